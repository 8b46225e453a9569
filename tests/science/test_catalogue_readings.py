"""Mistakes of an observer in a catalogue: the one that was made is said; sound catalogues are quiet."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from star_tables import stars
from studies import sound_stars

from walop_jax.data.settings import Settings
from walop_jax.science import apply as application
from walop_jax.science.catalogue_readings import CatalogueReadings, readings_of
from walop_jax.science.other_readings import CatalogueReading, CatalogueRows, Fit, turned

ROTATOR = 35.0


@pytest.fixture(scope="module")
def sound(vectors) -> CatalogueRows:
    """A hundred and fifty stars with the noise of photons, on the sky."""
    table, _ = stars(vectors, 150, np.random.default_rng(3), teff=5500.0, rotator=(ROTATOR,))
    settings = dataclasses.replace(Settings.default(150), teff=np.full(150, 5500.0))
    place = np.array(table["X"]), np.array(table["Y"]), np.full(150, ROTATOR)
    return CatalogueRows(np.arange(150), *place, np.array(table["N"]), np.array(table["N_ERR"]), settings)


def first(vectors, rows, **options) -> str:
    found = readings_of(vectors, rows, **options)
    assert isinstance(found, CatalogueReadings)
    return found.words() if found.better else ""


def ordered(rows: CatalogueRows, order) -> CatalogueRows:
    return rows.changed(counts=rows.counts[:, order], sigma=rows.sigma[:, order])


def placed(rows: CatalogueRows, x, y) -> CatalogueRows:
    return rows.changed(x=x, y=y)


@pytest.mark.parametrize("left", [94, 2])
def test_where_a_tenth_would_still_disagree_another_instrument_is_asked_for(left):
    """Stars of a WALOP-NORTH by a calibration of WALOP-SOUTH: an order of cameras mends all but 94 of 300."""
    order = CatalogueReading(
        "N were in the order O2, O1", "exchange them", lambda rows: rows, Fit(0.0, left / 300, 0.02)
    )
    stands = Fit(1e4, 299 / 300, 0.03)
    said = CatalogueReadings(300, stands, (order,), instrument="WALOP-SOUTH").words()
    assert said.startswith(
        f"299 of 300 stars disagree with the calibration; they would agree (all but {left} of 300)"
    )
    assert ("not of WALOP-LAB or WALOP-NORTH" in said) == (left > 30)


def test_sound_catalogues_have_no_other_reading(vectors, sound):
    """Neither as they are nor in doubt; nor with a camera that has become fainter by two per cent, or dust."""
    assert first(vectors, sound) == first(vectors, sound, doubted=True) == ""
    spot = 1.0 - 0.1 * np.exp(-((sound.x - 0.1) ** 2 + (sound.y - 0.05) ** 2) / 2 / 0.03**2)
    for factor in (0.98, spot[:, None]):
        fainter = sound.changed(counts=sound.counts * np.where(np.arange(4) == 1, factor, 1.0))
        assert first(vectors, fainter) == ""


@pytest.mark.parametrize(
    "order", [(1, 0, 2, 3), (0, 1, 3, 2), (1, 0, 3, 2), (2, 3, 0, 1), (0, 2, 1, 3), (3, 0, 1, 2)]
)
def test_the_order_of_the_cameras(vectors, sound, order):
    """The first three leave the sums of both arms as they were: only the q and u of the stars tell."""
    names = vectors.instrument.cameras.names
    held = ", ".join(names[k] for k in order)
    assert f"if the columns of N and N_ERR were in the order {held} (" in first(
        vectors, ordered(sound, list(order))
    )


def test_a_field_that_is_mirrored_or_turned(vectors, sound):
    x, y = sound.x, sound.y
    assert "if X and Y were exchanged (" in first(vectors, placed(sound, y, x))
    assert "if X ran the other way (" in first(vectors, placed(sound, -x, y))
    # X and Y of a ROTATOR of −35°: turned by −70° from those of 35°.
    wrong = placed(sound, *turned(x, y, -2 * ROTATOR)).changed(rotator=-sound.rotator)
    text = first(vectors, wrong)
    assert "if ROTATOR had the wrong sign, 35° in place of −35° (" in text
    radians = np.deg2rad(ROTATOR)
    wrong = placed(sound, *turned(x, y, radians - ROTATOR)).changed(rotator=np.full(150, radians))
    assert "if ROTATOR were in radians, 35° in place of 0.6109° (" in first(vectors, wrong)
    wrong = placed(sound, *turned(x, y, 23.0))
    text = first(vectors, wrong)
    angle = float(text.partition("turned by ")[2].partition("°")[0].replace("−", "-"))
    assert angle == pytest.approx(-23.0, abs=0.5)


def test_turned_is_what_a_larger_rotator_does():
    """X and Y of a direction east and north of the centre, by the definition of ROTATOR (docs: conventions)."""
    east, north, r, more = 0.2, 0.1, np.deg2rad(20.0), np.deg2rad(50.0)
    x, y = east * np.sin(r) + north * np.cos(r), east * np.cos(r) - north * np.sin(r)
    later = east * np.sin(more) + north * np.cos(more), east * np.cos(more) - north * np.sin(more)
    np.testing.assert_allclose(turned(np.array([x]), np.array([y]), 30.0), np.transpose([later]), atol=1e-15)


def test_a_pointing_that_is_off(vectors, sound):
    """By 0.06° east and 0.02° south; with +X 35° from north through east."""
    r, east, north = np.deg2rad(ROTATOR), 0.06, -0.02
    dx, dy = east * np.sin(r) + north * np.cos(r), east * np.cos(r) - north * np.sin(r)
    text = first(vectors, placed(sound, sound.x - dx, sound.y - dy), doubted=True)
    assert "west and" in text
    assert "north of the one that was taken" in text
    numbers = text.partition("stars lay at X ")[2].replace("−", "-")
    found = float(numbers.partition("°")[0]), float(numbers.partition("Y ")[2].partition("°")[0])
    np.testing.assert_allclose(found, (dx, dy), atol=0.003)


@pytest.mark.parametrize(
    ("change", "words", "factor"),
    [
        (lambda east, north: (1.15 * east, 1.15 * north), "if X and Y were ", 1 / 1.15),
        (lambda east, north: (east / 0.7, north), "if distances along right ascension were ", 0.7),
    ],
    ids=["scale", "cosine"],
)
def test_a_field_that_is_stretched(vectors, sound, change, words, factor):
    """By the scale of the pixels, or where the cosine of a declination of 45.6° was left out."""
    s, c = np.sin(np.deg2rad(ROTATOR)), np.cos(np.deg2rad(ROTATOR))
    inner = sound.of(np.maximum(np.abs(sound.x), np.abs(sound.y)) < 0.18)
    east, north = change(inner.x * s + inner.y * c, inner.x * c - inner.y * s)
    text = first(vectors, placed(inner, east * s + north * c, east * c - north * s), doubted=True)
    found = float(text.partition(words)[2].partition(" times as large")[0])
    assert found == pytest.approx(factor, rel=0.02)


def test_a_field_in_radians(vectors, sound):
    small = placed(sound, np.deg2rad(sound.x), np.deg2rad(sound.y))
    assert "if X and Y were in radians (give degrees)" in first(vectors, small, doubted=True)


def test_a_camera_that_holds_other_stars(vectors, sound):
    """Every third star of O2 is the one four rows below: fluxes of the others are five times larger or smaller."""
    flux = 10.0 ** np.random.default_rng(5).uniform(-0.7, 0.7, (150, 1))
    many = sound.changed(counts=flux * sound.counts, sigma=np.sqrt(flux) * sound.sigma)
    assert first(vectors, many, doubted=True) == ""
    wrong, rows = many.counts.copy(), np.arange(0, 150, 3)
    wrong[rows, 2] = many.counts[(rows + 4) % 150, 2]
    found = readings_of(vectors, many.changed(counts=wrong))
    assert isinstance(found, CatalogueReadings)
    assert found.mended
    assert found.others is not None
    assert (found.others.camera, found.others.bright) == ("O2", 150)
    off = np.abs(np.log(flux[rows, 0] / flux[(rows + 4) % 150, 0]))
    assert np.sum(off > np.log(1.65)) <= found.others.rows <= np.sum(off > np.log(1.35))
    assert "N of O2 are those of other stars in " in found.words()
    # A camera with half of the light of all stars holds no other stars.
    half = many.counts * np.array([1.0, 0.5, 1.0, 1.0])
    assert "N of E1 were 2" in first(vectors, many.changed(counts=half))


def test_magnitudes_and_a_camera_in_another_unit(vectors, sound):
    magnitudes = sound.changed(
        counts=25.0 - 2.5 * np.log10(sound.counts), sigma=2.5 / np.log(10.0) * sound.sigma / sound.counts
    )
    assert "if N were magnitudes (" in first(vectors, magnitudes)
    gain = np.array([1.0, 1.0, 0.85, 1.0])
    weaker = sound.changed(counts=sound.counts * gain, sigma=sound.sigma * gain)
    text = first(vectors, weaker)
    assert "if N of O2 were 1.17" in text


def test_few_stars_say_nothing(vectors, sound):
    few = ordered(sound.of(sound.star < 7), [1, 0, 2, 3])
    assert readings_of(vectors, few) is None


@pytest.mark.parametrize(
    ("order", "said"), [([0, 1, 2, 3], ""), ([1, 0, 2, 3], "in the order E1, O1, O2, E2")]
)
def test_an_exchange_where_no_camera_is_to_spare(monkeypatch, order, said):
    """WALOP-NORTH: two fluxes, q and u of four cameras; the scatter of q and u tells."""
    monkeypatch.setattr(application, "AnalysisVectors", application.AnalysisVectors)  # the study replaces it
    made = sound_stars.catalogue("WALOP-NORTH", 300, 1)
    given = dataclasses.replace(made, counts=made.counts[:, order], sigma=made.sigma[:, order])
    text = sound_stars.said(sound_stars.reduced("WALOP-NORTH", given), given)
    assert said in text
    assert bool(text) == bool(said)
