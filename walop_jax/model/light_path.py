"""The light path: sources, the train of elements, its arms, the cameras, and its effects.

Nothing here computes light: `light.py` folds it. An effect is a patch: `patched` is the light path with the
changes of the effects, and all computations of light use it.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator
from typing import Any, Self, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from walop_jax.io.errors import nearest
from walop_jax.model.cameras import Cameras, Throughput
from walop_jax.model.elements.base import Element
from walop_jax.model.elements.simple import Analyser, Polariser
from walop_jax.model.elements.wave_plate import WavePlate
from walop_jax.model.parameters import Component, Scalar, by_shapes, check_names, number, unknown_name
from walop_jax.model.ray import NotPlannedError, Ray
from walop_jax.model.sources import Source, Standards

AnyPart = TypeVar("AnyPart", bound=Component)


class NoSuchPlaceError(ValueError):
    """A change or an effect names an element, camera or source that this instrument does not have."""


class Arm(Component):
    """Light path of one part of the pupil; `path` names its elements in the order in which light meets them.

    The last one is the analyser, behind which the cameras of the arm stand.
    """

    name: str = eqx.field(static=True)
    elements: tuple[Element, ...]
    path: tuple[str, ...] = eqx.field(static=True)

    def train(self) -> Iterator[Element]:
        """The elements of the arm ahead of its analyser, in the order in which light meets them."""
        for name in self.path[:-1]:
            yield _member(self.elements, name, f"element of arm {self.name}")

    @property
    def analyser(self) -> Analyser:
        """The last element of the arm."""
        last = _member(self.elements, self.path[-1], f"element of arm {self.name}")
        if not isinstance(last, Analyser):
            raise ValueError(f"arm {self.name}: its path must end with an analyser, not with {last.name!r}")
        return last


class LightPath(Component):
    """All sources, optics and cameras of a fit; `path` names the elements ahead of the arms in their order.

    `rotator_zero` (deg) is added to ROTATOR; `filter_shift` (µm) displaces broad bands; None stands for no such change.
    `effects` are not applied yet: `patched` returns the light path with their changes.
    """

    name: str = eqx.field(static=True)
    sources: tuple[Source, ...]
    elements: tuple[Element, ...]
    arms: tuple[Arm, ...]
    throughput: Throughput
    cameras: Cameras
    path: tuple[str, ...] = eqx.field(static=True)
    effects: tuple[Any, ...] = ()  # patches: `effects.base.Effect`
    rotator_zero: Scalar | None = number("deg", "true ROTATOR minus the header's", default=None)
    filter_shift: Scalar | None = number("um", "displacement of broad bands", default=None)
    sky_films: tuple[
        Any, ...
    ] = ()  # changes of light from the sky in single exposures (`effects.optics.Film`)

    # ------------------------------------------------------------------------------- parts

    def train(self) -> Iterator[Element]:
        """The elements ahead of the arms, in the order light meets them."""
        for name in self.path:
            yield _member(self.elements, name, "element")

    @property
    def polariser(self) -> Polariser | None:
        """The calibration polariser, if the train has one."""
        return next((element for element in self.train() if isinstance(element, Polariser)), None)

    def telescope(self) -> tuple[Element, ...]:
        """The elements ahead of the polariser, in light from the sky alone; none without a polariser.

        Raises ValueError for one that moves, bends the ray or depends on wavelength or exposure.
        """
        if self.polariser is None:
            return ()
        elements = tuple(itertools.takewhile(lambda e: not isinstance(e, Polariser), self.train()))
        for element in elements:
            if element.moves or type(element).ray is not Element.ray or not is_achromatic(element):
                raise ValueError(
                    f"element {element.name!r} is ahead of the polariser, where nothing may move, bend the ray "
                    "or depend on wavelength or exposure; put it behind the polariser"
                )
        return elements

    @property
    def ahead_of_polariser(self) -> tuple[str, str] | None:
        """The place directly ahead of the polariser, as changes name it, which light from the sky alone passes.

        None without a polariser.
        """
        return None if self.polariser is None else ("ahead of", self.polariser.name)

    def behind_polariser(self) -> tuple[Element, ...]:
        """The elements behind the polariser; all elements without a polariser."""
        return tuple(self.train())[len(self.telescope()) + (self.polariser is not None) :]

    @property
    def standard(self) -> Standards:
        """The source `standard` of the light path: its standard stars."""
        source = _member(self.sources, Standards.name, "source")
        assert isinstance(source, Standards)
        return source

    @property
    def kinds(self) -> tuple[str, ...]:
        """The KINDs of exposures that its sources can shine in."""
        return tuple(source.kind for source in self.sources)

    def element(self, place: str) -> Element:
        """An element by its place, as for `changed`. Raises `NoSuchPlaceError` where there is none."""
        arm, _, name = place.rpartition(".")
        holder = _member(self.arms, arm, "arm") if arm else self
        return _member(holder.elements, name, "element")

    def places(self, kind: type[Element]) -> tuple[str, ...]:
        """Places, as for `changed`, of all elements of a class; arms first, then the common train."""
        return tuple(place for place, element in self.by_place().items() if isinstance(element, kind))

    def by_place(self) -> dict[str, Element]:
        """All elements by their places, as for `changed`; arms first, then the common train."""
        in_arms = {f"{arm.name}.{element.name}": element for arm in self.arms for element in arm.elements}
        return in_arms | {element.name: element for element in self.elements}

    def ahead_of_analysers(self) -> list[Element]:
        """The elements of the common train, then of every arm, in the order light meets them."""
        return [*self.train(), *(element for arm in self.arms for element in arm.train())]

    def moving(self) -> tuple[str, ...]:
        """Prefixes of the columns of the moving elements behind the polariser, common train first."""
        elements = (e for e in self.ahead_of_analysers() if not isinstance(e, Polariser))
        return tuple(dict.fromkeys(element.moves for element in elements if element.moves))

    def reading_in_words(self, prefix: str, reading: float) -> str:
        """A reading of the elements that move as `prefix`, with their unit: 45°, 5 V, or the number alone."""
        words = {e.reading_in_words(reading) for e in self.ahead_of_analysers() if e.moves == prefix}
        return words.pop() if len(words) == 1 else f"{reading:g}"

    def within_period(self, prefix: str, readings: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Readings of the elements that move together as `prefix`, reduced to one period (`Element.period`).

        Readings with which the optics are the same become equal: 10 and 370 for a plate in degrees. Readings come back
        as they are where they do not repeat themselves (a voltage) or the elements do not agree in their periods.
        """
        periods = {element.period for element in self.ahead_of_analysers() if element.moves == prefix}
        period = periods.pop() if len(periods) == 1 else None
        return readings if period is None else np.mod(readings, period)

    @property
    def plates(self) -> str | None:
        """Model of its wave plates (`wave_plate.MODELS`); None where it has none."""
        return next((e.model for e in self.by_place().values() if isinstance(e, WavePlate)), None)

    def effect(self, name: str) -> Any:
        """The active effect of a name; ValueError when there is none."""
        return _member(self.effects, name, "active effect")

    # ------------------------------------------------------------------------------- changing it

    def as_put_together(self) -> Self:
        """The instrument with its structural effects made (a plate left out, say); all others stay effects."""
        structural = tuple(effect for effect in self.effects if effect.kind.is_structural())
        others = tuple(effect for effect in self.effects if not effect.kind.is_structural())
        return dataclasses.replace(dataclasses.replace(self, effects=structural).patched(), effects=others)

    def patched(self) -> Self:
        """The instrument with the changes of its effects made, and without the effects themselves."""
        bare = dataclasses.replace(self, effects=())
        return functools.reduce(lambda instrument, effect: effect.patch(instrument), self.effects, bare)

    def changed(self, place: str, **fields: Any) -> Self:
        """The instrument with fields of one part replaced.

        `place` is a name with dots: an element, an arm's element ("half1.plate"), a layer of it
        ("half1.plate.mgf2"), a source, or "" for the light path itself. A function is applied to the old value.
        Raises `NoSuchPlaceError` where the instrument has no such part.
        """
        return _changed(self, place.split(".") if place else [], fields, place)

    def inserted(self, element: Element, *, before: str = "", after: str = "") -> Self:
        """The instrument with one more element directly before or after another one ("half1.plate" in an arm).

        A duplicate name gets a number. Raises `NoSuchPlaceError` where there is no such element.
        """
        where, _, neighbour = (before or after).rpartition(".")
        holder = _member(self.arms, where, "arm") if where else self
        if neighbour not in holder.path:
            raise NoSuchPlaceError(str(unknown_name("element", neighbour, holder.path)))
        name, count = element.name or element.kind, 1
        while name in holder.path:
            count += 1
            name = f"{element.name or element.kind}_{count}"
        at = holder.path.index(neighbour) + bool(after)
        elements = (*holder.elements, dataclasses.replace(element, name=name))
        return self.changed(where, elements=elements, path=(*holder.path[:at], name, *holder.path[at:]))

    def with_part(self, stage: str, part: Component) -> Self:
        """The instrument with one more part of its cameras.

        `stage` is the stage of the cameras at which it acts: "transmission", "mixing", "ghosts", "exposures" or
        "detectors".
        """
        cameras = dataclasses.replace(self.cameras, **{stage: (*getattr(self.cameras, stage), part)})
        return dataclasses.replace(self, cameras=cameras)

    def with_source(self, source: Source) -> Self:
        """The instrument with a source of one more KIND, or with one of its sources replaced."""
        sources = {present.name: present for present in self.sources} | {source.name: source}
        return dataclasses.replace(self, sources=tuple(sources.values()))


def _member(members: tuple[Any, ...], name: str, what: str) -> Any:
    by_name = {member.name: member for member in members}
    if name not in by_name:
        raise NoSuchPlaceError(str(unknown_name(what, name, by_name)))
    return by_name[name]


@by_shapes
def is_achromatic(element: Element) -> bool:
    """True if an element depends neither on wavelength nor on another quantity of the exposures."""

    def run(element: Element) -> Any:
        ray = Ray.entering(jnp.zeros(()), jnp.zeros(()))
        return element.mueller(ray), element.ray(ray)

    try:
        jax.eval_shape(run, element)
    except NotPlannedError:
        return False
    return True


def _changed(part: AnyPart, path: list[str], fields: dict[str, Any], place: str) -> AnyPart:
    if not path:
        names = [field.name for field in dataclasses.fields(part)]
        check_names(f"field of {place or 'the instrument'}", fields, names)
        new = {
            name: value(getattr(part, name)) if callable(value) else value for name, value in fields.items()
        }
        return dataclasses.replace(part, **new)
    names = []
    for field in dataclasses.fields(part):
        members = getattr(part, field.name)
        if field.metadata.get("static", False) or not isinstance(members, tuple):
            continue
        names += [member.name for member in members if isinstance(member, Element | Arm)]
        for i, member in enumerate(members):
            if isinstance(member, Component) and member.name == path[0]:  # pyright: ignore
                new = (*members[:i], _changed(member, path[1:], fields, place), *members[i + 1 :])
                return dataclasses.replace(part, **{field.name: new})
    raise NoSuchPlaceError(f"the instrument has no part {place!r}; {nearest(path[0], names)}")
