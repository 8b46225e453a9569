"""A set that stands for pixels beside other sets: its record goes with it, or the sets are refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from astropy.io import fits
from frames_file import write_frames

import walop_jax as walop
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.grid import Grid
from walop_jax.data.merge import merge_calibration_sets
from walop_jax.data.records import Compression
from walop_jax.io.errors import DataError

RECORD = Compression(
    90_000, 271_000.0, 269_900, {"half2.wedge": 0.2305, "half2.plate.mgf2": 1930.5}, gain=1e-3, response=2e-4
)
ANGLES = [0.0, 30.0, 60.0, 90.0]


def a_set(seed: int, **changes):
    """Sets of four exposures with numbers of their own noise; all have the EXPOSURE numbers 0 to 3."""
    counts = 1e5 * (1.0 + np.random.default_rng(seed).random((2, 4, 4)))
    calset = walop.from_arrays(counts, np.sqrt(counts), [0.0, 0.1], [0.1, 0.0], ANGLES)
    return dataclasses.replace(calset, **changes)


@pytest.mark.parametrize("first", [True, False])
def test_the_record_goes_with_its_exposures(first, tmp_path):
    """Whichever set comes first; the file of both gives it back."""
    sets = [a_set(1, compression=RECORD), a_set(2)]
    merged = merge_calibration_sets(*(sets if first else sets[::-1]))
    record, exposures = merged.compression, merged.exposures
    assert record == dataclasses.replace(RECORD, exposures=record.exposures)
    np.testing.assert_array_equal(record.covers(exposures), [first] * 4 + [not first] * 4)
    summed = merged.intensities.block(0, 2).counts[:, record.covers(exposures)]
    np.testing.assert_array_equal(summed, sets[0].intensities.block(0, 2).counts)
    walop.write_calibration_set(tmp_path / "both.fits", merged)
    assert read_calibration_set(tmp_path / "both.fits").compression == record


def test_a_third_set_is_beside_it_too():
    twice = merge_calibration_sets(merge_calibration_sets(a_set(2), a_set(1, compression=RECORD)), a_set(3))
    np.testing.assert_array_equal(
        twice.compression.covers(twice.exposures), [False] * 4 + [True] * 4 + [False] * 4
    )


def test_alone_it_stays_as_it_is():
    assert merge_calibration_sets(a_set(1, compression=RECORD)).compression == RECORD


def test_two_of_them_are_refused():
    both = a_set(1, compression=RECORD), a_set(2, compression=RECORD)
    with pytest.raises(DataError, match=r"walop-jax refit A\.fits B\.fits --compress"):
        merge_calibration_sets(*both)


def test_beside_frames_it_is_refused(tmp_path):
    """Frames would be summed again, at other values."""
    grid = Grid(2, 1, (1.0, 1.0), (0.0, 0.0), ((0.1, 0.0), (0.0, 0.1)))
    write_frames(tmp_path / "frames.fits", a_set(2), grid)
    frames = read_calibration_set(tmp_path / "frames.fits")
    with pytest.raises(DataError, match=r"or there are frames.*walop-jax refit A\.fits B\.fits --compress"):
        merge_calibration_sets(a_set(1, compression=RECORD), frames)


def test_copies_beside_it_are_still_found():
    merged = merge_calibration_sets(a_set(1, compression=RECORD), a_set(2), a_set(2))
    assert sum("if they are copies" in remark for remark in merged.remarks) == 1


@pytest.mark.parametrize("text", ["", "0", "3:1", "0:2,x", "0:99999999999"])
def test_a_header_that_names_no_exposures_is_refused(text, tmp_path):
    path = tmp_path / "both.fits"
    walop.write_calibration_set(path, merge_calibration_sets(a_set(1, compression=RECORD), a_set(2)))
    with fits.open(path, mode="update") as hdus:
        hdus["COMPRESSION"].header["EXPOSURE"] = text
        hdus["COMPRESSION"].add_checksum()
    with pytest.raises(DataError, match=r"COMPRESSION.*EXPOSURE.*runs of numbers"):
        read_calibration_set(path)
