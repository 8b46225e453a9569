"""A calibration set and a model brought together: what a fit, a sampler or a diagnosis works on."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from walop_jax.data.records import CalibrationSet, Sources
from walop_jax.likelihood import engine
from walop_jax.likelihood.chunks import Chunks, median_counts
from walop_jax.likelihood.nodes import Nodes, accurate_nodes
from walop_jax.likelihood.passes import Part, Passes, threads_at_work
from walop_jax.likelihood.processes import Processes
from walop_jax.model.chebyshev import Rectangle
from walop_jax.model.compiled import require_double_precision
from walop_jax.model.effects.base import Effect, overridden
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.plan import Plan, plan_for, with_median
from walop_jax.model.specification import Model, make_model, optical_indices

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]

POINTS_PER_CHUNK = 256
LARGEST_CHUNK = 2_000_000  # intensities × local quantities that a chunk may hold
THINNEST = 1e-3  # deg: shortest side of a rectangle with nodes
LARGE_CHUNK = 1024  # field points of a chunk of a set that is interpolated: the engine divides it further
LARGE_ABOVE = 65536  # field points above which the matrix of a fit is computed as seldom as can be
INTERPOLATE_ABOVE = 4096  # field points: more than ten times the nodes that the optics need


@dataclasses.dataclass(frozen=True)
class Posterior:
    """χ² of data and priors at a point of parameter space, and its expansion there in the free parameters.

    `gradient` is half the gradient of the total and `matrix` half its Gauss–Newton Hessian, both with the
    errors of the data times `noise_scale`; `data` and `chi2` are with the errors as given. `loose` is the
    share of the weak pulls that are no prior knowledge; it is in the gradient and the matrix, not in
    `chi2`.
    """

    data: float
    priors: float
    loose: float
    noise_scale: float
    gradient: Vector
    matrix: Matrix

    @property
    def chi2(self) -> float:
        """Sum over data and priors."""
        return self.data + self.priors

    @property
    def objective(self) -> float:
        """What a fit minimises."""
        return self.data / self.noise_scale**2 + self.priors + self.loose


class _Census(NamedTuple):
    rows: Int[np.ndarray, " e"]
    field: Float[np.ndarray, 4]


class Problem:
    """The joint likelihood of one calibration set under one model.

    Field points are handled in chunks of equal size, so that a set larger than memory goes through the
    same code (`likelihood/chunks.py`), several of them at a time (`likelihood/passes.py`); a large set is shared
    with the other processes of `jax.distributed`, if there are any. Of more than `INTERPOLATE_ABOVE` points, `expand`,
    `slope` and `residuals` solve the optics on Chebyshev nodes only (`likelihood/nodes.py`); `optics_error` is what
    that has cost in accuracy so far. `passes.watch` is told how far a pass is, `passes.journal` keeps what is done.
    """

    def __init__(
        self,
        calset: CalibrationSet,
        model: Model,
        points_per_chunk: int | None = None,
        probes: tuple[Effect, ...] = (),
        interpolate: bool | None = None,
        memory: float | None = None,
    ) -> None:
        """`probes` are effects that are not in the model but whose columns will be asked for.

        `interpolate` says whether the optics are interpolated over the field; None leaves it to the size of the set.
        `memory` (bytes) is what the data of the points may take, None for the usual 2 GB.
        """
        require_double_precision()
        self.calset = calset
        self.model = model
        effects = (*model.template.effects, *probes)
        self.plan: Plan = plan_for(effects, calset.exposures, calset.filters, calset.sources)
        if any(effect.uses_median for effect in effects):
            self.plan = with_median(self.plan, median_counts(calset))
        self._mirrored = overridden(effects, "mirrored")
        n_points = len(calset.points)
        local = len(model.parameters) - len(model.template.throughput.coefficients.ravel()) + 4
        fits = max(1, LARGEST_CHUNK // (4 * len(calset.exposures) * local) * 4)
        self.interpolates = n_points > INTERPOLATE_ABOVE if interpolate is None else interpolate
        usual = LARGE_CHUNK if n_points > INTERPOLATE_ABOVE else min(POINTS_PER_CHUNK, fits)
        self.points_per_chunk = min(points_per_chunk or usual, n_points)
        self.chunks = Chunks(
            calset,
            self.plan,
            self.points_per_chunk,
            mirrored=self._mirrored,
            memory=memory,
            threads=threads_at_work(),
        )
        self.is_large = self.interpolates and n_points > LARGE_ABOVE
        processes = Processes.present() if self.is_large else Processes()
        self.passes = Passes(n_points, self.chunks.slab, processes=processes)
        self.optics_error = 0.0
        self._nodes_per_side: int | None = None
        self._census: _Census | None = None

    def _total(
        self,
        label: str,
        key: str | None,
        function: Callable[[engine.PointData], Sequence[Array]],
        shapes: Sequence[tuple[int, ...]],
    ) -> list[np.ndarray]:
        """Sums over all points of the arrays that `function` gives for a chunk, the points counted on the way."""

        def work(number: int) -> Part:
            chunks = self.chunks.of_slab(number)
            sums = np.zeros(sum(math.prod(shape) for shape in shapes))
            for chunk in chunks:
                sums += np.concatenate([sums[:0], *(np.ravel(array) for array in function(chunk))])
            used = np.concatenate([np.asarray(chunk.weight[..., 0]) > 0 for chunk in chunks])
            x, y = (np.concatenate([np.asarray(getattr(chunk, name)) for chunk in chunks]) for name in "xy")
            extent = np.stack([-x, x, -y, y])[:, used.any(axis=1)].max(axis=1, initial=-np.inf)
            return Part(np.concatenate([sums, used.sum(axis=0)]), extent)

        total = self.passes.total(label, key, work)
        *arrays, rows = np.split(total.sums, np.cumsum([math.prod(shape) for shape in shapes]))
        self._census = _Census(rows.astype(int), total.extent * np.array([-1.0, 1.0, -1.0, 1.0]))
        return [array.reshape(shape) for array, shape in zip(arrays, shapes, strict=True)]

    @cached_property
    def _rectangle(self) -> Rectangle:
        """The part of the field on which optics are needed; ghosts need those of the opposite points too."""
        xy = np.stack([self.calset.points.x, self.calset.points.y])
        low, high = xy.min(axis=1), xy.max(axis=1)
        if self._mirrored:
            low, high = np.minimum(low, -high), np.maximum(high, -low)
        thin = 0.5 * np.maximum(THINNEST - (high - low), 0.0)
        return Rectangle(low - thin, high + thin)

    def nodes(self, instrument: Instrument) -> Nodes | None:
        """The optics on nodes of the field, None where they are solved point by point."""
        if not self.interpolates:
            return None
        scale = np.array([p.scale for p in self.model.parameters])[list(optical_indices(instrument))]
        nodes, error = accurate_nodes(instrument, self.plan, self._rectangle, scale, self._nodes_per_side)
        if nodes is None:  # they oscillate over the field: no need to try again
            self.interpolates = False
            return None
        if np.isfinite(error):
            self._nodes_per_side, self.optics_error = nodes.per_side, max(self.optics_error, error)
        return nodes

    # -------------------------------------------------------------------------------------- the posterior

    @cached_property
    def _priors(self) -> tuple[Int[np.ndarray, " k"], Vector, Vector]:
        known = [
            (i, *p.prior)
            for i, p in enumerate(self.model.parameters)
            if p.prior is not None and p.tie is None
        ]
        index, mean, width = zip(*known, strict=True) if known else ((), (), ())
        return np.array(index, int), np.array(mean, float), np.array(width, float)

    @cached_property
    def _loose(self) -> Vector:
        """Inverse squared widths of the weak pulls, per parameter."""
        return np.array(
            [0.0 if p.loose is None or p.prior is not None else p.loose**-2 for p in self.model.parameters]
        )

    def expand(self, values: Vector, noise_scale: float = 1.0) -> Posterior:
        """χ² and its quadratic expansion at a full vector of parameter values.

        `noise_scale` multiplies the errors of the data (not the priors'): above 1 it stands for what the
        model cannot explain.
        """
        values = self._agreed(values)
        instrument, n = self.model.instrument(values), len(values)
        nodes = self.nodes(instrument)
        data, gradient, matrix = self._total(
            "χ², gradient and matrix",
            f"matrix {values.tobytes().hex()}",
            lambda chunk: engine.normal_equations(instrument, self.plan, chunk, nodes),
            ((), (n,), (n, n)),
        )
        matrix = matrix / noise_scale**2
        index, _, width = self._priors
        matrix[index, index] += width**-2
        matrix[np.diag_indices_from(matrix)] += self._loose
        select = self.model.selection()
        return self._posterior(values, float(data), gradient, noise_scale, select.T @ matrix @ select)

    def slope(self, values: Vector, near: Posterior) -> Posterior:
        """As `expand`, with the matrix of an expansion nearby: a third of the time, where optics are interpolated."""
        values = self._agreed(values)
        instrument, n = self.model.instrument(values), len(values)
        nodes = self.nodes(instrument)
        if nodes is None:
            return self.expand(values, near.noise_scale)
        data, gradient = self._total(
            "χ² and gradient",
            f"gradient {values.tobytes().hex()}",
            lambda chunk: engine.slope_equations(instrument, self.plan, chunk, nodes),
            ((), (n,)),
        )
        return self._posterior(values, float(data), gradient, near.noise_scale, near.matrix)

    def _agreed(self, values: Vector) -> Vector:
        return self.passes.processes.agreed("values", np.asarray(values, float))

    def _posterior(
        self,
        values: Vector,
        data: float,
        gradient: Vector,
        noise_scale: float,
        matrix: Float[np.ndarray, "free free"],
    ) -> Posterior:
        gradient = gradient / noise_scale**2
        index, mean, width = self._priors
        pull = (values[index] - mean) / width
        gradient[index] += pull / width
        away = values - self.model.start
        gradient += self._loose * away
        return Posterior(
            data=data,
            priors=float(pull @ pull),
            loose=float(self._loose @ away**2),
            noise_scale=noise_scale,
            gradient=self.model.selection().T @ gradient,
            matrix=matrix,
        )

    def residuals(self, values: Vector) -> tuple[Float[np.ndarray, "p e"], Float[np.ndarray, "p e 4"]]:
        """Best flux and normalised residuals (data − model)/σ of every (point, exposure); 0 where unused.

        All of them at once: for whole frames take a sample (`chunks.thinned`).
        """
        instrument = self.model.instrument(values)
        nodes = self.nodes(instrument)
        parts = [engine.residuals(instrument, self.plan, chunk, nodes) for chunk in self.chunks]
        flux = np.concatenate([np.asarray(part[0]) for part in parts])
        residual = np.concatenate([np.asarray(part[1]) for part in parts])
        return flux[: len(self.calset.points)], residual[: len(self.calset.points)]

    def jacobian(self, values: Vector) -> Float[np.ndarray, "d f"]:
        """Derivatives of the used residuals with respect to the free parameters, dense: for tables, not frames.

        Rows run over points, then exposures, then cameras, as in `residuals(values)[1][self.used]`.
        """
        instrument = self.model.instrument(values)
        select = self.model.selection()
        parts = [self._rows(engine.dense_jacobian(instrument, self.plan, c), c) @ select for c in self.chunks]
        return np.concatenate(parts)

    def effect_columns(self, values: Vector, probes: tuple[Effect, ...]) -> Float[np.ndarray, "d a"]:
        """Derivatives of the used residuals with respect to the amplitudes of neutral effects added to the model."""
        instrument = self.model.instrument(values)
        parts = [self._rows(engine.effect_columns(instrument, self.plan, probes, c), c) for c in self.chunks]
        return np.concatenate(parts)

    def effect_columns_over_shapes(
        self, values: Vector, probes: Sequence[Effect]
    ) -> Float[np.ndarray, "g d a"]:
        """As `effect_columns` for one effect at many shapes, all with the same discrete choices."""
        instrument = self.model.instrument(values)
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *probes)
        parts = []
        for chunk in self.chunks:
            cube = np.asarray(engine.effect_columns_over_shapes(instrument, self.plan, stacked, chunk))
            parts.append(np.stack([self._rows(one, chunk) for one in cube]))
        return np.concatenate(parts, axis=1)

    @staticmethod
    def _rows(columns: Array | np.ndarray, chunk: engine.PointData) -> Float[np.ndarray, "d n"]:
        used = np.asarray(chunk.weight[..., 0] > 0)
        cube = np.asarray(columns).reshape(*used.shape, 4, -1)
        return cube[used].reshape(-1, cube.shape[-1])

    def light(self, values: Vector) -> Float[np.ndarray, "p e 4"]:
        """Stokes vectors that enter the instrument, per unit flux."""
        instrument = self.model.instrument(values)
        parts = [np.asarray(engine.incoming(instrument, self.plan, chunk)) for chunk in self.chunks]
        return np.concatenate(parts)[: len(self.calset.points)]

    # ------------------------------------------------------------------------------------------- counting

    @cached_property
    def used(self) -> Bool[np.ndarray, "p e"]:
        """True where the four intensities of a (point, exposure) are used."""
        parts = [np.asarray(chunk.weight[..., 0]) > 0 for chunk in self.chunks]
        return np.concatenate(parts)[: len(self.calset.points)]

    def _counted(self) -> _Census:
        if self._census is None:  # the first pass counts; before that, one that does nothing else
            self._total("counting", "census", lambda _: (), ())
        if self._census is None:
            raise RuntimeError("a pass over the points has counted nothing")
        return self._census

    @property
    def rows_used(self) -> Int[np.ndarray, " e"]:
        """Number of points used in each exposure."""
        return self._counted().rows

    @property
    def field(self) -> tuple[float, float, float, float]:
        """Smallest and largest x, smallest and largest y (deg) of the points that are used in any exposure."""
        low_x, high_x, low_y, high_y = self._counted().field.tolist()
        return low_x, high_x, low_y, high_y

    @property
    def n_data(self) -> int:
        """Number of intensities used."""
        return 4 * int(self.rows_used.sum())

    @property
    def dof(self) -> int:
        """Three per used row (four when the flux is known), one per prior, minus the free parameters."""
        per_row = np.where(np.asarray(self.plan.exposures.flux_known), 4, 3)
        free = set(self.model.free.tolist())
        priors = sum(1 for i in self._priors[0] if int(i) in free)
        return int(self.rows_used @ per_row) + priors - len(free)


def standard_names(sources: Sources) -> tuple[str, ...]:
    """Unique names of the standards, usable in parameter names."""
    names: list[str] = []
    for number, name in zip(sources.source, sources.name, strict=True):
        clean = "".join(c if c.isalnum() else "_" for c in str(name).strip()) or f"source{number}"
        names.append(clean if clean not in names else f"{clean}_{number}")
    return tuple(names)


def has_known_flux(calset: CalibrationSet) -> bool:
    """Whether any exposure is of KIND `flux`, so that the overall scale of the throughput is measured."""
    return bool((calset.exposures.kind == "flux").any())


def base_model(calset: CalibrationSet, *, plates: str = "waves", throughput_degree: int = 4) -> Model:
    """The base model (docs: model) for the instrument and standards of a calibration set.

    The scale of the throughput is a gauge unless a flux is known, and the constant of camera N0 is held then.
    """
    names = standard_names(calset.sources)
    sources = calset.sources
    level = _throughput_level(calset) if has_known_flux(calset) else 0.5
    instrument = nominal_instrument(
        calset.instrument,
        standards=list(zip(names, sources.q, sources.u, strict=True)),
        plates=plates,
        throughput_degree=throughput_degree,
        throughput=level,
    )
    priors = {}
    for i, name in enumerate(names):
        priors[f"standard.{name}.q"] = (float(sources.q[i]), float(sources.q_err[i]))
        priors[f"standard.{name}.u"] = (float(sources.u[i]), float(sources.u_err[i]))
    model = make_model(calset.instrument, instrument, priors=priors)
    for name in model.names:
        if name.startswith("throughput."):
            p = model[name]
            model = model.change(name, scale=p.scale * level / 0.5, loose=level)
    if not has_known_flux(calset):
        model = model.change("throughput.n0.p00", free=False)
    if not ((calset.exposures.kind == "moon") & ~calset.exposures.clp_in).any():
        model = model.change("sky.depolarisation", free=False)
    return model


def _throughput_level(calset: CalibrationSet) -> float:
    # A camera gets half of the unpolarised light: N = T/2. One slab of points is enough for a start value.
    block = calset.intensities.block(0, min(256, len(calset.points)))
    rows = block.used & (calset.exposures.kind == "flux")
    return float(2.0 * block.counts[rows].mean())
