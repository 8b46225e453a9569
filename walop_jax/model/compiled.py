"""Compilation with the options that this code needs.

On CPU the fusion emitters of XLA compute shared sub-expressions over and over when a derivative of the plates is
compiled (measured with jax 0.10.2: 35 s and 9.6 s a call instead of 3 s and 0.08 s), so they are switched off
there. `tests/model/test_compiled.py` keeps an eye on it. What is called once or twice is not worth optimising.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax

Result = TypeVar("Result")


def compiled(function: Callable[..., Result], *, fuse: bool = False) -> Callable[..., Result]:
    """`jax.jit` with this package's options; the back end is looked up at the first call, not at import.

    A call with `once=True` compiles without optimisation: sooner ready, slower to run. `fuse` leaves the fusion
    emitters on, for a function without derivatives of the plates.
    """

    @functools.cache
    def jitted(once: bool) -> Any:
        on_cpu = jax.default_backend() == "cpu"
        options: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False} if on_cpu and not fuse else {}
        if once:
            options["xla_backend_optimization_level"] = 0
        return jax.jit(function, compiler_options=options or None)

    @functools.wraps(function)
    def call(*args: Any, once: bool = False) -> Result:
        return jitted(once)(*args)

    return call


def require_double_precision() -> None:
    """Raise RuntimeError, with the remedy, when float64 is switched off."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(
            "walop_jax computes in float64, which is switched off: call "
            'jax.config.update("jax_enable_x64", True) before anything else, or set JAX_ENABLE_X64=1.'
        )
