"""The joint fit of calibration sets: from files to the folder of a run, resumed where it was interrupted."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import write_product
from walop_jax.calibration.records import ResidualMap
from walop_jax.calibration.residual_map import residual_map
from walop_jax.calibration.summary import FAILED, PARTIAL, PRODUCT, SUMMARY, summary
from walop_jax.diagnosis.trust import examined
from walop_jax.fit.misfit import Misfit, describe
from walop_jax.fit.refit import FitResult, refit
from walop_jax.io.atomic import atomic_path
from walop_jax.io.folder import OutputFolder, output_folder
from walop_jax.io.heartbeat import repeated
from walop_jax.io.temporary import remove
from walop_jax.io.text import json_text, read_text
from walop_jax.likelihood.processes import Processes
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.runs.inputs import sets_and_model

OUTPUTS = (PRODUCT, SUMMARY)


@dataclasses.dataclass(frozen=True)
class RefitRun:
    """A fit, the content of `summary.json`, and what was made of it.

    `residuals` is the map of what the model leaves, of large sets whose fit has converged; `misfit` says where model
    and data disagree, where they do. `seconds` is the time from start to end.
    """

    result: FitResult
    summary: dict[str, Any]
    residuals: ResidualMap | None
    misfit: Misfit | None
    seconds: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to bear in mind, in sentences."""
        return (*self.result.warnings, *(() if self.misfit is None else self.misfit.sentences()))


def refit_sets(
    calsets: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    model: str | os.PathLike[str] | None = None,
    instrument: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    memory: float | None = None,
    processes: Processes | None = None,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> RefitRun:
    """Fit all field points of calibration sets jointly, and write the folder `output`.

    A fit that has converged leaves `calibration.fits` and `summary.json` there, one that has not
    `summary.failed.json` alone. `instrument` is a shipped one by name or a description file (default: what the sets
    say), `model` a TOML file (default: the base model); `catalogue` are the
    effects that a model may have. `progress` is told in a line what is being done. Of large sets: `memory` (bytes)
    is what their data may take; finished parts are kept in `output`/partial until the end, and the same call goes
    on from them; `processes` share the work (`likelihood.processes.join`), each making this call, and the first one
    writes.

    Raises `DataError` for files that cannot be read or written, ValueError for a model file that does not fit, and
    what `refit` raises.
    """
    began = time.perf_counter()
    tell = progress or (lambda text: None)
    first = processes is None or processes.index == 0
    text = "" if model is None else read_text(model)
    # Of several processes the first one writes; it alone holds the folder.
    with output_folder(output, OUTPUTS, overwrite=overwrite) if first else contextlib.nullcontext() as out:
        tell("reading")
        calset, chosen = sets_and_model(calsets, text, model, instrument, catalogue)
        with repeated(tell) as say:
            partial = Path(output) / PARTIAL
            fitted = refit(calset, chosen, folder=partial, progress=say, memory=memory, processes=processes)
            result = examined(fitted)
        residuals = residual_map(result) if result.likelihood.layout.large and result.converged else None
        misfit = describe(result) if first and not result.explains_data else None
        seconds = time.perf_counter() - began
        found = summary(result, seconds=seconds, misfit=misfit, residuals=residuals) | {"seed": None}
        if out is not None:
            tell("mapping the field")
            _write(out, result, residuals, found)
    return RefitRun(result, found, residuals, misfit, seconds)


def _write(
    out: OutputFolder, result: FitResult, residuals: ResidualMap | None, found: dict[str, Any]
) -> None:
    """The files of a run; what was kept of the fit on the way goes."""
    if result.converged:
        product = Calibration.from_fit(result, residuals).to_product()
        with out.filled(drop=(FAILED, PARTIAL)) as folder:
            write_product(folder / PRODUCT, product)
            (folder / SUMMARY).write_text(json_text(found), encoding="utf-8")
        return
    out.path.mkdir(exist_ok=True)
    with atomic_path(out.path / FAILED, overwrite=True) as temporary:
        temporary.write_text(json_text(found), encoding="utf-8")
    remove(out.path / PARTIAL)
