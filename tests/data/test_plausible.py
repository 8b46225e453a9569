"""Numbers that cannot be what they say: each is named with its rows and the likeliest cause; sound ones are not."""

from __future__ import annotations

import re

import numpy as np
import pytest

import walop_jax as walop
from walop_jax.data import plausible
from walop_jax.data.calset import read_calibration_set

NOW = 61372.0


def said(doubts) -> str:
    return "\n".join(f"{column} {what}" for column, what in doubts)


@pytest.mark.parametrize(
    ("mjd", "message"),
    [
        ([61220.0, 40587.0], r"is 40587 in row 1 .*: a clock that was not set \(1970\)"),
        ([61220.0, 0.0], "a clock that was not set"),
        ([51544.5, 61220.0], r"not set \(2000\)"),
        ([2026.5, 61220.0], r"is 2026.5 in row 0 .*: is this a year"),
        ([61220.0, 47000.0], "is before 1990 in row 1"),
        ([61220.0, 72000.0], r"lies in the future in row 1 .*, at 72000 \(today is 61372\)"),
    ],
)
def test_dates(mjd, message):
    assert re.search(message, said(plausible.of_times(np.array(mjd), NOW)))


def test_sound_dates_are_not_remarked_on():
    assert not said(plausible.of_times(np.array([61220.0, np.nan, 50000.0]), NOW))
    assert not said(plausible.of_times(np.array([72000.0])))  # of a simulation
    assert not said(plausible.of_campaign(np.array([61220.0, 61500.0, np.nan])))
    assert "more than 400 days from the median, 61220.0, in row 2" in said(
        plausible.of_campaign(np.array([61220.0, 61220.0, 57000.0]))
    )
    assert 61000 < plausible.today() < 90000


def test_exposure_times_in_milliseconds():
    minutes = 61220.0 + np.arange(10) / 1440
    assert "is up to 30000 s" in said(plausible.of_exposure_times(np.full(10, 30000.0), minutes))
    # 8 s as 8000: exposures a minute apart cannot be that long.
    assert "are these milliseconds" in said(plausible.of_exposure_times(np.full(10, 8000.0), minutes))
    assert not said(plausible.of_exposure_times(np.full(10, 30.0), minutes))
    assert not said(plausible.of_exposure_times(np.full(10, 30.0), np.full(10, 61220.0)))
    assert "is 0 in row 3" in said(
        plausible.of_exposure_times(np.where(np.arange(10) == 3, 0.0, 5.0), minutes)
    )


def test_temperatures():
    assert "is 99.9 Celsius in row 1" in said(plausible.of_temperatures(np.array([10.0, 99.9, 11.0])))
    assert "a sensor that is off, or Fahrenheit" in said(
        plausible.of_temperatures(np.array([10.0, 11.0, 52.0]))
    )
    assert not said(plausible.of_temperatures(np.array([-12.0, 15.0, np.nan])))


def test_angles():
    assert "is beyond a turn in row 1" in said(plausible.of_angles("ROTATOR", np.array([10.0, 365.0])))
    turns = np.deg2rad(np.arange(0.0, 360.0, 22.5))
    assert "are these radians" in said(plausible.of_angles("CHWP_ANGLE", turns))
    assert not said(plausible.of_angles("CHWP_ANGLE", turns, radians=False))
    assert not said(plausible.of_angles("CHWP_ANGLE", np.array([0.0, 22.5, 45.0, 360.0, -360.0])))


def photons(rows=200, cameras=4, mean=2e4, seed=1):
    counts = np.random.default_rng(seed).poisson(mean, (rows, cameras)).astype(float)
    return counts, np.sqrt(counts + 25.0), np.ones(rows, bool)


def test_counts_of_photons_are_not_remarked_on():
    """Whole numbers of 10⁵ draws: the largest is there once or twice."""
    for seed in range(20):
        assert not said(plausible.of_counts(*photons(5000, seed=seed)))


@pytest.mark.parametrize(
    ("factor", "message"),
    [
        (11.0, "is 11 times the noise of photons"),
        (0.09, "is 0.09"),
        (300.0, "is above N in 100 % of all values"),
    ],
)
def test_errors_that_are_ten_times_off(factor, message):
    counts, sigma, used = photons()
    assert message in said(plausible.of_errors(counts, factor * sigma, used))
    assert not said(plausible.of_errors(counts, 5.0 * sigma, used))


def test_errors_that_are_variances():
    counts, sigma, used = photons()
    assert "are these variances" in said(plausible.of_errors(counts, 0.8 * sigma**2, used))


def test_the_ceiling_of_a_detector():
    counts, _, used = photons()
    counts[[3, 50, 70, 90], 2] = 65535.0
    assert "N is exactly 65535, the largest, in rows 3, 50, 70, 90 (counted from 0) of camera 2" in said(
        plausible.of_ceilings(counts, used)
    )
    assert "of O2" in said(plausible.of_ceilings(counts, used, ("O1", "E1", "O2", "E2")))
    flagged = used.copy()
    flagged[[3, 50, 70, 90]] = False
    assert not said(plausible.of_ceilings(counts, flagged))
    copies = np.repeat(
        counts[:1], 6, axis=0
    )  # one measurement six times: another fault, with a remark of its own
    assert not said(plausible.of_ceilings(copies, np.ones(6, bool)))


def test_counters_that_began_anew():
    counts, sigma, _ = photons(mean=64000.0)
    over = counts[:, 1] > 64100.0
    wrapped = np.where(np.arange(4) == 1, np.where(over[:, None], counts + 2000.0 - 65536.0, counts), counts)
    group = np.zeros(len(counts), int)
    text = said(plausible.of_wraps(wrapped, sigma, group))
    assert "of camera 1" in text
    assert "a counter of 16 bits that began anew? Add 65536" in text
    signed = counts.copy()
    signed[7, 3] -= 65536.0
    signed[7, 3] -= 4000.0
    assert "is -" in said(plausible.of_wraps(signed, sigma))
    # A camera that is dark in half of the exposures is none.
    dark = photons(100, mean=60000.0)[0]
    both = np.concatenate([dark, dark * 0.01])
    assert not said(plausible.of_wraps(both, np.sqrt(both), np.repeat([0, 1], 100)))


def test_a_set_tells_all_of_it(handmade):
    exposures = handmade.tables["EXPOSURES"]
    exposures["MJD"][2][1] = 40587.0
    exposures["TEMP"][2][2] = 99.9
    handmade.tables["INTENSITIES"]["N_ERR"][2] *= 30.0
    remarks = "\n".join(read_calibration_set(handmade.write()).remarks)
    assert "[EXPOSURES] MJD: is 40587 in row 1" in remarks
    assert "[EXPOSURES] TEMP: is 99.9 Celsius in row 2" in remarks
    assert "[INTENSITIES] N_ERR: is " in remarks


def test_simulated_sets_are_plausible():
    calset, _ = walop.simulate(seed=3)
    assert not calset.remarks
    assert not walop.inspect(calset).inspections[0].faults
