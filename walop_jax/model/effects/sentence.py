"""Sentences about what an instrument may lack: a kind, at a place of the light path, growing with something.

    KIND PREPOSITION PLACE [* FACTOR ...]

    retardance q behind collimator * r2         a linear retarder with its axis along X, growing as r² over the field
    turn of polariser * cos 2 CLP               an axis that is turned by an amount that depends on its own reading
    gain of O1 * hours                          a camera that grows more sensitive
    light of E1 in O1                           a share of the counts of one camera in another one
    polarisation q of HD_14069                  a star that is not what the catalogue says

Kinds of the optics have an axis: q, u (along X, along 45°), v (circular), radial, or diagonal (at 45° to radial; both
grow with r²). They stand `ahead of` or `behind` an element, or are `of` one that moves, in the beam only when it is.
Factors multiply each other; without one the amplitude is the same everywhere.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from typing import Any, Self

import jax.numpy as jnp
import numpy as np

from walop_jax.model import legendre
from walop_jax.model.conventions import FIELD_SCALE
from walop_jax.model.parameters import unknown_name

AXES = ("q", "u", "v", "radial", "diagonal")
OPTICAL = (
    *(f"{kind} {axis}" for kind in ("diattenuation", "retardance") for axis in AXES),
    "depolarisation",
)
NUMBERS = {"axis": "angle", "cut": "angle", "thickness": "length", "thermal": "number"}
"""Numbers of elements that a sentence can change, and the parameter of the effect that holds the change."""
DISPLACEMENTS = ("displacement x", "displacement y")
POLARISATION = ("polarisation q", "polarisation u", "polarisation")
OPPOSITE = "opposite"  # the field point, as an origin of light
SKY, BAND = "sky", "band"  # places that are no element
KINDS: Mapping[str, str] = {
    **{kind: "retardance" if kind.startswith("retardance") else "share" for kind in OPTICAL},
    "turn": "angle",
    "gain": "share",
    "light": "share",
    "afterglow": "share",
    "fringes": "share",
    **dict.fromkeys(POLARISATION, "share"),
    **dict.fromkeys(DISPLACEMENTS, "displacement"),
    "shift": "wavelength",
    **NUMBERS,
}
"""Kinds, and the parameter of the effect that holds the amplitude: it has the unit."""

REFERENCE_WAVELENGTH = 0.62  # µm
REFERENCE_TEMPERATURE = 10.0  # Celsius
LARGEST_SQUARE = 2.0  # of the field radius, in units of FIELD_SCALE: the corners
FIELD_FACTORS = ("x", "y", "r2", "x2-y2", "xy")
_RING = re.compile(r"ring (\d+)")
_HARMONIC = re.compile(r"(cos|sin) (\d+) (\w+)")
_SPAN = re.compile(r"hours (-?[\d.]+) to (-?[\d.]+)")
_EXPOSURE = re.compile(r"exposure (\d+)")
_GAP = re.compile(r"gap ([\d.]+)")
_SENTENCE = re.compile(
    rf"(?P<kind>{'|'.join(KINDS)})(?: of (?P<origin>\S+))? (?P<where>of|in|ahead of|behind) (?P<place>[^\s*]+)"
)


_PLAIN: Mapping[str, Callable[[Any], Any]] = {
    "x": lambda at: at.x / FIELD_SCALE,
    "y": lambda at: at.y / FIELD_SCALE,
    "r2": lambda at: (at.x**2 + at.y**2) / FIELD_SCALE**2,
    "x2-y2": lambda at: (at.x**2 - at.y**2) / FIELD_SCALE**2,
    "xy": lambda at: 2.0 * at.x * at.y / FIELD_SCALE**2,
    "colour": lambda at: at.wavelength / REFERENCE_WAVELENGTH - 1.0,
    "hours": lambda at: at.hours,
    "hour angle": lambda at: at.hour_angle,
    "kelvin": lambda at: at.temperature - REFERENCE_TEMPERATURE,
    "counts": lambda at: 1.0,  # the detector multiplies with its own counts
}
_WORDS = {
    "x": "growing with X (amplitude at 0.3°)",
    "y": "growing with Y (amplitude at 0.3°)",
    "r2": "growing with the field radius squared (amplitude at 0.3°)",
    "x2-y2": "as X² − Y² over the field (amplitude at 0.3°)",
    "xy": "as 2XY over the field (amplitude at 0.3°)",
    "colour": "growing with wavelength (per unit of λ/0.62 µm − 1)",
    "hours": "growing with time (per hour since the first exposure)",
    "hour angle": "growing with the hour angle (per hour)",
    "kelvin": "growing with temperature (per kelvin above 10 °C)",
    "counts": "growing with the counts (at 10⁶ electrons)",
}


_FACTORS = (*_PLAIN, "ring N", "cos N PREFIX", "sin N PREFIX", "hours A to B", "exposure N", "gap UM")


@dataclasses.dataclass(frozen=True)
class Sentence:
    """A kind at a place with its factors; `origin` is where light comes from: another camera, or `OPPOSITE`."""

    kind: str
    where: str
    place: str
    factors: tuple[Any, ...] = ()  # texts; a column may be taken with a function of the exposures instead
    origin: str = ""

    @classmethod
    def parsed(cls, text: str) -> Self:
        """The sentence of a text. Raises ValueError, with the nearest words, for what is none."""
        head, *factors = (part.strip() for part in text.split("*"))
        found = _SENTENCE.fullmatch(head)
        if found is None:
            kinds = ", ".join(KINDS)
            raise ValueError(
                f"{text!r} is no sentence: write KIND of|in|behind|ahead of PLACE [* FACTOR]; kinds are {kinds}"
            )
        for factor in factors:
            _check_factor(factor)
        return cls(found["kind"], found["where"], found["place"], tuple(factors), found["origin"] or "")

    @property
    def text(self) -> str:
        """The sentence as it is typed."""
        origin = f" of {self.origin}" if self.origin else ""
        return " * ".join((f"{self.kind}{origin} {self.where} {self.place}", *self.factors))

    @property
    def label(self) -> str:
        """The same without blanks, for the name of a parameter."""
        return self.text.replace(" ", "_")

    @property
    def parameter(self) -> str:
        """The parameter of the effect that holds the amplitude."""
        return KINDS[self.kind]

    def times(self, *factors: str) -> Sentence:
        """The sentence with further factors."""
        return dataclasses.replace(self, factors=(*self.factors, *factors))

    @property
    def number(self) -> int:
        """The exposure that it is about. Raises ValueError for a sentence about no single one."""
        return int(self._stated(_EXPOSURE, "of which exposure", "exposure 7"))

    @property
    def gap(self) -> float:
        """Thickness (µm) of the air whose fringes it is about. Raises ValueError for a sentence without one."""
        return float(self._stated(_GAP, "of which gap (µm)", "gap 10"))

    def _stated(self, pattern: re.Pattern[str], what: str, example: str) -> str:
        """What the only factor of a form says."""
        found = [one[1] for f in self.factors if (one := pattern.fullmatch(f))]
        if len(found) != 1:
            raise ValueError(f"{self.text!r}: say {what}, as in '{self.kind} of {self.place} * {example}'")
        return found[0]

    @property
    def field_factors(self) -> tuple[str, ...]:
        """Factors that depend on the field point alone."""
        return tuple(f for f in self.factors if f in FIELD_FACTORS or _RING.fullmatch(f))

    @property
    def exposure_factors(self) -> tuple[str, ...]:
        """Factors that depend on the exposure."""
        return tuple(f for f in self.factors if f not in (*self.field_factors, "colour"))

    def factor(self, at: Any) -> Any:
        """Product of its factors, 1 without any; `at` has x, y, wavelength, hours, temperature, number, angle()."""
        product: Any = 1.0
        for name in self.factors:
            product = product * factor(name, at)
        return product

    def in_words(self) -> str:
        """Kind, place and dependence, to be read by people."""
        origin = "the opposite field point" if self.origin == OPPOSITE else self.origin
        of = f" of {origin}" if origin else ""
        return ", ".join((f"{self.kind}{of} {self.where} {self.place}", *map(_in_words, self.factors)))


def factor(name: str, at: Any) -> Any:
    """Value of one factor."""
    if name in _PLAIN:
        return _PLAIN[name](at)
    if ring := _RING.fullmatch(name):
        square = (at.x**2 + at.y**2) / FIELD_SCALE**2
        return legendre.polynomial(int(ring[1]), 2.0 * square / LARGEST_SQUARE - 1.0)
    if harmonic := _HARMONIC.fullmatch(name):
        angle = at.angle(harmonic[3])
        wave = getattr(np if isinstance(angle, np.ndarray) else jnp, harmonic[1])
        return wave(int(harmonic[2]) * angle)
    if span := _SPAN.fullmatch(name):
        return ((at.hours >= float(span[1])) & (at.hours < float(span[2]))) * 1.0
    if one := _EXPOSURE.fullmatch(name):
        return (at.number == int(one[1])) * 1.0
    if _GAP.fullmatch(name):
        return 1.0  # the fringes themselves know it
    raise unknown_name("factor", name, _FACTORS)


def _check_factor(name: str) -> None:
    if name not in _PLAIN and not any(p.fullmatch(name) for p in (_RING, _HARMONIC, _SPAN, _EXPOSURE, _GAP)):
        raise unknown_name("factor", name, _FACTORS)


def _in_words(name: str) -> str:
    if name in _WORDS:
        return _WORDS[name]
    if ring := _RING.fullmatch(name):
        return f"in rings over the field (Legendre polynomial {ring[1]} of the radius squared)"
    if harmonic := _HARMONIC.fullmatch(name):
        return f"as the {harmonic[1]}ine of {harmonic[2]} × the angle of {harmonic[3]}".replace(
            "sinine", "sine"
        )
    if span := _SPAN.fullmatch(name):
        return f"from {span[1]} to {span[2]} h after the first exposure"
    if gap := _GAP.fullmatch(name):
        return f"of {gap[1]} µm of air (amplitude at a maximum)"
    return f"in {name} of the list alone (the first is 0)"
