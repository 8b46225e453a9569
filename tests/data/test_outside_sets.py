"""Sets made outside the project are read as they are, and written back to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from sets import cut
from south_sets import CUTS, SouthSet

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.write import write_calibration_set

# Exposures, points, rows of intensities.
CUT = {"a": (31, 50, 775), "b": (65, 50, 1625), "c": (31, 50, 775), "d": (31, 50, 775)}
WHOLE = {"a": (31, 169, 3512), "b": (155, 169, 21368), "c": (31, 169, 3512), "d": (31, 169, 3512)}


@pytest.mark.parametrize("name", CUT)
def test_cut_set(name, south_set, tmp_path):
    is_read_and_written(south_set(name).path, CUT[name], "WALOP-SOUTH", tmp_path)


@pytest.mark.parametrize("name", WHOLE)
def test_whole_set(name, whole_south_set, tmp_path):
    is_read_and_written(whole_south_set(name).path, WHOLE[name], "WALOP-SOUTH", tmp_path)


def test_design_of_walop_north(shared_data, tmp_path):
    is_read_and_written(shared_data / "walop_north_design.fits", (300, 288, 86400), "WALOP-NORTH", tmp_path)


def is_read_and_written(path, sizes, instrument, tmp_path):
    exposures, points, rows = sizes
    calset = read_calibration_set(path)
    assert (len(calset.exposures), len(calset.points)) == (exposures, points)
    assert (calset.intensities.rows, calset.instrument) == (rows, instrument)
    assert not [remark for remark in calset.remarks if "no checksum" not in remark]

    block = calset.intensities.block(0, points)
    with fits.open(path) as hdus:
        table = hdus["INTENSITIES"].data
        row = len(table) // 2
        place = np.flatnonzero(calset.points.point == table["POINT"][row])[0]
        exposure = np.flatnonzero(calset.exposures.exposure == table["EXPOSURE"][row])[0]
        np.testing.assert_array_equal(block.counts[place, exposure], table["N"][row])
        np.testing.assert_array_equal(block.sigma[place, exposure], table["N_ERR"][row])

    write_calibration_set(tmp_path / "again.fits", calset)
    again = read_calibration_set(tmp_path / "again.fits")
    for field in ("counts", "sigma", "used", "source", "x", "y"):
        copy = again.intensities.block(0, points)
        np.testing.assert_array_equal(getattr(copy, field), getattr(block, field))


def test_two_outside_sets_share_points_and_stars(south_set):
    calset = read_calibration_set(*(south_set(name).path for name in "ac"))
    assert (len(calset.exposures), len(calset.points)) == (62, 50)
    assert calset.intensities.rows == 2 * 775
    assert len(calset.sources) in (8, 16)


def test_cuts_hold_what_the_script_cuts(whole_south_set, tmp_path):
    cut.main(whole_south_set("a").path.parent, tmp_path)
    for name in WHOLE:
        again, kept = SouthSet.of(tmp_path, name), SouthSet.of(CUTS, name)
        assert again.as_built() == kept.as_built()
        for mine, theirs in ((again.path, kept.path), (again.matrix, kept.matrix)):
            assert fits.FITSDiff(str(mine), str(theirs)).identical
