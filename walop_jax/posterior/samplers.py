"""The interface of a sampler, the density that it samples, and the samplers by name.

A sampler is a class with a name and two methods. Independent ensembles of it (of one walker or of many) are started and
taken further, stretch by stretch, by `Ensembles`, which also judges convergence. A sampler of
one's own is one file, given by its place (`my_sampler.py:MySampler`) or in Python (`Options(sampler=MySampler())`).
"""

from __future__ import annotations

import abc
import dataclasses
import importlib
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.io.code import classes_of
from walop_jax.io.errors import fail, nearest
from walop_jax.model.compiled import compiled

SAMPLERS = {
    "emcee": "walop_jax.posterior.emcee:Emcee",
    "nuts": "walop_jax.posterior.nuts:Nuts",
    "bootstrap": "walop_jax.posterior.bootstrap:Bootstrap",
}
"""One line for each sampler: its name, and module and class."""

Positions = Float[np.ndarray, "n k"]
Batch = Callable[[Positions], Float[np.ndarray, " n"]]

EnsembleState = Mapping[str, Any]  # all there is to an ensemble between two steps, by name


@dataclasses.dataclass(frozen=True)
class Density:
    """ln p, up to a constant, of `dimension` coordinates; near the fit they are independent with width 1.

    `function` gives ln p of one position as a JAX scalar; it takes `arrays` after the position, which keeps data out of
    compiled code. `batch`, where there is one, is a faster `log_density`.
    """

    dimension: int
    function: Callable[..., Array]
    arrays: tuple[Any, ...] = ()
    batch: Batch | None = None

    @cached_property
    def _one(self) -> Callable[..., Array]:
        return compiled(self.function)

    @cached_property
    def _one_with_gradient(self) -> Callable[..., tuple[Array, Array]]:
        return compiled(jax.value_and_grad(self.function))

    def log_density(self, positions: Positions) -> Float[np.ndarray, " n"]:
        """Return ln p of every position; −inf where it is not finite."""
        if self.batch is not None:
            return self.batch(positions)
        value = np.array([float(self._one(jnp.asarray(p), *self.arrays)) for p in positions])
        return np.where(np.isfinite(value), value, -np.inf)

    def value_and_gradient(self, position: Float[np.ndarray, " k"]) -> tuple[float, Float[np.ndarray, " k"]]:
        """Return ln p of one position and its gradient."""
        value, gradient = self._one_with_gradient(jnp.asarray(position), *self.arrays)
        return float(value), np.asarray(gradient)


class Stretch(NamedTuple):
    """Result of a number of steps: positions, their ln p, and the fraction of proposals accepted.

    `counts` are numbers that the sampler wants to be reported, summed over all stretches.
    """

    positions: Float[np.ndarray, "n w k"]
    log_density: Float[np.ndarray, "n w"]
    acceptance: Float[np.ndarray, "n w"]
    counts: Mapping[str, int] = {}


class Sampler(abc.ABC):
    """A way of drawing from a density; `Emcee` is one.

    A sampler that is not `exact` is given the surrogate, in which throughput coefficients and catalogue values are
    marginalised; an `exact` one the posterior of all free parameters. `software` are the packages whose versions its
    draws depend on; every `thin`-th of its steps is stored, unless something else is asked for. A sampler that
    `resumes` goes on with the chain of an interrupted run; others start anew. One that `repeats_the_fit` on simulated
    sets has no density and no chains (`posterior.bootstrap`).

    The same state and number of steps must always give the same stretch, whatever has been computed before: random
    numbers come from the state.
    """

    name: ClassVar[str]
    exact: ClassVar[bool] = False
    software: ClassVar[tuple[str, ...]] = ()
    thin: ClassVar[int] = 1
    resumes: ClassVar[bool] = False
    repeats_the_fit: ClassVar[bool] = False

    @abc.abstractmethod
    def start(self, density: Density, seed: Sequence[int]) -> EnsembleState:
        """Return an ensemble before its first step; `seed` as `numpy.random.default_rng` takes it."""

    @abc.abstractmethod
    def advance(self, density: Density, state: EnsembleState, steps: int) -> tuple[EnsembleState, Stretch]:
        """Return the ensemble after `steps` more steps, and their results."""


def make_sampler(
    sampler: str | Sampler | type[Sampler], settings: Mapping[str, Any] | None = None
) -> Sampler:
    """Return a sampler by its name, its class or `FILE.py:CLASS`; a `Sampler` comes back as it is.

    `settings` are arguments of its class. Raises `DataError` for a name or a file that does not exist, for a class that
    is no `Sampler`, and for settings that the sampler does not have.
    """
    settings = settings or {}
    if isinstance(sampler, Sampler):
        _check_settings(type(sampler), settings, given=True)
        return sampler
    if isinstance(sampler, type):
        kind = sampler
    elif ".py:" in sampler:
        file, name = sampler.rsplit(":", 1)
        kinds = classes_of(file, Sampler, "give a sampler as FILE.py:CLASS")
        if name not in kinds:
            raise fail(f"has no sampler {name!r}", file=file, advice=nearest(name, kinds))
        kind = kinds[name]
    elif sampler in SAMPLERS:
        module, name = SAMPLERS[sampler].split(":")
        kind = getattr(importlib.import_module(module), name)
    else:
        advice = f"choose one of {', '.join(SAMPLERS)}, or give your own as FILE.py:CLASS"
        raise fail(f"there is no sampler {sampler!r}", advice=advice)
    if not isinstance(getattr(kind, "name", None), str):
        raise fail(f"the sampler {sampler!r} has no name", advice='write name = "…" into its class')
    _check_settings(kind, settings)
    try:
        return kind(**settings)
    except TypeError as error:
        raise fail(f"the sampler {sampler!r} cannot be made: {error}", advice="look at its class") from error


def _check_settings(kind: type[Sampler], settings: Mapping[str, Any], given: bool = False) -> None:
    setting_names = {f.name for f in dataclasses.fields(kind)} if dataclasses.is_dataclass(kind) else set()
    unknown = list(settings) if given else [name for name in settings if name not in setting_names]
    if unknown:
        advice = "set it in the sampler that you give" if given else "leave it out"
        raise fail(f"{unknown[0]!r} is no option of the sampler {kind.name!r}", advice=advice)
