"""How often does noise alone raise a doubt? All questions of trust at once, on draws of noise into one fit.

    python tests/studies/false_alarms.py [--draws 1000] [--seed 3]                                      (3 minutes)

Residuals of a small run are replaced by noise behind the projection, to first order those of a fit to such data.
Printed is how many draws of all raise a doubt, question by question, and of any kind.
"""

from __future__ import annotations

import dataclasses
import sys
from collections import Counter
from pathlib import Path

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from small_run import small_fit  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.diagnosis import thresholds, trust  # noqa: E402
from walop_jax.diagnosis.design import Design, pattern_scores  # noqa: E402
from walop_jax.diagnosis.stated_conditions import Singles, scored, stated_conditions  # noqa: E402
from walop_jax.diagnosis.variance_components import (  # noqa: E402
    found_components,
    repeated_noise,
    variance_components,
)


def noise(design: Design, rng: np.random.Generator) -> np.ndarray:
    """Whitened noise that no flux holds; a weak pull is no datum and has none."""
    unit = design.measured.model[design.measured.used]
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    rows = rng.standard_normal(unit.shape)
    rows -= np.sum(rows * unit, axis=1, keepdims=True) * unit
    priors = rng.standard_normal(len(design.residual) - design.rows) * design.fit.likelihood.priors.known
    return np.concatenate([rows.reshape(-1), priors])


def main() -> None:
    """Print the study."""
    given = options_of(__doc__, draws=1000, seed=3).parse_args()
    jax.config.update("jax_enable_x64", True)
    design, rng, found = Design.of(small_fit()), np.random.default_rng(given.seed), Counter[str]()
    rivals = [item.single for item in Singles.of(design).items]
    for number in range(given.draws):
        drawn = dataclasses.replace(design, residual=noise(design, rng))
        drawn.__dict__["projector"] = design.projector
        doubts = {
            "variance components": found_components(variance_components(drawn)),
            "single numbers": list(stated_conditions(drawn, scored(drawn, rivals))),
            "patterns": pattern_scores(drawn, number).p_global < thresholds.ALARM,
            "groups": any(trust._groups(drawn)),
            "repeated noise": any(repeated_noise(drawn)),
        }
        raised = [name for name, doubt in doubts.items() if doubt]
        found.update(raised)
        found["any"] += bool(raised)
    for name in (*doubts, "any"):
        print(f"{name}: {found[name]} of {given.draws}")


if __name__ == "__main__":
    main()
