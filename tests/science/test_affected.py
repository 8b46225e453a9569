"""Stars by an old and a new calibration: shift against the covariance that the change was drawn from; nights; again."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from small_run import small_fit
from star_tables import stars

import walop_jax as walop
from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.user_tables import in_memory
from walop_jax.fit.verdict import Structure
from walop_jax.science.affected import Affected, affected, shift
from walop_jax.science.apply import results_of
from walop_jax.science.catalogue import read_catalogue


@pytest.fixture(scope="module")
def old() -> Calibration:
    return Calibration.from_fit(small_fit())


@pytest.fixture(scope="module")
def table(old):
    """Two nights of 30 stars each."""
    made, _ = stars(AnalysisVectors(old), 60, np.random.default_rng(3), flux=4e7)
    made["MJD"] = np.repeat([61220.9, 61221.9], 30)
    return made


def changes(old: Calibration, new: Calibration, *tables, **options) -> Affected:
    """What `check NEW --against OLD TABLES` finds."""
    return walop.check(new, *tables, against=old, **options)["affected"]


def moved(calibration: Calibration, name: str, sigmas: float) -> Calibration:
    """One parameter elsewhere, by so many of its standard errors."""
    at = calibration.model.index(name)
    values = calibration.values.copy()
    values[at] += sigmas * np.sqrt(calibration.covariance[at, at])
    return dataclasses.replace(calibration, values=values)


@pytest.mark.parametrize("name", ["collimator.u", "half1.plate.mgf2", "throughput.n1.p10"])
def test_a_parameter_off_by_its_error_shifts_stars_by_the_error_that_it_makes(old, table, name):
    """δ = D σ is what the covariance P + δ δᵀ of the old result holds: z² = s/(1 + s), s = δᵀ P⁻¹ δ."""
    at = old.model.index(name)
    alone = np.zeros_like(old.covariance)
    alone[at, at] = old.covariance[at, at]
    verdict = dataclasses.replace(old.verdict, structure=Structure())
    one = dataclasses.replace(old, covariance=alone, verdict=verdict)
    known = table.copy()
    known["TEFF"] = 5000.0
    catalogue = read_catalogue(in_memory(known), old.model.template.patched())
    before, after = results_of(one, catalogue), results_of(moved(one, name, 1.0), catalogue)
    change = after.qu - before.qu
    s = np.einsum("si,sij,sj->s", change, np.linalg.inv(before.photon), change)
    assert s.max() > 1e-3
    np.testing.assert_allclose(shift(before, after), np.sqrt(s / (1 + s)), rtol=0.02, atol=1e-4)


def test_the_same_calibration_changes_nothing(old, table):
    found = changes(old, old, table)
    assert found.again == ()
    assert [night.largest for night in found.nights] == [0.0, 0.0]
    assert [night.stars for night in found.nights] == [30, 30]
    assert [night.night for night in found.nights] == [61220.0, 61221.0]


def test_a_star_of_two_nights_is_one_of_each(old, table):
    """Ten stars with rows of both nights, ten of the first alone, ten of the second without a time in one row."""
    rows = table[np.repeat(np.arange(30), 2)]
    rows["MJD"] = np.concatenate(
        [np.tile([61220.9, 61221.9], 10), np.full(20, 61220.9), np.tile([np.nan, 61221.9], 10)]
    )
    found = changes(old, old, rows)
    assert [(night.night, night.stars) for night in found.nights] == [(61220.0, 20), (61221.0, 20)]


def test_calibrations_and_catalogues_of_other_instruments_are_told(old, table, monkeypatch):
    other = table.copy()
    other.meta["INSTRUME"] = "WALOP-NORTH"
    (warning,) = changes(old, old, other).warnings
    assert "INSTRUME of the table is WALOP-NORTH, the calibration is of WALOP-SOUTH" in warning
    new = dataclasses.replace(old, path=Path("NEW"))
    names = property(lambda it: "WALOP-NORTH" if it.path == new.path else "WALOP-SOUTH")
    monkeypatch.setattr(Calibration, "instrument", names)
    with pytest.raises(
        ValueError, match="OLD_RUN is a calibration of WALOP-SOUTH, NEW_RUN one of WALOP-NORTH"
    ):
        changes(old, new, table)


def test_what_must_be_made_again_is_named(old, table):
    """collimator.u adds to u of light ahead of the plates: 5 sigma of it shift u of every star alike."""
    new = moved(old, "collimator.u", 5.0)
    moved_by = 5.0 * old["collimator.u"].sigma
    reduced = walop.apply(old, table)
    found = changes(old, new, table, reduced)
    first, second = found.nights[:2]
    assert found.again == ("catalogue 1", "catalogue 2")
    first = found.nights[0]
    quiet = dataclasses.replace(
        found, limit=0.5, nights=(first._replace(most=0.4, largest=0.61, again=False),)
    )
    assert "nothing: nowhere do more than 5 % of the stars of a night shift by more than 0.5" in str(quiet)
    near = dataclasses.replace(found, limit=0.5, nights=(first._replace(most=0.5004),))
    assert "0.5004" in str(near)  # not 0.50 beside a limit of 0.5
    assert [night.most for night in found.nights[:2]] == pytest.approx([n.most for n in found.nights[2:]])
    assert first.median > found.limit
    assert first.u == pytest.approx(-moved_by, rel=0.05)
    assert second.u == pytest.approx(first.u, rel=0.05)
    assert changes(old, new, table, limit=1e3).again == ()
    again = changes(old, new, walop.apply(new, table))
    assert again.warnings == ("catalogue 1: was made with the new calibration already",)
    answer = walop.check(new, table, reduced, against=old)
    assert not answer.go
    assert [one.what.split()[1] for one in answer.reasons] == ["1", "2"]  # catalogue 1, catalogue 2
    assert answer.reasons[0].off == pytest.approx(moved_by, rel=0.05)
    assert "walop-jax apply NEW catalogue 1" in answer.reasons[0].cure
    document = found.document()
    assert document["again"] == ["catalogue 1", "catalogue 2"]
    assert "again" in found.display().text()


def test_stars_that_are_hardly_measured_do_not_make_the_mean(old, table, monkeypatch):
    """Half of the stars shift by 0.001, the others, with errors a hundred times as large, by 0.1."""
    catalogue = read_catalogue(in_memory(table), old.model.template.patched())
    before = results_of(old, catalogue)
    poor = np.arange(len(before.qu)) % 2 == 1
    size = np.where(poor, 100.0, 1.0)[:, None]
    before = dataclasses.replace(before, photon=1e-4 * size[:, :, None] ** 2 * np.eye(2))
    after = dataclasses.replace(before, qu=before.qu + 1e-3 * size)
    results = iter((before, after))
    monkeypatch.setattr("walop_jax.science.affected.results_of", lambda *_: next(results))
    for night in affected(old, old, catalogue, "catalogue"):
        assert (night.q, night.u) == pytest.approx((1e-3, 1e-3), rel=0.02)


def test_results_that_are_lost_are_made_again(old, table):
    """The new calibration takes the middle of the field for beyond its own: no result there."""
    x0, x1, y0, y1 = old.field
    small = dataclasses.replace(old, field=(x0 / 9, x1 / 9, y0 / 9, y1 / 9))
    found = changes(old, small, table)
    assert found.nights[0].lost > 0
    assert found.again == ("catalogue 1",)
