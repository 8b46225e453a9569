"""A polarimeter on a bench, two beams behind a half-wave plate that turns, its intensities made by numpy alone."""

from __future__ import annotations

import re

import numpy as np
import pytest

from walop_jax.data.calset import from_arrays
from walop_jax.data.records import CalibrationSet, FilterCurve
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.instruments.description import parsed
from walop_jax.io.errors import DataError
from walop_jax.model.instrument import build

BENCH = """
name = "BENCH"
path = ["polariser", "hwp"]
[field]
limit = 0.1
scale = 0.1
[cameras]
names = ["left", "right"]
[throughput]
degree = {degree}
[elements.polariser]
kind = "polariser"
moves = "CLP"
extinction = 1e-5
[elements.hwp]
kind = "spectral"
moves = "HWP"
axis = {{ value = 0.0, sigma = 1.0, unit = "deg" }}
delta_at = [0.44, 0.55, 0.65]
delta = {{ value = [3.2, 3.14, 3.1], sigma = 0.1, unit = "rad" }}
[arms.main]
path = ["wollaston"]
[arms.main.elements.wollaston]
kind = "analyser"
cameras = ["left", "right"]
efficiency = {{ value = 0.998, sigma = 0.002 }}
angle = {{ value = 0.0, sigma = 0.5, unit = "deg" }}
"""
WAVELENGTH = {"B": 0.44, "V": 0.55, "R": 0.65}
RETARDANCE = {"B": 3.22, "V": 3.13, "R": 3.06}
MINUTES, SLIPPED = 2.0, 40  # between exposures; the first behind the slip


def _behind_plate(retardance: float, axis: float, polariser: float) -> float:
    """q of fully polarised light behind a linear retarder: angles in rad."""
    c, s = np.cos(2.0 * axis), np.sin(2.0 * axis)
    q, u = np.cos(2.0 * polariser), np.sin(2.0 * polariser)
    return (c * c + s * s * np.cos(retardance)) * q + c * s * (1.0 - np.cos(retardance)) * u


def bench(
    side: int = 4, *, slip: float = 0.0, drift: float = 0.0, balance: dict[str, float] | None = None
) -> CalibrationSet:
    """72 exposures in random order; `slip` (deg) of the plate, `drift` of a gain, `balance` of the beams by filter."""
    draw = np.random.default_rng(11)
    settings = [
        (name, plate, angle)
        for name in WAVELENGTH
        for plate in (0.0, 22.5, 45.0, 67.5)
        for angle in range(0, 180, 30)
    ]
    settings = [settings[i] for i in draw.permutation(len(settings))]
    x, y = (
        (one.ravel() for one in np.meshgrid(*[np.linspace(-0.09, 0.09, side)] * 2))
        if side > 1
        else ([0.0],) * 2
    )
    expected = np.empty((side**2, len(settings), 2))
    for number, (name, plate, angle) in enumerate(settings):
        axis = np.deg2rad(plate + 0.4 + (slip if number >= SLIPPED else 0.0))
        q = 0.997 * _behind_plate(RETARDANCE[name], axis, np.deg2rad(angle))
        ratio = (balance or {}).get(name, 1.02) * (1.0 + drift * number / len(settings))
        expected[:, number] = 2e5 * np.array([(1.0 + q) * ratio, 1.0 - q])
    counts = draw.poisson(expected) + draw.normal(0.0, 30.0, expected.shape)
    filters, plates, angles = zip(*settings, strict=True)
    return from_arrays(
        counts,
        np.sqrt(expected + 900.0),
        x,
        y,
        np.array(angles, float),
        instrument="BENCH",
        filter=list(filters),
        filters={n: FilterCurve(n, np.array([w]), np.array([1.0])) for n, w in WAVELENGTH.items()},
        mjd=61000.0 + np.arange(len(settings)) * MINUTES / 1440.0,
        hwp_in=True,
        hwp_angle=np.array(plates, float),
    )


def diagnosed(calset: CalibrationSet, degree: int = 1) -> Diagnosis:
    return diagnose(calset, base_model(calset, build(parsed(BENCH.format(degree=degree), "bench.toml"))))


def test_a_plate_that_slips_is_told_with_its_time():
    """Half-wave plates turn polarisation by twice what they turn: a polariser turned the other way does the same."""
    with pytest.raises(DataError, match="it would if") as told:
        diagnosed(bench(slip=0.3))
    said = str(told.value)
    plate, polariser = (
        re.search(rf"{name}_ANGLE is (\S+)° too (?:small|large) in exposures (\d+)", said)
        for name in ("HWP", "CLP")
    )
    assert plate
    assert polariser
    assert float(plate[1]) == pytest.approx(0.3, abs=0.01)
    assert float(polariser[1]) == pytest.approx(0.6, abs=0.02)
    assert int(plate[2]) == int(polariser[2]) == SLIPPED


def test_a_gain_that_drifts_leaves_nothing_behind():
    """Scattered light that follows the measured median would go on finding their noise."""
    found = diagnosed(bench(drift=0.01))
    assert [step.effect for step in found.steps] == ["camera_gain_drift"]
    assert found.verdict == "effect_found"
    assert diagnosed(bench()).verdict == "consistent"


def test_a_balance_that_differs_between_filters_is_told_at_a_single_field_point():
    """Gains of the two beams that change with wavelength are a diattenuation ahead of the analyser."""
    found = diagnosed(bench(1, balance={"B": 1.01, "V": 1.02, "R": 1.03}), degree=0)
    (step,) = found.steps
    ((change, value, sigma),) = step.descriptions
    assert change.text == "diattenuation q behind hwp * colour"
    assert value == pytest.approx(0.02 / 2.0 / ((0.65 - 0.44) / 0.62), abs=4.0 * sigma)
    assert found.verdict == "effect_found"
