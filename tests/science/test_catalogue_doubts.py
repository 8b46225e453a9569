"""Values of a catalogue that cannot be what they say: doubts of all of it, remarks with the rows."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.data.user_tables import in_memory
from walop_jax.science.catalogue_doubts import errors_of_cameras, field_against_sky, units_of_counts

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


def test_errors_that_are_the_same_whatever_the_counts():
    counts = np.random.default_rng(1).uniform(1e4, 1e5, (60, 4))
    sigma = np.sqrt(counts)
    assert list(errors_of_cameras(counts, sigma, NAMES)) == []
    (sentence,) = errors_of_cameras(counts, np.where(np.arange(4) == 2, 100.0, sigma), NAMES)
    assert "N_ERR of O2 is 100 in all rows" in sentence
    (sentence,) = errors_of_cameras(counts, np.where(np.arange(4) == 1, 2.0 * counts, sigma), NAMES)
    assert "N_ERR of E1 is larger than N in all rows" in sentence
