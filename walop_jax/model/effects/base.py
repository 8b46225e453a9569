"""Effects: components with a name that patch the instrument.

An effect acts by `patch` alone: it changes a number of an element, or inserts an element, a part of the cameras or of a
source. Every computation of light uses the patched instrument; an inactive effect is not in the tree and costs nothing.
"""

from __future__ import annotations

import abc
import dataclasses
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.io.text import in_its_unit
from walop_jax.model.conventions import CAMERAS, EXTINCTION, OF_WALOP, Units
from walop_jax.model.effects.change import Change
from walop_jax.model.instrument import Instrument
from walop_jax.model.light_path import NoSuchPlaceError
from walop_jax.model.parameters import (
    Component,
    Parameter,
    as_number,
    by_shapes,
    field_declarations,
    unknown_name,
)
from walop_jax.model.parameters import Scalar as Scalar

MOST_PRINTED = 4  # values of one parameter


class Context(NamedTuple):
    """What effects need to know of the data.

    `moon` holds the positions of the Moon exposures and `moon_ids` their EXPOSURE numbers; `sources` the names of the
    standards, `exposures` the number of exposures, `cameras` the names of the cameras; `extinction` is the extinction
    of the polariser without the effect, `units` the scales of field and wavelength. `largest` are the largest values of
    factors of changes (`factors.largest_factors`); a factor that is not there is at most about 1.
    """

    exposures: int = 0
    moon: tuple[int, ...] = ()
    moon_ids: tuple[int, ...] = ()
    sources: tuple[str, ...] = ()
    cameras: tuple[str, ...] = CAMERAS
    extinction: float = EXTINCTION
    units: Units = OF_WALOP
    largest: Mapping[str, float] = MappingProxyType({})


class Effect(Component):
    """A physical effect beyond the base model, such as a half-wave plate that is turned (`hwp1_axis`).

    Its parameters are the `param` fields; static fields are its discrete choices (which camera, which star). `shape`
    names the non-linear parameters (phase, gap, position); all others are amplitudes, which do nothing at neutral,
    whatever the shape. `starts` are groups of initial shapes for a search: groups are alternatives, the members of a
    group are directions of a joint fit that `combine` turns into one effect. `one_sided` names amplitudes that physics
    keeps above neutral; `over_field` is true for an effect that only several field points can show, `watched` for one
    that may change from night to night, so that `check` looks for it in stars; `reference` is its source; `said` are
    its changes (`change`), empty for an effect beyond them. `unlisted` says what its parameters are if there are too
    many of them to be listed in print; it is empty for an effect whose parameters are listed.

    >>> walop.effect_by_name("hwp1_axis").neutral(walop.ObservingPlan(grid=3).context()).name
    'hwp1_axis'
    >>> walop.effect_by_name("hwp1_axis").of(walop.ObservingPlan(grid=3).context(), angle=0.3)
    hwp1_axis(angle=0.3 deg)
    """

    name: ClassVar[str] = ""
    shape: ClassVar[tuple[str, ...]] = ()
    starts: ClassVar[tuple[tuple[Mapping[str, Any], ...], ...]] = (({},),)
    one_sided: ClassVar[tuple[str, ...]] = ()
    over_field: ClassVar[bool] = False
    watched: ClassVar[bool] = False
    revealed_by: ClassVar[str] = ""
    separated_by: ClassVar[str] = ""
    reference: ClassVar[str] = ""
    said: ClassVar[tuple[str, ...]] = ()
    unlisted: ClassVar[str] = ""

    def __repr__(self) -> str:
        numbers = [
            f"{name}={_in_print(getattr(self, name), declared.unit)}"
            for name, declared in self.declarations().items()
        ]
        choices = [f"{name}={value!r}" for name, value in self.choices().items()]
        return f"{self.name}({', '.join(numbers + choices)})"

    @abc.abstractmethod
    def patch(self, instrument: Instrument) -> Instrument:
        """The instrument with the effect. Raises `NoSuchPlaceError` where it has no element that the effect acts on."""

    def details(self) -> tuple[tuple[float, float], ...]:
        """Field positions (deg) that show how fine a local feature is, such as a spot: interpolation may miss it."""
        return ()

    # ---------------------------------------------------------------------------------- making and describing

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """The effect with values that change nothing."""
        return cls()

    @classmethod
    def of(cls, context: Context, **values: Any) -> Self:
        """The neutral effect with some values replaced; a scalar fills a parameter of many elements.

        A camera is given by its name, or by its number from 0. Raises ValueError, with the nearest names, for an
        unknown parameter or camera.
        """
        return cls.neutral(context).given(context, **values)

    @classmethod
    def probes(cls, context: Context) -> tuple[tuple[Self, ...], ...]:
        """Neutral effects at the shapes of `starts`, to be differentiated by a linear search."""
        return tuple(tuple(cls.of(context, **start) for start in group) for group in cls.starts)

    @classmethod
    def combine(cls, group: Sequence[Any], amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Self:
        """The effect with amplitudes from a linear fit of the probes of a group.

        `amplitudes` are counted from neutral, member by member in the order of the fields. A group of one
        takes them as they are; larger groups override this.
        """
        if len(group) != 1:
            raise NotImplementedError(f"{cls.name} has no `combine` for its probes")
        return group[0].moved(amplitudes)

    @classmethod
    def head(cls) -> str:
        """Equation, symbols, source, neutral values and revealing data, for its page: the head of its file."""
        return inspect.cleandoc(sys.modules[cls.__module__].__doc__ or "").partition("\n")[2].strip("\n")

    @classmethod
    def numbers(cls) -> dict[str, Parameter]:
        """The parameters by name, as the class declares them."""
        return field_declarations(cls)

    @classmethod
    def amplitudes(cls) -> tuple[str, ...]:
        """Names of the parameters with a linear effect at neutral."""
        return tuple(name for name in cls.numbers() if name not in cls.shape)

    @classmethod
    def is_structural(cls) -> bool:
        """True for an effect without parameters: present or absent."""
        return not cls.numbers()

    # ------------------------------------------------------------------------------------- an effect at some values

    @property
    def kind(self) -> Any:
        """Its class, or its entry in the catalogue: common to all effects of its name."""
        return type(self)

    def declarations(self) -> Mapping[str, Parameter]:
        """The parameters of this effect by name."""
        return self.kind.numbers()

    def replaced(self, **values: Any) -> Self:
        """The effect with other values of parameters, or other choices."""
        return dataclasses.replace(self, **values)

    def given(self, context: Context, **values: Any) -> Self:
        """The effect with values as `of` takes them."""
        numbers, choices = self.declarations(), self.choices()
        for name, value in values.items():
            if name in numbers:
                shape = np.shape(getattr(self, name))
                number = as_number(value)
                values[name] = number if np.shape(number) == shape else jnp.broadcast_to(number, shape)
            elif name not in choices:
                raise unknown_name(f"parameter of {self.name}", name, [*numbers, *choices])
        if "camera" in values:
            values["camera"] = numbered_camera(self.name, values["camera"], context.cameras)
        return self.replaced(**values)

    def prior_widths(self, context: Context) -> dict[str, float]:
        """Prior widths of the amplitudes for some data by label, in the order of its parameters."""
        declared, names = self.declarations(), self.kind.amplitudes()
        return {label: declared[name].width or 1.0 for name in names for label in self.labels(name)}

    def moved(self, amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Self:
        """The effect with numbers added to its amplitudes, in the order of its parameters."""
        remaining, changed = np.asarray(amplitudes, float), {}
        for name in self.kind.amplitudes():
            value = np.asarray(getattr(self, name))
            changed[name] = value + remaining[: value.size].reshape(value.shape)
            remaining = remaining[value.size :]
        return self.replaced(**changed)

    def choices(self) -> dict[str, Any]:
        """Discrete choices of the effect, e.g. the number of a camera."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.metadata.get("static")}

    def as_descriptions(self, instrument: Instrument) -> tuple[str, ...]:
        """Descriptions of the changes whose sum, to first order, is the effect in an instrument."""
        return self.said

    def first_order(self, instrument: Instrument) -> tuple[tuple[tuple[float, Change], ...], ...]:
        """For each amplitude its changes and their coefficients to first order; empty: unknown."""
        return ()

    @property
    def stated(self) -> tuple[str, ...]:
        """Changes of numbers of which a parameter is the value itself: the two exclude each other."""
        return ()

    def at_neutral(self, context: Context) -> Self:
        """The same effect, discrete choices included, at neutral values."""
        return self.kind.of(context, **self.choices())

    def standard_form(self) -> Self:
        """The same effect with positive amplitude and with angles in their principal range."""
        return self

    def lacks(self, instrument: Instrument) -> str:
        """The part that the instrument, as it was put together, lacks for the effect; empty where it fits."""
        return _lacking(self, dataclasses.replace(instrument.as_put_together(), effects=()))


def _in_print(value: Any, unit: str) -> str:
    """The value of a parameter with its unit; how many values, if there are more than a few."""
    try:
        numbers = np.ravel(np.asarray(value, float)).tolist()
    except TypeError:  # traced by JAX, or a shape: there is no number yet
        return "?"
    few = len(numbers) <= MOST_PRINTED
    return in_its_unit(
        "/".join(f"{number:.4g}" for number in numbers) if few else f"{len(numbers)} values", unit
    )


@by_shapes
def _lacking(effect: Effect, bare: Instrument) -> str:
    """The part that an instrument without effects lacks for an effect."""
    try:
        jax.eval_shape(lambda effect, bare: effect.patch(bare), effect, bare)
    except NoSuchPlaceError as error:
        return str(error)
    return ""


def with_amplitudes(
    instrument: Instrument, effects: Sequence[Effect]
) -> tuple[list[Float[Array, ...]], Callable[[list[Float[Array, ...]]], Instrument]]:
    """The amplitudes of effects, one after the other, and the function that adds the effects with other ones."""
    names = [(i, name) for i, effect in enumerate(effects) for name in effect.kind.amplitudes()]

    def put(amplitudes: list[Float[Array, ...]]) -> Instrument:
        changed = list(effects)
        for (i, name), value in zip(names, amplitudes, strict=True):
            changed[i] = changed[i].replaced(**{name: value})
        return dataclasses.replace(instrument, effects=(*instrument.effects, *changed))

    return [getattr(effects[i], name) for i, name in names], put


def numbered_camera(effect: str, camera: int | str, names: Sequence[str]) -> int:
    """The number of a camera that is given by name or number; ValueError, with the effect, for an unknown camera."""
    if camera in names:
        return names.index(camera)  # type: ignore[arg-type]
    if camera not in range(len(names)):
        cameras = ", ".join(f"{name} ({number})" for number, name in enumerate(names))
        raise ValueError(f"{effect}: camera {camera!r} does not exist; cameras are {cameras}")
    return int(camera)
