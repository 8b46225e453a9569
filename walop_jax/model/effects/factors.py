"""Factors of changes: field, wavelength, time, temperature, counts, or the angle of an element.

A factor has a `text` as typed, a `value`, `words`, the observation that would `test` it (empty: none of its own) and
the quantity that it `depends_on`: FIELD, WAVELENGTH, EXPOSURE, COUNTS, or SHAPE (of the change itself). `factor` alone
reads the texts.

The argument of a value has x, y (deg), wavelength (µm), hours since the first exposure, hour_angle
(h), temperature (Celsius), exposure time (s), the number of the exposure in its list, `of_kind(name)`, true for
exposures of a KIND, and `angle(prefix)` (rad) of the polariser or another moving element, NaN where that is out of the
beam; all are scalars, or arrays that broadcast. The second argument holds the scales of field and wavelength.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from walop_jax.model import legendre
from walop_jax.model.conventions import Units
from walop_jax.model.materials import REFERENCE_TEMPERATURE
from walop_jax.model.parameters import unknown_name
from walop_jax.sky.nights import GAP

LARGEST_SQUARE = 2.0  # of the field radius, in units of the scale of the field: the corners
FIELD, WAVELENGTH, EXPOSURE, COUNTS, SHAPE = "field", "wavelength", "exposure", "counts", "shape"
MORE_POINTS = "more field points along that direction; dither: an error of the optics stays where it is"
ONCE_MORE = "the same exposures once more"
FIELD_UNIT, WAVE = "{field}", "{wavelength}"  # scales of an instrument in words
AT = f"(amplitude at {FIELD_UNIT}°)"
NUMBER = r"(-?\d*\.?\d+|-?\d+\.)"


@dataclasses.dataclass(frozen=True)
class Factor:
    """One factor; `form` is the first word of a text with numbers or names, `given` holds these."""

    text: str
    depends_on: str
    words: str
    test: str
    value: Callable[[Any, Units], Any]
    form: str = ""
    given: tuple[str, ...] = ()

    def in_words(self, units: Units) -> str:
        """Its words, with the scales of an instrument."""
        return self.words.replace(FIELD_UNIT, f"{units.field:g}").replace(WAVE, f"{units.wavelength:g}")


# ------------------------------------------------------------------------------- with numbers or names in them


def _ring(degree: str) -> Factor:
    """Legendre polynomial of some degree in (X² + Y²)/h² − 1, h the scale of the field."""

    def value(at: Any, units: Units) -> Any:
        square = (at.x**2 + at.y**2) / units.field**2
        return legendre.polynomial(int(degree), 2.0 * square / LARGEST_SQUARE - 1.0)

    words = f"in rings over the field (Legendre polynomial {degree} of the radius squared)"
    return Factor(f"ring {degree}", FIELD, words, MORE_POINTS, value, "ring", (degree,))


def _harmonic(wave: str, order: str, prefix: str) -> Factor:
    """Cosine or sine of a multiple of the angle of a moving element, by the prefix of its columns."""

    def value(at: Any, _: Units) -> Any:
        angle = at.angle(prefix)
        return getattr(np if isinstance(angle, np.ndarray) else jnp, wave)(int(order) * angle)

    words = f"as the {'cosine' if wave == 'cos' else 'sine'} of {order} × the angle of {prefix}"
    test = "a full turn at more angles in random order, then with the element mounted turned by 90°"
    return Factor(f"{wave} {order} {prefix}", EXPOSURE, words, test, value, wave, (order, prefix))


def _span(start: str, stop: str) -> Factor:
    """1 from one time to another (hours since the first exposure), 0 elsewhere."""
    return Factor(
        f"hours {start} to {stop}", EXPOSURE, f"from {start} to {stop} h after the first exposure", ONCE_MORE,
        lambda at, _: ((at.hours >= float(start)) & (at.hours < float(stop))) * 1.0, "hours", (start, stop),
    )  # fmt: skip


def _exposure(number: str) -> Factor:
    """1 in one exposure of the list, counted from 0; 0 in all others."""
    return Factor(
        f"exposure {number}", EXPOSURE, f"in exposure {number} of the list (the first is 0)", ONCE_MORE,
        lambda at, _: (at.number == int(number)) * 1.0, "exposure", (number,),
    )  # fmt: skip


def _kind(name: str) -> Factor:
    """1 in exposures of a KIND, 0 in all others."""
    return Factor(
        f"kind {name}", EXPOSURE, f"in exposures of KIND {name}", "the same field points in exposures of another KIND",
        lambda at, _: at.of_kind(name) * 1.0, "kind", (name,),
    )  # fmt: skip


def _side(prefix: str) -> Factor:
    """1 where a moving element came from smaller angles, −1 where from larger ones, 0 where it did not move."""

    def value(at: Any, _: Units) -> Any:
        angle = at.angle(prefix)
        xp: Any = np if isinstance(angle, np.ndarray) else jnp
        hours = xp.broadcast_to(at.hours, angle.shape)
        order = xp.argsort(hours, axis=-1)
        turned = xp.diff(xp.take_along_axis(angle, order, axis=-1), axis=-1)
        side = xp.sign(xp.sin(xp.where(xp.abs(turned) > 1e-9, turned, 0.0)))
        first = xp.zeros_like(angle[..., :1])
        return xp.take_along_axis(xp.concatenate([first, side], axis=-1), xp.argsort(order, axis=-1), axis=-1)

    words = f"with the side from which {prefix} came (1: from smaller angles)"
    test = "each angle once more, reached from the other side"
    return Factor(f"side {prefix}", EXPOSURE, words, test, value, "side", (prefix,))


def _since_evening(at: Any, _: Units) -> Any:
    """Hours since the first exposure of its night, nights being `GAP` hours apart."""
    xp: Any = np if isinstance(at.hours, np.ndarray) else jnp
    order = xp.argsort(at.hours, axis=-1)
    hours = xp.take_along_axis(at.hours, order, axis=-1)
    first = xp.diff(hours, axis=-1, prepend=hours[..., :1] - 2.0 * GAP) > GAP
    since = hours - xp.maximum.accumulate(xp.where(first, hours, -xp.inf), axis=-1)
    return xp.take_along_axis(since, xp.argsort(order, axis=-1), axis=-1)


def _gap(thickness: str) -> Factor:
    """Thickness (µm) of the air of a change by fringes: 1, as the fringes depend on it themselves."""
    words = f"of {thickness} µm of air (amplitude at a maximum)"
    return Factor(f"gap {thickness}", SHAPE, words, "", lambda at, _: 1.0, "gap", (thickness,))


FORMS: Mapping[str, tuple[str, Callable[..., Factor]]] = {
    "ring N": (r"ring (\d+)", _ring),
    "cos N PREFIX, sin N PREFIX": (r"(cos|sin) (\d+) (\S+)", _harmonic),
    "hours A to B": (rf"hours {NUMBER} to {NUMBER}", _span),
    "exposure N": (r"exposure (\d+)", _exposure),
    "kind KIND": (r"kind (\S+)", _kind),
    "side PREFIX": (r"side (\S+)", _side),
    "gap N": (rf"gap (?!-){NUMBER}", _gap),
}
"""Factors with numbers or names, by their form in messages: pattern of the text, and constructor."""


# ------------------------------------------------------------------------------------------------------ plain ones


PLAIN: Mapping[str, Factor] = {
    item.text: item
    for item in (
        Factor("x", FIELD, f"growing with X {AT}", MORE_POINTS, lambda at, units: at.x / units.field),
        Factor("y", FIELD, f"growing with Y {AT}", MORE_POINTS, lambda at, units: at.y / units.field),
        Factor(
            "r2", FIELD, f"growing with the field radius squared {AT}", MORE_POINTS,
            lambda at, units: (at.x**2 + at.y**2) / units.field**2,
        ),
        Factor(
            "x2-y2", FIELD, f"as X² − Y² over the field {AT}", MORE_POINTS,
            lambda at, units: (at.x**2 - at.y**2) / units.field**2,
        ),
        Factor(
            "xy", FIELD, f"as 2XY over the field {AT}", MORE_POINTS,
            lambda at, units: 2.0 * at.x * at.y / units.field**2,
        ),
        Factor(
            "colour", WAVELENGTH, f"growing with wavelength (per unit of λ/{WAVE} µm − 1)",
            "narrow bands, or another filter", lambda at, units: at.wavelength / units.wavelength - 1.0,
        ),
        Factor(
            "hours", EXPOSURE, "growing with time (per hour since the first exposure)",
            "the same exposures in another order, or once more hours later", lambda at, _: at.hours,
        ),
        Factor(
            "hour angle", EXPOSURE, "growing with the hour angle (per hour)",
            "the same exposures at other hour angles, in another order", lambda at, _: at.hour_angle,
        ),
        Factor(
            "kelvin", EXPOSURE, "growing with temperature (per kelvin above 10 °C)",
            "the same exposures at another temperature", lambda at, _: at.temperature - REFERENCE_TEMPERATURE,
        ),
        Factor(
            "per EXPTIME", EXPOSURE, "falling with the exposure time (per 1/s)",
            "the same exposures with other exposure times",
            lambda at, _: 1.0 / np.where(at.exptime > 0, at.exptime, np.inf)
            if isinstance(at.exptime, np.ndarray)
            else 1.0 / jnp.where(at.exptime > 0, at.exptime, jnp.inf),
            "per EXPTIME",
        ),
        Factor(
            "order", EXPOSURE, "growing from exposure to exposure of the list", ONCE_MORE,
            lambda at, _: 1.0 * at.number, "order",
        ),
        Factor(
            "night hours", EXPOSURE, "growing through every night (per hour since its first exposure)",
            "the same exposures of a night in another order", _since_evening, "night hours",
        ),
        Factor(
            # The detector multiplies with its own counts.
            "counts", COUNTS, "growing with the counts (at 10⁶ electrons)", "the same exposures at another flux",
            lambda at, _: 1.0,
        ),
    )
}  # fmt: skip
"""Factors without a number of their own, by text."""


@functools.cache
def factor(text: str) -> Factor:
    """The factor of a text. Raises ValueError, with the nearest ones, for an unknown text."""
    if text in PLAIN:
        return PLAIN[text]
    for pattern, make in FORMS.values():
        if match := re.fullmatch(pattern, text):
            return make(*match.groups())
    raise unknown_name("factor", text, (*PLAIN, *FORMS))
