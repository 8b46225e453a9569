"""Factors of changes: field, wavelength, time, temperature, counts, or the angle of an element.

A factor has a `text` as typed, a `value`, `words`, the observation that would `test` it (empty: none of its own) and
the quantity that it `depends_on`: FIELD, WAVELENGTH, EXPOSURE, COUNTS, or SHAPE (of the change itself). `factor` alone
reads the texts.

The argument of a value has x, y (deg), wavelength (µm), hours since the first exposure, hour_angle
(h), temperature (Celsius), exposure time (s), the number of the exposure in its list, `of_kind(name)`, true for
exposures of a KIND, `between(start, stop)`, true for those of an interval of hours, and `angle(prefix)` (rad) of the
polariser or another moving element, NaN where that is out of the beam; all are scalars, or arrays that broadcast. The
second argument holds the scales of field and wavelength.
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
    """One factor of a change, such as `hours` or `cos 2 CLP`.

    `form` is the first word of a text with numbers or names, and `given` holds these numbers and names.
    """

    text: str
    depends_on: str
    words: str
    test: str
    value: Callable[[Any, Units], Any]
    form: str = ""
    given: tuple[str, ...] = ()

    def in_words(self, units: Units) -> str:
        """The words of the factor, with the scales of an instrument."""
        return self.words.replace(FIELD_UNIT, f"{units.field:g}").replace(WAVE, f"{units.wavelength:g}")


# ------------------------------------------------------------------------------- with numbers or names in them


def _ring(at: Any, units: Units, degree: str) -> Any:
    """Legendre polynomial of some degree in (X² + Y²)/h² − 1, h the scale of the field."""
    square = (at.x**2 + at.y**2) / units.field**2
    return legendre.polynomial(int(degree), 2.0 * square / LARGEST_SQUARE - 1.0)


def _smooth(at: Any, units: Units, i: str, j: str) -> Any:
    """The term P_i(X/h) P_j(Y/h) of a smooth field, times its standard deviation beforehand (`smooth_deviations`)."""
    of_x, of_y = (legendre.polynomial(int(degree), t / units.field) for degree, t in ((i, at.x), (j, at.y)))
    return _term(i, j, of_x, of_y)


def _term(i: str, j: str, of_x: Any, of_y: Any) -> Any:
    return smooth_deviations()[int(i)] * smooth_deviations()[int(j)] * of_x * of_y


def _wave(at: Any, _: Units, wave: str, order: str, prefix: str) -> Any:
    """Cosine or sine of a multiple of the angle of a moving element, by the prefix of its columns."""
    angle = at.angle(prefix)
    return getattr(np if isinstance(angle, np.ndarray) else jnp, wave)(int(order) * angle)


def _side(at: Any, _: Units, prefix: str) -> Any:
    """1 where a moving element came from smaller angles, −1 where it came from larger ones, 0 where it did not move."""
    angle = at.angle(prefix)
    xp: Any = np if isinstance(angle, np.ndarray) else jnp
    hours = xp.broadcast_to(at.hours, angle.shape)
    order = xp.argsort(hours, axis=-1)
    turned = xp.diff(xp.take_along_axis(angle, order, axis=-1), axis=-1)
    side = xp.sign(xp.sin(xp.where(xp.abs(turned) > 1e-9, turned, 0.0)))
    first = xp.zeros_like(angle[..., :1])
    return xp.take_along_axis(xp.concatenate([first, side], axis=-1), xp.argsort(order, axis=-1), axis=-1)


SMOOTH_DEGREE, FINEST_DEGREE = 6, 8
"""Largest total degrees of the terms of a smooth field: of changes of the optics, and of cameras."""
SMOOTH_LENGTH = 0.5
"""Length over which a smooth field changes, in units of the scale of the field."""


@functools.cache
def smooth_deviations() -> tuple[float, ...]:
    """Standard deviations of the coefficients of P_0 … P_8 along one axis of a Gaussian process of variance 1.

    Equation    s_i² = ((2i + 1)/2)² ∫∫ P_i(t) P_i(u) exp(−(t − u)²/2ℓ²) dt du, t and u from −1 to 1
    Symbols     ℓ `SMOOTH_LENGTH`; the process over the field has the kernel exp(−|Δ|²/2ℓ²), so that the term i, j has
                the standard deviation s_i s_j
    Limits      correlations of coefficients whose degrees differ by 2, 4 … are left out
    Source      Rasmussen & Williams 2006, Gaussian Processes for Machine Learning, ch. 4.3 (expansion of a kernel)
    """
    nodes, weights = np.polynomial.legendre.leggauss(64)
    kernel = np.exp(-0.5 * ((nodes[:, None] - nodes) / SMOOTH_LENGTH) ** 2)
    values = np.polynomial.legendre.legvander(nodes, FINEST_DEGREE) * weights[:, None]
    variances = np.einsum("ti,tu,ui->i", values, kernel, values) * (np.arange(FINEST_DEGREE + 1) + 0.5) ** 2
    return tuple(np.sqrt(variances).tolist())


FORMS: Mapping[str, tuple[str, str, str, str, Callable[..., Any]]] = {
    "ring N": (
        r"ring (\d+)", FIELD, "in rings over the field (Legendre polynomial {0} of the radius squared)", MORE_POINTS,
        _ring,
    ),
    "field I J": (
        r"field (\d+) (\d+)", FIELD, "in a smooth field (term {0}, {1})", MORE_POINTS, _smooth,
    ),
    "cos N PREFIX, sin N PREFIX": (
        r"(cos|sin) (\d+) (\S+)", EXPOSURE, "as the {0} of {1} × the angle of {2}",
        "a full turn at more angles in random order, then with the element mounted turned by 90°", _wave,
    ),
    "hours A to B": (
        rf"hours {NUMBER} to {NUMBER}", EXPOSURE, "from {0} to {1} h after the first exposure", ONCE_MORE,
        lambda at, _, start, stop: at.between(start, stop) * 1.0,
    ),
    "exposure N": (
        r"exposure (\d+)", EXPOSURE, "in exposure {0} of the list (the first is 0)", ONCE_MORE,
        lambda at, _, number: (at.number == int(number)) * 1.0,
    ),
    "kind KIND": (
        r"kind (\S+)", EXPOSURE, "in exposures of KIND {0}", "the same field points in exposures of another KIND",
        lambda at, _, name: at.of_kind(name) * 1.0,
    ),
    "side PREFIX": (
        r"side (\S+)", EXPOSURE, "with the side from which {0} came (1: from smaller angles)",
        "each angle once more, reached from the other side", _side,
    ),
    # The fringes depend on the thickness of their air themselves.
    "gap N": (
        rf"gap (?!-){NUMBER}", SHAPE, "of {0} µm of air (amplitude at a maximum)", "", lambda at, _, thickness: 1.0
    ),
}  # fmt: skip
"""Factors with numbers or names, by their form in messages: pattern of the text, then all of a `Factor` but the text,
its words and its value as functions of these."""
_SPELT = {"cos": "cosine", "sin": "sine"}


# ------------------------------------------------------------------------------------------------------ plain ones


def _since_evening(at: Any, _: Units) -> Any:
    """Hours since the first exposure of its night, nights being `GAP` hours apart."""
    xp: Any = np if isinstance(at.hours, np.ndarray) else jnp
    order = xp.argsort(at.hours, axis=-1)
    hours = xp.take_along_axis(at.hours, order, axis=-1)
    first = xp.diff(hours, axis=-1, prepend=hours[..., :1] - 2.0 * GAP) > GAP
    since = hours - xp.maximum.accumulate(xp.where(first, hours, -xp.inf), axis=-1)
    return xp.take_along_axis(since, xp.argsort(order, axis=-1), axis=-1)


def _unity(at: Any, _: Units) -> float:
    """1: the detector multiplies with a power of its own counts."""
    return 1.0


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
        *(
            Factor(text, COUNTS, f"growing with {of} (at 10⁶ electrons)", "the same exposures at another flux", _unity)
            for text, of in (
                ("counts", "the counts"),
                ("root counts", "the root of the counts"),
                ("counts squared", "the square of the counts"),
            )
        ),
    )
}  # fmt: skip
"""Factors without a number of their own, by text."""


WIDE = 0.1  # of the mean wavelength: half the width of a broad band


def largest_factors(at: Any, units: Units) -> dict[str, float]:
    """Largest absolute values of the factors that grow with a condition of the exposures `at`, by text."""
    growing = (item for item in PLAIN.values() if item.depends_on == EXPOSURE)
    values = {item.text: np.nan_to_num(np.asarray(item.value(at, units), float)) for item in growing}
    largest = {text: float(np.abs(value).max(initial=0.0)) for text, value in values.items()}
    return {text: size for text, size in largest.items() if size > 0.0} | {"colour": WIDE}


@functools.cache
def factor(text: str) -> Factor:
    """The factor of a text. Raises ValueError, with the nearest ones, for an unknown text."""
    if text in PLAIN:
        return PLAIN[text]
    for pattern, depends_on, words, test, value in FORMS.values():
        if match := re.fullmatch(pattern, text):
            given = match.groups()
            words = words.format(*(_SPELT.get(item, item) for item in given))
            of_given = functools.partial(lambda value, given, *at: value(*at, *given), value, given)
            return Factor(text, depends_on, words, test, of_given, text.split()[0], given)
    raise unknown_name("factor", text, (*PLAIN, *FORMS))


def values_at(at: Any) -> Callable[[str, Units], Any]:
    """The values of factors at `at` by text, each computed once; terms of a smooth field share their polynomials."""

    @functools.cache
    def polynomials(units: Units) -> list[list[Any]]:
        return [legendre.polynomials(t / units.field, FINEST_DEGREE) for t in (at.x, at.y)]

    @functools.cache
    def value(text: str, units: Units) -> Any:
        item = factor(text)
        if item.form != "field":
            return item.value(at, units)
        of_x, of_y = polynomials(units)
        i, j = item.given
        return _term(i, j, of_x[int(i)], of_y[int(j)])

    return value
