"""Schedules of the survey's telescope control (format v4, JSON): written for exposures, and read back as exposures.

A schedule has targets, a target has acquisitions: a window, a number of the filter, the half-wave plate, the polariser,
and so many exposures of whole seconds. Times of a window are local, those after midnight of the next day.

Source      skiehl/pasiphae-survey-planner, info/schedule_json_format (fields, ranges, types of targets)
"""

from __future__ import annotations

import datetime
import itertools
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.data.header_words import Words, columns_of, exposures_table, json_content, overlapping
from walop_jax.data.kinds import CALIBRATION_PLATE, POLARISER
from walop_jax.data.records import Exposures, Position, Site
from walop_jax.data.schema import EXPOSURES
from walop_jax.data.units import degrees_of, mjd_of, sexagesimal
from walop_jax.io.errors import PathLike, fail
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.text import some
from walop_jax.io.toml import Reader

TYPES: Mapping[str, str] = {"clp": "CAL-CAL", "lamp": "CAL-CAL", "moon": "CAL-MOO"}
"""Types of targets by KIND; of standards CAL-POL or CAL-UPO."""
KINDS_OF = {"CAL-CAL": "clp", "CAL-MOO": "moon", "CAL-POL": "standard", "CAL-UPO": "standard"}
OF_SCIENCE = ("PAS", "SCI")
"""Types of targets that are no calibration."""
FASTEST = 3.0  # turns per minute
MOST_FILTERS = 4
MOST_EXPOSURES = 10_000
"""Of an acquisition."""
SLACK = 30.0  # minutes that a window is longer than its exposures, on both sides
ALIKE = 180.0  # deg after which a wave plate is the same again
ELEMENTS = {CALIBRATION_PLATE: "hwp", POLARISER: "polarizer"}


def read_exposures(paths: Sequence[PathLike], rules: Words) -> tuple[dict[str, np.ndarray], list[str]]:
    """The columns of EXPOSURES in records of an observatory: headers, a log, tables, or a schedule; and remarks."""
    single = len(paths) == 1 and Path(paths[0]).suffix.lower() == ".json"
    content = json_content(paths[0]) if single else None
    if is_schedule(content):
        return read_schedule(paths[0], rules.filters, content)
    return exposures_table(paths, rules, content)


def exposures_as_table(columns: Mapping[str, np.ndarray]) -> Any:
    """The columns of EXPOSURES as an astropy table with their units."""
    units = {name: "deg" for name in columns if name.endswith(("_ANGLE", "_TURN"))}
    units |= {name: rule.unit for name, rule in EXPOSURES.items()}
    return astropy_table({name: (values, units.get(name, ""), "") for name, values in columns.items()})


def is_schedule(content: Any) -> bool:
    """True for the content of a schedule."""
    return isinstance(content, Mapping) and "targets" in content and "objects" in content


def schedule_of(
    exposures: Exposures,
    site: Site,
    filters: Mapping[str, int],
    *,
    facts: Mapping[str, str] | None = None,
    names: Sequence[str] | None = None,
    unpolarised: Collection[str] = (),
) -> tuple[dict[str, Any], list[str]]:
    """The schedule of exposures in their order, and remarks; `names` are those of their targets, some `unpolarised`.

    `facts` are name, pi, observer, mode. Raises `DataError` for exposures that no schedule can hold: more than four
    filters, other moving elements, a turn that is not one of half turns or faster than three turns a minute.
    """
    remarks = list[str]()
    _check(exposures, filters)
    each = [exposures[e : e + 1] for e in range(len(exposures))]
    rows = []
    for e, exposure in enumerate(each):
        seconds = max(round(float(exposures.exptime[e])), 1)
        states = {word: _state(exposure.positions[p], seconds, p) for p, word in ELEMENTS.items()}
        rows.append((seconds, {"filter": filters[str(exposures.filter[e])], **states}))
    rounded = [float(t) for t in exposures.exptime if t != round(t) or t < 1]
    if rounded:
        remarks.append(f"{len(rounded)} exposure times are no whole seconds ({rounded[0]:g} s): rounded")
    label = list(_labels(exposures)) if names is None else names
    kinds = ["CAL-UPO" if name in unpolarised else _type(each[e]) for e, name in enumerate(label)]
    night = _window(exposures.mjd, exposures.exptime, site)
    targets, objects = [], dict[str, dict[str, str]]()
    for (target, kind), group in itertools.groupby(range(len(rows)), lambda e: (label[e], kinds[e])):
        acquisitions = []
        for _, same in itertools.groupby(group, lambda e: json.dumps(rows[e], sort_keys=True)):
            which = list(same)
            of_sky = kind != "CAL-CAL"
            window = _window(exposures.mjd[which], exposures.exptime[which], site) if of_sky else night
            seconds, setting = rows[which[0]]
            exposure = {"multiples": len(which), "T": seconds}
            acquisitions.append({"window": window, "guider": False, **setting, "exposure": exposure})
            ra, dec = float(exposures.ra[which[0]]), float(exposures.dec[which[0]])
            if math.isfinite(ra) and math.isfinite(dec):
                place = {"ra": sexagesimal(ra, "hourangle"), "dec": sexagesimal(dec, "deg")}
                objects.setdefault(target, {"name": target, **place})
        targets.append({"target": target, "type": kind, "acquisition": acquisitions})
    evening = _local(float(np.nanmin(exposures.mjd)), site) - datetime.timedelta(hours=12)
    usual = {"name": "calibration", "pi": "walop-jax", "mode": "manual", "observer": "walop-jax"}
    stated = {name: (facts or {}).get(name, text) for name, text in usual.items()}
    head = {"name": stated.pop("name"), "date": evening.date().isoformat(), **stated}
    return head | {"objects": list(objects.values()), "targets": targets}, remarks


def _labels(exposures: Exposures) -> Iterator[str]:
    """Names of targets by their KIND, numbered where exposures of a KIND have several places on the sky."""
    usual = {"clp": "calibration polariser", "moon": "Moon"}
    places = np.nan_to_num(np.stack([exposures.ra, exposures.dec], axis=1), nan=np.inf)
    seen = list(zip(map(str, exposures.kind), map(tuple, places.tolist()), strict=True))
    of_kind = {kind: sorted({place for name, place in seen if name == kind}) for kind in dict(seen)}
    for kind, place in seen:
        number = f" {of_kind[kind].index(place) + 1}" if len(of_kind[kind]) > 1 else ""
        yield usual.get(kind, kind) + number


def read_schedule(
    path: PathLike, filters: Mapping[str, int], content: Any = None
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Columns of EXPOSURES of a schedule, the names of their targets in TARGET, and remarks.

    `content` is that of the file, where it has been read. An acquisition that was executed may hold `executed`, the UTC
    at which each exposure began. Without it times are not known. Raises `DataError`, with target and acquisition, for
    missing entries and for states that an exposure cannot have.
    """
    content = json_content(path) if content is None else content
    if not is_schedule(content):
        raise fail("is no schedule: it has no objects and targets", file=path, advice="give one of format v4")
    where = {str(entry.get("name")): entry for entry in _tables(content["objects"], path, "objects")}
    _tables(content["targets"], path, "targets")
    name_of = {number: name for name, number in filters.items()}
    rows, remarks = list(_read(content, where, name_of, path)), list[str]()
    if science := [str(t.get("target")) for t in content["targets"] if t.get("type") in OF_SCIENCE]:
        remarks.append(f"{path}: {', '.join(science)}: no calibration ({' and '.join(OF_SCIENCE)}), left out")
    if not rows:
        raise fail("has no exposures", file=path, advice="nothing to be read")
    targets = np.array([row.pop("TARGET") for row in rows])
    table = columns_of(rows, str(path))
    if unknown := int(np.sum(np.isnan(table["MJD"]))):
        remarks.append(f"{path}: {unknown} exposures without `executed`: their time is not known")
    unplaced = np.isin(table["KIND"], ("moon", "standard")) & np.isnan(table["RA"])
    if unplaced.any():
        names = some(list(dict.fromkeys(targets[unplaced].tolist())), 5)
        remarks.append(f"{path}: {names}: no object with RA and DEC, where these are is not known")
    if early := overlapping(table["MJD"], table["EXPTIME"]):
        what = "begin before the one ahead of them has ended"
        remarks.append(f"{path}: {early} exposures {what}: are `executed` their begins, in UTC?")
    return table | {"TARGET": targets}, remarks


# --------------------------------------------------------------------------------------------------------- writing


def _check(exposures: Exposures, filters: Mapping[str, int]) -> None:
    for name in np.unique(exposures.filter).tolist():
        number = filters.get(name)
        if number is None or not 1 <= number <= MOST_FILTERS:
            what = f"filter {name} has no number from 1 to {MOST_FILTERS}"
            raise fail(what, column="FILTER", advice=f'give it: filters = {{ "{name}" = 1 }} in the words')
    if numbers := [n for n in filters.values() if list(filters.values()).count(n) > 1]:
        what = f"two filters have the number {numbers[0]}"
        raise fail(what, column="FILTER", advice="correct filters of the words")
    if inside := [prefix for prefix, at in exposures.further.items() if at.inside.any()]:
        what, column = f"a schedule cannot set {inside[0]}", f"{inside[0]}_ANGLE"
        raise fail(what, column=column, advice="take these by hand")
    if not np.isfinite(exposures.exptime).all():
        raise fail("is not known", column="EXPTIME", advice="a schedule needs the time of every exposure")
    if not np.isfinite(exposures.mjd).any():
        raise fail("no exposure has a time", column="MJD", advice="a schedule needs the date of its night")


def _state(at: Position, seconds: int, prefix: str) -> dict[str, Any]:
    """Setting of an element in a single exposure."""
    if not at.inside[0]:
        return {"engage": False, "continuous": False}
    turn = float(at.turn[0])
    if not turn:
        return {"engage": True, "continuous": False, "angle": float(at.angle[0]) % 360.0}
    speed = turn / 6.0 / seconds
    if speed > FASTEST * (1.0 + 1e-9):
        what = f"{turn:g} deg in {seconds} s is {speed:.2g} turns a minute, more than {FASTEST:g}"
        raise fail(what, column=f"{prefix}_TURN", advice="turn it less, or expose longer")
    _check_half_turns(turn, prefix)
    return {"engage": True, "continuous": True, "speed": speed}


def _check_half_turns(turn: float, prefix: str, file: object = "") -> None:
    if abs(turn / ALIKE - round(turn / ALIKE)) > 1e-6:
        what = f"a turn of {turn:g} deg is none of half turns: the angle at which it began counts, and is not stated"
        advice = f"choose speed and time so that 6 × speed × T is a multiple of {ALIKE:g} deg, or take it from the log"
        raise fail(what, file=file, column=f"{prefix}_TURN", advice=advice)


def _type(one: Exposures) -> str:
    kind = str(one.kind[0])
    return "CAL-CAL" if one.clp_in[0] else TYPES.get(kind, "CAL-POL" if kind == "standard" else "LAB-OPT")


def _local(mjd: float, site: Site) -> datetime.datetime:
    """Local mean time, in whole hours from UTC."""
    west = site.longitude > 180.0  # 290 deg east is 70 deg west: five hours behind UTC, not nineteen ahead
    hours = round((site.longitude - 360.0 * west) / 15.0) if math.isfinite(site.longitude) else 0
    return datetime.datetime(1858, 11, 17) + datetime.timedelta(days=mjd, hours=hours)


def _window(mjd: np.ndarray, exptime: np.ndarray, site: Site) -> dict[str, str]:
    """A window about exposures; the whole night where their times are not known."""
    dated = np.isfinite(mjd)
    if not dated.any():
        return {"start": "18:00:00", "end": "06:00:00"}
    half = np.nan_to_num(exptime[dated]) / 2.0 / 86400.0
    edges = (mjd[dated] - half).min() - SLACK / 1440.0, (mjd[dated] + half).max() + SLACK / 1440.0
    return dict(zip(("start", "end"), (f"{_local(float(t), site):%H:%M:%S}" for t in edges), strict=True))


# --------------------------------------------------------------------------------------------------------- reading


def _read(
    content: Mapping[str, Any], where: Mapping[str, Any], name_of: Mapping[int, str], path: Any
) -> Iterator[dict[str, Any]]:
    for target in content["targets"]:
        name, form = str(target.get("target")), str(target.get("type"))
        if form in OF_SCIENCE:
            continue
        if form not in KINDS_OF and not form.startswith(("TES-", "LAB-")):
            raise fail(f"target {name} has the type {form}", file=path, advice="give one of format v4")
        for number, acquisition in enumerate(_tables(target.get("acquisition", []), path, "acquisition")):
            place = f"{path}: target {name}, acquisition {number}"
            read = Reader(place)
            try:
                exposure, plate, polariser = (
                    read.table(acquisition[key], "", f"{key} = ") for key in ("exposure", "hwp", "polarizer")
                )
                count = read.whole(exposure["multiples"], "multiples", "exposure")
                number_of_filter = read.whole(acquisition["filter"], "filter", "")
                inside = read.flag(polariser["engage"], "engage", "polarizer")
                seconds = read.positive(exposure["T"], "T", "exposure")
                settings = _position(plate, CALIBRATION_PLATE, seconds, read)
                settings |= _position(polariser, POLARISER, seconds, read)
            except KeyError as error:
                raise fail(f"has no {error}", file=place, advice="see the format v4") from None
            if not 1 <= count <= MOST_EXPOSURES:
                raise read.fault("exposure", f"multiples = {count} must be between 1 and {MOST_EXPOSURES}")
            if number_of_filter not in name_of:
                advice = f'give its name: filters = {{ "SDSS-r" = {number_of_filter} }} in the words'
                raise fail(f"filter {number_of_filter} has no name", file=place, advice=advice)
            began = acquisition.get("executed") or []
            if began and len(began) != count:
                raise fail(f"has {len(began)} times of {count} exposures", file=place, advice="one for each")
            kind = "clp" if inside else KINDS_OF.get(form, "lamp").replace("clp", "lamp")
            place_of = where.get(name, {})
            for k in range(count):
                yield {
                    "TARGET": name,
                    "KIND": kind,
                    "MJD": _mjd(began[k], place) + seconds / 2 / 86400.0 if began else math.nan,
                    "EXPTIME": seconds,
                    "FILTER": name_of[number_of_filter],
                    "RA": _angle(place_of.get("ra"), "hourangle", name, path),
                    "DEC": _angle(place_of.get("dec"), "deg", name, path),
                    **settings,
                }


def _tables(value: Any, path: Any, what: str) -> list[Mapping[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(entry, Mapping) for entry in value):
        raise fail(f"{what} is no list of records", file=path, advice="see the format v4")
    return value


def _angle(text: Any, unit: str, name: str, path: Any) -> float:
    try:
        return math.nan if text is None else float(degrees_of(text.strip(), unit))
    except (ValueError, AttributeError):
        raise fail(f"object {name}: {text!r} is no angle", file=path, advice="as 06:30:12.5") from None


def _position(state: Mapping[str, Any], prefix: str, seconds: float, read: Reader) -> dict[str, float]:
    """The columns of an element: whether it is in, its angle and, where it turns, its turn."""
    word = ELEMENTS[prefix]
    if not read.flag(state["engage"], "engage", word):
        return {f"{prefix}_IN": False, f"{prefix}_ANGLE": math.nan}
    if not state.get("continuous"):
        if "angle" not in state:
            raise fail("is in the beam without an angle", file=read.where, column=prefix, advice="give it")
        if not 0.0 <= (angle := read.number(state["angle"], "angle", word)) <= 360.0:
            raise read.fault(word, f"angle = {angle:g} must be between 0 and 360 degrees")
        return {f"{prefix}_IN": True, f"{prefix}_ANGLE": angle}
    if (speed := read.positive(state.get("speed"), "speed", word)) > FASTEST:
        raise read.fault(word, f"speed = {speed:g} must be at most {FASTEST:g} turns a minute")
    turn = 6.0 * speed * seconds
    if prefix == POLARISER:
        what, advice = "turns during the exposure", "leave it out, or take it at angles"
        raise fail(what, file=read.where, column=prefix, advice=advice)
    _check_half_turns(turn, prefix, read.where)
    return {f"{prefix}_IN": True, f"{prefix}_ANGLE": 0.0, f"{prefix}_TURN": turn}


def _mjd(text: Any, place: str) -> float:
    try:
        return mjd_of(str(text))
    except ValueError:
        raise fail(f"executed: {text!r} is no time", file=place, advice="as 2026-11-26T01:02:03Z") from None
