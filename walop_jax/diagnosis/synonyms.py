"""Descriptions that say what another candidate says: one candidate with several names.

Data        Behind the free parameters the columns C of two candidates with k amplitudes span the same changes of the
            residuals, where the cosines of the angles between the two spans are 1: Σ (1 − cos²) < 1 − S² with
            S = `thresholds.SAME`.
Product     What both do to the instrument matrix, refitted, is the same: with D the change of the matrix by the
            amplitudes, directly and through the shift of the free parameters, and b = T a the amplitudes of the first
            candidate that imitate amplitudes a of the second one best, D₂ a − D₁ T a is less than `ALIKE` of the errors
            of the matrix for N_ERR as stated, rms over the field points, for each number at its prior width.
Names       A name of the catalogue goes before a description, a description of a KIND of exposures (which may as well
            be that of all other kinds, `class_members`) before others, the shorter before the longer; the candidate
            keeps the prior widths of the name it has. Names of the catalogue remain apart from each other: each is an
            effect of its own, and reported as indistinguishable.

Synonyms stay synonyms where further parameters are free, which take up both or neither. Source: Björck & Golub 1973,
Math. Comp. 27, 579 (angles between spans).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.calibration.matrix import first_setting, matrix_slopes, of_matrix
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.hypotheses import Probe, texts_of
from walop_jax.diagnosis.score import Candidate, ScoreSpace
from walop_jax.diagnosis.undetected_errors import usual_exposure
from walop_jax.likelihood.starlight import added_to_starlight
from walop_jax.model.effects import Described

ALIKE = 0.5  # of the errors of the matrix: changes of it that differ by less are the same


def synonyms(
    design: Design, space: ScoreSpace, candidates: Mapping[str, Candidate], probes: Sequence[Probe]
) -> dict[str, tuple[str, ...]]:
    """Names of descriptions by the candidate that says the same; `probes` are effects and descriptions of `space`.

    Empty for an instrument whose product has no matrix.
    """
    if not design.fit.model.template.cameras.pairs:
        return {}
    groups = list(_same_to_the_data(space, sorted(probes, key=_preference)))
    if not groups:
        return {}
    changes, places = _changes(design, candidates, list(itertools.chain(*groups))), space.places()
    also: dict[str, tuple[str, ...]] = {}
    for group in groups:
        left = [probe for probe in group if probe.name in changes]
        while left:
            first, *rest = left
            alike = [p for p in rest if _same_product(space, places, changes, first, p)]
            same = [probe.name for probe in alike if probe.effect is Described]
            if same:
                also[first.name] = tuple(same)
            left = [probe for probe in rest if probe.name not in same]
    return also


def _preference(probe: Probe) -> tuple[int, int]:
    """Names of the catalogue first, in its order; of descriptions those of a KIND, and the shortest."""
    if probe.effect is not Described:
        return 0, 0
    return 2 - all("kind " in text for text in texts_of(probe)), len(probe.name)


def _same_to_the_data(space: ScoreSpace, probes: Sequence[Probe]) -> Iterator[list[Probe]]:
    """Groups of two or more probes whose columns span the same; no group without a description."""
    places, by_rank = space.places(), dict[int, list[Probe]]()
    for probe in probes:
        rank = space.whitened[probe.name].shape[1]
        if rank and rank == len(probe.widths):
            by_rank.setdefault(rank, []).append(probe)
    for rank, ranked in by_rank.items():
        same = _spans_are_the_same(space, [places[probe.name] for probe in ranked], rank, ranked)
        left = list(range(len(ranked)))
        while left:
            group = [i for i in left if same[left[0], i]]
            left = [i for i in left if i not in group]
            if len(group) > 1 and ranked[group[-1]].effect is Described:
                yield [ranked[i] for i in group]


def _spans_are_the_same(
    space: ScoreSpace, places: Sequence[slice], rank: int, probes: Sequence[Probe]
) -> Bool[np.ndarray, "c c"]:
    """True for each pair of candidates with so many numbers whose columns span the same."""
    at = np.concatenate([np.arange(place.start, place.stop) for place in places])
    whitened = np.zeros((len(at), len(at)))
    for number, probe in enumerate(probes):
        own = slice(number * rank, (number + 1) * rank)
        whitened[own, own] = space.whitened[probe.name]
    cosines = whitened.T @ space.gram[np.ix_(at, at)] @ whitened
    squares = np.sum(cosines.reshape(len(places), rank, len(places), rank) ** 2, axis=(1, 3))
    return rank - squares < 1.0 - thresholds.SAME**2


def _changes(
    design: Design, candidates: Mapping[str, Candidate], probes: Sequence[Probe]
) -> dict[str, Float[np.ndarray, "p m k"]]:
    """Change of the elements of the matrix by the amplitudes of probes, refitted, in errors of the elements.

    Without those that have no descriptions.
    """
    fit, template = design.fit, design.fit.model.template
    every_sum = {p.name: [tuple(t) for m in p.group for t in m.first_order(template)] for p in probes}
    widths = {probe.name: probe.widths for probe in probes}
    sums = {
        name: of
        for name, of in every_sum.items()
        if len(of) == len(widths[name]) and all(map(design.columns.has, of))
    }
    usual = usual_exposure(fit.calset, template)
    every = list(dict.fromkeys(itertools.chain(*sums.values())))
    vectors, added = added_to_starlight(design.columns, every, usual)
    place = {total: number for number, total in enumerate(every)}
    instrument, points = fit.model.instrument(fit.values), fit.calset.points
    setting = first_setting(fit.calset, instrument, usual)
    matrix, slopes = matrix_slopes(instrument, setting, fit.calset.filters, points.x, points.y)
    slopes = slopes.reshape(len(matrix), -1, slopes.shape[-1]) @ fit.model.selection()
    covariance = fit.covariance[np.ix_(fit.model.free, fit.model.free)]
    # Of data as stated: of a fit that is far off any two products would be the same.
    errors = np.sqrt(np.einsum("pmf,fg,pmg->pm", slopes, covariance, slopes)) / fit.noise_scale
    columns = [candidates[name].columns for name in sums]
    taken_up = design.projector.taken_up(design.products(columns, design.projector.basis).T)
    ends = np.cumsum([len(of) for of in sums.values()])[:-1]
    scale, changes = np.where(errors > 0, errors, np.inf)[..., None], {}
    for (name, of), moved in zip(sums.items(), np.split(taken_up, ends, axis=1), strict=True):
        own = np.moveaxis(added[..., [place[total] for total in of]], -1, 1)
        direct = np.moveaxis(of_matrix(vectors[:, None], own, template.cameras.pairs), 1, -1)
        changes[name] = (direct.reshape(*errors.shape, -1) - slopes @ moved) / scale
    return changes


def _same_product(
    space: ScoreSpace,
    places: Mapping[str, slice],
    changes: Mapping[str, Float[np.ndarray, "p m k"]],
    first: Probe,
    second: Probe,
) -> bool:
    """True if the second of two candidates that are the same to the data does to the matrix what the first does."""
    w = space.whitened[first.name]
    imitation = w @ (w.T @ space.gram[places[first.name], places[second.name]])
    apart = (changes[second.name] - changes[first.name] @ imitation) * second.widths
    return bool(np.sqrt(np.mean(apart**2, axis=0)).max() < ALIKE)
