"""An output is no input, whatever its name; a table in CSV is read back as it was."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pytest
from astropy.table import Table
from camera_files import four, some_stars

import walop_jax as walop
from walop_jax.commands.command import UsageError
from walop_jax.io.errors import DataError
from walop_jax.io.folder import check_apart

STARS = some_stars(40)
LOST = "is the output and an input"


def content(path) -> bytes:
    return path.read_bytes()


def test_an_output_that_is_an_input_is_refused_and_nothing_is_lost(run, tmp_path):
    files = four(STARS, tmp_path)
    before = content(files[1])
    with pytest.raises(UsageError, match=LOST):
        walop.gather(files, output=files[1], overwrite=True)
    link = tmp_path / "link.fits"
    link.symlink_to(files[1])
    hard = tmp_path / "hard.fits"
    os.link(files[1], hard)
    for other_name in (link, hard, tmp_path / "." / "E1.fits"):
        with pytest.raises(UsageError, match=LOST):
            walop.gather(files, output=other_name, overwrite=True)
    assert content(files[1]) == before
    stars = tmp_path / "stars.fits"
    walop.gather(files, output=stars)
    with pytest.raises(UsageError, match=LOST):
        walop.apply(run, stars, output=stars, overwrite=True)
    with pytest.raises(UsageError, match=LOST):
        walop.gather(files, gaia=str(stars), output=stars, overwrite=True)


def test_a_calibration_that_is_compared_is_not_replaced(run, calset_file, tmp_path):
    old = shutil.copytree(run, tmp_path / "old")
    for given in (old, old / "calibration.fits", walop.read(old)):
        with pytest.raises(UsageError, match=LOST):
            walop.check(given, calset_file, output=old, overwrite=True)


def test_other_commands_keep_their_inputs(tmp_path):
    plan, truth = tmp_path / "plan.toml", tmp_path / "truth.json"
    plan.write_text("seed = 1\n")
    with pytest.raises(UsageError, match=LOST):
        walop.simulate(plan, output=tmp_path / "s.fits", truth=plan, overwrite=True)
    with pytest.raises(UsageError, match=LOST):
        walop.plan(plan, output=tmp_path, overwrite=True)
    with pytest.raises(ValueError, match="is the file of output as well"):
        walop.simulate(output=truth, truth=truth, overwrite=True)
    with pytest.raises(UsageError, match=LOST):
        walop.matrix("RUN", points=plan, output=plan, overwrite=True)


def test_a_table_in_a_file_is_that_file(tmp_path):
    file = tmp_path / "a.fits"
    file.touch()
    with pytest.raises(DataError, match=LOST):
        check_apart([file], [f"{file}[STARS]"])
    check_apart([tmp_path / "b.fits"], [file, "nowhere.fits"])


def test_stars_in_csv_are_read_back_as_they_were(call, run, tmp_path):
    files = four(STARS, tmp_path)
    assert call("gather", *files, "-o", tmp_path / "g.fits").exit_code == 0
    done = call("gather", *files, "-o", tmp_path / "g.csv")
    assert done.exit_code == 0, done.output
    assert "CSV has no header: INSTRUME, RA, DEC, ROTATOR, RADESYS are not in" in done.stderr
    plain = Table.read(tmp_path / "g.csv")
    assert {"N0", "N3", "N0_ERR", "N3_ERR", "N0_FLAG"} <= set(plain.colnames)
    assert "N" not in plain.colnames
    made = {}
    for end in ("fits", "csv"):
        assert call("apply", run, tmp_path / f"g.{end}", "-o", tmp_path / f"a.{end}").exit_code in (0, 3)
        made[end] = Table.read(tmp_path / f"a.{end}")
    for name in ("Q", "U", "Q_ERR", "U_ERR", "QU_COV", "FLAG", "SOURCE_ID"):
        np.testing.assert_allclose(made["csv"][name], made["fits"][name], rtol=1e-9)
    np.testing.assert_allclose(made["csv"]["N2"], made["fits"]["N"][:, 2], rtol=1e-12)
