"""The forward model of a calibration set as pure functions of JAX: counts, residuals, densities.

    χ²(θ) = Σ ((N − F a(θ)) / σ)²,    ln L = −χ² / 2,    ln p = −½ Σ ((θ − μ) / s)²

Where the errors σ have parameters, ln L has the other terms of `likelihood/noise.py` as well.

Symbols     θ parameters of the model, in its order and units; N ± σ used intensities (electrons); a(θ) counts for light
            of unit flux (`model.light`), through the detectors where their response is not linear; F flux of each
            (point, exposure), the one that fits best (`likelihood.flux`); μ, s mean and width of a prior
Gauges      constants are left out of the densities. A free parameter without a prior may have a weak pull to its start
            value, which keeps undetermined parameters from running away; it is part of ln p, as in a fit
Ties        a tied parameter has the value of its master, whatever stands in its place
Derivatives in any mode and order; the optics by the rule of `likelihood.optics`. Points are worked on in batches, in a
            scan; χ² of a batch comes with its gradient, so that the memory of a gradient is that of one batch
Precision   float64, of arguments as well: rounded to float32 a thickness of 1930 µm is off by up to 10⁻⁴ µm, and JAX
            gives a gradient the precision of its argument
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from walop_jax.data.records import CalibrationSet
from walop_jax.likelihood import engine, limits
from walop_jax.likelihood.engine import PointData
from walop_jax.likelihood.layout import Layout, PointReader
from walop_jax.likelihood.likelihood import PriorRows, prior_rows
from walop_jax.likelihood.noise import NoiseTerms, log_variance, variance_ratio
from walop_jax.model.compiled import array, need_float64
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import check_names, values_of, with_values
from walop_jax.model.plan import Plan
from walop_jax.model.specification import Model

Values = Float[Any, " n"]

WHAT = "the forward model"  # in messages


def program(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of `Forward` as a program of JAX, compiled at its first call for arguments of one structure and shape.

    Later calls run it: in milliseconds, also below `jax.grad` or `jax.vmap` alone. Within a `jax.jit` of the caller it
    is a part of the caller's program. Raises TypeError for arguments in float32.
    """
    run = jax.jit(method, inline=True)

    @functools.wraps(method)
    def call(self: Forward, values: Any, *further: Any, **options: Any) -> Any:
        need_float64(WHAT)
        refuse_float32((self, values, further, options))
        if not isinstance(values, Instrument):
            values = jnp.asarray(values, float)
        return run(self, values, *further, **options)

    return call


def refuse_float32(arguments: Any) -> None:
    """Raise TypeError, with the remedy, where a number in a tree of arguments is a float of less than 64 bits."""
    kinds = {
        dtype for leaf in jax.tree.leaves(arguments) if (dtype := getattr(leaf, "dtype", None)) is not None
    }
    less = sorted(str(kind) for kind in kinds if jnp.issubdtype(kind, jnp.floating) and kind != jnp.float64)
    if less:
        raise TypeError(
            f"{WHAT} is computed in float64 and was given numbers in {less[0]}: a thickness of 1930 um is then off by "
            "up to 1e-4 um, and JAX would round the gradient as well; give jnp.asarray(values, jnp.float64), and "
            "differentiate with respect to that"
        )


class Forward(eqx.Module):
    """Counts, residuals and densities of one calibration set under one model; every array is a leaf.

    Methods take the vector of all parameters in the order of `names`, or an `Instrument`, and compose with `jax.jit`,
    `grad`, `jacfwd`, `jacrev`, `hessian` and `vmap`. Each is compiled at its first call, which takes seconds, and runs
    in milliseconds from the second one on. Points, exposures and cameras are in the order of the set.

    >>> forward = walop.forward(calset)
    >>> forward.counts(forward.start).shape  # point, exposure, camera
    (29, 14, 4)
    """

    template: Instrument
    plan: Plan
    data: PointData  # with leading axes (batch, point)
    used: Int[Array, " d"]
    master: Int[Array, " n"]
    free: Int[Array, " f"]
    start: Values
    prior: tuple[Int[Array, " k"], Float[Array, " k"], Float[Array, " k"]]
    noise_terms: NoiseTerms | None
    names: tuple[str, ...] = eqx.field(static=True)
    shape: tuple[int, int, int] = eqx.field(static=True)

    @classmethod
    def of(cls, calset: CalibrationSet, model: Model, batch: int | None = None) -> Forward:
        """The forward model of a set that fits into memory, `batch` points at a time (None: by the kind of machine).

        Raises RuntimeError when float64 is switched off, as the methods do: compiled programs keep their precision.
        """
        need_float64(WHAT)
        if batch is None:
            on_cpu = jax.default_backend() == "cpu"
            batch = limits.FORWARD_BATCH if on_cpu else limits.ACCELERATOR_BATCH
        layout = Layout.of(calset, model, batch=batch, interpolate=False)
        reader = PointReader(calset, layout.plan, model.template, layout.mirrored)
        batches = reader.batches(0, layout.points, layout.batch)
        data = jax.tree.map(lambda *parts: array(np.stack(parts)), *batches)
        rows: PriorRows = prior_rows(model)
        return cls(
            template=model.template,
            plan=layout.plan,
            data=data,
            used=array(np.flatnonzero(np.asarray(data.weight))),
            master=array(model.masters),
            free=array(model.free),
            start=array(model.start),
            prior=(array(rows.index), array(rows.mean), array(rows.width)),
            noise_terms=None if model.template.noise is None else NoiseTerms(*map(array, reader.noise_terms)),
            names=model.names,
            shape=(layout.points, len(calset.exposures), calset.cameras),
        )

    def __getattribute__(self, name: str) -> Any:
        # Methods of Equinox modules are trees, which `jax.jit` cannot hash; these are plain methods.
        return object.__getattribute__(self, name)

    def __repr__(self) -> str:
        points, exposures, cameras = self.shape
        return (
            f"Forward model of {self.template.name}: {len(self.names)} parameters, {len(self.free)} free; "
            f"{points} points, {exposures} exposures, {cameras} cameras, {len(self.used)} used intensities"
        )

    # ----------------------------------------------------------------------------------------- vectors

    def named(self, values: Values) -> dict[str, Float[Array, ""]]:
        """The values by the names of their parameters."""
        return dict(zip(self.names, values, strict=True))

    def values(self, named: Mapping[str, Any]) -> Values:
        """All values from some by name, the others at their start.

        Raises ValueError, with the nearest names, for one that does not exist.
        """
        check_names("parameter", named, self.names)
        need_float64(WHAT)
        refuse_float32(dict(named))
        index = [self.names.index(name) for name in named]
        return self._tied(self.start.at[np.array(index, int)].set(jnp.array(list(named.values()), float)))

    def full(self, free: Float[Any, " f"]) -> Values:
        """All values from those of the free parameters."""
        need_float64(WHAT)
        refuse_float32((self, free))
        return self._tied(self.start.at[self.free].set(jnp.asarray(free, float)))

    def _tied(self, values: Values) -> Values:
        need_float64(WHAT)
        return jnp.asarray(values, float)[self.master]

    def instrument(self, values: Values) -> Instrument:
        """The instrument with these values in the place of its parameters."""
        refuse_float32((self, values))
        return with_values(self.template)(self._tied(values))

    # ------------------------------------------------------------------------------------ measurements

    @program
    def counts(
        self, values: Values | Instrument, flux: Float[Any, "p e *f"] | None = None
    ) -> Float[Array, "p e k"]:
        """Counts (electrons) of every camera, for a flux (electrons per unit of unpolarised light) or the best one.

        A flux is that of all cameras, or has an axis of their groups as in `flux`. With the best flux they are 0 where
        no intensity is used.
        """
        if flux is not None:
            flux = jnp.asarray(flux, float)
            flux = self._batched(flux if flux.ndim > 2 else flux[..., None])

        def of(point: PointData, flux: Array | None) -> Array:
            instrument, unit = self._unit(values, point)
            if flux is None:
                flux = engine.best_flux(instrument, self.plan, unit, self._with_errors(instrument, point)[0])
            return engine.detected_counts(instrument, self.plan, unit, flux, point)

        return self._whole(jax.lax.map(lambda part: jax.vmap(of)(*part), (self.data, flux)))

    @program
    def flux(self, values: Values | Instrument) -> Float[Array, "p e f"]:
        """Best flux of every (point, exposure), one for each group of cameras that has one in common."""

        def of(point: PointData) -> Array:
            instrument, unit = self._unit(values, point)
            return engine.best_flux(instrument, self.plan, unit, self._with_errors(instrument, point)[0])

        return self._whole(jax.lax.map(jax.vmap(of), self.data))

    @program
    def residuals(self, values: Values | Instrument) -> Float[Array, " d"]:
        """(measured − model) / error of the used intensities, fluxes eliminated; by point, exposure, camera."""
        residuals = jax.lax.map(lambda part: self._residuals(values, part), self.data)
        return residuals.reshape(-1)[self.used]

    # ----------------------------------------------------------------------------------------- densities

    @program
    def chi2(self, values: Values | Instrument) -> Float[Array, ""]:
        """Sum of the squared residuals."""
        return engine.summed(lambda data: _chi2(dataclasses.replace(self, data=data), values), self.data)

    @program
    def log_variance(self, values: Values | Instrument) -> Float[Array, ""]:
        """What −2 ln L has beside χ² where errors of the data have parameters; 0 where they are as stated."""
        if self.noise_terms is None:
            return jnp.zeros(())
        return engine.summed(lambda data: self._log_variance(values, data), self.data)

    @program
    def log_likelihood(self, values: Values | Instrument) -> Float[Array, ""]:
        """−χ²/2 of the data; with the other terms of the density where their errors have parameters."""
        if self.noise_terms is None:
            return -0.5 * self.chi2(values)
        deviance = engine.summed(
            lambda data: _deviance(dataclasses.replace(self, data=data), values), self.data
        )
        return -0.5 * deviance

    @program
    def log_prior(self, values: Values) -> Float[Array, ""]:
        """Logarithm of the prior of the free parameters, weak pulls included, without its constant."""
        index, mean, width = self.prior
        return -0.5 * jnp.sum(((self._tied(values)[index] - mean) / width) ** 2)

    @program
    def log_density(self, values: Values) -> Float[Array, ""]:
        """Logarithm of the posterior density, without its constant."""
        return self.log_likelihood(values) + self.log_prior(values)

    # --------------------------------------------------------------------------------------- point by point

    def _unit(self, values: Values | Instrument, point: PointData) -> tuple[Instrument, Float[Array, "e k"]]:
        """The instrument, and the counts of a point for light of unit flux."""
        need_float64(WHAT)
        if isinstance(values, Instrument):
            instrument, base, vector = values, values, values_of(values)
        else:  # the template has no slopes of its own: those of the parameters are in the vector alone
            base, vector = self.template, self._tied(values)
            instrument = with_values(base)(vector)
        rows = engine.rows_at(vector, base, self.plan, point)
        throughput = engine.throughput_at(instrument, point)
        return instrument, engine.unit_counts(instrument, self.plan, rows, throughput, point)

    def _residuals(self, values: Values | Instrument, data: PointData) -> Float[Array, "m e k"]:
        def of(point: PointData) -> Array:
            instrument, unit = self._unit(values, point)
            return engine.residuals_of(instrument, self.plan, unit, self._with_errors(instrument, point)[0])[
                1
            ]

        return jax.vmap(of)(data)

    def _with_errors(self, instrument: Instrument, point: PointData) -> tuple[PointData, Float[Any, "e k"]]:
        """A point with the errors of the noise terms of an instrument, and σ²/N_ERR² of its intensities."""
        if instrument.noise is None or self.noise_terms is None:
            return point, jnp.ones_like(point.weight)
        ratio = variance_ratio(instrument.noise, self.noise_terms, point.counts, point.weight)
        return point._replace(weight=point.weight / jnp.sqrt(ratio)), ratio

    def _log_variance(self, values: Values | Instrument, data: PointData) -> Float[Array, ""]:
        """Sum over the points of a batch."""

        def of(point: PointData) -> Array:
            instrument, unit = self._unit(values, point)
            point, ratio = self._with_errors(instrument, point)
            shared = engine.flux_groups(instrument, self.plan)
            return jnp.sum(log_variance(ratio, unit * point.weight, self.plan.exposures.flux_known, shared))

        return jnp.sum(jax.vmap(of)(data))

    def _whole(self, batches: Float[Array, "c m e k"]) -> Float[Array, "p e k"]:
        """All points, without those that fill up the last batch."""
        return batches.reshape(-1, *batches.shape[2:])[: self.shape[0]]

    def _batched(self, points: Float[Array, "p e f"]) -> Float[Array, "c m e f"]:
        batches, size = self.data.x.shape
        filled = jnp.concatenate([points, jnp.repeat(points[-1:], batches * size - len(points), axis=0)])
        return filled.reshape(batches, size, *points.shape[1:])


def _with_its_gradient(function: Callable[[Forward, Any], Array]) -> Callable[[Forward, Any], Array]:
    """The function of a batch and of values, made together with its gradient where it is differentiated.

    The gradient comes by reverse differentiation, and nothing is computed twice.
    """
    made = jax.custom_jvp(function)

    def with_gradient(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
        leaves, tree = jax.tree.flatten(primals)
        steps = jax.tree.leaves(tangents, is_leaf=lambda leaf: isinstance(leaf, SymbolicZero))
        moving = [n for n, step in enumerate(steps) if not isinstance(step, SymbolicZero)]

        def value_at(moved: list[Array]) -> Array:
            at = dict(zip(moving, moved, strict=True))
            return function(*tree.unflatten([at.get(n, leaf) for n, leaf in enumerate(leaves)]))

        # Another reverse pass, for second derivatives, keeps the inputs of a batch alone.
        value, gradient = jax.checkpoint(jax.value_and_grad(value_at))([leaves[n] for n in moving])
        changes = [jnp.vdot(slope, steps[n]) for n, slope in zip(moving, gradient, strict=True)]
        return value, sum(changes, jnp.zeros_like(value))

    made.defjvp(with_gradient, symbolic_zeros=True)
    return made


@_with_its_gradient
def _chi2(batch: Forward, values: Values | Instrument) -> Float[Array, ""]:
    """χ² of the points of a batch."""
    return jnp.sum(batch._residuals(values, batch.data) ** 2)


@_with_its_gradient
def _deviance(batch: Forward, values: Values | Instrument) -> Float[Array, ""]:
    """−2 ln L of the points of a batch."""
    chi2 = jnp.sum(batch._residuals(values, batch.data) ** 2)
    return chi2 + batch._log_variance(values, batch.data)
