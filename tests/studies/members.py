"""Depolarisation behind the collimator that a diagnosis tells of the polariser: does the mean over its class hold?

    PYTHONPATH=tests python tests/studies/members.py [--sets 18] [--seed 26112610]

Sets of 64 field points by the oracle's optics (`sealed`); size 6 × 10⁻⁴ to 6 × 10⁻³ at 0.3°, growing with r².
Nothing is searched for: the description is given, its class is worked out. Pulls are those of stars with p = 2 %,
and of the elements of the matrix, at 400 places.
"""

from __future__ import annotations

from unittest import mock

import jax
import numpy as np
from studies import sealed
from studies.sealed_optics import Hidden
from study_options import options_of

from walop_jax.calibration.calibration import Calibration
from walop_jax.diagnosis import grammar
from walop_jax.diagnosis.class_product import averaged
from walop_jax.diagnosis.discrepancy import ambiguities
from walop_jax.diagnosis.examination import examine
from walop_jax.diagnosis.hypotheses import Hypotheses
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit, with_empirical_covariance
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Described
from walop_jax.model.effects.in_models import effect_context, with_effects

TOLD, KINDS = "depolarisation of polariser * r2", ("depol", "retard", "diatt", "added")


def judged(seed: int) -> sealed.Judged:
    """The product of one set, held against its truth."""
    size = 10 ** np.random.default_rng(seed).uniform(-3.2, -2.2)
    hidden = Hidden(
        "depolarisation", "behind collimator", size, np.diag([0.0, -1.0, -1.0, -1.0]),
        lambda x, y: (np.hypot(x, y) / 0.3) ** 2, np.ones_like, np.ones(1000), 1.0, np.zeros(4),
    )  # fmt: skip
    with mock.patch.object(sealed, "draw", return_value=hidden):
        one = sealed.sealed(2, seed, 8)
    base = base_model(one.calset)
    context = effect_context(base.template, one.calset.exposures)
    model = with_effects(base, [Described.saying([TOLD], [size])], context)
    result = with_empirical_covariance(fit(Likelihood.of(one.calset, model))).with_verdict()
    every = grammar.descriptions(model.template, one.calset.exposures, len(one.calset.points))
    some = [probe for probe in every if probe.name.startswith(KINDS)]
    state = examine(result, Hypotheses(descriptions=some), np.random.default_rng(0))
    classes = ambiguities(state, {TOLD: ()})
    return sealed.judged(averaged(Calibration.from_fit(result), classes), True, one)


def main() -> None:
    options = options_of(__doc__, sets=18, seed=26112610).parse_args()
    jax.config.update("jax_enable_x64", True)
    every = [judged(options.seed + number) for number in range(options.sets)]
    for what in ("stars", "elements"):
        square = np.mean([np.mean(getattr(one, what) ** 2, axis=0) for one in every], axis=0)
        print(f"rms pulls of {what}:", np.round(np.sqrt(square), 2))
    beyond = [one.beyond for one in every]
    print(
        f"stars beyond 3 errors: {100 * np.mean(beyond):.2f} %, at most {100 * np.max(beyond):.1f} % of a set"
    )


if __name__ == "__main__":
    main()
