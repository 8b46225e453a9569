"""What every run of a fit begins with: its sets, and the model to fit to them."""

from __future__ import annotations

import os
from collections.abc import Sequence

from walop_jax.data import read_calibration_set
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.model_builder import model_for
from walop_jax.io.errors import errors_naming
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.specification import Model


def sets_and_model(
    calsets: Sequence[str | os.PathLike[str]],
    text: str,
    model: str | os.PathLike[str] | None,
    instrument: str | os.PathLike[str] | None,
    catalogue: Sequence[type[Effect]] = EFFECTS,
) -> tuple[CalibrationSet, Model]:
    """Read calibration sets, and make the model that `text`, the content of the file `model`, asks for.

    `instrument` is a shipped one by name or a description file (None: what the sets say); `catalogue` are the
    effects that `text` may name. Raises `DataError` for files that cannot be read, and ValueError, naming the file,
    for a model that does not fit.
    """
    calset = read_calibration_set(*calsets)
    return calset, model_of(calset, text, model, instrument, catalogue)


def model_of(
    calset: CalibrationSet,
    text: str,
    model: str | os.PathLike[str] | None,
    instrument: str | os.PathLike[str] | None,
    catalogue: Sequence[type[Effect]] = EFFECTS,
) -> Model:
    """The model that `text` asks for, for a set that has been read; arguments and errors as above."""
    design = None if instrument is None else Instrument.read(instrument)
    with errors_naming(model):
        return model_for(calset, text, design, catalogue)
