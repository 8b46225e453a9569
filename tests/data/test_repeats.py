"""Data that are there twice under other times, identifiers or coordinates; and data that only look like it."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from frames_file import write_frames
from south_sets import CUTS, SouthSet

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.grid import Grid
from walop_jax.data.records import CalibrationSet, Exposures, Points
from walop_jax.data.repeats import repeated_counts
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.write import write_calibration_set

COLUMNS = ("exposure", "point", "source", "counts", "sigma", "flag", "used")


@functools.cache
def plain() -> CalibrationSet:
    """31 exposures of 25 points with noise, by another program."""
    return read_calibration_set(SouthSet.of(CUTS, "a").path)


def again(
    calset: CalibrationSet, chosen: slice = slice(None), points: Points | None = None, **changes
) -> CalibrationSet:
    """A set with some exposures twice, the second time under new numbers, with columns, counts or points changed."""
    e, table = calset.exposures, calset.intensities
    assert isinstance(table, TableIntensities)
    rows = np.arange(len(e))[chosen]
    copied = np.isin(table.exposure, rows)
    columns = {name: np.concatenate([value, value[rows]]) for name, value in e.columns().items()}
    columns["EXPOSURE"][len(e) :] = e.exposure.max() + 1 + np.arange(len(rows))
    for name in changes.keys() & {"MJD", "TEMP"}:
        columns[name][len(e) :] = changes[name](e.columns()[name][rows])
    more = {name: getattr(table, name)[copied] for name in COLUMNS}
    more["exposure"] = len(e) + np.searchsorted(rows, more["exposure"])
    more["counts"] = changes.get("counts", lambda n, s: n)(more["counts"], more["sigma"])
    whole = calset.points
    if points is not None:
        more["point"] = more["point"] + len(whole)
        whole = Points(
            *(np.concatenate([getattr(whole, n), getattr(points, n)]) for n in ("point", "x", "y"))
        )
    joined = {name: np.concatenate([getattr(table, name), more[name]]) for name in COLUMNS}
    total = TableIntensities(len(e) + len(rows), whole, **joined)
    return dataclasses.replace(
        calset, exposures=Exposures.from_columns(columns), points=whole, intensities=total, inputs=()
    )


def new_points(calset: CalibrationSet, change=np.asarray) -> Points:
    p = calset.points
    return Points(p.point + 1000, change(p.x).astype(float), change(p.y).astype(float))


def second_later(mjd):
    return mjd + 1.0 / 86400.0


COPIES = {
    "a second later": {"MJD": second_later},
    "without time": {"MJD": lambda mjd: np.full(len(mjd), np.nan)},
    "counts in single precision": {
        "MJD": second_later,
        "counts": lambda n, s: n.astype(np.float32).astype(float),
    },
    "another temperature": {"MJD": second_later, "TEMP": lambda temp: temp + 0.5},
}


def remarks_of(calset: CalibrationSet) -> list[str]:
    return list(repeated_counts(calset.intensities, calset.exposures, calset.points, "set"))


@pytest.mark.parametrize("name", COPIES)
@pytest.mark.parametrize("chosen", [slice(4, 5), slice(15)], ids=["one", "many"])
def test_copies_of_exposures_are_remarked_on_by_number(tmp_path, name, chosen):
    path = tmp_path / "twice.fits"
    calset = again(plain(), chosen, **COPIES[name])
    write_calibration_set(path, calset)
    (remark,) = [text for text in read_calibration_set(path).remarks if "copies" in text]
    listed = ", ".join(map(str, calset.exposures.exposure[31:36]))
    assert remark.startswith(f"{path} [INTENSITIES] N: exposures {listed}")
    assert "have the counts of others at the same places; remove them" in remark


def test_a_copy_with_a_row_that_is_not_finite_is_a_copy(tmp_path):
    """Its other rows would count twice, as measurements of their own at the same time."""
    table, path = plain().intensities, tmp_path / "twice.fits"
    assert isinstance(table, TableIntensities)
    spoilt = table.counts.copy()
    spoilt[np.flatnonzero(table.exposure == 4)[2], 1] = np.nan
    calset = dataclasses.replace(plain(), intensities=dataclasses.replace(table, counts=spoilt))
    write_calibration_set(path, again(calset, slice(4, 5)))
    read = read_calibration_set(path)
    assert any("are the same to the last bit, the second is not used" in text for text in read.remarks)
    assert read.intensities.rows == table.rows - 1


@pytest.mark.parametrize("change", [np.asarray, np.float32], ids=["same", "float32"])
def test_points_under_new_numbers_are_remarked_on(change):
    table = plain().intensities
    assert isinstance(table, TableIntensities)
    points = new_points(plain(), change)
    whole = Points(
        *(np.concatenate([getattr(plain().points, n), getattr(points, n)]) for n in ("point", "x", "y"))
    )
    columns = {name: np.concatenate([getattr(table, name)] * 2) for name in COLUMNS}
    columns["point"][len(table.point) :] += len(points)
    calset = dataclasses.replace(plain(), points=whole, intensities=TableIntensities(31, whole, **columns))
    (remark,) = remarks_of(calset)
    assert f"points {', '.join(map(str, points.point[:5]))}" in remark


@pytest.mark.parametrize("change", [np.asarray, np.float32], ids=["same", "float32"])
def test_the_same_data_in_a_second_file(tmp_path, change):
    later = dataclasses.replace(plain().exposures, mjd=second_later(plain().exposures.mjd))
    p = plain().points
    moved = dataclasses.replace(p, x=change(p.x).astype(float), y=change(p.y).astype(float))
    table = plain().intensities
    columns = {name: getattr(table, name) for name in COLUMNS}
    second = dataclasses.replace(
        plain(), exposures=later, points=moved, intensities=TableIntensities(31, moved, **columns)
    )
    for name, calset in (("a.fits", plain()), ("b.fits", second)):
        write_calibration_set(tmp_path / name, calset)
    both = read_calibration_set(tmp_path / "a.fits", tmp_path / "b.fits")
    (remark,) = [text for text in both.remarks if "copies" in text]
    assert "a.fits" in remark
    assert "b.fits" in remark
    assert f"exposures {', '.join(map(str, both.exposures.exposure[31:36]))}" in remark


def noise(seed):
    draw = np.random.default_rng(seed)
    return lambda n, s: n + s * draw.standard_normal(n.shape)


def test_repeated_exposures_with_noise_of_their_own_pass():
    assert remarks_of(again(plain(), MJD=second_later, counts=noise(1))) == []


@pytest.mark.parametrize("factor", [1e-3, 1e6])
def test_very_bright_and_very_faint_sets_pass(factor):
    """Repeated exposures whose noise is drawn anew; errors go with the root of the counts, counts are whole."""
    table = plain().intensities
    assert isinstance(table, TableIntensities)
    mean = np.round(table.counts * factor)
    draw = np.random.default_rng(2)
    changed = {name: getattr(table, name) for name in COLUMNS} | {"sigma": np.sqrt(mean + 1.0)}
    changed["counts"] = draw.poisson(mean).astype(float)
    calset = dataclasses.replace(plain(), intensities=TableIntensities(31, plain().points, **changed))
    assert (
        remarks_of(again(calset, MJD=second_later, counts=lambda n, s: draw.poisson(n).astype(float))) == []
    )


def ideal(angles: np.ndarray, electrons: float = 1e6, points: int = 25) -> CalibrationSet:
    """Expected counts without noise of an analyser with a diattenuating plate ahead, smooth over the field."""
    two = 2 * np.deg2rad(angles)[:, None]
    slope = np.linspace(-0.05, 0.05, points)[None, :]
    light = 1 + slope * np.cos(two)
    c, s = (np.cos(two) + slope) / light, np.sin(two + slope)
    share = 1.02 + np.stack([c, -c, s, -s], axis=-1)
    counts = (electrons * light[..., None] * share).reshape(-1, 4)
    point, exposure = np.tile(np.arange(points), len(angles)), np.repeat(np.arange(len(angles)), points)
    zeros = np.zeros(len(point), int)
    where = Points(np.arange(points), np.linspace(-0.3, 0.3, points), np.zeros(points))
    row = plain().exposures[np.zeros(len(angles), int)].columns()
    row |= {
        "EXPOSURE": np.arange(len(angles)),
        "CLP_ANGLE": angles,
        "MJD": 61043.0 + 0.01 * np.arange(len(angles)),
    }
    row |= {"KIND": np.full(len(angles), "clp"), "CLP_IN": np.ones(len(angles), bool)}
    table = TableIntensities(
        len(angles), where, exposure=exposure, point=point, source=zeros - 1, counts=counts,
        sigma=np.sqrt(counts + 25.0), flag=zeros, used=zeros == 0,
    )  # fmt: skip
    return dataclasses.replace(
        plain(), exposures=Exposures.from_columns(row), points=where, intensities=table
    )


@pytest.mark.parametrize("axis", ["x", "y"])
def test_equal_counts_at_other_places_are_no_copies(axis):
    """Expected counts of a uniform field, at points along one axis."""
    calset = ideal(np.linspace(0.0, 168.0, 8), points=5)
    table = calset.intensities
    assert isinstance(table, TableIntensities)
    counts = table.counts.reshape(8, 5, 4)[:, [0] * 5].reshape(-1, 4)
    along = {"x": np.zeros(5), "y": np.zeros(5)} | {axis: np.linspace(-0.3, 0.3, 5)}
    where = Points(np.arange(5), **along)
    columns = {name: getattr(table, name) for name in COLUMNS} | {"counts": counts}
    uniform = dataclasses.replace(calset, points=where, intensities=TableIntensities(8, where, **columns))
    assert remarks_of(uniform) == []
    assert len(remarks_of(again(uniform, MJD=second_later))) == 1


def test_expected_counts_without_noise_are_read_with_a_remark(tmp_path):
    """A full turn: every angle returns after half of it, with the same counts in single precision."""
    calset = ideal(np.arange(0.0, 360.0, 11.25))
    write_calibration_set(tmp_path / "ideal.fits", calset)
    found = read_calibration_set(tmp_path / "ideal.fits")
    assert found.intensities.rows == 32 * 25
    assert sum("copies" in remark for remark in found.remarks) == 1


def test_frames_in_two_files(tmp_path):
    """The same frames a second later, in another file; frames with noise of their own are no copies."""
    grid = Grid(7, 5, (4.0, 3.0), (0.0, 0.0), ((0.05, 0.0), (0.0, 0.05)))
    calset = ideal(np.linspace(0.0, 170.0, 16), points=35)
    table = calset.intensities
    assert isinstance(table, TableIntensities)
    for name, seed, shift in (("one", 1, 0.0), ("same", 1, 1 / 86400), ("other", 2, 2 / 86400)):
        columns = {key: getattr(table, key) for key in COLUMNS}
        columns["counts"] = noise(seed)(table.counts, table.sigma)
        exposures = dataclasses.replace(calset.exposures, mjd=calset.exposures.mjd + shift)
        whole = TableIntensities(16, grid.points, **columns)
        made = dataclasses.replace(calset, exposures=exposures, points=grid.points, intensities=whole)
        write_frames(tmp_path / f"{name}.fits", made, grid)
    read = functools.partial(read_calibration_set, tmp_path / "one.fits")
    assert not any("copies" in remark for remark in read(tmp_path / "other.fits").remarks)
    assert any("exposures 16, 17, 18" in remark for remark in read(tmp_path / "same.fits").remarks)


def test_no_false_alarm_among_many_repetitions():
    """200 exposures of one setting: 20 000 pairs."""
    calset = ideal(np.repeat(np.linspace(0, 170, 20), 10), points=9)
    table = calset.intensities
    assert isinstance(table, TableIntensities)
    columns = {name: getattr(table, name) for name in COLUMNS}
    columns["counts"] = np.random.default_rng(0).poisson(table.counts).astype(float)
    total = TableIntensities(200, calset.points, **columns)
    assert remarks_of(dataclasses.replace(calset, intensities=total)) == []


@pytest.mark.parametrize(("copied", "told"), [(12, 0), (13, 1)])
def test_an_exposure_is_a_copy_if_most_of_its_rows_are(copied, told):
    def partly(n, s):
        fresh = noise(3)(n, s)
        fresh[:copied] = n[:copied]
        return fresh

    calset = again(plain(), slice(4, 5), MJD=second_later, counts=partly)
    assert int((calset.intensities.exposure == 31).sum()) == 25
    assert len(remarks_of(calset)) == told
