"""Values of a catalogue that cannot be what they say: doubts of all of it, remarks with the rows."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.data.user_tables import in_memory
from walop_jax.science.catalogue_doubts import (
    ceilings,
    errors_of_cameras,
    field_against_sky,
    many_are_full,
    not_measured,
    stars_of_one_name,
    units_of_counts,
)

NAMES = ("O1", "E1", "O2", "E2")
ROTATOR = 35.0


def field(count=40, centre=(97.5, -44.0), scale=1.0):
    """X, Y, RA and DEC near a field centre, by hand: ten arcminutes are a plane to a few thousandths of a degree."""
    x, y = np.random.default_rng(0).uniform(-0.15, 0.15, (2, count))
    r = np.deg2rad(ROTATOR)
    east, north = x * np.sin(r) + y * np.cos(r), x * np.cos(r) - y * np.sin(r)
    dec = centre[1] + north
    return x * scale, y * scale, np.mod(centre[0] + east / np.cos(np.deg2rad(dec)), 360.0), dec


def said(x, y, ra, dec, rotator):
    table = in_memory({"X": x, "Y": y, "RA": ra, "DEC": dec})
    return list(field_against_sky(table, x, y, np.full(len(x), float(rotator))))


def test_x_and_y_agree_with_ra_and_dec():
    assert said(*field(), ROTATOR) == said(*field(centre=(0.0, 30.0)), ROTATOR - 360.0) == []
    x, y, *_ = field()
    assert list(field_against_sky(in_memory({"X": x, "Y": y}), x, y, np.full(40, ROTATOR))) == []
    # Stars of other fields, or too few of them, say nothing.
    _, _, ra, dec = field()
    assert said(x[::-1], y[::-1], ra, dec, ROTATOR) == said(*(v[:4] for v in (y, x, ra, dec)), ROTATOR) == []


@pytest.mark.parametrize(
    ("rotator", "words"),
    [
        (-35.0, "say 35°: its sign?"),
        (np.deg2rad(35.0), "say 35°: are these radians?"),
        (125.0, "ROTATOR is 125°, but"),
    ],
)
def test_a_rotator_that_contradicts_the_positions(rotator, words):
    (sentence,) = said(*field(), rotator)
    assert words in sentence


def test_mirrored_fields_and_other_scales():
    x, y, ra, dec = field()
    for columns, words in (
        ((y, x), "if X and Y were exchanged"),
        ((-x, y), "if X ran the other way"),
        ((x, -y), "if Y ran the other way"),
    ):
        (sentence,) = said(*columns, ra, dec, ROTATOR)
        assert words in sentence
    (sentence,) = said(*field(scale=1.1), ROTATOR)
    assert "1.1 times as far apart" in sentence


def test_counts_that_are_no_electrons():
    electrons = np.full((50, 4), 4e4)
    assert list(units_of_counts(electrons, np.sqrt(electrons))) == []
    (sentence,) = units_of_counts(electrons / 120.0, np.sqrt(electrons) / 120.0)
    assert "if they were multiplied by 120, as rates" in sentence
    (sentence,) = units_of_counts(electrons, electrons + 900.0)
    assert "are these variances?" in sentence
    (sentence,) = units_of_counts(np.sqrt(electrons), electrons)
    assert "were N and N_ERR exchanged?" in sentence
    for share in (1.0, 1.0857):  # of N, and in magnitudes
        (sentence,) = units_of_counts(electrons, share * electrons**-0.5)
        assert "N_ERR is relative to N, or in magnitudes" in sentence


def test_stars_that_share_a_number_lie_at_two_places_at_one_time():
    """Two of ten numbers; not where the telescope has moved between their rows, nor for one number of twenty."""
    star, there = np.tile(np.arange(10), 2), np.where(np.arange(20) < 12, 0.0, 0.1)
    star[10:12] = 8, 9
    x, y, night = np.where(star > 7, there, 0.0), np.zeros(20), np.full(20, 60000.0)
    (sentence,) = stars_of_one_name(star, x, y, night)
    assert "ID: 2 of 10 stars are at several places of the field at one MJD" in sentence
    assert list(stars_of_one_name(star, x, y, 60000.0 + np.arange(20))) == []
    assert list(stars_of_one_name(star, x, y, np.full(20, np.nan))) == []
    more = np.concatenate([np.where(star == 9, 0.0, x), np.zeros(10)])
    stars = np.concatenate([star, 10 + np.arange(10)])
    assert list(stars_of_one_name(stars, more, np.zeros(30), np.full(30, 60000.0))) == []


def test_a_number_in_the_place_of_what_was_not_measured_and_a_ceiling_of_all_cameras():
    counts = np.random.default_rng(2).uniform(2e4, 1e6, (60, 4))
    sigma = np.sqrt(counts)
    counts[3, 1] = sigma[3, 1] = -999.0
    counts[4, 2] = -30.0  # noise about a subtracted sky
    assert np.argwhere(not_measured(counts, sigma)).tolist() == [[3, 1]]
    good = np.isfinite(counts).all(axis=1)
    assert not many_are_full(counts)
    assert list(ceilings(counts, good, NAMES)) == []
    full = np.minimum(counts, 5e5)
    assert many_are_full(full)
    (found,) = ceilings(full, good, NAMES)
    assert "is exactly 500000, the largest, of several cameras in rows " in found.what


def test_errors_that_are_the_same_whatever_the_counts():
    counts = np.random.default_rng(1).uniform(1e4, 1e5, (60, 4))
    sigma = np.sqrt(counts)
    assert list(errors_of_cameras(counts, sigma, NAMES)) == []
    (sentence,) = errors_of_cameras(counts, np.where(np.arange(4) == 2, 100.0, sigma), NAMES)
    assert "N_ERR of O2 is 100 in all rows" in sentence
    (sentence,) = errors_of_cameras(counts, np.where(np.arange(4) == 1, 2.0 * counts, sigma), NAMES)
    assert "N_ERR of E1 is larger than N in all rows" in sentence
