"""What a set can show, in words and rows for a page."""

from __future__ import annotations

from typing import Any

from walop_jax.diagnosis.limits_found import DetectionLimits


def limits_in_words(found: DetectionLimits | None) -> dict[str, Any] | None:
    """The protection level as a sentence (empty where no exposure gives q and u), and rows of the amplitudes."""
    if found is None:
        return None
    level = found.protection_in_words()
    names = ("amplitude", "detected", "named", "unit", "error", "taken_for")
    return {
        "level": f"{level[:1].upper()}{level[1:]}." if level else "",
        "rows": [dict(zip(names, row, strict=True)) for row in found.display().rows],
        "untestable": found.untestable,
    }
