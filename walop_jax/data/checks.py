"""Plausibility checks of the numbers in a calibration set."""

from __future__ import annotations

import dataclasses
import difflib
import itertools
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.data import plausible
from walop_jax.data.kinds import EPHEMERIS_MJD, KINDS, POLARISER, WAVELENGTHS
from walop_jax.data.records import Exposures, FilterCurve, Points, Site, Sources
from walop_jax.data.schema import EXPOSURES, POINTS, SOURCES, TURN, check
from walop_jax.data.settings import BUILTIN_FILTERS, PHOTOMETRIC_BANDS, same_filters, single_wavelength
from walop_jax.data.units import Place
from walop_jax.instruments.description import described, shipped
from walop_jax.io.errors import nearest, rows_text

_ANY_FIELD = 90.0  # deg
_LONGEST_NAME = 32
_LIKE = 0.85  # of two names, for "did you mean"


def field_limit(instrument: str) -> float:
    """Largest |X|, |Y| in degrees that a field point of an instrument may have."""
    return described(instrument).field_limit if instrument in shipped() else _ANY_FIELD


def _letters(name: str) -> list[str]:
    return sorted(filter(str.isalnum, name.upper()))


def instrument_name(value: object, place: Place) -> str:
    """Check INSTRUME, in which names of shipped instruments are case-insensitive, and return it.

    Raises `DataError` for a name that is empty, longer than 32 letters, begins or ends with a blank, or is not
    printable ASCII, and for one with the letters of a shipped instrument in another order or with other separators.
    """
    name = value if isinstance(value, str) else ""
    good = 0 < len(name) <= _LONGEST_NAME and name == name.strip() and name.isascii() and name.isprintable()
    if not good:
        advice = f"1 to {_LONGEST_NAME} printable ASCII letters, no blank at either end"
        raise place.fail(f"is {value!r}, not a name", "INSTRUME", advice)
    if name.upper() in shipped():
        return name.upper()
    if any(_letters(name) == _letters(shipped_name) for shipped_name in shipped()):
        raise place.fail(f"is {name!r}", "INSTRUME", nearest(name, shipped()))
    return name


def check_cameras(instrument: str, cameras: int, place: Place, column: str) -> None:
    """Raise `DataError` for another number of cameras than a shipped instrument has."""
    if instrument in shipped() and cameras != (expected := len(described(instrument).cameras)):
        what = f"has {cameras} camera(s), {instrument} has {expected}"
        raise place.fail(what, column, "write all of them, or correct the name of the instrument")


def make_points(table: dict[str, Any], instrument: str, place: Place) -> Points:
    """Check the POINTS table (degrees) against the field of the instrument."""
    check(table, POINTS, place)
    limit = field_limit(instrument)
    advice = "field coordinates are in degrees: are these arcmin or pixels?"
    for name in ("X", "Y"):
        place.refuse(np.abs(table[name]) > limit, f"lies outside ±{limit:g}° of {instrument}", name, advice)
    return Points(point=table["POINT"], x=table["X"], y=table["Y"])


def make_filters(table: dict[str, Any], place: Place) -> dict[str, FilterCurve]:
    """Check the FILTERS table (µm); strip the NaN padding; turn descending curves round."""
    curves: dict[str, FilterCurve] = {}
    wavelengths, throughputs = table["WAVELENGTH"], table["THROUGHPUT"]
    if wavelengths.shape != throughputs.shape:
        raise place.fail("has not as many values as WAVELENGTH", "THROUGHPUT", "pad both with NaN")
    for row, name in enumerate(table["FILTER"].tolist()):
        where = f" in {rows_text([row])}"
        if name in curves:
            raise place.fail(f"{name!r} is there twice, again{where}", "FILTER", "rename one")
        curves[name] = checked_curve(name, wavelengths[row], throughputs[row], place, where)
    return curves


def match_filters(
    tables: dict[str, dict[str, Any]], filters: dict[str, FilterCurve], file: object
) -> tuple[dict[str, FilterCurve], list[str]]:
    """Give names of filters that differ in case, blanks and dashes alone one spelling; the curves, and remarks.

    A curve counts before a built-in one, whose name it gets. FILTER of EXPOSURES and SOURCES is changed in place.
    Raises `DataError` where several curves could be meant.
    """
    place, remarks, curves = Place(file, "FILTERS"), list[str](), dict(filters)
    for table in ("EXPOSURES", "SOURCES"):
        used = tables.get(table, {}).get("FILTER", np.zeros(0, "U1"))
        exact = set(used.tolist())
        for name in sorted(exact - set(curves) - {""}):
            alike = same_filters(name, curves)
            if len(alike) > 1:
                listed = " and ".join(map(repr, alike))
                raise place.fail(f"{listed} may be {name} of {table}", "FILTER", "rename all but one of them")
            built_in = same_filters(name, BUILTIN_FILTERS)
            if alike and built_in and alike[0] not in exact:
                curves[name] = dataclasses.replace(curves.pop(alike[0]), name=name)
                remarks.append(place.remark(f"the curve {alike[0]!r} is taken as that of {name}", "FILTER"))
                continue
            to = next(iter(alike or built_in), name)
            if to != name:
                wide = np.array(used, f"U{max(used.dtype.itemsize // 4, len(to))}")
                used = tables[table]["FILTER"] = np.where(used == name, to, wide)
                remarks.append(Place(file, table).remark(f"{name!r} is taken as {to!r}", "FILTER"))
    return curves, remarks


def checked_curve(
    name: str,
    wavelength: Float[np.ndarray, " n"],
    throughput: Float[np.ndarray, " n"],
    place: Place,
    where: str = "",
) -> FilterCurve:
    """The curve of a filter (µm), padding stripped, ascending; `DataError`, at `place`, for one that no filter has."""

    def refuse(bad: Any, what: str, column: str, advice: str) -> None:
        if bad:
            raise place.fail(f"{name!r} {what}{where}", column, advice)

    finite = np.isfinite(wavelength)
    gap = not np.any(finite) or not np.all(np.isfinite(throughput[finite]))
    advice = "pad both columns with NaN in the same places"
    refuse(gap, "has no value where WAVELENGTH has one,", "THROUGHPUT", advice)
    wavelength, throughput = wavelength[finite], throughput[finite]
    (low, high), (first, last) = WAVELENGTHS, (wavelength.min(), wavelength.max())
    what = f"reaches from {first:g} to {last:g} µm, outside {low:g} … {high:g},"
    advice = "wavelengths are in µm: are these nm or Angstrom?"
    refuse((first < low) | (last > high), what, "WAVELENGTH", advice)
    if len(wavelength) > 1 and wavelength[0] > wavelength[-1]:
        wavelength, throughput = wavelength[::-1].copy(), throughput[::-1].copy()
    refuse(np.any(np.diff(wavelength) <= 0), "is not sorted,", "WAVELENGTH", "sort the curve")
    dark = np.any(throughput < 0) or not np.any(throughput > 0)
    refuse(dark, "is negative or zero throughout,", "THROUGHPUT", "correct the curve")
    return FilterCurve(name, wavelength, throughput)


def make_sources(
    table: dict[str, Any], place: Place, filters: Mapping[str, FilterCurve] | None = None
) -> Sources:
    """Check the SOURCES table: one row for a star, or one for each of its bands (`filters`, built in, photometric)."""
    check(table, SOURCES, place)
    sources = Sources(**{name.lower(): table[name] for name in SOURCES})
    bands = {*(filters or ()), *BUILTIN_FILTERS, *PHOTOMETRIC_BANDS}
    for name in set(sources.filter.tolist()) - bands - {""}:
        if single_wavelength(name) is None:
            what = f"{name!r} is neither a row of FILTERS nor a band that is known,"
            place.refuse(sources.filter == name, what, "FILTER", nearest(name, bands))
    several = np.bincount(sources.stars, minlength=len(sources))[sources.stars] > 1
    advice = "number the stars; rows of one star need FILTER, each another one"
    place.refuse(several & (sources.filter == ""), "the identifier is not unique", "SOURCE", advice)
    rows = list(zip(sources.source.tolist(), sources.filter.tolist(), strict=True))
    twice = np.array([rows.index(row) != i for i, row in enumerate(rows)], bool)
    place.refuse(twice, "the star has a value in this FILTER already", "FILTER", "remove one of them")
    for column, values in (("NAME", sources.name), ("TEFF", sources.teff)):
        first = values[sources.stars]
        odd = (values != first) & ~((values != values) & (first != first))  # NaN is like NaN
        place.refuse(odd, "differs from that of the first row of the star", column, "give it another SOURCE")
    return sources


def make_exposures(
    table: dict[str, Any],
    filters: Mapping[str, FilterCurve],
    site: Site,
    place: Place,
    kinds: Collection[str] | None = KINDS.keys(),
) -> Exposures:
    """Check the EXPOSURES table for the columns that every KIND needs; `kinds` are those allowed, None: any."""
    table["KIND"] = kind = np.char.lower(table["KIND"])
    for name in np.unique(kind).tolist():
        if kinds is not None and name not in kinds:
            place.refuse(kind == name, f"{name!r} is not a kind,", "KIND", nearest(name, kinds))
    filter_names = {*filters, *BUILTIN_FILTERS}
    for name in np.unique(table["FILTER"]).tolist():
        if name not in filter_names:
            what, advice = f"{name!r} is neither a row of FILTERS nor built in,", nearest(name, filter_names)
            place.refuse(table["FILTER"] == name, what, "FILTER", advice)
    clp_in = table["CLP_IN"]
    place.refuse((kind == "clp") & ~clp_in, "is false", "CLP_IN", "KIND clp needs the polariser in")
    moving = [name.removesuffix("_IN") for name in table if name.endswith("_IN")]
    for prefix in moving:
        angle, inside = table[f"{prefix}_ANGLE"], table[f"{prefix}_IN"]
        advice = f"give the encoder reading, or set {prefix}_IN false"
        absent = inside.sum() > 1 and not np.isfinite(angle[inside]).any()
        what, advice = "is not finite", advice + (", if the column is there at all" if absent else "")
        place.refuse(inside & ~np.isfinite(angle), what, f"{prefix}_ANGLE", advice)
        # Out of the beam an element has no angle, whatever the header remembers.
        table[f"{prefix}_ANGLE"] = np.where(inside, angle, np.nan)
    turning = {p: np.abs(table[f"{p}_TURN"]) * table[f"{p}_IN"] > 0 for p in moving if f"{p}_TURN" in table}
    if POLARISER in turning:
        advice = "take it at several angles; only elements behind it may turn during an exposure"
        place.refuse(turning[POLARISER], "is not 0", f"{POLARISER}_TURN", advice)
    several = np.sum([*turning.values(), np.zeros(len(kind))], axis=0) > 1
    column = " and ".join(f"{p}_TURN" for p in turning)
    advice = "one at a time: their angles go together, which is not stated"
    place.refuse(several, "another element turns as well", column, advice)
    angles = np.unique(table["CLP_ANGLE"][clp_in])
    if plausible.like_radians(angles):
        what = f"all {len(angles)} different angles lie between {angles[0]:g} and {angles[-1]:g}"
        raise place.fail(what, "CLP_ANGLE", "angles are in degrees: are these radians?")
    angles_of = {f"{prefix}_ANGLE": EXPOSURES["CLP_ANGLE"] for prefix in moving}
    check(table, {**EXPOSURES, **angles_of, **{f"{prefix}_TURN": TURN for prefix in turning}}, place)

    moon, standard = ((kind == name) & ~clp_in for name in ("moon", "standard"))
    pointing = ("MJD", "RA", "DEC", "ROTATOR")
    needs = [(moon, name, "the moonlit sky needs time and pointing") for name in pointing]
    for needing, name, advice in (*needs, (standard, "ROTATOR", "a standard needs it")):
        place.refuse(needing & ~np.isfinite(table[name]), "is not finite", name, advice)
    low, high = EPHEMERIS_MJD
    bad = (moon & (table["MJD"] < low)) | (table["MJD"] > high)
    place.refuse(bad, "is not in 1900 … 2100", "MJD", "is this a Julian Date? subtract 2400000.5")
    _site(site, place, needed=bool(np.any(moon)))
    return Exposures.from_columns(table)


def _site(site: Site, place: Place, *, needed: bool) -> None:
    values = {
        "SITELAT": (site.latitude, -90.0, 90.0),
        "SITELONG": (site.longitude, -180.0, 360.0),
        "SITEELEV": (site.elevation, -500.0, 9000.0),
    }
    for name, (value, low, high) in values.items():
        if not low <= value <= high and (needed or not np.isnan(value)):
            what = f"is {value:g}, not in {low:g} … {high:g}"
            raise Place(place.file, "PRIMARY").fail(what, name, "the Moon's parallax needs the site")


_NEAR = 0.05  # degrees between two statements of one site
_LEVEL = 100.0  # metres


SIMULATED = "walop-jax simulate"
"""Begin of the ORIGIN of simulated sets, which may be of the future."""


def doubts_about(
    instrument: str, site: Site, exposures: Exposures, place: Place, origin: str = ""
) -> Iterator[str]:
    """Sentences on a site that is not that of a shipped instrument, and on numbers of exposures that cannot be meant.

    None of it forbids a fit: an instrument may have been moved, and MJD matters to few of its exposures.
    """
    if instrument in shipped():
        yield from _about_site(instrument, site, place)
    elif like := difflib.get_close_matches(instrument.upper(), shipped(), 1, _LIKE):
        yield f"{place.file} [PRIMARY] INSTRUME: is {instrument!r}, not shipped; did you mean {like[0]!r}?"
    now = np.inf if origin.startswith(SIMULATED) else plausible.today()
    for column, what in itertools.chain(
        plausible.of_columns(exposures.columns(), now), plausible.of_campaign(exposures.mjd)
    ):
        yield f"{place.file} [EXPOSURES] {column}: {what}"


def _about_site(instrument: str, site: Site, place: Place) -> Iterator[str]:
    _, latitude, longitude, elevation, _ = described(instrument).place
    for card, value, described_value, near, unit in (
        ("SITELAT", site.latitude, latitude, _NEAR, "°"),
        ("SITELONG", site.longitude, longitude, _NEAR, "°"),
        ("SITEELEV", site.elevation, elevation, _LEVEL, " m"),
    ):
        away = abs(value - described_value)
        if card == "SITELONG":
            away = abs((away + 180.0) % 360.0 - 180.0)
        if np.isfinite(away) and away > near:
            what = f"{card}: is {value:g}{unit}, {instrument} stands at {described_value:g}{unit}"
            yield f"{place.file} [PRIMARY] {what}; correct the card if the instrument has not been moved"
