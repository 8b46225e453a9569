"""Round trips to the last bit, and files that are never half there."""

from __future__ import annotations

import dataclasses
import errno
import os

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import walop_jax.data.write
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.merge import merge_calibration_sets
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.write import write_calibration_set
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import DataError


def columns(calset):
    """All columns of the three small tables."""
    named = {f"EXPOSURES.{name}": values for name, values in calset.exposures.columns().items()}
    for part in ("points", "sources"):
        record = getattr(calset, part)
        named |= {f"{part}.{field.name}": getattr(record, field.name) for field in dataclasses.fields(record)}
    return named


def equal(one, other):
    tables = [columns(one), columns(other)]
    assert tables[0].keys() == tables[1].keys()
    for name, a in tables[0].items():
        np.testing.assert_array_equal(a, tables[1][name], strict=a.dtype.kind != "U")
    assert one.filters.keys() == other.filters.keys()
    for name, curve in one.filters.items():
        np.testing.assert_array_equal(curve.wavelength, other.filters[name].wavelength)
        np.testing.assert_array_equal(curve.throughput, other.filters[name].throughput)
    for name in ("exposure", "point", "source", "counts", "sigma", "flag", "used"):
        np.testing.assert_array_equal(getattr(one.intensities, name), getattr(other.intensities, name))
    assert (one.instrument, one.site, one.origin) == (other.instrument, other.site, other.origin)


def test_round_trip_is_exact(handmade):
    handmade.values("INTENSITIES", "FLAG")[4] = 3
    handmade.values("INTENSITIES", "N")[5, 2] = float("nan")
    calset = read_calibration_set(handmade.write())
    path = handmade.folder / "again.fits"
    write_calibration_set(path, calset)
    equal(calset, read_calibration_set(path))
    second = handmade.folder / "third.fits"
    write_calibration_set(second, calset)
    assert path.read_bytes() == second.read_bytes()


def test_errors_of_the_numbers_of_a_set_are_read_written_and_joined(handmade):
    """Of several files the largest of each."""
    handmade.header |= {"POS_ERR": 0.5, "SCAL_ERR": 2e-3, "MJD_ERR": 0}
    one = read_calibration_set(handmade.write("one.fits"))
    assert (one.stated_errors.position, one.stated_errors.scale, one.stated_errors.time) == (0.5, 2e-3, 0.0)
    again = handmade.folder / "again.fits"
    write_calibration_set(again, one)
    assert read_calibration_set(again).stated_errors == one.stated_errors
    assert {name: fits.getval(again, name) for name in ("POS_ERR", "SCAL_ERR", "MJD_ERR")} == {
        "POS_ERR": 0.5,
        "SCAL_ERR": 2e-3,
        "MJD_ERR": 0,
    }
    other = handmade.copy()
    other.header |= {"POS_ERR": 3.0, "SCAL_ERR": 1e-4, "MJD_ERR": 2.0}
    both = merge_calibration_sets(one, read_calibration_set(other.write("two.fits"))).stated_errors
    assert (both.position, both.scale, both.time) == (3.0, 2e-3, 2.0)
    assert both.rotator == 0.1  # the usual one


def test_the_level_of_the_sky_is_read_written_and_joined(handmade):
    rows = len(handmade.values("INTENSITIES", "N"))
    sky = np.arange(4.0 * rows).reshape(rows, 4)
    sky[3] = np.nan  # not known
    other = read_calibration_set(handmade.write("plain.fits"))
    assert other.intensities.sky is None
    handmade["INTENSITIES"]["SKY"] = ["4D", "electron", sky]
    calset = read_calibration_set(handmade.write())
    known = np.nan_to_num(sky)
    np.testing.assert_array_equal(calset.intensities.sky, known)
    assert not any("SKY" in remark for remark in calset.remarks)
    write_calibration_set(handmade.folder / "again.fits", calset)
    again = read_calibration_set(handmade.folder / "again.fits")
    np.testing.assert_array_equal(again.intensities.sky, known)
    joined = merge_calibration_sets(calset, dataclasses.replace(other, exposures=_later(other.exposures)))
    np.testing.assert_array_equal(joined.intensities.sky, np.concatenate([known, np.zeros_like(known)]))
    sky[5, 1] = -1.0
    handmade["INTENSITIES"]["SKY"] = ["4D", "electron", sky]
    handmade.refused("INTENSITIES", "SKY", "below 0", "row 5")
    handmade["INTENSITIES"]["SKY"] = ["2D", "electron", np.ones((rows, 2))]
    handmade.refused("INTENSITIES", "SKY", "2 value(s)", "every camera")


def _later(exposures):
    return dataclasses.replace(exposures, mjd=exposures.mjd + 1.0)


@settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    values=st.lists(st.floats(1e-300, 1e300), min_size=96, max_size=96),
    x=st.lists(st.floats(-0.35, 0.35), min_size=3, max_size=3),
)
def test_round_trip_of_any_number(handmade, values, x):
    calset = read_calibration_set(handmade.write())
    table = calset.intensities
    assert isinstance(table, TableIntensities)
    counts = np.array(values).reshape(24, 4)
    counts[0] += [0, 1, 2, 3]
    points = dataclasses.replace(calset.points, x=np.array(x))
    columns = {name: getattr(table, name) for name in ("exposure", "point", "source", "flag", "used")}
    changed = TableIntensities(8, points, counts=counts, sigma=counts + 1.0, **columns)
    calset = dataclasses.replace(calset, points=points, intensities=changed)
    path = handmade.folder / "again.fits"
    write_calibration_set(path, calset, overwrite=True)
    again = read_calibration_set(path)
    equal(calset, again)


def test_what_stands_in_the_file(handmade):
    calset = read_calibration_set(handmade.write())
    path = handmade.folder / "again.fits"
    write_calibration_set(path, calset)
    with fits.open(path, checksum=True) as hdus:  # a mismatch would be a warning, hence an error here
        assert [hdu.name for hdu in hdus[1:]] == ["EXPOSURES", "POINTS", "INTENSITIES", "SOURCES", "FILTERS"]
        assert all("CHECKSUM" in hdu.header and "DATASUM" in hdu.header for hdu in hdus)
        columns = hdus["INTENSITIES"].columns
        assert columns.names == ["EXPOSURE", "POINT", "SOURCE", "N", "N_ERR", "FLAG"]
        assert columns["N"].format == "4D"
        assert columns["N"].unit == "electron"
        assert hdus["EXPOSURES"].columns["TEMP"].unit == "Celsius"
        assert hdus["EXPOSURES"].columns["CLP_IN"].format == "L"
        assert hdus[0].header["CALVERS"] == 2
        assert hdus["INTENSITIES"].data["SOURCE"][21:].tolist() == [3, 3, 3]


def test_dense_blocks_make_a_table(handmade):
    calset = read_calibration_set(handmade.write())
    block = calset.intensities.block(0, 3)
    block.used[1, 2] = False
    block.counts[1, 2], block.sigma[1, 2], block.source[1, 2] = 0.0, 1.0, -1
    again = TableIntensities.dense(calset.points, block).block(0, 3)
    for name in ("counts", "sigma", "used", "source"):
        np.testing.assert_array_equal(getattr(block, name), getattr(again, name))


def test_a_file_is_not_overwritten_unasked(handmade):
    path = handmade.write()
    calset = read_calibration_set(path)
    before = path.read_bytes()
    with pytest.raises(DataError, match=r"exists already; choose another name"):
        write_calibration_set(path, calset)
    assert path.read_bytes() == before
    write_calibration_set(path, calset, overwrite=True)
    assert path.read_bytes() != before


def test_a_name_that_fits_cannot_hold(handmade):
    calset = read_calibration_set(handmade.write())
    sources = dataclasses.replace(calset.sources, name=np.array(["βCas", "HD 1"]))
    path = handmade.folder / "again.fits"
    with pytest.raises(DataError, match=r"again\.fits \[SOURCES\] NAME: 'βCas' is not plain ASCII"):
        write_calibration_set(path, dataclasses.replace(calset, sources=sources))
    assert not path.exists()


def test_a_full_disk_leaves_the_old_file(handmade, monkeypatch):
    path = handmade.write()
    calset, before = read_calibration_set(path), path.read_bytes()

    def full(hdus, temporary):
        temporary.write_bytes(b"SIMPLE  =")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(walop_jax.data.write, "sign_and_write", full)
    with pytest.raises(DataError, match=r"set\.fits: writing failed: .*No space left.*untouched"):
        write_calibration_set(path, calset, overwrite=True)
    assert path.read_bytes() == before
    assert os.listdir(handmade.folder) == ["set.fits"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_interrupt_leaves_nothing(tmp_path, error):
    def write():
        with atomic_path(tmp_path / "out.json") as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        write()
    assert os.listdir(tmp_path) == []


def test_atomic_path(tmp_path):
    target = tmp_path / "Übersicht 1.json"
    with atomic_path(target) as temporary:
        assert temporary.suffix == ".json"
        assert temporary.parent == tmp_path
        assert not target.exists()
        temporary.write_text("one")
    assert target.read_text() == "one"
    mask = os.umask(0)
    os.umask(mask)
    assert target.stat().st_mode & 0o777 == 0o666 & ~mask
    target.chmod(0o600)
    with atomic_path(target, overwrite=True) as temporary:
        temporary.write_text("two")
    assert target.read_text() == "two"
    assert target.stat().st_mode & 0o777 == 0o600
    assert os.listdir(tmp_path) == [target.name]


def test_atomic_path_follows_a_link(tmp_path):
    real, link = tmp_path / "real.txt", tmp_path / "link.txt"
    real.write_text("one")
    link.symlink_to(real)
    with atomic_path(link, overwrite=True) as temporary:
        temporary.write_text("two")
    assert link.is_symlink()
    assert real.read_text() == "two"


def test_atomic_path_refuses(tmp_path):
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for path, fragment in [
        (tmp_path, "is a folder"),
        (loop, "link"),
        (tmp_path / "a" / "b", "does not exist"),
    ]:
        with pytest.raises(DataError, match=fragment), atomic_path(path, overwrite=True):
            pass


def test_a_file_that_appears_meanwhile_is_kept(tmp_path):
    target = tmp_path / "out.txt"

    def write():
        with atomic_path(target) as temporary:
            temporary.write_text("mine")
            target.write_text("theirs")

    with pytest.raises(DataError, match="another program"):
        write()
    assert target.read_text() == "theirs"
