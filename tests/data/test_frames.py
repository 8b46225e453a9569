"""Frames of few pixels, each a cell of its own, give what a table of the same numbers gives; faults of frames."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from frames_file import write_frames

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.grid import Grid
from walop_jax.data.records import Block
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.write import write_calibration_set
from walop_jax.io.errors import DataError

GRID = Grid(7, 5, (4.0, 3.0), (0.01, -0.02), ((0.05, 0.004), (-0.003, 0.06)))


@pytest.fixture
def scene(handmade):
    """A set of 35 points on a grid, 6 exposures without standards, as a dense table."""
    for name, entry in handmade["EXPOSURES"].items():
        entry[2] = entry[2][:7]
        assert name
    for entry in handmade["INTENSITIES"].values():
        entry[2] = entry[2][:21]
    small = read_calibration_set(handmade.write("small.fits"))
    rng = np.random.default_rng(1)
    points = GRID.points
    used = rng.random((35, 7)) > 0.1
    counts = np.where(used[..., None], rng.integers(1000, 100000, (35, 7, 4)) / 4, 0.0)
    sigma = np.where(used[..., None], np.sqrt(counts + 900.0), 1.0)
    block = Block(points.x, points.y, counts, sigma, used, np.full((35, 7), -1))
    return dataclasses.replace(small, points=points, intensities=TableIntensities.dense(points, block))


def same(one, other):
    for field in dataclasses.fields(Block):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


def test_frames_equal_the_table(scene, tmp_path):
    write_calibration_set(tmp_path / "table.fits", scene)
    write_frames(tmp_path / "frames.fits", scene, GRID, dtype="f8")
    table = read_calibration_set(tmp_path / "table.fits")
    frames = read_calibration_set(tmp_path / "frames.fits")
    assert isinstance(frames.intensities, TableIntensities)
    np.testing.assert_array_equal(frames.points.x, table.points.x)
    np.testing.assert_array_equal(frames.points.y, table.points.y)
    assert frames.intensities.rows == table.intensities.rows
    for start, stop in [(0, 35), (0, 1), (6, 8), (13, 29), (34, 35), (5, 5)]:
        same(frames.intensities.block(start, stop), table.intensities.block(start, stop))


def test_frames_in_another_unit_are_converted_and_all_have_one(scene, tmp_path):
    write_frames(tmp_path / "plain.fits", scene, GRID, dtype="f8")
    plain = read_calibration_set(tmp_path / "plain.fits").intensities.block(0, 35)
    with fits.open(tmp_path / "plain.fits", memmap=False) as hdus:
        for name in [f"{letter}{k}" for letter in "NE" for k in range(4)]:
            hdus[name].data = hdus[name].data / 1024.0
            hdus[name].header["BUNIT"] = "1024 electron"
        hdus.writeto(tmp_path / "kilo.fits", checksum=True)
        hdus["E2"].header.remove("BUNIT")
        hdus.writeto(tmp_path / "mixed.fits", checksum=True)
    same(read_calibration_set(tmp_path / "kilo.fits").intensities.block(0, 35), plain)
    with pytest.raises(DataError, match=r"\[BUNIT\] E2: has no unit, N0 is in 1024 electron"):
        read_calibration_set(tmp_path / "mixed.fits")


def test_single_precision_frames(scene, tmp_path):
    path = tmp_path / "frames.fits"
    write_frames(path, scene, GRID)
    with fits.open(path, checksum=True) as hdus:
        assert hdus["N3"].data.dtype == ">f4"
        assert hdus["E0"].data.shape == (7, 5, 7)
    block = read_calibration_set(path).intensities.block(0, 35)
    np.testing.assert_allclose(block.counts, scene.intensities.block(0, 35).counts, rtol=1e-7)


def test_coordinates_agree_with_astropy(scene, tmp_path):
    path = tmp_path / "frames.fits"
    write_frames(path, scene, GRID)
    points = read_calibration_set(path).points
    with fits.open(path) as hdus:
        wcs = WCS(hdus["N0"].header, naxis=2)
    column, row = np.meshgrid(np.arange(7), np.arange(5))
    x, y = wcs.wcs_pix2world(column.ravel(), row.ravel(), 0)
    np.testing.assert_allclose(points.x, x, atol=1e-15)
    np.testing.assert_allclose(points.y, y, atol=1e-15)


def test_other_forms_of_the_same_frames(scene, tmp_path):
    """CDELT and PC in arcmin, scaled unsigned integers, one FLAG plane for all exposures."""
    write_frames(tmp_path / "frames.fits", scene, GRID, dtype="f8")
    path = tmp_path / "other.fits"
    with fits.open(tmp_path / "frames.fits", memmap=False) as hdus:
        for hdu in hdus:
            if hdu.name[:1] not in "NE" or hdu.name == "EXPOSURES":
                continue
            for key in ("CD1_1", "CD1_2", "CD2_1", "CD2_2", "DATASUM"):
                del hdu.header[key]
            del hdu.header["CHECKSUM"]
            hdu.header.update(
                CUNIT1="arcmin", CUNIT2="arcmin", CDELT1=3.0, CDELT2=3.6, CRVAL1=0.6, CRVAL2=-1.2
            )
            hdu.header.update(PC1_2=0.24 / 3.0, PC2_1=-0.18 / 3.6)
            if hdu.name == "N2":
                hdu.data = np.round(hdu.data).astype(np.uint32)
        hdus["FLAG"].data = np.zeros((1, 5, 7), dtype=np.int16)
        hdus["FLAG"].data[0, 2, 3] = 4
        del hdus["FLAG"].header["DATASUM"], hdus["FLAG"].header["CHECKSUM"]
        n2 = hdus["N2"].data.copy()
        hdus.writeto(path)
    frames = read_calibration_set(path)
    keep = np.arange(35) != 2 * 7 + 3  # a pixel that is used nowhere is no point
    np.testing.assert_allclose(frames.points.x, GRID.points.x[keep], atol=1e-15)
    np.testing.assert_allclose(frames.points.y, GRID.points.y[keep], atol=1e-15)
    block = frames.intensities.block(0, 35)
    assert block.used.all()
    np.testing.assert_array_equal(block.counts[:, :, 2], n2.reshape(7, 35).T[keep])


def test_undefined_pixels_are_masked(scene, tmp_path):
    path = change(scene, tmp_path, lambda hdus: hdus["N1"].data.__setitem__((2, 1, 3), np.nan))
    block = read_calibration_set(path).intensities.block(0, 35)
    assert not block.used[1 * 7 + 3, 2]
    assert block.counts[10, 2].tolist() == [0.0] * 4


def change(scene, folder, what):
    write_frames(folder / "frames.fits", scene, GRID, dtype="f8", overwrite=True)
    with fits.open(folder / "frames.fits", memmap=False) as hdus:
        what(hdus)
        for hdu in hdus:
            for key in ("DATASUM", "CHECKSUM"):
                hdu.header.remove(key, ignore_missing=True)
        hdus.writeto(folder / "changed.fits", overwrite=True)
    return folder / "changed.fits"


def zero_error(hdus):
    hdus["FLAG"].data[:] = 0
    hdus["E2"].data[:, 1, 3] = 0.0


def constant(hdus):
    for k in range(4):
        hdus[f"N{k}"].data[:] = 7.0


@pytest.mark.parametrize(
    ("what", "fragment"),
    [
        (lambda hdus: hdus.pop(hdus.index_of("E3")), r"\[E3\]: the image extension is missing"),
        (lambda hdus: hdus["N1"].header.update(CTYPE1="RA---TAN"), r"\[N1\] CTYPE1: is 'RA---TAN'"),
        (lambda hdus: hdus["N1"].header.update(CRVAL1=0.1), r"N0 and N1 do not lie on the same grid"),
        (lambda hdus: hdus["N1"].header.update(BUNIT="adu"), r"\[N1\] BUNIT: the unit 'adu' .*gain"),
        (lambda hdus: hdus["N1"].header.update(CROTA2=3.0), r"\[N1\] CROTA2"),
        (lambda hdus: setattr(hdus["E1"], "data", np.ones((3, 5, 7))), r"\[E1\]: has shape \(3, 5, 7\)"),
        (lambda hdus: setattr(hdus["FLAG"], "data", np.ones((7, 5, 6), np.int16)), r"\[FLAG\]"),
        (
            lambda hdus: [h.header.update(CD1_1=50.0) for h in hdus if "CTYPE1" in h.header],
            "arcmin or pixels",
        ),
        (zero_error, r"\[E2\]: is zero or negative in plane 0, row 1, column 3"),
        (constant, r"all counts are equal \(7\)"),
        (lambda hdus: hdus["N2"].data.fill(np.nan), r"% of the pixels are not finite"),
    ],
)
def test_bad_frames(scene, tmp_path, what, fragment):
    path = change(scene, tmp_path, what)
    with pytest.raises(DataError, match=fragment):
        read_calibration_set(path)


def test_frames_of_a_standard_or_compressed(scene, tmp_path):
    kind = scene.exposures.kind.copy()
    kind[6] = "standard"
    standard = dataclasses.replace(scene, exposures=dataclasses.replace(scene.exposures, kind=kind))
    write_frames(tmp_path / "standard.fits", standard, GRID)
    with pytest.raises(DataError, match=r"\[EXPOSURES\] KIND: EXPOSURE 16 is a standard"):
        read_calibration_set(tmp_path / "standard.fits")
    write_frames(tmp_path / "frames.fits", scene, GRID)
    with fits.open(tmp_path / "frames.fits", memmap=False) as hdus:
        del hdus["N0"].header["DATASUM"], hdus["N0"].header["CHECKSUM"]
        hdus[hdus.index_of("N0")] = fits.CompImageHDU(hdus["N0"].data, hdus["N0"].header)
        hdus.writeto(tmp_path / "packed.fits")
    with pytest.raises(DataError, match="compressed"):
        read_calibration_set(tmp_path / "packed.fits")


def test_damaged_frames(scene, tmp_path):
    path = tmp_path / "frames.fits"
    write_frames(path, scene, GRID)
    good = path.read_bytes()
    content = bytearray(good)
    content[-2870] ^= 4
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"\[FLAG\]: the data do not agree with DATASUM"):
        read_calibration_set(path)
    path.write_bytes(good.replace(b"CRPIX1  =                  4.0", b"CRPIX1  =                  5.0", 1))
    with pytest.raises(DataError, match=r"\[N0\]: the bytes do not agree with CHECKSUM"):
        read_calibration_set(path)


def test_frames_of_two_nights_and_a_table(scene, handmade, tmp_path):
    write_frames(tmp_path / "one.fits", scene, GRID, dtype="f8")
    later = dataclasses.replace(
        scene, exposures=dataclasses.replace(scene.exposures, mjd=scene.exposures.mjd + 1)
    )
    write_frames(tmp_path / "two.fits", later, GRID, dtype="f8")
    whole = scene.intensities.block(0, 35)
    both = read_calibration_set(tmp_path / "one.fits", tmp_path / "two.fits")
    assert (len(both.points), len(both.exposures)) == (35, 14)
    np.testing.assert_array_equal(both.intensities.block(3, 20).counts[:, 7:], whole.counts[3:20])

    table = handmade.write("table.fits")
    mixed = read_calibration_set(tmp_path / "one.fits", table, tmp_path / "two.fits")
    assert (len(mixed.points), len(mixed.exposures)) == (38, 21)
    assert len(np.unique(mixed.points.point)) == 38
    block = mixed.intensities.block(30, 37)
    np.testing.assert_array_equal(block.x, mixed.points.x[30:37])
    np.testing.assert_array_equal(block.counts[:5, :7], whole.counts[30:])
    np.testing.assert_array_equal(block.counts[:5, 14:], whole.counts[30:])
    np.testing.assert_array_equal(
        block.counts[5:, 7:14], read_calibration_set(table).intensities.block(0, 2).counts
    )
    assert not np.any(block.used[:5, 7:14])
    assert not np.any(block.used[5:, :7])
    assert mixed.intensities.rows == 2 * int(whole.used.sum()) + 21
