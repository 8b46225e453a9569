"""Discrete causes of a gross misfit: compared by cheap steps, before any amplitude is thought of.

Where a fit misses per cents of the light, no linear step of an effect means anything. What can make such residuals has
no derivative: the data were written down otherwise (`readings`), an element stood where the exposures do not say it,
the instrument was put together in another way (`model/alternatives.py`). A cause is worth the χ² that is left at a few
field points,

    χ²(θ₀ + δ),   δ = −(JᵀJ/s² + P)⁻¹ (Jᵀr/s² + P(θ₀ − θ_prior)),

after one Gauss–Newton step from the model as designed, the errors of the data scaled by s as the fit of the set as it
stands asks for, so that priors hold what residuals of a wrong model would bend. The best ones take more steps. What
brings χ²/dof − 1 below a tenth of what the fit of the set as it stands has left, and below what a fit would call far
off, explains it. What leaves nothing but noise ends the comparison.

Of the many that concern some of the exposures, of other descriptions, and of two causes at once, only those take such
steps that are best with the slopes of the model as it stands (`Screen`): the residuals r of each cause at the start
values, less the part that the parameters could absorb,

    χ² = ‖r‖² − ‖Qᵀr‖²,   Q an orthonormal basis of the columns of J and the priors,

a sum over exposures. So one pair of residuals, with the cause and without it, gives χ² of the cause in any of them:
from one exposure on, up to it, in those of one KIND.

Symbols     J, r Jacobian and whitened residuals; P inverse prior variances; θ₀ start values.
Limits      Two causes at most. Those that do the same to these data are reported together.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.kinds import POLARISER
from walop_jax.data.records import CalibrationSet, Position
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.readings import (
    FEW,
    Alternative,
    in_some_exposures,
    instruments,
    listed,
    of_some_exposures,
    readings,
    unchanged,
    with_block,
    with_part,
)
from walop_jax.diagnosis.stated_conditions import STEP, stated_numbers
from walop_jax.fit.base_model import base_model
from walop_jax.fit.model_of_set import model_like
from walop_jax.fit.refit import FitResult, Vector
from walop_jax.fit.search import FAR_OFF
from walop_jax.io.errors import DataError
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.alternatives import alternatives
from walop_jax.model.effects import Effect, OtherDescription
from walop_jax.model.effects.in_models import with_effects
from walop_jax.model.light_path import NoSuchPlaceError
from walop_jax.model.parameters import values_of
from walop_jax.model.specification import Model

_POINTS = 16  # field points that are looked at
_STEPS = (1, 6)  # Gauss–Newton steps at the first look, and of the best
_LOOKED = 8  # causes that take a step, of more those that the screen finds best
_BEST = 3  # causes that are looked at again, and beside which a second one is sought
_HELPS = 0.9  # of the misfit, that the first of two causes leaves at most by itself
_EXCHANGED = 5  # worst exposures, of which two may have been exchanged
_ROUNDS = 3  # times that the size of a step is determined anew

Tell = Callable[[str], None]
Stage = Callable[[], Iterable[Alternative]]
Rows = Float[np.ndarray, " d"]


def silent(_: str) -> None:
    """Tell nobody."""


def refuse_mixups(result: FitResult) -> None:
    """Raise `DataError` with the remedy if another reading of its data explains the residuals of a fit."""
    if found := causes_of(result):
        raise refusal(result.chi2 / result.dof, found)


def causes_of(
    result: FitResult, structural: Sequence[Effect] = (), tell: Tell = silent, *, descriptions: bool = False
) -> tuple[Alternative, ...]:
    """The discrete causes that explain the residuals of a fit, best first: readings of the data, and what is asked for.

    `structural` are effects without an amplitude; `descriptions` asks for other descriptions of the instrument as well.
    """
    if result.dof <= 0:
        return ()
    left = result.chi2 / result.dof
    return causes(result.calset, result.model, left, structural, tell, descriptions=descriptions)


def refusal(left: float, found: Sequence[Alternative]) -> DataError:
    """The error of data that other readings explain, and that leave `left` (χ²/dof) as they stand."""
    reasons = "; or if ".join(str(alternative) for alternative in found)
    return DataError(f"the model does not fit (χ²/dof = {left:.3g}); it would if {reasons}")


def causes(
    calset: CalibrationSet,
    model: Model,
    left: float,
    structural: Sequence[Effect] = (),
    tell: Tell = silent,
    *,
    descriptions: bool = False,
) -> tuple[Alternative, ...]:
    """The causes that explain a set, best first, where a fit misses it by a per cent or more.

    `left` is the χ²/dof of a fit of `model`; the others are those of `causes_of`.
    """
    if left < thresholds.POOR_FIT:
        return ()
    few, likelihood = _few(calset, model)
    if likelihood is None:
        return ()
    stands, values = _misfit(likelihood, left, _STEPS[1])
    return _compared(likelihood, min(left, stands), values, structural, tell, descriptions=descriptions)


def causes_before_a_fit(
    calset: CalibrationSet, model: Model, structural: Sequence[Effect] = (), tell: Tell = silent
) -> tuple[float, tuple[Alternative, ...] | None]:
    """χ²/dof a few steps from the model as designed, and the causes of a gross misfit there; None: it is not gross.

    A fit of data that are read wrongly wanders through all orders of the plates to no end: they are asked first.
    """
    few, likelihood = _few(calset, model)
    if likelihood is None:
        return np.nan, None
    try:
        left, values = _misfit(likelihood, FAR_OFF, _STEPS[1])
    except np.linalg.LinAlgError:
        return np.nan, None
    if not FAR_OFF <= left < np.inf:
        return left, None
    return left, _compared(likelihood, left, values, structural, tell, descriptions=True)


def _compared(
    likelihood: Likelihood,
    left: float,
    values: Vector,
    structural: Sequence[Effect],
    tell: Tell,
    *,
    descriptions: bool,
) -> tuple[Alternative, ...]:
    """The causes that explain what a likelihood leaves at the `values` of a few steps, best first."""
    few, model = likelihood.calset, likelihood.model
    if left < thresholds.POOR_FIT:  # the fit has lost its way, not the data
        return ()
    look = _Look(few, model, left, likelihood)
    of_instrument = [
        Alternative(effect.name, "add it to the model", effects=(effect,)) for effect in structural
    ]
    of_some = list(of_some_exposures(likelihood, _worst_exposures(likelihood, values)))
    if _most_missed(likelihood, values) < thresholds.READING_COARSE:
        return look.explaining(of_some, look.enough)
    tell("comparing discrete causes: plates, beams and cables, signs, zeros and units of the data")
    of_all = list(readings(few, model))
    described = [
        Alternative(
            sentence,
            "correct the description of the instrument",
            effects=(OtherDescription(change=sentence),),
        )
        for sentence in alternatives(model.template)
        if descriptions and OtherDescription.name not in model.effect_names
    ]
    # With a choice of exposures, or a size, much can be imitated: only what leaves noise is told.
    sure, far_off = thresholds.READING_SURE, left >= FAR_OFF
    if not far_off:
        # Nearer by, names compete: only what leaves noise is told, and what has a size is for the search.
        return look.first_of(
            [lambda: of_some, lambda: of_all, lambda: look.screen.in_parts(of_all)], min(look.enough, sure)
        )
    whole: list[Stage] = [lambda: look.screen.best(of_instrument), lambda: of_some, lambda: of_all]
    if found := look.first_of(whole, look.enough):
        return found
    if descriptions and (found := _stated_otherwise(likelihood, left, values)):
        return found
    if found := look.first_of([lambda: look.screen.in_parts(of_all), look.screen.steps], sure):
        return found
    tell("comparing two mistakes of the data at once")
    if found := look.pairs([*of_some, *of_all]):
        return found
    # Each of these may cost a program of its own.
    described = [
        Alternative(
            sentence,
            "correct the description of the instrument",
            effects=(OtherDescription(change=sentence),),
        )
        for sentence in alternatives(model.template)
        if descriptions and OtherDescription.name not in model.effect_names
    ]
    further: list[Stage] = [lambda: look.screen.best(described)] if described else []
    if found := look.first_of([*further, lambda: instruments(few)], look.enough):
        return found
    tell("comparing two discrete causes at once")
    if found := look.pairs([*of_instrument, *of_some, *of_all, *described]):
        return found
    near = sorted(look.near, key=_left)
    return tuple(item for item in near if item.explained < thresholds.READING_ALIKE * near[0].explained)


def _stated_otherwise(likelihood: Likelihood, left: float, values: Vector) -> tuple[Alternative, ...]:
    """The number that the set states which leaves nothing but noise where it is another one; empty: there is none.

    Its linear step must explain most of the misfit; then it is determined as a step in the run is.
    """
    screen = Screen(likelihood, left, values)
    every, largest, best = np.ones(len(likelihood.calset.exposures), bool), 0.0, None
    for stated in stated_numbers(likelihood.calset):

        def changed(calset: CalibrationSet, by: float, _: Any, what: str = stated.what) -> CalibrationSet:
            return next(one for one in stated_numbers(calset) if one.what == what).changed(by)

        number = _Stepping(stated.changed_by, stated.remedy, changed, STEP * stated.width, operator.add)
        _, size, gain = screen.step(number, every)
        if gain > largest and abs(size) < stated.width:
            largest, best = gain, (number, size)
    if best is None or largest < thresholds.GOOD_SHARE * screen.misfit:
        return ()
    found = screen.determined(best[0], every, best[1], "")
    found = _judged(found, likelihood.calset, likelihood.model, left, _STEPS[1])
    if found.explained >= thresholds.READING_SURE:
        return ()
    number = f"{found.what} ({found.remedy}; χ²/dof = {found.explained:.3g})"
    return (dataclasses.replace(found, number=number, change=unchanged),)


def _few(calset: CalibrationSet, model: Model) -> tuple[CalibrationSet, Likelihood | None]:
    """A set at the few field points that are looked at, and its likelihood; None where no light was seen there."""
    # The program that a small set was fitted with is there already.
    few = calset if len(calset.points) <= FEW else thinned(calset, _POINTS, neighbours=1)
    block = few.intensities.block(0, len(few.points))
    if not (block.used[..., None] & (block.counts > 0)).any():
        return few, None
    few = dataclasses.replace(few, intensities=TableIntensities.dense(few.points, block))
    return few, Likelihood.of(few, model)


def _most_missed(likelihood: Likelihood, values: Vector) -> float:
    """Share of the light that is missed, rms of the exposure in which it is largest.

    A mistake in the conditions of an exposure misses its light by per cents, and that of others hardly.
    """
    calset, used = likelihood.calset, likelihood.used
    block = calset.intensities.block(0, len(calset.points))
    _, residual = likelihood.residuals(values)
    level = np.maximum(np.abs(block.counts), block.sigma).sum(axis=-1)
    share = np.sqrt(np.mean((residual * block.sigma) ** 2, axis=-1)) * block.counts.shape[-1] / level
    mean = np.where(used, share**2, 0.0).sum(axis=0) / np.maximum(used.sum(axis=0), 1)
    return float(np.sqrt(mean.max()))


@dataclasses.dataclass
class _Look:
    """Causes compared at some field points of a set; `tried` are all that took a step, with what each leaves.

    `near` are those that explain what was asked of them, but leave more than noise.
    """

    calset: CalibrationSet
    model: Model
    left: float
    likelihood: Likelihood
    tried: list[Alternative] = dataclasses.field(default_factory=list)
    near: list[Alternative] = dataclasses.field(default_factory=list)

    @functools.cached_property
    def screen(self) -> Screen:
        """The screen of the set as it stands."""
        return Screen(self.likelihood, self.left)

    @property
    def enough(self) -> float:
        """The χ²/dof below which a cause explains the data."""
        return min(1.0 + (self.left - 1.0) / thresholds.PART, FAR_OFF)

    def first_of(self, stages: Iterable[Stage], enough: float) -> tuple[Alternative, ...]:
        """The causes of the first stage that leave nothing but noise, best first; empty: none."""
        for stage in stages:
            found = self.explaining(stage(), enough)
            if found and found[0].explained < thresholds.READING_SURE:
                return found
            self.near += found  # another cause may explain all
        return ()

    def explaining(
        self, items: Iterable[Alternative], enough: float, steps: int = _STEPS[0]
    ) -> tuple[Alternative, ...]:
        """Those of the causes that leave `enough` (χ²/dof) at most, best first; of equals the one listed first."""
        items = list(items)
        likely = self.screen.best(items, _LOOKED) if len(items) > _LOOKED else items
        tried = [_judged(item, self.calset, self.model, self.left, steps) for item in likely]
        self.tried += tried
        tried = sorted((item for item in tried if np.isfinite(item.explained)), key=_left)[:_BEST]
        tried = [item for item in tried if item.explained <= thresholds.PART * tried[0].explained]
        best = [_judged(item, self.calset, self.model, item.explained, _STEPS[1]) for item in tried]
        good = sorted((item for item in best if item.explained < enough), key=_left)
        if not good:
            return ()
        place, least = {item.what: n for n, item in enumerate(items)}, good[0].explained
        alike = [item for item in good if item.explained < thresholds.READING_ALIKE * least]
        # Within an odds ratio of e³ the data do not say which: the commoner one is listed first.
        free = max(self.likelihood.census.n_data, 1)
        equal = least + 2.0 * thresholds.EVEN_ODDS / free
        return tuple(
            sorted(
                alike,
                key=lambda i: (i.explained > equal, place[i.what] if i.explained <= equal else i.explained),
            )
        )

    def pairs(self, items: Sequence[Alternative]) -> tuple[Alternative, ...]:
        """Two causes at once that explain the data: of the best alone, each with the best beside it."""
        stands, _ = _misfit(self.likelihood, self.left, _STEPS[0])  # as they were tried, not as it was fitted
        firsts = sorted((item for item in self.tried if item.explained < _HELPS * stands), key=_left)
        for first in firsts[:_BEST]:
            try:
                calset, model = _applied(first, self.calset, self.model)
                screen = Screen(Likelihood.of(calset, model), first.explained)
            except (ValueError, np.linalg.LinAlgError):
                continue
            others = (item for item in items if item.what != first.what)
            seconds = screen.best(others, share=1.0 / thresholds.PART)
            both = [first.beside(second) for second in seconds]
            if found := self.explaining(both, thresholds.READING_SURE, _STEPS[1]):
                return found
        return ()


def _left(item: Alternative) -> float:
    return item.explained


class Screen:
    """χ² of causes at the start values of a model, less the part that its parameters could absorb."""

    def __init__(self, likelihood: Likelihood, misfit: float, values: Vector | None = None) -> None:
        model = likelihood.model
        self.likelihood, self.scale = likelihood, float(np.sqrt(max(misfit, 1.0)))
        self.values = model.start if values is None else values
        rows = likelihood.priors
        jacobian = np.vstack(
            [likelihood.jacobian(self.values) / self.scale, -rows.jacobian(model.selection())]
        )
        norm = np.linalg.norm(jacobian, axis=0)
        self.basis = np.linalg.qr(jacobian / np.where(norm > 0, norm, 1.0))[0]
        self.used = likelihood.used
        count = likelihood.cameras * int(self.used.sum())
        prior = -rows.residuals(self.values)
        self.of_priors = float(prior @ prior), self.basis[count:].T @ prior
        self.exposure = np.repeat(np.nonzero(self.used)[1], likelihood.cameras)
        self.basis = self.basis[:count]
        self.stands = self.rows(likelihood)
        self._changed: dict[str, Rows | None] = {}

    @property
    def calset(self) -> CalibrationSet:
        """The set as it stands."""
        return self.likelihood.calset

    def rows(self, likelihood: Likelihood, values: Vector | None = None) -> Rows:
        """Residuals of a set or model changed, at the values of the screen or others; 0 where not used."""
        residual = likelihood.residuals(self.values if values is None else values)[1]
        return np.where(likelihood.used[..., None], residual, 0.0)[self.used].reshape(-1) / self.scale

    def sums(self, rows: Rows) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, "e f"]]:
        """Of every exposure the sum of squares, and its part of Qᵀr."""
        count = self.used.shape[1]
        square = np.bincount(self.exposure, rows**2, minlength=count)
        along = np.stack([self.basis[self.exposure == e].T @ rows[self.exposure == e] for e in range(count)])
        return square, along

    def left(
        self, square: Float[np.ndarray, ...], along: Float[np.ndarray, "... f"]
    ) -> Float[np.ndarray, ...]:
        """χ² of sums over exposures."""
        priors, pulled = self.of_priors
        return square + priors - np.sum((along + pulled) ** 2, axis=-1)

    @functools.cached_property
    def misfit(self) -> float:
        """χ² of the set as it stands, less what the parameters could absorb."""
        square, along = (part.sum(axis=0) for part in self.sums(self.stands))
        return float(self.left(square, along))

    def changed(self, item: Alternative) -> Rows | None:
        """Residuals with a cause; None where it cannot be asked."""
        if item.what not in self._changed:
            self._changed[item.what] = self._residuals_with(item)
        return self._changed[item.what]

    def _residuals_with(self, item: Alternative) -> Rows | None:
        try:
            if item.effects and not self.likelihood.model.effect_names:
                rows = self.rows(*self._arranged(item))
            else:
                rows = self.rows(Likelihood.of(*_applied(item, self.calset, self.likelihood.model)))
        except (ValueError, np.linalg.LinAlgError):
            return None
        return rows if np.isfinite(rows).all() else None

    def _arranged(self, item: Alternative) -> tuple[Likelihood, Vector]:
        """The likelihood of an instrument that is arranged as a cause says, at the values of the screen.

        Arranged in place, not by an effect: instruments that differ in the angles of their plates share a program.
        """
        instrument = self.likelihood.model.instrument(self.values)
        for effect in item.effects:
            instrument = effect.patch(instrument)
        model = dataclasses.replace(self.likelihood.model, template=instrument)
        return Likelihood.of(item.change(self.calset), model), np.asarray(values_of(instrument))

    def best(
        self, items: Iterable[Alternative], most: int = _BEST, share: float = 1.0
    ) -> list[Alternative]:
        """The `most` causes that leave less than a `share` of what nothing changed does, and least, in their order."""
        stands, ranked = self.misfit, []
        for item in items:
            if (rows := self.changed(item)) is not None:
                square, along = (part.sum(axis=0) for part in self.sums(rows))
                if (left := float(self.left(square, along))) < share * stands:
                    ranked.append((left, item))
        return _least(ranked, most)

    def later(self) -> Bool[np.ndarray, "n e"]:
        """The exposures from the second on, from the third on, …, in the order of their times."""
        mjd = self.calset.exposures.mjd
        order = np.argsort(np.where(np.isfinite(mjd), mjd, 0.0), kind="stable")
        place = np.argsort(order)
        return place >= np.arange(1, len(mjd))[:, None]

    def choices(self) -> Iterator[Bool[np.ndarray, " e"]]:
        """Exposures that may have a mistake in common: from one on, up to one, those of a KIND."""
        e = self.calset.exposures
        for later in self.later():
            yield later
            yield ~later
        kinds = np.unique(e.kind)
        for name in kinds if len(kinds) > 1 else ():
            yield e.kind == name

    def in_parts(self, items: Iterable[Alternative]) -> list[Alternative]:
        """The best causes that concern some of the exposures alone, each in those in which it leaves least."""
        chosen = np.array(list(self.choices()))
        if not len(chosen):
            return []
        stands, ranked = self.sums(self.stands), []
        for item in items:
            other = item.change(self.calset)
            if other.points is not self.calset.points or other.sources is not self.calset.sources:
                continue
            if other.site is not self.calset.site or (rows := self.changed(item)) is None:
                continue
            square, along = self.sums(rows)
            lefts = self.left(
                stands[0].sum() + chosen @ (square - stands[0]),
                stands[1].sum(axis=0) + chosen @ (along - stands[1]),
            )
            best = int(np.argmin(lefts))
            # Those that it does not change are not among them.
            differs = np.bincount(self.exposure, np.abs(rows - self.stands), minlength=len(square)) > 0
            some = chosen[best] & differs
            ranked.append((float(lefts[best]), item.in_some(some, listed(self.calset, some))))
        return _least(ranked)

    def steps(self) -> list[Alternative]:
        """Numbers whose step in the run explains most of the misfit, each from the exposure on from which it does."""
        found = []
        least = thresholds.GOOD_SHARE * self.misfit
        for number in _stepping(self.likelihood):
            chosen, size, gain = self.step(number)
            if gain > least:
                found.append((gain, number, chosen, size))
        likely = sorted(found, key=lambda entry: -entry[0])[:_BEST]
        return [self.determined(number, chosen, size) for _, number, chosen, size in likely]

    def step(
        self, number: _Stepping, chosen: Bool[np.ndarray, " e"] | None = None
    ) -> tuple[Bool[np.ndarray, " e"], float, float]:
        """Exposures in which a number is another one, its change by a linear step, and what that gains in χ²."""
        every = np.ones(len(self.calset.exposures), bool)
        slope = self.rows(
            Likelihood.of(number.change(self.calset, number.unit, every), self.likelihood.model)
        )
        slope = (slope - self.stands) / number.unit
        options = self.later() if chosen is None else chosen[None]
        if not len(options):
            return every, 0.0, 0.0
        _, of_rows = self.sums(self.stands)
        square, along = self.sums(slope)
        product = np.bincount(self.exposure, slope * self.stands, minlength=len(every))
        taken = options @ along
        scores = options @ product - taken @ (of_rows.sum(axis=0) + self.of_priors[1])
        information = options @ square - np.sum(taken**2, axis=1)
        alive = information > thresholds.ROUNDING * max(float(square.sum()), 1e-300)
        gains = np.where(alive, scores**2 / np.where(alive, information, 1.0), 0.0)
        best = int(np.argmax(gains))
        size = float(-scores[best] / information[best]) if alive[best] else 0.0
        return options[best] & (square > 0.0), size, float(gains[best])

    def determined(
        self, number: _Stepping, chosen: Bool[np.ndarray, " e"], size: float, where: str | None = None
    ) -> Alternative:
        """A step of a number, its size determined where the other parameters are fitted to it.

        `where` names the exposures, in place of their numbers.
        """
        for _ in range(_ROUNDS):
            likelihood = Likelihood.of(number.change(self.calset, size, chosen), self.likelihood.model)
            left, values = _misfit(likelihood, self.scale**2, _STEPS[1])
            _, more, _ = Screen(likelihood, left, values).step(number, chosen)
            size = number.joined(size, more)
        where = f" in {listed(self.calset, chosen)}" if where is None else where
        return Alternative(
            f"{number.worded(size)}{where}",
            number.remedy,
            lambda calset: number.change(calset, size, chosen),
        )


def _least(ranked: Sequence[tuple[float, Alternative]], most: int = _BEST) -> list[Alternative]:
    """The `most` causes that leave least, the best first; not those that leave far more than the best."""
    best = sorted(ranked, key=lambda pair: pair[0])[:most]
    return [item for left, item in best if left <= thresholds.PART * best[0][0]]


class _Stepping(NamedTuple):
    """A number that may step in the run: in words, the set with it undone in some exposures, a small unit of it.

    `change` takes the step out of the data; `joined` is the size of one step behind another.
    """

    worded: Callable[[float], str]
    remedy: str
    change: Callable[[CalibrationSet, float, Bool[np.ndarray, " e"]], CalibrationSet]
    unit: float
    joined: Callable[[float, float], float]


def _stepping(likelihood: Likelihood) -> Iterator[_Stepping]:
    """The gain of every camera, as a factor on N less 1; the zero of every moving element (deg)."""
    names = likelihood.model.template.cameras.names
    for k, name in enumerate(names):

        def scaled(calset: CalibrationSet, by: float, chosen: np.ndarray, k: int = k) -> CalibrationSet:
            factor = np.ones((len(chosen), len(names)))
            factor[chosen, k] = 1.0 + by
            changed = with_block(lambda b: {"counts": b.counts * factor, "sigma": b.sigma * np.abs(factor)})
            return changed(calset)

        yield _Stepping(
            lambda by, name=name: f"the gain of {name} is {1.0 / (1.0 + by):.3g} times as large",
            "check its gain, and bring N to one unit",
            scaled,
            1e-3,
            lambda first, second: (1.0 + first) * (1.0 + second) - 1.0,
        )
    for prefix, position in likelihood.calset.exposures.positions.items():
        if not position.inside.any():
            continue

        def turned(calset: CalibrationSet, by: float, chosen: np.ndarray, prefix: str = prefix) -> CalibrationSet:
            whole = with_part(
                "exposures", lambda e: e.placed(**{prefix: Position.at(e.position(prefix).angle + by)})
            )(calset)
            return in_some_exposures(calset, whole, chosen)

        what = "the polariser" if prefix == POLARISER else f"the element of {prefix}"
        yield _Stepping(
            lambda by, prefix=prefix: f"{prefix}_ANGLE is {abs(by):.3g}° too {'small' if by > 0 else 'large'}",
            f"check whether {what} has slipped, and correct {prefix}_ANGLE",
            turned,
            0.01,
            operator.add,
        )


def _applied(item: Alternative, calset: CalibrationSet, model: Model) -> tuple[CalibrationSet, Model]:
    """The set rewritten and the model extended. Raises ValueError where a cause has no place in them."""
    rewritten = item.change(calset)
    if rewritten.instrument != calset.instrument:
        model = base_model(rewritten)
    elif rewritten.sources is not calset.sources:  # their priors
        model = model_like(rewritten, model)
    try:
        for effect in item.effects:
            model = with_effects(model, [effect], rewritten)
    except NoSuchPlaceError as error:
        raise ValueError(str(error)) from error
    return rewritten, model


def _judged(
    item: Alternative, calset: CalibrationSet, model: Model, misfit: float, steps: int
) -> Alternative:
    """A cause with χ²/dof after some Gauss–Newton steps from the model as designed; ∞ where none can be made."""
    try:
        likelihood = Likelihood.of(*_applied(item, calset, model))
        return dataclasses.replace(item, explained=_misfit(likelihood, misfit, steps)[0])
    except (ValueError, np.linalg.LinAlgError):
        return item


def _misfit(likelihood: Likelihood, before: float, steps: int) -> tuple[float, Vector]:
    """χ²/dof after some steps, the errors of the data scaled as `before`, then as the step before, asks for; and where.

    The smallest of all steps, and the values there.
    """
    model, least = likelihood.model, before
    x = model.start[model.free]
    step, smallest, best = None, np.inf, model.start
    for number in range(steps + 1):
        values = model.full(x)
        step = likelihood.expand(values, np.sqrt(max(least, 1.0)), step)
        if step.dof <= 0 or not np.isfinite(step.chi2):
            break
        least = step.chi2 / step.dof
        if least < smallest:
            smallest, best = least, values
        if number < steps:
            width = np.sqrt(np.diag(step.matrix))
            x = x - np.linalg.solve(step.matrix / np.outer(width, width), step.gradient / width) / width
    return smallest, best


def _worst_exposures(likelihood: Likelihood, values: Vector) -> list[int]:
    """Exposures with the largest mean squared residuals, the worst first."""
    _, residual = likelihood.residuals(values)
    square = np.where(likelihood.used[..., None], residual**2, 0.0).sum(axis=(0, 2))
    mean = square / np.maximum(likelihood.used.sum(axis=0), 1)
    return np.argsort(-mean, kind="stable")[:_EXCHANGED].tolist()
