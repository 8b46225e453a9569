"""The judge of the search that fits: trials, predictions of the data left out, and the model that goes on."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.accuracy import largest_change
from walop_jax.calibration.matrix import instrument_matrices
from walop_jax.diagnosis import grammar, thresholds
from walop_jax.diagnosis.design import Design, exposure_folds, held_out
from walop_jax.diagnosis.exact import (
    Trial,
    context_of,
    other_descriptions,
    refit_without,
    try_effect,
    try_shapes,
    with_refuted_priors_widened,
)
from walop_jax.diagnosis.examination import Examination, examine, shortest
from walop_jax.diagnosis.findings import Choice, FitComparison
from walop_jax.diagnosis.hypotheses import Hypotheses, Ranked, sentences_of
from walop_jax.diagnosis.score import Candidate
from walop_jax.diagnosis.search import Reason, Round, State
from walop_jax.fit.refit import FitResult, fit
from walop_jax.fit.robust import field_cells, states
from walop_jax.io.progress import Stage
from walop_jax.likelihood.columns import columns
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Described, Effect


@dataclasses.dataclass(frozen=True)
class Refits:
    """All that the fits of a search have in common; `adopt` is the only function that gives a state another fit.

    Nothing further is tried after `most` fits, nor `minutes` after the time `began` (infinite: no matter how long it
    takes).
    """

    hypotheses: Hypotheses
    rng: np.random.Generator
    tell: Callable[[str], None]
    minutes: float = np.inf
    began: float = 0.0
    most: int = thresholds.MOST_FITS

    def over(self, fits: int) -> str:
        """Amount of work after which nothing further is tried, in words; empty: there is more to spend."""
        if time.perf_counter() >= self.began + 60.0 * self.minutes:
            return f"{self.minutes:g} minutes"
        return f"{fits} fits" if fits >= self.most else ""

    def examined(self, result: FitResult, earlier: Examination | None = None) -> Examination:
        """A fit, scored; the columns of an `earlier` one serve again where the light has hardly changed."""
        evidence = examine(result, self.hypotheses, self.rng, earlier)
        if evidence.alarm:
            self.tell(Stage(f"p = {evidence.table.p_global:.2g}: something is missing", "naming"))
        return evidence

    def adopt(
        self, state: State, result: FitResult, steps: Sequence[Trial], earlier: Examination | None = None
    ) -> State:
        """The state with another fit of its set, and with the additions that this has."""
        evidence = self.examined(result, earlier or state.evidence)
        return dataclasses.replace(state, evidence=evidence, steps=tuple(steps))

    def fitted(self, evidence: Examination, trial: Trial) -> Trial:
        """A linear trial fitted exactly."""
        item = trial.item
        assert item is not None
        self.tell(f"trying {item.name}")
        if item.effect is Described:
            if not self._hopeful(evidence, item):
                return dataclasses.replace(trial, predicts=False)
            description = self._with_best_times(evidence, shortest(item))
            refitted = try_effect(evidence.result, description, len(evidence.sentences))
        else:
            shapes = sum(probe.effect is item.effect for probe in evidence.probes)
            refitted = try_shapes(evidence.result, item, shapes)
        return dataclasses.replace(refitted, item=item, linear=trial.linear)

    def _with_best_times(self, evidence: Examination, description: Described) -> Described:
        """A description that starts or stops in time, where it explains most by linear steps; any other as it is."""
        ((change, amplitude), *further) = description.terms()
        result = evidence.result
        for end in (0, 1) if not further else ():
            if times := grammar.retimed(change, result.calset.exposures, end):
                c = columns(result.likelihood, result.values, [[(1.0, sentence)] for sentence in times])
                c = evidence.design.projector(evidence.design.stacked([c]))
                along, square = c.T @ evidence.design.residual, np.sum(c**2, axis=0)
                best = int(np.argmax(along**2 / np.where(square > 0, square, np.inf)))
                change, amplitude = times[best], -along[best] / square[best]
        return description if further else Described.saying([change.text], [float(amplitude)])

    def _hopeful(self, evidence: Examination, item: Ranked) -> bool:
        """True if a sentence predicts held-out data by its linear step: it has no name that would support it."""
        single = any("exposure" in text for text in sentences_of(item.probe))
        column = [evidence.candidates[item.probe.name]]
        return predicts_unseen(evidence.design, column, thresholds.HOPEFUL, of_states=not single)

    def others(self, state: State) -> tuple[list[Trial], Mapping[str, Choice]]:
        """The instrument described otherwise; where the model is far off in all ways, and structural effects."""
        result, trials = state.evidence.result, list[Trial]()

        def allowed() -> bool:
            return not self.over(state.fits + len(trials))

        for effect in self.hypotheses.effects if state.evidence.poor else ():
            if effect.is_structural() and effect.name not in result.model.effect_names and allowed():
                self.tell(f"trying {effect.name}")
                trials.append(try_effect(result, effect.neutral(context_of(result))))
        described, compared = other_descriptions(
            result, allowed, self.tell, all_of_them=state.evidence.poor, earlier=state.choices
        )
        return [*trials, *described], {**state.choices, **compared}

    def with_causes(self, state: State, effects: Sequence[Effect]) -> State:
        """The state with discrete causes of what was missing: fitted from the model as designed, and added."""
        for effect in effects:
            result = state.evidence.result
            self.tell(f"fitting {getattr(effect, 'change', '') or effect.name}")
            trial = try_effect(result, effect, start=result.model.start)
            if trial.fit is None or not trial.fit.converged or trial.left > state.evidence.chi2:
                continue
            trial = self.confronted(state.evidence, trial)
            p, reason = (
                state.evidence.table.p_global,
                Reason(trial.name, trial.evidence, 0.0, fitted=True, reason=""),
            )
            state = dataclasses.replace(self.adopted(state, trial), fits=state.fits + 1)
            state = dataclasses.replace(state, rounds=(*state.rounds, Round(p, trial.name, (reason,))))
        return state

    def confronted(self, evidence: Examination, trial: Trial) -> Trial:
        """A trial with the exposures and places left out of its fit, and the evidence of each KIND against it."""
        assert trial.fit is not None
        after = Design.of(trial.fit)
        compared = before_and_after(trial.effect.name, evidence.design, after)
        against = contradicting(evidence.design, after) if compared.confirmed else ""
        if against:
            self.tell(f"{trial.name}: exposures of {against} speak against it")
        return dataclasses.replace(trial, compared=compared, against=against)

    def adopted(self, state: State, trial: Trial) -> State:
        """The state with the model of a trial, fitted again where priors or errors were in its way."""
        assert trial.fit is not None
        evidence, name = state.evidence, trial.effect.name
        result = settled(trial.fit, [name, *(step.effect.name for step in state.steps)])
        compared, alike = trial.compared, (*trial.rivals, *trial.nameless)
        groups, also = {trial.name: alike} if trial.effect is Described else {}, trial.also
        probability = trial.probability
        if result is not trial.fit:
            compared = before_and_after(name, evidence.design, Design.of(result))
        item = trial.item or next((r for r in evidence.ranked if r.effect is trial.effect), None)
        table = evidence.table
        score = item.score.statistic if item else evidence.chi2 - trial.left
        p_value = table.corrected(item.score) if item else table.p_global
        steps = [step for step in state.steps if step.effect is not trial.effect]
        # A further change of the description joins those before.
        for earlier in (step for step in state.steps if step.effect is trial.effect):
            before = "chi2_before", "heldout_before", "residual_before"
            compared = dataclasses.replace(
                compared, **{key: getattr(earlier.compared, key) for key in before}
            )
            groups, also = {**earlier.groups, **groups}, {**earlier.also, **also}
            probability = min(probability, earlier.probability)
        found = {
            "compared": compared, "score": score, "p_value": p_value, "groups": groups, "also": also,
            "probability": probability,
        }  # fmt: skip
        step = dataclasses.replace(trial, **found)
        self.tell(f"added {name}; scoring the residuals")
        return self.adopt(state, result, [*steps, step])


def settled(result: FitResult, names: Collection[str]) -> FitResult:
    """A fit with errors as given where they need not be scaled any more, and the refuted priors of effects widened."""
    if result.noise_scale > 1.0:
        result = fit(result.likelihood, start=result.values)
    model = result.model
    for name in names:
        model = with_refuted_priors_widened(model, result.values, name)
    if model is not result.model:
        result = fit(Likelihood.of(result.calset, model), start=result.values)
    return result


def without(result: FitResult, name: str, remaining: Collection[str]) -> FitResult:
    """A fit without an effect; `remaining` are the names of the other additions."""
    return settled(refit_without(result, name), remaining)


def contradicting(before: Design, after: Design) -> str:
    """KINDs of exposures that all others predict worse with the additions of a fit; empty: none.

    Worse is both less probable and farther off, by χ² of the prediction: one that has only become broader contradicts
    nothing. Polariser, Moon and standards see one instrument: what is true makes none of them less probable given the
    others.
    """
    kinds = before.fit.calset.exposures.kind[before.exposure]
    names = np.unique(kinds)
    if len(names) < 2:
        return ""
    first, second = ((d.jacobian, d.residual, d.projector.free, d.fit.noise_scale) for d in (before, after))
    worse = (gains_of_units(kinds, first, second) < -thresholds.EVEN_ODDS).all(axis=0)
    return ", ".join(f"KIND {kind}" for kind in names[worse])


def refitted_in_order(steps: Sequence[Trial], start: Design, end: Design) -> list[Trial]:
    """The steps as they lead, one after the other, from one fit to another that has no effects beside theirs.

    The models between the two are fitted again; what belongs to the discovery of an effect stays.
    """
    fits = [end.fit] if steps else []
    for step in reversed(steps[1:]):
        fits.append(refit_without(fits[-1], step.effect.name))
    in_order, before = [], start
    for step, result in zip(steps, reversed(fits), strict=True):
        after = end if result is end.fit else Design.of(result)
        in_order.append(dataclasses.replace(step, compared=before_and_after(step.effect.name, before, after)))
        before = after
    return in_order


LaidOut = tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, " _"], int, float]


def before_and_after(name: str, before: Design, after: Design) -> FitComparison:
    """The fits without and with an effect."""
    effect = after.fit.model.template.effect(name)
    many = any(np.size(getattr(effect, f)) > 4 for f in effect.kind.amplitudes())
    scheme = "field blocks" if many or _of_one_fold(after, name) else "exposures"
    old, new = (instrument_matrices(design.fit) for design in (before, after))
    return FitComparison(
        chi2_before=before.fit.chi2,
        chi2_after=after.fit.chi2,
        dof_after=after.fit.dof,
        heldout_scheme=scheme,
        heldout_before=held_out(before, scheme),
        heldout_after=held_out(after, scheme),
        change_of_qu=largest_change(old, new),
        residual_before=before.measured.residual,
        residual_after=after.measured.residual,
    )


def _of_one_fold(design: Design, name: str) -> bool:
    """True of an effect with an amplitude that only exposures of one fold show: others do not predict these."""
    at = design.columns_of(design.fit.model.positions(name))
    square, fold = design.jacobian[: design.rows, at] ** 2, exposure_folds(design)
    of_folds = np.array([square[fold == k].sum(axis=0) for k in np.unique(fold)])
    return bool(np.any(np.count_nonzero(of_folds > thresholds.ROUNDING * of_folds.max(axis=0), axis=0) == 1))


def predicts_unseen(
    design: Design, terms: Sequence[Candidate], least: float, *, of_states: bool = True
) -> bool:
    """True if terms without a name predict states and parts of the field that they have not seen.

    One Gauss–Newton step of everything, with and without the terms, from all data but those of a unit gives the
    density of that unit, ln p = −½ (dᵀΣ⁻¹d + ln det Σ), Σ = s² (1 + A H⁻¹ Aᵀ): it is broad where the step leaves it
    open, and s² is the χ²/dof that a model leaves, 1 or more. Units are states (exposures that differ in nothing but
    the filter; not where the terms are about single ones), and the cells of the field, where there are several. The
    mean gain must exceed `least` times its standard error over the units, for both: a term that only follows what each
    setting of an element does by itself predicts the field, and no other setting. Nor must it bend the rest of the
    model: the mean of dᵀd over the states must not grow, where a density may become more probable by being broader
    alone.

    Symbols     d prediction error of the unit, A its rows of the Jacobian, H normal matrix of all others and priors
    """
    widths = np.concatenate([term.widths for term in terms])
    columns = design.stacked([term.columns for term in terms])
    prior = np.zeros((len(widths), design.jacobian.shape[1]))
    rows = np.block([[design.jacobian, columns], [prior, np.diag(1.0 / widths)]])
    residual = np.append(design.residual, np.zeros(len(widths)))
    calset = design.fit.calset
    cells, state = field_cells(calset)[design.point], states(calset)[design.exposure]
    units = [("cells", cells)] * (len(np.unique(cells)) > 1) + [("states", state)] * of_states
    for kind, unit in units:
        before = _predictions(design.jacobian, design.residual, unit, design.projector.free)
        after = _predictions(rows, residual, unit, design.projector.free)
        gain, closer = after.density - before.density, after.distance - before.distance
        if len(gain) < 2 or gain.mean() < least * gain.std(ddof=1) / np.sqrt(len(gain)):
            return False
        if kind == "states" and closer.mean() > 0.0:
            return False
    return True


def gains_of_units(unit: np.ndarray, before: LaidOut, after: LaidOut) -> Float[np.ndarray, "2 u"]:
    """Gain in ln p of each unit of the data rows, as all others predict it, of one model over another, and −½ Δχ².

    χ² is that of the prediction, in both models with the errors of that which leaves less scatter. The gains of a unit
    and of all others by themselves add up to the evidence.

    Of each model the Jacobian, the residuals at its minimum, priors last, its degrees of freedom, and the factor on the
    errors in whose units the data rows are.
    """
    count, densities, squares, scales = np.unique(unit, return_counts=True)[1], [], [], []
    for rows, residual, free, noise in (before, after):
        predicted = _predictions(rows, residual, unit, free)
        densities.append(predicted.density - count * free / len(unit) * np.log(noise))
        squares.append(predicted.square * noise**2)
        scales.append(predicted.scale * noise**2)
    return np.stack([densities[1] - densities[0], 0.5 * (squares[0] - squares[1]) / min(scales)])


class _Predicted(NamedTuple):
    """Units of data rows as all the others predict them: ln p, χ² in units of the stated errors, squared distance.

    `scale` is the χ²/dof that the model leaves, 1 or more.
    """

    density: Float[np.ndarray, " u"]
    square: Float[np.ndarray, " u"]
    distance: Float[np.ndarray, " u"]
    scale: float


def _predictions(
    rows: Float[np.ndarray, "r n"], residual: Float[np.ndarray, " r"], unit: np.ndarray, free: int
) -> _Predicted:
    """Predictions of the units; rows beyond those of `unit` are priors."""
    norm = np.linalg.norm(rows, axis=0)
    scaled = rows / np.where(norm > 0, norm, 1.0)
    ridge = 1e-12 * np.eye(len(norm))
    gram, along = scaled.T @ scaled + ridge, scaled.T @ residual
    step = np.linalg.solve(gram, along)
    scale = max(1.0, float(residual @ residual - along @ step) / max(free, 1))
    log_determinant = np.linalg.slogdet(gram)[1]
    predictions = []
    for label in np.unique(unit):
        a, r = scaled[: len(unit)][unit == label], residual[: len(unit)][unit == label]
        remaining = gram - a.T @ a
        d = r - a @ np.linalg.solve(remaining, along - a.T @ r)
        pull = a.T @ d
        square = d @ d - pull @ np.linalg.solve(gram, pull)
        spread = log_determinant - np.linalg.slogdet(remaining)[1]
        density = -0.5 * (square / scale + spread + len(r) * free / len(unit) * np.log(scale))
        predictions.append((density, square, d @ d))
    density, square, distance = np.array(predictions).T
    return _Predicted(density, square, distance, scale)
