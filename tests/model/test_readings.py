"""A reading that is no angle: a liquid crystal driven by ±V, held against the closed form of its Mueller matrix."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from astropy.table import Table
from one_arm import POLARISER, one_arm

import walop_jax as walop
from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.settings import Settings
from walop_jax.data.user_tables import read_input_table
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import refit
from walop_jax.model import mueller
from walop_jax.model.elements.base import Element
from walop_jax.model.elements.simple import Retarder
from walop_jax.model.elements.wave_plate import WavePlate
from walop_jax.model.fold import Turning
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.parameters import Scalar, number
from walop_jax.plans.available import CandidateExposure, plan_beside
from walop_jax.plans.exposure_plan import PlannedExposure
from walop_jax.reports.wording import data_in_words
from walop_jax.science.apply import apply
from walop_jax.science.catalogue import read_catalogue
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

BASE, SLOPE, AXIS = 1.5, 0.3, 22.5  # rad, rad/V, deg
EFFICIENCY = 0.998  # of the analyser, known
VOLTS = (-5.0, 5.0)


class VoltageCell(Element):
    """A retarder whose retardance grows with a voltage; it has a unit, and says nothing of a period."""

    base: Scalar = number("rad", "retardance at 0 V")
    slope: Scalar = number("rad", "change per volt")
    axis: Scalar = number("deg", "fast axis")
    volt: float = eqx.field(static=True, default=0.0)
    kind: ClassVar[str] = "voltage_cell"
    reading_unit: ClassVar[str] = "V"

    def turned(self, angle):
        return dataclasses.replace(self, volt=float(angle))

    def mueller(self, ray):
        return mueller.retarder(self.base + self.volt * self.slope, jnp.deg2rad(self.axis))


class HalfTurnCell(VoltageCell):
    """The same, declared to act alike after 180."""

    kind: ClassVar[str] = "half_turn_cell"
    period: ClassVar[float | None] = 180.0


CELL = """
[elements.modulator]
kind = "voltage_cell"
moves = "FLC"
base = { value = 1.5, sigma = 0.05, unit = "rad" }
slope = { value = 0.3, sigma = 0.02, unit = "rad" }
axis = { value = 22.5, sigma = 1.0, unit = "deg" }
"""


@pytest.fixture(scope="module")
def instrument(tmp_path_factory) -> Instrument:
    path = tmp_path_factory.mktemp("cell") / "cell.toml"
    path.write_text(
        one_arm("CELL", ["polariser", "modulator"], POLARISER + CELL, analyser=f"efficiency = {EFFICIENCY}")
    )
    return Instrument.read(path, elements=[VoltageCell])


@pytest.fixture(scope="module")
def calibration(instrument) -> Calibration:
    """A calibration of the instrument; the voltages of its exposures are `VOLTS`."""
    plan = ObservingPlan(
        instrument, grid=2, polariser_angles=polariser_turn(6), moon_patches=0, standards=0,
        filters=("SDSS-r",), moving={"FLC": VOLTS},
    )  # fmt: skip
    calset = simulate(plan, seed=3).calset
    return Calibration.from_fit(refit(calset, base_model(calset, instrument)).with_verdict())


def retarder_by_hand(volt: float, base: float = BASE, slope: float = SLOPE, axis: float = AXIS) -> np.ndarray:
    """Linear retarder, written out: Q and U turn about the fast axis by δ = base + slope V (docs: conventions)."""
    delta = base + slope * volt
    c, s = np.cos(2 * np.deg2rad(axis)), np.sin(2 * np.deg2rad(axis))
    k = np.cos(delta)
    return np.array([
        [1, 0, 0],
        [0, c * c + s * s * k, c * s * (1 - k)],
        [0, c * s * (1 - k), s * s + c * c * k],
    ])  # fmt: skip


def test_periods_are_declared_or_absent():
    """360 for what turns by its axis; none, which is always right, for a class with a meaning of its own."""
    assert Retarder.period == WavePlate.period == 360.0
    assert VoltageCell.period is None
    assert HalfTurnCell.period == 180.0

    class Replaced(WavePlate):
        """A class on top of another one's `turned` keeps its period."""

    assert Replaced.period == 360.0


def test_only_angles_are_reduced(instrument):
    readings = np.array([-5.0, 355.0, 725.0, np.nan])
    np.testing.assert_array_equal(instrument.within_period("FLC", readings), readings)
    np.testing.assert_allclose(instrument.within_period("CLP", readings), [355.0, 355.0, 5.0, np.nan])
    half = instrument.changed(
        "", elements=(HalfTurnCell(name="modulator", moves="FLC"),), path=("modulator",)
    )
    np.testing.assert_allclose(half.within_period("FLC", readings), [175.0, 175.0, 5.0, np.nan])
    two = instrument.inserted(
        Retarder(name="beside", moves="FLC"), after="modulator"
    )  # one turns, one is driven
    np.testing.assert_array_equal(two.within_period("FLC", readings), readings)


def test_settings_a_turn_apart_are_one(instrument):
    """They share one table of the optics, which takes seconds to make; −5 V and 355 V must not."""

    def keys(instrument: Instrument, **at) -> set:
        vectors = AnalysisVectors.__new__(AnalysisVectors)
        vectors.instrument = instrument
        settings = vectors.reduced(Settings.default(2).at(**at))
        return {setting.key for setting, _ in settings.distinct()}

    readings = np.array([-5.0, 355.0])
    assert len(keys(nominal_instrument("WALOP-SOUTH"), CHWP=readings)) == 1
    assert len(keys(instrument, FLC=readings)) == 2


def test_stars_behind_a_cell_at_negative_voltage(calibration, tmp_path):
    """Counts by the closed form of the fitted numbers: q, u come back. −5 V taken as 355 V is 0.6 % off."""
    values = dict(zip(calibration.model.names, calibration.values, strict=True))
    fit = {name: values[f"modulator.{name}"] for name in ("base", "slope", "axis")}
    q, u = np.array([0.02, -0.03]), np.array([0.01, 0.02])
    light = np.stack([np.ones(2), q, u])
    rows = []
    for volt in VOLTS:
        _, seen, _ = retarder_by_hand(volt, **fit) @ light
        throughput = np.array([values["throughput.n0.p00"], values["throughput.n1.p00"]])
        counts = 1e6 * throughput[:, None] * (1.0 + np.array([[1.0], [-1.0]]) * EFFICIENCY * seen)
        rows.append(Table({"ID": [1, 2], "X": [0.03, -0.05], "Y": [0.01, 0.06], "N": counts.T,
                           "N_ERR": np.full((2, 2), 1e3), "FLC_ANGLE": [volt, volt]}))  # fmt: skip
    table = Table({name: np.concatenate([row[name] for row in rows]) for name in rows[0].colnames})
    table.write(tmp_path / "stars.fits")
    catalogue = read_catalogue(read_input_table(tmp_path / "stars.fits"), calibration.design)
    found = apply(calibration, catalogue)
    np.testing.assert_allclose(found.qu, np.stack([q, u], axis=1), atol=1e-9)
    at_minus_five, _ = calibration.matrix([0.03], [0.01], Settings.default(1).at(FLC=-5.0))
    by_hand = EFFICIENCY * retarder_by_hand(-5.0, **fit)[1, 1:]  # the first element is the ratio of the beams
    np.testing.assert_allclose(at_minus_five[0, 1:], by_hand, atol=1e-9)
    # A reading that was not stated in the exposures: nothing is looked up in it.
    at_355, _ = calibration.matrix([0.03], [0.01], Settings.default(1).at(FLC=355.0))
    assert abs(at_355[0, 1] - at_minus_five[0, 1]) > 1e-3


def test_a_plan_beside_a_calibration_keeps_the_voltages(calibration):
    assert plan_beside(calibration).moving == {"FLC": VOLTS}


def test_a_ramp_of_the_voltage_is_its_mean(instrument):
    """Mean of cos δ over a ramp of 400: by the closed form; nothing repeats itself after 360."""
    at, weight = Turning(10.0, 400.0).angles(None)
    rate = 0.05
    exact = (np.sin(rate * 210.0) - np.sin(rate * -190.0)) / (rate * 400.0)
    assert weight @ np.cos(rate * at) == pytest.approx(exact, abs=1e-12)
    assert weight.sum() == pytest.approx(1.0, abs=1e-13)


def test_two_voltages_with_equal_counts_are_no_copies(instrument, tmp_path):
    """−5 V and 355 V of one star with the same counts are two settings; for a plate −5° and 355° are one."""
    same = np.array([[1000.5, 2000.25], [1000.5, 2000.25]])
    table = Table({"ID": [1, 1], "X": [0.03, 0.03], "Y": [0.01, 0.01], "N": same, "N_ERR": np.sqrt(same)})
    remarks = {}
    for prefix, there in (("FLC", instrument), ("WIN", _window(tmp_path))):
        table[f"{prefix}_ANGLE"] = [-5.0, 355.0]
        table.write(tmp_path / f"{prefix}.fits")
        del table[f"{prefix}_ANGLE"]
        source = read_input_table(tmp_path / f"{prefix}.fits")
        read_catalogue(source, there)
        remarks[prefix] = " ".join(source.remarks)
    assert "copies of another row" in remarks["WIN"]
    assert "copies of another row" not in remarks["FLC"]


def _window(tmp_path) -> Instrument:
    window = CELL.replace("voltage_cell", "retarder").replace("base =", "delta =").replace('"FLC"', '"WIN"')
    window = "\n".join(line for line in window.splitlines() if not line.startswith("slope"))
    path = tmp_path / "window.toml"
    path.write_text(one_arm("WINDOW", ["polariser", "modulator"], POLARISER + window))
    return Instrument.read(path)


class SilentCell(VoltageCell):
    """The same, but it says nothing of the unit of its reading."""

    kind: ClassVar[str] = "silent_cell"

    def turned(self, angle):
        return super().turned(angle)


def test_a_reading_is_written_with_its_unit(instrument, calibration):
    """Degrees of what turns, volts of what says so, and the number alone where nothing is said."""
    assert nominal_instrument().reading_in_words("CHWP", 22.5) == "22.5°"
    assert instrument.reading_in_words("FLC", -5.0) == "−5 V"
    assert SilentCell.reading_in_words(-5.0) == "−5"
    assert SilentCell.period is None
    assert "FLC at −5 V" in str(walop.matrix(calibration, x=0.0, y=0.0, at={"FLC": -5.0}))
    assert dict(data_in_words(calibration))["FLC"] == "−5 V, 5 V"
    choice = CandidateExposure("clp", "SDSS-r", {"FLC": -5.0}, 30.0, ())
    assert choice.in_words(instrument.reading_in_words) == "clp, SDSS-r, FLC −5 V, 30 s"
    line = PlannedExposure("clp", "SDSS-r", {"FLC": -5.0}, 45.0, -1, 1, 30.0, 1.0, 1.0, 30.0, 0.0)
    assert line.cells(instrument.reading_in_words)[2:4] == ("FLC −5 V", "45.0°")
