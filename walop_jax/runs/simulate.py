"""A synthetic calibration set and its truth, written to files."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from walop_jax.data.write import write_calibration_set
from walop_jax.io.atomic import atomic_path, check_output
from walop_jax.io.text import json_text
from walop_jax.model.effects.base import Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import leaves
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import simulate, truth_values


@dataclasses.dataclass(frozen=True)
class SimulatedSet:
    """A calibration set that was written, what it holds, and the file of its truth (None: not asked for)."""

    path: Path
    instrument: str
    seed: int
    exposures: int
    points: int
    rows: int
    effects: tuple[str, ...]
    truth: Path | None

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "output": str(self.path),
            "instrument": self.instrument,
            "seed": self.seed,
            "exposures": self.exposures,
            "points": self.points,
            "rows": self.rows,
            "effects": list(self.effects),
            "truth": None if self.truth is None else str(self.truth),
        }


def simulate_set(
    output: str | os.PathLike[str],
    plan: ObservingPlan,
    *,
    seed: int = 0,
    effects: Sequence[Effect] = (),
    truth: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: Callable[[str], None] | None = None,
) -> SimulatedSet:
    """Simulate what `plan` observes, with `effects` hidden in it, and write it as `output`; its truth as `truth`.

    `progress` is told what is being done. Raises `DataError` for files that cannot be written; neither of the two
    appears then.
    """
    tell = progress or (lambda text: None)
    check_output(output, overwrite=overwrite)
    if truth is not None:
        check_output(truth, overwrite=overwrite)
    tell("following the light")
    calset, instrument = simulate(plan, seed, effects=effects)
    tell("writing")
    with contextlib.ExitStack() as stack:
        if truth is not None:
            temporary = stack.enter_context(atomic_path(truth, overwrite=overwrite))
            temporary.write_text(json_text(truth_document(plan, seed, instrument)), encoding="utf-8")
        write_calibration_set(output, calset, overwrite=overwrite)
    return SimulatedSet(
        path=Path(output),
        instrument=plan.name,
        seed=seed,
        exposures=len(calset.exposures),
        points=len(calset.points),
        rows=calset.intensities.rows,
        effects=tuple(effect.name for effect in effects),
        truth=None if truth is None else Path(truth),
    )


def truth_document(plan: ObservingPlan, seed: int, instrument: Instrument) -> dict[str, Any]:
    """What a simulated set was made of, as plain data: the plan, the effects, the true value of every parameter."""
    units = {leaf.name: leaf.declaration.unit for leaf in leaves(instrument)}
    return {
        "instrument": plan.name,
        "seed": seed,
        "plan": plan.document(),
        "effects": {effect.name: effect.choices() for effect in instrument.effects},
        "parameters": {
            name: {"value": value, "unit": units[name]} for name, value in truth_values(instrument).items()
        },
    }
