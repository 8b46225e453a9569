"""How results say that effects of a model had to be left out of them."""

from __future__ import annotations

import os
from collections.abc import Sequence

from walop_jax.calibration.records import in_ascii

KEY = "not_carried_over"
"""Where results in JSON list the effects."""


def left_out_sentences(names: Sequence[str], source: str | os.PathLike[str] | None = None) -> tuple[str, ...]:
    """A sentence for every effect; `source` is the file that the model comes from."""
    where = "" if source is None else f"{os.fspath(source)}: "
    return tuple(
        f"{where}{name} acts on single exposures of the calibration, which cannot be carried over; it is left out"
        for name in names
    )


def left_out_cards(names: Sequence[str]) -> dict[str, str]:
    """The card NOTCARR of a table, which lists the effects; none where all are in it."""
    return {"NOTCARR": in_ascii(", ".join(names))} if names else {}
