"""Exposures from the words of an observatory: FITS headers, a log, a table; what is missing or odd is told."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

import walop_jax as walop
from walop_jax.data.header_words import exposures_table, of_header, read_words, words_of
from walop_jax.data.records import Site
from walop_jax.io.errors import DataError

WORDS = """
extension = 0
filters = { "SDSS-r" = 1, "NB-660" = 3 }
[KIND]
word = ["OBSTYPE", "IMAGETYP"]
values = { POLFLAT = "clp", MOON = "moon" }
[MJD]
word = "DATE-OBS"
expression = "x + EXPTIME / 2 / 86400"
[EXPTIME]
word = "EXPMIN"
unit = "min"
[FILTER]
word = "FILTNUM"
values = { 1 = "SDSS-r", 3 = "NB-660" }
[CLP_IN]
word = "POLARIS"
values = { IN = true, OUT = false }
[CLP_ANGLE]
word = "POLANG"
unit = "rad"
optional = true
[TEMP]
word = "TINSTR"
unit = "K"
[RA]
word = "TELRA"
unit = "hourangle"
[DEC]
word = "TELDEC"
unit = "deg"
[ROTATOR]
word = "ROT"
expression = "(90 - x) % 360"
[CHWP_IN]
value = false
"""
HEADERS = [
    {"OBSTYPE": "POLFLAT", "DATE-OBS": "2026-11-26T18:00:00", "EXPMIN": 0.5, "FILTNUM": 1, "POLARIS": "IN",
     "POLANG": np.pi / 4, "TINSTR": 283.15, "TELRA": "06:45:13.2", "TELDEC": "-02:30:00", "ROT": 100.0},
    {"IMAGETYP": "MOON", "DATE-OBS": "2026-11-26T19:30:00", "EXPMIN": 2.0, "FILTNUM": 3, "POLARIS": "out",
     "TINSTR": 281.15, "TELRA": "23:59:00", "TELDEC": "+00:00:36", "ROT": 80.0},
]  # fmt: skip


@pytest.fixture
def words(tmp_path: Path) -> Path:
    (tmp_path / "words.toml").write_text(WORDS)
    return tmp_path / "words.toml"


def headers(folder: Path, **changes) -> list[Path]:
    """The headers as FITS files, with words of the first changed (None: taken out)."""
    paths = []
    for number, words in enumerate(HEADERS):
        path = folder / f"{number}.fits"
        now = {k: v for k, v in (words | (changes if number == 0 else {})).items() if v is not None}
        fits.PrimaryHDU(header=fits.Header(now)).writeto(path, overwrite=True)
        paths.append(path)
    return paths


def check_columns(columns) -> None:
    """Worked out by hand from the headers."""
    begun = 61370.75  # 2026-11-26T18:00
    np.testing.assert_allclose(columns["MJD"], [begun + 15 / 86400, begun + 1.5 / 24 + 60 / 86400], atol=1e-9)
    np.testing.assert_allclose(columns["EXPTIME"], [30.0, 120.0])
    np.testing.assert_allclose(columns["TEMP"], [10.0, 8.0])
    np.testing.assert_allclose(columns["RA"], [101.305, 359.75], atol=1e-10)
    np.testing.assert_allclose(columns["DEC"], [-2.5, 0.01], atol=1e-12)
    np.testing.assert_allclose(columns["ROTATOR"], [350.0, 10.0])
    np.testing.assert_allclose(columns["CLP_ANGLE"], [45.0, np.nan])
    assert columns["CLP_IN"].tolist() == [True, False]
    assert columns["KIND"].tolist() == ["clp", "moon"]
    assert columns["FILTER"].tolist() == ["SDSS-r", "NB-660"]


def test_headers_of_a_night(words: Path, tmp_path: Path):
    columns, remarks = exposures_table(headers(tmp_path), read_words(words))
    check_columns(columns)
    assert [Path(name).name for name in columns["FILE"]] == ["0.fits", "1.fits"]
    assert remarks == ["no word for HA, TEFF: taken as not known"]


def test_light_through_the_polariser_needs_no_word_for_it(words: Path, tmp_path: Path):
    """KIND clp is light through the polariser, which a remark says; its angle has to be stated."""
    text = WORDS.replace('[CLP_IN]\nword = "POLARIS"\nvalues = { IN = true, OUT = false }\n', "")
    columns, remarks = exposures_table(headers(tmp_path), words_of(tomllib.loads(text)))
    check_columns(columns)
    assert remarks[1:] == ["CLP_IN is not stated in 1 exposures of KIND clp: taken as true"]
    text = text.replace('[CLP_ANGLE]\nword = "POLANG"\nunit = "rad"\noptional = true\n', "")
    columns, remarks = exposures_table(headers(tmp_path), words_of(tomllib.loads(text)))
    assert columns["CLP_IN"].tolist() == [True, False]
    assert remarks[2:] == ["CLP_ANGLE is not known in 1 exposures through the polariser: a fit needs it"]


def test_a_log_of_the_telescope(words: Path, tmp_path: Path):
    """The same words nested in the records of a document database, and one record a line."""
    text = WORDS.replace('"DATE-OBS"', '"time.began"').replace('"ROT"', '"rotator.angle"')
    words.write_text('rows = "night.log"\n' + text)
    records = [
        {k: v for k, v in one.items() if k not in ("DATE-OBS", "ROT")}
        | {"time": {"began": {"$date": one["DATE-OBS"] + "Z"}}, "rotator": {"angle": one["ROT"]}}
        for one in HEADERS
    ]
    (tmp_path / "log.json").write_text(json.dumps({"night": {"log": records}}))
    check_columns(exposures_table([tmp_path / "log.json"], read_words(words))[0])
    words.write_text(text)
    (tmp_path / "lines.jsonl").write_text("\n".join(map(json.dumps, records)))
    check_columns(exposures_table([tmp_path / "lines.jsonl"], read_words(words))[0])


def test_a_table_of_words(words: Path, tmp_path: Path):
    names = dict.fromkeys(name for one in HEADERS for name in one)
    Table({n: [str(one.get(n, "")) for one in HEADERS] for n in names}).write(tmp_path / "log.csv")
    check_columns(exposures_table([tmp_path / "log.csv"], read_words(words))[0])


def test_the_command_and_the_set(words: Path, tmp_path: Path):
    """Its columns are what `from_arrays` takes."""
    table = walop.exposures(headers(tmp_path), words=words, output=tmp_path / "exposures.ecsv")
    again = Table.read(tmp_path / "exposures.ecsv")
    assert again["RA"].unit == "deg"
    check_columns({name: np.asarray(again[name]) for name in again.colnames})
    counts = np.full((3, 2, 4), 1e5) * np.array([1.0, 1.1, 0.9, 1.05])
    columns = {n.lower(): table[n] for n in ("MJD", "EXPTIME", "FILTER", "TEMP", "RA", "DEC", "ROTATOR")}
    narrow = walop.FilterCurve("NB-660", np.array([0.66]), np.ones(1))
    made = walop.from_arrays(
        counts, np.sqrt(counts), [0.0, 0.1, 0.2], [0.0, 0.1, 0.0], table["CLP_ANGLE"], table["KIND"],
        site=Site("SAAO", -32.4, 20.8, 1798.0), filters={"NB-660": narrow},
        **columns,
    )  # fmt: skip
    np.testing.assert_allclose(made.exposures.rotator, [350.0, 10.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"TINSTR": None}, r"0\.fits.*TEMP: the word TINSTR is missing"),
        ({"TINSTR": "cold"}, r"TEMP: TINSTR = 'cold' is not a number"),
        ({"TINSTR": 900.0}, r"TEMP.*exceeds ±150.*row 0"),
        ({"FILTNUM": 2}, r"FILTER: FILTNUM = 2 is none of its values"),
        ({"OBSTYPE": "DOME"}, r"KIND: OBSTYPE = 'DOME' is none of its values.*POLFLAT"),
        ({"DATE-OBS": "yesterday"}, r"MJD: DATE-OBS = 'yesterday' is no date"),
        ({"POLARIS": 3}, r"CLP_IN: POLARIS = 3 is none"),
        ({"TELRA": "06:75:13.2"}, r"RA: TELRA = '06:75:13\.2' is no angle; .* minutes below 60"),
    ],
)
def test_words_that_cannot_be_meant_are_told(words: Path, tmp_path: Path, changes, message):
    with pytest.raises(DataError, match=message):
        exposures_table(headers(tmp_path, **changes), read_words(words))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unit = "K"', 'unit = "m"', r"TEMP: the unit 'm' cannot be converted to 'Celsius'"),
        ('unit = "hourangle"', "", r"RA: TELRA = '06:45:13\.2' may be hours or degrees"),
        ("[TEMP]", "[TEMPERATUR]", r"words.toml: EXPOSURES have no column 'TEMPERATUR'.*TEMP"),
        ("(90 - x) % 360", "__import__('os')", r"\[ROTATOR\] expression = .* may hold numbers, columns"),
        ("(90 - x) % 360", "x + ROTT", r"\[ROTATOR\] expression: there is no 'ROTT'"),
        ("(90 - x) % 360", "x / 0", r"ROTATOR: 'x / 0'"),
        ('word = "ROT"', "", r"\[ROTATOR\] needs word"),
        ('word = "ROT"', 'words = "ROT"', r"there is no key 'words'"),
        ("[KIND]", "[HA]", "values|not a number"),
        ("extension = 0", 'schedule = "survey"', "schedule = 'survey' must be a table"),
        ("extension = 0", 'schedule = { observr = "x" }', r"no key 'observr'; did you mean 'observer'"),
        ("extension = 0", 'schedule = { mode = "semi" }', "mode = 'semi' is neither manual nor auto"),
        ("extension = 0", f'schedule = {{ pi = "{"x" * 101}" }}', "pi has more than 100 characters"),
    ],
)
def test_files_of_words_that_cannot_be_meant_are_told(words: Path, tmp_path: Path, old, new, message):
    words.write_text(WORDS.replace(old, new, 1))
    with pytest.raises(DataError, match=message):
        exposures_table(headers(tmp_path), read_words(words))


def test_an_expression_takes_other_columns_as_they_are_in_the_end(words: Path, tmp_path: Path):
    """The middle of 30000 ms that begin at 18:00 UTC of a word that is 8 h ahead, by way of two other expressions."""
    text = WORDS.replace('word = "EXPMIN"\nunit = "min"', 'word = "EXPMS"\nexpression = "x / 1000"')
    text += '[HA]\nword = "ZONE"\nexpression = "x / EXPTIME * 30"\n'
    text = text.replace("x + EXPTIME / 2 / 86400", "x + EXPTIME / 2 / 86400 - HA / 24")
    first, _ = headers(tmp_path, EXPMS=30000.0, ZONE=8.0, **{"DATE-OBS": "2026-11-27T02:00:00"})
    columns, _ = exposures_table([first], words_of(tomllib.loads(text)))
    np.testing.assert_allclose(columns["MJD"], 61370.75 + 15 / 86400, atol=1e-9)
    assert (columns["EXPTIME"], columns["HA"]) == (30.0, 8.0)
    one = of_header(fits.getheader(first), words_of(tomllib.loads(text)), ("MJD",), first)
    assert one == {"MJD": columns["MJD"][0]}
    with pytest.raises(DataError, match="MJD: the expressions of MJD and EXPTIME and HA need each other"):
        exposures_table([first], words_of(tomllib.loads(text.replace("x / 1000", "x / 1000 + HA"))))


@pytest.mark.parametrize(
    "began",
    [
        "2026-11-26T18:00:00Z",
        "2026-11-26T20:30:00+02:30",
        "2026-11-26 18:00:00.000000",
        {"$date": "2026-11-26T18:00:00.000Z"},
        {"$date": {"$numberLong": "1795716000000"}},  # date -d 2026-11-26T18:00Z +%s
        {"$date": 1795716000000},
    ],
)
def test_times_of_a_log(words: Path, tmp_path: Path, began):
    """A zone is taken into account, a byte-order mark and NaN are nothing; a file for each camera is remarked on."""
    record = HEADERS[0] | {"DATE-OBS": began, "POLANG": float("nan"), "TELRA": "6h45m13.2s"}
    (tmp_path / "log.json").write_text("\ufeff" + json.dumps([record] * 4))
    columns, remarks = exposures_table([tmp_path / "log.json"], read_words(words))
    np.testing.assert_allclose(columns["MJD"], 61370.75 + 15 / 86400, atol=1e-9)
    np.testing.assert_allclose(columns["RA"], 101.305, atol=1e-10)
    assert np.isnan(columns["CLP_ANGLE"]).all()
    assert (
        "3 exposures begin before the one ahead of them has ended: is a record there twice, or a file"
        in remarks[-1]
    )


def test_nothing_says_what_was_observed(tmp_path: Path):
    with pytest.raises(DataError, match="KIND: the kind of the exposures is not known"):
        exposures_table(headers(tmp_path), words_of({"EXPTIME": {"word": "EXPMIN", "unit": "min"}}))
