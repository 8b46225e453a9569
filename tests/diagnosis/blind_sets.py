"""A blind suite on whole data sets: simulate with something hidden, run `diagnose`, then open the truth.

Every scene has an instrument, a sky and noise of its own, and one effect of the catalogue at a random shape between
the probes, at a signal-to-noise ratio of 6, 10 or 30 behind the projection; every eighth scene hides nothing. The
verdict of a scene is written before its truth is looked at; a study goes on where it was left.

    PYTHONPATH=tests python tests/diagnosis/blind_sets.py SCENES OUT.jsonl      (half a minute each)
    PYTHONPATH=tests python tests/diagnosis/blind_sets.py report OUT.jsonl
"""

from __future__ import annotations

import collections
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.examination import examine
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.diagnosis.hypotheses import Hypotheses, Probe, all_candidates, probes
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood.columns import Columns
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.model.effects.in_models import effect_context
from walop_jax.model.parameters import leaves, values_of
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import simulate

RATIOS = (10.0, 30.0, 6.0)
NULL_EVERY = 8
PLAUSIBLE = 5.0  # prior widths that a hidden amplitude may have
SEED = 20261121


class Hiding:
    """Draws effects of a given signal-to-noise ratio for one observing plan."""

    def __init__(self, plan: ObservingPlan) -> None:
        self.plan = plan
        calset, _ = simulate(plan, seed=SEED)
        self.fit = fit(Likelihood.of(calset, base_model(calset)))
        self.design = Design.of(self.fit)
        self.context = effect_context(self.fit.model.template, calset.exposures)
        every = list(probes(EFFECTS, self.context))
        examination = examine(self.fit, Hypotheses(every), np.random.default_rng(0))
        self.probes = [p for p in examination.probes if examination.table[p.name].testable]
        self.names = sorted({p.effect.name for p in self.probes})

    def draw(self, name: str, ratio: float, rng: np.random.Generator) -> Effect | None:
        """The effect at a random shape; None when no plausible amplitude reaches the ratio in a few tries."""
        for _ in range(20):
            drawn = self._try(name, ratio, rng)
            if drawn is not None:
                return drawn
        return None

    def _try(self, name: str, ratio: float, rng: np.random.Generator) -> Effect | None:
        shapes = [p for p in self.probes if p.effect.name == name]
        probe = shapes[rng.integers(len(shapes))]
        group = (
            tuple(_jittered(member, rng) for member in probe.group) if len(probe.group) == 1 else probe.group
        )
        probe = Probe(probe.name, probe.effect, group)
        candidate = all_candidates(Columns(self.fit.likelihood, self.fit.values), [probe])[probe.name]
        columns = self.design.stacked([candidate.columns])
        step = rng.standard_normal(len(probe.widths)) * probe.widths
        step = np.where(probe.one_sided, np.abs(step), step)
        step *= ratio / np.linalg.norm(self.design.projector(columns @ step))
        if np.max(np.abs(step) / probe.widths) > PLAUSIBLE:
            return None
        return probe.effect.combine(probe.group, step).standard_form()


def _jittered(effect: Effect, rng: np.random.Generator) -> Effect:
    declared = effect.declarations()
    moved = {
        name: np.asarray(getattr(effect, name)) + rng.uniform(-1, 1) * (declared[name].scale or 0.0)
        for name in effect.shape
    }
    return effect.replaced(**moved)


def scene(hiding: Hiding, number: int) -> dict[str, Any]:
    """One scene: hide, diagnose, open."""
    rng = np.random.default_rng([SEED, number])
    null = number % NULL_EVERY == NULL_EVERY - 1
    turn = number - number // NULL_EVERY
    name = hiding.names[turn % len(hiding.names)]
    ratio = RATIOS[(turn // len(hiding.names)) % len(RATIOS)]
    effect = None if null else hiding.draw(name, ratio, rng)
    if effect is None and not null:
        return {"scene": number, "truth": name, "ratio": ratio, "verdict": "out of reach"}
    hidden = [] if effect is None else [effect]
    calset, _ = simulate(hiding.plan, seed=int(rng.integers(2**31)), effects=hidden)
    found = diagnose(calset, seed=number)
    entry = {"scene": number, **_said(found)}
    # Opened only now.
    entry["truth"] = None if null else name
    entry["ratio"] = 0.0 if null else ratio
    entry["values"] = {
        leaf.name: float(v) for e in hidden for leaf, v in zip(leaves(e), values_of(e), strict=True)
    }
    return entry


def _said(found: Diagnosis) -> dict[str, Any]:
    return {
        "verdict": found.verdict,
        "named": [s.effect for s in found.steps],
        "classes": [list(s.equivalent) for s in found.steps],
        "parameters": [s.parameters for s in found.steps],
        "p": found.p_value,
        "remaining": found.remaining_p,
        "separation": [min(s.separation.values(), default=np.inf) for s in found.steps],
        "chi2_per_dof": found.after.chi2 / found.after.dof,
        "seconds": found.seconds,
    }


def report(entries: list[dict[str, Any]]) -> dict[str, Any]:
    """Rates over the scenes that are there."""
    rates: dict[str, list[bool]] = collections.defaultdict(list)
    pulls, misses = [], []
    for e in entries:
        if e["verdict"] == "out of reach":
            continue
        if e["truth"] is None:
            rates["false alarm"].append(e["verdict"] != "consistent")
            continue
        told = set(e["named"][:1]) | set(e["classes"][0] if e["classes"] else [])
        found, ratio = e["verdict"] == "effect_found", f"SNR {e['ratio']:g}"
        rates[f"detected, {ratio}"].append(e["p"] < thresholds.ALARM)
        rates[f"top-1, {ratio}"].append(e["named"][:1] == [e["truth"]])
        rates[f"truth named or in its class, {ratio}"].append(e["truth"] in told)
        rates[f"exactly the truth, {ratio}"].append(found and e["named"] == [e["truth"]])
        rates[f"confident and wrong, {ratio}"].append(found and e["truth"] not in told)
        if e["named"] != [e["truth"]]:
            misses.append(f"{e['scene']}: {e['truth']} {ratio} → {e['verdict']} {e['named']} {e['classes']}")
        if e["named"][:1] == [e["truth"]]:
            for name, (value, sigma, _) in e["parameters"][0].items():
                if sigma > 0 and name in e["values"]:
                    pulls.append((value - e["values"][name]) / sigma)
    return {
        "rates": {name: (float(np.mean(v)), len(v)) for name, v in sorted(rates.items())},
        "pulls": {"rms": float(np.sqrt(np.mean(np.square(pulls)))) if pulls else None, "count": len(pulls),
                  "largest": float(np.max(np.abs(pulls))) if pulls else None},
        "misses": misses,
    }  # fmt: skip


def main(count: str, path: Path) -> None:
    """Go on with a study until it has `count` scenes, or report it."""
    done = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    if count != "report":
        hiding = Hiding(ObservingPlan())
        for number in range(len(done), int(count)):
            done.append(scene(hiding, number))
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(done[-1], ensure_ascii=False) + "\n")
    print(json.dumps(report(done), indent=1, ensure_ascii=False))


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    main(sys.argv[1], Path(sys.argv[2]))
