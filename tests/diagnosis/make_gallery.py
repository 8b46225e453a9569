"""Make `walop_jax/docs/gallery.json`, the numbers of the pages `walop-jax docs effect NAME`: about a minute.

PYTHONPATH=tests python tests/diagnosis/make_gallery.py
"""

from __future__ import annotations

import json
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import walop_jax as walop  # noqa: E402
from walop_jax.diagnosis.detectability import detectability  # noqa: E402
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

if __name__ == "__main__":
    calset, _ = walop.simulate(PLAN, seed=4)
    found = detectability(walop.refit(calset))
    effects = {one.effect: one.document() for one in found}
    FILE.write_text(json.dumps({"plan": WORDS, "effects": effects}, indent=1, ensure_ascii=False) + "\n")
