"""A night of an observer, typed as its page says; every refusal is followed to the remedy that it names."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest
from astropy.table import Table
from camera_files import four
from command import Call, one_line
from small_run import SEED, SMALL

import walop_jax as walop
from walop_jax.commands.docs import pages
from walop_jax.data.write import write_calibration_set
from walop_jax.simulation.simulate import simulate

PAGE = pages()["observer"]
TYPED = re.findall(r"walop-jax ((?:check|apply) [^`\n]*)", PAGE)
"""The lines of the page that ask the calibration and the stars."""
CAMERAS = ("O1.cat", "E1.cat", "O2.cat", "E2.cat")


@pytest.fixture
def here(run: Path, tmp_path: Path, monkeypatch) -> Path:
    """What lies in the folder of the night: a run, catalogues of the cameras, a later calibration set."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(run, "RUN")
    stars = walop.simulate(SMALL, seed=SEED, stars=400)
    for path in four(stars, tmp_path, scatter=0.05):
        path.rename(path.with_suffix(".cat"))
    truth = simulate(SMALL, seed=SEED).truth
    write_calibration_set("NEW.fits", simulate(SMALL, seed=SEED + 7, instrument=truth).calset)
    return tmp_path


def words(line: str) -> list[str]:
    """The words of a line of the page, without the pattern of a shell."""
    return shlex.split(line.replace("STARS*.fits", "STARS.fits"))


def test_the_lines_of_the_page_answer_as_it_says(call: Call, here: Path):
    """All of a sound night: each begins with go, and ends with exit code 0."""
    assert len(TYPED) == 6
    lines = sorted(
        (words(line) for line in TYPED), key=lambda line: (line[0] != "apply", "--against" in line)
    )
    for line in lines:
        if "--against" in line:
            line[1] = "RUN"  # a survey of this one night
        done = call(*line, *(("--overwrite",) if "-o" in line else ()))
        assert done.exit_code == 0, f"{line}: {done.output}"
        assert re.search(r": go(, with reservations: .*)?$", done.stdout.splitlines()[0]), done.stdout
        assert done.stdout.splitlines()[1].startswith("  p of a star")
    assert {entry.name for entry in Path("STILL").iterdir()} >= {"check.json"}
    assert len(Table.read("QUALITY.ecsv")) == 1


def test_every_refusal_leads_to_its_remedy(call: Call, here: Path):
    """Files in the wrong order, one camera alone, a wrong sign of ROTATOR, a plan: each is told, and then mended."""
    exchanged = call("gather", "O1.cat", "O2.cat", "E1.cat", "E2.cat", "-o", "STARS.fits")
    assert exchanged.exit_code == 2
    assert "is given in the place of camera" in exchanged.stderr
    assert call("gather", *CAMERAS, "-o", "STARS.fits").exit_code == 0

    alone = one_line(call("check", "RUN", "O1.cat"))
    assert "walop-jax gather O1 E1 O2 E2 -o STARS.fits" in alone
    assert call("check", "RUN", "STARS.fits").exit_code == 0

    table = Table.read("STARS.fits")
    table["N"], table["N_ERR"] = table["N"][:, [2, 3, 0, 1]], table["N_ERR"][:, [2, 3, 0, 1]]
    table.write("arms.fits")
    done = call("apply", "RUN", "arms.fits", "-o", "OUT.fits")
    assert done.exit_code == 3
    first = done.stdout.splitlines()[0]
    assert "OUT.fits: no go: " in first
    (order,) = re.findall(r"in the order (\w\w), (\w\w), (\w\w), (\w\w)", first)
    names = ("O1", "E1", "O2", "E2")
    back = [order.index(name) for name in names]
    for column in ("N", "N_ERR"):
        table[column] = table[column][:, back]
    table.write("mended.fits")
    mended = call("apply", "RUN", "mended.fits", "-o", "OUT.fits", "--overwrite")
    assert mended.exit_code == 0, mended.output
    assert mended.stdout.startswith("OUT.fits: go")

    Path("plan.toml").write_text("grid = 5\n")
    refused = one_line(call("check", "RUN", "plan.toml"))
    assert "is a TOML file, such as a plan or a model" in refused
    assert "give calibration sets (FITS with EXPOSURES), or catalogues of stars" in refused
    assert call("check", "RUN", "NEW.fits").exit_code == 0
