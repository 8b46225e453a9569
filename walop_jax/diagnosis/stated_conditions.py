"""Were the data taken under the conditions that their set states? Its coordinates, filter curves and colours.

A field that is displaced, turned or scaled, a filter curve that is displaced, a lamp of another temperature: each is a
single number, and a fit takes most of it up in its own parameters, which are then wrong by many standard errors while
χ² hardly changes. Patterns over field and exposures, of which there are hundreds, miss what is spread over all data.
So each number has its own efficient score (`score`), with the derivative

    C = [r(θ̂; set with c + h) − r(θ̂; set with c − h)] / 2h

of the whitened residuals r with respect to the number c that the set states, fluxes solved for anew. A row knows of the
field only its own place, so that scale and angle are sums of X and Y, row by row.

Limits      What the free parameters take up whole is told by no residual: with a single filter its displacement, the
            thicknesses of the plates look the same. One number at a time, by a linear step: the size is a hint.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.examination import ALARM
from walop_jax.diagnosis.mixups import with_exposures, with_places
from walop_jax.diagnosis.score import Score, Scorer, ScoreSpace, corrected_p
from walop_jax.fit.refit import NEARLY
from walop_jax.io.rounding import value_and_error
from walop_jax.likelihood.likelihood import Likelihood

_ALIKE = 25.0  # in χ², within which conditions are told together
STEP = 1e-4  # of the width: what is left out of the derivative is its square


class Stated(NamedTuple):
    """A number that a set states: what it is, its unit, what to check, and the set with it changed.

    `width` is by how much it may be wrong at most; `value` is None where only a change of it has a meaning.
    `seen_by_stars`: whether stars are observed under the same condition. `along` is how the places of the field points
    (x, y) change with a number that is about them.
    """

    what: str
    unit: str
    remedy: str
    width: float
    changed: Callable[[float], CalibrationSet]
    value: float | None = None
    seen_by_stars: bool = False
    along: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]] | None = None


class Scored(NamedTuple):
    """A number, the score of changing it, and the derivative of the residuals (rows of the design).

    `square` is the square of what the model leaves of the derivative: information, in errors as stated.
    """

    stated: Stated
    score: Score
    column: Float[np.ndarray, " _"]
    square: float

    @property
    def gain(self) -> float:
        """By how much the change lowers χ², by a linear step."""
        return float(self.score.amplitudes[0] ** 2 * self.square)


def stated_conditions(design: Design) -> Iterator[str]:
    """A sentence on the conditions that the residuals of a fit speak against, the clearest first.

    Of a fit that does not explain its data only where one condition alone would.
    """
    scored = [item for item in condition_scores(design) if item.score.testable]
    found = [item for item in scored if corrected_p(item.score.log_p, len(scored)) < ALARM]
    if not found:
        return
    found.sort(key=lambda item: item.score.log_p)
    best, result = found[0].score.statistic, design.fit
    left = float(np.sum(design.projector(design.residual) ** 2)) - found[0].gain
    if not result.explains_data and left > NEARLY * design.projector.free:
        return
    likely = [item for item in found if item.score.statistic > best - _ALIKE]
    said = "; or for ".join(_in_words(item.stated, item.score) for item in likely)
    yield f"the residuals ask for {said} (p = {corrected_p(found[0].score.log_p, len(scored)):.2g})"


def _in_words(stated: Stated, score: Score) -> str:
    size, sigma = float(score.amplitudes[0]), float(np.sqrt(score.covariance[0, 0]))
    if stated.value is None:
        value, error = value_and_error(size, sigma)
        return f"{stated.what} changed by {value} ± {error} {stated.unit}".rstrip() + f" ({stated.remedy})"
    value, error = value_and_error(stated.value + size, sigma)
    return f"{stated.what} {value} ± {error} {stated.unit}, not {stated.value:g} ({stated.remedy})"


def condition_scores(design: Design) -> list[Scored]:
    """The numbers that a set states, each with the score of changing it."""
    asked = list(_stated(design.fit.calset))
    if not asked:
        return []
    columns = design.stacked([column[:, None] for column in _columns(design, asked)])
    there = np.flatnonzero(np.any(columns != 0.0, axis=0))  # a number may be stated and not used
    asked, columns = [asked[i] for i in there], columns[:, there]
    given = columns.copy()
    names = [str(number) for number in range(len(asked))]
    widths = [np.array([one.width]) for one in asked]
    space = ScoreSpace.projected(design.projector, names, widths, columns)
    residual = design.projector(design.residual)
    table = Scorer(space, np.random.default_rng(), draws=0)(columns.T @ residual, float(residual @ residual))
    return [
        Scored(one, table[name], column, float(square))
        for one, name, column, square in zip(asked, names, given.T, np.diag(space.gram), strict=True)
    ]


def _columns(design: Design, asked: Sequence[Stated]) -> Iterator[Float[np.ndarray, " _"]]:
    of_field = [one for one in asked if one.along is not None]
    by_place = [_column(design, one) for one in of_field[:2]]  # X and Y come first
    for one in asked:
        if one.along is None:
            yield _column(design, one)
        else:
            (in_x, in_y), (by_x, by_y) = one.along, by_place
            yield in_x[design.point] * by_x + in_y[design.point] * by_y


def _column(design: Design, one: Stated) -> np.ndarray:
    def residual(step: float) -> np.ndarray:
        likelihood = Likelihood.of(one.changed(step), design.fit.model)
        return likelihood.residuals(design.fit.values)[1][design.measured.used].reshape(-1)

    step = STEP * one.width
    return (residual(step) - residual(-step)) / (2.0 * step)


def _stated(calset: CalibrationSet) -> Iterator[Stated]:
    if len(calset.points) > 1:
        yield from _of_field(calset)
    for name in calset.filters:
        yield Stated(
            f"the wavelengths of filter {name}",
            "um",
            "check its curve, and what the polariser exposures were taken through",
            0.05,
            lambda step, name=name: _with_wavelength(calset, name, step),
            seen_by_stars=True,
        )
    e = calset.exposures
    for kind in np.unique(e.kind):
        chosen = (e.kind == kind) & np.isfinite(e.teff)
        if not chosen.any():
            continue
        typical = float(np.median(e.teff[chosen]))
        yield Stated(
            f"TEFF of exposures of kind {kind}",
            "K",
            "check the colour temperature of their light",
            typical,
            lambda step, chosen=chosen, typical=typical: with_exposures(
                lambda e: dataclasses.replace(e, teff=e.teff * np.where(chosen, 1.0 + step / typical, 1.0))
            )(calset),
            typical if np.ptp(e.teff[chosen]) == 0.0 else None,
        )


def _of_field(calset: CalibrationSet) -> Iterator[Stated]:
    check = "check X and Y against the frames (docs: conventions)"
    x, y = calset.points.x, calset.points.y
    radius, one = float(np.hypot(x, y).max()), np.ones(len(x))
    for what, unit, width, along in (
        ("X of all field points", "deg", radius, (one, 0.0 * one)),
        ("Y of all field points", "deg", radius, (0.0 * one, one)),
        ("the scale of X and Y", "", 1.0, (x, y)),
        ("the angle of the field", "rad", 1.0, (-y, x)),
    ):
        yield Stated(
            what,
            unit,
            check,
            width,
            lambda h, a=along: with_places(lambda x, y: (x + h * a[0], y + h * a[1]))(calset),
            along=along,
        )


def _with_wavelength(calset: CalibrationSet, name: str, step: float) -> CalibrationSet:
    curve = calset.filters[name]
    moved = dataclasses.replace(curve, wavelength=curve.wavelength + step)
    return dataclasses.replace(calset, filters={**calset.filters, name: moved})
