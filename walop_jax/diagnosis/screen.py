"""A screen of discrete causes: what each leaves of a misfit, from one evaluation of the residuals.

The residuals r of each cause at the start values, less the part that the parameters could absorb,

    χ² = ‖r‖² − ‖Qᵀr‖²,   Q an orthonormal basis of the columns of J and the priors,

are a sum over exposures: one pair of residuals, with the cause and without it, gives χ² of the cause in any of them.
A number that may have stepped in the run, the gain of a camera or the zero of a moving element, has its efficient score
for every exposure from which it may have done so.

Symbols     J, r Jacobian and whitened residuals, as the model stands.
Limits      Slopes are those of the model as it stands: the screen ranks, `discrete` fits what comes first.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.kinds import POLARISER
from walop_jax.data.records import CalibrationSet, Position
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.readings import Alternative, in_some_exposures, listed, with_block, with_part
from walop_jax.fit.base_model import base_model
from walop_jax.fit.model_of_set import model_like
from walop_jax.io.shapes import Vector
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects.in_models import with_effects
from walop_jax.model.instrument import Instrument
from walop_jax.model.light_path import NoSuchPlaceError
from walop_jax.model.specification import Model

STEPS = (1, 6)  # Gauss–Newton steps at the first look, and of the best
BEST = 3  # causes that are looked at again, and beside which a second one is sought
_ROUNDS = 3  # times that the size of a step is determined anew

RowChanges = Float[np.ndarray, " d"]


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
        self._changed: dict[str, RowChanges | None] = {}

    @property
    def calset(self) -> CalibrationSet:
        """The set as it stands."""
        return self.likelihood.calset

    def rows(self, likelihood: Likelihood, values: Vector | None = None) -> RowChanges:
        """Residuals of a set or model changed, at the values of the screen or others; 0 where not used."""
        residual = likelihood.residuals(self.values if values is None else values)[1]
        return np.where(likelihood.used[..., None], residual, 0.0)[self.used].reshape(-1) / self.scale

    def sums(self, rows: RowChanges) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, "e f"]]:
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

    def changed(self, item: Alternative) -> RowChanges | None:
        """Residuals with a cause; None where it cannot be asked."""
        if item.what not in self._changed:
            self._changed[item.what] = self._residuals_with(item)
        return self._changed[item.what]

    def _residuals_with(self, item: Alternative) -> RowChanges | None:
        try:
            arranged = None
            if item.effects and not self.likelihood.model.effect_names:
                arranged = self._arranged(item)
            if arranged is not None:
                rows = self.rows(Likelihood.of(item.change(self.calset), arranged), arranged.start)
            else:
                calset, model = applied(item, self.calset, self.likelihood.model)
                # Parameters of standards follow the catalogue: other values there are other values of these.
                own = self.likelihood.model
                moved = model.start - own.start if model.names == own.names else 0.0
                rows = self.rows(Likelihood.of(calset, model), self.values + moved)
        except (ValueError, np.linalg.LinAlgError):
            return None
        return rows if np.isfinite(rows).all() else None

    def _arranged(self, item: Alternative) -> Model | None:
        """The model of an instrument that is arranged as a cause says, with the values of the screen as its start."""

        def arrange(instrument: Instrument) -> Instrument:
            return functools.reduce(lambda made, effect: effect.patch(made), item.effects, instrument)

        return self.likelihood.model.rearranged(self.values, arrange)

    def best(self, items: Iterable[Alternative], most: int = BEST) -> list[Alternative]:
        """The `most` causes that leave less than what nothing changed does, and least, in their order."""
        stands, ranked = self.misfit, []
        for item in items:
            if (rows := self.changed(item)) is not None:
                square, along = (part.sum(axis=0) for part in self.sums(rows))
                if (left := float(self.left(square, along))) < stands:
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
        least = thresholds.LIKELY_SHARE * self.misfit
        for number in stepping(self.likelihood):
            chosen, size, gain = self.step(number)
            if gain > least:
                found.append((gain, number, chosen, size))
        likely = sorted(found, key=lambda entry: -entry[0])[:BEST]
        return [self.determined(number, chosen, size) for _, number, chosen, size in likely]

    def step(
        self, number: Stepping, chosen: Bool[np.ndarray, " e"] | None = None
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
        self, number: Stepping, chosen: Bool[np.ndarray, " e"], size: float, where: str | None = None
    ) -> Alternative:
        """A step of a number, its size determined where the other parameters are fitted to it.

        `where` names the exposures, in place of their numbers.
        """
        for _ in range(_ROUNDS):
            likelihood = Likelihood.of(number.change(self.calset, size, chosen), self.likelihood.model)
            left, values = misfit_after(likelihood, self.scale**2, STEPS[1])
            _, more, _ = Screen(likelihood, left, values).step(number, chosen)
            size = number.joined(size, more)
        where = f" in {listed(self.calset, chosen)}" if where is None else where
        return Alternative(
            f"{number.worded(size)}{where}",
            number.remedy,
            lambda calset: number.change(calset, size, chosen),
        )


def _least(ranked: Sequence[tuple[float, Alternative]], most: int = BEST) -> list[Alternative]:
    """The `most` causes that leave least, the best first; not those that leave far more than the best."""
    best = sorted(ranked, key=lambda pair: pair[0])[:most]
    return [item for left, item in best if left <= thresholds.PART * best[0][0]]


class Stepping(NamedTuple):
    """A number that may step in the run: in words, the set with it undone in some exposures, a small unit of it.

    `change` takes the step out of the data; `joined` is the size of one step behind another.
    """

    worded: Callable[[float], str]
    remedy: str
    change: Callable[[CalibrationSet, float, Bool[np.ndarray, " e"]], CalibrationSet]
    unit: float
    joined: Callable[[float, float], float]


def stepping(likelihood: Likelihood) -> Iterator[Stepping]:
    """The gain of every camera, as a factor on N less 1; the zero of every moving element (deg)."""
    names = likelihood.model.template.cameras.names
    for k, name in enumerate(names):

        def scaled(calset: CalibrationSet, by: float, chosen: np.ndarray, k: int = k) -> CalibrationSet:
            factor = np.ones((len(chosen), len(names)))
            factor[chosen, k] = 1.0 + by
            changed = with_block(lambda b: {"counts": b.counts * factor, "sigma": b.sigma * np.abs(factor)})
            return changed(calset)

        yield Stepping(
            lambda by, name=name: f"the gain of {name} is {1.0 / (1.0 + by):.3g} times as large",
            "check its gain, and bring N to one unit",
            scaled,
            1e-3,
            lambda first, second: (1.0 + first) * (1.0 + second) - 1.0,
        )
    for prefix, position in likelihood.calset.exposures.positions.items():
        if not position.inside.any():
            continue

        def turned(
            calset: CalibrationSet, by: float, chosen: np.ndarray, prefix: str = prefix
        ) -> CalibrationSet:
            whole = with_part(
                "exposures", lambda e: e.placed(**{prefix: Position.at(e.position(prefix).angle + by)})
            )(calset)
            return in_some_exposures(calset, whole, chosen)

        what = "the polariser" if prefix == POLARISER else f"the element of {prefix}"
        yield Stepping(
            lambda by, prefix=prefix: (
                f"{prefix}_ANGLE is {abs(by):.3g}° too {'small' if by > 0 else 'large'}"
            ),
            f"check whether {what} has slipped, and correct {prefix}_ANGLE",
            turned,
            0.01,
            operator.add,
        )


def applied(item: Alternative, calset: CalibrationSet, model: Model) -> tuple[CalibrationSet, Model]:
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


def misfit_after(likelihood: Likelihood, before: float, steps: int) -> tuple[float, Vector]:
    """The smallest χ²/dof at the start and after each of `steps` Gauss–Newton steps, and the values (n,) there.

    The errors of the data are scaled by the root of χ²/dof, 1 or more: first of `before`, then of the last expansion.
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
