"""Go or no-go: each requirement missed by itself, and what is told then."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from small_run import small_fit

from walop_jax.calibration.product import Validity
from walop_jax.data.inspection import inspect
from walop_jax.fit.verdict import Verdict
from walop_jax.science.commissioning import Certificate, requirements
from walop_jax.science.field_accuracy import FieldAccuracy, for_stars

FIELD = np.linspace(1e-4, 4.9e-4, 100).reshape(10, 10)  # median 2.95e-4


def accuracy(**changes):
    plain = FieldAccuracy(
        FIELD, (-0.3, 0.3, -0.3, 0.3), "SDSS-r", limited_by="the sky (70 % of the variance)"
    )
    return dataclasses.replace(plain, **changes)


def certificate(result, accuracy):
    asked = requirements(result.checked_verdict(), "", accuracy, result.calset)
    verdict = for_stars(result.checked_verdict(), accuracy, inspect(result.calset).findings)
    found = Certificate(
        Path("calibration.fits"), (), asked, Validity((0.0, 0.0), (), (0.0, 0.0)), "", (), verdict
    )
    assert found.go == verdict.go == Verdict(doubts=found.against).go
    return found


def test_a_go():
    found = certificate(small_fit(), accuracy(hidden=2e-4, hidden_by="the filter"))
    assert found.go
    assert "go" in found.display().title
    assert "p known to 0.050 % in 95 % of the field" in found.display().text()
    # Eight angles and a set of 25 points: told, and no reason against it.
    assert all(one.met for one in found.requirements if one.needed)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        # (8.85·10⁻⁴/5·10⁻⁴)² = 3.13 times the light for half of the goal in half of the field.
        (
            {"error": 3.0 * FIELD},
            "0.088 % in 50 % of the field, 0.050 % allowed: 3.1 times the light (most of the error comes from the sky)",
        ),
        ({"error": FIELD + 1e-2}, "times the light"),
    ],
)
def test_a_no_go(change, words):
    found = certificate(small_fit(), accuracy(**change))
    assert not found.go
    assert "no go" in found.display().title
    assert words in found.missing[0]
    first = found.verdict.reasons[0]
    assert first.blocking
    assert words.partition(": ")[0] in first.words
    assert first.off == pytest.approx(np.median(change["error"]))
    assert found.document()["go"] is False


@pytest.mark.parametrize(
    "change",
    [
        {"error": np.full((10, 10), np.nan)},  # both arms see the same direction: the matrix has no inverse
        {"error": np.full((10, 10), 5.0), "with_u": np.zeros((10, 10), bool), "without_u": 1.0},
    ],
)
def test_an_error_that_is_not_known_is_no_go(change):
    found = accuracy(**change)
    assert np.isnan(found.reached)
    assert not certificate(small_fit(), found).go
    assert found.document()["good_enough"] is False
    assert dict(found.facts())["good for 0.1 %"].startswith("no, for ")
    assert any("plate at 22.5°" in one.cure for one in for_stars(small_fit().verdict, found).reasons)


def test_what_is_not_trusted_is_no_go():
    bad = small_fit().with_verdict(["the residuals hold patterns"])
    assert certificate(small_fit().with_remark("a remark"), accuracy()).go
    refused = certificate(bad, accuracy())
    assert not refused.go
    # The first reason alone, and nothing of an accuracy that is not known.
    assert [one.found for one in refused.requirements if not one.met and one.needed] == [
        "the residuals hold patterns"
    ]
    assert not any("% of the field" in one.what for one in refused.requirements)
    assert "diagnose" in certificate(bad, accuracy()).missing[0]
    assert (
        refused.verdict.first_line
        == "no go: the residuals hold patterns; walop-jax diagnose looks for the cause"
    )


def test_mistakes_that_could_hide_are_told_but_forbid_nothing():
    found = certificate(
        small_fit(),
        accuracy(
            hidden=3e-3, hidden_by="the scale of X and Y (wrong by 2 %)", remedy="check the field positions"
        ),
    )
    assert found.go
    assert any("error of 0.30 %" in text and "field positions" in text for text in found.missing)
    assert found.verdict.words == "go, with reservations"
    assert found.verdict.reasons[0].off == 3e-3
    assert found.verdict.reasons[0].cure == "check the field positions"
    assert "goes undetected: the scale of X and Y" in found.display().text()


def test_the_edge_of_the_field_is_told():
    """1.6 · 2.95·10⁻⁴ in half of the field, 1.6 · 4.7·10⁻⁴ in 95 % of it: a go, and more light is advised."""
    found = certificate(small_fit(), accuracy(error=1.6 * FIELD))
    assert found.go
    assert any(text.startswith("0.075 %") and "times the light" in text for text in found.missing)


def test_the_strip_without_u_is_left_out_and_said():
    """A fifth of the field has errors of 1 %: 95 % of the rest is known as if the strip were not there."""
    with_u = np.ones((10, 10), bool)
    with_u[:, 4:6] = False
    error = np.where(with_u, FIELD, 1e-2)
    found = accuracy(error=error, without_u=0.2, with_u=with_u)
    assert found.reached == pytest.approx(np.quantile(FIELD[with_u], 0.95))
    assert found.reached < 5e-4
    said = certificate(small_fit(), found).display().text()
    assert "in 95 % of the field with u in one exposure (80 %)" in said
    assert np.quantile(error, 0.95) == pytest.approx(1e-2)


def test_where_one_exposure_holds_no_u_more_light_is_no_cure():
    """8 % of the field in the strip: the edge of the field is its matter, half of the field is not."""
    found = certificate(small_fit(), accuracy(error=1.6 * FIELD, without_u=0.08))
    assert found.go
    (told,) = [text for text in found.missing if text.startswith("0.075 %")]
    assert "8 % of the field" in told
    assert "plate at 22.5°" in told
    assert "times the light" not in told
