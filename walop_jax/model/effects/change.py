"""A change of an instrument with one amplitude: a kind, at a place, with factors.

    KIND RELATION PLACE [* FACTOR ...]

    retardance q behind collimator * r2         a linear retarder with its axis along X, growing as r² over the field
    turn of polariser * cos 2 CLP               an axis turned by an amount that depends on its own reading
    gain of O1 * hours                          a camera that grows more sensitive
    light of E1 in O1                           a fraction of the counts of one camera in another one
    polarisation q of HD_14069                  a star that differs from the catalogue

RELATION is a preposition: "ahead of", "behind", "of" or "in" (`Change.relation`); PLACE is the name of an element, a
camera or a star (`Change.place`). An amplitude of 0 changes nothing. The kind of a change (`ChangeKind`), defined in
the file of its family (`optics`, `cameras`, `numbers`), says what a change does to an instrument. Factors (`factors`)
multiply each other; without a factor the amplitude is the same everywhere.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
import re
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.data.kinds import POLARISER
from walop_jax.model.conventions import OF_WALOP, Units
from walop_jax.model.effects.factors import FIELD, Factor, factor, smooth_deviations, values_at
from walop_jax.model.instrument import Instrument
from walop_jax.model.light_path import Scalar
from walop_jax.model.parameters import check_names
from walop_jax.model.ray import NotPlannedError, Ray
from walop_jax.model.sources import ExposureArrays

Term = tuple["Change", Scalar]
FactorLike = str | Callable[[Any], Any]
"""A factor: a text, or a function of the quantities of factors."""
OPPOSITE = "opposite"  # the field point, as an origin of light
SLOW, SINGLE = ("hours", "kelvin", "hour angle"), ("per EXPTIME", "order", "night hours")
OF_LIST = ("exposure", "kind", "side", *SINGLE)  # forms of factors that ask for the list of exposures
OF_RAY = ("kind", "per EXPTIME")  # those that the optics follow (`ray.Conditions`)
GROWING = ("hours", "hour_angle", "temperature")  # conditions that factors are proportional to
SKY, BAND = "sky", "band"  # places other than elements


class Amplitude(NamedTuple):
    """Unit, meaning and plausible size of an amplitude."""

    unit: str
    about: str
    width: float


AMPLITUDES = {
    "share": Amplitude("", "share", 0.003),
    "retardance": Amplitude("rad", "retardance", 0.02),
    "angle": Amplitude("deg", "angle", 0.1),
    "displacement": Amplitude("deg", "displacement in the field", 0.005),
    "length": Amplitude("um", "length", 5.0),
    "wavelength": Amplitude("um", "displacement of the band", 0.003),
    "number": Amplitude("", "number", 1.0),
}
"""Amplitudes of changes, by the parameter of `described` that holds them."""


class Combinations(NamedTuple):
    """Factors of changes in a diagnosis: each pattern over the field with each form of dependence.

    Patterns and forms are those of `diagnosis.grammar`; `among` is the group of changes tried together,
    each with its amplitude: single ones, those of the cameras of an arm, of all cameras or arms, or all optics there.
    """

    over: tuple[str, ...] = ("even",)
    along: tuple[str, ...] = ("steady",)
    among: tuple[str, ...] = ("alone",)


class Grows(NamedTuple):
    """What a change may grow with: dependences (`Factor.depends_on`), an angle, and the combinations `tried` in a
    diagnosis.

    `angle` is the prefix of the columns of the one element whose angle is allowed; None: any element, and also single
    exposures and exposures of one KIND.
    """

    allowed: tuple[str, ...] = ()
    angle: str | None = ""
    tried: tuple[Combinations, ...] = ()


class NoSlotError(ValueError):
    """A change that is no sum of slots to first order, so that it needs a derivative of its own."""


class SlotTerm(NamedTuple):
    """A first-order term of a change: a slot of the light path (`model.slots`), a coefficient, factors."""

    slot: tuple[Any, ...]
    size: float
    factors: tuple[FactorLike, ...]


SlotTerms = Callable[["Instrument", "Change"], Iterable[SlotTerm]]


def itself(stage: str) -> SlotTerms:
    """Slots of changes with a slot of their own: without factors, at a stage of the light path."""
    return lambda _, change: [
        SlotTerm((stage, change.kind, change.relation, change.place), 1.0, change.factors)
    ]


@dataclasses.dataclass(frozen=True)
class ChangeKind:
    """A kind of change: one of `AMPLITUDES`, its patch of an instrument, the observation that would test it.

    Changes with equal `patch` and `together` are patched together. `patch` and `grows` raise `NoSuchPlaceError` where
    an instrument has no such place, ValueError for an impossible change. `slots` are its first-order terms; slots that
    an instrument does not have are no error here. The kind `gain`, for instance, multiplies the counts of a camera.
    """

    parameter: str
    patch: Callable[[Instrument, Sequence[Term]], Instrument]
    together: Callable[[Change], Hashable] = lambda change: change
    test: str = ""
    grows: Callable[[Instrument, Change], Grows] = lambda instrument, change: Grows()
    slots: SlotTerms = dataclasses.field(kw_only=True)


SMOOTH = "smooth"
"""Word for all terms of a smooth field (factors `field I J`) together."""
OF_CAMERAS = ("gain", "reported gain", "light", "afterglow")
"""Kinds of changes of counts."""
KINDS: dict[str, ChangeKind] = {}
"""All kinds by their names, which begin the texts of their changes; filled by the files of their families."""


@dataclasses.dataclass(frozen=True)
class Change:
    """A change: a kind, at a place, with factors; `origin` is where its light comes from: another camera, or
    `OPPOSITE`.

    Factors are counted in the `units` of an instrument, those of WALOP until the change is `counted_in` other units.
    `Change.parsed("gain of O1 * hours")` has the kind "gain", the relation "of", the place "O1" and one factor.
    """

    kind: str
    relation: str
    place: str
    factors: tuple[FactorLike, ...] = ()
    origin: str = ""
    units: Units = OF_WALOP

    @classmethod
    def parsed(cls, text: str) -> Self:
        """The change of a text. Raises ValueError, with the nearest words, for an invalid text."""
        return cls(*_parsed(text))

    @property
    def text(self) -> str:
        """The change as it is typed."""
        origin = f" of {self.origin}" if self.origin else ""
        return " * ".join((f"{self.kind}{origin} {self.relation} {self.place}", *map(str, self.factors)))

    @property
    def label(self) -> str:
        """The text of the change without blanks, for the name of a parameter."""
        return self.text.replace(" ", "_")

    @property
    def candidate(self) -> str:
        """The text, in which the terms of a smooth field have one name: `gain of O1 * hours * smooth`.

        A diagnosis has all terms of a smooth field as one candidate.
        """
        smooth = [item.text for item in self.grows_with if item.form == "field"]
        texts = (SMOOTH if item in smooth else item for item in self.text.split(" * "))
        return " * ".join(texts) if smooth else self.text

    @property
    def smooth_rms(self) -> float:
        """Root mean square of its terms of a smooth field over a square field of the scale; 1 without such a term."""
        terms = [item.given for item in self.grows_with if item.form == "field"]
        degrees = [int(degree) for given in terms for degree in given]
        return math.prod(smooth_deviations()[degree] / math.sqrt(2.0 * degree + 1.0) for degree in degrees)

    @property
    def parameter(self) -> str:
        """The amplitude, by its name in `AMPLITUDES`."""
        return KINDS[self.kind].parameter

    @property
    def grows_with(self) -> tuple[Factor, ...]:
        """The factors that have a text."""
        return tuple(factor(item) for item in self.factors if isinstance(item, str))

    def counted_in(self, units: Units) -> Change:
        """The change with its factors counted in the scales `units`."""
        return dataclasses.replace(self, units=units)

    @property
    def applies_to_catalogue(self) -> bool:
        """True if its effect on a star depends on nothing but the counts and the field position of that star."""
        elsewhere = self.kind == "afterglow" or (self.kind == "light" and self.origin in ("", OPPOSITE))
        return not elsewhere and not any(
            item.text == "hours" or item.form in ("hours", *OF_LIST) for item in self.grows_with
        )

    @property
    def of_camera(self) -> bool:
        """True if it acts on the counts of cameras, behind all optics."""
        return self.kind in OF_CAMERAS

    def is_of_sky(self, instrument: Instrument) -> bool:
        """True for a change of light from the sky alone, ahead of the polariser."""
        return (self.relation, self.place) == instrument.ahead_of_polariser

    @property
    def over_field(self) -> tuple[str, ...]:
        """Texts of its factors that are patterns over the field."""
        return tuple(item.text for item in self.grows_with if item.depends_on == FIELD)

    @property
    def beside_field(self) -> tuple[str, ...]:
        """Texts of its factors that are no patterns over the field."""
        return tuple(item.text for item in self.grows_with if item.depends_on != FIELD)

    def times(self, *factors: str) -> Change:
        """The change with further factors."""
        return dataclasses.replace(self, factors=(*self.factors, *factors))

    def without(self, factor: str) -> Change:
        """The change without a factor."""
        return dataclasses.replace(self, factors=tuple(f for f in self.factors if f != factor))

    def width(self, largest: Mapping[str, float]) -> float:
        """Prior width of the amplitude: the change is as large as its kind may be where its factors are largest.

        `largest` are the largest values of factors (`Context`).
        """
        sizes = (largest.get(item.text, 1.0) for item in self.grows_with)
        return AMPLITUDES[self.parameter].width / math.prod(sizes)

    @property
    def number(self) -> int:
        """Number of its exposure. Raises ValueError for a change without a single one."""
        return int(self._only("exposure", "the exposure", "exposure 7"))

    @property
    def gap(self) -> float:
        """Thickness (µm) of the air of its fringes. Raises ValueError for a change without one."""
        return float(self._only("gap", "the gap (µm)", "gap 10"))

    def _only(self, form: str, what: str, example: str) -> str:
        """Value given in the only factor of a form."""
        matches = [item.given[0] for item in self.grows_with if item.form == form]
        if len(matches) != 1:
            raise ValueError(f"{self.text!r}: state {what}, as in '{self.kind} of {self.place} * {example}'")
        return matches[0]

    def factor(self, at: Any) -> Any:
        """The product of its factors at `at`, 1 without any."""
        return product(self.factors, at, self.units)

    def in_train(self, ray: Ray, angle: Any) -> Any:
        """Product of its factors for a ray, in an element at `angle` (deg)."""
        return self.factor(InTrain(ray, angle))

    def check_factors(self, instrument: Instrument) -> None:
        """Raise ValueError for a factor beyond those of the kind."""
        allowed, angle, _ = KINDS[self.kind].grows(instrument, self)
        for item in self.grows_with:
            if item.form == "kind":
                check_names("KIND of exposures", item.given, instrument.kinds)
            matching = angle is None or (item.form in ("cos", "sin") and item.given[-1] == angle)
            single = item.form in ("cos", "sin", *OF_LIST) and item.form not in OF_RAY
            if item.depends_on not in allowed or (single and not matching):
                takes = ", ".join(allowed) or "nothing"
                only = f"; of angles that of {angle} alone" if angle else ""
                what = f"{self.kind} {self.relation} {self.place} cannot grow with {item.text!r}"
                raise ValueError(f"{self.text!r}: {what}, only with {takes}{only}")

    def in_words(self) -> str:
        """Kind, place and dependence in plain words."""
        origin = "the opposite field point" if self.origin == OPPOSITE else self.origin
        of = f" of {origin}" if origin else ""
        return ", ".join(
            (
                f"{self.kind}{of} {self.relation} {self.place}",
                *(f.in_words(self.units) for f in self.grows_with),
            )
        )

    @property
    def tested_by(self) -> str:
        """Observations that would test it."""
        advice = [f.test for f in self.grows_with if f.test]
        if self.origin == OPPOSITE:
            advice.append("a star dithered over the field: its ghost moves the other way")
        elif test := KINDS[self.kind].test:
            advice.append(test)
        elif self.relation == "ahead of" and "." not in self.place:
            advice.append("standards at several ROTATOR angles: light through the polariser does not have it")
        elif self.relation == "of":
            advice.append("the same exposures without that element, or with it mounted turned over")
        else:
            advice.append(
                "a half-wave plate for calibration at 0° and 45°: it turns what is ahead of it, not what is behind"
            )
        return "; ".join(dict.fromkeys(advice))


@functools.lru_cache(maxsize=8192)
def _parsed(text: str) -> tuple[str, str, str, tuple[str, ...], str]:
    head, *factors = (item.strip() for item in text.split("*"))
    match = _pattern().fullmatch(head)
    if match is None:
        raise ValueError(
            f"cannot read {text!r}: expected KIND of|in|behind|ahead of PLACE [* FACTOR ...]; kinds are "
            f"{', '.join(KINDS)}"
        )
    for text_of_factor in factors:
        factor(text_of_factor)
    return match["kind"], match["relation"], match["place"], tuple(factors), match["origin"] or ""


@functools.cache
def _pattern() -> re.Pattern[str]:
    kinds = "|".join(re.escape(name) for name in sorted(KINDS, key=len, reverse=True))
    return re.compile(
        rf"(?P<kind>{kinds})(?: of (?P<origin>\S+))? (?P<relation>of|in|ahead of|behind) (?P<place>[^\s*]+)"
    )


def place_of_star(name: str) -> str:
    """The name of a star as the place of a change, which is one word."""
    return name.replace(" ", "_")


def patched(instrument: Instrument, terms: Iterable[Term]) -> Instrument:
    """The instrument with changes of some amplitudes; joint changes at one place are combined."""
    together: dict[tuple[Any, Hashable], list[Term]] = {}
    for change, size in terms:
        change.check_factors(instrument)
        kind, scaled = KINDS[change.kind], change.counted_in(instrument.units)
        together.setdefault((kind.patch, kind.together(scaled)), []).append((scaled, size))
    for (patch, _), changes_alike in together.items():
        instrument = patch(instrument, changes_alike)
    return instrument


def product(
    factors: Iterable[FactorLike], at: Any, units: Units, value: Callable[[str, Units], Any] | None = None
) -> Any:
    """Product of factors, 1 without any; `value` knows those with a text at `at` (`values_at`)."""
    value = value or (lambda text, units: factor(text).value(at, units))
    values = (value(item, units) if isinstance(item, str) else item(at) for item in factors)
    return functools.reduce(operator.mul, values, 1.0)


def with_factors(terms: Iterable[Term], at: Any) -> list[tuple[Change, Any]]:
    """The changes with amplitude × factors at `at`; a factor that several changes have is computed once."""
    value = values_at(at)
    return [(change, size * product(change.factors, at, change.units, value)) for change, size in terms]


def add(size: Scalar) -> Any:
    """Function that adds an amplitude to a number, or to an absent one."""
    return lambda value: size if value is None else value + size


# ---------------------------------------------------------------------------- quantities of factors


@dataclasses.dataclass(frozen=True)
class InTrain:
    """Quantities of a ray; `axis` (deg) is the angle of the moving element."""

    ray: Ray
    axis: Any

    def __getattr__(self, name: str) -> Any:
        if name in GROWING:
            return self.ray.conditions.smooth(name)
        return getattr(self.ray if name in ("x", "y", "wavelength") else self.ray.conditions, name)

    def angle(self, prefix: str) -> Any:
        """Angle of the element itself, the only one in the optics (`Grows`)."""
        return jnp.deg2rad(self.axis)


@dataclasses.dataclass(frozen=True)
class AtPoint:
    """A field point alone: requests for other quantities are errors."""

    x: Any
    y: Any

    def __getattr__(self, name: str) -> Any:
        raise NotPlannedError(name)


@dataclasses.dataclass(frozen=True)
class InExposures:
    """A list of exposures at a field point."""

    exposures: ExposureArrays
    x: Any = 0.0
    y: Any = 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.exposures, name)

    @property
    def number(self) -> Any:
        """Positions (e) of the exposures in the list."""
        return np.arange(len(self.exposures.hours))

    def angle(self, prefix: str) -> Any:
        """Angle (rad) of the polariser or of another moving element; NaN where it is out."""
        angle = self.exposures.clp_angle
        if prefix == POLARISER:
            xp = np if isinstance(angle, np.ndarray) else jnp
            return xp.where(self.exposures.clp_in, angle, np.nan)
        return self.exposures.moving.get(prefix, np.full(angle.shape, np.nan))


def in_exposures(change: Change, exposures: ExposureArrays, x: Any = 0.0, y: Any = 0.0) -> Float[Array, " e"]:
    """The factor of a change in every exposure, 0 where its condition is unknown."""
    return jnp.nan_to_num(change.factor(InExposures(exposures, x, y))) * jnp.ones(exposures.hours.shape[0])
