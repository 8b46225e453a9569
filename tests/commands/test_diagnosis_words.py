"""What a diagnosis found is told by `print`, by the command and by the page in the same sentences."""

from __future__ import annotations

import dataclasses
import html
import json

import handmade_run
import pytest
from small_run import small_fit

from walop_jax.diagnosis.findings import Diagnosis, Step, Unexplained, document
from walop_jax.model.effects.change import Change


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    fit = small_fit().with_verdict()
    step = Step(
        effect="described",
        parameters={"turn": (0.1, 0.01, "deg")},
        score=100.0,
        p_value=1e-9,
        log_bayes=40.0,
        chi2_before=2000.0,
        chi2_after=1000.0,
        dof_after=900,
        heldout_scheme="exposures",
        heldout_before=1.0,
        heldout_after=1.0,
        change_of_qu=0.01,
        equivalent=("clp_zero",),
        separated_by="a polarised standard",
        where={"kind": "clp 100%"},
        descriptions=((Change.parsed("turn of polariser * x"), 0.1, 0.01),),
        nameless=("a step of the polariser in exposure 4",),
        alternatives=("camera = 2",),
    )
    left = Unexplained(1e-5, "patterns over the field are left", (), ("gain",), 1000.0, 900.0)
    return Diagnosis(
        "effect_found", (step,), (), (), ("etalon",), left, 1e-9, 0.5, fit, fit, 1.0, 29,
        classes=({"effect": "hwp1_axis", "equivalent": ["hwp2_axis"], "separated_by": "stars in the other half"},),
    )  # fmt: skip


def test_the_first_line_says_what_is_missing_where_and_how_large(found: Diagnosis):
    """Cause, place, size and probability, by hand; a description in its own words."""
    spot = dataclasses.replace(
        found.steps[0],
        effect="blemish",
        about="a dark spot in front of one camera, O2",
        parameters={"depth": (0.006, 0.0005, ""), "x": (0.11, 0.01, "deg")},
        descriptions=(),
        probability=0.971,
    )
    assert spot.in_words == (
        "a dark spot in front of one camera, O2: depth 0.00600 ± 0.00050, x 0.110 ± 0.010 deg (blemish, probability "
        "0.97)"
    )
    assert repr(spot) == f"Step({spot.in_words}; χ² 2000 → 1000)"
    shown = dataclasses.replace(found, steps=(dataclasses.replace(spot, choices={"camera": 2}),)).display()
    assert list(shown.rows[0][:3]) == ["blemish", "camera", "O2"]
    # √((0.001 s₀²)² + (0.004 s₁ s₀/√3)²) of s₀ = 0.7083 and s₁ = 0.9212; errors by hand in the same way.
    terms = tuple(
        (Change.parsed(f"gain of O1 * hours * field {i} 0"), size, 0.0002)
        for i, size in enumerate((0.001, 0.004))
    )
    smooth = dataclasses.replace(spot, effect="described", descriptions=terms, parameters={})
    words = (
        "gain of O1: 0.001588 ± 0.000078 rms, in a smooth field, growing with time (per hour since the first"
    )
    assert smooth.in_words.startswith(words)
    turned = dataclasses.replace(
        spot,
        effect="clp_zero",
        about="zero point of the polariser's encoder",
        parameters={"angle": (0.2, 0.01, "deg")},
        probability=0.9999,
    )
    assert turned.in_words == (
        "zero point of the polariser's encoder: 0.200 ± 0.010 deg (clp_zero, probability above 0.99)"
    )
    facts = dict(dataclasses.replace(found, steps=(spot,), unexplained=None).display().facts)
    assert facts["found"] == spot.in_words


def comes_out(found: Diagnosis, monkeypatch) -> None:
    """What the command gets in place of a search of minutes."""
    monkeypatch.setattr("walop_jax.diagnosis.workflow.diagnose", lambda *args, **how: found)
    monkeypatch.setattr("walop_jax.diagnosis.figure_data.figure_data", lambda found: None)
    monkeypatch.setattr(
        "walop_jax.diagnosis.figure_data.write_figure_data", lambda path, data: path.write_bytes(b"")
    )


def test_print_command_and_page_say_the_same(found: Diagnosis, call, calset_file, tmp_path, monkeypatch):
    comes_out(found, monkeypatch)
    run = handmade_run.make_refit(tmp_path / "run")
    content = document(found) | {"shown": found.display().document()}
    (run / "diagnosis.json").write_text(json.dumps(content))
    shown = call("diagnose", calset_file, "-o", tmp_path / "made").stdout
    call("report", run)
    page = html.unescape((run / "report.html").read_text()).replace("\N{NO-BREAK SPACE}", " ")
    for text in (
        "turn of polariser: 0.100 ± 0.010 deg, growing with X (amplitude at 0.3°)",
        "these data cannot distinguish it from clp_zero, a step of the polariser in exposure 4",
        "what would: a polarised standard",
        "equally consistent with camera = 2",
        "added as a free-form term (gain): χ² 1000.0 → 900.0",
        "before anything was added hwp1_axis was significant too; these data cannot distinguish it from hwp2_axis; "
        "what would: stars in the other half",
        "not tested, since these data cannot show it: etalon",
        "χ² 2000.0 → 1000.0",
    ):
        for said in (repr(found), shown, page):
            assert text in said
    assert "mean squared residual of data left out (exposures) 1 → 1" in shown
    assert "kind: clp" not in shown  # of one kind there is nothing to say


@pytest.mark.parametrize(
    ("verdict", "words", "doubts"),
    [("unexplained", "unexplained", []), ("effect_found", "effect found", ["odd"])],
)
def test_what_is_not_to_be_used_is_not_recommended(
    verdict, words, doubts, found: Diagnosis, call, calset_file, tmp_path, monkeypatch
):
    made = dataclasses.replace(found, verdict=verdict, after=small_fit().with_verdict(doubts))
    comes_out(made, monkeypatch)
    done = call("diagnose", calset_file, "-o", tmp_path / "made")
    assert done.exit_code == 3  # as of every other command whose calibration is not to be used
    assert done.stdout.startswith(f"Diagnosis ({words}): no go: ")
    assert "Written to" in done.stdout
    assert "walop-jax report" in done.stderr
    assert "walop-jax apply" not in done.stderr
    assert ("if nothing were missing" in done.stdout) == (not doubts)
