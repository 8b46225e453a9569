"""Numbers with errors as text: two digits of the error, and the value to match. The same everywhere."""

from __future__ import annotations

import math

_MOST_PLACES = 8
_WRITTEN_OUT = 1e7
_TINY = 1e-15  # probabilities below are not to be taken at their word
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def with_error(value: float, sigma: float) -> str:
    """Value and error, two digits of the error: 0.23227 ± 0.00024."""
    return " ± ".join(value_and_error(value, sigma)) if sigma > 0 else value_and_error(value, sigma)[0]


def value_and_error(value: float | str | None, sigma: float | None) -> tuple[str, str]:
    """Value and error as two texts, both to the second digit of the error; the error is empty where there is none."""
    if isinstance(value, str):
        return value, ""
    if value is None or not math.isfinite(value):
        return "–", ""
    if sigma is None or not 0 < sigma < math.inf:
        return with_minus_sign(f"{value:.7g}"), ""
    # Rounded first: 0.0996 has its second digit where 0.10 has it.
    places = 1 - math.floor(math.log10(float(f"{sigma:.1e}")))
    if places > _MOST_PLACES:
        more = max(0, places + math.floor(math.log10(abs(value) or sigma)))
        return with_minus_sign(f"{value:.{more}e}"), with_minus_sign(f"{sigma:.1e}")
    shown = max(0, places)
    return with_minus_sign(f"{round(value, places) + 0.0:.{shown}f}"), f"{round(sigma, places):.{shown}f}"


def with_minus_sign(text: str) -> str:
    """A number with a true minus sign."""
    return text.replace("-", "−")


def rounded(value: float | None, form: str = ".4g") -> str:
    """A number, or a dash where there is none; powers of ten only beyond 10⁷ and below 10⁻⁴."""
    if value is None or not math.isfinite(value):
        return "–"
    text = format(value, form)
    if "e+" in text and abs(value) < _WRITTEN_OUT:
        text = f"{float(text):.0f}"
    return with_minus_sign(text.removesuffix("."))


def two_digits(value: float | None) -> str:
    """A number to two digits, zeros included: 0.40, 2.0, 120."""
    return rounded(value, "#.2g")


def two_digits_range(low: float, high: float) -> str:
    """A range to two digits, or one number where its ends are nearly the same; empty where there is none."""
    if not math.isfinite(low):
        return ""
    return two_digits(low) if high < 1.05 * low else f"{two_digits(low)} … {two_digits(high)}"


def probability(p: float | None) -> str:
    """`= 0.43`, `= 2.1 × 10⁻⁷` or `< 10⁻¹⁵`."""
    if p is None or not math.isfinite(p):
        return "unknown"
    if p < _TINY:
        return f"< {_power(_TINY)}"
    if p >= 1e-3:
        return f"= {p:.2g}"
    mantissa, exponent = f"{p:.1e}".split("e")
    return f"= {mantissa} × 10{str(int(exponent)).translate(RAISED)}"


def _power(value: float) -> str:
    return "10" + str(round(math.log10(value))).translate(RAISED)
