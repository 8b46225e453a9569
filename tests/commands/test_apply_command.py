"""`walop-jax apply` from files to files: columns, header, flags, errors in one line."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from astropy.table import Table

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import read_calibration
from walop_jax.data.settings import Settings

ADDED = ["Q", "U", "Q_ERR", "U_ERR", "QU_COV", "P", "P_DEBIASED", "P_ERR", "EVPA", "EVPA_ERR", "FLAG"]


def catalogue(path, rows=6, **columns):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.2, 0.2, (2, rows))
    table = Table({"ID": np.arange(rows), "X": x, "Y": y})
    counts = rng.normal(1e6, 1e3, (rows, 4))
    if str(path).endswith(".fits"):
        table["N"], table["N_ERR"] = counts, np.sqrt(counts)
    else:
        for k in range(4):
            table[f"N{k}"], table[f"N{k}_ERR"] = counts[:, k], np.sqrt(counts[:, k])
    for name, values in columns.items():
        table[name] = values
    table.write(path, overwrite=True)
    return path


@pytest.mark.parametrize("suffix", [".fits", ".csv", ".ecsv"])
def test_apply_adds_columns(call, run, tmp_path, suffix):
    source = catalogue(tmp_path / f"c{suffix}", ROTATOR=20.0)
    output = tmp_path / f"o{suffix}"
    result = call("apply", run / "calibration.fits", source, "-o", output, "--json")
    assert result.exit_code == 3, result.output  # equal counts in all cameras are none of this instrument
    told = json.loads(result.stdout)
    assert told["trusted"] is False
    assert "contradict the calibration" in told["doubts"][0]
    assert told["rows"] == told["stars"] == 6
    assert told["estimator"] == "MAS"
    table, before = Table.read(output), Table.read(source)
    assert table.colnames[: len(before.colnames)] == before.colnames
    assert set(ADDED) <= set(table.colnames)
    assert np.all((table["EVPA"] >= 0) & (table["EVPA"] < 180))
    assert np.all(table["P_DEBIASED"] <= table["P"])
    np.testing.assert_allclose(np.hypot(table["Q"], table["U"]), table["P"], rtol=1e-12)
    if suffix != ".csv":
        assert [str(table[name].unit) for name in ("EVPA", "EVPA_ERR", "Q")] == ["deg", "deg", "None"]
        assert table.meta["QUFRAME"] == "sky"
        assert str(table.meta["TRUSTED"]) == "False"
        assert "contradict the calibration" in table.meta["DOUBT"]
        assert (
            table.meta["CALHASH"] == read_calibration(run / "calibration.fits", any_model=True).content_hash()
        )
        assert table.meta["PESTIM"].startswith("Plaszczynski")


def test_other_estimator_and_combined_rows(call, run, tmp_path):
    source = catalogue(tmp_path / "c.fits", ID=["a", "b", "a", "c", "b", "a"])
    call("apply", run, source, "-o", tmp_path / "o.fits", "--debias", "WK", "--quiet")
    table = Table.read(tmp_path / "o.fits")
    assert table["NROWS"].tolist() == [3, 2, 3, 1, 2, 3]
    assert len(set(table["Q"].tolist())) == 3
    assert table.meta["PESTIM"].startswith("Wardle")
    assert table.meta["QUFRAME"] == "instrument"


def test_rows_that_hold_nothing_are_said(call, run, tmp_path):
    counts = np.full((6, 4), 1e6)
    counts[0] = 0.0
    source = catalogue(tmp_path / "c.fits", N=counts)
    result = call("apply", run, source, "-o", tmp_path / "o.fits")
    assert result.exit_code == 3
    assert "1 star(s) without a result" in result.stderr
    assert np.isnan(np.ma.filled(Table.read(tmp_path / "o.fits")["Q"], np.nan)[0])


def test_the_summary_says_how_well_p_is_known_and_variances_are_noticed(call, run, tmp_path):
    table = catalogue(tmp_path / "s.fits")
    result = call("apply", run, table, "-o", tmp_path / "o.fits")
    assert re.search(
        r"p of a star +error [\d.]+ % \(median\), photons make \d+ % of its variance", result.stdout
    )
    stars = Table.read(table)
    assert "variances" not in result.stderr
    stars["N_ERR"] = stars["N_ERR"] ** 2
    stars.write(table, overwrite=True)
    assert "are these variances?" in call("apply", run, table, "-o", tmp_path / "v.fits").stderr


@pytest.fixture(scope="module")
def sound(run, tmp_path_factory):
    """Forty stars as the calibration has them, with the noise of photons."""
    rng, vectors = np.random.default_rng(1), AnalysisVectors(Calibration.read(run / "calibration.fits"))
    x, y = rng.uniform(-0.2, 0.2, (2, 40))
    expected = 1e6 * vectors.coloured(Settings.default(1), x, y)[..., 0]
    counts = rng.normal(expected, np.sqrt(expected))
    table = Table({"ID": np.arange(40), "X": x, "Y": y, "N": counts, "N_ERR": np.sqrt(expected)})
    table.write(path := tmp_path_factory.mktemp("sound") / "stars.fits")
    return path


def test_the_first_line_and_the_exit_code_say_whether_the_catalogue_is_to_be_trusted(
    call, run, sound, tmp_path
):
    """Sound; of another instrument; with cameras exchanged inside an arm, which no sum of cameras shows; both kinds."""
    good = call("apply", run, sound, "-o", tmp_path / "good.fits")
    assert good.exit_code == 0, good.output
    assert good.stdout.startswith(f"{tmp_path / 'good.fits'}: go\n")
    meta = Table.read(tmp_path / "good.fits").meta
    assert meta["TRUSTED"]
    assert "DOUBT" not in meta

    other = Table.read(sound)
    other.meta["INSTRUME"] = "WALOP-NORTH"
    other.write(tmp_path / "other.fits")
    exchanged = Table.read(sound)
    for name in ("N", "N_ERR"):
        exchanged[name] = exchanged[name][:, [1, 0, 2, 3]]
    exchanged.write(tmp_path / "exchanged.fits")
    for name, words in (
        ("other", "INSTRUME of the table is WALOP-NORTH"),
        ("exchanged", "would agree|would not .* in the order E1, O1, O2, E2"),
    ):
        result = call("apply", run, tmp_path / f"{name}.fits", "-o", tmp_path / "bad.fits", "--overwrite")
        assert result.exit_code == 3
        line = result.stdout.splitlines()[0]
        assert "no go: " in line
        assert re.search(words, line)
        assert "Next" not in result.stderr

    files = [tmp_path / "exchanged.fits", sound]
    for again in (False, True):  # tables that are there already are judged by their headers
        result = call("apply", run, *files, "--each", "-o", tmp_path / "OUT")
        assert result.exit_code == 3, again
        assert result.stdout.startswith("1 of 2 tables: no go: ")
        assert "exchanged.fits" in result.stdout.splitlines()[0]
