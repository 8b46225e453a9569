"""Make `walop_jax/docs/gallery.json`, the numbers of the pages `walop-jax docs effect NAME`: about a minute.

PYTHONPATH=tests python tests/diagnosis/make_gallery.py
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import walop_jax as walop  # noqa: E402
from walop_jax.calibration.matrix import effect_slopes, first_setting  # noqa: E402
from walop_jax.diagnosis.detection_limits import detection_limits  # noqa: E402
from walop_jax.diagnosis.hypotheses import probes  # noqa: E402
from walop_jax.model.specification import effect_context  # noqa: E402
from walop_jax.simulation.observing_plan import polariser_turn  # noqa: E402

FILE = Path(__file__).resolve().parents[2] / "walop_jax" / "docs" / "gallery.json"
PLAN = walop.ObservingPlan(
    grid=5, standard_grid=2, polariser_angles=polariser_turn(8), moon_patches=3, standards=3,
    plate=(None, 0.0, 22.5),
)  # fmt: skip
WORDS = (
    "WALOP-South, 5 × 5 field points, 8 polariser angles with the calibration plate out, at 0° and at 22.5°, "
    "3 Moon patches, 3 standards, 10⁶ electrons"
)
ELEMENTS = ("m21", "m22", "m23", "m31", "m32", "m33")
RIVALS = 3


def entries(fit: walop.FitResult) -> dict[str, dict[str, Any]]:
    """By effect: the first amplitude, its sizes, its nearest rivals, and what its usual size does to the matrix."""
    found = detection_limits(fit)
    context = effect_context(fit.model.template, fit.calset.exposures)
    instrument, points = fit.model.instrument(fit.values), fit.calset.points
    setting = first_setting(fit.calset, instrument)
    made: dict[str, dict[str, Any]] = {}
    for number, name in enumerate(found.effects):
        effect = next(one for one in walop.EFFECTS if one.name == name)
        probe = next(iter(probes((effect,), context)))
        first = probe.parameters[0]
        one = next(e for e in found.limits if (e.effect, e.parameter) == (name, first))
        slope = effect_slopes(instrument, setting, fit.calset.filters, points.x, points.y, probe.group)
        rms = probe.widths[0] * np.sqrt(np.mean(slope[..., 0] ** 2, axis=0)).ravel()
        row = found.separation[number]
        near = [i for i in np.argsort(row) if math.isfinite(row[i]) and i != number][:RIVALS]
        made[name] = {
            "parameter": first,
            "unit": one.unit,
            "found": list(one.detected),
            "named": one.named if math.isfinite(one.named) else None,
            "rivals": [[found.effects[i], float(row[i])] for i in near],
            "usual": probe.widths[0],
            "maps": dict(zip(ELEMENTS, (100.0 * rms).tolist(), strict=True)),
        }
    return made


if __name__ == "__main__":
    calset, _ = walop.simulate(PLAN, seed=4)
    document = {"plan": WORDS, "effects": entries(walop.refit(calset))}
    FILE.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n")
