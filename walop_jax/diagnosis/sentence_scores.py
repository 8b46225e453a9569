"""The scores of all descriptions against a fit, each by itself: what a diagnosis would find, the fit is asked as well.

A description is one group of sentences (`grammar`). Its score needs of the design the products of its own columns
with each other, the residuals and the projection alone; so the columns are made some at a time, and nothing is kept of
them. All descriptions count as trials (Šidák), which is more than there are in effect: what has a corrected p here has
no larger one in a diagnosis.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import linalg

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import grammar, thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.hypotheses import Probe, all_candidates
from walop_jax.diagnosis.score import ScoreSpace, ScoreTable

TOGETHER = 1e8  # numbers of columns that are there at a time
_SHOWN = 3


def sentence_scores(design: Design) -> ScoreTable:
    """The scores of all descriptions that an instrument and its exposures allow, with their corrected p."""
    fit = design.fit
    calset: CalibrationSet = fit.calset
    every = grammar.sentences(fit.model.template, calset.exposures, len(calset.points))
    residual = design.projector(design.residual)
    noise = float(np.sqrt(residual @ residual / max(design.projector.free, 1))) or 1.0
    names: list[str] = []
    sizes: list[int] = []
    parts: list[tuple[np.ndarray, ...]] = []
    for some in _batches(every, len(design.residual)):
        for probe, columns in _columns(design, some):
            own = columns.astype(float) / fit.noise_scale
            along = design.projector.basis[: len(own)].T @ own
            square = own.T @ own
            names.append(probe.name)
            sizes.append(own.shape[1])
            parts.append(
                (probe.widths, np.diag(square), own.T @ residual[: len(own)], square - along.T @ along)
            )
    if not names:
        return ScoreTable((), noise, 1.0, 1.0)
    widths, before, scores = (np.concatenate(each) for each in list(zip(*parts, strict=True))[:3])
    gram = np.asarray(linalg.block_diag(*(block for *_, block in parts)))
    space = ScoreSpace(tuple(names), tuple(sizes), widths, before, gram, design.projector.free)
    return space.table_after(ScoreTable((), noise, 1.0, float(len(names))), scores)


def _batches(every: tuple[Probe, ...], rows: int) -> Iterator[list[Probe]]:
    most, some, count = max(1, int(TOGETHER / max(rows, 1))), list[Probe](), 0
    for probe in every:
        if some and count + len(probe.widths) > most:
            yield some
            some, count = [], 0
        some.append(probe)
        count += len(probe.widths)
    if some:
        yield some


def _columns(design: Design, some: list[Probe]) -> Iterator[tuple[Probe, np.ndarray]]:
    said = all_candidates(design.columns, (), some)[1]
    yield from ((probe, said[probe.name].columns) for probe in some if probe.name in said)


def described_doubts(design: Design) -> Iterator[str]:
    """A sentence if descriptions of what may be missing explain more than noise does."""
    table = sentence_scores(design)
    if table.p_global >= thresholds.ALARM:
        return
    names = table.significant(thresholds.ALARM, _SHOWN)
    yield (
        f"the residuals are explained better with something that the model has not (p = {table.p_global:.2g}, limit "
        f"{thresholds.ALARM:g}; nearest: {' | '.join(names)}): walop-jax diagnose looks for the cause"
    )
