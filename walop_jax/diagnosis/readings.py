"""Recording mistakes: other readings of the data, each with its remedy and the set rewritten as the remedy says.

Cameras in another order, angles that run the other way or start elsewhere, a field that is mirrored, turned or in
other units, an element that was not in the beam, or was, another instrument: each makes residuals far beyond what any
effect makes, and each is undone by rewriting the set. `discrete` compares them.
"""

from __future__ import annotations

import dataclasses
import itertools
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from walop_jax.data.kinds import POLARISER
from walop_jax.data.records import Block, CalibrationSet, Exposures, Points, Position, Sources
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.diagnosis import thresholds
from walop_jax.fit.refit import FitResult
from walop_jax.instruments.description import shipped
from walop_jax.io.errors import DataError
from walop_jax.io.text import some
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.cameras import other_orders
from walop_jax.model.effects import Effect
from walop_jax.model.specification import Model

FEW = 64  # field points up to which sets are looked at whole
_NO_LIGHT = 0.05  # of the expected light, below which a camera sees nothing
_FIELD = 1.5  # of the designed field: what a field in other units must fit into
_FEW_FILTERS = 4  # up to which any two may be exchanged
_LISTED = 8  # exposures that a sentence lists

DataChange = Callable[[CalibrationSet], CalibrationSet]


def unchanged(calset: CalibrationSet) -> CalibrationSet:
    """The set as it is."""
    return calset


@dataclasses.dataclass(frozen=True)
class Alternative:
    """A discrete cause: what must have happened, what to do about it, and the set rewritten, or the model extended.

    `effects` are what the instrument differs by (a structural effect, another description); `explained` is the χ²/dof
    at the field points that were looked at. `number` says which number of the set is wrong, where that is the cause:
    a diagnosis of it is a verdict, not a refusal.
    """

    what: str
    remedy: str
    change: DataChange = unchanged
    effects: tuple[Effect, ...] = ()
    explained: float = np.inf
    number: str = ""

    def __str__(self) -> str:
        return f"{self.what} (χ²/dof = {self.explained:.3g}): {self.remedy}"

    @property
    def of_data(self) -> bool:
        """True if the data are to be corrected, not the model alone."""
        return self.change is not unchanged

    def beside(self, other: Alternative) -> Alternative:
        """This cause and another one together."""
        return Alternative(
            f"{self.what}, and {other.what}",
            f"{self.remedy}; and {other.remedy}",
            _one_after_the_other(self.change, other.change),
            (*self.effects, *other.effects),
        )

    def in_some(self, chosen: Bool[np.ndarray, " e"], where: str) -> Alternative:
        """The same mistake in some of the exposures alone; `where` names them."""
        return dataclasses.replace(
            self,
            what=f"{self.what} in {where}",
            remedy=f"{self.remedy}, in {where} alone",
            change=lambda calset: in_some_exposures(calset, self.change(calset), chosen),
        )


def _one_after_the_other(first: DataChange, second: DataChange) -> DataChange:
    """Both changes of a set; none where neither changes it."""
    if first is unchanged:
        return second
    return first if second is unchanged else lambda calset: second(first(calset))


def in_some_exposures(
    calset: CalibrationSet, other: CalibrationSet, chosen: Bool[np.ndarray, " e"]
) -> CalibrationSet:
    """A set with the chosen exposures, and their intensities, of another one of the same field points."""
    old, new = calset.exposures, other.exposures
    plain = [field.name for field in dataclasses.fields(old) if field.name != "positions"]
    columns = {name: np.where(chosen, getattr(new, name), getattr(old, name)) for name in plain}
    positions = {}
    for prefix, at in old.positions.items():
        then = new.position(prefix)
        pairs = ((then.inside, at.inside), (then.angle, at.angle), (then.turn, at.turn))
        positions[prefix] = Position(*(np.where(chosen, *pair) for pair in pairs))
    calset = dataclasses.replace(calset, exposures=Exposures(**columns, positions=positions))
    if other.intensities is calset.intensities:
        return calset
    there = other.intensities.block(0, len(other.points))
    return with_block(
        lambda b: {
            "counts": np.where(chosen[:, None], there.counts, b.counts),
            "sigma": np.where(chosen[:, None], there.sigma, b.sigma),
            "used": np.where(chosen, there.used, b.used),
            "source": np.where(chosen, there.source, b.source),
        }
    )(calset)


def listed(calset: CalibrationSet, chosen: Bool[np.ndarray, " e"]) -> str:
    """Some exposures in words: by their KIND where they are all of it, else by their numbers."""
    kind = calset.exposures.kind
    kinds = np.unique(kind[chosen])
    if len(kinds) and (chosen == np.isin(kind, kinds)).all() and len(kinds) < len(np.unique(kind)):
        return f"exposures of kind {' and '.join(kinds)}"
    return f"exposures {some([str(number) for number in calset.exposures.exposure[chosen]], _LISTED)}"


# ------------------------------------------------------------------------------------------- the alternatives


def readings(calset: CalibrationSet, model: Model) -> Iterator[Alternative]:
    """Readings that concern all exposures: cameras, angles, field points, moving elements in and out."""
    yield from _orders(model)
    yield from _angles(calset)
    yield from _columns_exchanged(calset)
    yield from _filters(calset)
    yield from _fields(calset, model)
    e = calset.exposures
    if e.clp_in.any():
        yield Alternative(
            "the calibration polariser was not in the beam",
            "set CLP_IN to F and CLP_ANGLE to NaN, or observe again",
            with_part("exposures", lambda e: e.placed(**{POLARISER: Position.out(len(e))})),
        )
    yield from _in_or_out(calset, model)


def _in_or_out(calset: CalibrationSet, model: Model) -> Iterator[Alternative]:
    """A moving plate that stayed in the beam, or never came there, whatever the exposures say."""
    e = calset.exposures
    for prefix in sorted({*e.positions, *model.template.patched().moving()} - {POLARISER}):
        inside = e.position(prefix).inside if prefix in e.positions else np.zeros(len(e), bool)
        if inside.any():
            yield Alternative(
                f"{prefix} was not in the beam",
                f"set {prefix}_IN to F and {prefix}_ANGLE to NaN",
                with_part("exposures", lambda e, prefix=prefix: e.placed(**{prefix: Position.out(len(e))})),
            )
        for angle in () if inside.all() else (0.0, 22.5, 45.0, 67.5):

            def stayed(at: Position, angle: float = angle) -> Position:
                return Position.at(np.where(at.inside, at.angle, angle))

            yield Alternative(
                f"{prefix} was in the beam, at {angle:g}°, where the exposures say that it was out",
                f"set {prefix}_IN to T and {prefix}_ANGLE to {angle:g}",
                with_part("exposures", lambda e, p=prefix, s=stayed: e.placed(**{p: s(e.position(p))})),
            )


def instruments(calset: CalibrationSet) -> Iterator[Alternative]:
    """Those that come with the package; each costs a program of its own, so they come last."""
    for name in shipped():
        if name != calset.instrument:
            yield Alternative(
                f"they came from {name}",
                f"correct INSTRUME, which says {calset.instrument}",
                lambda calset, name=name: dataclasses.replace(calset, instrument=name),
            )


def of_some_exposures(likelihood: Likelihood, worst: Sequence[int]) -> Iterator[Alternative]:
    """Readings that concern sky and standards, or single exposures, where these are among the worst."""
    yield from _dead(likelihood)
    calset = likelihood.calset
    yield from _rotators(calset, calset.exposures[np.array(worst)])
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


def _rotators(calset: CalibrationSet, worst: Exposures) -> Iterator[Alternative]:
    """ROTATOR of another sense, zero or unit, in all exposures that have it and in those of one KIND.

    They come before the signs of Q and U in the catalogue, which do the same to some data: a zero is wrong more often.
    """
    kind, turned = calset.exposures.kind, np.isfinite(calset.exposures.rotator)
    if not np.isfinite(worst.rotator).any():
        return
    kinds = np.unique(kind[turned])
    for what, change in (
        ("runs the other way", operator.neg),
        ("is 90° too small", lambda a: a + 90.0),
        ("is in radians", np.rad2deg),
    ):
        item = Alternative(
            f"ROTATOR {what}", "correct it (docs: conventions)", _with_column("rotator", change)
        )
        yield item
        for name in kinds if len(kinds) > 1 else ():
            yield item.in_some(kind == name, f"exposures of kind {name}")


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
    block = calset.intensities.block(0, min(len(calset.points), FEW))
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
    dead = (level < _NO_LIGHT * expected) & (
        np.nanmedian(lacking[:, exposures], axis=0) < -thresholds.SEPARATION
    )
    for k in np.flatnonzero(dead.any(axis=0) & ~dead.all(axis=0)):
        off = exposures[dead[:, k]]
        numbers = some([str(number) for number in calset.exposures.exposure[off]], _LISTED)
        yield Alternative(
            f"exposures {numbers} were left out, in which camera {model.template.cameras.names[k]} holds no light",
            "leave them out, or reduce them again",
            with_block(lambda b, off=off: {"used": b.used & ~np.isin(np.arange(b.used.shape[1]), off)}),
        )


def with_block(change: Callable[[Block], dict[str, np.ndarray]]) -> DataChange:
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


def with_part(part: str, change: Callable[[Any], Any]) -> DataChange:
    """A set with another of its parts: its exposures, sources or site."""
    return lambda calset: dataclasses.replace(calset, **{part: change(getattr(calset, part))})


def with_values(part: str, name: str, turn: Callable[[Any], Any]) -> DataChange:
    """A set with other values of one name in a part of it."""
    return with_part(part, lambda old: dataclasses.replace(old, **{name: turn(getattr(old, name))}))


def _with_column(column: str, turn: Callable[[np.ndarray], np.ndarray]) -> DataChange:
    return with_values("exposures", column, turn)


def _with_sources(turn: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> DataChange:
    def change(old: Sources) -> Sources:
        q, u = turn(old.q, old.u)
        return dataclasses.replace(old, q=q, u=u)

    return with_part("sources", change)


def _has_stars(calset: CalibrationSet, worst: Exposures) -> bool:
    polarised = bool(len(calset.sources) and np.hypot(calset.sources.q, calset.sources.u).max() > 0.0)
    return polarised and "standard" in worst.kind


def _has_moon(calset: CalibrationSet, worst: Exposures) -> bool:
    return bool(((worst.kind == "moon") & np.isfinite(worst.ra) & np.isfinite(worst.dec)).any())


def _below(column: str, limit: float) -> Callable[[CalibrationSet, Exposures], bool]:
    """Moon exposures in which a column is nowhere larger."""

    def concerned(calset: CalibrationSet, worst: Exposures) -> bool:
        values = np.abs(getattr(calset.exposures, column))
        return _has_moon(calset, worst) and float(np.nanmax(values)) <= limit

    return concerned


def _orders(model: Model) -> Iterator[Alternative]:
    names = model.template.cameras.names
    for order in other_orders(len(names)):
        held = ", ".join(names[k] for k in np.argsort(order))
        yield Alternative(
            f"the columns of N were in the order {held}",
            f"their order is {', '.join(names)}",
            with_block(lambda b, at=list(order): {"counts": b.counts[..., at], "sigma": b.sigma[..., at]}),
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
        for factor, what in ((2.0, "is half of the angle"), (0.5, "is twice the angle")):
            yield Alternative(
                f"{column} {what}",
                f"give {factor:g} {column}",
                _with_angle(prefix, lambda a, factor=factor: factor * a),
            )
        if np.nanmax(np.abs(position.angle)) <= 2.0 * np.pi:
            yield Alternative(
                f"{column} is in radians", "give degrees, or the unit of the column", _with_angle(prefix, np.rad2deg)
            )  # fmt: skip


def _columns_exchanged(calset: CalibrationSet) -> Iterator[Alternative]:
    """Columns of two moving elements, each with the prefix of the other."""
    moving = [prefix for prefix, at in calset.exposures.positions.items() if at.inside.any()]
    for one, other in itertools.combinations(moving, 2):
        yield Alternative(
            f"the columns of {one} and {other} were exchanged",
            f"exchange {one}_IN and {other}_IN, {one}_ANGLE and {other}_ANGLE",
            with_part(
                "exposures",
                lambda e, one=one, other=other: e.placed(**{one: e.position(other), other: e.position(one)}),
            ),
        )


def _filters(calset: CalibrationSet) -> Iterator[Alternative]:
    """Names of two filters exchanged; bins of a spectrum counted from the other end."""
    curves = calset.filters
    names = sorted(
        curves, key=lambda name: float(np.average(curves[name].wavelength, weights=curves[name].throughput))
    )
    for one, other in itertools.combinations(names, 2) if len(names) <= _FEW_FILTERS else ():
        yield Alternative(
            f"the filters {one} and {other} were exchanged",
            "exchange their names in FILTER",
            _with_column("filter", _renamed({one: other, other: one})),
        )
    if len(names) > 2:
        yield Alternative(
            f"the filters were counted from the other end, {names[-1]} as {names[0]}",
            "give FILTER in the order of their wavelengths",
            _with_column("filter", _renamed(dict(zip(names, names[::-1], strict=True)))),
        )


def _renamed(names: Mapping[str, str]) -> Callable[[np.ndarray], np.ndarray]:
    return lambda column: np.array([names.get(name, name) for name in column.tolist()])


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


def with_places(turn: Callable[..., tuple[np.ndarray, np.ndarray]]) -> DataChange:
    """A set with other coordinates: `turn` takes and gives X and Y."""

    def change(calset: CalibrationSet) -> CalibrationSet:
        x, y = turn(calset.points.x, calset.points.y)
        points = Points(calset.points.point, x, y)
        block = dataclasses.replace(calset.intensities.block(0, len(points)), x=x, y=y)
        return dataclasses.replace(calset, points=points, intensities=TableIntensities.dense(points, block))

    return change


def _with_angle(prefix: str, turned: Callable[[np.ndarray], np.ndarray]) -> DataChange:
    return with_part(
        "exposures", lambda e: e.placed(**{prefix: Position.at(turned(e.position(prefix).angle))})
    )


_AT = "give degrees, or the unit of the column"
_TABLE: tuple[tuple[str, str, Callable[[CalibrationSet, Exposures], bool], DataChange], ...] = (
    ("U of SOURCES had the other sign", "give −U (docs: conventions)", _has_stars, _with_sources(lambda q, u: (q, -u))),
    ("Q of SOURCES had the other sign", "give −Q (docs: conventions)", _has_stars, _with_sources(lambda q, u: (-q, u))),
    ("Q and U of SOURCES both had the other sign", "give −Q and −U", _has_stars, _with_sources(lambda q, u: (-q, -u))),
    ("Q and U of SOURCES were exchanged", "exchange them", _has_stars, _with_sources(lambda q, u: (u, q))),
    ("Q and U of SOURCES are in per cent", "give fractions", _has_stars,
     _with_sources(lambda q, u: (q / 100.0, u / 100.0))),
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
