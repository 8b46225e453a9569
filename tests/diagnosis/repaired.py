"""How much of the damage done by an effect that is in no catalogue its description repairs, on whole data sets.

    PYTHONPATH=tests python tests/diagnosis/repaired.py [--ratio 30] [--effects 30] [OUT.json]   (40 minutes)

Each effect is hidden in turn, at a random shape and the signal-to-noise ratio that is asked for, and taken out of the
catalogue that `diagnose` knows. The error of the matrix (rms of m22, m23, m32, m33, m21, m31 over points between those
of the grid) is that of the instrument that made the data, the effect included where it acts on the light of stars.

repaired    1 − (with what was found − with the effect itself) / (without anything − with the effect itself), in mean
            squares: the noise of the fit is in all of them. Not asked where the effect does less to the matrix than
            noise does.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import jax
import numpy as np
from blind_sets import Hiding
from matrix_at import matrix_at

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import EFFECTS
from walop_jax.model.effects.in_models import with_effects
from walop_jax.model.instrument import Instrument
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

PLAN = ObservingPlan(
    grid=8, standard_grid=3, polariser_angles=polariser_turn(12), moon_patches=6, standards=6
)
SEED = 20261122


def matrix_between(instrument: Instrument, calset: CalibrationSet) -> np.ndarray:
    """Rows q, u of the instrument matrix between the points of the grid."""
    side = np.unique(calset.points.x)
    middle = 0.5 * (side[1:] + side[:-1])[:: max(1, len(side) // 8)]
    x, y = (grid.ravel() for grid in np.meshgrid(middle, middle))
    return matrix_at(instrument, calset, x, y)


def mean_square(result: FitResult, truth: np.ndarray) -> float:
    """Of the error of the matrix of a fit."""
    return float(
        np.mean((matrix_between(result.model.instrument(result.values), result.calset) - truth) ** 2)
    )


def scene(hiding: Hiding, name: str, ratio: float) -> dict[str, object] | None:
    """One effect hidden and looked for without its entry; None where no plausible amplitude reaches the ratio."""
    rng = np.random.default_rng([SEED, hiding.names.index(name)])
    effect = hiding.draw(name, ratio, rng)
    if effect is None:
        return None
    drawn = simulate(hiding.plan, seed=int(rng.integers(2**31)), effects=[effect])
    calset, model = drawn.calset, base_model(drawn.calset)
    truth = matrix_between(drawn.truth, calset)
    found = diagnose(calset, catalogue=tuple(e for e in EFFECTS if e.name != name))
    before = fit(Likelihood.of(calset, model))
    right = fit(Likelihood.of(calset, with_effects(model, [effect], hiding.context)))
    without, told, known = (mean_square(r, truth) for r in (before, found.after, right))
    damage = without - known
    return {
        "effect": name,
        "verdict": found.verdict,
        "steps": [s.effect for s in found.steps],
        "said": [change.text for s in found.steps for change, _, _ in s.descriptions],
        "without": without**0.5,
        "told": told**0.5,
        "known": known**0.5,
        "repaired": 1.0 - (told - known) / damage if damage > known else None,
    }


def main() -> None:
    """Print each scene and the median."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", nargs="?", type=Path)
    parser.add_argument("--ratio", type=float, default=30.0)
    parser.add_argument("--effects", type=int, default=99)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    hiding, found = Hiding(PLAN), []
    for name in hiding.names[: options.effects]:
        one = scene(hiding, name, options.ratio)
        if one is not None:
            found.append(one)
            print(json.dumps(one, ensure_ascii=False), flush=True)
    shares = [one["repaired"] for one in found if one["repaired"] is not None]
    print(f"repaired, median of {len(shares)} scenes that did damage: {np.median(shares):.3f}")
    if options.output is not None:
        options.output.write_text(json.dumps(found, indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main()
