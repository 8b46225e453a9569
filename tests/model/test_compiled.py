"""Compilation: the derivative of the optics must stay clear of the trap of XLA's fusion emitters."""

import pickle
import time
import types
from pathlib import Path

import builders
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import walop_jax
from walop_jax.data.settings import builtin_filter
from walop_jax.model import light
from walop_jax.model.compiled import compiled, knows
from walop_jax.model.dependence import optical_indices
from walop_jax.model.parameters import as_number, values_of, with_values

POINTS = 144


@pytest.fixture
def no_cache():
    """Compile for real: nothing is taken from the cache of compiled code."""
    jax.config.update("jax_enable_compilation_cache", False)
    yield
    jax.config.update("jax_enable_compilation_cache", True)


@pytest.mark.usefixtures("no_cache")
def test_jacobian_of_the_optics_compiles_and_runs_quickly():
    """144 points, SDSS-r, all optical parameters, in seconds of processor time.

    The trap cost 35 s to compile and 9.6 s a call when the plates were solved one by one; solved together, as
    they are now, the emitters cost 10 s against 5 s, as much per call (jax 0.10.2). Bounds leave room
    for a slower machine and would notice the trap if a change brings it back.
    """
    instrument = builders.south()
    plan = builders.setting_plan(builtin_filter("SDSS-r"))
    values, to_instrument = values_of(instrument), with_values(instrument)
    optical = np.asarray(optical_indices(instrument), int)

    def rows(some, x, y):
        return light.band_rows(to_instrument(values.at[optical].set(some)), plan, x, y)

    jacobian = compiled(jax.vmap(jax.jacfwd(rows), in_axes=(None, 0, 0)))
    grid = np.linspace(-0.29, 0.29, 12)
    x, y = (jnp.asarray(v.ravel()) for v in np.meshgrid(grid, grid))
    start = time.process_time()
    jax.block_until_ready(jacobian(values[optical], x, y))
    first = time.process_time() - start
    start = time.process_time()
    found = jax.block_until_ready(jacobian(values[optical], x, y))
    again = time.process_time() - start
    assert found.shape == (POINTS, 1, 4, 4, optical.size)
    assert first < 20.0
    assert again < 2.5


def test_compiled_is_the_function_itself():
    def area(a, b):
        """What a rectangle covers."""
        return a * b

    quick = compiled(area)
    assert float(quick(jnp.asarray(3.0), jnp.asarray(2.0))) == 6.0
    assert (quick.__name__, quick.__doc__) == ("area", "What a rectangle covers.")


class Amount(eqx.Module):
    """Work that is asked for."""

    work: int


@pytest.mark.parametrize(("works", "programs"), [((100, 1), 1), ((1, 100), 2), ((1, 2), 1)])
def test_an_optimised_program_serves_little_work_as_well(monkeypatch, works, programs):
    """What is there already is not compiled a second time without optimisation."""
    made, jit = [], jax.jit

    def counted(function, **options):
        made.append(options)
        return jit(function, **options)

    doubled = compiled(lambda amount, x: 2.0 * x, optimised_above=10)
    knows("xla_cpu_use_fusion_emitters")  # asked once in a process, by a program of its own
    monkeypatch.setattr(jax, "jit", counted)
    assert [float(doubled(Amount(work), jnp.arange(3.0))[1]) for work in works] == [2.0, 2.0]
    assert len(made) == programs


def test_methods_of_components_are_plain():
    """Equinox makes a tree of every method that is asked for, which took a tenth of the time of a second fit."""
    instrument = builders.south()
    for one in (instrument, pickle.loads(pickle.dumps(instrument))):
        assert isinstance(one.patched, types.MethodType)


def test_numbers_that_are_arrays_already_stay():
    number = jnp.asarray(1.5, float)
    assert as_number(number) is number
    assert not as_number(jnp.asarray(1.5)).weak_type
    assert as_number(2).dtype == np.float64


def test_an_option_that_xla_does_not_have_is_noticed():
    """Versions of XLA drop options, and refuse to compile with one that they do not know."""
    assert knows("xla_cpu_enable_fast_math")
    assert not knows("xla_of_another_day")


def test_programs_of_a_session_stay():
    """The caches of JAX belong to the session: what a user has compiled is there after any work of the package."""
    package = Path(walop_jax.__file__).parent
    clearing = [p.name for p in package.rglob("*.py") if "clear_caches" in p.read_text(encoding="utf-8")]
    assert clearing == []
