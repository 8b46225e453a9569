"""The benchmark of `speed.py`, and what it must show."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from south_sets import SouthSet

HERE = Path(__file__).resolve().parent


@pytest.mark.benchmark
def test_effective_samples_per_second(either_south_set: Callable[[str], SouthSet]) -> None:
    """≥ 50 × plain emcee on a NumPy model and ≥ 1 × whitened NUTS, cold and warm."""
    command = [sys.executable, str(HERE / "speed.py"), str(either_south_set("a").path)]
    paths = [str(HERE.parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr[-2000:]
    print(run.stdout)
    found = json.loads(run.stdout[run.stdout.index("{") :])
    for state in ("cold", "warm"):
        assert found[f"ours_{state}_trusted"]
        assert found[f"gain_over_plain_{state}"] > 50
        assert found[f"gain_over_nuts_{state}"] > 1
