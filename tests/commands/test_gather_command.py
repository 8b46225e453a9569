"""From four catalogues of SExtractor to the common table in two commands, read as others read it, against the truth."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from astropy.io.votable import validate
from astropy.table import Table
from camera_files import four
from small_run import SEED, SMALL

import walop_jax as walop

COUNT = 5000


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """Stars of the instrument of the small run: the table, the truth, and the catalogues of its cameras."""
    folder = tmp_path_factory.mktemp("sky")
    stars = walop.simulate(SMALL, seed=SEED, stars=COUNT, output=folder / "s.fits", truth=folder / "t.json")
    truth = json.loads((folder / "t.json").read_text())
    return stars, truth, four(stars, folder, scatter=0.05)


def test_two_commands_to_the_common_table(call, run, sky, tmp_path):
    stars, truth, files = sky
    gathered, output = tmp_path / "g.fits", tmp_path / "c.vot"
    done = call("gather", *files, "-o", gathered, "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["stars"] > 0.99 * COUNT
    assert [entry["camera"] for entry in told["registrations"]] == ["O1", "E1", "O2", "E2"]
    assert call("apply", run, gathered, "-o", output, "--common", "--quiet").exit_code == 0
    assert validate(str(output), output=io.StringIO())
    assert walop.check_common_table(output) == ()
    table = Table.read(output)
    assert len(table.to_pandas()) == len(table) > 0.98 * COUNT
    assert all(table[name].description and table[name].meta["ucd"] for name in table.colnames)

    order = {source: row for row, source in enumerate(stars["SOURCE_ID"].tolist())}
    row = np.array([order[source] for source in table["GaiaID"].tolist()])
    for name, error in (("q", "e_q"), ("u", "e_u")):
        pull = (np.asarray(table[name]) - np.array(truth["stars"][name])[row]) / np.asarray(table[error])
        assert 66 < 100 * np.mean(np.abs(pull) < 1.0) < 70
        assert 93.5 < 100 * np.mean(np.abs(pull) < 1.96) < 96.5


def test_apply_takes_the_catalogues_of_the_cameras(call, run, sky, tmp_path):
    _, _, files = sky
    direct = call("apply", run, *files, "-o", tmp_path / "d.fits")
    assert direct.exit_code == 0, direct.output
    assert "is made of BP_RP" in direct.stderr
    assert "O1.fits" in direct.stderr
    table = Table.read(tmp_path / "d.fits")
    assert {"RA", "DEC", "SOURCE_ID", "BP_RP", "Q", "QU_PHOTON"} <= set(table.colnames)
    assert (table.meta["POLCCONV"], table.meta["TIMESYS"]) == ("IAU", "UTC")
    assert not any("not used" in text for text in table.meta.get("REMARK", []))


def test_simulated_stars_are_those_of_the_instrument_of_the_seed(sky):
    stars, truth, _ = sky
    again = walop.simulate(SMALL, seed=SEED, stars=50)
    known = walop.simulate(SMALL, seed=SEED).values
    assert truth["parameters"]["half1.wedge"]["value"] == known["half1.wedge"]
    assert len(again) == 50
    assert set(again.colnames) == set(stars.colnames)
    assert all(stars[name].description for name in stars.colnames)


def test_catalogues_of_the_cameras_are_those_of_the_stars(call, tmp_path):
    """Gathered, they are the catalogue: positions within the scatter of four, counts, time and pointing."""
    stars = walop.simulate(SMALL, seed=SEED, stars=40, cameras=True, output=tmp_path / "s.fits")
    files = [tmp_path / f"s_{name}.fits" for name in ("O1", "E1", "O2", "E2")]
    made = walop.gather(files)
    made.sort("SOURCE_ID")
    np.testing.assert_array_equal(made["SOURCE_ID"], stars["SOURCE_ID"])
    np.testing.assert_allclose(made["N"], stars["N"])
    assert np.max(np.abs(made["X"] - stars["X"])) < 0.2 / 3600
    assert np.max(np.abs(made["ROTATOR"] - stars["ROTATOR"])) < 1e-3
    assert (made["MJD"][0], made["FILTER"][0]) == (stars["MJD"][0], stars["FILTER"][0])
    assert call("simulate", "--cameras", "-o", tmp_path / "no.fits").exit_code == 2
