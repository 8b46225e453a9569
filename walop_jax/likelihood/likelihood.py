"""A calibration set and a model combined: the basis of fits, samplers and diagnoses."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from walop_jax.data.records import CalibrationSet
from walop_jax.io.display import ShortDir
from walop_jax.io.shapes import Matrix, Vector
from walop_jax.likelihood import engine
from walop_jax.likelihood.field_table import FieldTable, accurate_nodes
from walop_jax.likelihood.flux import FluxGroups
from walop_jax.likelihood.inverses import determined
from walop_jax.likelihood.layout import (
    Layout,
    MeasuredPoints,
    PointReader,
    curves_of,
    fields_of_stars,
)
from walop_jax.likelihood.noise import log_variance, noise_expansion, variance_ratio
from walop_jax.likelihood.optics import directions
from walop_jax.likelihood.runner import Runner
from walop_jax.model.compiled import array
from walop_jax.model.effects.base import Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.noise import NOISE
from walop_jax.model.plan import Plan
from walop_jax.model.planning import outgrown
from walop_jax.model.specification import Model


class UsedData(NamedTuple):
    """How much of a set is used, and where in the field: what degrees of freedom and maps are counted from.

    `rows` is the number of field points used in each exposure; `field` the smallest and largest x, then the smallest
    and largest y (deg), of the points that are used in any exposure; `cameras` the number of cameras. Ten points in
    two exposures of four cameras are rows (10, 10), that is 80 intensities.
    """

    rows: Int[np.ndarray, " e"]
    field: tuple[float, float, float, float]
    cameras: int

    @property
    def n_data(self) -> int:
        """Number of intensities used."""
        return self.cameras * int(self.rows.sum())

    def joined(self, other: UsedData) -> UsedData:
        """The counts of two parts of a set, added, and the rectangle around both fields."""
        (a, b, c, d), (e, f, g, h) = self.field, other.field
        return UsedData(self.rows + other.rows, (min(a, e), max(b, f), min(c, g), max(d, h)), self.cameras)


class DataTerms(NamedTuple):
    """χ² of the data, its half gradient and Gauss–Newton matrix in all parameters, no priors; and which data were used.

    Where errors of the data have parameters, `log_variance` is the rest of −2 ln L (`noise.log_variance`), and gradient
    and matrix hold its part.
    """

    data: float
    gradient: Vector
    matrix: Matrix
    used_data: UsedData
    log_variance: float = 0.0

    def joined(self, other: DataTerms) -> DataTerms:
        """The terms of two parts of a set."""
        a, b, used_data = self, other, self.used_data.joined(other.used_data)
        log_variance = a.log_variance + b.log_variance
        return DataTerms(
            a.data + b.data, a.gradient + b.gradient, a.matrix + b.matrix, used_data, log_variance
        )


Joined = TypeVar("Joined", UsedData, DataTerms)


class OpticsUsed(NamedTuple):
    """Sampling of the optics: so many nodes per side, with that error between them; None: point by point."""

    nodes_per_side: int | None
    error: float = 0.0


@dataclasses.dataclass(frozen=True, repr=False)
class Expansion:
    """χ² of data and priors at a point of parameter space, and its expansion there in the free parameters.

    `gradient` is half the gradient of the total and `matrix` half its Gauss–Newton Hessian, both with the
    errors of the data times `noise_scale`; `data` and `chi2` are with the errors as given. `loose` is the
    sum over the weak pulls, which are no prior knowledge; it is in the gradient and the matrix, not in
    `chi2`. `log_variance` is what −2 ln L has beside `chi2` where errors of the data have parameters (χ² is with the
    errors that these make), 0 where all errors are as stated. `dof` counts the independent data of every used row
    (`Likelihood.data_per_row`), one per prior, less the parameters that these determine (`determined`).
    """

    data: float
    priors: float
    loose: float
    noise_scale: float
    gradient: Vector
    matrix: Matrix
    used_data: UsedData
    dof: int
    optics: OpticsUsed
    log_variance: float = 0.0

    def __repr__(self) -> str:
        sums = f"χ² = {self.data:.7g} of the data + {self.priors:.4g} of priors"
        return f"Expansion: {sums}, {self.dof} degrees of freedom, {len(self.gradient)} free parameters"

    @property
    def chi2(self) -> float:
        """χ² of data and priors, with the errors of the data as given."""
        return self.data + self.priors

    @property
    def misfit(self) -> float:
        """χ² of the data with their errors as given, per degree of freedom."""
        return self.data / max(self.dof, 1)

    @property
    def objective(self) -> float:
        """The number that a fit minimises: −2 ln of the posterior density, without its constant."""
        return self.data / self.noise_scale**2 + self.log_variance + self.priors + self.loose

    @property
    def n_data(self) -> int:
        """Number of intensities used."""
        return self.used_data.n_data


@dataclasses.dataclass(frozen=True)
class PriorRows:
    """Rows (θ − mean) / width of the parameters at `index`; rows that are not `known` are weak pulls.

    A free parameter has one row: its prior if it has one, else the weak pull to its start value if it has that. A fixed
    parameter has no row, for it does not vary. A tied parameter has no row either: its value is the value of its
    master, whose prior is counted once. The magnification 15.63 ± 0.05 of a pupil has the row (θ − 15.63)/0.05.
    """

    index: Int[np.ndarray, " k"]
    mean: Float[np.ndarray, " k"]
    width: Float[np.ndarray, " k"]
    known: Bool[np.ndarray, " k"]

    def __len__(self) -> int:
        return len(self.index)

    def residuals(self, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " k"]:
        """The rows (k) at a full vector of values (n)."""
        return (values[self.index] - self.mean) / self.width

    def jacobian(self, selection: Float[np.ndarray, "n f"]) -> Float[np.ndarray, "k f"]:
        """Derivatives (k, f) of the rows in the free parameters; `selection` is `Model.selection`."""
        return selection[self.index] / self.width[:, None]


def prior_rows(model: Model) -> PriorRows:
    """The rows of all priors and weak pulls of the free parameters of a model."""
    rows = []
    for i in model.free.tolist():
        p = model.parameters[i]
        if p.prior is not None:
            rows.append((i, *p.prior, True))
        elif p.loose is not None:
            rows.append((i, p.start, p.loose, False))
    index, mean, width, known = zip(*rows, strict=True) if rows else ((),) * 4
    at, is_known = np.array(index, int), np.array(known, bool)
    return PriorRows(at, np.array(mean, float), np.array(width, float), is_known)


def of_rows(
    held: Float[np.ndarray, "p e k"] | None, rows: slice, count: int
) -> Float[np.ndarray, "b e k"] | None:
    """Numbers of the points of a batch, filled up with zeros to `count` points; None where there are none."""
    if held is None:
        return None
    own = held[rows]
    return np.concatenate([own, np.zeros((count - len(own), *own.shape[1:]))])


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Likelihood(ShortDir):
    """The joint likelihood of one calibration set under one model.

    Field points are handled in batches of equal size (`likelihood/layout.py`), several of them at a time
    (`likelihood/runner.py`). Where `layout` says so, `expand` and `residuals` solve the optics on Chebyshev nodes only
    (`likelihood/field_table.py`). Immutable: what a pass finds out beside its sums comes back with them (`Expansion`).

    Errors of the data that have parameters (`model.noise`) are those of the values that a method is given, unless
    `errors_at` says at which values (a full vector) they are held: a fit hands on its likelihood with errors as fitted.
    `taken` is the part of every intensity that the other parameters take up (`noise`), None: they take up none;
    `light` is F u/N_ERR of all intensities where a search holds it, None: that of the values.

    >>> values, residual = result.likelihood.residuals(result.values)
    >>> residual.shape  # point, exposure, camera
    (29, 14, 4)
    """

    _working = (
        "of", "counted", "data_terms", "errors_at", "expanded", "fits_errors", "following", "layout", "light",
        "linearised", "nodes", "points", "points_as_stated", "runner", "taken", "weak", "with_errors_at",
    )  # fmt: skip

    layout: Layout
    points: MeasuredPoints
    runner: Runner
    model: Model
    errors_at: Vector | None = None
    taken: Float[np.ndarray, "p e k"] | None = None
    light: Float[np.ndarray, "p e k"] | None = None

    def __repr__(self) -> str:
        names, free = len(self.model.names), len(self.model.free)
        points, exposures = self.layout.points, len(self.calset.exposures)
        return (
            f"Likelihood of {self.model.name}: {points} points, {exposures} exposures, {self.calset.cameras} cameras; "
            f"{names} parameters, {free} free"
        )

    @classmethod
    def of(
        cls,
        calset: CalibrationSet,
        model: Model,
        probes: tuple[Effect, ...] = (),
        *,
        runner: Runner | None = None,
        **options: Any,
    ) -> Likelihood:
        """Bring a set and a model together; `probes` are effects beyond the model whose columns will be asked for.

        `options` are those of `Layout.of`: batch, interpolate, sets.
        """
        runner = runner or Runner()
        layout = Layout.of(calset, model, probes, **options)
        reader = PointReader(calset, layout.plan, model.template, layout.mirrored)
        return cls(layout, MeasuredPoints(reader, layout), runner, model)

    def following(self, values: Vector) -> Likelihood:
        """This likelihood with wavelength nodes that follow the retarders at a full vector of values (n).

        It returns itself if its nodes follow them already.
        """
        instrument = self.model.instrument(values)
        if not outgrown(self.layout.followed, instrument, curves_of(self.calset)):
            return self
        model, layout = dataclasses.replace(self.model, template=instrument), self.layout
        how = {"interpolate": layout.interpolated, "sets": layout.sets}
        return Likelihood.of(self.calset, model, runner=self.runner, **how)

    def with_errors_at(self, values: Vector | None) -> Likelihood:
        """This likelihood with the errors of its data held at a full vector of values (n).

        With None each call takes the errors of the values that it is given. It returns itself if the errors have no
        parameters.
        """
        if self.model.template.noise is None:
            return self
        noise = None if values is None else self.model.instrument(np.asarray(values, float)).noise
        reader = dataclasses.replace(self.points.reader, noise=noise)
        return dataclasses.replace(self, points=MeasuredPoints(reader, self.layout), errors_at=values)

    @property
    def fits_errors(self) -> bool:
        """True where errors of the data depend on the values that a method is given."""
        return self.model.template.noise is not None and self.errors_at is None

    @property
    def calset(self) -> CalibrationSet:
        """The calibration set whose points it reads."""
        return self.points.reader.calset

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.model.template.cameras)

    @property
    def plan(self) -> Plan:
        """Plan of the computation for the exposures."""
        return self.layout.plan

    @property
    def flux_known(self) -> Bool[np.ndarray, " e"]:
        """Exposures of sources whose flux is known."""
        return np.asarray(self.plan.exposures.flux_known)

    @property
    def data_per_row(self) -> Float[np.ndarray, " e"]:
        """Independent data of a used row (e): one for each camera, less the fraction of the unknown fluxes that the row
        pays for.

        Of four cameras with one unknown flux these are three.
        """
        groups = self.plan.exposures.shared
        size = np.ones(len(self.flux_known)) if groups is None else np.asarray(groups @ groups.sum(axis=0))
        return self.cameras - np.where(self.flux_known, 0.0, self.model.template.cameras.fluxes / size)

    @cached_property
    def flux_groups(self) -> FluxGroups:
        """Which cameras and exposures have a flux in common, and which exposures of a star its own q, u, point by
        point.
        """
        stars = self.points.gathered("stars") if len(fields_of_stars(self.calset.sources)) else None
        return engine.flux_groups(self.model.template, self.plan)._replace(stars=stars)

    @cached_property
    def priors(self) -> PriorRows:
        """Prior knowledge of the free parameters, from the model."""
        return prior_rows(self.model)

    @cached_property
    def weak(self) -> Float[np.ndarray, " f"]:
        """Precision of the weak pull of every free parameter; 0 where there is none."""
        rows, precision = self.priors, np.zeros(len(self.model.parameters))
        precision[rows.index[~rows.known]] = rows.width[~rows.known] ** -2
        return precision[self.model.free]

    def nodes(
        self, instrument: Instrument, near: Expansion | None = None
    ) -> tuple[FieldTable | None, OpticsUsed]:
        """The optics on nodes of the field, and how accurate they are; None where they are to be solved point by point.

        `near` is an expansion at similar values: as many nodes as it needed are tried first. If no number of nodes was
        enough there, because the optics oscillate over the field, none is tried here.
        """
        hint = None if near is None else near.optics.nodes_per_side
        if not self.layout.interpolated or (near is not None and hint is None):
            return None, OpticsUsed(None)
        scale = np.array([p.scale for p in self.model.parameters])[directions(instrument, self.plan).index]
        nodes, error = accurate_nodes(instrument, self.plan, self.layout.rectangle, scale, hint)
        return (None, OpticsUsed(None)) if nodes is None else (nodes, OpticsUsed(nodes.count, error))

    # -------------------------------------------------------------------------------------- the expansion

    def expand(self, values: Vector, noise_scale: float = 1.0, near: Expansion | None = None) -> Expansion:
        """χ² and its quadratic expansion at a full vector of parameter values.

        `noise_scale` multiplies the errors of the data (not the priors'): above 1 it stands for what the
        model cannot explain. `near` is an earlier expansion at similar values, which saves the search for nodes.
        """
        values = np.asarray(values, float)
        terms, optics = self.data_terms(values, near)
        return self.expanded(values, terms, noise_scale, optics)

    def data_terms(self, values: Vector, near: Expansion | None = None) -> tuple[DataTerms, OpticsUsed]:
        """χ² of the data with its expansion at a full vector of values, and the optics used; `near` as for `expand`."""
        instrument = self.model.instrument(values)
        nodes, optics = self.nodes(instrument, near)

        def of_batch(data: engine.PointData, rows: slice) -> DataTerms:
            if self.fits_errors:
                return self._terms_with_errors(instrument, data, nodes, rows)
            chi2, gradient, matrix = engine.normal_equations(instrument, self.plan, data, nodes)
            return DataTerms(float(chi2), gradient, matrix, self.counted(data))

        return self._joined("χ², gradient and matrix", of_batch), optics

    def _terms_with_errors(
        self, instrument: Instrument, stated: engine.PointData, nodes: FieldTable | None, rows: slice
    ) -> DataTerms:
        """Terms of a batch of the data whose errors are those of the noise terms of the instrument.

        `rows` are the points of the batch, of which the last one may be filled up.
        """
        noise, groups = instrument.noise, self.points.reader.noise_terms
        assert noise is not None
        counts, weight = np.asarray(stated.counts), np.asarray(stated.weight)
        ratio = variance_ratio(noise, groups, counts, weight)
        data = stated._replace(weight=array(weight / np.sqrt(ratio)))
        chi2, gradient, matrix = engine.normal_equations(instrument, self.plan, data, nodes)
        residual = np.asarray(engine.residuals(instrument, self.plan, data, nodes)[1])
        shared = engine.flux_groups(instrument, self.plan)
        taken, light = (of_rows(held, rows, len(counts)) for held in (self.taken, self.light))
        at_values = noise, groups, counts, weight, residual, self.flux_known, shared
        of_errors = noise_expansion(*at_values, taken=0.0 if taken is None else taken, light=light)
        at, gradient, matrix = self.model.positions(NOISE), np.array(gradient), np.array(matrix)
        gradient[at] += of_errors.gradient
        matrix[np.ix_(at, at)] += of_errors.matrix
        return DataTerms(float(chi2), gradient, matrix, self.counted(data), of_errors.value)

    def expanded(self, values: Vector, terms: DataTerms, noise_scale: float, optics: OpticsUsed) -> Expansion:
        """The expansion that the terms of the data make together with the priors."""
        rows, select, pull = self.priors, self.model.selection(), self.priors.residuals(values)
        gradient = terms.gradient / noise_scale**2
        gradient[rows.index] += pull / rows.width
        matrix = terms.matrix / noise_scale**2
        matrix[rows.index, rows.index] += rows.width**-2
        matrix = select.T @ matrix @ select
        # Parameters of the errors take up no data: with their best values χ² is its expectation.
        of_model = ~np.isin(self.model.free, self.model.positions(NOISE))
        taken_up = determined(matrix[np.ix_(of_model, of_model)], self.weak[of_model])
        return Expansion(
            data=terms.data,
            priors=float(np.sum(pull[rows.known] ** 2)),
            loose=float(np.sum(pull[~rows.known] ** 2)),
            noise_scale=noise_scale,
            gradient=select.T @ gradient,
            matrix=matrix,
            used_data=terms.used_data,
            dof=self._independent(terms.used_data) - round(taken_up),
            optics=optics,
            log_variance=terms.log_variance,
        )

    def _independent(self, used_data: UsedData) -> int:
        of_errors = np.isin(self.priors.index, self.model.positions(NOISE))
        return round(float(used_data.rows @ self.data_per_row)) + int((self.priors.known & ~of_errors).sum())

    # ----------------------------------------------------------------------------------- a pass over the points

    def _joined(self, label: str, function: Callable[[engine.PointData, slice], Joined]) -> Joined:
        """The results of `function` for all batches of points, joined into one by their method `joined`.

        It is given a batch, and the points of the set that the batch holds.
        """
        part, size = self.layout.part, self.layout.batch

        def work(number: int) -> Joined:
            starts = itertools.count(number * part, size)
            batches = zip(self.points.part(number), starts, strict=False)
            results = (function(batch, slice(start, start + size)) for batch, start in batches)
            return functools.reduce(lambda a, b: a.joined(b), results)

        parts = self.runner.each(label, work, self.layout.points, self.layout.part)
        return functools.reduce(lambda a, b: a.joined(b), parts)

    def counted(self, data: engine.PointData) -> UsedData:
        """Number and field of the data of some points that are used."""
        used = np.asarray(data.weight)[..., 0] > 0
        x, y = (np.asarray(at)[used.any(axis=1)] for at in (data.x, data.y))
        low, high = np.inf, -np.inf
        field = (x.min(initial=low), x.max(initial=high), y.min(initial=low), y.max(initial=high))
        return UsedData(used.sum(axis=0), tuple(map(float, field)), self.cameras)  # pyright: ignore[reportArgumentType]

    @cached_property
    def used_data(self) -> UsedData:
        """Number and field of the used data of the whole set, counted by a pass of its own.

        An expansion has counted them on its way (`Expansion.used_data`).
        """
        return self._joined("counting", lambda data, _: self.counted(data))

    @property
    def independent(self) -> int:
        """Number of independent data: `data_per_row` of every used row, and one for each prior."""
        return self._independent(self.used_data)

    @cached_property
    def used(self) -> Bool[np.ndarray, "p e"]:
        """True where the intensities of a (point, exposure) are used."""
        used = [np.asarray(batch.weight)[..., 0] > 0 for batch in self.points]
        return np.concatenate(used)[: self.layout.points]

    # ----------------------------------------------------------------------------------------- row by row

    def residuals(self, values: Vector) -> tuple[Float[np.ndarray, "p e"], Float[np.ndarray, "p e k"]]:
        """Best flux and normalised residuals (data − model)/σ of every (point, exposure); 0 where unused.

        The flux is the mean over the arms where each has its own; errors that have parameters are those of `values`.
        """
        if self.fits_errors:
            return self.with_errors_at(values).residuals(values)
        instrument = self.model.instrument(values)
        nodes, _ = self.nodes(instrument)
        batches = [engine.residuals(instrument, self.plan, batch, nodes) for batch in self.points]
        return self._of_points(batches)

    def _of_points(
        self, batches: Sequence[tuple[Any, Any]]
    ) -> tuple[Float[np.ndarray, "p e"], Float[np.ndarray, "p e k"]]:
        """Fluxes and residuals of all points from those of the batches, the last of which is filled up."""
        flux, residual = (
            np.concatenate(arrays)[: self.layout.points] for arrays in zip(*batches, strict=True)
        )
        return flux.mean(axis=-1), residual

    def light_at(self, values: Vector) -> Float[np.ndarray, "p e k"]:
        """F u/N_ERR of all intensities at a full vector of values, with the errors of these values; 0 where unused."""
        counts, weight = map(self.points_as_stated.gathered, ("counts", "weight"))
        residual = self.with_errors_at(values).residuals(values)[1]
        noise = self.model.instrument(values).noise
        if noise is not None:
            residual = residual * np.sqrt(
                variance_ratio(noise, self.points.reader.noise_terms, counts, weight)
            )
        return np.where(weight > 0, counts * weight - residual, 0.0)

    @property
    def points_as_stated(self) -> MeasuredPoints:
        """The points with the errors that the set states, whatever was fitted of them."""
        return self.with_errors_at(None).points

    def log_variance(self, values: Vector) -> Float[np.ndarray, "p e"]:
        """What −2 ln L has beside χ² at a full vector of values, of every (point, exposure); 0 without noise terms."""
        noise = self.model.instrument(values).noise
        if noise is None:
            return np.zeros((self.layout.points, len(self.calset.exposures)))
        counts, weight = map(self.points_as_stated.gathered, ("counts", "weight"))
        ratio = variance_ratio(noise, self.points.reader.noise_terms, counts, weight)
        light = self.light_at(values) / np.sqrt(ratio)
        shared = engine.flux_groups(self.model.template, self.plan)
        return log_variance(ratio, light, self.flux_known, shared)

    def linearised(
        self, values: Vector
    ) -> tuple[Float[np.ndarray, "p e"], Float[np.ndarray, "p e k"], Float[np.ndarray, "d f"]]:
        """Best fluxes and residuals, as `residuals` gives them, and the derivatives of `jacobian`."""
        if self.layout.interpolated:  # the optics of residuals come from nodes
            return *self.residuals(values), self.jacobian(values)
        select, found, rows = self.model.selection(), [], []
        for batch, linear in self._linearised_batches(values):
            rows.append(used_rows(linear.slope, batch) @ select)
            found.append((np.asarray(linear.flux), np.asarray(linear.residual).reshape(batch.weight.shape)))
        return *self._of_points(found), np.concatenate(rows)

    def jacobian(self, values: Vector) -> Float[np.ndarray, "d f"]:
        """Derivatives of the used residuals with respect to the free parameters, dense.

        Rows run over points, then exposures, then cameras, as in `residuals(values)[1][self.used]`.
        """
        batches, select = self._linearised_batches(values), self.model.selection()
        return np.concatenate([used_rows(linear.slope, batch) @ select for batch, linear in batches])

    def _linearised_batches(self, values: Vector) -> Iterator[tuple[engine.PointData, engine.Linearised]]:
        """Every batch of points, with its residuals and their derivatives in all parameters."""
        of = self.with_errors_at(values) if self.fits_errors else self
        instrument = self.model.instrument(values)
        for batch in of.points:
            yield batch, engine.linearised_residuals(instrument, self.plan, batch)

    def stokes(self, values: Vector) -> Float[np.ndarray, "p e 4"]:
        """Stokes vectors (p, e, 4) of the light that enters the instrument, per unit of flux."""
        instrument = self.model.instrument(values)
        vectors = [engine.incoming(instrument, self.plan, batch) for batch in self.points]
        return np.concatenate(vectors)[: self.layout.points]


def used_rows(columns: Array | np.ndarray, batch: engine.PointData) -> Float[np.ndarray, "d n"]:
    """The rows of a batch whose intensities are used, of columns for all of its intensities."""
    used = np.asarray(batch.weight)[..., 0] > 0
    cube = np.asarray(columns).reshape(*used.shape, batch.weight.shape[-1], -1)
    return cube[used].reshape(-1, cube.shape[-1])
