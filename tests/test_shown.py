"""What a session shows of the things that a user holds: short texts with units, and help that speaks Python first."""

from __future__ import annotations

import inspect

import jax
import pytest
from small_run import SEED, SMALL, small_fit

import walop_jax as walop
from walop_jax.calibration.calibration import Calibration
from walop_jax.commands import COMMANDS

LONGEST = 200  # characters of a line about one thing


def test_effects_are_short_and_have_units():
    shown = [repr(kind) for kind in walop.EFFECTS]
    assert max(map(len, shown)) < LONGEST
    assert "hwp1_axis(angle [deg])" in shown
    assert len(repr(walop.EFFECTS)) < 5000


def test_effects_at_some_values_are_lines():
    context = walop.ObservingPlan(grid=3).context()
    for kind in walop.EFFECTS:
        line = repr(kind.neutral(context))
        assert line.startswith(f"{kind.name}(")
        assert len(line) < LONGEST
        assert "\n" not in line
    turned = walop.effect_by_name("hwp1_axis").of(context, angle=0.3)
    assert repr(turned) == "hwp1_axis(angle=0.3 deg)"
    spot = walop.effect_by_name("blemish").of(context, x=0.1, depth=0.02, camera="E1")
    assert repr(spot) == "blemish(x=0.1 deg, y=0 deg, size=0.05 deg, depth=0.02, camera=1)"
    shapes = jax.eval_shape(lambda effect: effect, turned)
    assert repr(shapes) == "hwp1_axis(angle=?)"


def test_parts_of_a_fit_are_lines():
    result = small_fit()
    parts = [*result.model.parameters, result.minimum, result.expansion, result.likelihood]
    assert max(len(repr(part)) for part in parts) < LONGEST
    assert repr(result.model["half1.wedge"]) == (
        "Parameter half1.wedge = -0.23 rad, prior -0.23 ± 0.001, free: wedge angle"
    )


def test_parts_of_a_set_and_its_likelihood_are_lines():
    calset = walop.simulate(SMALL, seed=SEED).calset
    assert repr(calset.exposures) == (
        "Exposures: 8 clp, 3 moon, 3 standard; SDSS-r, MJD 61220.82 to 61220.87; in the beam: CLP"
    )
    assert repr(calset.exposures[:0]).startswith("Exposures: none")
    assert repr(calset.points) == "Points: 29 field points, X -0.290 to +0.290°, Y -0.290 to +0.290°"
    likelihood = walop.Likelihood.of(calset, walop.base_model(calset))
    assert repr(likelihood) == (
        f"Likelihood of WALOP-SOUTH: 29 points, 14 exposures, 4 cameras; {len(likelihood.model.names)} parameters, "
        f"{len(likelihood.model.free)} free"
    )


@pytest.mark.parametrize("name", [name.replace("-", "_") for name in COMMANDS])
def test_help_speaks_python_first(name: str):
    """The sentence, what Python gives, arguments and example; what a terminal adds comes last."""
    text = inspect.getdoc(getattr(walop, name)) or ""
    assert text.count("In Python:") == 1
    second = text.split("\n\n")[1]
    assert second.startswith("In Python:")
    if "On the command line:" in text:
        assert text.index(">>>") < text.index("On the command line:")


def test_watched_effects_are_those_that_change_from_night_to_night():
    """Plates and prisms that are taken out and put back, window, mirror and filter: no crystals, no cameras."""
    assert sorted(kind.name for kind in walop.EFFECTS if kind.watched) == [
        "chwp_axis", "filter_shift", "hwp1_axis", "hwp1_crossing", "hwp2_axis", "hwp2_crossing",
        "telescope_polarisation", "upstream_retarder", "wollaston_axis",
    ]  # fmt: skip


def test_working_parts_are_not_between_results():
    """`dir`, and with it completion, names what a user may want; other rooms still find the rest."""
    result = small_fit()
    calibration = Calibration.from_fit(result)
    for one, working in (
        (result, ("with_verdict", "with_doubt", "with_remark", "checked_verdict", "shown", "of")),
        (calibration, ("shown", "widened", "with_covariance", "matrix_columns")),
        (result.verdict, ("on_top_of", "recorded", "answers")),
        (result.likelihood, ("data_terms", "with_errors_at", "points_as_stated", "taken", "of")),
    ):
        assert [name for name in working if not hasattr(one, name)] == []
        assert set(working) & set(dir(one)) == set()
    assert {"residuals", "to_table", "trusted", "covariance", "plot", "save"} <= set(dir(result))
    assert {"matrix", "flags", "covariance", "maps"} <= set(dir(calibration))
    assert {"residuals", "jacobian", "expand", "model", "priors"} <= set(dir(result.likelihood))


def test_help_lists_every_argument_of_refit():
    text = inspect.getdoc(walop.refit) or ""
    arguments = text.split("Arguments:\n")[1].split("\n\n")[0].splitlines()
    assert [line.split(":")[0] for line in arguments] == list(inspect.signature(walop.refit).parameters)
