"""A plate that turns during an exposure: its mean over the angles against averages made by other means."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from handmade_set import Handmade
from small_run import SMALL

import walop_jax as walop
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.records import Position
from walop_jax.data.settings import BUILTIN_FILTERS, Settings, builtin_filter
from walop_jax.fit.refit import refit
from walop_jax.io.errors import DataError
from walop_jax.model import light
from walop_jax.model.fold import Turning
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.planning import plan_for_settings
from walop_jax.simulation.observing_plan import Stop
from walop_jax.simulation.simulate import simulate

R = next(iter(BUILTIN_FILTERS))


def rows(instrument: Instrument, angles, turns=None, at=(0.2, -0.15), band="MONO-6500"):
    """Rows that the analysers see behind the plate at angles (deg), which turns meanwhile."""
    settings = dataclasses.replace(
        Settings.default(len(angles), band).at(CHWP=np.array(angles, float)),
        turns={} if turns is None else {"CHWP": np.array(turns, float)},
    )
    plan = plan_for_settings(instrument, settings, {band: builtin_filter(band)})
    found = jax.jit(lambda x, y: light.band_rows(instrument, plan, x, y))(*map(float, at))
    return np.asarray(found)[plan.band_of[:, 0]]


@pytest.mark.parametrize("turn", [1.0, 30.0, 100.0, 359.0, 360.0, 540.0, 1000.0])
def test_weights_average_harmonics_as_the_integral_does(turn):
    """Mean of cos n(θ − ψ) from a to b: cos n(m − ψ) sinc(n (b − a)/2), for all harmonics that plates can have."""
    at, weight = Turning(17.0, turn).angles()
    assert weight.sum() == pytest.approx(1.0, abs=1e-13)
    for n in range(1, 25):
        half = n * np.deg2rad(turn) / 2.0
        exact = np.cos(n * np.deg2rad(17.0 - 11.0)) * np.sin(half) / half
        assert weight @ np.cos(n * np.deg2rad(at - 11.0)) == pytest.approx(exact, abs=1e-9), n


@pytest.mark.parametrize(("name", "place"), [("WALOP-SOUTH", (0.28, -0.2)), ("WALOP-LAB", (18.0, 0.0))])
@pytest.mark.parametrize("turn", [20.0, 500.0])
def test_a_turning_plate_is_the_mean_of_plates_that_stand(name, place, turn):
    """400 angles at the middles of even steps: their mean is the integral to better than 1e-6 for smooth functions."""
    instrument = nominal_instrument(name)
    count = 400 if turn < 360 else 720
    steps = 30.0 + turn * ((np.arange(count) + 0.5) / count - 0.5)
    still = rows(instrument, steps, at=place).mean(axis=0)
    np.testing.assert_allclose(rows(instrument, [30.0], [turn], at=place)[0], still, atol=3e-5)


def test_a_turn_that_shrinks_to_nothing_is_a_plate_that_stands():
    instrument = nominal_instrument()
    still, slow, slower = (rows(instrument, [22.5], turns)[0] for turns in (None, [1e-3], [1e-7]))
    np.testing.assert_allclose(slower, still, atol=1e-12, rtol=0)
    assert np.abs(slow - still).max() < 1e-8


def test_states_with_and_without_a_turn_stand_beside_each_other():
    instrument = nominal_instrument()
    both = rows(instrument, [22.5, 22.5, np.nan], [0.0, 90.0, 0.0])
    np.testing.assert_allclose(both[0], rows(instrument, [22.5])[0], atol=1e-13)
    np.testing.assert_allclose(both[1], rows(instrument, [22.5], [90.0])[0], atol=1e-13)
    np.testing.assert_allclose(both[2], rows(instrument, [np.nan])[0], atol=1e-13)


def test_the_column_is_read_written_and_joined(handmade: Handmade, tmp_path):
    turn = np.array([0.0, 120.0] + [0.0] * 6)
    handmade["EXPOSURES"]["CHWP_TURN"] = ["D", "deg", turn]
    calset = read_calibration_set(handmade.write("turning.fits"))
    np.testing.assert_array_equal(calset.exposures.positions["CHWP"].turn, turn)
    walop.write_calibration_set(tmp_path / "again.fits", calset)
    again = read_calibration_set(tmp_path / "again.fits")
    np.testing.assert_array_equal(again.exposures.positions["CHWP"].turn, turn)
    assert again.exposures[1:3].positions["CHWP"].turn.tolist() == [120.0, 0.0]


@pytest.mark.parametrize(
    ("prefix", "turn", "message"),
    [("CLP", 30.0, r"CLP_TURN: is not 0 in rows 0, 1"), ("CHWP", np.nan, r"CHWP_TURN: is not finite")],
)
def test_what_cannot_be_stated_is_refused(handmade: Handmade, prefix, turn, message):
    handmade["EXPOSURES"][f"{prefix}_TURN"] = ["D", "deg", np.full(8, turn)]
    with pytest.raises(DataError, match=message):
        read_calibration_set(handmade.write())


def test_two_elements_do_not_turn_at_once(two_cameras: Handmade):
    for prefix in ("HWP", "RET_1"):
        two_cameras["EXPOSURES"][f"{prefix}_TURN"] = ["D", "deg", np.full(8, 10.0)]
    with pytest.raises(DataError, match="another element turns as well"):
        read_calibration_set(two_cameras.write())


def test_an_element_that_is_out_does_not_turn():
    assert Position(
        np.array([True, False]), np.array([1.0, np.nan]), np.array([-5.0, 5.0])
    ).turn.tolist() == [5.0, 0.0]


def test_a_set_with_a_turning_plate_is_fitted(tmp_path):
    """Simulated, fitted, written and read; taken for a plate that stands still it is explained by nothing."""
    settings = ((None, 0.0), (0.0, 0.0), (30.0, 70.0))
    stops = [Stop(a, plate=p, turn=t) for a in (0.0, 45.0, 90.0, 135.0) for p, t in settings]
    plan = dataclasses.replace(
        SMALL, plate=(None, 0.0, 30.0), stops=tuple(stops), moon_patches=0, standards=0
    )
    calset = simulate(plan, 3).calset
    fit = refit(calset)
    assert abs(fit.excess) < 4.0
    fit.with_verdict().save(tmp_path / "RUN")
    turn = walop.read(tmp_path / "RUN").calibration.exposures.positions["CHWP"].turn
    np.testing.assert_array_equal(turn, calset.exposures.positions["CHWP"].turn)
    assert turn.max() == 70.0
    still = dataclasses.replace(calset.exposures.positions["CHWP"], turn=np.zeros(len(turn)))
    taken = dataclasses.replace(calset, exposures=calset.exposures.placed(CHWP=still))
    assert refit(taken).excess > 100.0
