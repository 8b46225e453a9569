"""What the joint fit costs beside scipy's least squares on a numpy model.

    OMP_NUM_THREADS=1 python -m pytest tests/fit/test_speed.py --benchmark -s

Both fit all base parameters to the same 12 × 12 set from the same start values. scipy has what it can use: the
residuals of the numpy oracle with the fluxes as parameters of their own, the sparsity of their Jacobian and
`x_scale="jac"`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from oracle import fit as oracle_fit
from oracle import forward
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.write import write_calibration_set
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import simulate


def scipy_fit(path):
    """scipy's result and the number of its model evaluations."""
    data = forward.load(path)
    catalogue = data["sources"]
    start = forward.nominal(catalogue["Q"].size)
    start["q"], start["u"] = catalogue["Q"].copy(), catalogue["U"].copy()
    vector = oracle_fit.Vector(start, data)
    first = vector.pack(start)
    n, rows = first.size, data["point"].size
    calls = 0

    def model(x):
        nonlocal calls
        calls += 1
        return forward.model_counts(vector.unpack(x), data, oracle_fit.NODES)

    def residuals(x):
        parameters = vector.unpack(x[:n])
        measured = (data["n"] - (x[n:] * level)[:, None] * model(x[:n])) / data["n_err"]
        known = [(parameters[k] - forward.NOMINAL[k]) / width for k, width in forward.PRIOR_WIDTH.items()]
        q, u = ((parameters[k.lower()] - catalogue[k]) / catalogue[f"{k}_ERR"] for k in "QU")
        return np.concatenate([measured.ravel(), known, q, u])

    unit, weight = model(first), data["n_err"] ** -2
    level = np.sum(weight * data["n"] * unit, axis=-1) / np.sum(weight * unit**2, axis=-1)
    x0 = np.concatenate([first, np.ones(rows)])
    found = least_squares(
        residuals, x0, jac_sparsity=sparsity(vector, data, residuals(x0).size), x_scale="jac",
        ftol=1e-10, xtol=1e-10, gtol=1e-10, max_nfev=100,
    )  # fmt: skip
    return found, calls


def sparsity(vector, data, length):
    """Which residual depends on which parameter; all priors on all parameters that have no flux in their name."""
    rows, names = data["point"].size, vector.names
    sources, series = len(vector.start["q"]), int(vector.free.sum())
    n = len(names) + series + 2 * sources
    pattern = lil_matrix((length, n + rows), dtype=int)
    for column, name in enumerate(names):
        touched = np.repeat(data["kind"] == "moon", 4) if name == "delta" else np.ones(4 * rows, bool)
        pattern[np.flatnonzero(touched), column] = 1
    camera_of = np.nonzero(vector.free)[0]
    for column, camera in enumerate(camera_of, start=len(names)):
        pattern[4 * np.arange(rows) + camera, column] = 1
    for source in range(sources):
        touched = np.flatnonzero(np.repeat(data["source"] == source, 4))
        pattern[touched, len(names) + series + source] = 1
        pattern[touched, len(names) + series + sources + source] = 1
    for row in range(rows):
        pattern[4 * row : 4 * row + 4, n + row] = 1
    pattern[4 * rows :, :n] = 1
    return pattern.tocsr()


def seconds(work):
    began = time.perf_counter()
    result = work()
    return time.perf_counter() - began, result


@pytest.mark.benchmark
def test_against_scipy(tmp_path):
    path = tmp_path / "run.fits"
    write_calibration_set(path, simulate(ObservingPlan(), seed=2026).calset)
    here, root = Path(__file__).resolve().parent, Path(__file__).resolve().parents[1]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(here), str(root), *sys.path])}

    def process(code, *arguments):
        command = [sys.executable, "-c", code, *map(str, arguments)]
        return seconds(lambda: subprocess.run(command, check=True, env=environment, capture_output=True))[0]

    refit = "from walop_jax.commands import main; main()"
    filled = process(refit, "refit", path, "-o", tmp_path / "first")
    cold = min(process(refit, "refit", path, "-o", tmp_path / f"run{n}") for n in range(2))
    calset = read_calibration_set(path)
    model = base_model(calset)
    fit(Likelihood.of(calset, model))
    warm, ours = min(
        (seconds(lambda: fit(Likelihood.of(calset, model))) for _ in range(3)), key=lambda pair: pair[0]
    )
    theirs, (found, calls) = seconds(lambda: scipy_fit(path))
    scipy_cold = process("import sys; from test_speed import scipy_fit; scipy_fit(sys.argv[1])", path)
    print(
        f"\nours: {warm:.2f} s warm, {ours.minimum.steps} steps, χ² {ours.chi2:.4f}; process {cold:.1f} s, "
        f"the first time {filled:.1f} s\nscipy: {theirs:.1f} s, {calls} evaluations, χ² {2 * found.cost:.4f}, "
        f"{found.message}; process {scipy_cold:.1f} s\n"
        f"ratios: {theirs / warm:.0f} warm, {scipy_cold / cold:.1f} as processes"
    )
    assert 2 * found.cost > ours.chi2 * (1 - 1e-7)
    assert theirs > 10 * warm
    assert cold < scipy_cold
