"""Files of tables: dialects of CSV, packed files, archives, FITS with several extensions, names that hide the form."""

from __future__ import annotations

import bz2
import gzip
import lzma
import zipfile

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from tables_in_memory import ROWS, SOUTH, remarks, table

from walop_jax.data.table_files import read_table_file
from walop_jax.data.user_tables import read_input_table
from walop_jax.io.errors import DataError
from walop_jax.science.catalogue import read_catalogue
from walop_jax.science.field_points import field_points

# ----------------------------------------------------------------------------------------------------------------- CSV

PLAIN = """X,Y,N0,N1,N2,N3,N0_ERR,N1_ERR,N2_ERR,N3_ERR,ID,TEFF
0.1,-0.05,1000.5,1e3,990.25,1010,32,31.5,31,32,a b,5500
-0.2,0.1,2000,2001,2002.5,2003,44,45,46,47,c,
"""


def commas_to(separator, text=PLAIN):
    return text.replace(",", separator)


@pytest.mark.parametrize(
    "content",
    [
        commas_to(";").encode(),
        commas_to("\t").encode(),
        commas_to("|").encode(),
        commas_to(";").replace(".", ",").encode(),
        commas_to("\t").replace(".", ",").encode(),
        b"# stars of field 12\n# r band\n" + PLAIN.encode(),
        b"sep=,\n" + PLAIN.encode(),
        b'"sep=;"\n' + commas_to(";").encode(),
        b"\n\n" + PLAIN.encode(),
        PLAIN.encode("utf-16"),
        PLAIN.encode("utf-8-sig"),
        PLAIN.replace("\n", "\r\n").encode("utf-16"),
        PLAIN.replace("\n", "\r").encode(),
        PLAIN.replace("\n-0.2", "\n# the second star\n-0.2").encode(),
        (commas_to(" ", PLAIN.replace("a b", "a").replace("47,c,\n", "47,c,nan\n"))).encode(),
        ("# " + PLAIN).encode(),
    ],
)
def test_dialects_of_csv_are_read(tmp_path, content):
    (tmp_path / "d.csv").write_bytes(content)
    found = read_catalogue(read_input_table(tmp_path / "d.csv"), SOUTH)
    np.testing.assert_array_equal(found.points.x, [0.1, -0.2])
    np.testing.assert_array_equal(found.points.settings.teff, [5500.0, np.nan])
    np.testing.assert_array_equal(found.counts, [[1000.5, 1000, 990.25, 1010], [2000, 2001, 2002.5, 2003]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"X;Y;N0\n0.1;0,2;1.234,5\n", "with points.*decimal point"),
        (b"X;Y;N0\n0,1;0,2;1,234,567\n", "several commas.*separators of thousands"),
        (b"X,Y\n0,1,0,2\n", "decimal commas need semicolons"),
        (b'X,Y\n"0,1","0,2"\n', "decimal point"),
        (b"X,Y\n0\xe9,1\n", "save it as UTF-8"),
        (b"X\0,\0Y\0\n\0", "NUL"),
        (b"PK\x03\x04 broken", "write it again"),
    ],
)
def test_what_is_not_clear_is_refused_with_advice(tmp_path, content, message):
    (tmp_path / "d.csv").write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        field_points(read_input_table(tmp_path / "d.csv"), SOUTH)
    assert "d.csv" in str(caught.value)


@pytest.mark.parametrize("separator", [",", ";", "\t", "|"])
def test_rows_that_are_too_short_are_refused_with_their_number(tmp_path, separator):
    (tmp_path / "d.csv").write_text(commas_to(separator) + commas_to(separator, "0.1,0.1,2000,2001\n"))
    with pytest.raises(DataError, match=r"d\.csv: has not as many cells as line 1 in row 2 "):
        read_input_table(tmp_path / "d.csv")


@pytest.mark.parametrize("ids", [("007", "7"), ("7.10", "7.1"), ("7", "7.0")])
def test_identifiers_of_a_text_are_texts(tmp_path, ids):
    one, other = PLAIN.replace(",a b,", f",{ids[0]},"), PLAIN.splitlines()[2].replace(",c,", f",{ids[1]},")
    (tmp_path / "d.csv").write_text("\n".join([*one.splitlines()[:2], other]) + "\n")
    found = read_input_table(tmp_path / "d.csv")
    assert len(set(read_catalogue(found, SOUTH).star.tolist())) == 2
    assert list(found.table["ID"]) == list(ids)


# -------------------------------------------------------------------------------------------- packed files, extensions


@pytest.mark.parametrize(
    ("suffix", "packed"), [(".gz", gzip.compress), (".bz2", bz2.compress), (".xz", lzma.compress)]
)
@pytest.mark.parametrize("name", ["t.fits", "t.ecsv", "t.vot"])
def test_packed_tables_are_read(tmp_path, name, suffix, packed):
    table().write(tmp_path / name, format="votable" if name.endswith("vot") else None)
    (tmp_path / f"{name}{suffix}").write_bytes(packed((tmp_path / name).read_bytes()))
    found = read_catalogue(read_input_table(tmp_path / f"{name}{suffix}"), SOUTH)
    np.testing.assert_array_equal(found.counts, table()["N"])


def test_an_archive_holds_one_table(tmp_path):
    table().write(tmp_path / "t.fits")
    path = tmp_path / "t.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(tmp_path / "t.fits", "inner/t.fits")
    np.testing.assert_array_equal(read_catalogue(read_input_table(path), SOUTH).counts, table()["N"])
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("other.csv", "X,Y\n0,0\n")
    with pytest.raises(DataError, match=r"holds 2 files \(inner/t.fits, other.csv\); unpack it"):
        read_input_table(path)
    with zipfile.ZipFile(tmp_path / "w.zip", "w") as archive:
        archive.writestr("[Content_Types].xml", "")
    with pytest.raises(DataError, match=r"spreadsheet.*save the sheet as CSV"):
        read_input_table(tmp_path / "w.zip")


def test_the_table_that_fits_is_taken_or_can_be_named(tmp_path):
    path = tmp_path / "two.fits"
    log = fits.BinTableHDU(Table({"A": [1, 2]}), name="LOG")
    stars = fits.BinTableHDU(table(), name="STARS")
    fits.HDUList([fits.PrimaryHDU(), log, stars]).writeto(path)
    found = read_catalogue(read_input_table(path), SOUTH)
    np.testing.assert_array_equal(found.counts, table()["N"])
    assert "the table STARS is read, not LOG" in remarks(found)
    fits.HDUList([fits.PrimaryHDU(), log, stars, fits.BinTableHDU(table()[:2], name="MORE")]).writeto(
        path, overwrite=True
    )
    with pytest.raises(
        DataError, match=r"several tables that could be meant \(STARS, MORE\); name one: two.fits\[STARS\]"
    ):
        read_input_table(path)
    assert read_input_table(f"{path}[more]").rows == 2
    assert read_input_table(f"{path}[2]").rows == ROWS
    with pytest.raises(DataError, match="has no table 'none'; there is LOG, STARS, MORE"):
        read_input_table(f"{path}[none]")
    fits.HDUList([fits.PrimaryHDU(), log, log.copy()]).writeto(path, overwrite=True)
    with pytest.raises(DataError, match="none of the tables LOG, LOG has X and Y"):
        read_input_table(path)


@pytest.mark.parametrize("name", ["t.fts", "t.cat", "t", "t.fits.gz", "t.fts.gz"])
def test_fits_is_known_by_its_content(tmp_path, name):
    table().write(tmp_path / "t.fits")
    content = (tmp_path / "t.fits").read_bytes()
    (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith(".gz") else content)
    assert len(read_catalogue(read_input_table(tmp_path / name), SOUTH)) == ROWS


@pytest.mark.parametrize("name", ["t.txt", "t.dat", "t.dat.gz"])
def test_texts_of_other_names_are_read(tmp_path, name):
    content = b"X Y TEFF\n0.1 0.2 5000\n0.2 0.1 6000\n"
    (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith(".gz") else content)
    points = field_points(read_input_table(tmp_path / name), SOUTH)
    assert points.settings.teff.tolist() == [5000.0, 6000.0]


@pytest.mark.parametrize("separator", [",", ";", "\t", "|", " "])
def test_columns_are_told_apart_where_none_is_asked_for(tmp_path, separator):
    """Catalogues of cameras and logs of a telescope: names are not known ahead of reading."""
    (tmp_path / "t.txt").write_text(commas_to(separator, "A,B,C\n1,2.5,x\n3,4.5,y\n"))
    _, found, _ = read_table_file(tmp_path / "t.txt", ())
    assert found.colnames == ["A", "B", "C"]
    assert found["B"].tolist() == [2.5, 4.5]
