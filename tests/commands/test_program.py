"""The program as a process of its own: start-up, streams, exit codes, the cache of compiled code."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import handmade_run
import pytest
from south_sets import CUTS

from walop_jax.model.compiled import CACHE_VARIABLE, cache_folder

ROOT = Path(__file__).resolve().parents[2]


def program(*args: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from walop_jax.commands import main; main()", *(str(arg) for arg in args)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
    )


def test_help_comes_without_the_heavy_libraries():
    code = (
        "import sys, walop_jax.commands.program\n"
        "heavy = {'jax', 'astropy', 'numpy', 'equinox', 'scipy', 'matplotlib', 'emcee'} & set(sys.modules)\n"
        "print(sorted(heavy))"
    )
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert shown.stdout.strip() == "[]"
    shown = program("--help")
    assert shown.returncode == 0
    for name in ("inspect", "refit", "matrix", "model", "cite"):
        assert name in shown.stdout


@pytest.mark.benchmark
def test_help_is_fast():
    """Half a second; 0.2 s measured on two idle cores."""
    best = min(_seconds("--help") for _ in range(3))
    assert best < 0.5


def _seconds(*args: object) -> float:
    began = time.perf_counter()
    program(*args)
    return time.perf_counter() - began


def test_wrong_usage_and_errors_have_their_exit_codes(tmp_path):
    assert program("refit").returncode == 2
    failed = program("inspect", tmp_path / "none.fits", "--quiet")
    assert failed.returncode == 1
    assert failed.stdout == ""
    assert re.fullmatch(r"walop-jax: error: .*none\.fits.*\n", failed.stderr)


@pytest.mark.parametrize(
    ("module", "disguised"), [("typer", False), ("walop_jax.data.inspection", False), ("numpy", True)]
)
def test_an_interrupt_during_imports_is_one_line(tmp_path, module, disguised):
    """Libraries in C turn the interrupt into an error of their own."""
    error = "raise ImportError('failed') from KeyboardInterrupt()" if disguised else "raise KeyboardInterrupt"
    code = (
        "import sys\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}:\n"
        f"            {error}\n"
        "sys.meta_path.insert(0, Interrupting())\n"
        "from walop_jax.commands import main\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "inspect", str(tmp_path / "none.fits")],
        capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 130
    assert done.stderr == "walop-jax: error: interrupted; nothing was left half-written\n"


def test_a_path_that_is_not_utf_8(tmp_path):
    path = os.fsencode(tmp_path) + b"/a\xff.fits.gz"
    shutil.copy(CUTS / "walop_south_a.fits.gz", path)
    done = program("inspect", os.fsdecode(path), PYTHONIOENCODING="utf-8:strict")
    assert done.returncode == 0, done.stderr
    assert "\\xff.fits.gz" in done.stdout or "\\udcff.fits.gz" in done.stdout
    told = json.loads(program("inspect", "--json", os.fsdecode(path)).stdout)
    assert told["sets"][0]["files"] == [f"{tmp_path}/a\\xff.fits.gz"]


def test_a_command_as_a_process_keeps_its_programs(run, tmp_path):
    cache = tmp_path / "cache"
    done = program("matrix", run, "--x", "0.1", "--y", "0", "--json", WALOP_JAX_CACHE=str(cache))
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)
    assert "Traceback" not in done.stderr
    assert any(cache.iterdir())


def test_where_no_cache_can_be_kept_a_command_goes_on_without(call, run, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "file" / "cache"))
    assert cache_folder() is None
    (tmp_path / "p.csv").write_text("X,Y\n0,0\n")
    asked = call("matrix", run, "--points", tmp_path / "p.csv", "-o", tmp_path / "o.csv")
    assert asked.exit_code == 0, asked.stderr
    assert "M22" in (tmp_path / "o.csv").read_text()
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "made" / "cache"))
    assert cache_folder() == tmp_path / "made" / "cache"
    assert (tmp_path / "made" / "cache").is_dir()


def test_a_reader_that_has_gone_is_no_error(calset_file):
    shell = f'"{sys.executable}" -c "from walop_jax.commands import main; main()" model | head -n 1'
    done = subprocess.run(
        shell, shell=True, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    assert done.stdout.startswith("# Model of WALOP-SOUTH")


@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_streams_that_are_closed_are_no_error(tmp_path: Path, closed: tuple[int, ...]):
    """As daemons start programs (`>&-`): the work is done, what would be printed is dropped and ends up in no file."""
    close = " ".join(("<&-", ">&-", "2>&-")[number] for number in closed)
    shown = subprocess.run(
        ["bash", "-c", f'"$@" {close}', "bash", sys.executable, "-m", "walop_jax", "model", "-o", "model.toml"],
        cwd=tmp_path, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert (shown.returncode, shown.stderr) == (0, "")
    assert [path.name for path in tmp_path.iterdir()] == ["model.toml"]
    written = (tmp_path / "model.toml").read_text(encoding="utf-8")
    assert "[parameters" in written
    assert "of them free" not in written  # what the program prints


def test_a_back_end_of_a_notebook_is_not_needed(tmp_path: Path):
    """Jupyter exports the name of one that need not be where the program is."""
    run = handmade_run.make_refit(tmp_path / "run")
    shown = program("report", run, MPLBACKEND="module://matplotlib_that_is_not_there.backend")
    assert shown.returncode == 0, shown.stderr
    assert (run / "report.html").exists()
