"""Sessions in which JAX is set to float32: the numbers of this package are those of float64, and the session stays."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_run import SMALL

import walop_jax as walop
from walop_jax.model.compiled import array, compiled, float64
from walop_jax.model.elements.wave_plate import WavePlate
from walop_jax.model.instrument import nominal_instrument
from walop_jax.model.parameters import values_of

SCRIPT = """
import json, sys, jax, jax.numpy as jnp, numpy as np
mine = jnp.arange(3.0)  # alive when the package is first used: JAX is left at float32
import walop_jax as walop
from small_run import SEED, SMALL

def numbers():
    calset = walop.simulate(SMALL, seed=SEED).calset
    fit = walop.refit(calset)
    x, y = np.linspace(-0.25, 0.25, 5), np.linspace(-0.2, 0.25, 5)
    matrix = walop.matrix(fit, x=x, y=y)
    stars = {"X": x, "Y": y, "N": np.full((5, 4), 1e6) + np.arange(4) * 1e4, "N_ERR": np.full((5, 4), 1e3)}
    applied = walop.apply(fit, stars)
    later = walop.Calibration.from_fit(fit)  # and objects that compute when they are asked
    likelihood = walop.Likelihood.of(calset, fit.model)
    return {
        "counts": calset.intensities.block(0, len(calset.points)).counts,
        "values": fit.values, "covariance": fit.covariance,
        "matrix": [matrix[name] for name in ("M21", "M32", "M33", "M33_ERR")],
        "stars": [applied[name] for name in ("Q", "U", "Q_ERR")],
        "light": np.concatenate([np.ravel(stage.value) for stage in walop.trace(fit, x=0.1, y=0.05, q=0.02)]),
        "at a place": later.matrix(x, y)[1], "maps": later.new_maps(7).values,
        "residuals": likelihood.residuals(fit.values)[1], "jacobian": likelihood.jacobian(fit.values),
        "instrument": np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(fit.model.instrument(fit.values))]),
    }

single = numbers()
session = [str(mine.dtype), str(jnp.ones(1).dtype), sum(a.dtype == jnp.float32 for a in jax.live_arrays())]
jax.config.update("jax_enable_x64", True)
double = numbers()
off = {name: float(np.max(np.abs(np.asarray(a) - double[name])) / np.max(np.abs(a))) for name, a in single.items()}
print(json.dumps([session, off]))
"""


def test_numbers_are_those_of_float64():
    environment = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    environment["PYTHONPATH"] = os.pathsep.join(
        [os.path.dirname(__file__), environment.get("PYTHONPATH", "")]
    )
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, check=False, text=True, env=environment
    )
    assert run.returncode == 0, run.stderr
    session, off = json.loads(run.stdout)
    assert session == ["float32", "float32", 1]  # the array of the session, and none of the package
    assert max(off.values()) < 1e-12, off


@pytest.fixture
def single():
    """A session whose float64 has been switched off."""
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)


def test_programs_and_arrays_are_of_float64(single):
    third = compiled(lambda x: x / 3.0)(array(np.ones(1)))
    assert float(np.asarray(third)[0]) == 1.0 / 3.0
    assert np.asarray(values_of(nominal_instrument("WALOP-SOUTH"))).dtype == np.float64
    assert jnp.ones(1).dtype == jnp.float32


def test_numbers_that_have_lost_their_digits_are_refused(single):
    with pytest.raises(RuntimeError, match="jax_enable_x64"):
        compiled(lambda x: x / 3.0)(jnp.ones(1))


def test_the_switch_is_for_the_block(single):
    with float64(), float64():
        assert jnp.ones(1).dtype == jnp.float64
    assert jnp.ones(1).dtype == jnp.float32


def test_what_the_session_compiles_is_refused(single):
    """A forward model made, or kept, in a session of float32, and the matrices of an instrument."""
    mine = jnp.ones(1)  # alive: the session is left as it is
    with pytest.raises(RuntimeError, match="float64, which is switched off"):
        walop.forward(SMALL)
    with float64():
        forward = walop.forward(SMALL)
        values = np.asarray(forward.start)
        instrument = forward.instrument(values)
        plate = next(e for e in instrument.arms[0].elements if isinstance(e, WavePlate))
        flux = np.ones(forward.shape[:2])
    asked = [
        *(
            getattr(forward, name)
            for name in ("counts", "flux", "residuals", "chi2", "log_density", "log_prior")
        ),
        forward.instrument,
        jax.jit(forward.chi2),
        jax.grad(forward.chi2),
        lambda values: forward.counts(values, flux),
        lambda values: forward.chi2(instrument),
        lambda values: forward.full(values[np.asarray(forward.free)]),
        lambda values: instrument.mueller(0.1, 0.05, 0.6, {"CHWP": 45.0}),
        lambda values: plate.retardance(2.0, 30.0, 0.6),
    ]
    for function in asked:
        with pytest.raises(RuntimeError, match="float64, which is switched off"):
            function(values)
    assert mine.dtype == jnp.ones(1).dtype == jnp.float32


def test_values_in_float32_are_refused_with_what_they_would_cost():
    """A thickness of 1930 µm in float32 is off by 10⁻⁴ µm, and its gradient would be rounded as well."""
    forward = walop.forward(SMALL)
    rounded = np.asarray(forward.start, np.float32)
    for values in (rounded, jnp.asarray(rounded)):
        with pytest.raises(TypeError, match="was given numbers in float32"):
            forward.instrument(values)
    assert forward.instrument(rounded.astype(np.float64)) is not None
