"""The scripts of the page of recipes run as they stand there, are short, and use public names only."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from camera_files import ascii_head, four
from quick import quick
from small_run import SEED, SMALL

import walop_jax as walop
from walop_jax.commands.docs import pages
from walop_jax.data.write import write_calibration_set
from walop_jax.fit.refit import refit
from walop_jax.simulation.simulate import simulate

SECTIONS = re.split(r"^## ", pages()["recipes"], flags=re.MULTILINE)[1:]
SCRIPTS = {
    section.splitlines()[0]: textwrap.dedent(
        "\n".join(re.findall(r"^(?:    .*)?$", section, re.MULTILINE))
    ).strip()
    for section in SECTIONS
}
SAID = {
    "The posterior of two thicknesses": "half1.plate.mgf2",
    "p of my stars": "P_DEBIASED",
    "Fix the wedge": "fixed",
    "An effect of my own": "Diagnosis (",
    "Compare two nights": "the instrument has changed",
    "My arrays": "Fit of WALOP-SOUTH",
    "How good would a plan be?": "M33_ERR",
    "The quality of nights": "CHI2DOF",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """What the scripts find beside them."""
    from walop_jax.calibration.calibration import Calibration
    from walop_jax.calibration.product import write_calibration

    path = tmp_path_factory.mktemp("recipes")
    calset = simulate(SMALL, seed=SEED).calset
    write_calibration_set(path / "run.fits", calset)
    write_calibration_set(path / "night2.fits", simulate(SMALL, seed=SEED + 1).calset)
    (path / "RUN").mkdir()
    write_calibration(path / "RUN" / "calibration.fits", Calibration.from_fit(refit(calset).with_verdict()))
    x, y = np.random.default_rng(0).uniform(-0.25, 0.25, (2, 30))
    Table({"X": x, "Y": y}).write(path / "stars.csv")
    four(walop.simulate(SMALL, seed=SEED, stars=60), path, ascii_head)
    clp = np.flatnonzero(calset.exposures.kind == "clp")
    block = calset.intensities.block(0, len(calset.points))
    points = np.flatnonzero(block.used[:, clp].all(axis=1))
    np.savez(
        path / "arrays.npz", counts=block.counts[points][:, clp], errors=block.sigma[points][:, clp],
        x=block.x[points], y=block.y[points], angles=calset.exposures.clp_angle[clp],
    )  # fmt: skip
    return path


def test_they_use_public_names_alone():
    assert len(SCRIPTS) >= 10
    for title, script in SCRIPTS.items():
        assert script.strip(), title
        assert not re.search(r"walop_jax\.|import _|\._", script), title


@pytest.mark.parametrize("title", quick(SCRIPTS, ["My arrays"]))
def test_it_runs(title, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    exec(compile(SCRIPTS[title], title, "exec"), {"__name__": "recipe"})
    assert SAID.get(title, "") in capsys.readouterr().out
    if title == "The matrix at my stars":
        assert len(Table.read(folder / "matrix.fits")) == 30
    if title == "From SExtractor to a table for others":
        assert walop.check_common_table(folder / "stars.fits") == ()
