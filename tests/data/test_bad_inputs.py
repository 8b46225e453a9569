"""Every bad input is one row: what is done to a good set, and what the error must name."""

from __future__ import annotations

import gzip
import re

import numpy as np
import pytest
from astropy.io import fits

from walop_jax.data.calset import read_calibration_set
from walop_jax.io.errors import DataError

NAN = float("nan")


def put(table, column, row, value):
    def change(made):
        made.values(table, column)[row] = value

    return change


def column(table, name, *entry):
    """Replace a column, or remove it when no entry is given."""

    def change(made):
        if entry:
            made[table][name] = list(entry)
        else:
            del made[table][name]

    return change


def header(name, value):
    def change(made):
        if value is None:
            del made.header[name]
        else:
            made.header[name] = value

    return change


def remove(table):
    return lambda made: made.tables.pop(table)


def empty(table):
    def change(made):
        for entry in made[table].values():
            entry[2] = entry[2][:0]

    return change


def no_moon(name, value):
    def change(made):
        made.values(E, "KIND")[6] = "flux"
        made.header[name] = value

    return change


def repeat_pair(made):
    made.values("INTENSITIES", "POINT")[4] = 5


def all_flagged(made):
    made.values(I, "FLAG")[:] = 1


E, P, I, S, F = "EXPOSURES", "POINTS", "INTENSITIES", "SOURCES", "FILTERS"  # noqa: E741 - as in the tables
BAD = {
    # headers
    "misspelt INSTRUME": (header("INSTRUME", "WALOP-SUOTH"), "INSTRUME", "did you mean 'WALOP-SOUTH'"),
    "newer CALVERS": (header("CALVERS", 3), "[PRIMARY] CALVERS: is 3", "newer walop-jax"),
    "no CALVERS": (header("CALVERS", None), "CALVERS: is missing", "is this a calibration set?"),
    "site text": (header("SITELAT", "south"), "[PRIMARY] SITELAT: is 'south'", "degrees"),
    "Moon, no site": (header("SITELONG", None), "[PRIMARY] SITELONG: is nan", "site"),
    "latitude": (header("SITELAT", -132.0), "SITELAT: is -132, not in -90 … 90"),
    "latitude, no Moon": (no_moon("SITELAT", -132.0), "SITELAT: is -132, not in -90 … 90"),
    "error of positions": (header("POS_ERR", -1.0), "[PRIMARY] POS_ERR: is -1.0", "in arcsec, 0 or more"),
    "error of positions, text": (
        header("POS_ERR", "1 arcsec"),
        "[PRIMARY] POS_ERR: is '1 arcsec'",
        "a number",
    ),
    # tables as such
    "no table": (remove(P), "[POINTS]: the extension is missing"),
    "no exposures": (empty(E), "[EXPOSURES]: has no rows"),
    "unit type": (column(P, "X", "D", "m", np.zeros(3)), "[POINTS] X: the unit 'm' cannot be", "deg"),
    "unit adu": (column(I, "N", "4D", "adu", np.ones((24, 4))), "[INTENSITIES] N: the unit 'adu'", "gain"),
    "unit nonsense": (column(P, "X", "D", "furlongs", np.zeros(3)), "the unit 'furlongs' is not known"),
    "strings": (
        column(P, "X", "4A", None, np.array(["a", "b", "c"])),
        "[POINTS] X: holds strings",
        "'a' in row 0",
    ),
    "number names": (column(E, "KIND", "J", None, np.arange(8)), "[EXPOSURES] KIND: holds numbers"),
    "fraction id": (column(P, "POINT", "D", None, np.array([5, 6.5, 7])), "[POINTS] POINT", "row 1 (counted"),
    "not a bool": (
        column(E, "CLP_IN", "J", None, np.arange(8)),
        "CLP_IN: is neither true nor false in rows 2",
    ),
    "three cameras": (column(I, "N", "3D", "electron", np.ones((24, 3))), "[INTENSITIES] N: has 3 camera(s)"),
    "scalar N": (column(I, "N", "D", "electron", np.ones(24)), "[INTENSITIES] N: has 1 camera(s)"),
    "complex": (column(P, "X", "C", "deg", np.zeros(3)), "[POINTS] X: holds complex64"),
    # exposures
    "same exposure": (put(E, "EXPOSURE", 3, 10), "[EXPOSURES] EXPOSURE", "rows 0, 3 (counted from 0)"),
    "unknown kind": (put(E, "KIND", 6, "mond"), "[EXPOSURES] KIND: 'mond'", "row 6", "did you mean 'moon'"),
    "clp without": (put(E, "CLP_IN", 2, False), "[EXPOSURES] CLP_IN: is false in row 2"),
    "clp angle": (put(E, "CLP_ANGLE", 2, NAN), "[EXPOSURES] CLP_ANGLE: is not finite in row 2"),
    "chwp angle": (put(E, "CHWP_ANGLE", 1, NAN), "[EXPOSURES] CHWP_ANGLE: is not finite in row 1"),
    "moon RA": (put(E, "RA", 6, NAN), "[EXPOSURES] RA: is not finite in row 6"),
    "moon DEC": (put(E, "DEC", 6, NAN), "[EXPOSURES] DEC: is not finite in row 6"),
    "moon ROTATOR": (put(E, "ROTATOR", 6, NAN), "[EXPOSURES] ROTATOR: is not finite in row 6"),
    "moon MJD": (put(E, "MJD", 6, NAN), "[EXPOSURES] MJD: is not finite in row 6"),
    "moon JD": (put(E, "MJD", 6, 2461044.35), "[EXPOSURES] MJD", "row 6", "Julian Date"),
    "JD of a lamp": (put(E, "MJD", 2, 2461044.35), "[EXPOSURES] MJD", "row 2", "Julian Date"),
    "negative time": (put(E, "EXPTIME", 2, -30.0), "[EXPOSURES] EXPTIME: is not a time in row 2", "seconds"),
    "bell in a name": (put(S, "NAME", 1, "HD\a1"), "[SOURCES] NAME: holds a control character in row 1"),
    "line in a filter": (put(F, "FILTER", 0, "NAR\nROW"), "[FILTERS] FILTER: holds a control character"),
    "standard ROTATOR": (put(E, "ROTATOR", 7, NAN), "[EXPOSURES] ROTATOR: is not finite in row 7"),
    "TEFF zero": (put(E, "TEFF", 2, 0.0), "[EXPOSURES] TEFF", "row 2", "NaN means"),
    "HA degrees": (put(E, "HA", 2, -45.0), "[EXPOSURES] HA: exceeds ±24 in row 2", "degrees?"),
    "TEMP kelvin": (put(E, "TEMP", 2, 283.0), "[EXPOSURES] TEMP", "row 2", "kelvin?"),
    "DEC range": (put(E, "DEC", 6, 95.0), "[EXPOSURES] DEC: exceeds ±90 in row 6"),
    # points
    "pixels": (
        put(P, "Y", slice(1, 3), [2e3, -99.0]),
        "[POINTS] Y",
        "rows 1, 2 (counted",
        "arcmin or pixels?",
    ),
    "point NaN": (put(P, "Y", 1, NAN), "[POINTS] Y: is not finite in row 1"),
    "same point": (put(P, "POINT", 1, 5), "[POINTS] POINT", "rows 0, 1"),
    # intensities
    "no such exposure": (put(I, "EXPOSURE", 4, 99), "[INTENSITIES] EXPOSURE", "99", "row 4", "nearest is 17"),
    "no such point": (put(I, "POINT", 4, 1), "[INTENSITIES] POINT", "POINT 1 does", "row 4", "nearest is 5"),
    "pair twice": (repeat_pair, "[INTENSITIES] EXPOSURE, POINT: EXPOSURE 11, POINT 5", "rows 3, 4"),
    "all flagged": (all_flagged, "[INTENSITIES] FLAG: no row can be used"),
    "unknown star": (put(I, "SOURCE", slice(21, 24), 9), "[INTENSITIES] SOURCE", "9 is not one", "rows 21"),
    "no star": (put(I, "SOURCE", 22, -1), "[INTENSITIES] SOURCE", "row 22", "SOURCES has 3, 4"),
    "no SOURCES": (remove(S), "[INTENSITIES] SOURCE", "SOURCES has none"),
    # sources and filters
    "per cent": (put(S, "Q", 1, 3.4), "[SOURCES] Q: exceeds 1 in row 1", "per cent?"),
    "prior zero": (put(S, "U_ERR", 1, 0.0), "[SOURCES] U_ERR: is not a positive number in row 1"),
    "same source": (put(S, "SOURCE", 1, 3), "[SOURCES] SOURCE", "rows 0, 1"),
    "unsorted": (put(F, "WAVELENGTH", (0, 1), 0.595), "[FILTERS] WAVELENGTH: 'NARROW' is not sorted"),
    "negative T": (put(F, "THROUGHPUT", (0, 1), -0.1), "[FILTERS] THROUGHPUT: 'NARROW' is negative"),
    "ragged": (put(F, "THROUGHPUT", (0, 1), NAN), "[FILTERS] THROUGHPUT: 'NARROW' has no value"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_set_is_refused_by_name(handmade, name):
    change, *fragments = BAD[name]
    change(handmade)
    handmade.refused(*fragments)


def test_duplicated_column(handmade):
    path = handmade.write(checksum=False)
    content = path.read_bytes()
    assert content.count(b"'Y       '") == 1
    path.write_bytes(content.replace(b"'Y       '", b"'x       '"))
    with pytest.raises(DataError, match=r"\[POINTS\] X: the column is there twice"):
        read_calibration_set(path)


def twice(hdus):
    hdus.append(hdus[2].copy())


def image(hdus):
    hdus[2] = fits.ImageHDU(np.zeros((2, 2)), name="POINTS")


def undefined_integer(hdus):
    numbers = fits.Column("POINT", "J", null=6, array=[5, 6, 7])
    hdus[2] = fits.BinTableHDU.from_columns([numbers, *list(hdus[2].columns)[1:]], name="POINTS")


def variable_length(hdus):
    ragged = np.array([[0.57, 0.58]], dtype=object)
    curves = [fits.Column(name, "PD()", array=ragged) for name in ("WAVELENGTH", "THROUGHPUT")]
    names = fits.Column("FILTER", "12A", array=["NARROW"])
    hdus[5] = fits.BinTableHDU.from_columns([names, *curves], name="FILTERS")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (twice, "[POINTS]: is there twice"),
        (image, "[POINTS]: is not a binary table"),
        (undefined_integer, "[POINTS] POINT: undefined (TNULL) in row 1"),
        (variable_length, "[FILTERS] WAVELENGTH: is an array of variable length"),
    ],
)
def test_extensions_that_cannot_be(handmade, change, message):
    hdus = handmade.hdus()
    change(hdus)
    path = handmade.folder / "set.fits"
    fits.HDUList(hdus).writeto(path)
    with pytest.raises(DataError, match=re.escape(message)):
        read_calibration_set(path)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.6, 0.99])
@pytest.mark.parametrize("checksum", [True, False])
def test_truncated_file(handmade, share, checksum):
    path = handmade.write(checksum=checksum)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError, match=r"set\.fits"):
        read_calibration_set(path)


def test_bytes_behind_the_last_extension(handmade):
    path = handmade.write()
    path.write_bytes(path.read_bytes() + b"XTENSION of nothing")
    with pytest.raises(DataError, match=r"set\.fits"):
        read_calibration_set(path)


def test_damaged_data(handmade):
    path = handmade.write()
    content = bytearray(path.read_bytes())
    with fits.open(path) as hdus:
        content[hdus["INTENSITIES"].fileinfo()["datLoc"] + 13] ^= 1
    path.write_bytes(content)
    with pytest.raises(
        DataError,
        match=r"\[INTENSITIES\]: the data do not agree with DATASUM; .*again, or with checksum=True if",
    ):
        read_calibration_set(path)


def test_edited_header(handmade):
    path = handmade.write()
    path.write_bytes(path.read_bytes().replace(b"WALOP-SOUTH", b"WALOP-NORTH"))
    with pytest.raises(DataError, match="do not agree with CHECKSUM"):
        read_calibration_set(path)


@pytest.mark.parametrize(
    ("content", "fragment"),
    [(b"not FITS at all", "cannot be read as FITS"), (b"\x80\x04K\x01.", "cannot be read as FITS")],
)
def test_something_else(tmp_path, content, fragment):
    path = tmp_path / "Beobachtung übermorgen.fits"
    path.write_bytes(content)
    with pytest.raises(DataError, match=fragment) as caught:
        read_calibration_set(path)
    assert path.name in str(caught.value)


def test_no_file_no_path_no_link(tmp_path):
    with pytest.raises(DataError, match="there is no such file"):
        read_calibration_set(tmp_path / "absent.fits")
    with pytest.raises(DataError, match="is a folder; a calibration set is a FITS file"):
        read_calibration_set(tmp_path)
    with pytest.raises(DataError, match="no file was given"):
        read_calibration_set()
    loop = tmp_path / "loop.fits"
    loop.symlink_to(loop)
    with pytest.raises(DataError, match="cannot be read"):
        read_calibration_set(loop)


def test_gzip(handmade):
    path = handmade.write()
    packed = path.with_suffix(".fits.gz")
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert len(read_calibration_set(packed).points) == 3
    packed.write_bytes(packed.read_bytes()[:2000])
    with pytest.raises(DataError, match="cannot be read as FITS"):
        read_calibration_set(packed)


def test_same_file_twice(handmade):
    path = handmade.write()
    with pytest.raises(DataError, match="has the same bytes as"):
        read_calibration_set(path, path)
