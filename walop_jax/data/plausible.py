"""Numbers that cannot be what their column says: sentences that name rows and the likeliest cause; nothing is refused.

Functions take plain arrays, of exposures, of stars or of pixels alike, and give pairs of a column and a sentence. What
no row may have at all (a Julian Date as MJD, 999 Celsius) is an error of `data.schema`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.io.errors import rows_text
from walop_jax.io.shapes import CountsOfRows, Vector

UsedRows = Bool[np.ndarray, " n"]
Groups = Int[np.ndarray, " n"]

OLDEST = 48000.0
"""MJD (1990) before which no such camera was read out."""
CAMPAIGN = 400.0
"""Days about the median date within which exposures belong to one campaign."""
_ZEROS = {0.0: "0", 15020.0: "1900", 40587.0: "1970", 44239.0: "1980", 51544.0: "2000", 51544.5: "2000"}
"""Days at which clocks begin that were never set."""
_YEARS = (1950.0, 2150.0)
_LONGEST = 4.0 * 3600.0  # s
_MILLISECONDS = 100.0  # times longer than the time between exposures, where a thousand is meant
_TEMPERATURES = (-60.0, 60.0)  # Celsius
_APART = 30.0  # Celsius, from the median of the exposures
_NOISE = 100.0
"""Factor in N_ERR²/N from that of photons: ten in N_ERR."""
_MOST = 0.9
_FEWEST_FULL = 4  # rows with exactly the largest value
_SMALLEST_FULL = 1000.0  # electrons: whole numbers below repeat by chance
_WORD = 65536.0
_FEWEST_WRAPPED = 3
_LIKE = 0.25  # of the usual counts, of one that began anew
_NEGATIVE = 5.0  # standard errors


class Implausible(NamedTuple):
    """A sentence that doubts the values of one column."""

    column: str
    what: str


def today() -> float:
    """The present moment as MJD (UTC)."""
    return time.time() / 86400.0 + 40587.0


def of_columns(columns: Mapping[str, np.ndarray], now: float = np.inf) -> Iterator[Implausible]:
    """Doubts about MJD, EXPTIME, TEMP, ROTATOR, CHWP_ANGLE, RA and DEC, those that there are; `now` is a date (MJD)."""
    nothing = np.zeros(0)
    mjd = columns.get("MJD", nothing)
    yield from of_times(mjd, now)
    yield from of_exposure_times(columns.get("EXPTIME", nothing), mjd)
    yield from of_temperatures(columns.get("TEMP", nothing))
    for name in ("ROTATOR", "CHWP_ANGLE"):
        yield from of_angles(name, columns.get(name, nothing))
    ra, dec = (columns.get(name, nothing) for name in ("RA", "DEC"))
    if len(ra) == len(dec) and np.any(unset := (ra == 0.0) & (dec == 0.0)):
        yield Implausible(
            "RA, DEC", f"are both 0 in {_rows(unset)}: were they not set? Write NaN where not known"
        )


def of_times(mjd: Vector, now: float = np.inf) -> Iterator[Implausible]:
    """Doubts about dates (MJD, d): before 1990, in the future, of a clock that was not set."""
    known = np.isfinite(mjd)
    zero = known & np.isin(mjd, list(_ZEROS))
    if zero.any():
        which = _ZEROS[float(mjd[zero][0])]
        what = f"is {mjd[zero][0]:g} in {_rows(zero)}: a clock that was not set ({which})?"
        yield Implausible("MJD", f"{what} Write NaN where the time is not known")
    year = known & (mjd > _YEARS[0]) & (mjd < _YEARS[1])
    if year.any():
        yield Implausible(
            "MJD", f"is {mjd[year][0]:g} in {_rows(year)}: is this a year? Give Modified Julian Dates"
        )
    if np.any(old := known & (mjd < OLDEST) & ~zero & ~year):
        yield Implausible("MJD", f"is before 1990 in {_rows(old)}; write NaN where the time is not known")
    if np.any(late := known & (mjd > now + 2.0)):
        what = f"lies in the future in {_rows(late)}, at {mjd[late].max():.6g}"
        yield Implausible(
            "MJD", f"{what} (today is {now:.0f}): is it a Modified Julian Date, and was the clock set?"
        )


def of_campaign(mjd: Vector) -> Iterator[Implausible]:
    """Doubts about exposures of one set that are years apart."""
    if not np.isfinite(mjd).any():
        return
    middle = np.nanmedian(mjd)
    if np.any(far := np.abs(mjd - middle) > CAMPAIGN):
        what = f"is more than {CAMPAIGN:g} days from the median, {middle:.1f}, in {_rows(far)}"
        yield Implausible("MJD", f"{what}; correct it, or calibrate the epochs one by one")


def of_exposure_times(exptime: Vector, mjd: Float[np.ndarray, " m"]) -> Iterator[Implausible]:
    """Doubts about exposure times (s): milliseconds, by their length or by the dates (MJD, d) of the exposures."""
    known = np.isfinite(exptime)
    if not known.any():
        return
    if np.any(none := known & (exptime == 0.0)):
        yield Implausible("EXPTIME", f"is 0 in {_rows(none)}: no light; write NaN where it is not known")
    if np.any(long := exptime > _LONGEST):
        what = f"is up to {exptime[long].max():g} s in {_rows(long)}"
        yield Implausible("EXPTIME", f"{what}: are these milliseconds? Seconds are wanted")
        return
    if len(mjd) != len(exptime):
        return
    order = np.argsort(mjd, kind="stable")
    order = order[np.isfinite(mjd[order]) & known[order] & (exptime[order] > 0)]
    apart = 86400.0 * np.diff(mjd[order])
    between = 0.5 * (exptime[order][1:] + exptime[order][:-1])
    later = apart > 0.5  # s: dates that are stated to the second
    if later.sum() >= 2 and np.median(between[later] / apart[later]) > _MILLISECONDS:
        factor = np.median(between[later] / apart[later])
        what = f"is {factor:.2g} times as long as the exposures lie apart by MJD"
        yield Implausible("EXPTIME", f"{what}: are these milliseconds? Seconds are wanted")


def of_temperatures(celsius: Vector) -> Iterator[Implausible]:
    """Doubts about temperatures: of no instrument, or far from those of the other exposures."""
    known = np.isfinite(celsius)
    if not known.any():
        return
    low, high = _TEMPERATURES
    if np.any(odd := known & ((celsius < low) | (celsius > high))):
        what = f"is {celsius[odd][0]:g} Celsius in {_rows(odd)}, of no instrument"
        yield Implausible(
            "TEMP", f"{what}: a number that stands for not known, or a sensor that is off? Write NaN there"
        )
    rest = known & ~odd
    if rest.any() and np.any(far := rest & (np.abs(celsius - np.median(celsius[rest])) > _APART)):
        what = f"is {celsius[far][0]:g} Celsius in {_rows(far)}, {np.median(celsius[rest]):.3g} in the others"
        yield Implausible(
            "TEMP", f"{what}: a sensor that is off, or Fahrenheit? Write NaN where it is not known"
        )


def of_angles(name: str, degrees: Vector, *, radians: bool = True) -> Iterator[Implausible]:
    """Doubts about angles: beyond a turn, or `radians`."""
    known = np.isfinite(degrees)
    if np.any(beyond := known & (np.abs(degrees) > 360.0)):
        what = f"is beyond a turn in {_rows(beyond)}, up to {np.abs(degrees[beyond]).max():g} deg"
        yield Implausible(
            name, f"{what}: an encoder that counts turns, or steps? Angles are taken modulo 360 deg"
        )
    if radians and like_radians(degrees[known]):
        what = f"lies between {degrees[known].min():.4g} and {degrees[known].max():.4g} in all rows"
        yield Implausible(name, f"{what}: are these radians? Angles are in degrees")


def like_radians(angles: np.ndarray) -> bool:
    """True if angles are clearly radians, not degrees.

    Clearly: five or more, from more than a quarter of a turn in radians, none beyond a turn, and most of
    them off the round numbers that anyone would choose in degrees.
    """
    distinct = np.unique(angles)
    if len(distinct) < 5 or distinct[0] < -2 * np.pi or distinct[-1] > 2 * np.pi + 1e-6:
        return False
    steps = distinct / 0.05
    off = np.mean(np.abs(steps - np.round(steps)) > 1e-3)
    return bool(distinct[-1] - distinct[0] > 0.5 * np.pi and off > 0.5)


def of_counts(
    counts: CountsOfRows,
    sigma: CountsOfRows,
    used: UsedRows,
    *,
    measured: UsedRows | None = None,
    group: Groups | None = None,
    cameras: Sequence[str] = (),
) -> Iterator[Implausible]:
    """Doubts about counts (electrons) and errors of cameras, of the rows that are `used`; `measured` are photons.

    Errors above the counts, or ten times off the noise of photons; values that stand at the ceiling of a detector;
    counters of 16 bits that began anew, beside rows of the same `group`. `cameras` are what messages call them.
    """
    yield from of_errors(counts, sigma, used if measured is None else used & measured)
    yield from of_ceilings(counts, used, cameras)
    yield from of_wraps(counts, sigma, group, cameras)


def of_errors(counts: CountsOfRows, sigma: CountsOfRows, used: UsedRows) -> Iterator[Implausible]:
    """Doubts about standard errors, by those of photons √N in the brightest tenth, where the sky matters least."""
    good = used[:, None] & np.isfinite(counts) & np.isfinite(sigma) & (counts > 0) & (sigma > 0)
    if good.sum() < _FEWEST_FULL:
        return
    n, e = counts[good], sigma[good]
    if np.mean(e > n) > _MOST:
        what = f"is above N in {100.0 * np.mean(e > n):.0f} % of all values (median N_ERR/N {np.median(e / n):.3g})"
        yield Implausible("N_ERR", f"{what}: are the columns exchanged, or is N a rate and N_ERR not?")
        return
    bright = n >= np.quantile(n, 0.9)
    n, e = n[bright], e[bright]
    ratio = float(np.median(e**2 / n))
    if not 1.0 / _NOISE < ratio < _NOISE:
        like = np.median(np.abs(np.log(e / n))) < 0.5
        cause = (
            "are these variances?"
            if like
            else "are N and N_ERR in electrons, or in counts (multiply by the gain)?"
        )
        yield Implausible("N_ERR", f"is {np.sqrt(ratio):.3g} times the noise of photons √N (median): {cause}")


def of_ceilings(counts: CountsOfRows, used: UsedRows, cameras: Sequence[str] = ()) -> Iterator[Implausible]:
    """Doubts about values that are exactly the largest of their camera in several rows: a detector that is full."""
    for camera in range(counts.shape[1]):
        values = np.where(used & np.isfinite(counts[:, camera]), counts[:, camera], -np.inf)
        if not len(values) or not (top := values.max()) > _SMALLEST_FULL:
            continue
        full = np.flatnonzero(values == top)
        different = len(np.unique(counts[full], axis=0))
        if len(full) >= _FEWEST_FULL and 2 * different > len(full):
            what = f"is exactly {top:.10g}, the largest, in {rows_text(full)} of {_named(camera, cameras)}"
            yield Implausible("N", f"{what}: the ceiling of the detector? Set FLAG 1 (saturated) there")


def of_wraps(
    counts: CountsOfRows, sigma: CountsOfRows, group: Groups | None = None, cameras: Sequence[str] = ()
) -> Iterator[Implausible]:
    """Doubts about values that would be like others with 65536 more: of a counter of 16 bits that began anew.

    Others are those of the same camera and `group`, such as an exposure, whose counts are alike; without groups, where
    they need not be alike, only values far below 0 can be such.
    """
    of = np.zeros(len(counts), int) if group is None else np.unique(group, return_inverse=True)[1].reshape(-1)
    for camera in range(counts.shape[1]):
        n = counts[:, camera]
        with np.errstate(invalid="ignore"):
            negative = n < -_NEGATIVE * sigma[:, camera]
        plain = np.isfinite(n) & ~negative
        if not plain.any():
            continue
        middle = np.full(of.max() + 1, np.nan)
        order = np.argsort(of[plain], kind="stable")
        parts = np.split(n[plain][order], np.flatnonzero(np.diff(of[plain][order])) + 1)
        middle[np.unique(of[plain])] = [np.median(part) for part in parts]
        expected = middle[of]
        near = (np.abs(n + _WORD - expected) < _LIKE * expected) & (expected > 0)
        low = plain & (n < 0.4 * expected) if group is not None and n[plain].max() <= _WORD else negative
        rows = np.flatnonzero(near & (negative | low))
        if len(rows) >= (1 if negative[rows].any() else _FEWEST_WRAPPED):
            where = f"{rows_text(rows)} of {_named(camera, cameras)}"
            what = f"is {n[rows[0]]:.6g} in {where}, where {expected[rows[0]]:.6g} would be usual"
            yield Implausible("N", f"{what}: a counter of 16 bits that began anew? Add 65536, or set FLAG 1")


def _named(camera: int, cameras: Sequence[str]) -> str:
    return cameras[camera] if cameras else f"camera {camera}"


def _rows(which: np.ndarray) -> str:
    return rows_text(np.flatnonzero(which))
