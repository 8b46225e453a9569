"""`walop-jax trace`: the table of the stages, for an instrument as designed and as fitted."""

from __future__ import annotations

import numpy as np
import pytest
from own_instrument import OWN

import walop_jax as walop


def test_the_table_has_a_line_for_every_stage(call):
    lines = call("trace", "--angle", 30, "--at", "CHWP=45").stdout.splitlines()
    starts = ["source", "collimator", "chwp", "arms half1", "arms half2"]
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
    _, truth = walop.simulate(walop.ObservingPlan(grid=2, standard_grid=1, moon_patches=0, standards=0))
    one, other = walop.trace(truth, x=0.1, q=0.02), walop.trace(instrument=truth, x=0.1, q=0.02)
    np.testing.assert_array_equal(one[-1].value, other[-1].value)


def test_one_search_for_names_of_effects(call):
    """What nobody is much like goes by what effects are about; a slip of a letter by its looks."""
    told = call("simulate", "--effect", "polariser_encoder=3", "-o", "none.fits").stderr
    assert "did you mean 'clp_zero' or 'clp_wobble'" in " ".join(told.split())
    assert (
        "did you mean 'wollaston_axis'"
        in call("simulate", "--effect", "wolaston_axs=3", "-o", "n.fits").stderr
    )
