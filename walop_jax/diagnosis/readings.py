"""Recording mistakes, tried where a fit explains nothing: other readings of the data.

Cameras in another order, angles that run the other way or start elsewhere, a field that is mirrored, turned or in
other units, a polariser that was not in the beam, another instrument: each makes residuals far beyond what any effect
makes, and each is undone by rewriting the set. An alternative is worth the χ² of a fit of the rewritten set at a few
field points,

    χ²(θ₀ + δ),   δ = −(JᵀJ/s² + P)⁻¹ (Jᵀr/s² + P(θ₀ − θ_prior)),

after one Gauss–Newton step from the model as designed, the errors of the data scaled by s as the fit of the set as it
stands asks for, so that priors hold what residuals of a wrong model would bend. The best ones take more steps. What
brings χ²/dof − 1 below a tenth of what the fit of the set as it stands has left, and below what a fit would call far
off, is reported.

Symbols     J, r Jacobian and whitened residuals; P inverse prior variances; θ₀ start values.
Limits      One mix-up at a time. Two that do the same to these data are reported together.
"""

from __future__ import annotations

import dataclasses
import itertools
import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from walop_jax.data.kinds import POLARISER
from walop_jax.data.records import Block, CalibrationSet, Exposures, Points, Position, Sources
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.diagnosis import thresholds
from walop_jax.fit.base_model import base_model, model_like
from walop_jax.fit.refit import FitResult, Vector
from walop_jax.fit.search import FAR_OFF
from walop_jax.instruments.description import shipped
from walop_jax.io.errors import DataError
from walop_jax.io.text import some
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.specification import Model

_POINTS, _FEW = 16, 64  # field points that are looked at; sets of so few are looked at whole
_STEPS = (1, 6)  # Gauss–Newton steps at the first look, and of the best
_BEST = 3  # alternatives that are looked at again
_ALL_ORDERS = 4  # cameras up to which all orders are tried, beyond pairs alone
_EXCHANGED = 5  # worst exposures, of which two may have been exchanged
_NO_LIGHT = 0.05  # of the expected light, below which a camera sees nothing, …
_MISSING = 20.0  # … if as many standard errors are missing
_FIELD = 1.5  # of the designed field: what a field in other units must fit into

Change = Callable[[CalibrationSet], CalibrationSet]


@dataclasses.dataclass(frozen=True)
class Alternative:
    """Another reading of a set: what must have happened, what to do about it, and the set rewritten.

    `explained` is its χ²/dof at the field points that were looked at.
    """

    what: str
    remedy: str
    change: Change
    explained: float = np.inf

    def __str__(self) -> str:
        return f"{self.what} (χ²/dof = {self.explained:.3g}): {self.remedy}"


def refuse_mixups(result: FitResult) -> None:
    """Raise `DataError` with the remedy if another reading of its data explains the residuals of a fit."""
    if alternatives := mixups_of(result):
        raise refusal(result, alternatives)


def mixups_of(result: FitResult) -> tuple[Alternative, ...]:
    """The readings of the data that explain the residuals of a fit, best first."""
    return mixups(result.calset, result.model, result.chi2 / result.dof) if result.dof > 0 else ()


def refusal(result: FitResult, alternatives: Sequence[Alternative]) -> DataError:
    """The error of data that other readings explain."""
    reasons = "; or if ".join(str(alternative) for alternative in alternatives)
    return DataError(
        f"the model does not fit (χ²/dof = {result.chi2 / result.dof:.3g}); it would if {reasons}"
    )


def mixups(calset: CalibrationSet, model: Model, left: float) -> tuple[Alternative, ...]:
    """The readings of the data that explain them, best first, where a fit misses them by a per cent or more.

    `left` is the χ²/dof of a fit of `model`.
    """
    if left < thresholds.POOR_FIT:
        return ()
    # The program that a small set was fitted with is there already.
    few = calset if len(calset.points) <= _FEW else thinned(calset, _POINTS, neighbours=1)
    block = few.intensities.block(0, len(few.points))
    lit = block.used[..., None] & (block.counts > 0)
    if not lit.any():
        return ()
    # A mistake in all exposures misses all of the light by so much.
    coarse = np.median(block.sigma[lit] / block.counts[lit]) * np.sqrt(left) >= thresholds.READING_COARSE
    few = dataclasses.replace(few, intensities=TableIntensities.dense(few.points, block))
    likelihood = Likelihood.of(few, model)
    stands, values = _misfit(likelihood, left, _STEPS[1])
    left = min(left, stands)
    if left < thresholds.POOR_FIT:  # the fit has lost its way, not the data
        return ()
    of_all = (_readings(few, model), _instruments(few)) if coarse and left >= FAR_OFF else ()
    for readings in (_of_some_exposures(likelihood, _worst_exposures(likelihood, values)), *of_all):
        tried = [_judged(item, few, model, left, _STEPS[0]) for item in readings]
        tried = sorted(tried, key=lambda item: item.explained)[:_BEST]
        best = [_judged(item, few, model, item.explained, _STEPS[1]) for item in tried]
        enough = min(1.0 + (left - 1.0) / thresholds.PART, FAR_OFF)
        good = sorted((item for item in best if item.explained < enough), key=lambda item: item.explained)
        if good:
            alike = thresholds.READING_ALIKE * good[0].explained
            return tuple(item for item in good if item.explained < alike)
    return ()


def _judged(
    item: Alternative, calset: CalibrationSet, model: Model, misfit: float, steps: int
) -> Alternative:
    """An alternative with χ²/dof after some Gauss–Newton steps from the model as designed; ∞ where none can be made."""
    try:
        rewritten = item.change(calset)
        if rewritten.instrument != calset.instrument:
            model = base_model(rewritten)
        elif rewritten.sources is not calset.sources:  # their priors
            model = model_like(rewritten, model)
        return dataclasses.replace(item, explained=_misfit(Likelihood.of(rewritten, model), misfit, steps)[0])
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


# ------------------------------------------------------------------------------------------- the alternatives


def _readings(calset: CalibrationSet, model: Model) -> Iterator[Alternative]:
    yield from _orders(model)
    yield from _angles(calset)
    yield from _fields(calset, model)
    e = calset.exposures
    if e.clp_in.any():
        yield Alternative(
            "the calibration polariser was not in the beam",
            "set CLP_IN to F and CLP_ANGLE to NaN, or observe again",
            with_part("exposures", lambda e: e.placed(**{POLARISER: Position.out(len(e))})),
        )


def _instruments(calset: CalibrationSet) -> Iterator[Alternative]:
    """Those that come with the package; each costs a program of its own, so they come last."""
    for name in shipped():
        if name != calset.instrument:
            yield Alternative(
                f"they came from {name}",
                f"correct INSTRUME, which says {calset.instrument}",
                lambda calset, name=name: dataclasses.replace(calset, instrument=name),
            )


def _of_some_exposures(likelihood: Likelihood, worst: Sequence[int]) -> Iterator[Alternative]:
    """Readings that concern sky and standards, or single exposures, where these are among the worst."""
    yield from _dead(likelihood)
    calset = likelihood.calset
    for what, remedy, concerned, change in _TABLE:
        if concerned(calset, calset.exposures[np.array(worst)]):
            yield Alternative(what, remedy, change)
    yield from _signs_of_stars(calset, worst)
    number = calset.exposures.exposure
    for pair in itertools.combinations(sorted(worst), 2):
        first, second = (number[i] for i in pair)
        yield Alternative(
            f"the intensities of exposures {first} and {second} were exchanged",
            "exchange their EXPOSURE numbers in the table of intensities",
            lambda calset, pair=pair: _exchanged(calset, pair),
        )


def _signs_of_stars(calset: CalibrationSet, worst: Sequence[int]) -> Iterator[Alternative]:
    """Signs of q and u of single standards among the worst exposures, where several stars are polarised."""
    polarised = np.hypot(calset.sources.q, calset.sources.u) > 0.0
    if len(np.unique(calset.sources.source[polarised])) < 2:
        return
    observed = np.unique(calset.intensities.block(0, len(calset.points)).source[:, list(worst)])
    for star in observed[observed >= 0].tolist():
        q, u = calset.sources.q[star], calset.sources.u[star]
        for column, signs in (("Q", (-1, 1)), ("U", (1, -1)), ("Q and U", (-1, -1))):
            if all(value != 0.0 for value, sign in zip((q, u), signs, strict=True) if sign < 0):
                factors = [
                    np.where(calset.sources.source == calset.sources.source[star], s, 1) for s in signs
                ]
                yield Alternative(
                    f"{column} of {calset.sources.name[star]} in SOURCES had the other sign",
                    "correct its row (docs: conventions)",
                    _with_sources(lambda q, u, factors=factors: (factors[0] * q, factors[1] * u)),
                )


def refuse_dead_cameras(result: FitResult) -> None:
    """Raise `DataError` for a camera with one and the same number at all field points in all exposures.

    A fit takes that for a camera that sees little light.
    """
    calset = result.calset
    block = calset.intensities.block(0, min(len(calset.points), _FEW))
    repeated = block.used.sum(axis=0) > 1
    if not repeated.any():
        return
    counts = np.where(block.used[..., None], block.counts, np.nan)[:, repeated]
    still = np.nanmax(counts, axis=(0, 1)) == np.nanmin(counts, axis=(0, 1))
    if still.any():
        names = ", ".join(np.array(result.model.template.cameras.names)[still])
        raise DataError(
            f"INTENSITIES, N: camera {names} has the same number everywhere: it was dead, or its column was "
            "not filled; check it, or describe an instrument without it"
        )


def _dead(likelihood: Likelihood) -> Iterator[Alternative]:
    """A camera that sees nothing where the instrument as designed expects light, in some exposures: these left out."""
    calset, model = likelihood.calset, likelihood.model
    block = calset.intensities.block(0, len(calset.points))
    _, residual = likelihood.residuals(model.start)
    lacking = np.where(block.used[..., None], residual, np.nan)
    exposures = np.flatnonzero(block.used.any(axis=0))
    expected = np.nanmedian((block.counts - lacking * block.sigma)[:, exposures], axis=0)
    level = np.nanmedian(np.where(block.used[..., None], block.counts, np.nan)[:, exposures], axis=0)
    dead = (level < _NO_LIGHT * expected) & (np.nanmedian(lacking[:, exposures], axis=0) < -_MISSING)
    for k in np.flatnonzero(dead.any(axis=0) & ~dead.all(axis=0)):
        off = exposures[dead[:, k]]
        listed = some([str(number) for number in calset.exposures.exposure[off]], 6)
        yield Alternative(
            f"exposures {listed} were left out, in which camera {model.template.cameras.names[k]} holds no light",
            "leave them out, or reduce them again",
            _with_block(lambda b, off=off: {"used": b.used & ~np.isin(np.arange(b.used.shape[1]), off)}),
        )


def _with_block(change: Callable[[Block], dict[str, np.ndarray]]) -> Change:
    """A set with other intensities: `change` gives the arrays that differ."""

    def changed(calset: CalibrationSet) -> CalibrationSet:
        block = calset.intensities.block(0, len(calset.points))
        block = dataclasses.replace(block, **change(block))
        return dataclasses.replace(calset, intensities=TableIntensities.dense(calset.points, block))

    return changed


def _exchanged(calset: CalibrationSet, pair: tuple[int, int]) -> CalibrationSet:
    """The set with the conditions of two exposures exchanged: angles, time, pointing, all but the number."""
    order = np.arange(len(calset.exposures))
    order[list(pair)] = pair[::-1]
    swapped = dataclasses.replace(calset.exposures[order], exposure=calset.exposures.exposure)
    return dataclasses.replace(calset, exposures=swapped)


def with_part(part: str, change: Callable[[Any], Any]) -> Change:
    """A set with another of its parts: its exposures, sources or site."""
    return lambda calset: dataclasses.replace(calset, **{part: change(getattr(calset, part))})


def with_values(part: str, name: str, turn: Callable[[Any], Any]) -> Change:
    """A set with other values of one name in a part of it."""
    return with_part(part, lambda old: dataclasses.replace(old, **{name: turn(getattr(old, name))}))


def _with_column(column: str, turn: Callable[[np.ndarray], np.ndarray]) -> Change:
    return with_values("exposures", column, turn)


def _with_sources(turn: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Change:
    def change(old: Sources) -> Sources:
        q, u = turn(old.q, old.u)
        return dataclasses.replace(old, q=q, u=u)

    return with_part("sources", change)


def _has_stars(calset: CalibrationSet, worst: Exposures) -> bool:
    polarised = bool(len(calset.sources) and np.hypot(calset.sources.q, calset.sources.u).max() > 0.0)
    return polarised and "standard" in worst.kind


def _has_moon(calset: CalibrationSet, worst: Exposures) -> bool:
    return bool(((worst.kind == "moon") & np.isfinite(worst.ra) & np.isfinite(worst.dec)).any())


def _has_rotator(calset: CalibrationSet, worst: Exposures) -> bool:
    return bool(np.isfinite(worst.rotator).any())


def _below(column: str, limit: float) -> Callable[[CalibrationSet, Exposures], bool]:
    """Moon exposures in which a column is nowhere larger."""

    def concerned(calset: CalibrationSet, worst: Exposures) -> bool:
        values = np.abs(getattr(calset.exposures, column))
        return _has_moon(calset, worst) and float(np.nanmax(values)) <= limit

    return concerned


def _orders(model: Model) -> Iterator[Alternative]:
    names = model.template.cameras.names
    count = len(names)
    if count <= _ALL_ORDERS:
        orders = list(itertools.permutations(range(count)))[1:]
    else:
        pairs = itertools.combinations(range(count), 2)
        orders = [tuple(b if k == a else a if k == b else k for k in range(count)) for a, b in pairs]
    for order in orders:
        held = ", ".join(names[k] for k in np.argsort(order))
        yield Alternative(
            f"the columns of N were in the order {held}",
            f"their order is {', '.join(names)}",
            _with_block(lambda b, at=list(order): {"counts": b.counts[..., at], "sigma": b.sigma[..., at]}),
        )


def _angles(calset: CalibrationSet) -> Iterator[Alternative]:
    e = calset.exposures
    for prefix, position in e.positions.items():
        if not position.inside.any():
            continue
        column = f"{prefix}_ANGLE"
        for sign, offset in itertools.product((1.0, -1.0), (0.0, 45.0, 90.0, 135.0)):
            if (sign, offset) == (1.0, 0.0):
                continue
            runs = "runs the other way" if sign < 0 else ""
            starts = f"is {offset:g}° too small" if offset else ""
            yield Alternative(
                f"{column} {' and '.join(text for text in (runs, starts) if text)}",
                f"give {'−' if sign < 0 else ''}{column}{f' + {offset:g}°' if offset else ''}",
                _with_angle(prefix, lambda a, sign=sign, offset=offset: sign * a + offset),
            )
        if np.nanmax(np.abs(position.angle)) <= 2.0 * np.pi:
            yield Alternative(
                f"{column} is in radians", "give degrees, or the unit of the column", _with_angle(prefix, np.rad2deg)
            )  # fmt: skip


def _fields(calset: CalibrationSet, model: Model) -> Iterator[Alternative]:
    turns: tuple[tuple[str, str, Callable[..., tuple[np.ndarray, np.ndarray]]], ...] = (
        ("X runs the other way", "give −X", lambda x, y: (-x, y)),
        ("Y runs the other way", "give −Y", lambda x, y: (x, -y)),
        ("the field is turned by 180°", "give −X and −Y", lambda x, y: (-x, -y)),
        ("the field is turned by 90°", "give −Y as X, and X as Y", lambda x, y: (-y, x)),
        ("the field is turned by −90°", "give Y as X, and −X as Y", lambda x, y: (y, -x)),
        ("X and Y are exchanged", "exchange them", lambda x, y: (y, x)),
        ("X and Y are exchanged and run the other way", "give −Y as X, and −X as Y", lambda x, y: (-y, -x)),
    )  # fmt: skip
    for what, remedy, turn in turns:
        yield Alternative(what, remedy, with_places(turn))
    extent = model.template.field_limit
    far = float(np.hypot(calset.points.x, calset.points.y).max())
    for unit, factor in (("arcmin", 1.0 / 60.0), ("arcsec", 1.0 / 3600.0), ("radians", np.rad2deg(1.0))):
        if 0.05 * extent < factor * far < _FIELD * extent:
            yield Alternative(
                f"X and Y are in {unit}",
                "give degrees, or the unit of the columns",
                with_places(lambda x, y, factor=factor: (factor * x, factor * y)),
            )


def with_places(turn: Callable[..., tuple[np.ndarray, np.ndarray]]) -> Change:
    """A set with other coordinates: `turn` takes and gives X and Y."""

    def change(calset: CalibrationSet) -> CalibrationSet:
        x, y = turn(calset.points.x, calset.points.y)
        points = Points(calset.points.point, x, y)
        block = dataclasses.replace(calset.intensities.block(0, len(points)), x=x, y=y)
        return dataclasses.replace(calset, points=points, intensities=TableIntensities.dense(points, block))

    return change


def _with_angle(prefix: str, turned: Callable[[np.ndarray], np.ndarray]) -> Change:
    return with_part(
        "exposures", lambda e: e.placed(**{prefix: Position.at(turned(e.position(prefix).angle))})
    )


_AT = "give degrees, or the unit of the column"
_TABLE: tuple[tuple[str, str, Callable[[CalibrationSet, Exposures], bool], Change], ...] = (
    ("U of SOURCES had the other sign", "give −U (docs: conventions)", _has_stars, _with_sources(lambda q, u: (q, -u))),
    ("Q of SOURCES had the other sign", "give −Q (docs: conventions)", _has_stars, _with_sources(lambda q, u: (-q, u))),
    ("Q and U of SOURCES both had the other sign", "give −Q and −U", _has_stars, _with_sources(lambda q, u: (-q, -u))),
    ("Q and U of SOURCES were exchanged", "exchange them", _has_stars, _with_sources(lambda q, u: (u, q))),
    ("Q and U of SOURCES are in per cent", "give fractions", _has_stars,
     _with_sources(lambda q, u: (q / 100.0, u / 100.0))),
    ("ROTATOR runs the other way", "correct it (docs: conventions)", _has_rotator,
     _with_column("rotator", operator.neg)),
    ("ROTATOR is 90° too small", "correct it (docs: conventions)", _has_rotator,
     _with_column("rotator", lambda a: a + 90.0)),
    ("ROTATOR is in radians", "correct it (docs: conventions)", _has_rotator, _with_column("rotator", np.rad2deg)),
    ("RA is in hours", _AT, _below("ra", 24.0), _with_column("ra", lambda a: 15.0 * a)),
    ("RA is in radians", _AT, _below("ra", 2.0 * np.pi), _with_column("ra", np.rad2deg)),
    ("DEC is in radians", _AT, _below("dec", 0.5 * np.pi), _with_column("dec", np.rad2deg)),
    ("RA and DEC are exchanged", "exchange them", _below("ra", 90.0),
     with_part("exposures", lambda e: dataclasses.replace(e, ra=np.mod(e.dec, 360.0), dec=e.ra))),
    ("DEC has the other sign", "give −DEC", _has_moon, _with_column("dec", operator.neg)),
    *(
        (f"MJD is {abs(days):g} d too {'large' if days > 0 else 'small'}",
         "give MJD = JD − 2400000.5, UTC at mid-exposure", _has_moon, _with_column("mjd", lambda t, d=days: t - d))
        for days in (0.5, -0.5, 1.0, -1.0)
    ),
    ("SITELONG has the other sign", "east is positive", _has_moon, with_values("site", "longitude", operator.neg)),
    ("SITELAT has the other sign", "north is positive", _has_moon, with_values("site", "latitude", operator.neg)),
)  # fmt: skip
"""Readings of sky and standards: what must have happened, what to do, the sets it can have happened to, the cure."""
