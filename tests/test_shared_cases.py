"""Sets of an independent simulator with one thing wrong, beside the project: what each is to come to."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table
from south_sets import ABSENT, SHARED

import walop_jax as walop
from walop_jax.fit.verdict import Quality

CASES = SHARED / "cases"
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason=f"the cases are {ABSENT}")


@pytest.mark.long
def test_stars_on_a_spot_of_dust_are_flagged_and_their_errors_hold(caplog):
    """Camera O2 lost up to 1.5 % in a spot of 0.03° (SPOT) after the calibration: u of a star is 4 to 13 σ off."""
    truth = Table.read(CASES / "dust_stars.fits")
    stars = walop.apply(walop.refit(CASES / "dust.fits"), truth)
    assert "disagree with the calibration together" in caplog.text
    spot = np.asarray(truth["SPOT"]) > 1e-3
    pull = np.abs(np.asarray(stars["U"]) - truth["U_TRUE"]) / stars["U_ERR"]
    assert spot.sum() > 20
    assert (pull[spot] < 3.0).all()
    assert np.mean(pull < 2.0) > 0.93
    flagged = (np.asarray(stars["FLAG"]) & Quality.PLACE) != 0
    assert flagged[spot].all()
    assert flagged[np.asarray(truth["SPOT"]) < 1e-5].mean() < 0.02
    assert not stars.meta["HOLDS"]


@pytest.mark.long
def test_a_step_of_a_percent_is_seen_from_its_night_on():
    """O1 is 1 % brighter from the fourth of six nights on, which E2 fainter is to stars at one setting."""
    calset, _ = walop.simulate(seed=11)
    answer = walop.check(walop.refit(calset), CASES / "watch_step.csv")
    watch = answer["watch"]
    assert not answer.go
    assert not watch.holds
    (change,) = watch.changes
    assert change.time == pytest.approx(61235.8)
    sizes = {entry.name: entry for entry in change.alike}
    assert sizes["O1"].size == pytest.approx(0.01, abs=4.0 * sizes["O1"].error)


@pytest.mark.long
def test_a_clock_that_shows_local_time_is_named_before_sixteen_patches_of_the_moon():
    """MJD of the Moon exposures is UTC + 2 h."""
    found = walop.diagnose(CASES / "localtime.fits")
    assert not found.after.trusted
    (sentence,) = [line for line in str(found).splitlines() if "one number that the set states" in line]
    assert "MJD of sky exposures changed by −0.08" in sentence
