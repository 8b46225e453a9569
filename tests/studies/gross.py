"""Effects that misfit grossly: are they told by their names, with the effect fitted beside a description and without?

    python tests/studies/gross.py [--widths 20] [--seed 6200] [--most 99]                        (a quarter of an hour)

Every effect of the catalogue that has one shape is hidden in a small set of its own, with every amplitude `widths`
times its prior width, the sign at random. Sets whose fit of the base model has χ²/dof below 50 are passed over: there
linear steps are good. Of the others each is diagnosed as the search is, and without the rule that fits the effect with
the most evidence beside a description (`search._RoundInProgress.effect_instead`).
"""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from small_run import SMALL  # noqa: E402
from studies.ablation import RULES, without  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.data.records import CalibrationSet  # noqa: E402
from walop_jax.diagnosis.hypotheses import applicable, probes  # noqa: E402
from walop_jax.diagnosis.workflow import diagnose  # noqa: E402
from walop_jax.fit.base_model import base_model  # noqa: E402
from walop_jax.fit.refit import fit  # noqa: E402
from walop_jax.likelihood.likelihood import Likelihood  # noqa: E402
from walop_jax.model.effects import EFFECTS, Effect  # noqa: E402
from walop_jax.model.effects.in_models import effect_context  # noqa: E402
from walop_jax.simulation.simulate import simulate  # noqa: E402

GROSS = 50.0  # χ²/dof
RULE = next(rule for rule in RULES if rule.places[0][1] == "effect_instead")


def hidden(calset: CalibrationSet, widths: float, seed: int) -> list[Effect]:
    """The effects with one shape, each with amplitudes of so many prior widths."""
    template = base_model(calset).template
    context = effect_context(template, calset.exposures)
    shapes: dict[str, list[Effect]] = {}
    for number, probe in enumerate(probes(applicable(EFFECTS, context, template), context)):
        signs = np.random.default_rng([seed, number]).choice([-1.0, 1.0], len(probe.widths))
        signs = np.where(probe.one_sided, 1.0, signs)
        effect = probe.effect.combine(probe.group, widths * signs * probe.widths)
        shapes.setdefault(probe.effect.name, []).append(effect)
    return [effects[0] for effects in shapes.values() if len(effects) == 1]


def answer(calset: CalibrationSet) -> tuple[str, tuple[str, ...]]:
    """Verdict and names of a diagnosis."""
    found = diagnose(calset)
    return found.verdict, tuple(step.effect for step in found.steps)


def main() -> None:
    """Print each effect, and the counts."""
    options = options_of(__doc__, widths=20.0, seed=6200, most=99).parse_args()
    jax.config.update("jax_enable_x64", True)
    sound, counted = simulate(SMALL, seed=options.seed).calset, {"with": 0, "without": 0, "all": 0}
    for number, effect in enumerate(hidden(sound, options.widths, options.seed)[: options.most]):
        try:
            calset = simulate(SMALL, seed=options.seed + number, effects=[effect]).calset
            result = fit(Likelihood.of(calset, base_model(calset)))
        except (ValueError, FloatingPointError) as error:
            print(f"{effect.name}: {str(error)[:80]}", flush=True)
            continue
        if result.chi2 < GROSS * result.dof:
            continue
        asked = answer(calset)
        with without(RULE):
            plain = answer(calset)
        counted["all"] += 1
        for key, (_, names) in (("with", asked), ("without", plain)):
            counted[key] += names == (effect.name,)
        print(
            f"{effect.name} ({result.chi2 / result.dof:.0f}): {asked} | without the rule {plain}", flush=True
        )
        jax.clear_caches()
    print(
        f"named alone: {counted['with']} of {counted['all']} with the rule, {counted['without']} without",
        flush=True,
    )


if __name__ == "__main__":
    main()
