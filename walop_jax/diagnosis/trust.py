"""Is a fit to be trusted? What its residuals say against it, whatever the total χ² says.

χ² of everything hides errors small beside all the noise, or made up for elsewhere. Here the residuals
are asked in smaller questions, each with a known answer under the model that was fitted:

Patterns    the efficient score of every free-form pattern (`design`) with one global p for all of them: structure
            over the field, angle, time, flux, kinds, filters and single exposures that noise does not make.
Groups      the squared residuals of each camera, kind, filter and exposure. Behind the fluxes and parameters that
            were fitted, r has the covariance P = 1 − Σ w wᵀ − QQᵀ, so that
                E Σ r² = tr P_gg,   cov(Σ_g r², Σ_h r²) = 2 ‖P_gh‖²
            for groups g, h. The mean square of a group over that of the rest of the data has mean 1 and the variance
            that follows from these; its p is that of a scaled χ² with these two moments.
Components  the variance of what field points, exposures, states, standards, nights and kinds have in common beyond the
            model, finer than any pattern (`variance_components`).
Conditions  the efficient score of every number that the set states of itself: field, filters, colours, sky; of every
            prior, term of a camera and effect of the catalogue (`stated_conditions`).
Candidates  the efficient score of every effect and description of a diagnosis.
Repeats     the correlation of the residuals of two exposures (`variance_components.repeated_noise`).
Errors      χ²/dof far below 1: N_ERR is overestimated. A few per cent are attributed to the stated errors,
            not to the model.

Symbols     w = expected counts / errors of all with a flux in common (an exposure at a point), of unit length, where
            that was fitted (0 where it is known); Q orthonormal basis of the derivatives with respect to the free
            parameters.
Sources     Rao 1948; Satterthwaite 1946, Biometrics Bull. 2, 110 (χ² with two moments); Šidák 1967 (many questions).
Limits      Noise alone raises a doubt in about one fit of 100. Of a large table a sample of the points is looked at.
            What is finer than the cells of whole frames was measured when these were read (`data.cells`).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy import special

from walop_jax.data.joined_cells import joined_cells
from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import grammar, thresholds
from walop_jax.diagnosis.design import Design, pattern_in_words, pattern_scores
from walop_jax.diagnosis.discrete import refuse_mixups
from walop_jax.diagnosis.hypotheses import Probe, candidates_by_points
from walop_jax.diagnosis.readings import refuse_dead_cameras
from walop_jax.diagnosis.remedies import remedies
from walop_jax.diagnosis.score import Blocks, Projector, ScoreSpace, ScoreTable, effective_trials, local_p
from walop_jax.diagnosis.stated_conditions import Singles, stated_conditions
from walop_jax.diagnosis.undetected_errors import undetected_errors
from walop_jax.diagnosis.variance_components import (
    found_components,
    in_words,
    repeated_noise,
    structure_of,
    variance_components,
    with_structure,
)
from walop_jax.fit.refit import FitResult, with_empirical_covariance
from walop_jax.fit.search import FAR_OFF
from walop_jax.fit.verdict import NOT_MEASURED, Structure
from walop_jax.io.text import beside, some
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects.in_models import known_effects
from walop_jax.model.noise import COMMON

TRUST_ROWS = 20_000
"""(Exposure, point) pairs whose residuals are searched for patterns after every fit: a second, and half a GB."""
POINTS_TOGETHER = 48  # field points whose columns are made together: 50 MB of 4000 at 16 exposures
MULTIPLIED = 2e6  # numbers of those that are multiplied together: 16 MB
MADE_OF_N = (
    "{} holds the noise of N: SKY is proportional to N, so it is no level of the sky, and what is left of that in the "
    "counts was not asked; give the level that was subtracted, or leave SKY out"
)
DRAWN_TOGETHER = 20  # draws that are projected together: copies of all, in double precision, were 300 MB
DRAWS = 200  # of noise: a fifth of them give the number of trials to 16 %

NOISELESS = 1e-6
"""Squared residuals, beyond the reach of the parameters, of data that hold no noise: rounding, and second order."""


class Diagnosed(NamedTuple):
    """What a diagnosis has of a fit: the fit laid out with its columns, and the scores of what the model may lack.

    `beyond_remedy` is True where the model has so many descriptions that nothing would make them an explanation.
    """

    design: Design
    candidates: ScoreTable
    beyond_remedy: bool = False


def examined(
    result: FitResult, seed: int = 0, *, as_written: bool = False, diagnosed: Diagnosed | None = None
) -> FitResult:
    """The fit with the verdict on it: what its residuals say against it, beside χ², priors and convergence.

    A fit that does not explain its data is held against other readings of them (`discrete`), unless these were tried
    already (`as_written`), then against `remedies`: larger errors, rows left out, another value of a stated number.
    `seed` is that of the Monte Carlo p, `diagnosed` what a diagnosis of the same fit has found already.
    Of a set with more than `TRUST_ROWS` (exposure, point) pairs, points spread over the field are looked at; cells of
    whole frames are joined to so many (`joined_cells`), and those spread over the field are asked what differs between
    places.
    A χ² that is a few per cent too large while nothing else is wrong is put down to the stated errors, and the
    standard errors are made from the residuals. Raises `DataError` with the remedy for a camera that holds one
    number everywhere, and for data that another reading explains.
    """
    refuse_dead_cameras(result)
    if not result.converged:
        if not as_written and result.chi2 > FAR_OFF * max(result.dof, 1):
            refuse_mixups(result)
        return result.with_verdict()
    near = result.explains_data or result.nearly_explains_data
    if not (near or as_written):
        refuse_mixups(result)
    seen = sampled(result)
    beyond_remedy = diagnosed is not None and diagnosed.beyond_remedy
    cures = () if near or beyond_remedy else _remedies(result, seen, seed)
    if cures:
        return result.with_verdict(remedies=cures)
    if diagnosed is not None and seen is result:
        design = dataclasses.replace(diagnosed.design, fit=result)
    else:
        design = Design.of(seen)
    if result.errors_too_large and _hold_no_noise(design):
        return result.with_verdict(noiseless=True)
    places = design if seen is result or result.calset.fine is None else Design.of(_spread(result))
    asked = [c for c in variance_components(design) if places is design or not c.grouping.structure]
    if places is not design:
        asked += variance_components(places, structure_alone=True)
    components = found_components(asked)
    hidden = singles = None
    if near:
        singles = Singles.of(design)
        # The product of a diagnosis has further effects.
        hidden = undetected_errors(design, singles)
        candidates = diagnosed.candidates if diagnosed else candidate_scores(design, seed, singles)
        design.columns.forget()  # responses of a thousand points, ahead of the large matrices of the patterns
        doubts = (
            *stated_conditions(design, singles),
            *_significant(
                "hold patterns that noise does not make",
                pattern_scores(design, seed),
                result.model.template.cameras.names,
            ),
            *_significant("are explained better by a missing effect", candidates),
            *in_words(components),
            *_groups(design),
            *repeated_noise(design),
        )
    else:  # anything may be in such residuals; what single places of the field share sits on stars as well
        components = [component for component in components if component.grouping.structure]
        doubts = (*stated_conditions(design), *in_words(components))
    doubts = (*doubts, *_finer(result), *_fitted_errors(result))
    structure = structure_of(components)
    final = with_empirical_covariance(result)
    if structure:
        final = with_structure(final, places, components, len(result.calset.points))
    final = final.with_verdict(doubts, structure=_with_finer(result, structure))
    if unseen := hidden.not_measured() if hidden is not None else ():
        final = final.with_remark(NOT_MEASURED.format("; ".join(unseen)))
    for what in singles.of_noise if singles is not None else ():
        final = final.with_remark(MADE_OF_N.format(what))
    return dataclasses.replace(final, hidden=hidden)


def _fitted_errors(result: FitResult) -> Iterator[str]:
    """A sentence for every fitted scale of N_ERR that is so large that a misfit was taken for noise."""
    for name, value in zip(result.model.names, result.values.tolist(), strict=True):
        if name.startswith(COMMON) and value > thresholds.PART:
            yield (
                f"the errors are fitted as {value:.3g} times N_ERR ({name}): they take a misfit for noise; "
                "walop-jax diagnose looks for the cause, with errors held at what no candidate explains"
            )


def candidate_scores(design: Design, seed: int = 0, singles: Singles | None = None) -> ScoreTable:
    """Scores of all effects and descriptions that a model may lack (`grammar.hypotheses`), with their corrected p.

    Only products of the columns of a candidate with each other, the residuals and the projection are needed, so the
    columns are made for some points at a time; those of `singles` are there already. Their scores in draws of noise
    give the number of independent trials, as in a diagnosis, so that both correct p alike.
    """
    fit, calset, basis = design.fit, design.fit.calset, design.projector.basis
    listed = grammar.hypotheses(
        known_effects(fit.model), fit.model.template, calset.exposures, len(calset.points)
    )
    probes = listed.beside(fit.model.effect_names)
    numbers = (item.single for item in (singles.items if singles else ()))
    known = {n.candidate.name: n.candidate.columns for n in numbers if n.probe}
    residual = design.projector(design.residual)
    noise = float(np.sqrt(residual @ residual / max(design.projector.free, 1))) or 1.0
    normal = np.random.default_rng(seed).standard_normal((len(residual), DRAWS), dtype=np.float32)
    for first in range(0, DRAWS, DRAWN_TOGETHER):
        at = slice(first, first + DRAWN_TOGETHER)
        normal[:, at] = design.projector(normal[:, at])
    asked, first, sums = [probe for probe in probes if probe.name not in known], 0, dict[str, _Products]()
    used = design.measured.used
    for number, made in enumerate(candidates_by_points(design.columns, asked, POINTS_TOGETHER)):
        points = slice(number * POINTS_TOGETHER, (number + 1) * POINTS_TOGETHER)
        rows = slice(first, first := first + design.measured.cameras * int(used[points].sum()))
        shown = [probe for probe in probes if probe.name in known or probe.name in made]
        for group in _in_groups(shown, MULTIPLIED / max(1, rows.stop - rows.start)):
            joined = np.empty((sum(len(p.widths) for p in group), rows.stop - rows.start)).T
            places, last = list[slice](), 0
            for p in group:
                places.append(at := slice(last, last := last + len(p.widths)))
                if p.name in known:
                    joined[:, at] = known[p.name][rows]
                else:
                    np.divide(made[p.name].columns, fit.noise_scale, out=joined[:, at], dtype=float)
            along, scores = basis[rows].T @ joined, joined.T @ residual[rows]
            drawn = joined.T.astype(np.float32) @ normal[rows]
            for p, at in zip(group, places, strict=True):
                c = joined[:, at]
                products = _Products(c.T @ c, along[:, at], scores[at], drawn[at])
                sums[p.name] = products if p.name not in sums else sums[p.name].plus(products)
    scored = [probe for probe in probes if probe.name in sums]
    if not scored:
        return ScoreTable((), noise, 1.0, 1.0)
    parts = [sums[probe.name] for probe in scored]
    gram = Blocks([part.square - part.along.T @ part.along for part in parts])
    space = ScoreSpace(
        names=tuple(probe.name for probe in scored),
        sizes=tuple(len(probe.widths) for probe in scored),
        widths=np.concatenate([probe.widths for probe in scored]),
        before=np.concatenate([np.diag(part.square) for part in parts]),
        gram=gram,
        free=design.projector.free,
    )
    trials = effective_trials(space.smallest_of(np.concatenate([part.drawn for part in parts])))
    scores = np.concatenate([part.scores for part in parts])
    return space.table_after(ScoreTable((), noise, 1.0, trials), scores)


class _Products(NamedTuple):
    """Products of the columns C of a candidate: CᵀC, those with the basis of the parameters, residuals, draws."""

    square: np.ndarray
    along: np.ndarray
    scores: np.ndarray
    drawn: np.ndarray

    def plus(self, other: _Products) -> _Products:
        """Those of the rows of both."""
        return _Products(*(mine + theirs for mine, theirs in zip(self, other, strict=True)))


def _in_groups(probes: Sequence[Probe], amplitudes: float) -> Iterator[list[Probe]]:
    """Probes in their order, in groups of about so many amplitudes."""
    group_of = np.cumsum([len(probe.widths) for probe in probes]) // max(1, int(amplitudes))
    for _, group in itertools.groupby(zip(group_of.tolist(), probes, strict=True), lambda entry: entry[0]):
        yield [probe for _, probe in group]


def _finer(result: FitResult) -> Iterator[str]:
    """Structure finer than the cells of whole frames, all over the field."""
    if (fine := result.calset.fine) is not None and fine.everywhere:
        yield (
            f"residuals of the same pixel agree between exposures: structure of {fine.everywhere:.2g}, finer than the "
            "cells of the frames, that the model does not have"
        )


def _with_finer(result: FitResult, structure: Structure) -> Structure:
    """The structure of field points with that of the pixels in their cells."""
    fine = 0.0 if result.calset.fine is None else result.calset.fine.everywhere
    return dataclasses.replace(structure, gain=float(np.hypot(structure.gain, fine)))


def _remedies(result: FitResult, seen: FitResult, seed: int) -> tuple[str, ...]:
    """What would turn the residuals of a fit into noise, the best remedy first; `seen` are its field points."""
    rough = any(_finer(result))

    def is_noise(fitted: FitResult) -> bool:
        design = Design.of(fitted)
        if rough or found_components(variance_components(design)) or any(_groups(design)):
            return False
        return pattern_scores(design, seed).p_global >= thresholds.ALARM

    return remedies(seen, is_noise)


def _hold_no_noise(design: Design) -> bool:
    """True if the data are the model's at some values of its parameters: what priors pull at, noise has not made."""
    remainder = Projector(design.jacobian[: design.rows])(design.residual[: design.rows])
    return float(remainder @ remainder) < NOISELESS * design.rows


def sampled(result: FitResult, most: int = 0) -> FitResult:
    """The fit seen at about `most` field points (0: those of `TRUST_ROWS`): all cells, joined, or points of a table."""
    if result.calset.fine is None:
        return _spread(result, most)
    return _seen_at(result, joined_cells(result.calset, most or _most(result)))


def _spread(result: FitResult, most: int = 0) -> FitResult:
    """The fit seen at no more than `most` field points, spread over the field."""
    return _seen_at(result, thinned(result.calset, most or _most(result), neighbours=1))


def _most(result: FitResult) -> int:
    return max(1, TRUST_ROWS // max(len(result.calset.exposures), 1))


def _seen_at(result: FitResult, calset: CalibrationSet) -> FitResult:
    if calset is result.calset:
        return result
    return dataclasses.replace(result, likelihood=Likelihood.of(calset, result.model))


def _significant(finding: str, table: ScoreTable, cameras: Sequence[str] = ()) -> Iterator[str]:
    """A doubt if the lowest p-value of a table is below the threshold; `cameras` where its candidates are patterns."""
    if table.p_global < thresholds.ALARM:
        listed = table.significant(thresholds.ALARM, thresholds.SHOWN)
        names = " | ".join(pattern_in_words(name, cameras) for name in listed)
        found, limit = beside(table.p_global, thresholds.ALARM, ".{}g")
        yield (
            f"the residuals {finding} (p = {found}, limit {limit}; nearest: {names}): "
            "walop-jax diagnose looks for the cause"
        )


class _GroupScore(NamedTuple):
    """Squared residuals of a group of the data beside those of the rest.

    `ratio` is 1 where the group scatters as the rest does; `p_value` that of a ratio so far from 1, on either side.
    """

    name: str
    ratio: float
    p_value: float


def group_scores(design: Design) -> list[_GroupScore]:
    """Every camera, kind, filter and exposure of a fit by itself."""
    measured = design.measured
    residual = design.cube(design.projector(design.residual))
    shared = measured.shared
    power = shared.summed(measured.model**2)
    w = np.where(measured.known[..., None], 0.0, measured.model**2 / np.where(power > 0, power, 1.0))
    absorbed = design.cube(np.sum(design.projector.basis**2, axis=1))
    expected = np.where(measured.used[..., None], np.clip(1.0 - w - absorbed, 0.0, None), 0.0)
    scores = []
    for name, chosen in _groups_of(design).items():
        group = np.broadcast_to(chosen, residual.shape) & measured.used[..., None]
        complement = ~group & measured.used[..., None]
        means = [float(expected[subset].sum()) for subset in (group, complement)]
        if min(means) <= 0:
            continue
        # ‖P‖² among what has a flux in common; further coupling by parameters is small beside it.
        flux_shares = [np.where(subset, w, 0.0) for subset in (group, complement)]
        sums = [shared.summed(subset) for subset in flux_shares]
        squared_norms = [
            np.where(subset, (1.0 - w) ** 2 - w**2, 0.0).sum() + np.sum(t * s)
            for subset, t, s in zip((group, complement), flux_shares, sums, strict=True)
        ]
        variance = 2.0 * (squared_norms[0] / means[0] ** 2 + squared_norms[1] / means[1] ** 2)
        variance -= 4.0 * np.sum(flux_shares[0] * sums[1]) / (means[0] * means[1])
        squares = [float(np.sum(residual[subset] ** 2)) for subset in (group, complement)]
        ratio = squares[0] / means[0] / max(squares[1] / means[1], 1e-300)
        degrees = 2.0 / variance
        above = float(special.chdtrc(degrees, ratio * degrees))
        scores.append(_GroupScore(name, ratio, 2.0 * min(above, 1.0 - above)))
    return scores


def _groups_of(design: Design) -> Mapping[str, Bool[np.ndarray, "1 e k"]]:
    e, cameras = design.fit.calset.exposures, design.fit.model.template.cameras.names
    all_data = np.ones((1, len(e), len(cameras)), bool)
    groups = {f"camera {name}": all_data & (np.arange(len(cameras)) == k) for k, name in enumerate(cameras)}
    for what, labels in (("kind", e.kind), ("filter", e.filter), ("exposure", e.exposure)):
        for label in np.unique(labels):
            groups[f"{what} {label}"] = all_data & (labels == label)[None, :, None]
    return groups


def _groups(design: Design) -> Iterator[str]:
    scores = group_scores(design)
    # A part of the data so small that chance moves it by a quarter is held to a far smaller p by the number of groups.
    limit, most = local_p(thresholds.ALARM, len(scores)), 1.0 + thresholds.UNEVEN
    odd = [s for s in scores if s.p_value < limit and not 1.0 / most < s.ratio < most]
    if odd:
        odd.sort(key=lambda s: -abs(np.log(max(s.ratio, 1e-12))))
        listed = some([f"{s.name} {s.ratio:.3g}" for s in odd], thresholds.SHOWN)
        yield f"some parts of the data scatter more than the rest (mean squared residual): {listed}"
