"""What a change grows with: over the field, with wavelength, time, temperature, counts, or the angle of an element.

A factor knows its `text` as it is typed, its `value`, its `words`, the observation that would `test` it (empty: none of
its own) and what it `depends_on`: FIELD, WAVELENGTH, EXPOSURE, COUNTS, or SHAPE (of the change itself). `factor` is the
one reader of their texts.

A value is asked for with something that has x, y (deg), wavelength (µm), hours since the first exposure, hour_angle
(h), temperature (Celsius), the number of the exposure in its list, and `angle(prefix)` (rad) of the polariser or
another moving element, NaN where that is out of the beam; all are scalars, or arrays that broadcast.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self, final

import jax.numpy as jnp
import numpy as np

from walop_jax.model import legendre
from walop_jax.model.conventions import FIELD_SCALE, REFERENCE_WAVELENGTH
from walop_jax.model.materials import REFERENCE_TEMPERATURE
from walop_jax.model.parameters import unknown_name

LARGEST_SQUARE = 2.0  # of the field radius, in units of FIELD_SCALE: the corners
FIELD, WAVELENGTH, EXPOSURE, COUNTS, SHAPE = "field", "wavelength", "exposure", "counts", "shape"
MORE_POINTS = "more field points along that direction; dither: what is of the optics stays where it is"
ONCE_MORE = "the same exposures once more"


@final
@dataclasses.dataclass(frozen=True)
class Plain:
    """A factor without a number of its own."""

    text: str
    depends_on: str
    words: str
    test: str
    of: Callable[[Any], Any]

    def value(self, at: Any) -> Any:
        """Its value."""
        return self.of(at)


@final
@dataclasses.dataclass(frozen=True)
class Ring:
    """Legendre polynomial of some degree in (X² + Y²)/(0.3°)² − 1."""

    degree: int

    form: ClassVar[str] = "ring N"
    depends_on: ClassVar[str] = FIELD
    test: ClassVar[str] = MORE_POINTS

    @classmethod
    def parsed(cls, first: str, rest: list[str]) -> Self | None:
        """The factor of its words; None where they are none."""
        return cls(int(rest[0])) if first == "ring" and len(rest) == 1 and rest[0].isdecimal() else None

    @property
    def text(self) -> str:
        """The factor as it is typed."""
        return f"ring {self.degree}"

    @property
    def words(self) -> str:
        """The dependence in words."""
        return f"in rings over the field (Legendre polynomial {self.degree} of the radius squared)"

    def value(self, at: Any) -> Any:
        """Its value."""
        square = (at.x**2 + at.y**2) / FIELD_SCALE**2
        return legendre.polynomial(self.degree, 2.0 * square / LARGEST_SQUARE - 1.0)


@final
@dataclasses.dataclass(frozen=True)
class Harmonic:
    """Cosine or sine of a multiple of the angle of a moving element, by the prefix of its columns."""

    wave: str
    order: int
    prefix: str

    form: ClassVar[str] = "cos N PREFIX, sin N PREFIX"
    depends_on: ClassVar[str] = EXPOSURE
    test: ClassVar[str] = (
        "a full turn at more angles in random order, then with the element mounted turned by 90°"
    )

    @classmethod
    def parsed(cls, first: str, rest: list[str]) -> Self | None:
        """The factor of its words; None where they are none."""
        if first not in ("cos", "sin") or len(rest) != 2 or not rest[0].isdecimal():
            return None
        return cls(first, int(rest[0]), rest[1])

    @property
    def text(self) -> str:
        """The factor as it is typed."""
        return f"{self.wave} {self.order} {self.prefix}"

    @property
    def words(self) -> str:
        """The dependence in words."""
        name = {"cos": "cosine", "sin": "sine"}[self.wave]
        return f"as the {name} of {self.order} × the angle of {self.prefix}"

    def value(self, at: Any) -> Any:
        """Its value."""
        angle = at.angle(self.prefix)
        return getattr(np if isinstance(angle, np.ndarray) else jnp, self.wave)(self.order * angle)


@final
@dataclasses.dataclass(frozen=True)
class Span:
    """1 from one time to another (hours since the first exposure), 0 elsewhere; times as they are typed."""

    start: str
    stop: str

    form: ClassVar[str] = "hours A to B"
    depends_on: ClassVar[str] = EXPOSURE
    test: ClassVar[str] = ONCE_MORE

    @classmethod
    def parsed(cls, first: str, rest: list[str]) -> Self | None:
        """The factor of its words; None where they are none."""
        if (
            first != "hours"
            or len(rest) != 3
            or rest[1] != "to"
            or not (_number(rest[0]) and _number(rest[2]))
        ):
            return None
        return cls(rest[0], rest[2])

    @property
    def text(self) -> str:
        """The factor as it is typed."""
        return f"hours {self.start} to {self.stop}"

    @property
    def words(self) -> str:
        """The dependence in words."""
        return f"from {self.start} to {self.stop} h after the first exposure"

    def value(self, at: Any) -> Any:
        """Its value."""
        return ((at.hours >= float(self.start)) & (at.hours < float(self.stop))) * 1.0


@final
@dataclasses.dataclass(frozen=True)
class Exposure:
    """1 in one exposure of the list, counted from 0; 0 in all others."""

    number: int

    form: ClassVar[str] = "exposure N"
    depends_on: ClassVar[str] = EXPOSURE
    test: ClassVar[str] = ONCE_MORE

    @classmethod
    def parsed(cls, first: str, rest: list[str]) -> Self | None:
        """The factor of its words; None where they are none."""
        return cls(int(rest[0])) if first == "exposure" and len(rest) == 1 and rest[0].isdecimal() else None

    @property
    def text(self) -> str:
        """The factor as it is typed."""
        return f"exposure {self.number}"

    @property
    def words(self) -> str:
        """The dependence in words."""
        return f"in exposure {self.number} of the list (the first is 0)"

    def value(self, at: Any) -> Any:
        """Its value."""
        return (at.number == self.number) * 1.0


@final
@dataclasses.dataclass(frozen=True)
class Gap:
    """Thickness (µm) of the air whose fringes a change is, as it is typed: 1, the fringes themselves know it."""

    typed: str

    form: ClassVar[str] = "gap N"
    depends_on: ClassVar[str] = SHAPE
    test: ClassVar[str] = ""

    @classmethod
    def parsed(cls, first: str, rest: list[str]) -> Self | None:
        """The factor of its words; None where they are none."""
        good = first == "gap" and len(rest) == 1 and _number(rest[0]) and not rest[0].startswith("-")
        return cls(rest[0]) if good else None

    @property
    def thickness(self) -> float:
        """In µm."""
        return float(self.typed)

    @property
    def text(self) -> str:
        """The factor as it is typed."""
        return f"gap {self.typed}"

    @property
    def words(self) -> str:
        """The dependence in words."""
        return f"of {self.typed} µm of air (amplitude at a maximum)"

    def value(self, at: Any) -> Any:
        """1."""
        del at
        return 1.0


def _number(text: str) -> bool:
    return text.removeprefix("-").replace(".", "", 1).isdecimal()


Factor = Plain | Ring | Harmonic | Span | Exposure | Gap


def _at(what: str, depends_on: str, words: str, test: str, of: Callable[[Any], Any]) -> tuple[str, Factor]:
    return what, Plain(what, depends_on, words, test, of)


PLAIN: Mapping[str, Factor] = dict(
    (
        _at("x", FIELD, "growing with X (amplitude at 0.3°)", MORE_POINTS, lambda at: at.x / FIELD_SCALE),
        _at("y", FIELD, "growing with Y (amplitude at 0.3°)", MORE_POINTS, lambda at: at.y / FIELD_SCALE),
        _at(
            "r2", FIELD, "growing with the field radius squared (amplitude at 0.3°)", MORE_POINTS,
            lambda at: (at.x**2 + at.y**2) / FIELD_SCALE**2,
        ),
        _at(
            "x2-y2", FIELD, "as X² − Y² over the field (amplitude at 0.3°)", MORE_POINTS,
            lambda at: (at.x**2 - at.y**2) / FIELD_SCALE**2,
        ),
        _at(
            "xy", FIELD, "as 2XY over the field (amplitude at 0.3°)", MORE_POINTS,
            lambda at: 2.0 * at.x * at.y / FIELD_SCALE**2,
        ),
        _at(
            "colour", WAVELENGTH, "growing with wavelength (per unit of λ/0.62 µm − 1)",
            "narrow bands, or another filter", lambda at: at.wavelength / REFERENCE_WAVELENGTH - 1.0,
        ),
        _at(
            "hours", EXPOSURE, "growing with time (per hour since the first exposure)",
            "the same exposures in another order, or once more hours later", lambda at: at.hours,
        ),
        _at(
            "hour angle", EXPOSURE, "growing with the hour angle (per hour)",
            "the same exposures at other hour angles, in another order", lambda at: at.hour_angle,
        ),
        _at(
            "kelvin", EXPOSURE, "growing with temperature (per kelvin above 10 °C)",
            "the same exposures at another temperature", lambda at: at.temperature - REFERENCE_TEMPERATURE,
        ),
        _at(
            # The detector multiplies with its own counts.
            "counts", COUNTS, "growing with the counts (at 10⁶ electrons)", "the same exposures at another flux",
            lambda at: 1.0,
        ),
    )
)  # fmt: skip
"""Factors without a number of their own, by text."""

FORMS = (Ring, Harmonic, Span, Exposure, Gap)
"""Factors with numbers or names in them."""


@functools.cache
def factor(text: str) -> Factor:
    """The factor of a text. Raises ValueError, with the nearest ones, for what is none."""
    if text in PLAIN:
        return PLAIN[text]
    first, *rest = text.split(" ")
    for form in FORMS:
        if (found := form.parsed(first, rest)) is not None:
            return found
    raise unknown_name("factor", text, (*PLAIN, *(form.form for form in FORMS)))
