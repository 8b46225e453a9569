"""The judge of the search that fits: trials, predictions of the data left out, and the model that goes on."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.accuracy import largest_change
from walop_jax.calibration.matrix import instrument_matrices
from walop_jax.diagnosis import grammar, thresholds
from walop_jax.diagnosis.design import Design, exposure_folds, folds, held_out
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
from walop_jax.diagnosis.hypotheses import Hypotheses, Ranked
from walop_jax.diagnosis.score import Candidate
from walop_jax.diagnosis.search import Reason, Round, State
from walop_jax.fit.refit import FitResult, fit
from walop_jax.fit.robust import field_cells, states
from walop_jax.io.progress import Stage
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Described, Effect
from walop_jax.model.instrument import Instrument


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
        """A fit, scored; the columns of an `earlier` one serve again where the light has hardly changed.

        An instrument that is put together otherwise than that of `earlier` has candidates of its own.
        """
        candidates, template, calset = self.hypotheses, result.model.template, result.calset
        if structure := _structure(template):
            candidates = grammar.hypotheses(
                candidates.effects, template, calset.exposures, len(calset.points)
            )
        if earlier is not None and _structure(earlier.result.model.template) != structure:
            earlier = None
        evidence = examine(result, candidates, self.rng, earlier)
        if evidence.alarm:
            self.tell(Stage(f"p = {evidence.table.p_global:.2g}: something is missing", "naming"))
        return evidence

    def adopt(
        self, state: State, result: FitResult, steps: Sequence[Trial], earlier: Examination | None = None
    ) -> State:
        """The state with another fit of its set, and with the additions that this has."""
        state.evidence.forget()
        evidence = self.examined(result, earlier or state.evidence)
        return dataclasses.replace(state, evidence=evidence, steps=tuple(steps))

    def fitted(self, evidence: Examination, trial: Trial) -> Trial:
        """A linear trial fitted exactly."""
        item = trial.item
        assert item is not None
        self.tell(f"trying {item.name}")
        if item.effect is Described:
            description = self._description(evidence, item)
            refitted = try_effect(evidence.result, description, len(evidence.descriptions), scale=item.scale)
        else:
            shapes = sum(probe.effect is item.effect for probe in evidence.probes)
            refitted = try_shapes(evidence.result, item, shapes)
        return _with_rest(dataclasses.replace(refitted, item=item, expected=trial.expected))

    def _description(self, evidence: Examination, item: Ranked) -> Described:
        """The description to be fitted: all terms of a smooth field, else the members worth their length."""
        if evidence.smooth is not None and item.name in evidence.smooth.names:
            return Described.combine(item.probe.group, item.score.amplitudes)
        return self._with_best_times(evidence, shortest(item))

    def _with_best_times(self, evidence: Examination, description: Described) -> Described:
        """A description, its start or stop (if it has one) at the time that explains most by linear steps."""
        ((change, amplitude), *further) = description.terms()
        result = evidence.result
        for end in (0, 1) if not further else ():
            if times := grammar.retimed(change, result.calset.exposures, end):
                c = evidence.design.columns.of([[(1.0, one)] for one in times])
                c = evidence.design.projector(evidence.design.stacked([c]))
                along, square = c.T @ evidence.design.residual, np.sum(c**2, axis=0)
                best = int(np.argmax(along**2 / np.where(square > 0, square, np.inf)))
                change, amplitude = times[best], -along[best] / square[best]
        return description if further else Described.saying([change.text], [float(amplitude)])

    def others(self, state: State) -> tuple[list[Trial], Mapping[str, Choice]]:
        """Trials of other descriptions of the instrument, and all that were compared.

        Where the fit is poor (`Evidence.poor`) all descriptions are compared, and structural effects are tried as well;
        else other curves of dispersion alone. A structural effect that an earlier round refuted is not tried again: the
        names that joined the model since then explain a part of the misfit, and leave less for the effect to explain.
        """
        result, trials = state.evidence.result, list[Trial]()
        asked = itertools.chain(*(earlier.asked for earlier in state.rounds))
        refuted = {reason.name for reason in asked if reason.fitted and reason.evidence <= 0.0}

        def allowed(further: int = 0) -> bool:
            return not self.over(state.fits + len(trials) + further)

        for effect in self.hypotheses.effects if state.evidence.poor else ():
            known = effect.name in refuted or effect.name in result.model.effect_names
            if effect.is_structural() and not known and allowed():
                self.tell(f"trying {effect.name}")
                trials.append(try_effect(result, effect.neutral(context_of(result))))
        described, compared = other_descriptions(
            result, allowed, self.tell, all_of_them=state.evidence.poor, earlier=state.choices
        )
        return [_with_rest(trial) for trial in (*trials, *described)], {**state.choices, **compared}

    def with_causes(self, state: State, effects: Sequence[Effect]) -> State:
        """The state with discrete causes (`discrete`) added, each fitted from the start values of the model.

        A cause whose fit does not converge, or raises χ², is left out.
        """
        for effect in effects:
            result = state.evidence.result
            self.tell(f"fitting {getattr(effect, 'change', '') or effect.name}")
            trial = try_effect(result, effect, start=result.model.start)
            if trial.fit is None or not trial.fit.converged or trial.remaining > state.evidence.chi2:
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
        """A trial with its test against held-out exposures or places, and the KINDs of exposures that contradict it."""
        assert trial.fit is not None
        after = Design.of(trial.fit)
        compared = before_and_after(trial.effect.name, evidence.design, after)
        against = contradicting(evidence.design, after) if compared.confirmed else ""
        if against:
            self.tell(f"{trial.name}: exposures of {against} speak against it")
        return dataclasses.replace(trial, compared=compared, against=against)

    def adopted(self, state: State, trial: Trial) -> State:
        """The state with the model of a trial; fitted again if a prior is refuted or errors were scaled (`settled`)."""
        assert trial.fit is not None
        evidence, name = state.evidence, trial.effect.name
        result = settled(trial.fit, [name, *(step.effect.name for step in state.steps)])
        compared, alike = trial.compared, (*trial.rivals, *trial.nameless)
        groups, synonyms = {trial.name: alike} if trial.effect is Described else {}, trial.synonyms
        probability = trial.probability
        if result is not trial.fit:
            compared = before_and_after(name, evidence.design, Design.of(result))
        item = trial.item or next((r for r in evidence.ranked if r.effect is trial.effect), None)
        table = evidence.table
        score = item.score.statistic if item else evidence.chi2 - trial.remaining
        p_value = table.corrected(item.score) if item else table.p_global
        steps = [step for step in state.steps if step.effect is not trial.effect]
        # A further change of the description joins those before.
        for earlier in (step for step in state.steps if step.effect is trial.effect):
            before = "chi2_before", "heldout_before", "residual_before"
            compared = dataclasses.replace(
                compared, **{key: getattr(earlier.compared, key) for key in before}
            )
            groups, synonyms = {**earlier.groups, **groups}, {**earlier.synonyms, **synonyms}
            probability = min(probability, earlier.probability)
        found = {
            "compared": compared, "score": score, "p_value": p_value, "groups": groups, "synonyms": synonyms,
            "probability": probability,
        }  # fmt: skip
        step = dataclasses.replace(trial, **found)
        self.tell(f"added {name}; scoring the residuals")
        return self.adopt(state, result, [*steps, step])


def _with_rest(trial: Trial) -> Trial:
    """The trial with the χ² that is left once its errors and priors are settled.

    With the errors of a gross misfit the prior of an effect holds it far from the value that the data ask for.
    """
    if trial.fit is None or not trial.fit.converged or trial.fit.noise_scale <= 1.0:
        return trial
    rest = settled(trial.fit, [trial.effect.name])
    return dataclasses.replace(trial, remaining=rest.chi2, leaves_noise=rest.explains_data)


def settled(result: FitResult, names: Collection[str]) -> FitResult:
    """The fit made again, its errors scaled only if they still must be, and with refuted priors of effects widened.

    A fit whose errors are as given, without refuted priors, comes back as it is.
    """
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
    """KINDs of exposures that the exposures of all other KINDs predict worse with the additions of a fit; empty: none.

    Worse means that ln p and χ² of the prediction have both become worse: a prediction that is only broader contradicts
    nothing. Exposures of polariser, Moon and standards see the same instrument, so that a true addition makes none of
    the KINDs less probable, given the others.
    """
    kinds = before.fit.calset.exposures.kind[before.exposure]
    names = np.unique(kinds)
    if len(names) < 2:
        return ""
    worse = (gains_of_units(kinds, *map(_laid_out, (before, after))) < -thresholds.CERTAIN_ODDS).all(axis=0)
    return ", ".join(f"KIND {kind}" for kind in names[worse])


def refitted_in_order(steps: Sequence[Trial], start: Design, end: Design) -> list[Trial]:
    """The steps compared anew (`compared`), one after the other from the fit `start` to the fit `end`.

    `end` has the effects of the steps and no others. The models between the two are fitted again. What a step says of
    its discovery (score, p, rivals) stays.
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


def _laid_out(design: Design) -> LaidOut:
    return design.jacobian, design.residual, design.projector.free, design.fit.noise_scale


def before_and_after(name: str, before: Design, after: Design) -> FitComparison:
    """The fits without and with an effect."""
    effect = after.fit.model.template.effect(name)
    many = any(np.size(getattr(effect, f)) > 4 for f in effect.kind.amplitudes())
    scheme = "field blocks" if many or _of_one_fold(after, name) else "exposures"
    old, new = (instrument_matrices(design.fit) for design in (before, after))
    return FitComparison(
        **held_out_by(before, after, scheme),
        chi2_before=before.fit.chi2,
        chi2_after=after.fit.chi2,
        dof_after=after.fit.dof,
        change_of_qu=largest_change(old, new),
        residual_before=before.measured.residual,
        residual_after=after.measured.residual,
    )


def held_out_by(before: Design, after: Design, scheme: str) -> dict[str, Any]:
    """The part of a `FitComparison` about data that were left out, by folds of a scheme.

    Only where their mean squared residual is larger does the gain in ln p decide.
    """
    old, new = held_out(before, scheme), held_out(after, scheme)
    gain = float("nan")
    if new >= old:
        gain = float(gains_of_units(folds(before, scheme), _laid_out(before), _laid_out(after))[0].sum())
    return {
        "heldout_scheme": scheme, "heldout_before": old, "heldout_after": new, "heldout_gain": gain,
    }  # fmt: skip


def _of_one_fold(design: Design, name: str) -> bool:
    """True if a single fold of exposures shows an amplitude of the effect: other folds cannot predict it."""
    at = design.columns_of(design.fit.model.positions(name))
    square, fold = design.jacobian[: design.rows, at] ** 2, exposure_folds(design)
    of_folds = np.array([square[fold == k].sum(axis=0) for k in np.unique(fold)])
    return bool(np.any(np.count_nonzero(of_folds > thresholds.ROUNDING * of_folds.max(axis=0), axis=0) == 1))


def _structure(instrument: Instrument) -> list[tuple[str, Mapping[str, object]]]:
    """The structural effects of an instrument, with their choices."""
    return [(e.name, e.choices()) for e in instrument.effects if e.kind.is_structural()]


def predicts_unseen(design: Design, terms: Sequence[Candidate]) -> bool:
    """True if terms without a name predict states and parts of the field that they have not seen.

    Each unit of the data is left out in turn. One Gauss–Newton step of all parameters from the other data, with and
    without the terms, predicts the unit with the density ln p = −½ (dᵀΣ⁻¹d + ln det Σ), Σ = s² (1 + A H⁻¹ Aᵀ), which is
    broad where the other data do not determine it; s² is χ²/dof of the model, 1 or more. Units are cells of the field,
    if there are several, and states: exposures that differ in nothing but the filter. Cells and states must gain in
    ln p by `thresholds.SEPARATION` standard errors (`_gained`): a term that follows each setting of an element by
    itself predicts other places, but no other setting. The mean of dᵀd over the states must not grow either: a term
    that bends the rest of the model may gain in ln p only by a broader density.

    Symbols     d prediction error of the unit, A its rows of the Jacobian, H normal matrix of all others and priors
    """
    widths = np.concatenate([term.widths for term in terms])
    columns = design.stacked([term.columns for term in terms])
    prior = np.zeros((len(widths), design.jacobian.shape[1]))
    rows = np.block([[design.jacobian, columns], [prior, np.diag(1.0 / widths)]])
    residual = np.append(design.residual, np.zeros(len(widths)))
    calset = design.fit.calset
    cells, state = field_cells(calset)[design.point], states(calset)[design.exposure]
    units = [("cells", cells)] * (len(np.unique(cells)) > 1) + [("states", state)]
    for kind, unit in units:
        before = _predictions(design.jacobian, design.residual, unit, design.projector.free)
        after = _predictions(rows, residual, unit, design.projector.free)
        gain, closer = after.density - before.density, after.distance - before.distance
        if len(gain) < 2 or _gained(gain) < thresholds.SEPARATION:
            return False
        if kind == "states" and closer.mean() > 0.0:
            return False
    return True


def _gained(gain: Float[np.ndarray, " u"]) -> float:
    """Standard errors by which the gains of units lie above 0, by their mean or by their ranks, whichever is clearer.

    Two of thirty units that gain a hundred times more than the others make the mean scatter, though all of them gain;
    the signed ranks of the gains do not scatter (Wilcoxon 1945, Biometrics Bulletin 1, 80).
    """
    by_mean = gain.mean() / max(float(gain.std(ddof=1)) / np.sqrt(len(gain)), 1e-300)
    ranks = 1.0 + np.argsort(np.argsort(np.abs(gain)))
    return float(max(by_mean, np.sign(gain) @ ranks / np.sqrt(ranks @ ranks)))


def gains_of_units(unit: np.ndarray, before: LaidOut, after: LaidOut) -> Float[np.ndarray, "2 u"]:
    """How much better the model `after` predicts each unit of the data rows from all others than `before`.

    First row: gain in ln p; second row: −½ Δχ² of the prediction, for both models with the errors of the model that
    leaves less scatter. The gain of a unit and the gain of all other units by themselves add up to the evidence.

    A model is given as its Jacobian, its residuals at the minimum (rows of priors last), its degrees of freedom, and
    the factor on the errors that is in the data rows.
    """
    count, densities, squares, scales = np.unique(unit, return_counts=True)[1], [], [], []
    for rows, residual, free, noise in (before, after):
        predicted = _predictions(rows, residual, unit, free)
        densities.append(predicted.density - count * free / len(unit) * np.log(noise))
        squares.append(predicted.square * noise**2)
        scales.append(predicted.scale * noise**2)
    return np.stack([densities[1] - densities[0], 0.5 * (squares[0] - squares[1]) / min(scales)])


class _Predicted(NamedTuple):
    """Every unit of the data rows, predicted from all others: ln p, χ² by the stated errors, squared distance.

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
