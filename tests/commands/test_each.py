"""`walop-jax apply --each`: tables of many catalogues are those of one command each, and are made once."""

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from astropy.table import Table

import walop_jax as walop


@pytest.fixture
def catalogues(tmp_path):
    """Three catalogues in different formats, of six stars each."""
    rng, paths = np.random.default_rng(1), []
    for number, suffix in enumerate((".csv", ".ecsv", ".csv")):
        x, y = rng.uniform(-0.2, 0.2, (2, 6))
        table = Table({"ID": np.arange(6), "X": x, "Y": y})
        counts = rng.normal(1e6, 1e3, (6, 4))
        for k in range(4):
            table[f"N{k}"], table[f"N{k}_ERR"] = counts[:, k], np.sqrt(counts[:, k])
        table.write(path := tmp_path / f"night{number}{suffix}")
        paths.append(path)
    return paths


def test_tables_are_those_of_one_command_each_and_are_made_once(call, run, catalogues, tmp_path):
    out = tmp_path / "OUT"
    catalogues[1].rename(tmp_path / "away.ecsv")
    result = call("apply", run, *catalogues, "--each", "-o", out, "--json")
    told = json.loads(result.stdout)
    assert result.exit_code == 1
    assert told["made"] == 2
    assert "night1.ecsv" in told["failed"][0]
    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    assert sorted(before) == ["night0.csv", "night2.csv"]

    (tmp_path / "away.ecsv").rename(catalogues[1])
    with ThreadPoolExecutor(1) as executor:
        paths = walop.apply(run, catalogues, output=out, each=True, scheduler=executor)
    assert [path.name for path in paths] == [path.name for path in catalogues]
    assert {name: (out / name).stat().st_mtime_ns for name in before} == before
    for path, catalogue in zip(paths, catalogues, strict=True):
        alone = tmp_path / f"alone-{path.name}"
        walop.apply(run, catalogue, output=alone)
        assert path.read_text() == alone.read_text()


def test_tables_do_not_replace_their_catalogues(call, run, catalogues, tmp_path):
    content = [path.read_bytes() for path in catalogues]
    result = call("apply", run, *catalogues, "--each", "-o", tmp_path, "--overwrite")
    assert result.exit_code == 2
    assert "would replace the catalogues" in result.stderr
    assert [path.read_bytes() for path in catalogues] == content


def test_workers_are_for_many_catalogues(call, run, catalogues, tmp_path):
    result = call("apply", run, catalogues[0], "-o", tmp_path / "o.csv", "--workers", "2")
    assert result.exit_code == 2
    assert "see --each" in result.stderr
