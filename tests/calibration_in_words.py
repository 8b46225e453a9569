"""Calibrations as a file holds them: parameters by name, texts and maps, without an instrument that could be asked."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from walop_jax.calibration.calibration import Calibration, UnavailableInstrument, Written
from walop_jax.calibration.matrix import MatrixMaps
from walop_jax.model.parameters import Parameter
from walop_jax.model.specification import Model

TEXTS = ("maps", "model_lines", "description")


def in_words(
    *,
    instrument: str,
    parameters: Sequence[Parameter],
    maps: MatrixMaps,
    model_lines: tuple[str, ...] = ("[model]",),
    description: tuple[str, ...] = (),
    **contents: Any,
) -> Calibration:
    """A calibration whose model is a list of parameters."""
    template = UnavailableInstrument.because(ValueError("typed by hand"))
    model = Model(instrument, template, tuple(parameters), ())
    return Calibration(model=model, written=Written(maps, model_lines, description), **contents)


def changed(calibration: Calibration, **changes: Any) -> Calibration:
    """The same with other contents; maps and texts that are not changed stay."""
    return in_words(**(contents(calibration) | changes))


def contents(calibration: Calibration) -> Mapping[str, Any]:
    """All that its file holds, and where it was read from."""
    fields = (f.name for f in dataclasses.fields(calibration) if f.name != "model")
    names = ("instrument", "parameters", *TEXTS, *fields)
    return {name: getattr(calibration, name) for name in names}
