"""Other readings of the rows of a catalogue: what may have been mistaken, and how well stars agree with each.

A reading rewrites the rows as they should be. It is judged by a few hundred bright stars, with

    Σ min(χ², `CAP` ν) + 4 n ln s        χ² of a star with `FLOOR` of its light added to the errors,
                                         s the robust scatter of q and u of the n stars that measure them,

the second because two cameras of one arm can be exchanged without a trace in χ²: the cross-talk, wrongly taken out,
then stays in q and u.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize, special

from walop_jax.calibration.analysis_vectors import COLOURS, AnalysisVectors, colour_weights
from walop_jax.data.settings import BUILTIN_FILTERS, Settings
from walop_jax.instruments.description import shipped
from walop_jax.io.text import with_minus_sign
from walop_jax.model.cameras import other_orders
from walop_jax.science.estimate import estimate
from walop_jax.science.star_columns import LARGEST
from walop_jax.sky.position_angles import sky_to_instrument

FEWEST = 8
IMPROBABLE = 1e-3  # probability of a χ² as large below which a star disagrees
FLOOR = 0.002  # of the light: what a calibration or a flat field may be off by, and nobody minds
CAP = 50.0  # χ² per degree of freedom beyond which a star is off, however far
KNOWN = 0.1  # error of q and u together from which a star says nothing of their scatter
_STILL = 0.002  # scatter of q and u that is not told from none
_MAGNITUDES = 40.0  # |N| that no magnitude reaches
_STEP = 5.0  # deg, of turns of the field that are tried
_SHIFTS = 8  # to either side, in the range that is tried: …
_FINE = 0.005  # deg, about what a part of the stars says
_RANGE = 0.75  # … this share of the field
_SEARCHED = 100  # stars that turns, shifts and scales are searched with
_SCALES = np.geomspace(0.3, 3.0, 60)
"""Factors on positions that are tried: a step moves stars at the edge as much as one of `_STEP` does."""
_SAME = 0.02  # by which a scale may be another: optics change by less, and calibrations know theirs to less
_CONVERGENCE = 3.0  # deg, of the meridians over a field

OfRows = Float[np.ndarray, " r"]
Turn = Callable[[OfRows, OfRows], tuple[OfRows, OfRows]]


@dataclasses.dataclass(frozen=True)
class CatalogueRows:
    """Rows of whole stars: field positions and ROTATOR (deg; NaN: none), counts and errors (electron), settings.

    `star` numbers the stars from 0 in ascending order. `rewritten` is True where counts are other than they were given.
    """

    star: Int[np.ndarray, " r"]
    x: OfRows
    y: OfRows
    rotator: OfRows
    counts: Float[np.ndarray, "r k"]
    sigma: Float[np.ndarray, "r k"]
    settings: Settings

    def of(self, keep: Bool[np.ndarray, " r"]) -> CatalogueRows:
        """Some of the rows, of whole stars."""
        arrays = {n: v[keep] for n, v in vars(self).items() if isinstance(v, np.ndarray)}
        arrays["star"] = np.unique(arrays["star"], return_inverse=True)[1].reshape(-1)
        return CatalogueRows(**arrays, settings=self.settings[np.flatnonzero(keep)])

    def changed(self, **columns: Any) -> CatalogueRows:
        """The same with other columns."""
        return dataclasses.replace(self, **columns)


class Fit(NamedTuple):
    """How well stars agree with a reading: the sum of the head of this file, the share that disagrees, the scatter s.

    `misfit` is the part of χ² in the sum, of which `dof` is expected at most.
    """

    loss: float
    disagree: float
    scatter: float
    misfit: float = np.inf
    dof: float = 0.0


NO_FIT = Fit(np.inf, 1.0, np.inf)
"""Of rows that a reading cannot be of."""


@dataclasses.dataclass(frozen=True)
class CatalogueReading:
    """Another reading of a catalogue: what must have happened, what to do about it, how well the stars agree then.

    `usual` are changes as instruments have them: no mistake of the catalogue. A number that was `searched` for among
    all of its values must make χ² smaller, not only the scatter of q and u.
    """

    what: str
    remedy: str
    change: Callable[[CatalogueRows], CatalogueRows]
    fit: Fit = NO_FIT
    usual: bool = False
    searched: bool = False

    def document(self) -> dict[str, Any]:
        """The reading as plain data."""
        return {
            "what": self.what,
            "remedy": self.remedy,
            "disagree": self.fit.disagree,
            "scatter": self.fit.scatter,
        }


class Judge:
    """Fits of rows by a calibration, by its tables of vectors."""

    def __init__(self, vectors: AnalysisVectors) -> None:
        self.vectors = vectors

    def judged(self, reading: CatalogueReading, rows: CatalogueRows) -> CatalogueReading:
        """A reading with how well it fits; not at all where it cannot be made."""
        try:
            return dataclasses.replace(reading, fit=self.fit(reading.change(rows)))
        except (ValueError, np.linalg.LinAlgError):
            return reading

    def vectors_at(self, rows: CatalogueRows) -> Float[np.ndarray, "r k 3"]:
        """Analysis vectors of rows in the frame of the instrument."""
        settings = self.vectors.reduced(rows.settings)
        found = np.empty((len(rows.x), self.vectors.cameras, 3))
        for setting, same in settings.optics():
            teff = settings.teff[same]
            spectra = self.vectors.at(setting, rows.x[same], rows.y[same])
            found[same] = np.einsum("rc,rcks->rks", colour_weights(teff, COLOURS), spectra)
        return found

    def within(self, rows: CatalogueRows) -> CatalogueRows:
        """Rows of stars that lie in the field."""
        outside = np.maximum(np.abs(rows.x), np.abs(rows.y)) > self.vectors.half_width
        return rows.of(np.bincount(rows.star, outside)[rows.star] == 0) if outside.any() else rows

    def unpolarised(self, rows: CatalogueRows) -> tuple[Float[np.ndarray, "r k"], Float[np.ndarray, "r k"]]:
        """Counts of the rows in the field, and those of unpolarised stars of unit flux."""
        rows = self.within(rows)
        return rows.counts, self.vectors_at(rows)[..., 0]

    def fit(self, rows: CatalogueRows) -> Fit:
        """How well rows agree; stars beyond the field do not count, unless most lie there."""
        count = int(rows.star.max()) + 1
        rows = self.within(rows)
        if len(rows.x) == 0 or rows.star.max() + 1 < 0.5 * count:
            return NO_FIT
        vectors = self.vectors_at(rows)
        sky = np.isfinite(rows.rotator)
        turn = np.where(sky, rows.rotator, 0.0)
        axes = sky_to_instrument(vectors[..., 1], vectors[..., 2], -turn[:, None])
        on_sky = np.stack([vectors[..., 0], *axes], axis=-1)
        sigma = np.hypot(rows.sigma, FLOOR * np.abs(np.nan_to_num(rows.counts)))
        found = estimate(on_sky, rows.counts, sigma, rows.star, self.vectors.instrument.cameras)
        good = np.isfinite(found.qu).all(axis=1)
        # Without a camera to spare any counts agree: the scatter alone tells readings apart.
        off = np.where(good, np.where(found.dof > 0, found.chi2, 0.0), np.inf)
        dof = np.maximum(found.dof, 1)
        limit = special.chdtri(dof, IMPROBABLE)
        loss = np.minimum(off, CAP * dof)
        with np.errstate(invalid="ignore"):
            clear = good & (np.trace(found.photon, axis1=1, axis2=2) < KNOWN**2)
        number, scatter = int(clear.sum()), _STILL
        if number >= FEWEST:
            away = found.qu[clear] - np.median(found.qu[clear], axis=0)
            square = float(np.median(np.sum(away**2, axis=1))) / (2.0 * np.log(2.0))
            scatter = float(np.hypot(np.sqrt(square), _STILL))
        share = count / max(len(loss), 1)
        total = share * (float(loss.sum()) + 4.0 * number * float(np.log(scatter)))
        return Fit(
            total, float(np.mean(off > limit)), scatter, share * float(loss.sum()), share * float(dof.sum())
        )


# ----------------------------------------------------------------------------------------------- the readings


def orders(names: Sequence[str], arms: Sequence[Sequence[int]] | None = None) -> Iterator[CatalogueReading]:
    """Other orders of the cameras: all, or with `arms` those that leave each arm its cameras."""
    count = len(names)
    if arms is not None:
        flips = itertools.product((False, True), repeat=len(arms))
        tried = []
        for flip in flips:
            order = list(range(count))
            for arm, turned in zip(arms, flip, strict=True):
                for k, other in zip(arm, reversed(arm) if turned else arm, strict=True):
                    order[k] = other
            tried.append(tuple(order))
        tried = [order for order in tried if order != tuple(range(count))]
    else:
        tried = other_orders(count)
    for order in tried:
        held = ", ".join(names[int(k)] for k in np.argsort(order))
        yield CatalogueReading(
            f"the columns of N and N_ERR were in the order {held}",
            f"their order is {', '.join(names)}: exchange the files or columns",
            lambda r, at=list(order): r.changed(counts=r.counts[:, at], sigma=r.sigma[:, at]),
        )


def units(rows: CatalogueRows) -> Iterator[CatalogueReading]:
    """Magnitudes in the place of intensities."""
    if rows.counts.size and np.nanmax(np.abs(rows.counts)) < _MAGNITUDES:

        def intensities(r: CatalogueRows) -> CatalogueRows:
            counts = 10.0 ** (-0.4 * (r.counts - np.nanmedian(r.counts)))
            return r.changed(counts=counts, sigma=0.4 * np.log(10.0) * counts * r.sigma)

        yield CatalogueReading(
            "N were magnitudes", "give intensities in electrons: they add up, magnitudes do not", intensities
        )


def _placed(turn: Turn) -> Callable[[CatalogueRows], CatalogueRows]:
    def change(rows: CatalogueRows) -> CatalogueRows:
        x, y = turn(rows.x, rows.y)
        return rows.changed(x=x, y=y)

    return change


MIRRORED: tuple[tuple[str, str, Turn], ...] = (
    ("X and Y were exchanged", "exchange them", lambda x, y: (y, x)),
    ("X ran the other way", "give −X", lambda x, y: (-x, y)),
    ("Y ran the other way", "give −Y", lambda x, y: (x, -y)),
    ("X and Y were exchanged and ran the other way", "give −Y as X, and −X as Y", lambda x, y: (-y, -x)),
)
"""Mistakes by which the field is a mirror image of itself."""


def fields() -> Iterator[CatalogueReading]:
    """Mirror images of the field."""
    for what, remedy, turn in MIRRORED:
        yield CatalogueReading(what, remedy, _placed(turn))


def turned(x: OfRows, y: OfRows, angle: float | OfRows) -> tuple[OfRows, OfRows]:
    """X and Y of the same stars if ROTATOR were larger by an angle (deg)."""
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    return c * x + s * y, c * y - s * x


def rotators(rows: CatalogueRows) -> Iterator[CatalogueReading]:
    """ROTATOR of another sign, zero or unit, where X and Y were made with it, and where they were not."""
    known = np.isfinite(rows.rotator)
    if not known.all():
        return
    typical = float(np.rad2deg(np.angle(np.mean(np.exp(1j * np.deg2rad(rows.rotator))))))
    changes: list[tuple[str, str, Callable[[OfRows], OfRows]]] = []
    changes.append(("ROTATOR had the wrong sign", "give −ROTATOR", lambda r: -r))
    for quarters in (90.0, 180.0, -90.0):
        what = f"ROTATOR were {abs(quarters):g}° {'larger' if quarters > 0 else 'smaller'}"
        changes.append((what, "correct it (docs: conventions)", lambda r, d=quarters: r + d))
    if np.abs(rows.rotator).max() <= 2.0 * np.pi:
        changes.append(("ROTATOR were in radians", "give degrees, or the unit of the column", np.rad2deg))
    # ROTATOR differs between the stars of one pointing by the convergence of the meridians.
    one = bool(np.all(np.cos(np.deg2rad(rows.rotator - typical)) > np.cos(np.deg2rad(_CONVERGENCE))))
    several = np.ptp(np.cos(2.0 * np.deg2rad(rows.rotator - typical))) > 0.1
    made = "; X and Y are made with it"
    for what, remedy, change in changes:

        def both(r: CatalogueRows, change: Callable[[OfRows], OfRows] = change) -> CatalogueRows:
            centre = np.full(len(r.x), typical) if one else r.rotator
            turn = change(centre) - centre
            x, y = turned(r.x, r.y, turn)
            return r.changed(x=x, y=y, rotator=r.rotator + turn)

        number = with_minus_sign(f"{change(np.array([typical]))[0]:.4g}")
        size = f", {number}° in place of {with_minus_sign(f'{typical:.4g}')}°"
        yield CatalogueReading(what + size, remedy + made, both)
        if several:
            yield CatalogueReading(
                what, remedy, lambda r, change=change: r.changed(rotator=change(r.rotator))
            )


def turns(judge: Judge, rows: CatalogueRows) -> Iterator[CatalogueReading]:
    """The field turned by any angle, which is searched."""
    few = _some_of(rows)

    def loss(angle: float) -> float:
        return judge.fit(_placed(lambda x, y: turned(x, y, angle))(few)).misfit

    angles = np.arange(_STEP, 360.0, _STEP)
    losses = [loss(float(angle)) for angle in angles]
    start = float(angles[int(np.argmin(losses))])
    best: Any = optimize.minimize_scalar(loss, bounds=(start - _STEP, start + _STEP), method="bounded")
    angle = (float(best.x) + 180.0) % 360.0 - 180.0
    number = with_minus_sign(f"{angle:+.2f}")
    yield CatalogueReading(
        f"X and Y were turned by {number}°, as a ROTATOR that is {number}° larger turns them",
        "correct the rotator of the pointing",
        _placed(lambda x, y: turned(x, y, angle)),
        searched=True,
    )


def radians(judge: Judge, rows: CatalogueRows) -> Iterator[CatalogueReading]:
    """X and Y in radians, where the field would hold them."""
    largest = max(float(np.abs(rows.x).max()), float(np.abs(rows.y).max()))
    if 0 < np.rad2deg(largest) <= 1.5 * judge.vectors.half_width:
        yield CatalogueReading(
            "X and Y were in radians", "give degrees", _placed(lambda x, y: (np.rad2deg(x), np.rad2deg(y)))
        )


def scales(judge: Judge, rows: CatalogueRows) -> Iterator[CatalogueReading]:
    """The field stretched, as a whole or along right ascension, by factors that are searched."""
    few = _some_of(rows)

    def best(turn: Callable[[float], Turn]) -> tuple[float, Turn]:
        def loss(logarithm: float) -> float:
            return min(judge.fit(_placed(turn(float(np.exp(logarithm))))(few)).misfit, 1e30)

        tried = np.log(_SCALES)
        start, step = float(tried[int(np.argmin([loss(float(one)) for one in tried]))]), tried[1] - tried[0]
        found: Any = optimize.minimize_scalar(loss, bounds=(start - step, start + step), method="bounded")
        factor = float(np.exp(found.x))
        return factor, turn(factor)

    factor, turn = best(lambda factor: lambda x, y: (factor * x, factor * y))
    yield CatalogueReading(
        f"X and Y were {factor:.4g} times as large",
        "correct the scale of the pixels",
        _placed(turn),
        usual=bool(abs(np.log(factor)) < _SAME),
        searched=True,
    )
    known = rows.rotator[np.isfinite(rows.rotator)]
    if not known.size:
        return
    angle = float(np.angle(np.mean(np.exp(1j * np.deg2rad(known)))))
    s, c = np.sin(angle), np.cos(angle)

    def stretched(factor: float) -> Turn:
        """X and Y where the distance to the east is another one."""

        def of(x: OfRows, y: OfRows) -> tuple[OfRows, OfRows]:
            more = (factor - 1.0) * (x * s + y * c)
            return x + more * s, y + more * c

        return of

    factor, turn = best(stretched)
    dec = f" (DEC of ±{np.rad2deg(np.arccos(factor)):.1f}°)" if factor < 1.0 else ""
    yield CatalogueReading(
        f"distances along right ascension were {factor:.4g} times as large",
        f"is the difference of right ascension multiplied by the cosine of DEC, once{dec}?",
        _placed(turn),
        usual=bool(abs(np.log(factor)) < _SAME),
        searched=True,
    )


def shifts(judge: Judge, rows: CatalogueRows) -> Iterator[CatalogueReading]:
    """The field shifted, by what is searched."""
    few, reach = _some_of(rows), _RANGE * judge.vectors.half_width

    def moved(shift: Float[np.ndarray, " 2"]) -> Callable[[CatalogueRows], CatalogueRows]:
        dx, dy = shift.tolist()
        return _placed(lambda x, y: (x + dx, y + dy))

    def misfit(shift: Float[np.ndarray, " 2"], of: CatalogueRows = few) -> float:
        return min(judge.fit(moved(shift)(of)).misfit, 1e30)

    steps = np.linspace(-reach, reach, 2 * _SHIFTS + 1)
    best = min((np.array(pair) for pair in itertools.product(steps, steps)), key=misfit)
    for of, step in ((few, 0.5 * reach / _SHIFTS), (rows, _FINE)):
        simplex = best + step * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        options = {"xatol": 1e-4, "fatol": 0.1, "initial_simplex": simplex, "maxiter": 120}
        best = optimize.minimize(misfit, best, (of,), method="Nelder-Mead", options=options).x
    x, y = (with_minus_sign(f"{value:+.4f}") for value in best)
    where = ""
    known = rows.rotator[np.isfinite(rows.rotator)]
    if known.size:
        angle = np.angle(np.mean(np.exp(1j * np.deg2rad(known))))
        east = best[0] * np.sin(angle) + best[1] * np.cos(angle)
        north = best[0] * np.cos(angle) - best[1] * np.sin(angle)
        sides = (
            f"{abs(east):.4f}° {'west' if east > 0 else 'east'}",
            f"{abs(north):.4f}° {'south' if north > 0 else 'north'}",
        )
        where = f": the field centre lies {' and '.join(sides)} of the one that was taken"
    yield CatalogueReading(
        f"all stars lay at X {x}° and Y {y}° from where they are said to be{where}",
        "correct RA and DEC of the pointing, or the zero of X and Y",
        moved(best),
        searched=True,
    )


def _some_of(rows: CatalogueRows) -> CatalogueRows:
    """Every n-th star of rows, some `_SEARCHED` of them."""
    every = -(-(int(rows.star.max()) + 1) // _SEARCHED)
    return rows.of(rows.star % every == 0)


def filters(vectors: AnalysisVectors, rows: CatalogueRows) -> Iterator[CatalogueReading]:
    """Other filters, where all rows are of one."""
    stated = np.unique(rows.settings.filter)
    if len(stated) > 1:
        return
    held = vectors.calibration
    names = dict.fromkeys([*np.unique(held.exposures.filter).tolist(), *held.filters, *BUILTIN_FILTERS])
    for name in names:
        if name != stated[0]:

            def change(r: CatalogueRows, name: str = name) -> CatalogueRows:
                other = dataclasses.replace(r.settings, filter=np.full(len(r.x), name))
                return r.changed(settings=other)

            yield CatalogueReading(
                f"they were seen in {name}", f"correct FILTER, which says {stated[0]}", change
            )


def gains(judge: Judge, rows: CatalogueRows) -> Iterator[CatalogueReading]:
    """Another gain of one camera, or of one arm, by which unpolarised stars have the shares of the calibration."""
    cameras = judge.vectors.instrument.cameras
    names, count = cameras.names, len(cameras)
    counts, expected = judge.unpolarised(rows)
    with np.errstate(invalid="ignore", divide="ignore"):
        sets = [(k,) for k in range(count)] + [tuple(arm) for arm in cameras.arms if 1 < len(arm) < count]
        for members in sets:
            k, rest = list(members), [n for n in range(count) if n not in members]
            own, other = (counts[:, at].sum(axis=1) / expected[:, at].sum(axis=1) for at in (k, rest))
            factor = float(np.nanmedian(other / own))
            if np.isfinite(factor) and factor > 0:
                which = " and ".join(names[n] for n in members)
                yield CatalogueReading(
                    f"N of {which} were {factor:.4g} times as large",
                    "is that of one gain, unit, aperture and exposure with the other cameras?",
                    _scaled(np.where(np.isin(np.arange(count), k), factor, 1.0)),
                    usual=abs(factor - 1.0) <= LARGEST,
                )


def all_gains(judge: Judge, rows: CatalogueRows) -> Iterator[CatalogueReading]:
    """Other gains of all cameras: those of another instrument, say."""
    names = judge.vectors.instrument.cameras.names
    counts, expected = judge.unpolarised(rows)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = counts / expected
        factors = np.nanmedian(ratio.mean(axis=1, keepdims=True) / ratio, axis=0)
    if np.isfinite(factors).all() and (factors > 0).all():
        listed = ", ".join(f"{factor:.4g}" for factor in factors)
        yield CatalogueReading(
            f"N of {', '.join(names)} were {listed} times as large",
            f"{of_another(judge.vectors.instrument.name)}; are all cameras in one unit?",
            _scaled(factors),
            usual=bool(np.all(np.abs(factors - 1.0) <= LARGEST)),
        )


def of_another(instrument: str) -> str:
    """The question whether stars were seen by another instrument, shipped ones by name."""
    others = " or ".join(name for name in shipped() if name != instrument)
    return f"are they of the calibrated instrument, and not of {others} or another one"


def _scaled(factors: Float[np.ndarray, " k"]) -> Callable[[CatalogueRows], CatalogueRows]:
    return lambda rows: rows.changed(counts=rows.counts * factors, sigma=rows.sigma * factors)
