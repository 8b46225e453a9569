"""The judge of the search that fits nothing, for thousands of scenes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from walop_jax.diagnosis.exact import Trial
from walop_jax.diagnosis.examination import Evidence
from walop_jax.diagnosis.findings import Choice
from walop_jax.diagnosis.hypotheses import Ranked
from walop_jax.diagnosis.score import ScoreSpace
from walop_jax.diagnosis.search import State
from walop_jax.model.effects import Described


class Linear:
    """Judge of trials by their linear steps; nothing is held out and no time runs. `refits.Refits` fits instead."""

    def over(self, fits: int) -> str:
        """Nothing: linear steps cost nothing."""
        return ""

    def fitted(self, evidence: Evidence, trial: Trial) -> Trial:
        """A linear trial as it is."""
        return trial

    def others(self, state: State) -> tuple[Sequence[Trial], Mapping[str, Choice]]:
        """No trials of what has no linear step."""
        return (), {}

    def confronted(self, evidence: Evidence, trial: Trial) -> Trial:
        """The trial as it is: a score space has no rows that could have been left out."""
        return trial

    def adopted(self, state: State, trial: Trial) -> State:
        """The state with the evidence of what is left once a trial has joined the model."""
        assert trial.item is not None
        evidence = joined(state.evidence, trial.item)
        return dataclasses.replace(state, evidence=evidence, steps=(*state.steps, trial))


def joined(evidence: Evidence, item: Ranked, known: ScoreSpace | None = None) -> Evidence:
    """The evidence once a candidate has joined the base, by a linear step; `known` is the space of that."""
    space, reduce = evidence.space.with_base([item.probe.name])
    scores, square = reduce(evidence.scores, evidence.square)
    space = known or space
    effect = item.effect
    return dataclasses.replace(
        evidence,
        space=space,
        scores=scores,
        square=square,
        table=space.table_after(evidence.table, scores),
        probes=[p for p in evidence.probes if p.effect is not effect or effect is Described],
        descriptions=[probe for probe in evidence.descriptions if probe is not item.probe],
        parts=[dataclasses.replace(p, holders=p.holders - {effect}) for p in evidence.parts],
        chi2=evidence.chi2 - item.score.statistic * (evidence.table.noise_scale * evidence.scale) ** 2,
        dof=evidence.dof - item.score.rank,
    )
