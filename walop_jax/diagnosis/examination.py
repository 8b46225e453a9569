"""Candidates for missing physics, by linear algebra: scores, ranking by evidence, equivalent candidates.

Evidence      Of a candidate alone: ln B of the score test (`score.log_bayes`). Alternative shapes of an effect share
              its prior, descriptions share that of one name.
Separation    The change D of the residuals that a candidate makes at its amplitudes, projected off the other
              parameters, is fitted by each rival; the length of the remainder is the separation in
              standard deviations (Atkinson & Fedorov 1975, Biometrika 62, 57). Below `thresholds.SEPARATION` the data
              cannot tell the two apart, nor when their evidence differs by less than `thresholds.IMPROBABLE`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy import special

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import GAIN, SINGLE_EXPOSURES, Design, number_of_columns, strata
from walop_jax.diagnosis.hypotheses import Hypotheses, Probe, Ranked, SmoothField, all_candidates
from walop_jax.diagnosis.score import Candidate, Score, ScoreSpace, ScoreTable, log_bayes, separations
from walop_jax.diagnosis.smooth_fields import SmoothFields
from walop_jax.diagnosis.synonyms import synonyms
from walop_jax.fit.refit import FitResult
from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.likelihood import limits
from walop_jax.model.effects import Described, EffectKind
from walop_jax.model.effects.in_models import effect_context
from walop_jax.model.instrument import Instrument


def rank(table: ScoreTable, probes: Sequence[Probe]) -> list[Ranked]:
    """Effects by evidence, best first; alternative shapes share the prior of their effect."""
    by_effect: dict[EffectKind, list[tuple[Probe, Score]]] = {}
    for probe in probes:
        by_effect.setdefault(probe.effect, []).append((probe, table[probe.name]))
    ranked = []
    for shapes in by_effect.values():
        alive = [(p, s) for p, s in shapes if s.testable and follow_physics(p, s.amplitudes, s.covariance)]
        if not alive:
            continue
        alive.sort(key=lambda item: -item[1].log_bayes)
        probe, score = alive[0]
        mean = float(np.logaddexp.reduce([s.log_bayes for _, s in alive]) - np.log(len(shapes)))
        ranked.append(Ranked(probe, score, mean))
    return sorted(ranked, key=lambda item: -item.log_bayes)


def follow_physics(probe: Probe, amplitudes: AnyVector, covariance: AnyMatrix) -> bool:
    """True if a linear step leaves one-sided amplitudes on their side, within `thresholds.SEPARATION`."""
    sigma = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    return bool(np.all((amplitudes >= -thresholds.SEPARATION * sigma)[probe.one_sided]))


def shortest(item: Ranked) -> Described:
    """The descriptions of a group that are worth their length, with the amplitudes of a linear step.

    All subsets of `thresholds.MOST_TOGETHER` members or fewer are compared, and those that the whole group passes
    through as it loses its least probable member again and again.
    """
    information = np.linalg.pinv(item.score.covariance, hermitian=True)
    scores, widths = information @ item.score.amplitudes, item.probe.widths

    def worth(indices: Sequence[int]) -> float:
        return log_bayes(information[np.ix_(indices, indices)], scores[indices], widths[indices])

    subset, most = list(range(len(widths))), thresholds.MOST_TOGETHER
    sizes = range(1, min(len(subset), most) + 1)
    subsets = [list(indices) for size in sizes for indices in itertools.combinations(subset, size)]
    while len(subset) > most:
        subsets.append(subset)
        subset = max(([i for i in subset if i != index] for index in subset), key=worth)
    best = max(subsets, key=worth)
    amplitudes = np.linalg.lstsq(information[np.ix_(best, best)], scores[best], rcond=None)[0]
    return Described.combine([item.probe.group[i] for i in best], amplitudes)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """The part of one set of residuals that each candidate explains beyond the base parameters.

    `space` is that of all candidates behind the nuisance that single exposures may have, `scores` are C̃ᵀr and
    `square` r·r there. `probes` are effects, `descriptions` what else can be said, `parts` those that are reported as
    the effects that hold them (`grammar.beside_names`), `patterns` the names of patterns without a name. `chi2` and
    `dof` are those of the fit, `scale` the factor on the errors with which it was made. `synonyms` are other
    names of candidates (`synonyms.synonyms`).
    """

    space: ScoreSpace
    scores: AnyVector
    square: float
    table: ScoreTable
    probes: Sequence[Probe]
    descriptions: Sequence[Probe]
    parts: Sequence[Probe]
    patterns: Sequence[str]
    chi2: float
    dof: int
    scale: float = 1.0
    synonyms: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)

    @cached_property
    def smooth(self) -> SmoothFields | None:
        """Smooth fields that may be missing; None where columns were not kept."""
        return None

    def products_with(self, name: str) -> AnyMatrix:
        """CᵀC behind the free parameters, of all candidates C with one of them."""
        return self.space.gram[:, self.space.places()[name]]

    @property
    def asked(self) -> tuple[Probe, ...]:
        """All candidates but patterns."""
        return (*self.probes, *self.descriptions, *self.parts)

    @cached_property
    def ranked(self) -> list[Ranked]:
        """Effects in order of evidence."""
        return rank(self.table, self.probes)

    @property
    def price(self) -> float:
        """Logarithm of the number of descriptions, which share the prior of one name: each pays it."""
        return float(np.log(max(len(self.descriptions), 1)))

    @cached_property
    def ranked_descriptions(self) -> list[Ranked]:
        """Descriptions in order of evidence, each less the logarithm of their number."""
        price = self.price
        scored = [(probe, self.table[probe.name]) for probe in self.descriptions]
        candidates = (Ranked(p, s, s.log_bayes - price) for p, s in scored if s.testable)
        return sorted(candidates, key=lambda item: -item.log_bayes)

    @cached_property
    def by_name(self) -> Mapping[str, Ranked]:
        """Effects and descriptions by name."""
        return {item.name: item for item in (*self.ranked, *self.ranked_descriptions)}

    def is_clear(self, score: Score) -> bool:
        """True if a candidate is significant by itself, after correction for all."""
        return self.table.corrected(score) < thresholds.ALARM

    @cached_property
    def significant(self) -> list[Ranked]:
        """Effects that are significant by themselves, best evidence first."""
        return [item for item in self.ranked if self.is_clear(item.score)]

    @cached_property
    def significant_descriptions(self) -> list[Ranked]:
        """Descriptions that are significant by themselves, best evidence first."""
        return [item for item in self.ranked_descriptions if self.is_clear(item.score)]

    @property
    def alarm(self) -> bool:
        """True if the model is incomplete at the threshold `thresholds.ALARM`."""
        return self.table.p_global < thresholds.ALARM

    @property
    def poor(self) -> bool:
        """True if the fit is poor enough to try changes that have no derivative."""
        return self.chi2 > thresholds.POOR_FIT * self.dof

    @property
    def scatter(self) -> float:
        """Scatter behind all candidates, in errors of the fit (N_ERR times `FitResult.noise_scale`); 1 or more.

        Above `thresholds.FLOOR` no candidate explains the data to within N_ERR. Evidence and separations then count in
        this unit: in that of photons everything would be certain.
        """
        return self.table.noise_scale if self.table.noise_scale > thresholds.FLOOR else 1.0

    def by_fit(self, score: Score) -> float:
        """What a fit of this candidate finds as ln B, less its ln B by the linear step.

        Fits count in the errors of the fit that is examined, linear steps in units of the scatter behind all
        candidates (`ScoreTable.noise_scale`).
        """
        return 0.5 * score.statistic * (self.table.noise_scale**2 - 1.0)

    @cached_property
    def patterns_needed(self) -> list[tuple[str, float]]:
        """Patterns that together leave nothing significant, with corrected p: the most probable first, one by one."""
        space, scores, square = self.space, self.scores, self.square
        names, table, needed = list(self.patterns), self.table, []
        while len(needed) < thresholds.MOST_PATTERNS:
            clear = [
                s
                for s in map(table.__getitem__, names)
                if s.testable and self.table.corrected(s) < thresholds.ALARM
            ]
            if not clear:
                break
            best = max(clear, key=lambda s: s.log_bayes)
            needed.append((best.name, self.table.corrected(best)))
            names.remove(best.name)
            space, reduce = space.with_base([best.name])
            scores, square = reduce(scores, square)
            table = space.table_after(self.table, scores)
        return needed

    # ------------------------------------------------------------------------------- indistinguishable candidates

    def apart(self, item: Ranked) -> dict[str, float]:
        """Distance (σ) of every candidate from the change of one at its amplitudes, by linear steps."""
        at, amplitudes = self.space.places()[item.probe.name], item.score.amplitudes
        change = self.space.gram[:, at] @ amplitudes
        return separations(self.space, change, float(amplitudes @ change[at]))

    def nearest(self, by_candidate: Mapping[str, float]) -> dict[str, float]:
        """The smallest number of each effect among those of its probes."""
        return smallest((probe.effect.name, by_candidate[probe.name]) for probe in self.probes)

    def close(self, item: Ranked) -> tuple[str, ...]:
        """Effects indistinguishable from a candidate, by linear steps; the nearest first."""
        apart = self.nearest(self.apart(item))
        apart.pop(item.effect.name, None)
        close = {name: s for name, s in apart.items() if s < thresholds.SEPARATION * self.scatter}
        return tuple(sorted(close, key=close.__getitem__))

    def classes(self) -> Iterator[dict[str, Any]]:
        """Rows of a file: effects indistinguishable from each significant one, by linear steps."""
        for item in self.significant[: thresholds.MOST_CLASSES]:
            if close := self.close(item):
                separated_by = item.effect.separated_by
                yield {"effect": item.effect.name, "equivalent": close, "separated_by": separated_by}

    def summary(self) -> tuple[tuple[str, float, float], ...]:
        """Effects with score and corrected p, most significant first."""
        rows = [(r.effect.name, r.score.statistic, self.table.corrected(r.score)) for r in self.ranked]
        return tuple(sorted(rows, key=lambda row: row[2]))

    def limits(self) -> Iterator[dict[str, Any]]:
        """Rows of a file: upper limits on each effect with a single amplitude."""
        for item in self.ranked:
            effect, (name, *_) = item.effect, item.effect.amplitudes()
            if len(item.score.amplitudes) != 1 or sum(p.effect is effect for p in self.probes) > 1:
                continue
            value, sigma = float(item.score.amplitudes[0]), float(np.sqrt(item.score.covariance[0, 0]))
            below = upper_limit(value, sigma, one_sided=name in effect.one_sided)
            yield {
                "effect": effect.name, "parameter": name, "unit": effect.numbers()[name].unit,
                "value": value, "sigma": sigma, "below_95": below,
            }  # fmt: skip


def smallest(pairs: Iterable[tuple[str, float]]) -> dict[str, float]:
    """The smallest number of each name."""
    least: dict[str, float] = {}
    for name, value in pairs:
        least[name] = min(value, least.get(name, np.inf))
    return least


def upper_limit(value: float, sigma: float, *, one_sided: bool) -> float:
    """Size below which an amplitude stays (`thresholds.LIMIT`), for a flat prior (positive when one-sided).

    Quantiles of a normal distribution above 0, and of the size of a normal number, whose square follows χ'² of rank 1.
    """
    if one_sided:
        above = np.log1p(-thresholds.LIMIT) + special.log_ndtr(value / sigma)
        return float(value - sigma * special.ndtri_exp(above))
    return float(sigma * np.sqrt(special.chndtrix(thresholds.LIMIT, 1.0, (value / sigma) ** 2)))


# ----------------------------------------------------------------------------------------------- of one fit


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Examination(Evidence):
    """The evidence of one fit, and its origin.

    `candidates` are those of `space` by name, in its order, with their columns ahead of any projection; `bare` is their
    space ahead of the nuisance of single exposures. `fields` are the changes that may vary smoothly over the field.
    """

    result: FitResult
    design: Design
    candidates: Mapping[str, Candidate]
    bare: ScoreSpace
    fields: Sequence[SmoothField] = ()

    @cached_property
    def smooth(self) -> SmoothFields | None:
        """Smooth fields with their scores, made when they are first asked for; None of a set with too few points.

        Where gradients over the field at two places are the same change (`synonyms`), smooth fields there are as well;
        of changes that are not tried with a gradient those without a pattern tell.
        """
        columns = self.design.columns
        # What is the same everywhere in the field and in all exposures may be the same as a change that follows the
        # field otherwise.
        by_description = {
            field.gradient if field.gradient in self.candidates else field.even: field
            for field in self.fields
            if field.gradient in self.candidates or all(change.factors for change in field.changes)
        }
        also = {
            by_description[name].name: tuple(
                by_description[other].name for other in others if other in by_description
            )
            for name, others in self.synonyms.items()
            if name in by_description
        }
        said = set(itertools.chain(*also.values()))
        fields = [
            field
            for field in self.fields
            if field.name not in said and all(columns.has([(1.0, change)]) for change in field.changes)
        ]
        if not fields:
            return None
        context = effect_context(self.result.model.template, self.result.calset.exposures)
        bases = self.design.projector.basis, self._of_single_exposures()
        return SmoothFields(
            self.design, fields, context, bases, {n: names for n, names in also.items() if names}
        )

    def forget(self) -> None:
        """Give back the memory of the smooth fields, which are laid out anew where they are asked for again."""
        vars(self).pop("smooth", None)

    def _of_single_exposures(self) -> AnyMatrix:
        """Columns Z of which Z Zᵀ is what the disturbances of single exposures take up, behind the free parameters."""
        if SINGLE_EXPOSURES not in self.candidates:
            return np.zeros((len(self.design.residual), 0))
        first = self.bare.places()[SINGLE_EXPOSURES].start
        place, w = self.bare.joining([SINGLE_EXPOSURES], common_mode(self.bare, self.design))
        columns = self.design.stacked([self.candidates[SINGLE_EXPOSURES].columns[:, place - first]])
        return self.design.projector(columns) @ w

    def knows(self, name: str) -> bool:
        """True if a name is that of a candidate or of a smooth field."""
        return name in self.candidates or (self.smooth is not None and name in self.smooth.names)

    def candidate(self, name: str) -> Candidate:
        """A candidate or a smooth field, with its columns."""
        if name in self.candidates or self.smooth is None:
            return self.candidates[name]
        return self.smooth.candidate(name)

    def products_with(self, name: str) -> AnyMatrix:
        """CᵀC behind the free parameters, of all candidates and then all smooth fields C with a candidate by name."""
        smooth = self.smooth
        if smooth is None:
            return super().products_with(name)
        if name in self.candidates:
            of_candidates = super().products_with(name)
            columns = self.design.stacked([self.candidates[name].columns])[: self.design.rows]
            return np.concatenate([of_candidates, smooth.products(smooth.behind(columns))])
        rows = smooth.behind(smooth.columns(name))
        return np.concatenate([self.design.products(self.columns, rows), smooth.products(rows)])

    @property
    def columns(self) -> list[AnyMatrix]:
        """Columns of all candidates."""
        return [candidate.columns for candidate in self.candidates.values()]

    @property
    def noise_p(self) -> float:
        """Probability of a χ² as large as this from noise of the stated size alone."""
        return float(special.chdtrc(max(self.dof, 1), self.chi2))

    def untestable(self, catalogue: Sequence[EffectKind]) -> tuple[str, ...]:
        """Effects not detectable in these data at any plausible size."""
        testable = {probe.effect.name for probe in self.probes if self.table[probe.name].testable}
        testable.update(self.result.model.effect_names)
        return tuple(
            effect.name for effect in catalogue if effect.name not in testable and not effect.is_structural()
        )

    def space_beside(self, basis: AnyMatrix) -> tuple[AnyMatrix, ScoreSpace]:
        """Products of all columns with a basis of parameters that are taken out (`Design.without`); the space then."""
        along = self.design.products(self.columns, basis)
        return along, self.bare.with_known(along)

    def separation(self, name: str, change: AnyVector) -> dict[str, float]:
        """Distance (σ) of each rival from an active effect that changes the residuals (data rows) by `change`."""
        design, columns = self.design, self.columns
        rest, basis = design.without(design.columns_of(self.result.model.positions(name)))
        along, space = self.space_beside(basis)
        projected = rest(np.pad(change, (0, len(design.residual) - len(change))))
        scores = design.products(columns, design.projector(projected)) + along @ (basis.T @ projected)
        distances = self.nearest(separations(space, scores, float(projected @ projected)))
        return {rival: apart / self.scatter for rival, apart in distances.items()}

    def is_like(self, design: Design) -> bool:
        """True if another fit expects nearly the same counts, so that the columns of this one serve it as well."""
        ours, theirs = (of.counts_changed_by(GAIN) for of in (self.design.origin, design.measured))
        return bool(np.linalg.norm(ours - theirs) < thresholds.LINEAR * np.linalg.norm(ours))


def examine(
    result: FitResult,
    hypotheses: Hypotheses,
    rng: np.random.Generator,
    earlier: Examination | None = None,
    *,
    computed: Mapping[str, Candidate] | None = None,
    synonyms_apart: bool = False,
) -> Examination:
    """Score effects that a model has not, descriptions and patterns against a fit.

    Descriptions that say what another candidate says are names of that one (`synonyms`); with `synonyms_apart`, for
    studies, each is a candidate of its own. `earlier` is of a smaller model: its names hold here, and its columns serve
    again where the light has hardly changed. `computed` are effects and descriptions with columns that exist already.
    """
    active, design = result.model.effect_names, Design.of(result)
    known = earlier.synonyms if earlier is not None else {} if synonyms_apart else None
    again = earlier if earlier is not None and earlier.is_like(design) else None
    if again is not None:
        design = dataclasses.replace(design, served_by=again.design.origin)
        computed = again.candidates
    elif computed is None:
        other_names = set(itertools.chain(*(known or {}).values()))
        wanted = [probe for probe in hypotheses.beside(active) if probe.name not in other_names]
        computed = all_candidates(design.columns, wanted)
    probes = [p for p in hypotheses.names if p.name in computed and p.effect.name not in active]
    descriptions = tuple(probe for probe in hypotheses.descriptions if probe.name in computed)
    parts = [
        dataclasses.replace(p, holders=frozenset(kind for kind in p.holders if kind.name not in active))
        for p in hypotheses.parts
        if p.name in computed
    ]
    patterns = (
        [computed[name] for name in again.patterns]
        if again is not None
        else [
            dataclasses.replace(item, columns=item.columns.astype(np.float32))
            for item in map(design.measured.candidate, strata(design.measured))
        ]
    )
    of_probes = [computed[probe.name] for probe in (*probes, *descriptions, *parts)]
    candidates = {candidate.name: candidate for candidate in (*of_probes, *patterns)}
    names = list(candidates)
    widths, columns = zip(*((c.widths, c.columns) for c in candidates.values()), strict=True)
    exact = sum(len(probe.widths) for probe in probes)  # rivals may be the same to the last digit
    scale = result.noise_scale
    if again is not None and again.scale == scale:
        along = design.products(columns, design.projector.basis).T
        bare = again.bare.subset(names).behind(design.projector, along)
    else:
        bare = ScoreSpace.projected(design.projector, names, widths, columns, scale=scale, exact=exact)
    if known is None:
        known = synonyms(design, bare, candidates, (*probes, *descriptions))
        if said := set(itertools.chain(*known.values())):
            descriptions = tuple(probe for probe in descriptions if probe.name not in said)
            names = [name for name in names if name not in said]
            candidates, bare = {name: candidates[name] for name in names}, bare.subset(names)
    r = design.projector(design.residual)
    columns = [candidate.columns for candidate in candidates.values()]
    space, scores, square = bare, design.products(columns, r), float(r @ r)
    if SINGLE_EXPOSURES in names:
        space, reduce = bare.with_base([SINGLE_EXPOSURES], common_mode(bare, design))
        scores, square = reduce(scores, square)
    table = space.table(scores, square, space.smallest_p(rng))
    space.forget()
    return Examination(
        space=space,
        scores=scores,
        square=square,
        table=table,
        probes=probes,
        descriptions=descriptions,
        parts=parts,
        patterns=[pattern.name for pattern in patterns],
        chi2=result.chi2,
        dof=result.dof,
        scale=result.noise_scale,
        result=result,
        design=design,
        candidates=candidates,
        bare=bare,
        fields=hypotheses.smooth,
        synonyms=known,
    )


def common_mode(space: ScoreSpace, design: Design) -> AnyVector:
    """Prior widths of the gains of single exposures that amount to `thresholds.COMMON_MODE` per intensity."""
    at = space.places()[SINGLE_EXPOSURES]
    points = np.repeat(design.measured.used.sum(axis=0), len(design.measured.gained))
    square = np.where(space.before[at] > 0, space.before[at], np.inf)
    return np.maximum(thresholds.COMMON_MODE * np.sqrt(points / square), 1e-30)


def most_points(calset: CalibrationSet, instrument: Instrument, amplitudes: int) -> int:
    """Number of examined field points, from the limits on rows and on numbers in all columns.

    `amplitudes` counts those of all candidates.
    """
    exposures = len(calset.exposures)
    numbers = exposures * calset.cameras * (amplitudes + number_of_columns(calset, instrument))
    return max(1, min(limits.DIAGNOSED_ROWS // exposures, limits.DIAGNOSED_NUMBERS // numbers))
