"""Description files of instruments (TOML): elements with their numbers, arms, cameras, site and field.

A file may stand on another one (`like = NAME`) and say only what differs: tables are merged key by key, layers of a
plate by their name, everything else is replaced. What is checked here is the form; whether an element of that kind
exists and takes such a number, the model says that builds it (`model.build`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import re
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, TypeGuard

from walop_jax.io.errors import DataError, nearest
from walop_jax.io.text import parse_toml, read_text

Table = Mapping[str, Any]

KEYS = (
    "name", "default", "like", "about", "source", "path", "site", "field", "cameras", "throughput", "elements", "arms",
)  # fmt: skip
REQUIRED = ("name", "path", "field", "cameras", "throughput", "elements", "arms")
NUMBER_KEYS = ("value", "sigma", "unit", "source", "name", "scale", "loose", "tie")
SITE_KEYS = ("telescope", "latitude", "longitude", "elevation", "full_moon")
FIELD_KEYS = ("limit", "scale", "raster", "edge")
RASTERS = ("square", "line")
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
LARGEST = 1e300
CAMERA_KEYS = ("names", "split", "floor")
THROUGHPUT_KEYS = ("degree", "level", "scale", "loose")


@dataclasses.dataclass(frozen=True)
class Given:
    """A number of a description: fixed, or a parameter if the file gives more than its value.

    `sigma` is the scatter expected of what was built (the width of the prior, None: no prior), `scale` the step of a
    solver, `loose` the width of a weak pull; `name` replaces the name of the parameter, `tie` names the parameter that
    has the same value. A number that an element has at
    several wavelengths is a tuple; what else is said of it holds for each.
    """

    value: float | tuple[float, ...]
    parameter: bool = False
    sigma: float | None = None
    unit: str | None = None
    source: str | None = None
    name: str | None = None
    scale: float | None = None
    loose: float | None = None
    tie: str | None = None


@dataclasses.dataclass(frozen=True)
class ElementText:
    """An element as described: its kind, the columns that move it, and everything else by name."""

    name: str
    kind: str
    moves: str | None
    values: Mapping[str, Any]
    layers: tuple[Mapping[str, Any], ...] = ()


@dataclasses.dataclass(frozen=True)
class ArmText:
    """An arm as described; `path` names its elements in the order light meets them."""

    name: str
    path: tuple[str, ...]
    elements: tuple[ElementText, ...]


@dataclasses.dataclass(frozen=True)
class Description:
    """An instrument as described; `path` names the elements ahead of the arms in the order light meets them.

    `field_limit`, `field_scale` and `edge` in degrees; `split` and `floor` as in `model.cameras.Cameras`; `raster` is
    how the field points of a simulated run lie.
    """

    name: str
    about: str
    source: str
    path: tuple[str, ...]
    elements: tuple[ElementText, ...]
    arms: tuple[ArmText, ...]
    cameras: tuple[str, ...]
    field_limit: float
    field_scale: float
    throughput_degree: int
    throughput: Given
    site: Mapping[str, Any]
    raster: str = "square"
    edge: float = 0.0
    split: bool = False
    floor: float = 0.0
    default: bool = False
    text: str = ""

    @property
    def place(self) -> tuple[str, float, float, float, float]:
        """Telescope, latitude and longitude (deg, east positive), elevation (m), MJD of a full Moon; NaN: not said."""
        latitude, longitude, elevation, moon = (float(self.site.get(key, math.nan)) for key in SITE_KEYS[1:])
        return str(self.site.get("telescope", "")), latitude, longitude, elevation, moon


@functools.cache
def shipped() -> tuple[str, ...]:
    """Names of the instruments that come with the package."""
    folder = resources.files("walop_jax.instruments")
    return tuple(sorted(file.name[:-5] for file in folder.iterdir() if file.name.endswith(".toml")))


@functools.cache
def default_name() -> str:
    """The shipped instrument that is meant where none is named."""
    return next(name for name in shipped() if described(name).default)


@functools.cache
def described(name: str) -> Description:
    """A shipped instrument by name. Raises `DataError` with the nearest names for one that does not exist."""
    known = {each.upper(): each for each in shipped()}
    if name.upper() not in known:
        raise DataError(
            f"unknown instrument {name!r}; {nearest(name.upper(), shipped())}, or give a description file"
        )
    return parsed(_shipped_text(known[name.upper()]), f"instrument {name}")


def _shipped_text(name: str) -> str:
    return (resources.files("walop_jax.instruments") / f"{name}.toml").read_text(encoding="utf-8")


def read_description(source: str | os.PathLike[str]) -> Description:
    """The description in a file, or a shipped one by name.

    Raises `DataError` naming the file, the table and the key that is wrong, and what to write instead.
    """
    text = os.fspath(source)
    if text.upper() in (name.upper() for name in shipped()):
        return described(text)
    path = Path(source)
    if path.suffix != ".toml" and not path.exists():
        return described(text)
    return parsed(read_text(path), str(path))


def parsed(text: str, where: str) -> Description:
    """The description that a TOML text holds; `where` begins every message about it."""
    return _Reader(where).description(_whole(text, where, ()), text)


def _whole(text: str, where: str, seen: tuple[str, ...]) -> Table:
    """The table of a text with that of the instrument it stands on."""
    try:
        table = parse_toml(text)
    except ValueError as error:
        raise DataError(f"{where}: {error}") from None
    like = table.get("like")
    if like is None:
        return table
    known = {name.upper(): name for name in shipped()}
    if not isinstance(like, str) or like.upper() not in known or like in seen:
        raise DataError(
            f"{where}: like = {like!r} must name a shipped instrument; {nearest(str(like), shipped())}"
        )
    return merged(_whole(_shipped_text(known[like.upper()]), like, (*seen, like)), table)


def merged(old: Table, new: Table) -> Table:
    """Two tables as one: tables key by key, lists of tables with names by name, all else replaced."""
    result = dict(old)
    for key, value in new.items():
        before = result.get(key)
        if isinstance(before, Mapping) and isinstance(value, Mapping) and "value" not in value:
            result[key] = merged(before, value)
        elif _named(before) and _named(value) and [t["name"] for t in before] == [t["name"] for t in value]:
            result[key] = [merged(old_one, new_one) for old_one, new_one in zip(before, value, strict=True)]
        else:
            result[key] = value
    return result


def _named(value: Any) -> TypeGuard[list[Table]]:
    return isinstance(value, list) and all(isinstance(entry, Mapping) and "name" in entry for entry in value)


# ------------------------------------------------------------------------------------------------ checking


@dataclasses.dataclass(frozen=True)
class _Reader:
    where: str

    def fault(self, place: str, what: str) -> DataError:
        return DataError(f"{self.where}: [{place}] {what}" if place else f"{self.where}: {what}")

    def known(self, table: Table, keys: tuple[str, ...], place: str) -> None:
        for key in table:
            if key not in keys:
                raise self.fault(place, f"unknown key {key!r}; {nearest(key, keys)}")

    def table(self, table: Table, key: str, place: str = "") -> Table:
        value = table.get(key, {})
        if not isinstance(value, Mapping):
            raise self.fault(place, f"{key} = {value!r} must be a table")
        return value

    def name(self, value: str, place: str) -> str:
        if not NAME.fullmatch(value):
            raise self.fault(place, f"{value!r} cannot be a name: letters, digits and _, a letter first")
        return value

    def words(self, value: Any, key: str, place: str) -> tuple[str, ...]:
        if not (isinstance(value, list) and value and all(isinstance(word, str) for word in value)):
            raise self.fault(place, f"{key} = {value!r} must be a list of names")
        if len(set(value)) != len(value):
            raise self.fault(place, f"{key} names something twice: {', '.join(value)}")
        return tuple(value)

    def text(self, value: Any, key: str, place: str) -> str:
        if not isinstance(value, str) or not value.isprintable() or not value.strip():
            raise self.fault(place, f"{key} = {value!r} must be a text on one line")
        return value

    def float(self, value: Any, key: str, place: str) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
            shown = repr(value) if len(repr(value)) < 80 else "that"
            raise self.fault(place, f"{key} = {shown} must be a finite number")
        return float(value)

    def floats(self, value: list[Any], key: str, place: str) -> tuple[float, ...]:
        return tuple(self.float(entry, f"{key}[{i}]", place) for i, entry in enumerate(value))

    def split_and_floor(self, cameras: Table) -> tuple[bool, float]:
        split, floor = cameras.get("split", False), self.float(cameras.get("floor", 0.0), "floor", "cameras")
        if not isinstance(split, bool) or not 0.0 <= floor < 1.0:
            raise self.fault(
                "cameras", "split must be true or false, floor a share of the light from 0 to below 1"
            )
        return split, floor

    def positive(self, value: Any, key: str, place: str) -> float:
        number = self.float(value, key, place)
        if number <= 0:
            raise self.fault(place, f"{key} = {number:g} must be above 0")
        return number

    def number(self, value: Any, key: str, place: str) -> Given:
        if not isinstance(value, Mapping):
            return Given(self.float(value, key, place))
        here = f"{place}.{key}"
        self.known(value, NUMBER_KEYS, here)
        if "value" not in value:
            raise self.fault(here, "has no value")
        content = value["value"]
        several = isinstance(content, list) and bool(content)
        checked = self.floats(content, "value", here) if several else self.float(content, "value", here)
        given: dict[str, Any] = {"value": checked, "parameter": True}
        for name in ("sigma", "scale", "loose"):
            if name in value:
                given[name] = self.float(value[name], name, here)
                if given[name] <= 0:
                    raise self.fault(
                        here, f"{name} = {given[name]:g} must be above 0; leave it out where there is none"
                    )
        for name in ("unit", "source", "name", "tie"):
            if name in value:
                pure = name == "unit" and value[name] == ""
                given[name] = "" if pure else self.text(value[name], name, here)
        return Given(**given)

    def element(self, name: str, table: Any, place: str) -> ElementText:
        if not isinstance(table, Mapping):
            raise self.fault(place, f"{table!r} must be a table")
        if "kind" not in table:
            raise self.fault(place, "has no kind")
        moves = table.get("moves")
        if moves is not None:
            moves = self.text(moves, "moves", place)
        values = {
            k: self.value(v, k, place) for k, v in table.items() if k not in ("kind", "moves", "layers")
        }
        layers = table.get("layers", [])
        if not _named(layers):
            raise self.fault(place, "layers must be a list of tables with a name each")
        for layer in layers:
            self.name(self.text(layer["name"], "name", f"{place}.layers"), f"{place}.layers")
        self.words([layer["name"] for layer in layers], "layers", place) if layers else None
        made = tuple(
            {k: self.value(v, k, f"{place}.layers.{layer['name']}") for k, v in layer.items()}
            for layer in layers
        )
        return ElementText(name, self.text(table["kind"], "kind", place), moves, values, made)

    def value(self, value: Any, key: str, place: str) -> Any:
        """A number, a name, a list of either, or true or false."""
        if isinstance(value, bool):
            return value
        if isinstance(value, str):
            return self.text(value, key, place)
        if isinstance(value, list) and value and not isinstance(value[0], str):
            return Given(self.floats(value, key, place))
        if isinstance(value, list):
            return self.words(value, key, place)
        return self.number(value, key, place)

    def elements(self, table: Table, path: tuple[str, ...], place: str) -> Iterator[ElementText]:
        for name in path:
            if name not in table:
                raise self.fault(
                    place, f"path names {name!r}, which is not described; {nearest(name, table)}"
                )
        for name, entry in table.items():
            if name not in path:
                raise self.fault(f"{place}.{name}".lstrip("."), "is described but does not stand in the path")
            yield self.element(self.name(name, place), entry, f"{place}.{name}".lstrip("."))

    def arm(self, name: str, table: Any) -> ArmText:
        place = f"arms.{self.name(name, 'arms')}"
        if not isinstance(table, Mapping):
            raise self.fault(place, f"{table!r} must be a table")
        self.known(table, ("path", "elements"), place)
        path = self.words(table.get("path"), "path", place)
        elements = self.table(table, "elements", place)
        return ArmText(name, path, tuple(self.elements(elements, path, f"{place}.elements")))

    def description(self, table: Table, text: str) -> Description:
        self.known(table, KEYS, "")
        for key in REQUIRED:
            if key not in table:
                raise self.fault("", f"{key} is missing")
        site, field = self.table(table, "site"), self.table(table, "field")
        self.known(site, SITE_KEYS, "site")
        self.known(field, FIELD_KEYS, "field")
        for key, value in site.items():
            self.text(value, key, "site") if key == "telescope" else self.float(value, key, "site")
        if not abs(site.get("latitude", 0.0)) <= 90.0:
            raise self.fault("site", f"latitude = {site['latitude']:g} must be between -90 and 90 deg")
        series = self.table(table, "throughput")
        self.known(series, THROUGHPUT_KEYS, "throughput")
        degree = series.get("degree", 4)
        if isinstance(degree, bool) or not isinstance(degree, int) or not 0 <= degree <= 12:
            raise self.fault("throughput", f"degree = {degree!r} must be a whole number from 0 to 12")
        level = self.positive(series.get("level", 0.5), "level", "throughput")
        cameras = self.table(table, "cameras")
        self.known(cameras, CAMERA_KEYS, "cameras")
        split, floor = self.split_and_floor(cameras)
        path = tuple(self.words(table["path"], "path", "")) if table["path"] else ()
        raster = field.get("raster", RASTERS[0])
        if raster not in RASTERS:
            raise self.fault("field", f"raster = {raster!r} must be {' or '.join(RASTERS)}")
        arms = tuple(self.arm(name, entry) for name, entry in self.table(table, "arms").items())
        if not arms:
            raise self.fault("arms", "needs one arm at least")
        return Description(
            name=self.text(table["name"], "name", ""),
            about=self.text(table["about"], "about", "") if "about" in table else "",
            source=self.text(table.get("source", "description file"), "source", ""),
            path=path,
            elements=tuple(self.elements(self.table(table, "elements"), path, "elements")),
            arms=arms,
            cameras=self.words(cameras.get("names"), "names", "cameras"),
            field_limit=self.positive(field.get("limit", 90.0), "limit", "field"),
            field_scale=self.positive(field.get("scale", 0.3), "scale", "field"),
            throughput_degree=degree,
            throughput=Given(
                level,
                parameter=True,
                scale=self.positive(series.get("scale", 0.02), "scale", "throughput"),
                loose=self.positive(series.get("loose", 0.5), "loose", "throughput"),
            ),
            site=dict(site),
            raster=raster,
            edge=self.float(field.get("edge", 0.0), "edge", "field"),
            split=split,
            floor=floor,
            default=table.get("default") is True and "default" in text,
            text=text,
        )
