"""Numbers of a catalogue that cannot be what they say: units of counts, errors of cameras, frames of the positions.

A doubt concerns every star of the catalogue: no result that uses these numbers is to be trusted. A remark names the
likeliest cause. Neither needs the calibration. Dates, temperatures and detectors are checked in the same way as those
of calibration sets (`data.plausible`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.data import plausible, user_tables
from walop_jax.data.user_tables import InputTable
from walop_jax.io.errors import rows_text
from walop_jax.io.shapes import CountsOfRows, Vector
from walop_jax.io.text import with_minus_sign
from walop_jax.science.field_points import ANOTHER_PLACE
from walop_jax.science.other_readings import MIRRORED
from walop_jax.sky.directions import Pointing

BRIGHT = 1000.0  # electrons: errors of larger counts are a few per cent, a tenth with a read noise of 100 electrons
QUIET = 0.02  # of the variance of photons: what a mean of fifty exposures has
_RELATIVE = 0.3  # error of bright stars above which N_ERR is no share of N
_NOISIER = 10.0  # of the variance of photons: sky and detectors add to it
_SHARE = 0.1  # share of the stars, or rows, above which an oddity concerns the whole catalogue
_TURNED = 1.0  # deg by which ROTATOR may differ from the angle that the positions give: meridians converge
_SCALE = 0.02  # relative difference that may be between the scale of X, Y and that of RA, DEC
_POSITIONS, _FEWEST, _SPREAD = 2000, 5, 0.02
"""Rows that are looked at, and needed; share of their extent by which positions of several fields scatter."""


def units_of_counts(counts: CountsOfRows, sigma: CountsOfRows) -> Iterator[str]:
    """Sentences if N_ERR cannot be the errors of counts N in electrons: one of the two is in another unit."""
    lit = np.isfinite(counts) & (counts > 0)
    bright = lit & (sigma > 0) & (np.maximum(counts, sigma) > BRIGHT)
    if bright.any():
        n, error = counts[bright], sigma[bright]
        if _like_photons(sigma=n, counts=error):
            yield "N_ERR is the square of N, as counts are of their errors: were N and N_ERR exchanged? Exchange them"
            return
        if _like_photons(sigma=n * error, counts=n) and np.median(error) < _RELATIVE:
            what = "N_ERR is relative to N, or in magnitudes: N · N_ERR, not N_ERR, is the noise of photons"
            yield f"{what}; multiply it by N (and by 0.921 if it is in magnitudes)"
            return
    if lit.any() and (share := float(np.median(sigma[lit] ** 2 / counts[lit]))) < QUIET:
        what = f"N_ERR is {share**-0.5:.2g} times smaller than the noise of photons"
        number = f"both would be those of photons if they were multiplied by {1.0 / share:.3g}"
        yield (
            f"{what}: is N in electrons? Magnitudes, rates and means of exposures are not; {number}, as rates of an "
            "exposure of as many seconds, or a mean of as many exposures"
        )
    bright = counts > BRIGHT
    if bright.any() and (share := float(np.median(sigma[bright] / counts[bright]))) > 0.5:
        number = f"the root of N_ERR is {float(np.median(np.sqrt(sigma[bright] / counts[bright]))):.2g} times that of N"
        yield f"N_ERR of bright stars is {share:.2g} times N: are these variances? Standard errors are wanted; {number}"


def _like_photons(sigma: Vector, counts: Vector) -> bool:
    """True if errors are those of counts in electrons, with a noise of sky and detectors as it is usual."""
    return 0.8 < float(np.median(sigma**2 / counts)) < _NOISIER


def field_against_sky(source: InputTable, x: Vector, y: Vector, rotator: Vector) -> Iterator[str]:
    """Sentences where X, Y and ROTATOR contradict RA and DEC of the same table (docs: conventions).

    Positions of one pointing are a linear map of those on the tangent plane, whose rotation and sign are known.
    """
    if not {"RA", "DEC"} <= set(source.names):
        return
    ra, dec = user_tables.sky_positions(source)
    good = np.flatnonzero(np.isfinite(ra + dec + x + y + rotator))
    good = good[:: max(1, len(good) // _POSITIONS)]
    if len(good) < _FEWEST:
        return
    direction = np.exp(1j * np.deg2rad(rotator[good]))
    middle = float(np.rad2deg(np.angle(direction.mean())))
    if np.abs(np.angle(direction * np.exp(-1j * np.deg2rad(middle)))).max() > np.deg2rad(5.0):
        return
    centre = np.exp(1j * np.deg2rad(ra[good])).mean()
    north, east = Pointing(
        float(np.rad2deg(np.angle(centre))) % 360.0, float(dec[good].mean()), 0.0
    ).field_of(ra[good], dec[good])
    place, design = np.stack([x[good], y[good]], axis=1), np.stack([np.ones(len(good)), east, north], axis=1)
    if np.linalg.matrix_rank(design) < 3 or not np.isfinite(design).all():
        return
    linear = np.linalg.lstsq(design, place, rcond=None)[0]
    if float(np.std(place - design @ linear)) > _SPREAD * float(np.std(place)):
        return  # several fields
    turned, mirrored, scale = _turn(linear[1:].T)
    stated = f"ROTATOR is {with_minus_sign(f'{middle:.4g}')}°"
    if mirrored:
        fitting = [m for m in MIRRORED if abs(_apart(_turn(_after(m[2], linear[1:].T))[0], middle)) < _TURNED]
        reason = fitting[0] if fitting else ("the sign of X or of Y is the other one", "correct it")
        yield f"X and Y are a mirror image of RA and DEC; they would fit if {reason[0]} ({reason[1]})"
    elif abs(_apart(turned, middle)) > _TURNED:
        causes = {"its sign": -middle, "are these radians": float(np.rad2deg(middle))}
        named = [f": {name}?" for name, angle in causes.items() if abs(_apart(turned, angle)) < _TURNED]
        what = f"{stated}, but RA, DEC, X and Y say {with_minus_sign(f'{turned:.4g}')}°"
        yield f"{what}{named[0] if named else ''} Q, U and EVPA on the sky depend on it"
    if abs(scale - 1.0) > _SCALE:
        yield f"X and Y are {scale:.4g} times as far apart as RA and DEC: are they in degrees, with the right scale?"


def _turn(linear: Float[np.ndarray, "2 2"]) -> tuple[float, bool, float]:
    """ROTATOR (deg), whether the field is mirrored, and the scale of a map from (east, north) to (X, Y)."""
    angle = float(np.rad2deg(np.arctan2(linear[0, 0] - linear[1, 1], linear[0, 1] + linear[1, 0])))
    determinant = float(np.linalg.det(linear))
    return angle, determinant > 0, float(np.sqrt(abs(determinant)))


def _after(
    turn: Callable[..., tuple[np.ndarray, np.ndarray]], linear: Float[np.ndarray, "2 2"]
) -> Float[np.ndarray, "2 2"]:
    return np.stack(turn(*linear))


def _apart(one: float, other: float) -> float:
    """The difference of two angles (deg), between −180 and 180."""
    return (one - other + 180.0) % 360.0 - 180.0


def errors_of_cameras(counts: CountsOfRows, sigma: CountsOfRows, names: Sequence[str]) -> Iterator[str]:
    """Remarks on errors of a camera (electrons) that exceed its counts in all rows, or are the same in all rows."""
    used = np.isfinite(counts) & np.isfinite(sigma)
    for k, name in enumerate(names):
        n, error, on = counts[:, k], sigma[:, k], used[:, k]
        if on.sum() >= _FEWEST and np.all(error[on] > np.abs(n[on])):
            yield f"N_ERR of {name} is larger than N in all rows: are the columns exchanged, or is it in another unit?"
        if on.sum() >= _FEWEST and np.ptp(error[on]) == 0.0 and np.ptp(n[on]) > 0.0:
            yield f"N_ERR of {name} is {error[on][0]:g} in all rows, whatever N is: is it a placeholder?"


def not_measured(counts: CountsOfRows, sigma: CountsOfRows) -> Bool[np.ndarray, "n k"]:
    """True where N and N_ERR are the same negative number, which catalogues write for a value that is missing."""
    return (counts < 0) & (counts == sigma)


def stars_of_one_name(star: Int[np.ndarray, " n"], x: Vector, y: Vector, time: Vector) -> Iterator[str]:
    """A sentence if many stars have rows at several places of the field at the same time."""
    dated = np.flatnonzero(np.isfinite(time + x + y))
    exposure = np.unique(time[dated], return_inverse=True)[1].reshape(-1)
    _, of = np.unique(np.stack([star[dated], exposure], axis=1), axis=0, return_inverse=True)
    of = of.reshape(-1)
    extent = np.zeros(of.max(initial=-1) + 1)
    for values in (x[dated], y[dated]):
        low, high = np.full(len(extent), np.inf), np.full(len(extent), -np.inf)
        np.minimum.at(low, of, values)
        np.maximum.at(high, of, values)
        extent = np.maximum(extent, high - low)
    apart = int(np.sum(extent > ANOTHER_PLACE))
    if apart > _SHARE * len(extent):
        what = f"ID: {apart} of {len(extent)} stars are at several places of the field at one MJD"
        yield f"{what}: is one number that of several stars? Give each star a number of its own"


def ceilings(
    counts: CountsOfRows, used: Bool[np.ndarray, " n"], names: Sequence[str]
) -> Iterator[plausible.Implausible]:
    """Faults of counts that are the largest in several rows: one if all cameras share it, else one for each."""
    top = np.nanmax(np.where(used[:, None], counts, -np.inf), initial=-np.inf)
    full = (counts == top) & used[:, None]
    if full.any(axis=0).sum() > 1 and full.any(axis=1).sum() >= _FEWEST:
        which = rows_text(np.flatnonzero(full.any(axis=1)))
        what = f"is exactly {top:.10g}, the largest, of several cameras in {which}"
        yield plausible.Implausible(
            "N", f"{what}: the ceiling of the detectors? Set FLAG 1 (saturated) there"
        )
    else:
        yield from plausible.of_ceilings(counts, used, names)


def many_are_full(counts: CountsOfRows) -> bool:
    """True if the largest count of all cameras stands in more rows than single saturated stars explain."""
    full = counts == np.nanmax(counts, initial=-np.inf)
    return bool(np.mean(full.any(axis=1)) > _SHARE and full.sum() >= _FEWEST)
