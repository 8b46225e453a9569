"""What a model lacks to explain calibration sets: found, named and added, from files to the folder of a run."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import write_product
from walop_jax.calibration.summary import PRODUCT, SUMMARY, summary
from walop_jax.diagnosis.figure_data import figure_data
from walop_jax.diagnosis.figure_file import FIGURE_DATA, write_figure_data
from walop_jax.diagnosis.findings import DIAGNOSIS, Diagnosis, document
from walop_jax.diagnosis.workflow import MINUTES, diagnose
from walop_jax.fit.misfit import describe
from walop_jax.fit.model_file import render
from walop_jax.io.folder import output_folder
from walop_jax.io.heartbeat import repeated
from walop_jax.io.text import json_text, read_text
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.runs.inputs import sets_and_model

MODEL = "model.toml"
OUTPUTS = (PRODUCT, SUMMARY, DIAGNOSIS, FIGURE_DATA, MODEL)


@dataclasses.dataclass(frozen=True)
class DiagnosedRun:
    """A diagnosis, and the content of `diagnosis.json`."""

    diagnosis: Diagnosis
    document: dict[str, Any]


def diagnose_sets(
    calsets: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    model: str | os.PathLike[str] | None = None,
    instrument: str | os.PathLike[str] | None = None,
    seed: int | None = None,
    minutes: float = MINUTES,
    overwrite: bool = False,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> DiagnosedRun:
    """Find what is missing from the model of calibration sets, add it, fit again, and write the folder `output`.

    `calibration.fits` and `summary.json` are of the extended model, `diagnosis.json` is what was found,
    `diagnosis.fits` what figures of it need, and `model.toml` the extended model for other commands: all of them
    appear, or none. `instrument` is a shipped one by name or a description file (default: what the sets say),
    `model` a TOML file (default: the base model); `seed` (None: 0) is that of the Monte Carlo. `catalogue` are the
    effects that a model may have. No name is tried for after `minutes`. `progress` is told what is being done, at
    least every `heartbeat.EVERY` seconds.

    Raises `DataError` for files that cannot be read or written, ValueError for a model file that does not fit, and
    what `diagnose` raises.
    """
    began = time.perf_counter()
    tell = progress or (lambda text: None)
    text = "" if model is None else read_text(model)
    with output_folder(output, OUTPUTS, overwrite=overwrite) as out:
        tell("reading")
        calset, chosen = sets_and_model(calsets, text, model, instrument, catalogue)
        with repeated(tell) as say:
            found = diagnose(
                calset, chosen, catalogue=catalogue, seed=seed or 0, minutes=minutes, progress=say
            )
        tell("mapping the field")
        after = found.after
        product = Calibration.from_fit(after).to_product()
        misfit = None if after.explains_data else describe(after)
        content = document(found)
        fitted = summary(after, seconds=time.perf_counter() - began, misfit=misfit) | {"seed": seed}
        drawn_from = figure_data(found)
        with out.filled() as folder:
            write_product(folder / PRODUCT, product)
            (folder / SUMMARY).write_text(json_text(fitted), encoding="utf-8")
            (folder / DIAGNOSIS).write_text(json_text(content), encoding="utf-8")
            write_figure_data(folder / FIGURE_DATA, drawn_from)
            (folder / MODEL).write_text(render(after.model), encoding="utf-8")
    return DiagnosedRun(found, content)
