"""Compilation with the options that this code needs.

On CPU the fusion emitters of XLA compute shared sub-expressions over and over when a derivative of the plates is
compiled (measured with jax 0.10.2: 35 s and 9.6 s a call instead of 3 s and 0.08 s), so they are switched off
there. `tests/model/test_compiled.py` keeps an eye on it. What is called once or twice is not worth optimising.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

from walop_jax.model import kept_programs

Result = TypeVar("Result")
_kept: list[dict[Any, Any]] = []  # programs that came from disk, of every compiled function


def compiled(
    function: Callable[..., Result], *, fuse: bool = False, kept_as: str = ""
) -> Callable[..., Result]:
    """`jax.jit` with this package's options; the back end is looked up at the first call, not at import.

    A call with `once=True` compiles without optimisation: sooner ready, slower to run. `fuse` leaves the fusion
    emitters on, for a function without derivatives of the plates. `kept_as` is the name under which the traced program
    is kept between processes (`kept_programs`), for a function that depends on nothing but its arguments.
    """

    def options(once: bool) -> dict[str, Any] | None:
        on_cpu = jax.default_backend() == "cpu"
        chosen: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False} if on_cpu and not fuse else {}
        if once:
            chosen["xla_backend_optimization_level"] = 0
        return chosen or None

    @functools.cache
    def jitted(once: bool) -> Any:
        return jax.jit(function, compiler_options=options(once))

    programs: dict[Any, Any] = {}
    _kept.append(programs)

    def kept(args: tuple[Any, ...], once: bool) -> Any:
        """The program for arguments like these, from disk where it is there; None where none is kept."""
        here = kept_programs.folder()
        if here is None:
            return None
        leaves, tree = jax.tree.flatten(args)
        at = tree, tuple(kept_programs.kind(leaf) for leaf in leaves), once
        if at not in programs:
            programs[at] = kept_programs.program(here, kept_as, function, args, options(once))
        return programs[at]

    @functools.wraps(function)
    def call(*args: Any, once: bool = False) -> Result:
        run = (kept(args, once) if kept_as else None) or jitted(once)
        return run(*args)

    return call


def array(values: Any, kind: Any = None) -> jax.Array:
    """Known numbers as an array of JAX, for use outside of programs: `jnp.asarray` compiles one for each shape."""
    return values if isinstance(values, jax.Array) else jax.device_put(np.asarray(values, kind))


def forget_programs() -> None:
    """Give back the memory of all programs that JAX holds; what is called again is loaded or compiled anew.

    For a work that goes on with another model, whose programs are others: those of a large set take gigabytes.
    """
    for programs in _kept:
        programs.clear()
    jax.clear_caches()
    gc.collect()
    # What is given back in small pieces the GNU library keeps, gigabytes of it; others have no such function.
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def require_double_precision() -> None:
    """Raise RuntimeError, with the remedy, when float64 is switched off."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(
            "walop_jax computes in float64, which is switched off: call "
            'jax.config.update("jax_enable_x64", True) before anything else, or set JAX_ENABLE_X64=1.'
        )
