"""From the description of an instrument to the instrument: every element that a file names is made here."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from walop_jax.data.records import POLARISER, PREFIX
from walop_jax.instruments.description import (
    ArmText,
    Description,
    ElementText,
    Given,
    default_name,
    described,
    shipped,
)
from walop_jax.io.errors import DataError, nearest
from walop_jax.model import legendre, materials
from walop_jax.model.cameras import Cameras, Throughput
from walop_jax.model.elements import ELEMENTS, Analyser, Element, Layer, Polariser, WavePlate, Wedge
from walop_jax.model.elements.geometry import FRAMES
from walop_jax.model.elements.wave_plate import MODELS
from walop_jax.model.instrument import Arm, Instrument
from walop_jax.model.parameters import Component, Declaration, numbers_of, unknown_name
from walop_jax.model.sources import SOURCES, Source, Standards
from walop_jax.model.well_formed import check

PLATE_MODELS = tuple(MODELS)
STAR = tuple[str, float, float]
OWN = ("name", "moves", "declared", "model")  # what a file says otherwise, or not at all
SERIES = "Legendre coefficient P_i(x/h) P_j(y/h)"
FREE = "smooth vignetting and coatings: free"


def build(description: Description, *, elements: Sequence[type[Element]] = (), **options: Any) -> Instrument:
    """The instrument that a description describes, at the values that it gives; options as for `adapted`.

    `elements` are further kinds of elements that the description may name. Raises `DataError` for a kind of
    element, or a number of one, that does not exist.
    """
    make = _Maker(description, {kind.kind: kind for kind in (*ELEMENTS, *elements)})
    arms = tuple(make.arm(arm) for arm in description.arms)
    given = description.throughput
    series = Declaration(unit="", about=SERIES, source=FREE, scale=given.scale, loose=given.loose)
    coefficients = np.zeros((len(description.cameras), len(legendre.terms(description.throughput_degree))))
    coefficients[:, 0] = given.value
    instrument = Instrument(
        name=description.name,
        sources=sources(),
        elements=tuple(make.element(text) for text in description.elements),
        arms=arms,
        throughput=Throughput(
            degree=description.throughput_degree,
            coefficients=jnp.asarray(coefficients),
            scale=description.field_scale,
            declared=series,
        ),
        cameras=_cameras(description, arms),
        path=description.path,
        field_limit=description.field_limit,
        site=description.place,
        raster=(description.raster, description.edge),
        description="" if description.name in shipped() else description.text,
    )
    check(instrument)
    return adapted(instrument, **options)


def adapted(
    instrument: Instrument,
    *,
    standards: Sequence[STAR] = (),
    plates: str | None = None,
    throughput_degree: int | None = None,
    throughput: float | None = None,
) -> Instrument:
    """An instrument for the data at hand.

    `standards` are (name, q, u) in the equatorial frame; `plates` is the model of the wave plates,
    `throughput_degree` that of the series, `throughput` the level of all cameras; None leaves what the instrument
    says. Raises ValueError for an unknown plate model.
    """
    instrument = instrument.with_source(_standards(standards))
    if plates is not None:
        if plates not in PLATE_MODELS:
            raise ValueError(f"unknown plate model {plates!r}: choose one of {', '.join(PLATE_MODELS)}")
        for place in instrument.places(WavePlate):
            instrument = instrument.changed(place, model=plates)
    series = instrument.throughput
    degree = series.degree if throughput_degree is None else throughput_degree
    level = np.asarray(series.coefficients)[:, 0] if throughput is None else throughput
    coefficients = np.zeros((len(instrument.cameras), len(legendre.terms(degree))))
    coefficients[:, 0] = level
    return dataclasses.replace(
        instrument,
        throughput=dataclasses.replace(series, degree=degree, coefficients=jnp.asarray(coefficients)),
    )


def as_designed(instrument: Instrument) -> Instrument:
    """The instrument without effects: they are added by name."""
    return dataclasses.replace(instrument, effects=())


def nominal_instrument(name: str | None = None, **options: Any) -> Instrument:
    """A shipped instrument as designed (default: the first of the family); options as for `build`."""
    return build(described(name or default_name()), **options)


def sources() -> tuple[Source, ...]:
    """The sources that every instrument can look at."""
    return tuple(_standards(()) if kind is Standards else kind() for kind in SOURCES)


def _standards(stars: Sequence[STAR]) -> Standards:
    names, q, u = zip(*stars, strict=True) if stars else ((), (), ())
    return Standards(names=tuple(names), q=jnp.asarray(np.array(q, float)), u=jnp.asarray(np.array(u, float)))


def _cameras(description: Description, arms: Sequence[Arm]) -> Cameras:
    names = description.cameras
    pairs = []
    for arm in arms:
        beams = arm.analyser.cameras
        for name in beams:
            if name not in names:
                raise DataError(f"[arms.{arm.name}] camera {name!r} does not exist; {nearest(name, names)}")
        pairs.append((names.index(beams[0]), names.index(beams[1])))
    seen = [camera for pair in pairs for camera in pair]
    if sorted(seen) != list(range(len(names))):
        raise DataError(f"[cameras] every camera must stand behind one analyser: {', '.join(names)}")
    return Cameras(names=names, pairs=tuple(pairs), split=description.split, floor=description.floor)


@dataclasses.dataclass(frozen=True)
class _Maker:
    description: Description
    kinds: Mapping[str, type[Element]]

    def arm(self, text: ArmText) -> Arm:
        place = f"arms.{text.name}"
        elements = tuple(self.element(entry, f"{place}.elements.") for entry in text.elements)
        arm = Arm(name=text.name, elements=elements, path=text.path)
        if not isinstance(elements[[e.name for e in elements].index(text.path[-1])], Analyser):
            raise DataError(f"[{place}] its path must end with an analyser, not with {text.path[-1]!r}")
        if len(arm.analyser.cameras) != 2:
            raise DataError(f"[arms.{text.name}] its analyser needs the names of two cameras")
        return arm

    def element(self, text: ElementText, prefix: str = "elements.") -> Element:
        place = f"{prefix}{text.name}"
        if text.kind not in self.kinds:
            raise DataError(
                f"[{place}] unknown kind of element {text.kind!r}; {nearest(text.kind, self.kinds)}"
            )
        kind = self.kinds[text.kind]
        fields, declared = self.numbers(kind, text.values, place)
        if kind is WavePlate:
            if not text.layers:
                raise DataError(f"[{place}] a wave plate needs layers")
            fields |= {"layers": tuple(self.layer(layer, place) for layer in text.layers)}
        elif text.layers:
            raise DataError(f"[{place}] an element of kind {text.kind!r} has no layers")
        if kind is Wedge and fields.get("material", Wedge.material) not in materials.GLASSES:
            glass = str(fields["material"])
            raise DataError(f"[{place}] unknown glass {glass!r}; {nearest(glass, materials.GLASSES)}")
        if kind is Wedge and fields.get("frame", FRAMES[0]) not in FRAMES:
            raise DataError(f"[{place}] frame = {fields['frame']!r} of a wedge must be {' or '.join(FRAMES)}")
        try:
            made = kind(name=text.name, moves=text.moves, declared=declared, **fields)
        except ValueError as error:
            raise DataError(f"[{place}] {error}") from None
        self.check_moves(made, place)
        return made

    def check_moves(self, made: Element, place: str) -> None:
        moves, what = made.moves, f"an element of kind {made.kind!r}"
        if isinstance(made, Polariser):
            if moves not in (None, POLARISER):
                raise DataError(f"[{place}] moves = {moves!r}: the columns of a polariser are {POLARISER}")
        elif moves is None:
            return
        elif not PREFIX.fullmatch(moves):
            raise DataError(
                f"[{place}] moves = {moves!r} cannot begin the names of columns: capital letters, digits and _, a "
                "letter first"
            )
        elif isinstance(made, Analyser):
            raise DataError(f"[{place}] an analyser does not move")
        elif not hasattr(made, "axis"):
            raise DataError(f"[{place}] moves, but {what} has no axis that could turn")
        elif type(made).ray is not Element.ray:
            raise DataError(f"[{place}] {what} changes the ray and cannot move")

    def layer(self, values: Mapping[str, Any], place: str) -> Layer:
        name = values["name"]
        rest = {key: value for key, value in values.items() if key != "name"}
        place = f"{place}.layers.{name}"
        fields, declared = self.numbers(Layer, rest, place)
        if not fields.get("thickness", 0.0) >= 0.0 or "thickness" not in fields:
            raise DataError(f"[{place}] needs a thickness (um) that is not below 0")
        material = fields.get("material", "")
        if material not in materials.CRYSTALS:
            raise DataError(
                f"[{place}] unknown crystal {material!r}; {nearest(str(material), materials.CRYSTALS)}"
            )
        return Layer(name=name, declared=declared, **fields)

    def numbers(
        self, kind: type[Component], values: Mapping[str, Any], place: str
    ) -> tuple[dict[str, Any], tuple[tuple[str, Declaration], ...]]:
        """Fields of a component from what a file says of it, and which of them are parameters."""
        known = numbers_of(kind)
        static = {f.name: f.default for f in dataclasses.fields(kind) if f.metadata.get("static", False)}
        plain = {name: default for name, default in static.items() if name not in OWN}
        fields: dict[str, Any] = {}
        declared: list[tuple[str, Declaration]] = []
        for key, value in values.items():
            if key not in known and key not in plain:
                raise DataError(f"[{place}] {unknown_name('key', key, [*known, *plain])}")
            if key in plain:
                fields[key] = self.fixed(value, plain[key], f"[{place}] {key}")
                continue
            if not isinstance(value, Given):
                raise DataError(f"[{place}] {key} = {value!r} must be a number")
            if known[key].several is not isinstance(value.value, tuple):
                wanted = "a list of numbers" if known[key].several else "one number"
                raise DataError(f"[{place}] {key} = {value.value!r} must be {wanted}")
            if value.unit is not None and value.unit != known[key].unit:
                raise DataError(
                    f"[{place}] {key} is in {known[key].unit!r}, not in {value.unit!r}; convert it"
                )
            fields[key] = value.value
            if value.parameter:
                declared.append((key, self.declaration(value, known[key].unit, known[key].about)))
        # In the order of the class, as the tree is flattened.
        order = list(known)
        return fields, tuple(sorted(declared, key=lambda entry: order.index(entry[0])))

    def fixed(self, value: Any, default: Any, what: str) -> Any:
        """A choice that is no parameter, of the type of its default."""
        if isinstance(value, Given):
            if value.parameter:
                raise DataError(f"{what} cannot be a parameter")
            value = value.value
        if isinstance(value, bool) is not isinstance(default, bool):
            kind = "true or false" if isinstance(default, bool) else "no truth value"
            raise DataError(f"{what} = {value!r} must be {kind}")
        if isinstance(default, int | float):
            if not isinstance(value, int | float):
                raise DataError(f"{what} = {value!r} must be one number")
            return type(default)(value)
        if isinstance(default, str | tuple) and not isinstance(value, type(default)):
            raise DataError(f"{what} = {value!r} must be a {'name' if isinstance(default, str) else 'list'}")
        return value

    def declaration(self, given: Given, unit: str, about: str) -> Declaration:
        return Declaration(
            unit=unit,
            about=about,
            source=given.source or self.description.source,
            width=given.sigma,
            scale=given.scale,
            loose=given.loose,
            name=given.name,
            tie=given.tie,
        )
