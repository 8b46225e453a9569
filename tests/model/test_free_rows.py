"""Instruments of which little is known: one detector in light of one flux, and cameras with a free row each."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from one_arm import POLARISER, one_arm

import walop_jax as walop
from walop_jax.calibration.matrix import instrument_matrices
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.records import FilterCurve
from walop_jax.data.write import write_calibration_set
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import refit
from walop_jax.io.errors import DataError
from walop_jax.model.instrument import Instrument

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "notebooks"))
from tables import bench_set, saying

RETARDER = """
[elements.plate]
kind = "retarder"
moves = "PLATE"
delta = { value = 1.5, sigma = 0.5 }
wavelength = 0.6
axis = { value = 0.0, sigma = 5.0 }
"""
ONE_DETECTOR = one_arm(
    "ONE-DETECTOR", ["polariser", "plate"], f"{POLARISER}extinction = 0.0\n{RETARDER}", cameras=["detector"]
)
FREE_ROWS = """
name = "FREE-ROWS"
path = ["polariser"]
[field]
limit = 0.1
[cameras]
names = ["a", "b"]
[throughput]
degree = 0
loose = 20.0
[elements.polariser]
kind = "polariser"
moves = "CLP"
extinction = 0.0
[arms.first]
path = ["row", "detector"]
[arms.first.elements.row]
kind = "analysis_vector"
moves = "POL"
q = { value = 0.0, sigma = 1.0 }
u = { value = 0.0, sigma = 1.0 }
cos1 = { value = [0.0, 0.0, 0.0, 0.0], sigma = 0.1 }
[arms.first.elements.detector]
kind = "analyser"
cameras = ["a"]
[arms.second]
path = ["detector"]
[arms.second.elements.detector]
kind = "analyser"
cameras = ["b"]
angle = 90.0
"""


def described(tmp_path: Path, text: str) -> Instrument:
    path = tmp_path / "own.toml"
    path.write_text(text, encoding="utf-8")
    return Instrument.read(path)


def one_detector(delta: float = 1.4, zero: float = 2.0):
    """A retarder that turns between parallel polarisers: I ∝ 1 − ½ (1 − cos δ) sin² 2α (Goldstein 2003, ch. 5)."""
    angle = np.tile(np.arange(0.0, 180.0, 12.0), 2)
    wavelength, flux = np.repeat([0.6, 0.8], 15), np.repeat([2e5, 7e6], 15)
    retarded = 1.0 - np.cos(delta * 0.6 / wavelength)
    counts = flux * (1.0 - 0.5 * retarded * np.sin(2.0 * np.deg2rad(angle + zero)) ** 2)
    filters = [FilterCurve(f"{w:g}", np.array([w]), np.ones(1)) for w in (0.6, 0.8)]
    moving = {"PLATE": angle}
    return bench_set(
        "ONE-DETECTOR", "", "steady", filters, np.repeat([0, 1], 15), counts[:, None], 1e-3 * flux[:, None],
        moving, polariser=np.zeros(30),
    )  # fmt: skip


def test_one_detector_and_one_flux_for_each_filter(tmp_path):
    instrument, calset = described(tmp_path, ONE_DETECTOR), one_detector()
    result = refit(calset, base_model(calset, instrument))
    assert result.converged
    assert result.value("plate.delta")[0] == pytest.approx(1.4, abs=1e-5)
    assert result.value("plate.axis")[0] == pytest.approx(2.0, abs=1e-4)
    assert result.dof == 30 - 2 + 2 - 2  # intensities, a flux for each filter, priors, free parameters
    write_calibration_set(tmp_path / "one.fits", calset)
    again = read_calibration_set(tmp_path / "one.fits")
    np.testing.assert_array_equal(again.intensities.counts, calset.intensities.counts)
    assert set(again.exposures.kind) == {"steady"}


def test_without_an_arm_of_two_cameras_there_is_a_fit_and_no_product(tmp_path):
    """No pair, no row of the instrument matrix: the fit is examined, and a run is refused before it is made."""
    instrument, calset = described(tmp_path, ONE_DETECTOR), one_detector()
    result = walop.refit(calset, instrument=instrument)
    assert result.verdict is not None
    assert result.value("plate.delta")[0] == pytest.approx(1.4, abs=1e-5)
    assert instrument_matrices(result).shape == (1, 0, 3)
    write_calibration_set(tmp_path / "one.fits", calset)
    (description,) = tmp_path.glob("*.toml")
    with pytest.raises(DataError, match="no arm has two cameras"):
        walop.refit(tmp_path / "one.fits", instrument=description, output=tmp_path / "RUN")
    assert not (tmp_path / "RUN").exists()


def test_a_gain_may_follow_any_element_that_moves(tmp_path):
    instrument, calset = described(tmp_path, ONE_DETECTOR), one_detector()
    angle = np.deg2rad(calset.exposures.position("PLATE").angle)
    calset.intensities.counts[:] *= (1.0 + 0.004 * np.cos(angle))[:, None]
    model = saying(base_model(calset, instrument), calset, ["gain of detector * cos 1 PLATE"])
    result = refit(calset, model)
    assert result.values[-1] == pytest.approx(0.004, abs=1e-6)


def test_free_rows_that_follow_the_polariser(tmp_path):
    instrument = described(tmp_path, FREE_ROWS)
    angle = np.arange(0.0, 360.0, 10.0)
    c, s = np.cos(2 * np.deg2rad(angle)), np.sin(2 * np.deg2rad(angle))
    flux = 1e6 * (1.0 + 0.3 * c)
    wander = np.cos(np.deg2rad(angle))
    first = 1.0 + 0.3 * c - 0.2 * s + wander * (0.01 + 0.02 * c - 0.03 * s)
    counts = np.column_stack([0.25 * flux * first, flux * 0.5 * (1.0 - 0.999 * c)])
    calset = bench_set(
        "FREE-ROWS", "", "clp", [FilterCurve("laser", np.array([0.5]), np.ones(1))], np.zeros(36, int), counts,
        np.full((36, 2), 100.0), {"POL": angle}, polariser=angle,
    )  # fmt: skip
    result = refit(calset, base_model(calset, instrument))
    row = [result.value(f"first.row.{name}")[0] for name in ("q", "u", "cos1.i", "cos1.q", "cos1.u")]
    np.testing.assert_allclose(row, [0.3, -0.2, 0.01, 0.02, -0.03], atol=2e-3)


def test_what_an_arm_may_have(tmp_path):
    three = ONE_DETECTOR.replace('["detector"]', '["detector", "b", "c"]')
    with pytest.raises(DataError, match="two cameras, or of one"):
        described(tmp_path, three)
    with pytest.raises(DataError, match="one each for I, Q, U and V"):
        described(tmp_path, FREE_ROWS.replace("[0.0, 0.0, 0.0, 0.0]", "[0.0, 0.0]"))


def test_a_single_camera_says_nothing_of_light_of_unknown_flux(tmp_path):
    calset = one_detector()
    calset.exposures.kind[:] = "lamp"
    write_calibration_set(tmp_path / "one.fits", calset)
    with pytest.raises(DataError, match=re.escape("two at least where KIND is not flux or steady")):
        read_calibration_set(tmp_path / "one.fits")
