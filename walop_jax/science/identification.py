"""Who the stars of a field are: a table of known stars, moved to the time of the exposure, then matched.

Places      r(t) = r + (t − t₀)(μ_α* e_east + μ_δ e_north), normalised; μ_α* = PMRA holds cos δ, as in Gaia
Candidates  all known stars within the tolerance. Each has −2 ln L = d²/σ² + (ΔG/s)²: d is the distance, ΔG its
            magnitude less that of the counts; σ, s and the zero point are those of stars with a single candidate, by
            medians. Where few are such, those of the brightest candidates: a star that is counted is mostly the
            brightest there. One that outshines the others of this star tenfold is the star: their light is counted
            together. Else the best candidate is taken if it is 100 times as probable as the next; else none.
Limits      Parallaxes and radial velocities are left out: 1 arcsec at most, of the nearest star. Counts are those of
            one filter, G of another: `LEAST_SPREAD` is the least s.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from walop_jax.data import user_tables
from walop_jax.data.schema import Column
from walop_jax.data.units import Place
from walop_jax.data.user_tables import OF_STARS, InputTable
from walop_jax.io.errors import fail
from walop_jax.science.gathering import FARTHEST, Gathered, whole
from walop_jax.sky import directions
from walop_jax.sky.directions import FEWEST_REGISTERED, Pointing

BY_MAGNITUDE, UNDECIDED, OTHER_MAGNITUDE, NOT_LISTED = 1, 2, 4, 8
"""Bits of ID_FLAG: one of several candidates; several, none taken; one of another magnitude, not taken; none."""
ABOUT_FLAG = (
    "0: the only candidate; 1: one of several, by place and magnitude; 2: several, none taken; "
    "4: the only candidate has another magnitude, not taken; 8: not in the table"
)
LEAST_RATIO = 100.0  # of the likelihoods of the best candidate and the next
OUTSHONE = 2.5  # mag
LEAST_SPREAD = 0.3  # mag, of counts against G of one star: colours, variability
LEAST_SCATTER = 0.05  # arcsec
FARTHEST_MAGNITUDE = (5.0, 2.5)
"""Standard deviations, and mag, by both of which the only candidate must be off to be another star."""
FEWEST_SINGLE = 5
GAIA_EPOCH = 2016.0
"""Of Gaia DR3, where a table states no REF_EPOCH."""
J2000 = 51544.5  # MJD
_EPOCHS = (1850.0, 2150.0)


class _Pairs(NamedTuple):
    """Stars and their candidates, with the distance (arcsec) and G less the magnitude of the counts (NaN: unknown)."""

    star: Int[np.ndarray, " c"]
    known: Int[np.ndarray, " c"]
    distance: Float[np.ndarray, " c"]
    offset: Float[np.ndarray, " c"]


def identified(made: Gathered, table: Any, tolerance: float) -> Gathered:
    """The gathered catalogue with columns of a table of known stars (RA, DEC and any of `OF_STARS`), matched with its
    stars.

    `table` is a path, an astropy table, or columns by name. With PMRA, PMDEC (mas/yr) and REF_EPOCH (yr) its positions
    are moved to the MJD of the exposure. Positions are registered, as between cameras. ID_FLAG says how a star was
    found.
    """
    read = isinstance(table, str | os.PathLike)
    source = user_tables.read_input_table(table, ("RA", "DEC")) if read else user_tables.in_memory(table)
    if not set(OF_STARS) & set(source.names):
        raise fail(f"has none of {', '.join(OF_STARS)}", file=source.path, advice="name its columns so")
    ra, dec = user_tables.sky_positions(source)
    ra, dec, remarks = _moved(source, ra, dec, made)
    near = np.flatnonzero(directions.separation(made.pointing.ra, made.pointing.dec, ra, dec) < FARTHEST)
    reference = _on_plane(made.pointing, ra[near], dec[near])
    place = np.stack([made.columns[name][0] for name in "XY"], axis=1)
    counts = np.where(made.columns["N_FLAG"][0] == 0, made.columns["N"][0], np.nan)
    bright = np.nan_to_num(np.nanmean(counts, axis=1, where=np.isfinite(counts))) if counts.size else counts
    magnitude = user_tables.numeric_column(source, "PHOT_G_MEAN_MAG", Column("float", "mag", missing=np.nan))[
        near
    ]
    move = directions.registered(place, reference, bright, np.nan_to_num(-magnitude, nan=-np.inf), tolerance)
    if not move.pairs and (not len(reference) or min(len(place), len(reference)) >= FEWEST_REGISTERED):
        what = f"has no stars in common with the cameras within {directions.REACH / 60.0:g} arcmin"
        raise fail(what, file=source.path, advice="is it of this field? RA and DEC are in degrees")
    pairs = _candidates(move.apply(place), bright, reference, magnitude, tolerance)
    match, flag = _decided(pairs, len(place))
    stars = np.flatnonzero(match >= 0)
    rows = near[match[stars]]
    columns = dict(made.columns)
    for name, (unit, about) in OF_STARS.items():
        if name in source.names:
            texts = name == "SOURCE_ID"
            values = np.full(len(place), "" if texts else np.nan, object if texts else float)
            values[stars] = user_tables.column_of_stars(source, name)[rows]
            columns[name] = (whole(values) if texts else values, unit, about)
    columns["ID_FLAG"] = (flag, "", ABOUT_FLAG)
    remarks = [f"{len(stars)} of {len(place)} stars are in {source.path}", *remarks]
    remarks += _about(flag, tolerance, source, known=bool(np.isfinite(magnitude).any()))
    if replaced := [name for name in OF_STARS if name in source.names and name in made.columns]:
        remarks.append(f"{', '.join(replaced)} of the cameras: replaced by those of {source.path}")
    remarks += [f"{source.path}: {text}" for text in source.remarks]
    remarks += [f"{source.path}: {hint}" for hint in source.hints({"SOURCE_ID", "TEFF"})]
    if np.hypot(*move.shift) > 0.5 * tolerance:
        shift = f"{move.shift[0]:+.1f} and {move.shift[1]:+.1f} arcsec along X and Y"
        remarks.append(f"all cameras are shifted by {shift} against {source.path}: is their WCS right?")
    return dataclasses.replace(made, columns=columns, remarks=(*made.remarks, *remarks))


def moved(ra: Any, dec: Any, pmra: Any, pmdec: Any, years: Any) -> tuple[np.ndarray, np.ndarray]:
    """Places (deg) after so many years, by proper motions in mas/yr, of which PMRA holds cos DEC; NaN: none known."""
    a, d = (np.deg2rad(np.asarray(angle, float)) for angle in (ra, dec))
    east, north = (
        np.deg2rad(np.nan_to_num(np.asarray(rate, float) * years) / 3.6e6)[..., None]
        for rate in (pmra, pmdec)
    )
    zero = np.zeros_like(a)
    r = np.stack([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)], axis=-1)
    e = np.stack([-np.sin(a), np.cos(a), zero], axis=-1)
    n = np.stack([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)], axis=-1)
    x, y, z = np.moveaxis(r + east * e + north * n, -1, 0)
    return np.mod(np.rad2deg(np.arctan2(y, x)), 360.0), np.rad2deg(np.arctan2(z, np.hypot(x, y)))


def _moved(
    source: InputTable, ra: np.ndarray, dec: np.ndarray, made: Gathered
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """The places of known stars at the time of the exposure, and remarks on what is missing for that."""
    rate = Column("float", "mas / yr", missing=np.nan)
    absent = [name for name in ("PMRA", "PMDEC") if name not in source.names]
    if absent:
        what = f"has no {' and no '.join(absent)}: its places are taken as they are"
        advice = "a star of 100 mas/yr is off by 1 arcsec after 10 years"
        return ra, dec, [f"{source.path}: {what}; {advice}"]
    pmra, pmdec = (user_tables.numeric_column(source, name, rate) for name in ("PMRA", "PMDEC"))
    years = Column("float", "yr", missing=np.nan)
    epoch = user_tables.numeric_column(source, "REF_EPOCH", years)
    place = Place(source.path, "")
    wrong = np.isfinite(epoch) & ~((epoch > _EPOCHS[0]) & (epoch < _EPOCHS[1]))
    place.refuse(
        wrong, "is no year", "REF_EPOCH", "the epoch of its places in Julian years: 2016.0 of Gaia DR3"
    )
    remarks = []
    if unstated := int(np.sum(~np.isfinite(epoch))):
        how_many = "" if unstated == len(epoch) else f" in {unstated} rows"
        remarks.append(f"{source.path}: no REF_EPOCH{how_many}: taken as {GAIA_EPOCH:g}, that of Gaia DR3")
    if "MJD" not in made.columns:
        what = "the catalogues state no MJD: PMRA and PMDEC are not used"
        return ra, dec, [f"{source.path}: {what}; give it by a word of the header (--words)"]
    mjd = float(np.asarray(made.columns["MJD"][0], float)[0])
    if not np.isfinite(mjd) or abs(mjd) > 1e6:
        what = f"MJD = {mjd:g} of the exposure is no Modified Julian Date: PMRA and PMDEC are not used"
        return ra, dec, [f"{source.path}: {what}"]
    then = 2000.0 + (mjd - J2000) / 365.25
    ra, dec = moved(ra, dec, pmra, pmdec, then - np.where(np.isfinite(epoch), epoch, GAIA_EPOCH))
    if still := int(np.sum(~(np.isfinite(pmra) & np.isfinite(pmdec)))):
        remarks.append(
            f"{source.path}: {still} of {len(ra)} stars have no proper motion: their places are as stated"
        )
    return ra, dec, remarks


def _on_plane(pointing: Pointing, ra: np.ndarray, dec: np.ndarray) -> Float[np.ndarray, "n 2"]:
    return np.stack(pointing.field_of(ra, dec), axis=1) if len(ra) else np.zeros((0, 2))


def _candidates(
    place: Float[np.ndarray, "n 2"],
    bright: Float[np.ndarray, " n"],
    reference: Float[np.ndarray, "m 2"],
    magnitude: Float[np.ndarray, " m"],
    tolerance: float,
) -> _Pairs:
    """All pairs within the tolerance (arcsec) on the tangent plane (deg)."""
    if not len(place) or not len(reference):
        nothing = np.zeros(0)
        return _Pairs(nothing.astype(int), nothing.astype(int), nothing, nothing)
    near = KDTree(reference).query_ball_point(place, tolerance / 3600.0)
    star = np.repeat(np.arange(len(place)), [len(found) for found in near])
    known = np.array([row for found in near for row in found], int)
    distance = 3600.0 * np.hypot(*(place[star] - reference[known]).T)
    with np.errstate(divide="ignore"):
        of_counts = np.where(bright > 0, -2.5 * np.log10(np.where(bright > 0, bright, 1.0)), np.nan)
    return _Pairs(star, known, distance, magnitude[known] - of_counts[star])


def _decided(pairs: _Pairs, count: int) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """The candidate of each star (−1: none) and its ID_FLAG."""
    match, flag = np.full(count, -1), np.full(count, NOT_LISTED, np.int16)
    if not len(pairs.star):
        return match, flag
    several = np.bincount(pairs.star, minlength=count)[pairs.star] > 1
    shared = np.bincount(pairs.known, minlength=pairs.known.max() + 1)[pairs.known] > 1
    scatter, zero, spread = _spreads(pairs, several | shared, count)
    off = (pairs.offset - zero) / spread
    unlike = 0.5 * (pairs.distance / scatter) ** 2 + 0.5 * np.nan_to_num(off) ** 2
    # A candidate without a magnitude says nothing of it: only its place is compared.
    without = np.bincount(pairs.star, ~np.isfinite(off), minlength=count)[pairs.star] > 0
    unlike = np.where(without, 0.5 * (pairs.distance / scatter) ** 2, unlike)
    far = np.abs(pairs.offset - zero)
    other = (np.abs(off) > FARTHEST_MAGNITUDE[0]) & (far > FARTHEST_MAGNITUDE[1])
    by_known = np.lexsort([pairs.distance, pairs.known])
    nearest_star = np.zeros(len(pairs.star), bool)
    nearest_star[by_known[np.unique(pairs.known[by_known], return_index=True)[1]]] = True
    order = np.lexsort([unlike, pairs.star])
    starts = np.searchsorted(pairs.star[order], np.arange(count + 1))
    taken: dict[int, tuple[float, int]] = {}
    for star in range(count):
        rows = order[starts[star] : starts[star + 1]]
        if not len(rows):
            continue
        best = _outshining(rows, pairs, nearest_star)
        alone = len(rows) == 1 or best is not None
        best = rows[0] if best is None else best
        if not alone and unlike[rows[1]] - unlike[best] < np.log(LEAST_RATIO):
            flag[star] = UNDECIDED
        elif other[best]:
            flag[star] = OTHER_MAGNITUDE
        else:
            flag[star] = BY_MAGNITUDE if len(rows) > 1 else 0
            match[star] = pairs.known[best]
            before = taken.get(match[star], (np.inf, -1))
            loser = before[1] if unlike[best] < before[0] else star
            taken[match[star]] = min(before, (float(unlike[best]), star))
            if loser >= 0:  # two stars cannot be one
                match[loser], flag[loser] = -1, UNDECIDED
    return match, flag


def _outshining(
    rows: Int[np.ndarray, " r"], pairs: _Pairs, nearest_star: Bool[np.ndarray, " c"]
) -> int | None:
    """The candidate with nine tenths of the light of all that belong to no other star; None: there is none."""
    own = rows[nearest_star[rows]]
    if len(own) < 2 or not np.isfinite(pairs.offset[own]).all():
        return None
    first, second = own[np.argsort(pairs.offset[own], kind="stable")][:2]
    return int(first) if pairs.offset[second] - pairs.offset[first] > OUTSHONE else None


def _spreads(pairs: _Pairs, doubtful: Bool[np.ndarray, " c"], count: int) -> tuple[float, float, float]:
    """Scatter of places (arcsec, of each coordinate), zero point and spread of magnitudes, robustly."""
    single = ~doubtful
    if single.sum() < FEWEST_SINGLE:
        # The brightest candidate of each star; without magnitudes the nearest.
        faint = np.nan_to_num(pairs.offset, nan=np.inf)
        order = np.lexsort([pairs.distance, faint, pairs.star])
        first = order[np.searchsorted(pairs.star[order], np.arange(count))[:count].clip(max=len(order) - 1)]
        single = np.zeros(len(pairs.star), bool)
        single[first] = True
    scatter = max(float(np.median(pairs.distance[single])) / np.sqrt(2.0 * np.log(2.0)), LEAST_SCATTER)
    offset = pairs.offset[single & np.isfinite(pairs.offset)]
    if not len(offset):
        return scatter, 0.0, np.inf
    zero = float(np.median(offset))
    return scatter, zero, max(1.4826 * float(np.median(np.abs(offset - zero))), LEAST_SPREAD)


def _about(flag: np.ndarray, tolerance: float, source: InputTable, *, known: bool) -> list[str]:
    """Sentences on stars with several candidates, and on those whose candidate has another magnitude."""
    sentences = []
    how = "by place and magnitude" if known else "by place alone: the table has no PHOT_G_MEAN_MAG"
    if decided := int(np.sum(flag == BY_MAGNITUDE)):
        sentences.append(
            f"{decided} stars have several candidates within {tolerance:g} arcsec: decided {how} (ID_FLAG 1)"
        )
    if undecided := int(np.sum(flag == UNDECIDED)):
        what = f"{undecided} stars have several candidates within {tolerance:g} arcsec that cannot be told apart {how}"
        sentences.append(f"{what}: none is taken, they have no SOURCE_ID and no colour (ID_FLAG 2)")
    if other := int(np.sum(flag == OTHER_MAGNITUDE)):
        what = f"{other} stars have a single candidate of quite another magnitude"
        sentences.append(
            f"{what}: not taken (ID_FLAG 4); is {source.path} complete, and at the time of the exposure?"
        )
    return sentences
