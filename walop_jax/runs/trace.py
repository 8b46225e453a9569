"""The light of one source through an instrument: as designed, or as fitted, from the file of its calibration."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

from walop_jax.calibration.from_file import read_calibration
from walop_jax.data.filters import builtin_filter
from walop_jax.model.build import nominal_instrument
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.trace import Sightline, Stage, trace
from walop_jax.runs.left_out import KEY, left_out_sentences


@dataclasses.dataclass(frozen=True)
class TracedSource:
    """The light at every stage; `not_carried_over` names effects of the model that are not in it."""

    stages: tuple[Stage, ...]
    not_carried_over: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """Everything but the warnings as plain data."""
        stages = [
            {
                "stage": stage.name,
                "about": stage.about,
                "rows": stage.rows,
                "columns": stage.columns,
                "value": stage.value.tolist(),
            }
            for stage in self.stages
        ]
        return {"stages": stages, KEY: list(self.not_carried_over)}


def trace_source(
    sightline: Sightline,
    product: str | os.PathLike[str] | None = None,
    *,
    instrument: str | os.PathLike[str] | None = None,
    catalogue: Sequence[type[Effect]] = EFFECTS,
) -> TracedSource:
    """The light of a source, stage by stage, through the instrument of a calibration, or `instrument` as designed.

    `product` is a calibration product or the folder of a run. Raises `DataError` for a file that cannot be read;
    it or another ValueError, with the nearest names, for an unknown instrument, filter or moving element.
    """
    name = str(sightline.setting.filter[0])
    if product is None:
        design = nominal_instrument() if instrument is None else Instrument.read(instrument)
        return TracedSource(trace(design, builtin_filter(name), sightline))
    held = read_calibration(product, catalogue)
    calibration = held.calibration
    fitted = calibration.model.instrument(calibration.values)
    lost = calibration.left_behind
    stages = trace(fitted, calibration.filter_curve(name), sightline)
    return TracedSource(stages, lost, (*held.warnings, *left_out_sentences(lost, held.path)))
