"""Description files of instruments (TOML): elements with their numbers, arms, cameras, site and field.

A file may be based on another one (`like = NAME`) and say only what differs: tables are merged key by key, layers of a
plate by their name, and everything else is replaced. Which entries elements and arms may have is known to the model
that builds them (`model.build`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, TypeGuard

from walop_jax.io.errors import DataError, PathLike, nearest
from walop_jax.io.text import parse_toml, read_text
from walop_jax.io.toml import Reader, Table

REQUIRED = ("name", "path", "field", "cameras", "throughput", "elements", "arms")
KEYS: Table = dict.fromkeys(REQUIRED, Any) | {
    "default": Any, "like": str, "about": str, "source": str, "wavelength": float, "site": Any,
}  # fmt: skip
SITE: Table = {"telescope": str} | dict.fromkeys(("latitude", "longitude", "elevation", "full_moon"), float)
FIELD: Table = {"limit": float, "scale": float, "raster": str, "edge": float}
CAMERAS: Table = {"names": Any, "split": bool, "floor": float}
THROUGHPUT: Table = {"degree": int, "level": float, "scale": float, "loose": float}
RASTERS = ("square", "line")
NO_SOURCE = "description file"  # of numbers, where a file names none


@dataclasses.dataclass(frozen=True)
class Description:
    """An instrument as described; `path` names the elements ahead of the arms in the order light meets them.

    `elements` and `arms` are their tables, read by the model that builds them, with `read`; `field_limit`,
    `field_scale` and `edge` are in degrees; `wavelength` (µm) is the wavelength from which colours are counted (None:
    as for WALOP); `degree`, `level`, `scale` and `loose` belong to the throughput; `split` and `floor` are as `split`
    and `noise_floor` of `model.cameras.Cameras`; `raster` says how the field points of a simulated run lie.
    """

    name: str
    about: str
    source: str
    path: tuple[str, ...]
    elements: Table
    arms: Table
    cameras: tuple[str, ...]
    field_limit: float
    field_scale: float
    degree: int
    level: float
    scale: float
    loose: float
    site: Table
    read: Reader
    raster: str = "square"
    edge: float = 0.0
    split: bool = False
    floor: float = 0.0
    wavelength: float | None = None
    default: bool = False
    text: str = ""

    @property
    def place(self) -> tuple[str, float, float, float, float]:
        """Telescope, latitude and longitude (deg, east positive), elevation (m), MJD of a full Moon; NaN: not said."""
        latitude, longitude, elevation, moon = (float(self.site.get(key, math.nan)) for key in list(SITE)[1:])
        return str(self.site.get("telescope", "")), latitude, longitude, elevation, moon


@functools.cache
def shipped() -> tuple[str, ...]:
    """Names of the instruments that come with the package."""
    folder = resources.files("walop_jax.instruments")
    return tuple(sorted(file.name[:-5] for file in folder.iterdir() if file.name.endswith(".toml")))


@functools.cache
def default_name() -> str:
    """The shipped instrument that is used where none is named."""
    return next(name for name in shipped() if described(name).default)


@functools.cache
def described(name: str) -> Description:
    """A shipped instrument by name. Raises `DataError` with the nearest names for one that does not exist."""
    by_name = {shipped_name.upper(): shipped_name for shipped_name in shipped()}
    if name.upper() not in by_name:
        raise DataError(
            f"there is no instrument {name!r}; {nearest(name.upper(), shipped())} (or give a description file)"
        )
    return parsed(_shipped_text(by_name[name.upper()]), f"instrument {name}")


def _shipped_text(name: str) -> str:
    return (resources.files("walop_jax.instruments") / f"{name}.toml").read_text(encoding="utf-8")


def read_description(source: PathLike) -> Description:
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
    return _description(Reader(where), _whole(text, where, ()), text)


def _whole(text: str, where: str, seen: tuple[str, ...]) -> Table:
    """The table of a text with that of the instrument it stands on."""
    try:
        table = parse_toml(text)
    except ValueError as error:
        raise DataError(f"{where}: {error}") from None
    like = table.get("like")
    if like is None:
        return table
    by_name = {name.upper(): name for name in shipped()}
    if not isinstance(like, str) or like.upper() not in by_name or like in seen:
        raise DataError(
            f"{where}: like = {like!r} must name a shipped instrument; {nearest(str(like), shipped())}"
        )
    base = dict(_whole(_shipped_text(by_name[like.upper()]), like, (*seen, like)))
    base.pop("default", None)  # of one instrument alone
    field = table.get("field")
    if (
        isinstance(field, Mapping)
        and {"limit", "edge"} & set(field)
        and isinstance(base.get("field"), Mapping)
    ):
        # A field of another size has another scale.
        replaceable = {"raster"} | ({"limit"} if "edge" in field else set())
        base["field"] = {key: value for key, value in base["field"].items() if key in replaceable}
    return merged(base, table)


def merged(old: Table, new: Table) -> Table:
    """Two tables as one: tables key by key, lists of tables with names by name, all else replaced."""
    result = dict(old)
    for key, value in new.items():
        before = result.get(key)
        if isinstance(before, Mapping) and isinstance(value, Mapping) and "value" not in value:
            result[key] = merged(before, value)
        elif (
            is_named(before) and is_named(value) and [t["name"] for t in before] == [t["name"] for t in value]
        ):
            result[key] = [merged(old_one, new_one) for old_one, new_one in zip(before, value, strict=True)]
        else:
            result[key] = value
    return result


def is_named(value: Any) -> TypeGuard[list[Table]]:
    """True for a list of tables with a name each."""
    return isinstance(value, list) and all(isinstance(entry, Mapping) and "name" in entry for entry in value)


def _description(read: Reader, table: Table, text: str) -> Description:
    read.values(KEYS, table, "")
    for key in REQUIRED:
        if key not in table:
            raise read.fault("", f"{key} is missing; walop-jax docs adding-an-instrument has an example")
    tables = ("site", "field", "throughput", "cameras", "elements", "arms")
    site, field, series, cameras, elements, arms = (
        read.table(table.get(key, {}), "", f"{key} = ") for key in tables
    )
    for place, hints in (("site", SITE), ("field", FIELD), ("throughput", THROUGHPUT), ("cameras", CAMERAS)):
        read.values(hints, table.get(place, {}), place)
    if not abs(site.get("latitude", 0.0)) <= 90.0:
        raise read.fault("site", f"latitude = {site['latitude']:g} must be between -90 and 90 deg")
    degree, floor = series.get("degree", 4), float(cameras.get("floor", 0.0))
    if not 0 <= degree <= 12:
        raise read.fault("throughput", f"degree = {degree!r} must be a whole number from 0 to 12")
    if not 0.0 <= floor < 1.0:
        raise read.fault("cameras", f"floor = {floor:g} must be a fraction of the light from 0 to below 1")
    raster = field.get("raster", RASTERS[0])
    if raster not in RASTERS:
        raise read.fault("field", f"raster = {raster!r} must be {' or '.join(RASTERS)}")
    if not arms:
        raise read.fault("arms", "needs one arm at least")
    return Description(
        name=read.text(table["name"], "name", ""),
        about=table.get("about", ""),
        source=table.get("source", NO_SOURCE),
        path=read.words(table["path"], "path", "") if table["path"] else (),
        elements=elements,
        arms=arms,
        cameras=read.words(cameras.get("names"), "names", "cameras"),
        field_limit=read.positive(field.get("limit", 90.0), "limit", "field"),
        field_scale=read.positive(
            field.get("scale", field.get("edge", field.get("limit", 0.3))), "scale", "field"
        ),
        degree=degree,
        level=read.positive(series.get("level", 0.5), "level", "throughput"),
        scale=read.positive(series.get("scale", 0.02), "scale", "throughput"),
        loose=read.positive(series.get("loose", 0.5), "loose", "throughput"),
        site=dict(site),
        read=read,
        raster=raster,
        edge=read.number(field.get("edge", field.get("limit", 0.0)), "edge", "field"),
        split=cameras.get("split", False),
        floor=floor,
        wavelength=read.positive(table["wavelength"], "wavelength", "") if "wavelength" in table else None,
        default=table.get("default") is True,
        text=text,
    )
