"""The same fit on another machine: instruction sets, threads, and versions of JAX and Python.

`same_answer.json` has values and errors of the small set in fits_data by JAX 0.10.2 on a machine with AVX-512. It holds
no truth: it tells whether the program that runs the tests gives the same numbers (0.01 standard errors).
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

SHIFT = 0.01  # standard errors
HERE = Path(__file__).resolve()
SET = HERE.parents[2] / "fits_data" / "walop_south_small.fits"
STORED = HERE.with_name("same_answer.json")
SCRIPT = """
import json, sys
import walop_jax as walop
fit = walop.refit(sys.argv[1])
rows = zip(fit.model.names, fit.values.tolist(), fit.sigma.tolist(), strict=True)
print(json.dumps({name: [value, sigma] for name, value, sigma in rows}))
"""


@pytest.mark.long
@pytest.mark.parametrize("flags", ["", "--xla_cpu_max_isa=AVX2", "--xla_cpu_multi_thread_eigen=false"])
def test_every_parameter_is_within_a_hundredth_of_its_error(tmp_path: Path, flags: str):
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"} if "thread" in flags else {}
    surroundings = os.environ | {"XLA_FLAGS": flags, "XDG_CACHE_HOME": str(tmp_path)} | threads
    output = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(SET)], env=surroundings, check=True, capture_output=True, text=True
    )
    here, stored = json.loads(output.stdout.splitlines()[-1]), json.loads(STORED.read_text(encoding="utf-8"))
    assert here.keys() == stored.keys()
    (values, sigma), (there, error) = (np.transpose(list(one.values())) for one in (here, stored))
    free = error > 0
    assert np.all(values[~free] == there[~free])
    assert np.max(np.abs(values - there)[free] / error[free]) < SHIFT
    assert np.max(np.abs(sigma / np.where(free, error, 1.0) - 1.0)[free]) < SHIFT
