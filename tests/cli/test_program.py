"""The program as a process of its own: start-up, streams, exit codes, the cache of compiled code."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def program(*args: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from walop_jax.cli import main; main()", *(str(arg) for arg in args)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
    )


def test_help_comes_without_the_heavy_libraries():
    code = (
        "import sys, walop_jax.cli\n"
        "heavy = {'jax', 'astropy', 'numpy', 'equinox', 'optimistix', 'matplotlib', 'emcee'} & set(sys.modules)\n"
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
    failed = program("inspect", tmp_path / "none.fits")
    assert failed.returncode == 1
    assert failed.stdout == ""
    assert re.fullmatch(r"walop-jax: error: .*none\.fits.*\n", failed.stderr)


def test_refit_as_a_process(calset_file, tmp_path):
    cache = tmp_path / "cache"
    done = program("refit", calset_file, "-o", tmp_path / "run", "--json", WALOP_JAX_CACHE=str(cache))
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["trusted"] is True
    assert done.stderr == ""
    assert any(cache.iterdir())
    # Where no folder can be made the run goes on without one.
    (tmp_path / "file").write_text("")
    blocked = str(tmp_path / "file" / "cache")
    points = tmp_path / "p.csv"
    points.write_text("X,Y\n0,0\n")
    asked = program(
        "matrix", tmp_path / "run", "--points", points, "-o", tmp_path / "o.csv", WALOP_JAX_CACHE=blocked
    )
    assert asked.returncode == 0, asked.stderr
    assert "M22" in (tmp_path / "o.csv").read_text()


def test_a_reader_that_has_gone_is_no_error(calset_file):
    shell = f'"{sys.executable}" -c "from walop_jax.cli import main; main()" model | head -n 1'
    done = subprocess.run(
        shell, shell=True, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    assert done.stdout.startswith("# Model of WALOP-SOUTH")
