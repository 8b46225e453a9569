"""Errors undetectable in the data behind a fit: of the set, of the cameras, and effects missing from the model.

A number that is wrong by h moves the parameters by δθ = R⁻¹QᵀC h (J = QR), and is found with a probability of 99 %
where h² |PC|² reaches the noncentrality λ of its test (`stated_conditions`). What hides is what the data would not show
and what is plausible as well:

    h = min(w, √λ s),   s = 1/|PC|

with w the standard error of a number of the set (`records.StatedErrors`), for an effect the width of its prior. A
number without any information in the data, P C = 0 or no sensitive exposure, hides at w. The error of stars is the
effect on their own light less the compensation by δθ (`calibration.could_hide`); without either of these a mistake has
no consequence and is left out.

Symbols     C derivative of the residuals; P projection off the free parameters, Q, R of their Jacobian J; s standard
            error with which the data measure a number
Limits      One mistake at a time, one amplitude of an effect at a time, to first order. Effects of many places or
            thicknesses (blemish, fringes) are judged by patterns, and are not here.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.calibration.accuracy import LARGEST_P, Matrices, change_of_qu
from walop_jax.calibration.could_hide import as_text, change_by_effect, moves_with, turn_of
from walop_jax.calibration.matrix import first_setting, matrix_slopes, of_matrix
from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.hypotheses import Probe
from walop_jax.diagnosis.score import local_p, noncentrality
from walop_jax.diagnosis.stated_conditions import STEP, Singles, Stated
from walop_jax.fit.verdict import DATA, EFFECT, Hidden, UndetectedError
from walop_jax.likelihood.starlight import added_to_starlight
from walop_jax.model.effects import Change, Effect
from walop_jax.model.instrument import Instrument

STAR_POINTS = 16  # field points at which the errors of stars are computed
MOST_HIDDEN = 12  # mistakes in a product: each costs a star one product of two vectors


class _Mistake(NamedTuple):
    """One number at its largest undetected size, and its projection on the parameters.

    `informed`: whether the data hold information on it. Of an effect, at its size, `change` is what it does to the
    instrument matrix where the errors of stars are computed, and it `acts` on starlight if it does anything anywhere.
    """

    name: str
    kind: str
    size: float
    unit: str
    shown_by: str
    along: Float[np.ndarray, " q"]
    informed: bool
    effect: Effect | None = None
    change: Matrices | float = 0.0
    acts: bool = False


def undetected_errors(design: Design, singles: Singles) -> Hidden:
    """Single mistakes at the largest size that hides (h above), and their consequences.

    Kept are those that move the parameters by more than their standard errors, effects that act on starlight, and
    effects of elements out of the beam in the usual setting on which the data hold no information; first those that
    make q and u of stars most wrong, in the median over the field. Of those that the data measure, `MOST_HIDDEN` stay.
    """
    fit = design.fit
    places = np.unique(np.linspace(0, len(fit.calset.points) - 1, STAR_POINTS).astype(int))
    exposure = usual_exposure(fit.calset, fit.model.template)
    of_stars = Starlight(design, singles.asked, exposure, places)
    instrument, mistakes = of_stars.instrument, list(_mistakes(singles, of_stars))
    along = np.array([m.along for m in mistakes]).reshape(len(mistakes), -1).T
    changes = (fit.model.selection() @ design.projector.taken_up(along)).T
    turns = np.array([0.0 if m.effect is None else abs(turn_of(instrument, m.effect)) for m in mistakes])
    errors = _medians(of_stars.errors([m.change for m in mistakes], changes)) + 2.0 * LARGEST_P * turns
    strong = np.linalg.norm(along, axis=0) > 1.0
    best: dict[str, tuple[int, bool, bool]] = {}
    for i in np.argsort(-errors, kind="stable").tolist():
        m = mistakes[i]
        acts = m.acts or bool(turns[i] > 0.0)
        # In the usual setting it is out of the beam; stars that are seen through it have it.
        elsewhere = not (acts or m.informed or m.effect is None) and bool(moves_with(m.effect, instrument))
        if acts or strong[i] or elsewhere:
            best.setdefault(m.name, (i, acts, elsewhere))
    unseen = {i for i, acts, _ in best.values() if acts and not mistakes[i].informed}
    always = unseen | {i for i, _, elsewhere in best.values() if elsewhere}
    further = [i for i, *_ in best.values() if i not in always][:MOST_HIDDEN]
    order = sorted([*always, *further], key=lambda i: -errors[i])
    acting = {i for i, acts, elsewhere in best.values() if acts or elsewhere}
    hidden = []
    for i in order:
        m = mistakes[i]
        acts = as_text(m.effect) if m.effect is not None and i in acting else ""
        hidden.append(UndetectedError(m.name, m.size, m.unit, m.kind, m.shown_by, acts, i not in unseen))
    return Hidden(tuple(hidden), changes[order])


def _medians(errors: Float[np.ndarray, "c p"]) -> Float[np.ndarray, " c"]:
    """Median over the places where q and u are measured; 0 where they are at none."""
    measured = np.isfinite(errors).any(axis=0)
    return np.median(errors[:, measured], axis=1) if measured.any() else np.zeros(len(errors))


def _mistakes(singles: Singles, of_stars: Starlight) -> Iterator[_Mistake]:
    """All of them, amplitude by amplitude."""
    p, shown = local_p(thresholds.ALARM, len(singles.testable)), set[str]()
    for single, score, along, rest, alive in singles.items:
        plausible = np.broadcast_to(single.plausible, len(rest))
        if not plausible.any():
            continue
        least = noncentrality(p, max(score.rank, 1), thresholds.PROBABILITY)
        information = np.where(alive, rest, 1.0)
        sizes = np.where(alive, np.minimum(plausible, np.sqrt(least / information)), plausible)
        along = along * sizes
        if single.probe is not None:
            shown.add(single.probe.name)
            yield from of_stars.mistakes(single.probe, sizes, along, alive)
        else:
            kind, size = EFFECT if single.stated is None else DATA, float(sizes[0])
            number = score.name, kind, size, single.unit, single.shown_by
            yield _Mistake(*number, along[:, 0], bool(alive[0]))
    for probe in (probe for probe in of_stars.asked if probe.name not in shown):
        count = len(probe.widths)
        nothing = np.zeros((of_stars.parameters, count))
        yield from of_stars.mistakes(probe, probe.widths, nothing, np.zeros(count, bool))


class Starlight:
    """What effects do to the light of a star in the setting of an exposure, and to its q and u once it is calibrated.

    `asked` are the effects, `places` the field points at which errors are asked.
    """

    def __init__(
        self,
        design: Design,
        asked: Sequence[Probe],
        exposure: int,
        places: Int[np.ndarray, " p"],
    ) -> None:
        self.fit, self.asked, self.places = design.fit, asked, places
        self.parameters = design.projector.basis.shape[1]
        template, calset = self.fit.model.template, self.fit.calset
        self.instrument = self.fit.model.instrument(self.fit.values)
        self.setting = first_setting(calset, self.instrument, exposure)
        every = {p.name: [change for m in p.group for change in m.first_order(template)] for p in self.asked}
        linear = {
            name: terms
            for name, terms in every.items()
            if terms and all(map(design.columns.has, terms)) and not any(map(_of_fringes, terms))
        }
        changes = list(itertools.chain(*linear.values()))
        self.vectors, added = added_to_starlight(design.columns, changes, exposure)
        ends = np.cumsum([len(terms) for terms in linear.values()])[:-1]
        self.added = dict(zip(linear, np.split(added, ends, axis=-1), strict=False))

    @classmethod
    def everywhere(cls, design: Design, asked: Sequence[Probe]) -> Starlight:
        """At all field points, in the usual setting."""
        fit = design.fit
        exposure = usual_exposure(fit.calset, fit.model.template)
        return cls(design, asked, exposure, np.arange(len(fit.calset.points)))

    def change(self, probe: Probe, number: int, size: float) -> tuple[Matrices, bool]:
        """Change of the matrix (place, arm, 3) by one amplitude at its size, and whether starlight changes anywhere."""
        points = self.fit.calset.points
        if probe.name in self.added:
            added = self.added[probe.name][..., number] * size
            change = of_matrix(self.vectors, added, self.instrument.cameras.pairs)
        else:  # an effect that users define has no slots; fringes need more wavelengths
            at = self.setting, self.fit.calset.filters, points.x, points.y
            added = change = change_by_effect(self.instrument, _at_size(probe, number, size), *at)
        return change[self.places], bool(np.abs(added).max(initial=0.0) > thresholds.ROUNDING)

    def mistakes(
        self,
        probe: Probe,
        sizes: Float[np.ndarray, " a"],
        along: Float[np.ndarray, "q a"],
        alive: Bool[np.ndarray, " a"],
    ) -> Iterator[_Mistake]:
        """The amplitudes of a probe, each by itself."""
        declared = probe.effect.numbers()
        for number, (parameter, size) in enumerate(zip(probe.parameters, sizes.tolist(), strict=True)):
            effect, unit = _at_size(probe, number, size), declared[parameter].unit
            change, acts = self.change(probe, number, size)
            number_of = (f"{probe.effect.name}.{parameter}", EFFECT, size, unit, probe.effect.revealed_by)
            yield _Mistake(*number_of, along[:, number], bool(alive[number]), effect, change, acts)

    def slope_by_number(self, stated: Stated) -> Matrices:
        """Derivative of the matrix by a number that a set states of itself, under which stars are seen as well."""
        points, step = self.fit.calset.points, STEP * stated.width
        above, below = (
            matrix_slopes(self.instrument, self.setting, stated.changed(h).filters, points.x, points.y)[0]
            for h in (step, -step)
        )
        return (above - below)[self.places] / (2.0 * step)

    def errors(
        self, changes: Sequence[Matrices | float], moved: Float[np.ndarray, "c n"]
    ) -> Float[np.ndarray, "c p"]:
        """Error of q and u at the places from each change of the matrix, less what its parameters `moved` make up for.

        NaN where q and u are not measured.
        """
        calset, errors = self.fit.calset, np.zeros((len(changes), len(self.places)))
        x, y = calset.points.x[self.places], calset.points.y[self.places]
        matrix, slopes = matrix_slopes(self.instrument, self.setting, calset.filters, x, y)
        for i, (change, by) in enumerate(zip(changes, moved, strict=True)):
            errors[i] = change_of_qu(matrix, matrix + (change - slopes @ by))
        return errors


def _of_fringes(terms: Iterable[tuple[float, Change]]) -> bool:
    return any(change.kind == "fringes" for _, change in terms)


def _at_size(probe: Probe, number: int, size: float) -> Effect:
    """The effect of a probe with one amplitude alone, at its size."""
    step = np.zeros(len(probe.widths))
    step[number] = size
    return probe.effect.combine(probe.group, step)


def usual_exposure(calset: CalibrationSet, instrument: Instrument) -> int:
    """The exposure in the most usual setting: the first of those with fewest moving elements in the beam."""
    inside = [calset.exposures.position(prefix).inside for prefix in instrument.patched().moving()]
    return int(np.argmin(np.sum(inside, axis=0))) if inside else 0
