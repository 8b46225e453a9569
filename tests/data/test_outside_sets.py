"""Sets made outside the project are read as they are, and written back to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

from walop_jax.data import read_calibration_set, write_calibration_set

SETS = {
    "walop_south_a": (31, 169, 3512, "WALOP-SOUTH"),
    "walop_south_b": (155, 169, 21368, "WALOP-SOUTH"),
    "walop_south_c": (31, 169, 3512, "WALOP-SOUTH"),
    "walop_south_d": (31, 169, 3512, "WALOP-SOUTH"),
    "walop_north_design": (300, 288, 86400, "WALOP-NORTH"),
}


@pytest.mark.parametrize("name", SETS)
def test_outside_set(name, shared_data, tmp_path):
    path = shared_data / f"{name}.fits"
    exposures, points, rows, instrument = SETS[name]
    calset = read_calibration_set(path)
    assert (len(calset.exposures), len(calset.points)) == (exposures, points)
    assert (calset.intensities.rows, calset.instrument, calset.remarks) == (rows, instrument, ())

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


def test_two_outside_sets_share_points_and_stars(shared_data):
    calset = read_calibration_set(*(shared_data / f"walop_south_{name}.fits" for name in "ac"))
    assert (len(calset.exposures), len(calset.points)) == (62, 169)
    assert calset.intensities.rows == 2 * 3512
    assert len(calset.sources) in (8, 16)
