"""The model of an instrument, or that for calibration sets, as a file to look at and to change."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from walop_jax.data import read_calibration_set
from walop_jax.fit.model_builder import effects_text, model_for, model_without_data
from walop_jax.fit.model_file import render
from walop_jax.io.atomic import atomic_path, check_output
from walop_jax.model.build import nominal_instrument
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.specification import Model


@dataclasses.dataclass(frozen=True)
class ModelFile:
    """A model, its TOML text, and the file that it was written to (None: to no file)."""

    model: Model
    text: str
    path: Path | None

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "instrument": self.model.name,
            "effects": list(self.model.effect_names),
            "output": None if self.path is None else str(self.path),
            "parameters": {
                p.name: {
                    "start": p.start,
                    "unit": p.unit,
                    "prior": None if p.prior is None else list(p.prior),
                    "free": p.free,
                    "tie": p.tie,
                    "about": p.about,
                }
                for p in self.model.parameters
            },
        }


def write_model(
    output: str | os.PathLike[str] | None = None,
    calsets: Sequence[str | os.PathLike[str]] = (),
    *,
    instrument: str | os.PathLike[str] | None = None,
    effects: Sequence[str] = (),
    catalogue: Sequence[type[Effect]] = EFFECTS,
    overwrite: bool = False,
) -> ModelFile:
    """The base model with `effects` of `catalogue` added by name, for `calsets` or else for `instrument` (a shipped
    one by name or a description file; None: the first of the family).

    It is written as `output`, if that is given. Raises `DataError` for files that cannot be read or written, and
    ValueError, with the nearest names, for an unknown instrument or effect, and for an instrument that is not the
    sets'.
    """
    if output is not None:
        check_output(output, overwrite=overwrite)
    changes = effects_text(effects)
    design = Instrument.read(instrument) if instrument is not None else None
    if calsets:
        model = model_for(read_calibration_set(*calsets), changes, design, catalogue)
    else:
        model = model_without_data(design or nominal_instrument(), changes, catalogue=catalogue)
    text = render(model)
    if output is not None:
        with atomic_path(output, overwrite=overwrite) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return ModelFile(model, text, None if output is None else Path(output))
