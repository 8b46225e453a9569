"""Joint fits of many sets of one layout by one compiled program: noise realisations, bootstrap, nights, other draws.

Each fit is the one that `refit.fit` makes: the same minimum, sought by the same steps (`minimise.search_of`), fluxes
eliminated, priors and ties as in the model. What differs is only who evaluates: in every round, the places that all
unfinished searches ask for go through one program together, which loops over the fits. Nothing is compiled a second
time, and a set costs no more than its steps.

Layout      sets are of one layout if their plans have the same structure: as many exposures, field points, cameras,
            bands and settings of the moving elements, whatever the numbers. Numbers that are the same in all sets are
            in the program once.
Start       the first set begins at the start values of the model, as `refit.fit` does; all others begin at its minimum,
            from which they are a few steps away. Of many sets each takes `APPROACH` steps with the derivatives of the
            optics there: these cost a third of a step with derivatives of its own, and end at a few per cent of a
            standard error from the minimum (measured on sets of 45 points × 16 exposures).
Left over   a search that does not end, or ends far from the data (χ²/dof above `search.FAR_OFF`), is made anew by
            `refit.fit`, which scales errors and tries plates one order of retardance away; so is one of a model with
            air gaps, whose fringe orders are tried there, one whose plates need more wavelength nodes than were laid
            out, and one with parameters of the errors of the data, which change from place to place. `ManyFits.alone`
            names these.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from walop_jax.data.records import CalibrationSet
from walop_jax.fit.base_model import base_model
from walop_jax.fit.minimise import Minimum, search_of
from walop_jax.fit.refit import FitResult, fit, fit_at
from walop_jax.fit.search import FAR_OFF, check_identifiable, free_scales
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import fail
from walop_jax.io.plain_tables import astropy_table
from walop_jax.likelihood import engine
from walop_jax.likelihood.engine import NormalEquations, PointData
from walop_jax.likelihood.layout import PointReader
from walop_jax.likelihood.likelihood import (
    DataTerms,
    Expansion,
    Likelihood,
    MeasuredPoints,
    OpticsUsed,
    UsedData,
)
from walop_jax.likelihood.optics import KnownOptics
from walop_jax.model.compiled import array, compiled
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import with_values
from walop_jax.model.plan import Plan
from walop_jax.model.specification import Model

TOGETHER = 32
"""Fits that one call of the program evaluates: the last call of a round is filled up with copies of its last fit."""

APPROACH = 2
"""Steps with held derivatives: a third one would come no nearer to the minimum with derivatives of its own."""
APPROACHED = 100
"""Sets from which on their starts are worth two programs more: each saves some 20 ms, the programs cost seconds."""

FACTS = ("exposures", "points", "sources", "filters", "site")
"""What the plan of a set depends on, beside the model."""


@dataclasses.dataclass(frozen=True, repr=False)
class ManyFits(Displayed):
    """Fits of many sets of one layout, in the order of the sets.

    `fits` are ordinary results whose residuals are not examined (`trusted` needs `walop.refit`); `alone` are the
    positions of those that were fitted by themselves, because the common search did not end near the data. `seconds` is
    the time that all of them took.

    >>> fits = walop.refit_many([calset, calset])
    >>> fits.values.shape == (2, len(fits.names))
    True
    """

    fits: tuple[FitResult, ...]
    alone: tuple[int, ...]
    seconds: float

    def __len__(self) -> int:
        return len(self.fits)

    def __getitem__(self, number: int) -> FitResult:
        return self.fits[number]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.fits[0].model.names

    @property
    def values(self) -> Float[np.ndarray, "s n"]:
        """Values of all parameters, set by set, in the units of the parameters."""
        return np.stack([one.values for one in self.fits])

    @property
    def sigma(self) -> Float[np.ndarray, "s n"]:
        """Standard errors (s, n) of all parameters as each fit states them; 0 for fixed parameters."""
        return np.stack([one.sigma for one in self.fits])

    @property
    def chi2(self) -> Float[np.ndarray, " s"]:
        """χ² of data and priors of each fit."""
        return np.array([one.chi2 for one in self.fits])

    @property
    def converged(self) -> Bool[np.ndarray, " s"]:
        """True for the fits that reached a well-conditioned minimum."""
        return np.array([one.converged for one in self.fits])

    def to_table(self) -> Any:
        """An astropy table with a row for each parameter: mean, scatter and mean stated error over the converged fits.

        SCATTER is the standard deviation from fit to fit. RATIO, of the scatter to the stated error, is 1 where the
        sets are noise realisations and the stated errors are right, but smaller for a parameter that a prior holds.
        """
        converged, model, unknown = self.converged, self.fits[0].model, np.full(len(self.names), np.nan)
        values, stated = self.values[converged], self.sigma[converged]
        mean = values.mean(axis=0) if len(values) else unknown
        error = np.sqrt(np.mean(stated**2, axis=0)) if len(values) else unknown
        scatter = values.std(axis=0, ddof=1) if len(values) > 1 else unknown
        ratio = np.divide(scatter, error, out=unknown.copy(), where=error > 0)
        return astropy_table(
            {
                "NAME": (np.array(self.names), "", "parameter"),
                "UNIT": (np.array([p.unit for p in model.parameters]), "", "unit of the numbers of this row"),
                "MEAN": (mean, "", "mean over the converged fits"),
                "SCATTER": (scatter, "", "standard deviation from fit to fit"),
                "ERROR": (error, "", "stated standard error, root mean square over the fits"),
                "RATIO": (ratio, "", "scatter over stated error"),
            }
        )

    def display(self) -> Display:
        """How many fits there are, how many converged, and which were fitted alone."""
        count = len(self)
        facts = {
            "converged": f"{int(self.converged.sum())} of {count}",
            "χ²/dof": f"{np.median([one.chi2 / max(one.dof, 1) for one in self.fits]):.4g} (median)",
            "steps": f"{np.median([one.minimum.steps for one in self.fits]):.0f} (median)",
        }
        notes = [f"fit {n}: {self.fits[n].minimum.message}" for n in np.flatnonzero(~self.converged)[:5]]
        if self.alone:
            listed = ", ".join(map(str, self.alone[:10])) + (", …" if len(self.alone) > 10 else "")
            notes.append(f"fitted by themselves, as their common search did not end near the data: {listed}")
        title = f"Fits of {count} sets: {self.fits[0].model.name}"
        return Display(title, tuple(facts.items()), (), (), (*notes, "to_table() has mean and scatter"))


def refit_many(
    calsets: Sequence[CalibrationSet],
    model: Model | Sequence[Model] | None = None,
    *,
    progress: Callable[[str], None] | None = None,
) -> ManyFits:
    """The joint fit of each of many sets of one layout, in seconds for hundreds of them.

    `model` serves all sets, which must have the SOURCES of the first one then. Of a sequence of models each set has its
    own, with the same parameters but other priors. None: each set has its `walop.base_model`, with the catalogue values
    of its own standards as priors. Each fit equals `walop.refit` of its own set, but its residuals are not examined.
    Example: of noise realisations of one run, `to_table` has the scatter of every parameter beside its stated error,

    >>> walop.refit_many(realisations).to_table()["NAME", "SCATTER", "ERROR"]  # doctest: +SKIP

    Raises `DataError` for no sets, for a set of another layout than the first one (with its position), for another
    number of models than of sets, and for whole frames; ValueError where exposures cannot determine the instrument.
    """

    def tell(done: int, of: int) -> None:
        if progress is not None:
            progress(f"{done} of {of} fits have ended")

    return fitted_together(calsets, model, tell)


def fitted_together(
    calsets: Sequence[CalibrationSet],
    model: Model | Sequence[Model] | None,
    tell: Callable[[int, int], None],
) -> ManyFits:
    """The work of `refit_many`; `tell` hears how many fits have ended, and of how many."""
    began = time.perf_counter()
    if not calsets:
        raise fail("there are no sets to fit", advice="give at least one calibration set")
    likelihoods = _likelihoods(calsets, model)
    inputs = [_inputs(one) for one in likelihoods]
    # The points have been read: they are not read a second time for their numbers.
    used_data = [one.counted(data) for one, (_, _, data) in zip(likelihoods, inputs, strict=True)]
    for one, used in zip(likelihoods, used_data, strict=True):
        check_identifiable(one, used)
    first = fit(likelihoods[0])
    if first.model.template.noise is not None:
        others = tuple(fit(one) for one in likelihoods[1:])
        alone = tuple(range(1, len(likelihoods)))
        return ManyFits((first, *others), alone, time.perf_counter() - began)
    stack = Stack.of(inputs)
    starts = np.stack([_nearby(first, one.model) for one in likelihoods])
    if len(likelihoods) > APPROACHED:
        starts = _approached(stack, likelihoods, starts)
    searches = {
        n: search_of(
            starts[n][one.model.free],
            free_scales(one.model),
            damping=0.0,  # the minimum of the first set is near: Newton steps, until one of them leads upwards
            far_off=_is_far_off,
        )
        for n, one in enumerate(likelihoods)
        if n > 0
    }
    results, alone = [first], []
    for n, minimum in sorted(_driven(searches, stack, likelihoods, used_data, tell).items()):
        if _is_of_a_single_fit(likelihoods[n], minimum):
            results.append(fit_at(likelihoods[n], minimum, 0.0))
        else:
            alone.append(n)
            results.append(fit(likelihoods[n]))
    return ManyFits(tuple(results), tuple(alone), time.perf_counter() - began)


def _is_of_a_single_fit(likelihood: Likelihood, minimum: Minimum[Expansion]) -> bool:
    """True if `refit.fit` would look no further: near the data, no other fringe order, wavelength nodes that serve."""
    if not minimum.converged or _is_far_off(minimum.expansion) or likelihood.model.gaps():
        return False
    return likelihood.following(minimum.x) is likelihood


def _is_far_off(expansion: Expansion) -> bool:
    """True where the model is so far from the data that `refit.fit` scales their errors."""
    return not expansion.misfit < FAR_OFF


def _nearby(first: FitResult, model: Model) -> Float[np.ndarray, " n"]:
    """Values to start from: those of the first fit, but of parameters that begin elsewhere their own start values."""
    return np.where(model.start == first.model.start, first.values, model.start)


def _approached(
    stack: Stack, likelihoods: Sequence[Likelihood], starts: Float[np.ndarray, "s n"]
) -> Float[np.ndarray, "s n"]:
    """The starts after some steps with the derivatives of the optics at the start of the first set."""
    template, plan, data = stack.first
    held = engine.optics_of_points(with_values(template)(array(starts[0])), plan, data)._replace(rows=None)
    precision, mean = np.zeros(starts.shape), np.zeros(starts.shape)
    for n, one in enumerate(likelihoods):
        rows = one.priors
        precision[n, rows.index], mean[n, rows.index] = rows.width**-2, rows.mean
    select, found = array(likelihoods[0].model.selection()), starts.copy()
    for begin in range(0, len(starts), TOGETHER):
        some = np.minimum(np.arange(begin, begin + TOGETHER), len(starts) - 1)
        given = (array(of[some]) for of in (starts, precision, mean))
        found[some] = np.asarray(steps_of_many(stack.taken(some), held, select, *given))
    return found


def _driven(
    searches: dict[int, Any],
    stack: Stack,
    likelihoods: Sequence[Likelihood],
    used_data: Sequence[UsedData],
    tell: Callable[[int, int], None],
) -> dict[int, Minimum[Expansion]]:
    """The minima of searches by their position."""
    found: dict[int, Minimum[Expansion]] = {}
    places = {n: next(search) for n, search in searches.items()}
    while places:
        tell(len(found), len(searches))
        numbers = list(places)
        values = np.stack([likelihoods[n].model.full(places[n]) for n in numbers])
        expansions = _expansions(stack, likelihoods, used_data, numbers, values)
        places = {}
        for n, expansion in zip(numbers, expansions, strict=True):
            try:
                places[n] = searches[n].send(expansion)
            except StopIteration as end:
                found[n] = dataclasses.replace(end.value, x=likelihoods[n].model.full(end.value.x))
    return found


def _expansions(
    stack: Stack,
    likelihoods: Sequence[Likelihood],
    used_data: Sequence[UsedData],
    numbers: Sequence[int],
    values: Float[np.ndarray, "s n"],
) -> Iterator[Expansion]:
    """The expansion of each of some fits at its own values."""
    for begin in range(0, len(numbers), TOGETHER):
        some = list(numbers[begin : begin + TOGETHER])
        filled = np.array([*some, *[some[-1]] * (min(TOGETHER, len(likelihoods)) - len(some))])
        rows = np.minimum(np.arange(begin, begin + len(filled)), begin + len(some) - 1)
        normal = NormalEquations(
            *map(np.asarray, equations_of_many(stack.taken(filled), array(values[rows])))
        )
        for k, n in enumerate(some):
            likelihood = likelihoods[n]
            terms = DataTerms(
                float(normal.chi2[k]), normal.gradient[k].copy(), normal.matrix[k], used_data[n]
            )
            yield likelihood.expanded(values[begin + k], terms, 1.0, OpticsUsed(None))


# ------------------------------------------------------------------------------------------- many sets as one argument


class Stack(eqx.Module):
    """Trees of one structure as one argument of a program.

    Leaves that are the same in all trees are in `first` alone; those that differ are stacked in `varying`, with the
    trees along the leading axis, and `places` are their positions among the leaves.
    """

    first: Any
    varying: tuple[Array | np.ndarray, ...]
    places: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, trees: Sequence[Any]) -> Stack:
        """Stack trees. Raises `DataError` with the position of the first one that has another structure."""
        leaves, structure = jax.tree.flatten(trees[0])
        kinds = [(np.shape(leaf), np.asarray(leaf).dtype) for leaf in leaves]
        columns = [[np.asarray(leaf)] for leaf in leaves]
        for n, tree in enumerate(trees[1:], start=1):
            its_leaves, its_structure = jax.tree.flatten(tree)
            if its_structure != structure or kinds != [
                (np.shape(leaf), np.asarray(leaf).dtype) for leaf in its_leaves
            ]:
                what = f"set {n} has another layout than set 0"
                advice = (
                    "sets that are fitted together need as many exposures, field points and cameras, and the same "
                    "filters and settings of the moving elements: fit the others by themselves with walop.refit"
                )
                raise fail(what, advice=advice)
            for column, leaf in zip(columns, its_leaves, strict=True):
                column.append(np.asarray(leaf))
        differ = [
            i
            for i, column in enumerate(columns)
            if any(
                not np.array_equal(column[0], leaf, equal_nan=leaf.dtype.kind == "f") for leaf in column[1:]
            )
        ]
        return cls(trees[0], tuple(np.stack(columns[i]) for i in differ), tuple(differ))

    def taken(self, numbers: Int[np.ndarray, " m"]) -> Stack:
        """The trees of some numbers: one program serves any number of sets."""
        return Stack(
            self.first, tuple(array(np.asarray(column)[numbers]) for column in self.varying), self.places
        )

    def tree(self, varying: Sequence[Array]) -> Any:
        """The tree whose own leaves are `varying`."""
        leaves, structure = jax.tree.flatten(self.first)
        for place, leaf in zip(self.places, varying, strict=True):
            leaves[place] = leaf
        return structure.unflatten(leaves)


def _inputs(likelihood: Likelihood) -> tuple[Instrument, Plan, PointData]:
    """What the residuals of a set depend on beside the parameters; all of its points as one batch."""
    layout, reader = likelihood.layout, likelihood.points.reader
    (data,) = reader.batches(0, layout.points, layout.points)
    return likelihood.model.template, layout.plan, data


def _likelihoods(
    calsets: Sequence[CalibrationSet], given: Model | Sequence[Model] | None
) -> list[Likelihood]:
    """The likelihood of each set; a set with the exposures and sources of the first one shares its layout."""
    models = [given] * len(calsets) if isinstance(given, Model) else given
    if models is not None and len(models) != len(calsets):
        what = f"there are {len(models)} models for {len(calsets)} sets"
        raise fail(what, advice="give one model for all sets, or one for each")
    model = models[0] if models else base_model(calsets[0])
    first = Likelihood.of(calsets[0], model)
    if first.layout.interpolated:
        what = f"set 0 has {first.layout.points} field points"
        raise fail(what, advice="so large sets are fitted one by one: walop.refit")
    needs_no_counts = first.plan.exposures.median_counts is None  # else every set has a plan of its own
    likelihoods = [first]
    for n, calset in enumerate(calsets[1:], start=1):
        differ = [what for what in FACTS if not _same(getattr(calset, what), getattr(calsets[0], what))]
        if given is not None and "sources" in differ:
            advice = "leave the model out, so that every set has its own, or fit the set by itself with walop.refit"
            raise fail(f"set {n} has other SOURCES than set 0, whose priors the model holds", advice=advice)
        if needs_no_counts and not differ:
            reader = PointReader(calset, first.plan, model.template, first.layout.mirrored)
            points = MeasuredPoints(reader, first.layout)
            own = model if models is None else models[n]
            _check_parameters(own, model, n)
            likelihoods.append(Likelihood(first.layout, points, first.runner, own))
        else:
            own = models[n] if models is not None else base_model(calset)
            _check_parameters(own, model, n)
            likelihoods.append(Likelihood.of(calset, own))
    return likelihoods


def _check_parameters(own: Model, first: Model, number: int) -> None:
    """Raise `DataError` for the model of a set whose parameters are not those of the first one."""
    if (own.names, own.free.tolist()) != (first.names, first.free.tolist()):
        advice = "sets that are fitted together need the same parameters: fit it by itself with walop.refit"
        raise fail(f"set {number} has another model than set 0", advice=advice)


def _same(one: Any, other: Any) -> bool:
    """True if records, mappings or arrays hold the same numbers and names."""
    if dataclasses.is_dataclass(one):
        names = [field.name for field in dataclasses.fields(one)]
        return type(one) is type(other) and all(_same(getattr(one, n), getattr(other, n)) for n in names)
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(_same(value, other[key]) for key, value in one.items())
    a, b = np.asarray(one), np.asarray(other)
    return bool(np.array_equal(a, b, equal_nan=a.dtype.kind == b.dtype.kind == "f"))


# --------------------------------------------------------------------------------------------------------- the program


def _equations_of_many(stack: Stack, values: Float[Array, "s n"]) -> NormalEquations:
    """χ², Jᵀr and JᵀJ of the sets of a stack, each at its own values of all parameters."""

    def one(given: tuple[Sequence[Array], Array]) -> NormalEquations:
        varying, at = given
        template, plan, data = stack.tree(varying)
        return engine.block_equations(with_values(template)(at), plan, data)

    return jax.lax.map(one, (stack.varying, values), batch_size=_side_by_side())


def _side_by_side() -> int | None:
    """One after the other on a CPU, whose cache holds the Jacobian of one set; side by side where cores are many."""
    return None if jax.default_backend() == "cpu" else TOGETHER


def _steps_of_many(
    stack: Stack,
    held: KnownOptics,
    select: Float[Array, "n f"],
    values: Float[Array, "s n"],
    precision: Float[Array, "s n"],
    mean: Float[Array, "s n"],
) -> Float[Array, "s n"]:
    """All parameters of each set after `APPROACH` Gauss–Newton steps, as far as these lower the objective.

    `precision` and `mean` are those of the priors; the precision is 0 without one.
    """

    def one(given: tuple[Any, ...]) -> Array:
        varying, start, precision, mean = given
        template, plan, data = stack.tree(varying)

        def step(state: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
            reached, least, trial = state
            normal = engine.block_equations(with_values(template)(trial), plan, data, held)
            pull = precision * (trial - mean)
            objective = normal.chi2 + pull @ (trial - mean)
            matrix = select.T @ (normal.matrix + jnp.diag(precision)) @ select
            gradient = select.T @ (normal.gradient + pull)
            moved = trial - select @ jax.scipy.linalg.solve(matrix, gradient, assume_a="pos")
            lower = (objective < least) & jnp.isfinite(moved).all()
            reached, least = jnp.where(lower, trial, reached), jnp.where(lower, objective, least)
            return (reached, least, jnp.where(lower, moved, reached)), None

        return jax.lax.scan(step, (start, jnp.asarray(jnp.inf), start), None, length=APPROACH)[0][-1]

    return jax.lax.map(one, (stack.varying, values, precision, mean), batch_size=_side_by_side())


steps_of_many = compiled(_steps_of_many, kept_as="steps_of_many")
equations_of_many = compiled(_equations_of_many, kept_as="equations_of_many")
