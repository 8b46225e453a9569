"""`walop-jax trace`: the table of the stages, for an instrument as designed and as fitted."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from own_instrument import OWN

import walop_jax as walop
from walop_jax.calibration.product import read_calibration
from walop_jax.data.settings import Settings, builtin_filter
from walop_jax.model.instrument import nominal_instrument
from walop_jax.model.trace import Sightline, trace

STAR = ("--x", 0.2, "--y", -0.1, "--q", 0.03, "--u", 0.01, "--teff", 5772)
SUN = dataclasses.replace(Settings.default(1), teff=np.array([5772.0]))
RAY = Sightline(x=0.2, y=-0.1, q=0.03, u=0.01, setting=SUN)


def test_as_designed(call):
    result = call("trace", *STAR, "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)["stages"]
    stages = trace(nominal_instrument(), builtin_filter("SDSS-r"), RAY)
    assert [stage["stage"] for stage in told] == [stage.name for stage in stages]
    np.testing.assert_allclose(told[-1]["value"], stages[-1].value, rtol=1e-12)


def test_as_fitted(call, run):
    result = call("trace", run, *STAR, "--json")
    assert result.exit_code == 0, result.output
    calibration = read_calibration(run / "calibration.fits")
    stages = trace(calibration.model.instrument(calibration.values), builtin_filter("SDSS-r"), RAY)
    np.testing.assert_allclose(json.loads(result.stdout)["stages"][-1]["value"], stages[-1].value, rtol=1e-12)


def test_the_table_has_a_line_for_every_stage(call):
    lines = call("trace", "--angle", 30, "--at", "CHWP=45").stdout.splitlines()
    starts = [
        "source",
        "collimator",
        "chwp",
        "arms half1",
        "arms half2",
    ]
    starts += ["analysers", "cameras", "counts"]
    assert [line for line in lines if not line.startswith(" ")].__len__() == len(starts)
    for start in starts:
        assert any(line.startswith(start) for line in lines)
    # The polariser at 30°: Q = cos 60°, U = sin 60°, but for its extinction.
    assert lines[1].split()[1:4] == ["1.000000", "0.499980", "0.865991"]


WRONG = (
    ("--q", 1.5), ("--instrument", "WALOP-WEST"), ("--filter", "SDSS-rr"), ("--at", "CHWP"), ("--at", "CHPW=3"),
)  # fmt: skip


@pytest.mark.parametrize("options", WRONG)
def test_wrong_usage(call, options):
    assert call("trace", *options).exit_code == 2


def test_a_run_that_is_not_there(call, tmp_path):
    result = call("trace", tmp_path / "RUN")
    assert result.exit_code == 1
    assert "RUN" in result.stderr


def test_an_instrument_tells_what_its_plates_do(tmp_path):
    """Light arrives whatever a plate does to it: a thickness in mm shows in its retardance alone."""
    path = tmp_path / "own.toml"
    path.write_text(OWN.replace('moves = "WIN"\n', "").replace('moves = "CLP"\n', ""))
    found = walop.instrument(path)
    # n_e − n_o at 0.62 µm of quartz, 0.00907, and of MgF2, 0.0118 (handbooks), the crystals crossed.
    assert found.retardance["main.plate"] == pytest.approx((51.0 * 0.00907 - 30.0 * 0.0118) / 0.62, abs=0.005)
    assert found.retardance["window"] == pytest.approx(0.1 / (2 * np.pi))
    assert "retards by 0.016 waves at 0.62 um" in str(found)
    assert any(line.split() == ["moves", "nothing"] for line in str(found).splitlines())


def test_an_instrument_may_be_traced_as_it_is():
    """It was refused as a wrong kind of calibration; `instrument=` is the same."""
    _, truth = walop.simulate(grid=2, standard_grid=1, angles=3, moon_patches=0, standards=0)
    one, other = walop.trace(truth, x=0.1, q=0.02), walop.trace(instrument=truth, x=0.1, q=0.02)
    np.testing.assert_array_equal(one[-1].value, other[-1].value)


def test_one_search_for_names_of_effects(call):
    """What nobody is much like goes by what effects are about; a slip of a letter by its looks."""
    told = [
        call("docs", "effect", "polariser_encoder").stderr,
        call("simulate", "--effect", "polariser_encoder=3", "-o", "none.fits").stderr,
    ]
    for text in told:
        assert "did you mean 'clp_zero' or 'clp_wobble'" in " ".join(text.split())
    assert (
        "did you mean 'wollaston_axis'"
        in call("simulate", "--effect", "wolaston_axs=3", "-o", "n.fits").stderr
    )
