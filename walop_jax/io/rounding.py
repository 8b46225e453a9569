"""Numbers with errors as text: two digits of the error, and the value to match. The same everywhere."""

from __future__ import annotations

import math

_MOST_PLACES = 8


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
    """A number, or a dash where there is none."""
    return "–" if value is None or not math.isfinite(value) else with_minus_sign(format(value, form))
