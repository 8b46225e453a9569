"""At what size each effect is found and named in data of a plan, and what it is confused with, before there are data.

From the columns C̃ of the score test, all parameters of the model projected out, and G = C̃ᵀC̃. An amplitude a of
an effect whose column has G_ii stands a √G_ii standard deviations above noise. It is found in 99 % of cases when
that exceeds the alarm, corrected for all that is tried, by 2.33. What a rival h cannot imitate of it is G_ii − G_ih
G_hh⁺ G_hi; it is named when that part stands 5 standard deviations out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from walop_jax.diagnosis.effect_columns import Probe, applicable, probes
from walop_jax.diagnosis.examination import ALARM, Examination
from walop_jax.diagnosis.score import separations
from walop_jax.fit.refit import FitResult
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.model.parameters import field_declarations
from walop_jax.model.specification import effect_context

FOUND = 0.99  # probability
NAMED = 5.0  # standard deviations from the nearest rival
MOST_RIVALS = 3


@dataclasses.dataclass(frozen=True)
class Detectability:
    """The first amplitude of an effect: its unit, the sizes from which it is found and named (NaN: at none).

    `rivals` are (effect, separation in standard deviations at the size from which it is found), nearest first.
    """

    effect: str
    parameter: str
    unit: str
    found: float
    named: float
    rivals: tuple[tuple[str, float], ...]

    def document(self) -> dict[str, Any]:
        """As plain data."""
        return dataclasses.asdict(self)


def detectability(
    fit: FitResult, catalogue: Sequence[type[Effect]] = EFFECTS, seed: int = 0
) -> tuple[Detectability, ...]:
    """Of every effect of the catalogue with an amplitude that the exposures can show, at one of its shapes (the
    first)."""
    context = effect_context(fit.model.template, fit.calset.exposures)
    there = applicable(catalogue, context, fit.model.template)
    examination = Examination(fit, list(probes(there, context)), np.random.default_rng(seed))
    space, places = examination.space, examination.space.places()
    alive = space.alive()
    threshold = stats.norm.isf(0.5 * ALARM / max(examination.table.trials, 1.0)) + stats.norm.ppf(FOUND)
    first: dict[str, tuple[Probe, int]] = {}
    for probe in examination.probes:
        at = places[probe.name]
        if probe.effect.name not in first and alive[at].any():
            first[probe.effect.name] = probe, at.start + int(np.argmax(alive[at]))
    found = []
    for name, (probe, i) in first.items():
        whole = float(space.gram[i, i])
        size = threshold / np.sqrt(whole)
        apart = separations(space, space.gram[:, i], whole)
        left = {
            other: apart[rival.name] / np.sqrt(whole) for other, (rival, _) in first.items() if other != name
        }
        nearest = sorted(left, key=lambda other: left[other])[:MOST_RIVALS]
        closest = left[nearest[0]] if nearest else 1.0
        named = max(size, NAMED / (closest * np.sqrt(whole))) if closest > 0 else np.nan
        parameter = probe.effect.amplitudes()[0]
        unit = field_declarations(probe.effect)[parameter].unit
        rivals = tuple((other, float(threshold * left[other])) for other in nearest)
        found.append(Detectability(name, parameter, unit, float(size), float(named), rivals))
    return tuple(found)
