"""The instrument: sources, the train of elements, its arms, the cameras, and the effects that were added to it.

Nothing here computes light: `light.py` folds it. An effect is a patch: `patched` is the instrument with what the
effects change, and everything that asks for light asks the patched one.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from walop_jax.instruments.description import (
    NO_SOURCE,
    Description,
    Reader,
    default_name,
    described,
    read_description,
    shipped,
)
from walop_jax.io.errors import nearest
from walop_jax.model import fold, legendre
from walop_jax.model.build import parts, with_origins
from walop_jax.model.cameras import Cameras, Throughput
from walop_jax.model.compiled import array, need_float64
from walop_jax.model.conventions import REFERENCE_WAVELENGTH, Units
from walop_jax.model.elements import Analyser, Element, Polariser, WavePlate
from walop_jax.model.elements.wave_plate import MODELS
from walop_jax.model.parameters import Component, check_names, leaves, number, unknown_name
from walop_jax.model.ray import Conditions, NotPlannedError, Ray
from walop_jax.model.sources import SOURCES, Source, Standards

Scalar = Float[Array, ""]
AnyPart = TypeVar("AnyPart", bound=Component)
PLATE_MODELS = tuple(MODELS)
STAR = tuple[str, float, float]
TAKEN = ("throughput", "cameras", "effects")
"""Names of other parts of an instrument."""

NAN = float("nan")
NO_SITE = ("", NAN, NAN, NAN, NAN)


class NoSuchPlaceError(ValueError):
    """An effect asks for an element that this instrument does not have."""


class Arm(Component):
    """Light path of one part of the pupil; `path` names its elements in the order light meets them."""

    name: str = eqx.field(static=True)
    elements: tuple[Element, ...]
    path: tuple[str, ...] = eqx.field(static=True)

    def train(self) -> Iterator[Element]:
        """Its elements ahead of the analyser, in the order light meets them."""
        for name in self.path[:-1]:
            yield _member(self.elements, name, f"element of arm {self.name}")

    @property
    def analyser(self) -> Analyser:
        """The element that ends it."""
        last = _member(self.elements, self.path[-1], f"element of arm {self.name}")
        if not isinstance(last, Analyser):
            raise ValueError(f"arm {self.name}: its path must end with an analyser, not with {last.name!r}")
        return last


class Instrument(Component):
    """Everything that is fitted. `path` names the elements ahead of the arms in the order light meets them.

    `rotator_zero` (deg) is added to ROTATOR, `filter_shift` (µm) displaces broad bands; None: there is none. Field
    coordinates reach to ±`field_limit` (deg); `site` is telescope, latitude and longitude (deg, east positive),
    elevation (m) and MJD of a full Moon, `raster` how the points of a simulated run lie, and how far out (deg).
    `description` is the text it was described in, empty for an instrument that comes with the package, `source` where
    its numbers are from; colours and fringes are counted from `wavelength` (µm).

    >>> walop.Instrument.read("WALOP-NORTH").cameras.names
    ('O1', 'E1', 'O2', 'E2')
    """

    name: str = eqx.field(static=True)
    sources: tuple[Source, ...]
    elements: tuple[Element, ...]
    arms: tuple[Arm, ...]
    throughput: Throughput
    cameras: Cameras
    path: tuple[str, ...] = eqx.field(static=True)
    effects: tuple[Any, ...] = ()  # patches: `effects.base.Effect`
    rotator_zero: Scalar | None = number(unit="deg", about="true ROTATOR minus the header's", default=None)
    filter_shift: Scalar | None = number(unit="um", about="displacement of broad bands", default=None)
    sky_films: tuple[Any, ...] = ()  # what light from the sky meets in single exposures (`optics.SkyFilm`)
    field_limit: float = eqx.field(static=True, default=90.0)
    site: tuple[str, float, float, float, float] = eqx.field(static=True, default=NO_SITE)
    raster: tuple[str, float] = eqx.field(static=True, default=("square", 0.0))
    description: str = eqx.field(static=True, default="", repr=False)
    source: str = eqx.field(static=True, default="", repr=False)
    wavelength: float = eqx.field(static=True, default=REFERENCE_WAVELENGTH)

    def __repr__(self) -> str:
        arms = "; ".join(f"{arm.name}: {' > '.join(arm.path)}" for arm in self.arms)
        effects = f"; effects: {', '.join(effect.name for effect in self.effects)}" if self.effects else ""
        return (
            f"Instrument {self.name}, cameras {', '.join(self.cameras.names)}\n"
            f"  light path  {' > '.join(self.path)}\n  arms        {arms}{effects}"
        )

    @classmethod
    def read(cls, source: str | os.PathLike[str], **options: Any) -> Instrument:
        """The instrument of a description file, or a shipped one by name; options as for `build`.

        Raises `DataError`, naming file, table and key, for a file that is wrong.
        """
        return build(read_description(source), **options)

    # ------------------------------------------------------------------------------- asking for parts

    def train(self) -> Iterator[Element]:
        """The elements ahead of the arms, in the order light meets them."""
        for name in self.path:
            yield _member(self.elements, name, "element")

    @property
    def polariser(self) -> Polariser | None:
        """The calibration polariser, if the train has one."""
        return next((element for element in self.train() if isinstance(element, Polariser)), None)

    def telescope(self) -> tuple[Element, ...]:
        """The elements ahead of the polariser, which only light from the sky meets; none where there is no polariser.

        Raises ValueError for one that moves, bends the ray or depends on the wavelength: that is not computed there.
        """
        if self.polariser is None:
            return ()
        elements = tuple(itertools.takewhile(lambda e: not isinstance(e, Polariser), self.train()))
        for element in elements:
            if element.moves or type(element).ray is not Element.ray or not _is_achromatic(element):
                raise ValueError(
                    f"element {element.name!r} stands ahead of the polariser, where nothing may move, bend the ray "
                    "or depend on wavelength or exposure; put it behind the polariser"
                )
        return elements

    def behind_polariser(self) -> tuple[Element, ...]:
        """The elements behind the polariser, all where there is none."""
        return tuple(self.train())[len(self.telescope()) + (self.polariser is not None) :]

    @property
    def standard(self) -> Standards:
        """The standard stars."""
        found = _member(self.sources, Standards.name, "source")
        assert isinstance(found, Standards)
        return found

    @property
    def kinds(self) -> tuple[str, ...]:
        """KINDs of exposures that it can look at."""
        return tuple(source.kind for source in self.sources)

    def element(self, place: str) -> Element:
        """An element by its place, as for `changed`. Raises `NoSuchPlaceError` where there is none."""
        arm, _, name = place.rpartition(".")
        holder = _member(self.arms, arm, "arm") if arm else self
        return _member(holder.elements, name, "element")

    def places(self, kind: type[Element]) -> tuple[str, ...]:
        """Places, as for `changed`, of all elements of a class; arms first, then the common train."""
        arms = [
            f"{arm.name}.{element.name}"
            for arm in self.arms
            for element in arm.elements
            if isinstance(element, kind)
        ]
        return (*arms, *(element.name for element in self.elements if isinstance(element, kind)))

    def moving(self) -> tuple[str, ...]:
        """Prefixes of the columns of the moving elements behind the polariser, common train first."""
        parts = [*self.train(), *(element for arm in self.arms for element in arm.train())]
        found = [element.moves for element in parts if element.moves and not isinstance(element, Polariser)]
        return tuple(dict.fromkeys(found))

    @property
    def units(self) -> Units:
        """Scales that changes over its field and its bands are counted in."""
        return Units(self.throughput.scale, self.wavelength)

    @property
    def plates(self) -> str | None:
        """Model of its wave plates (`wave_plate.MODELS`); None where it has none."""
        elements = (*self.elements, *(element for arm in self.arms for element in arm.elements))
        return next((element.model for element in elements if isinstance(element, WavePlate)), None)

    def effect(self, name: str) -> Any:
        """The active effect of a name; ValueError when there is none."""
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise unknown_name("active effect", name, [effect.name for effect in self.effects])

    def mueller(
        self,
        x: ArrayLike,
        y: ArrayLike,
        wavelength: ArrayLike,
        angles: Mapping[str, float] | None = None,
        **conditions: Any,
    ) -> Float[Array, "k *w 4 4"]:
        """Mueller matrices of the light path of every camera, behind the polariser and ahead of its analyser.

        Differentiable in field position (deg), wavelength (µm) and the numbers of the instrument. `angles` (deg) are
        those of moving elements in the beam, by the prefix of their columns ({"CHWP": 45.0}); the others are out.
        `conditions` are those of `ray.CONDITIONS` that the optics depend on (temperature in Celsius, hour_angle in h).
        Raises ValueError for a moving element that the instrument does not have, and `NotPlannedError` for a condition
        that is missing, RuntimeError when float64 is switched off.
        """
        need_float64("the Mueller matrix")
        instrument, angles = self.patched(), dict(angles or {})
        moving = instrument.moving()
        check_names("moving element", angles, moving)
        nodes = jnp.atleast_1d(jnp.asarray(wavelength, float))
        planned = {name: jnp.full_like(nodes, value) for name, value in conditions.items()}
        ray = Ray.entering(
            jnp.asarray(x, float), jnp.asarray(y, float), (nodes, Conditions(jnp.zeros_like(nodes), planned))
        )
        common, ray = fold.stations(instrument.behind_polariser(), ray)
        arms = [fold.stations(tuple(arm.train()), ray)[0] for arm in instrument.arms]
        state = tuple(angles.get(prefix) for prefix in moving)
        ahead, *inside = fold.in_state(common, arms, moving, state)
        of_arm = []
        for behind in inside:
            whole = fold.product((*ahead, *behind))
            whole = jnp.eye(4) if whole is None else whole
            of_arm.append(jnp.broadcast_to(whole, (len(nodes), 4, 4)).reshape(*jnp.shape(wavelength), 4, 4))
        place = {camera: i for i, arm in enumerate(instrument.arms) for camera in arm.analyser.cameras}
        return jnp.stack([of_arm[place[camera]] for camera in instrument.cameras.names])

    # ------------------------------------------------------------------------------- changing it

    def patched(self) -> Instrument:
        """The instrument with what its effects change, and no effects any more."""
        bare = dataclasses.replace(self, effects=())
        return functools.reduce(lambda instrument, effect: effect.patch(instrument), self.effects, bare)

    def changed(self, place: str, **fields: Any) -> Instrument:
        """The instrument with fields of one part replaced.

        `place` is a name with dots: an element, an arm's element ("half1.plate"), a layer of it
        ("half1.plate.mgf2"), a source, or "" for the instrument itself. A function is applied to what was there.
        Raises `NoSuchPlaceError` where the instrument has no such part.
        """
        return _changed(self, place.split(".") if place else [], fields, place)

    def inserted(self, element: Element, *, before: str = "", after: str = "") -> Instrument:
        """The instrument with one more element directly before or after another one ("half1.plate" in an arm).

        A name that is taken gets a number. Raises `NoSuchPlaceError` where there is no such element.
        """
        where, _, neighbour = (before or after).rpartition(".")
        if where:
            arm = next((arm for arm in self.arms if arm.name == where), None)
            if arm is None:
                raise NoSuchPlaceError(f"the instrument has no arm {where!r}")
            holder = _inserted(arm, element, neighbour, bool(after))
            arms = tuple(holder if one.name == where else one for one in self.arms)
            return dataclasses.replace(self, arms=arms)
        return _inserted(self, element, neighbour, bool(after))

    def with_part(self, slot: str, part: Component) -> Instrument:
        """The instrument with one more part of its cameras.

        `slot` is "transmission", "mixing", "ghosts", "exposures" or "detectors".
        """
        cameras = dataclasses.replace(self.cameras, **{slot: (*getattr(self.cameras, slot), part)})
        return dataclasses.replace(self, cameras=cameras)

    def with_source(self, source: Source) -> Instrument:
        """The instrument with a source of one more KIND, or with one of its sources replaced."""
        others = tuple(one for one in self.sources if one.name != source.name)
        if len(others) == len(self.sources):
            return dataclasses.replace(self, sources=(*self.sources, source))
        return dataclasses.replace(
            self, sources=tuple(source if one.name == source.name else one for one in self.sources)
        )


def _member(members: tuple[AnyPart, ...], name: str, what: str) -> AnyPart:
    for member in members:
        if _name(member) == name:
            return member
    raise NoSuchPlaceError(str(unknown_name(what, name, [_name(member) for member in members])))


def _is_achromatic(element: Element) -> bool:
    zero = jnp.zeros(())
    try:
        jax.eval_shape(lambda e: e.mueller(Ray.entering(zero, zero)), element)
    except NotPlannedError:
        return False
    return True


def _name(member: Any) -> str:
    return member.name


def _changed(part: AnyPart, rest: list[str], fields: dict[str, Any], place: str) -> AnyPart:
    if not rest:
        known = [field.name for field in dataclasses.fields(part)]
        check_names(f"field of {place or 'the instrument'}", fields, known)
        new = {
            name: value(getattr(part, name)) if callable(value) else value for name, value in fields.items()
        }
        return dataclasses.replace(part, **new)
    known = []
    for field in dataclasses.fields(part):
        members = getattr(part, field.name)
        if field.metadata.get("static", False) or not isinstance(members, tuple):
            continue
        known += [_name(member) for member in members if isinstance(member, Element | Arm)]
        for i, member in enumerate(members):
            if isinstance(member, Component) and _name(member) == rest[0]:
                new = (*members[:i], _changed(member, rest[1:], fields, place), *members[i + 1 :])
                return dataclasses.replace(part, **{field.name: new})
    raise NoSuchPlaceError(f"the instrument has no part {place!r}; {nearest(rest[0], known)}")


def _inserted(holder: Any, element: Element, neighbour: str, after: bool) -> Any:
    if neighbour not in holder.path:
        raise NoSuchPlaceError(str(unknown_name("element", neighbour, holder.path)))
    name, number_ = element.name or element.kind, 1
    while name in holder.path:
        number_ += 1
        name = f"{element.name or element.kind}_{number_}"
    at = holder.path.index(neighbour) + (1 if after else 0)
    path = (*holder.path[:at], name, *holder.path[at:])
    return dataclasses.replace(
        holder, elements=(*holder.elements, dataclasses.replace(element, name=name)), path=path
    )


# ------------------------------------------------------------------------------------ from a description


def build(description: Description, *, elements: Sequence[type[Element]] = (), **options: Any) -> Instrument:
    """The instrument that a description describes, at the values that it gives; options as for `adapted`.

    `elements` are further kinds of elements that the description may name. Raises `DataError`, naming table and key,
    for what does not exist or would do nothing where it stands.
    """
    common, arms, throughput, cameras = parts(description, elements)
    every = (*common, *(element for _, inside, _ in arms for element in inside))
    instrument = Instrument(
        name=description.name,
        sources=sources(),
        elements=common,
        arms=tuple(Arm(*arm) for arm in arms),
        throughput=throughput,
        cameras=cameras,
        path=description.path,
        field_limit=description.field_limit,
        site=description.place,
        raster=(description.raster, description.edge),
        description="" if description.name in shipped() else with_origins(description.text, every),
        wavelength=description.wavelength or REFERENCE_WAVELENGTH,
        source=description.source if description.source != NO_SOURCE else "",
    )
    _check(instrument, description.read)
    return adapted(instrument, **options)


def adapted(
    instrument: Instrument,
    *,
    standards: Standards | Sequence[STAR] = (),
    plates: str | None = None,
    throughput_degree: int | None = None,
    throughput: float | None = None,
) -> Instrument:
    """An instrument for the data at hand.

    `standards` are (name, q, u) in the equatorial frame, or the source itself; `plates` is the model of the wave
    plates, `throughput_degree` that of the series, `throughput` the level of all cameras; None leaves what the
    instrument says. Raises ValueError for an unknown plate model.
    """
    instrument = instrument.with_source(_standards(standards))
    if plates is not None:
        if plates not in PLATE_MODELS:
            raise ValueError(f"there is no plate model {plates!r}: choose one of {', '.join(PLATE_MODELS)}")
        for place in instrument.places(WavePlate):
            instrument = instrument.changed(place, model=plates)
    series = instrument.throughput
    degree = series.degree if throughput_degree is None else throughput_degree
    level = np.asarray(series.coefficients)[:, 0] if throughput is None else throughput
    coefficients = np.zeros((len(instrument.cameras), len(legendre.terms(degree))))
    coefficients[:, 0] = level
    return dataclasses.replace(
        instrument,
        throughput=dataclasses.replace(series, degree=degree, coefficients=array(coefficients)),
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


def _standards(stars: Standards | Sequence[STAR]) -> Standards:
    if isinstance(stars, Standards):
        return stars
    names, q, u = zip(*stars, strict=True) if stars else ((), (), ())
    return Standards(names=tuple(names), q=array(np.array(q, float)), u=array(np.array(u, float)))


def _check(instrument: Instrument, read: Reader) -> None:
    """Raise `DataError` for a part that would do nothing where it stands, and for a name that is there twice."""
    for element in instrument.elements:
        if isinstance(element, Analyser):
            raise read.fault(
                f"elements.{element.name}", "an analyser ends an arm: move it to the path of one"
            )
    polarisers = [element.name for element in instrument.train() if isinstance(element, Polariser)]
    if len(polarisers) > 1:
        raise read.fault(f"elements.{polarisers[1]}", "is a second polariser; only one is allowed")
    for arm in instrument.arms:
        for element in arm.train():
            if isinstance(element, Analyser | Polariser):
                where = "ends its arm" if isinstance(element, Analyser) else "stands ahead of the arms"
                raise read.fault(f"arms.{arm.name}.elements.{element.name}", f"a {element.kind} {where}")
    parts = itertools.chain(instrument.sources, instrument.elements, instrument.arms)
    for name, count in Counter([*(part.name for part in parts), *TAKEN]).items():
        if count > 1:
            raise read.fault(name, "more than one part of the instrument has this name; give it another one")
    for name, count in Counter(parameter.name for parameter in leaves(instrument)).items():
        if count > 1:
            raise read.fault("", f"{count} parameters have the name {name!r}; give them different ones")
    try:
        instrument.telescope()
    except ValueError as error:
        raise read.fault("elements", str(error)) from None
