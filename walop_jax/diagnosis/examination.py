"""One examination of a fit: its design, the scores of every effect and pattern, and the names in order of evidence."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy import stats

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import grammar, naming
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.effect_columns import Probe
from walop_jax.diagnosis.findings import Alike, Limit
from walop_jax.diagnosis.freeform import SINGLE_EXPOSURES, number_of_columns, strata
from walop_jax.diagnosis.score import (
    Projector,
    Score,
    Scorer,
    ScoreSpace,
    ScoreTable,
    corrected_p,
    separations,
)
from walop_jax.diagnosis.sentence_columns import all_candidates
from walop_jax.diagnosis.two_steps import Behind, name_first
from walop_jax.fit.refit import FitResult
from walop_jax.likelihood import limits
from walop_jax.model.effects import Described, Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import field_declarations

Vector = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "_ _"]

ALARM = 0.0027  # three standard deviations
COMMON_MODE = 0.05  # rms (σ of one intensity) of disturbances that one camera in one exposure may have
PROBABILITY = 0.95
MOST_PATTERNS = 8
MOST_CLASSES = 8
LEAST_SHARE = 0.1  # of what is missing that an addition must explain
FLOOR = 1.25  # standard deviations of what is left above which the stated errors are not those of the data
SAME_COUNTS = 0.01  # relative change of the counts up to which columns are kept


@dataclasses.dataclass(frozen=True)
class _Absorbed:
    """What the parameters of an active effect absorb: the projection without them, and the columns' share of it."""

    rest: Projector
    basis: Matrix
    columns: Matrix  # basisᵀ C


class Examination:
    """The scores of everything against one fit.

    `named` and `said` are the columns of effects and of sentences ahead of any projection, `space` and `columns` those
    of all candidates behind it: effects, sentences, patterns. `ranked` are the effects in order of linear evidence,
    `told` the sentences, each less what it pays for being one of so many (`grammar`), `patterns` the scores of the
    free-form strata, `blocks` the blocks of the free-form term that can take candidates up. `scorer` has scored all,
    behind the nuisance that single exposures may have.
    """

    def __init__(
        self,
        result: FitResult,
        wanted: Sequence[Probe],
        rng: np.random.Generator,
        earlier: Examination | None = None,
        sentences: Sequence[Probe] = (),
        parts: Sequence[tuple[Probe, frozenset[type[Effect]]]] = (),
    ) -> None:
        """`earlier` is of a smaller model; its columns serve again where the light has hardly changed.

        `parts` are sentences that are told as the effects that hold them (`history.parts`).
        """
        self.result = result
        active = result.model.effect_names
        self.design = Design.of(result)
        inactive = [probe for probe in wanted if probe.effect.name not in active]
        every = [*sentences, *(probe for probe, _ in parts)]
        self.named, self.said = (
            all_candidates(result.likelihood, result.model, result.values, inactive, every)
            if earlier is None or not self._is_like(earlier)
            else (earlier.named, earlier.said)
        )
        self.probes = [probe for probe in inactive if probe.name in self.named]
        self.sentences = tuple(probe for probe in sentences if probe.name in self.said)
        self.parts = [
            (probe, {effect for effect in effects if effect.name not in active})
            for probe, effects in parts
            if probe.name in self.said
        ]
        patterns = [self.design.measured.candidate(stratum) for stratum in strata(self.design.measured)]
        candidates = [
            *(self.named[probe.name] for probe in self.probes),
            *(self.said[probe.name] for probe in self.sentences),
            *(self.said[probe.name] for probe, _ in self.parts),
            *patterns,
        ]
        self.blocks = {candidate.name: candidate.block for candidate in candidates}
        names, widths = [c.name for c in candidates], [c.widths for c in candidates]
        self.columns = self.design.stacked([candidates.pop(0).columns for _ in names])
        self._absorbed = {}
        for name in active:
            rest, basis = self.design.without(name)
            self._absorbed[name] = _Absorbed(rest, basis, basis.T @ self.columns)
        self.space = ScoreSpace.projected(self.design.projector, names, widths, self.columns)
        r = self.design.projector(self.design.residual)
        self._scored = self.space, self.columns.T @ r, float(r @ r)
        self.common_mode = np.zeros(0)
        if SINGLE_EXPOSURES in names:
            self.common_mode = self._common_mode()
            space, reduce = self.space.with_base([SINGLE_EXPOSURES], self.common_mode)
            self._scored = space, *reduce(*self._scored[1:])
        self._rng = rng
        self.scorer = Scorer(self._scored[0], rng)
        self.table: ScoreTable = self.scorer(*self._scored[1:])
        self.ranked = naming.rank(self.table, self.probes)
        self.told = grammar.rank(self.table, self.sentences)
        self.patterns = [self.table[name] for name in names[len(names) - len(patterns) :]]
        # Where the base is excluded, a name competes with patterns that have none, not with the base.
        self.least_evidence = min(0.0, max(s.log_bayes for s in self.patterns if s.testable))

    @property
    def floor(self) -> float:
        """What is left behind everything that was looked for, in standard deviations of the data as stated; 1 or more.

        Above `FLOOR` no candidate explains the data to within N_ERR. Evidence and separations then count in this unit:
        in that of photons everything would be certain.
        """
        return self.table.noise_scale if self.table.noise_scale > FLOOR else 1.0

    def _is_like(self, earlier: Examination) -> bool:
        """Whether the expected counts differ so little that derivatives with respect to anything else do as well."""
        ours, theirs = self.design.measured.model, earlier.design.measured.model
        return bool(np.linalg.norm(ours - theirs) < SAME_COUNTS * np.linalg.norm(theirs))

    def _common_mode(self) -> Vector:
        """Prior widths of the gains of single exposures that amount to `COMMON_MODE` per intensity."""
        at = self.space.places()[SINGLE_EXPOSURES]
        points = np.repeat(self.design.measured.used.sum(axis=0), len(self.design.measured.gained))
        square = np.where(self.space.before[at] > 0, self.space.before[at], np.inf)
        return np.maximum(COMMON_MODE * np.sqrt(points / square), 1e-30)

    @cached_property
    def _beside_patterns(self) -> tuple[list[tuple[str, float]], ScoreTable]:
        """Patterns that are needed, and the scores of everything with those as nuisances."""
        space, scores, square = self._scored
        names = [score.name for score in self.patterns]
        table, needed = self.table, []
        while len(needed) < MOST_PATTERNS:
            left = [s for s in table.scores if s.name in names and s.testable and self._p(s) < ALARM]
            if not left:
                break
            best = max(left, key=lambda s: s.log_bayes)
            needed.append((best.name, self._p(best)))
            names.remove(best.name)
            space, reduce = space.with_base([best.name])
            scores, square = reduce(scores, square)
            table = Scorer(space, self._rng, draws=0).after(self.table, scores)
        return needed, table

    def _p(self, score: Score) -> float:
        return corrected_p(score.log_p, self.table.trials)

    def patterns_needed(self) -> list[tuple[str, float]]:
        """Patterns that together leave nothing significant, with corrected p: the most probable first, one by one."""
        return self._beside_patterns[0]

    def best_pattern(self) -> float:
        """Evidence of the most probable pattern, less what it pays for being one of several."""
        alive = [score.log_bayes for score in self.patterns if score.testable]
        return max(alive, default=-np.inf) - float(np.log(max(len(alive), 1)))

    def stands(self, probes: Sequence[Probe], log_bayes: float) -> bool:
        """Whether an explanation with this evidence need not fear patterns that have no name.

        It is more probable than any of them, or is significant beside those that are needed.
        """
        if log_bayes > self.best_pattern() - naming.EVEN_ODDS:
            return True
        table = self._beside_patterns[1]
        return any(self._p(table[probe.name]) < ALARM for probe in probes if table[probe.name].testable)

    @property
    def alarm(self) -> bool:
        """Whether anything is missing at all."""
        return self.table.p_global < ALARM

    @property
    def noise_p(self) -> float:
        """Chance that noise of the stated size alone leaves as much as this fit does."""
        return float(stats.chi2.sf(self.result.chi2, max(self.result.dof, 1)))

    def summary(self) -> tuple[tuple[str, float, float], ...]:
        """Effects with score and corrected p, most significant first."""
        rows = [(r.effect.name, r.score.statistic, self.table.corrected(r.score)) for r in self.ranked]
        return tuple(sorted(rows, key=lambda row: row[2]))

    def limits(self) -> Iterator[Limit]:
        """What each effect with a single amplitude stays below."""
        for item in self.ranked:
            names = item.effect.amplitudes()
            if len(item.score.amplitudes) != 1 or sum(p.effect is item.effect for p in self.probes) > 1:
                continue
            value, sigma = float(item.score.amplitudes[0]), float(np.sqrt(item.score.covariance[0, 0]))
            unit = field_declarations(item.effect)[names[0]].unit
            one_sided = names[0] in item.effect.one_sided
            below = upper_limit(value, sigma, one_sided=one_sided)
            yield Limit(item.effect.name, names[0], unit, value, sigma, below)

    def untestable(self, catalogue: Sequence[type[Effect]]) -> tuple[str, ...]:
        """Effects that these data cannot show at any plausible size."""
        seen = {probe.effect.name for probe in self.probes if self.table[probe.name].testable}
        seen.update(self.result.model.effect_names)
        return tuple(
            effect.name for effect in catalogue if effect.name not in seen and not effect.is_structural()
        )

    def separation(self, name: str, change: Vector) -> dict[str, float]:
        """How far (σ) each rival stays from an active effect that changes the residuals (data rows) by `change`."""
        own = self._absorbed[name]
        whole = np.pad(change, (0, len(self.design.residual) - len(change)))
        projected = own.rest(whole)
        space = dataclasses.replace(self.space, gram=self.space.gram + own.columns.T @ own.columns)
        scores = self.columns.T @ projected + own.columns.T @ (own.basis.T @ projected)
        found = self.nearest(separations(space, scores, float(projected @ projected)))
        return {rival: apart / self.floor for rival, apart in found.items()}

    def classes(self) -> Iterator[Alike]:
        """Which other effects could follow what each significant one would explain, by linear steps."""
        for item in self.significant[:MOST_CLASSES]:
            apart = self.nearest(self._apart(item))
            close = {name: value for name, value in apart.items() if value < naming.SEPARATION * self.floor}
            close.pop(item.effect.name, None)
            if close:
                yield Alike(
                    item.effect.name, tuple(sorted(close, key=close.__getitem__)), item.effect.separated_by
                )

    def nearest(self, by_candidate: Mapping[str, float]) -> dict[str, float]:
        """The smallest number of each effect among those of its probes."""
        found: dict[str, float] = {}
        for probe in self.probes:
            effect = probe.effect.name
            found[effect] = min(by_candidate[probe.name], found.get(effect, np.inf))
        return found

    @cached_property
    def significant_sentences(self) -> list[naming.Ranked]:
        """Sentences that are significant by themselves, best evidence first."""
        return [r for r in self.told if self.table.corrected(r.score) < ALARM]

    def _behind(self, item: naming.Ranked) -> Behind:
        """What is left to be told when one candidate has joined the base, by a linear step."""
        space, scores, square = self._scored
        space, reduce = space.with_base([item.probe.name])
        table = Scorer(space, self._rng, draws=0).after(self.table, reduce(scores, square)[0])
        probes = [probe for probe in self.probes if probe.effect is not item.effect]
        said = [probe for probe in self.sentences if probe is not item.probe]
        return Behind(naming.rank(table, probes), grammar.rank(table, said), table.p_global)

    def sentences_before_names(self) -> list[naming.Ranked]:
        """Sentences that are more probable than every name; none where names suffice and they do not (`two_steps`)."""
        names, found = self.significant, self.significant_sentences
        if names:
            found = [item for item in found if item.log_bayes > names[0].log_bayes]
        return [] if found and name_first(names, found[0], self._behind, ALARM) else found

    def nameless(self, trial: naming.Trial) -> tuple[str, ...]:
        """Sentences beside what a trial says, by linear steps: not improbable, or no longer and not to be told from it.

        The most probable come first.
        """
        item, own = self._linear(trial), _sentences_of(trial)
        if item is None:
            return ()
        least, alike = max(0.0, item.log_bayes - naming.IMPROBABLE), self._alike(item)
        others = [r for r in self.told if r.log_bayes > least or r.probe.name in alike]
        others = [r for r in others if not own & set(grammar.said_by(r.probe))]
        return tuple(r.probe.name for r in others[:MOST_CLASSES])

    def held_in_part(self, trial: naming.Trial) -> tuple[str, ...]:
        """Effects that, were all but a part of them zero, would not be improbable beside what a trial says."""
        item = self._linear(trial)
        if item is None:
            return ()
        return naming.held_in_part(self.table, self.parts, item)

    def _linear(self, trial: naming.Trial) -> naming.Ranked | None:
        """What a trial says, as it was ranked by linear steps."""
        own = _sentences_of(trial)
        if own:
            return next((r for r in self.told if own & set(grammar.said_by(r.probe))), None)
        return next((r for r in self.ranked if r.effect is trial.effect), None)

    def _alike(self, item: naming.Ranked) -> set[str]:
        """Sentences no longer than a candidate that the data cannot tell from what it does."""
        apart, length = self._apart(item), len(item.score.amplitudes)
        limit = naming.SEPARATION * self.floor
        return {p.name for p in self.sentences if len(p.widths) <= length and apart[p.name] < limit}

    def _apart(self, item: naming.Ranked) -> dict[str, float]:
        """How far (σ) every candidate stays from what one does at its amplitudes, by linear steps."""
        at, amplitudes = self.space.places()[item.probe.name], item.score.amplitudes
        change = self.space.gram[:, at] @ amplitudes
        return separations(self.space, change, float(amplitudes @ change[at]))

    def is_worth_telling(self, trial: naming.Trial) -> bool:
        """Whether a trial explains a good part of what is missing, and patterns without a name do not do so better."""
        evidence = trial.log_bayes / self.floor**2
        if evidence <= self.least_evidence:
            return False
        missing, moved = self.result.chi2 - self.result.dof, self.result.chi2 - trial.fit.chi2
        if moved < LEAST_SHARE * missing:
            return False
        # What is left is noise, and was not before: a pattern can only say the same with more numbers.
        if trial.fit.explains_data and not self.result.explains_data:
            return True
        probes = [probe for probe in self.probes if probe.effect is trial.effect]
        return self.stands(probes, evidence) if probes or trial.effect is Described else True

    @cached_property
    def significant(self) -> list[naming.Ranked]:
        """Effects that are significant by themselves, best evidence first."""
        return [r for r in self.ranked if self.table.corrected(r.score) < ALARM]


def _sentences_of(trial: naming.Trial) -> set[str]:
    return set(trial.instance.sentences) if isinstance(trial.instance, Described) else set()


def most_points(calset: CalibrationSet, instrument: Instrument, amplitudes: int) -> int:
    """Number of field points that are looked at: as many as rows, and numbers in all columns, may be.

    `amplitudes` are those of the effects that are examined.
    """
    columns = amplitudes + number_of_columns(calset, instrument)
    exposures = len(calset.exposures)
    numbers = exposures * calset.cameras * columns
    return max(1, min(limits.DIAGNOSED_ROWS // exposures, limits.DIAGNOSED_NUMBERS // numbers))


def upper_limit(value: float, sigma: float, *, one_sided: bool) -> float:
    """Size that an amplitude stays below with 95 % probability, for a flat prior (positive when one-sided)."""
    if one_sided:
        below_zero = stats.norm.cdf(-value / sigma)
        return float(value + sigma * stats.norm.ppf(below_zero + PROBABILITY * (1.0 - below_zero)))
    return float(stats.foldnorm.ppf(PROBABILITY, abs(value) / sigma, scale=sigma))
