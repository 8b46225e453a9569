"""Scores of all effects and descriptions against a fit, for its verdict.

The list is that of a diagnosis (`grammar.hypotheses`). Only products of the columns of a candidate with each other, the
residuals and the projection are needed, so the columns are made in batches. Their scores in draws of noise give the
number of independent trials, as in a diagnosis, so that both correct p alike.
"""

from __future__ import annotations

import collections
from collections.abc import Iterator

import numpy as np
from scipy import linalg

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import grammar
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.hypotheses import Probe, all_candidates
from walop_jax.diagnosis.score import ScoreSpace, ScoreTable, effective_trials
from walop_jax.model.effects import Described

TOGETHER = 1e8  # numbers in the columns of a batch
DRAWS = 200  # of noise: a fifth of them give the number of trials to 16 %


def candidate_scores(design: Design, seed: int = 0) -> ScoreTable:
    """Scores of all effects and descriptions that a model may lack, with their corrected p."""
    fit = design.fit
    calset: CalibrationSet = fit.calset
    listed = grammar.hypotheses(fit.model.catalogue, fit.model.template, calset.exposures, len(calset.points))
    absent = [probe for probe in listed.names if probe.effect.name not in fit.model.effect_names]
    probes = (*absent, *listed.sentences, *(probe for probe, _ in listed.parts))
    residual = design.projector(design.residual)
    noise = float(np.sqrt(residual @ residual / max(design.projector.free, 1))) or 1.0
    normal = np.random.default_rng(seed).standard_normal((len(residual), DRAWS), dtype=np.float32)
    normal = design.projector(normal).astype(np.float32)
    scored: list[Probe] = []
    blocks: list[tuple[np.ndarray, ...]] = []
    for batch in _batches(probes, len(design.residual)):
        for probe, columns in _columns(design, batch):
            c = columns.astype(float) / fit.noise_scale
            along = design.projector.basis[: len(c)].T @ c
            square = c.T @ c
            drawn = c.T.astype(np.float32) @ normal[: len(c)]
            scored.append(probe)
            blocks.append((np.diag(square), c.T @ residual[: len(c)], drawn, square - along.T @ along))
    if not scored:
        return ScoreTable((), noise, 1.0, 1.0)
    before, scores, drawn = (np.concatenate(arrays) for arrays in list(zip(*blocks, strict=True))[:3])
    space = ScoreSpace(
        names=tuple(probe.name for probe in scored),
        sizes=tuple(len(probe.widths) for probe in scored),
        widths=np.concatenate([probe.widths for probe in scored]),
        before=before,
        gram=np.asarray(linalg.block_diag(*(block for *_, block in blocks))),
        free=design.projector.free,
    )
    trials = effective_trials(space.smallest_of(drawn))
    return space.table_after(ScoreTable((), noise, 1.0, trials), scores)


def _batches(probes: tuple[Probe, ...], rows: int) -> Iterator[list[Probe]]:
    limit, batch, count = max(1, int(TOGETHER / max(rows, 1))), list[Probe](), 0
    for probe in probes:
        if batch and count + len(probe.widths) > limit:
            yield batch
            batch, count = [], 0
        batch.append(probe)
        count += len(probe.widths)
    if batch:
        yield batch


def _columns(design: Design, batch: list[Probe]) -> Iterator[tuple[Probe, np.ndarray]]:
    names, sentences = (
        [p for p in batch if (p.effect is Described) == described] for described in (False, True)
    )
    candidates = collections.ChainMap(*all_candidates(design.columns, names, sentences))
    yield from ((probe, candidates[probe.name].columns) for probe in batch if probe.name in candidates)
