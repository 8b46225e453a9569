"""What calibration sets can show: the sizes at which effects are detected and named, and what goes unnoticed."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

from walop_jax.diagnosis.detection_limits import detection_limits
from walop_jax.diagnosis.limits_found import DetectionLimits
from walop_jax.diagnosis.trust import examined
from walop_jax.fit.refit import refit
from walop_jax.io.folder import output_folder
from walop_jax.io.text import json_text, read_text
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.reports.limits_figures import protection_figure, separation_figure
from walop_jax.reports.run import LIMITS
from walop_jax.runs.inputs import model_of, sets_and_model
from walop_jax.simulation.plan_file import is_plan, read_plan
from walop_jax.simulation.simulate import as_planned

PROTECTION, SEPARATION = "limits_protection.png", "limits_separation.png"
OUTPUTS = (LIMITS, PROTECTION, SEPARATION)


@dataclasses.dataclass(frozen=True)
class LimitsRun:
    """The limits of a set, the content of `limits.json`, and what to bear in mind."""

    found: DetectionLimits
    document: dict[str, Any]
    warnings: tuple[str, ...]


def limits_of_sets(
    calsets: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str] | None = None,
    *,
    model: str | os.PathLike[str] | None = None,
    instrument: str | os.PathLike[str] | None = None,
    seed: int | None = None,
    overwrite: bool = False,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> LimitsRun:
    """Fit calibration sets and find what they can show; write the folder `output`, if given.

    In place of sets a single observing plan will do (`plan_file`): its counts without noise, the instrument as
    designed. `instrument` is a shipped one by name or a
    description file (default: what the sets say), `model` a TOML file (default: the base model); `seed` (None: 0) is
    that of the Monte Carlo. `catalogue` are the effects that are looked at. `progress` is told what is being done.

    Raises `DataError` for files that cannot be read or written, ValueError for a model file that does not fit and a fit
    that does not converge, and what `refit` raises.
    """
    tell = progress or (lambda text: None)
    text = "" if model is None else read_text(model)
    reserved = None if output is None else output_folder(output, OUTPUTS, overwrite=overwrite)
    with contextlib.nullcontext() if reserved is None else reserved as out:
        tell("reading")
        plan = read_plan(calsets[0], instrument) if len(calsets) == 1 and is_plan(calsets[0]) else None
        if plan is not None:
            calset = as_planned(plan)
            chosen = model_of(calset, text, model, instrument, catalogue)
        else:
            calset, chosen = sets_and_model(calsets, text, model, instrument, catalogue)
        result = examined(refit(calset, chosen, progress=tell))
        if not result.converged:
            raise ValueError(f"the fit did not converge ({result.minimum.message})")
        found = detection_limits(result, catalogue=catalogue, seed=seed or 0, progress=tell)
        document = found.document() | {
            "instrument": result.model.name,
            "effects_of_the_model": list(result.model.effect_names),
            "inputs": [{"path": str(entry.path), "sha256": entry.sha256} for entry in calset.inputs],
            "plan": None if plan is None else plan.document(),
            "trusted": result.trusted,
            "seed": seed,
        }
        if out is not None:
            with out.filled() as folder:
                (folder / LIMITS).write_text(json_text(document), encoding="utf-8")
                protection_figure(found).savefig(folder / PROTECTION, dpi=130)
                separation_figure(found).savefig(folder / SEPARATION, dpi=130)
    return LimitsRun(found, document, tuple(f"the fit: {text}" for text in result.warnings))
