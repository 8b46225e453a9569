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

Of the many readings, of those that concern some of the exposures, of other descriptions, and of two causes at once,
only those take such steps that are best with the slopes of the model as it stands (`screen`).

Symbols     J, r Jacobian and whitened residuals; P inverse prior variances; θ₀ start values.
Limits      Two causes at most. Those that do the same to these data are reported together.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from walop_jax.data.records import CalibrationSet
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.readings import (
    FEW,
    Alternative,
    instruments,
    of_some_exposures,
    readings,
    unchanged,
)
from walop_jax.diagnosis.screen import BEST, STEPS, Screen, Stepping, applied, misfit_after
from walop_jax.diagnosis.stated_conditions import STEP, stated_numbers
from walop_jax.fit.refit import NEARLY, FitResult
from walop_jax.fit.search import FAR_OFF
from walop_jax.io.errors import DataError
from walop_jax.io.progress import Tell
from walop_jax.io.shapes import Vector
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.alternatives import alternatives
from walop_jax.model.effects import Effect, OtherDescription
from walop_jax.model.specification import Model

_POINTS = 16  # field points that are looked at
_LOOKED = 8  # causes that take a step, of more those that the screen finds best
_HELPS = 0.9  # of the misfit, that the first of two causes leaves at most by itself
_EXCHANGED = 5  # worst exposures, of which two may have been exchanged

CauseSearch = Callable[[], Iterable[Alternative]]


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
    """The causes that explain a set, best first; none if χ²/dof of its fit is below `thresholds.POOR_FIT`.

    Where no exposure misses a per cent of its light only readings of some exposures are asked. `left` is the χ²/dof of
    a fit of `model`; the other arguments are those of `causes_of`.
    """
    if left < thresholds.POOR_FIT:
        return ()
    likelihood = _few(calset, model)
    if likelihood is None:
        return ()
    stands, values = misfit_after(likelihood, left, STEPS[1])
    return _compared(likelihood, min(left, stands), values, structural, tell, descriptions=descriptions)


def causes_before_a_fit(
    calset: CalibrationSet, model: Model, structural: Sequence[Effect] = (), tell: Tell = silent
) -> tuple[float, tuple[Alternative, ...] | None]:
    """χ²/dof a few steps from the model as designed, and the causes of a gross misfit there; None: it is not gross.

    A fit of data that are read wrongly wanders through all orders of the plates to no end: they are asked first.
    """
    likelihood = _few(calset, model)
    if likelihood is None:
        return np.nan, None
    try:
        left, values = misfit_after(likelihood, FAR_OFF, STEPS[1])
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
    if _most_missed(likelihood, values) < thresholds.LINEAR:
        return look.explaining(of_some, look.enough)
    tell("comparing discrete causes: plates, beams and cables, signs, zeros and units of the data")
    of_all = list(readings(few, model))
    # Readings of some exposures and of the whole set compete: they may do the same to all data that there are.
    of_data = [*of_some, *of_all]
    if left < FAR_OFF:
        # Nearer by, names compete: only what leaves noise is told, and what has a size is for the search.
        return look.first_of(
            [lambda: of_data, lambda: look.screen.in_parts(of_all)], min(look.enough, NEARLY)
        )
    whole: list[CauseSearch] = [lambda: look.screen.best(of_instrument), lambda: of_data]
    if found := look.first_of(whole, look.enough):
        return found
    if descriptions and (found := _stated_otherwise(likelihood, left, values)):
        return found
    # With a choice of exposures, or a size, much can be imitated: only what leaves noise is told.
    if found := look.first_of([lambda: look.screen.in_parts(of_all), look.screen.steps], NEARLY):
        return found
    tell("comparing two mistakes of the data at once")
    if found := look.pairs(of_data):
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
    further: list[CauseSearch] = [lambda: look.screen.best(described)] if described else []
    if found := look.first_of([*further, lambda: instruments(few)], look.enough):
        return found
    tell("comparing two discrete causes at once")
    if found := look.pairs([*of_instrument, *of_data, *described]):
        return found
    near = sorted(look.near, key=_left)
    return tuple(item for item in near if item.explained < thresholds.POOR_FIT * near[0].explained)


def _stated_otherwise(likelihood: Likelihood, left: float, values: Vector) -> tuple[Alternative, ...]:
    """The number that the set states which leaves nothing but noise where it is another one; empty: there is none.

    Its linear step must explain most of the misfit; then it is determined as a step in the run is.
    """
    screen = Screen(likelihood, left, values)
    every, largest, best = np.ones(len(likelihood.calset.exposures), bool), 0.0, None
    for stated in stated_numbers(likelihood.calset):

        def changed(calset: CalibrationSet, by: float, _: Any, what: str = stated.what) -> CalibrationSet:
            return next(one for one in stated_numbers(calset) if one.what == what).changed(by)

        number = Stepping(stated.changed_by, stated.remedy, changed, STEP * stated.width, operator.add)
        _, size, gain = screen.step(number, every)
        if gain > largest and abs(size) < stated.width:
            largest, best = gain, (number, size)
    if best is None or largest < thresholds.LIKELY_SHARE * screen.misfit:
        return ()
    found = screen.determined(best[0], every, best[1], "")
    found = _judged(found, likelihood.calset, likelihood.model, left, STEPS[1])
    if found.explained >= NEARLY:
        return ()
    number = f"{found.what} ({found.remedy}; χ²/dof = {found.explained:.3g})"
    return (dataclasses.replace(found, number=number, change=unchanged),)


def _few(calset: CalibrationSet, model: Model) -> Likelihood | None:
    """The likelihood of a set at the few field points that are looked at; None where no light was seen there."""
    points = len(calset.points)
    few = calset if points <= FEW else thinned(calset, _POINTS, neighbours=1)
    block = few.intensities.block(0, len(few.points))
    if not (block.used[..., None] & (block.counts > 0)).any():
        return None
    few = dataclasses.replace(few, intensities=TableIntensities.dense(few.points, block))
    # The whole set is fitted as well: one program serves both.
    return Likelihood.of(few, model, sets=-(-points // len(few.points)))


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

    def first_of(self, stages: Iterable[CauseSearch], enough: float) -> tuple[Alternative, ...]:
        """The causes of the first stage that leave nothing but noise, best first; empty: none."""
        for stage in stages:
            found = self.explaining(stage(), enough)
            if found and found[0].explained < NEARLY:
                return found
            self.near += found  # another cause may explain all
        return ()

    def explaining(
        self, items: Iterable[Alternative], enough: float, steps: int = STEPS[0]
    ) -> tuple[Alternative, ...]:
        """Those of the causes that leave `enough` (χ²/dof) at most, best first; of equals the one listed first."""
        items = list(items)
        likely = self.screen.best(items, _LOOKED) if len(items) > _LOOKED else items
        tried = [_judged(item, self.calset, self.model, self.left, steps) for item in likely]
        self.tried += tried
        tried = sorted((item for item in tried if np.isfinite(item.explained)), key=_left)[:BEST]
        tried = [item for item in tried if item.explained <= thresholds.PART * tried[0].explained]
        best = [_judged(item, self.calset, self.model, item.explained, STEPS[1]) for item in tried]
        good = sorted((item for item in best if item.explained < enough), key=_left)
        if not good:
            return ()
        place, least = {item.what: n for n, item in enumerate(items)}, good[0].explained
        alike = [item for item in good if item.explained < thresholds.POOR_FIT * least]
        # Within `thresholds.CERTAIN_ODDS` the data do not say which it is: the commoner one is listed first.
        free = max(self.likelihood.used_data.n_data, 1)
        equal = least + 2.0 * thresholds.CERTAIN_ODDS / free
        return tuple(
            sorted(
                alike,
                key=lambda i: (i.explained > equal, place[i.what] if i.explained <= equal else i.explained),
            )
        )

    def pairs(self, items: Sequence[Alternative]) -> tuple[Alternative, ...]:
        """Two causes at once that explain the data: of the best alone, each with the best beside it."""
        # As they were tried, not as the set was fitted.
        stands, _ = misfit_after(self.likelihood, self.left, STEPS[0])
        firsts = sorted((item for item in self.tried if item.explained < _HELPS * stands), key=_left)
        for first in firsts[:BEST]:
            try:
                likelihood = Likelihood.of(*applied(first, self.calset, self.model))
                screen = Screen(likelihood, first.explained)
                _, values = misfit_after(likelihood, first.explained, STEPS[1])
            except (ValueError, np.linalg.LinAlgError):
                continue
            # Once the first one is undone, other exposures are the worst.
            of_some = of_some_exposures(likelihood, _worst_exposures(likelihood, values))
            others = {item.what: item for item in (*items, *of_some) if item.what != first.what}.values()
            seconds = screen.best(others)
            both = [first.beside(second) for second in seconds]
            if found := self.explaining(both, NEARLY, STEPS[1]):
                return found
        return ()


def _left(item: Alternative) -> float:
    return item.explained


def _judged(
    item: Alternative, calset: CalibrationSet, model: Model, misfit: float, steps: int
) -> Alternative:
    """A cause with χ²/dof after some Gauss–Newton steps from the model as designed; ∞ where none can be made."""
    try:
        likelihood = Likelihood.of(*applied(item, calset, model))
        return dataclasses.replace(item, explained=misfit_after(likelihood, misfit, steps)[0])
    except (ValueError, np.linalg.LinAlgError):
        return item


def _worst_exposures(likelihood: Likelihood, values: Vector) -> list[int]:
    """Exposures with the largest mean squared residuals, the worst first."""
    _, residual = likelihood.residuals(values)
    square = np.where(likelihood.used[..., None], residual**2, 0.0).sum(axis=(0, 2))
    mean = square / np.maximum(likelihood.used.sum(axis=0), 1)
    return np.argsort(-mean, kind="stable")[:_EXCHANGED].tolist()
