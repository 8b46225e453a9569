"""From the description of an instrument to its parts: construction and checks of all elements of a file."""

from __future__ import annotations

import dataclasses
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.data.kinds import POLARISER, PREFIX, WAVELENGTHS
from walop_jax.instruments.description import Description, Reader, Table, is_named
from walop_jax.io.errors import nearest
from walop_jax.model import legendre
from walop_jax.model.cameras import Cameras, Throughput
from walop_jax.model.compiled import array
from walop_jax.model.elements.base import Element
from walop_jax.model.elements.geometry import PupilMapping
from walop_jax.model.elements.registry import ELEMENTS
from walop_jax.model.elements.simple import Analyser, Polariser
from walop_jax.model.elements.wave_plate import Layer, WavePlate
from walop_jax.model.parameters import Component, Parameter, is_row, numbers_of, unknown_name

OWN = ("name", "moves", "declared", "model")  # under other keys in a file, or absent
NUMBER_KEYS = ("value", "sigma", "unit", "source", "name", "scale", "loose", "tie")
SERIES = "Legendre coefficient P_i(x/h) P_j(y/h)"
FREE = "smooth vignetting and coatings: free"
SHARES = ("efficiency", "extinction", "linear", "circular")
PER_FIELD = re.compile(r"deg-(\d)")  # unit of coefficients of a power of the distance from the centre
SURE = 3.0  # standard deviations within which an instrument is built
LARGEST_ANGLE = 4.0 * np.pi  # rad, of a number without a unit: two waves
NANOMETRES = 3000.0  # above, wavelengths are taken for Angstrom

ArmParts = tuple[str, tuple[Element, ...], tuple[str, ...]]
Declared = tuple[tuple[str, Parameter], ...]


def made_by(kind: str) -> str:
    """The beginning of the line of a description on the origin of a user-defined kind of element."""
    return f"# element {kind}: "


def with_origins(text: str, elements: Sequence[Element]) -> str:
    """A description with a line for each user-defined kind of element: other readers need the class."""
    lines = {}
    for element in elements:
        if not any(type(element) is kind for kind in ELEMENTS) and made_by(element.kind) not in text:
            module = sys.modules.get(type(element).__module__)
            file = Path(getattr(module, "__file__", None) or "a Python session").name
            lines[element.kind] = f"{made_by(element.kind)}class {type(element).__qualname__} of {file}"
    return "\n".join((text.rstrip("\n"), *lines.values(), "")) if lines else text


def parts(
    description: Description, elements: Sequence[type[Element]] = ()
) -> tuple[tuple[Element, ...], tuple[ArmParts, ...], Throughput, Cameras]:
    """The parts of a described instrument, at the values of the description.

    An arm is its name, its elements and their order. `elements` are further kinds of elements for the description.
    Raises `DataError`, with table and key, for invalid entries.
    """
    kinds = {kind.kind: kind for kind in (*ELEMENTS, *elements)}
    edge = (description.edge or description.field_scale) * (
        1.0 if description.raster == "line" else np.sqrt(2.0)
    )
    make = _Maker(description.read, description.source, kinds, description.text, edge)
    common = tuple(make.elements(description.elements, description.path, "elements"))
    arms = tuple(make.arm(name, table) for name, table in description.arms.items())
    coefficients = np.zeros((len(description.cameras), len(legendre.terms(description.degree))))
    coefficients[:, 0] = description.level
    series = Throughput(
        degree=description.degree,
        coefficients=array(coefficients),
        scale=description.field_scale,
        declared=Parameter("", "", SERIES, FREE, scale=description.scale, loose=description.loose),
    )
    return common, arms, series, _cameras(description, arms)


def _cameras(description: Description, arms: Sequence[ArmParts]) -> Cameras:
    names, fault = description.cameras, description.read.fault
    beams = []
    for arm, elements, path in arms:
        (analyser,) = (element for element in elements if element.name == path[-1])
        assert isinstance(analyser, Analyser)
        for name in analyser.cameras:
            if name not in names:
                raise fault(f"arms.{arm}", f"camera {name!r} does not exist; {nearest(name, names)}")
        beams.append(tuple(map(names.index, analyser.cameras)))
    cameras = [camera for beam in beams for camera in beam]
    if sorted(cameras) != list(range(len(names))):
        raise fault("cameras", f"every camera must be behind exactly one analyser: {', '.join(names)}")
    return Cameras(names=names, arms=tuple(beams), split=description.split, noise_floor=description.floor)


@dataclasses.dataclass(frozen=True)
class _Maker:
    read: Reader
    source: str
    kinds: Mapping[str, type[Element]]
    text: str = ""
    farthest: float = 0.0

    def origin(self, kind: str) -> str:
        """Advice on the missing class of a kind, with its origin where the description names it."""
        line = next((line for line in self.text.splitlines() if line.startswith(made_by(kind))), "")
        where = line.removeprefix(made_by(kind))
        return f"It is {where}: give --elements FILE.py" if where else "One of your own: --elements FILE.py"

    def arm(self, name: str, content: Any) -> ArmParts:
        place = f"arms.{self.read.name(name, 'arms')}"
        table = self.read.table(content, place)
        self.read.known(table, ("path", "elements"), place)
        path = self.read.words(table.get("path"), "path", place)
        described = self.read.table(table.get("elements", {}), place, "elements = ")
        elements = tuple(self.elements(described, path, f"{place}.elements"))
        last = next(element for element in elements if element.name == path[-1])
        if not isinstance(last, Analyser):
            raise self.read.fault(place, f"its path must end with an analyser, not with {path[-1]!r}")
        if len(last.cameras) not in (1, 2):
            raise self.read.fault(place, "its analyser needs the names of two cameras, or of one")
        return name, elements, path

    def elements(self, table: Table, path: tuple[str, ...], place: str) -> Iterator[Element]:
        for name in path:
            if name not in table:
                what = f"path names {name!r}, which is not described; {nearest(name, table)}"
                raise self.read.fault(place, what)
        for name, content in table.items():
            location = f"{place}.{self.read.name(name, place)}"
            if name not in path:
                raise self.read.fault(location, "is described but missing from the path")
            yield self.element(name, self.read.table(content, location), location)

    def element(self, name: str, table: Table, place: str) -> Element:
        if "kind" not in table:
            raise self.read.fault(place, "has no kind")
        kind = self.kinds.get(self.read.text(table["kind"], "kind", place))
        if kind is None:
            what = f"there is no kind of element {table['kind']!r}; {nearest(table['kind'], self.kinds)} "
            what += f"Kinds are {', '.join(self.kinds)}; walop-jax docs adding-an-instrument describes each. "
            what += f"{self.origin(table['kind'])}, in Python elements=[CLASS] or a FILE.py"
            raise self.read.fault(place, what)
        moves, layers = table.get("moves"), table.get("layers", [])
        values = {k: v for k, v in table.items() if k not in ("kind", "moves", "layers")}
        fields, declared = self.fields(kind, values, place)
        if kind is WavePlate:
            fields["layers"] = tuple(self.layers(layers, place))
        elif layers:
            raise self.read.fault(place, f"an element of kind {kind.kind!r} has no layers")
        if moves is not None:
            moves = self.read.text(moves, "moves", place)
        element = self.made(kind, place, name=name, moves=moves, declared=declared, **fields)
        self.check_moves(element, place)
        self.check_edge(element, place)
        return element

    def made(self, kind: type[Any], place: str, **fields: Any) -> Any:
        """A component; its complaints about numbers become errors of the file."""
        try:
            return kind(**fields)
        except ValueError as error:
            raise self.read.fault(place, str(error)) from None

    def check_moves(self, element: Element, place: str) -> None:
        moves, what = element.moves, f"an element of kind {element.kind!r}"
        if isinstance(element, Polariser):
            if moves not in (None, POLARISER):
                raise self.read.fault(place, f"moves = {moves!r}: the columns of a polariser are {POLARISER}")
        elif moves is None:
            return
        elif not PREFIX.fullmatch(moves):
            what = f"moves = {moves!r} cannot begin the names of columns: capital letters, digits and _, a letter first"
            raise self.read.fault(place, what)
        elif isinstance(element, Analyser):
            raise self.read.fault(place, "an analyser does not move")
        elif not hasattr(element, "axis"):
            raise self.read.fault(place, f"moves, but {what} has no axis that could turn")
        elif type(element).ray is not Element.ray:
            raise self.read.fault(place, f"{what} changes the ray and cannot move")

    def check_edge(self, element: Element, place: str) -> None:
        """Raise `DataError` for numbers that, within their errors, allow no light at the edge of the field."""
        mapping = isinstance(element, PupilMapping)  # r (1 + κ r²) must grow with r, and stay ahead of 90 deg
        r, share, limit = self.farthest, 0.0, 1.0 / 3.0 if mapping else 1.0
        for key, parameter in element.declarations().items():
            if power := PER_FIELD.fullmatch(parameter.unit):
                grown = r ** int(power[1])
                share = (
                    float(np.max(np.abs(getattr(element, key)))) + SURE * (parameter.width or 0.0)
                ) * grown
                if share >= limit:
                    what = f"{key} may be {share:.3g} at the edge of the field ({r:.3g} deg from its centre), where "
                    what += f"less than {limit:.2g} is possible: |value| + {SURE:g} sigma below {limit / grown:.2g} "
                    raise self.read.fault(place, f"{what}{parameter.unit}, or a smaller field")
        if mapping and (turn := r * abs(float(element.magnification)) * (1.0 + share)) >= 90.0:
            what = f"magnification = {float(element.magnification):g} turns rays from the edge of the field "
            what += f"({r:.3g} deg from its centre) by {turn:.0f} deg, 90 at most: correct it, or give a smaller field"
            raise self.read.fault(place, what)

    def layers(self, tables: Any, place: str) -> Iterator[Layer]:
        if not is_named(tables):
            raise self.read.fault(place, "layers must be a list of tables with a name each")
        if not tables:
            raise self.read.fault(place, "a wave plate needs layers")
        self.read.words([table["name"] for table in tables], "layers", place)
        for table in tables:
            name = self.read.name(table["name"], f"{place}.layers")
            location = f"{place}.layers.{name}"
            fields, declared = self.fields(Layer, {k: v for k, v in table.items() if k != "name"}, location)
            if not fields.get("thickness", 0.0) > 0.0:
                raise self.read.fault(location, "needs a thickness (um) above 0; leave a layer of none out")
            yield self.made(Layer, location, name=name, declared=declared, **fields)

    def fields(self, kind: type[Component], table: Table, place: str) -> tuple[dict[str, Any], Declared]:
        """Fields of a component from its table in a file, and the parameters among them."""
        numbers = numbers_of(kind)
        plain = {
            f.name: f.default
            for f in dataclasses.fields(kind)
            if f.metadata.get("static", False) and f.name not in OWN
        }
        values: dict[str, Any] = {}
        declared: dict[str, Parameter] = {}
        for key, value in table.items():
            if key in plain:
                values[key] = self.choice(value, plain[key], key, place)
                if (key == "at" or key.endswith("_at")) and values[key] != plain[key]:
                    self.check_wavelengths(values[key], key, place)
            elif key in numbers:
                values[key], parameter = self.number(value, numbers[key], is_row(kind, key), key, place)
                if parameter is not None:
                    declared[key] = parameter
                if key == "wavelength":
                    self.check_wavelengths(values[key], key, place)
                if key in SHARES and np.max(np.abs(values[key])) > 1.0:
                    what = f"{key} = {values[key]:g} must be between 0 and 1 (a fraction, not per cent)"
                    raise self.read.fault(place, what)
            else:
                raise self.read.fault(place, str(unknown_name("key", key, [*numbers, *plain])))
        # In the order of the class, as the tree is flattened.
        return values, tuple((key, declared[key]) for key in numbers if key in declared)

    def number(
        self, entry: Any, declaration: Parameter, row: bool, key: str, place: str
    ) -> tuple[float | tuple[float, ...], Parameter | None]:
        """The value of a number, or of a row of them; the parameter for a table with more than a value."""
        several = self.read.numbers if row else self.read.number
        if not isinstance(entry, Mapping):
            value = several(entry, key, place)
            self.check_angle(value, declaration.unit, key, place)
            return value, None
        location = f"{place}.{key}"
        self.read.known(entry, NUMBER_KEYS, location)
        if "value" not in entry:
            raise self.read.fault(location, "has no value")
        if entry.get("unit", declaration.unit) != declaration.unit:
            what = f"{key} is in {declaration.unit!r}, not in {entry['unit']!r}; "
            raise self.read.fault(place, what + _converted(entry, declaration.unit))
        advice = "; leave it out where there is none"
        widths = {
            k: self.read.positive(entry[k], k, location, advice)
            for k in ("sigma", "scale", "loose")
            if k in entry
        }
        texts = {k: self.read.text(entry[k], k, location) for k in ("source", "name", "tie") if k in entry}
        declared = dataclasses.replace(
            declaration,
            name=texts.get("name", ""),
            source=texts.get("source", self.source),
            prior=(0.0, widths["sigma"]) if "sigma" in widths else None,
            scale=widths.get("scale", 0.0),
            loose=widths.get("loose"),
            tie=texts.get("tie"),
        )
        value = several(entry["value"], "value", location)
        if "unit" not in entry:
            self.check_angle(value, declaration.unit, key, place)
        return value, declared

    def check_angle(self, value: float | tuple[float, ...], unit: str, key: str, place: str) -> None:
        """Raise `DataError` for an angle (rad) without a unit, apparently in degrees."""
        largest = float(np.max(np.abs(value)))
        if unit == "rad" and largest > LARGEST_ANGLE:
            what = f"{key} = {largest:g} rad is {largest / (2.0 * np.pi):.1f} waves; in degrees? write "
            what += f'{np.deg2rad(largest):g}, or set unit = "rad"'
            raise self.read.fault(place, what)

    def check_wavelengths(self, value: float | tuple[float, ...], key: str, place: str) -> None:
        """Raise `DataError` for wavelengths (µm) beyond those of cameras."""
        low, high = WAVELENGTHS
        for wavelength in np.atleast_1d(value).tolist():
            if not low <= wavelength <= high:
                unit, size = ("nm", 1e-3) if wavelength < NANOMETRES else ("Angstrom", 1e-4)
                advice = (
                    f"; in {unit}? write {wavelength * size:g}" if low <= wavelength * size <= high else ""
                )
                what = f"{key} = {wavelength:g} um is not light of a camera ({low:g} to {high:g} um){advice}"
                raise self.read.fault(place, what)

    def choice(self, value: Any, default: Any, key: str, place: str) -> Any:
        """A choice (no parameter), of the type of its default."""
        if isinstance(value, Mapping):
            raise self.read.fault(place, f"{key} cannot be a parameter")
        if isinstance(default, bool):
            return self.read.flag(value, key, place)
        if isinstance(default, int | float):
            return type(default)(self.read.number(value, key, place))
        if isinstance(default, str):
            if not isinstance(value, str):
                raise self.read.fault(place, f"{key} = {value!r} must be a name")
            return self.read.text(value, key, place)
        if not isinstance(value, list):
            raise self.read.fault(place, f"{key} = {value!r} must be a list")
        texts = bool(value) and isinstance(value[0], str)
        return self.read.words(value, key, place) if texts else self.read.numbers(value, key, place)


def _converted(given: Table, unit: str) -> str:
    """Advice on numbers in another unit: the converted ones where the conversion exists."""
    from walop_jax.data.units import Place, convert_unit

    try:
        written = {
            key: convert_unit(np.asarray(given[key], float), str(given["unit"]), unit, key, Place("", ""))
            for key in ("value", "sigma")
            if key in given
        }
    except (TypeError, ValueError):
        return "convert it"
    return "write " + ", ".join(f"{key} = {np.round(value, 9).tolist()}" for key, value in written.items())
