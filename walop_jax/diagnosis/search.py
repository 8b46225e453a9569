"""Exact fits of what a diagnosis tries, adds and drops, and the search for what is missing.

Evidence       Laplace: ln B = ½ (O_base − O_g) − ½ (ln det H_g − ln det H_base) − Σ ln w, with O the objective (χ² of
               data and priors), H half its Hessian and w the prior widths of the added parameters; those of amplitudes
               are averaged over their scale (`score.log_bayes`).

Names are added by evidence, one after the other, by the same rules for every judge. A *judge* says what an addition is
worth. That of the blind study (`tests/diagnosis/blind.py`) takes its linear step (a Schur complement of the score
space): no model is computed, and thousands of scenes run through the rules below. `workflow.Refit` fits it, but only
what may be added:

1. Candidates are ordered by their linear evidence. What linear algebra finds not worth telling is not tried.
2. The best is fitted. If it leaves nothing but noise, no rival can be better. If its evidence differs from that of its
   linear step by more than `Policy.linear_good`, rivals that lie within twice the difference are fitted as well.
3. Where the model is far off and no name explains half of that, or none is found, what cannot be differentiated
   competes with the names: structural effects and other descriptions of the instrument (`alternatives`).
4. What data that took no part in the fit confirm joins the model (`adopted`), and what is left is scored again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.accuracy import largest_change
from walop_jax.calibration.matrix import instrument_matrices
from walop_jax.diagnosis.candidates import said_by
from walop_jax.diagnosis.design import Design, held_out
from walop_jax.diagnosis.examination import Evidence, Ranked, explains, leaders
from walop_jax.diagnosis.findings import Step
from walop_jax.diagnosis.policy import Policy
from walop_jax.diagnosis.score import SCALES, Candidate, log_bayes
from walop_jax.fit.refit import PRIOR_EDGE, FitResult, fit
from walop_jax.fit.robust import field_cells, states
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Context, Described, Effect
from walop_jax.model.parameters import leaves, values_of
from walop_jax.model.specification import Model, model_without, with_effects

LaidOut = tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, " _"], int, float]


@dataclasses.dataclass(frozen=True)
class Trial:
    """An addition to a model that was tried: its evidence (ln B), and what it leaves, χ² and whether that is noise.

    `item` is its linear step, `linear` the evidence of that (NaN where there was none). `fit` is None until it has been
    fitted. `alternatives` are other shapes of the effect that do as well, in words. `rivals` are effects of nearly its
    evidence, or of which a part would do, `nameless` sentences that are not improbable beside it.
    """

    effect: type[Effect]
    evidence: float
    left: float
    noise: bool
    item: Ranked | None = None
    linear: float = float("nan")
    fit: FitResult | None = None
    alternatives: tuple[str, ...] = ()
    rivals: tuple[str, ...] = ()
    nameless: tuple[str, ...] = ()

    @property
    def instance(self) -> Effect:
        """The effect at its fitted values, in standard form."""
        assert self.fit is not None
        return self.fit.model.instrument(self.fit.values).effect(self.effect.name).standard_form()

    @property
    def sentences(self) -> tuple[str, ...]:
        """Its equivalent sentences, where it has no name."""
        if self.effect is not Described:
            return ()
        if self.fit is None:
            return () if self.item is None else said_by(self.item.probe)
        return self.instance.sentences  # type: ignore[attr-defined]


def _log_determinant(result: FitResult) -> float:
    return float(np.linalg.slogdet(result.posterior.matrix)[1])


def log_evidence_ratio(base: FitResult, extended: FitResult) -> float:
    """Laplace evidence of an extended fit against the base (parameters without a prior carry no Occam factor).

    Priors of amplitudes are those of the fit at all `SCALES`.
    """
    known, model = set(base.model.names), extended.model
    widths = [
        p.prior[1] if p.prior is not None else (p.loose or p.scale)
        for p in model.parameters
        if p.name not in known and p.free and p.tie is None
    ]
    amplitudes = [i for effect in model.effect_names for i in amplitude_positions(model, effect)]
    at = [i for i in amplitudes if model.names[i] not in known]
    gain = 0.5 * (base.posterior.objective - extended.posterior.objective)
    occam = 0.5 * (_log_determinant(extended) - _log_determinant(base))
    at_all_scales = _of_amplitudes(extended, at) - _of_amplitudes(extended, at, np.ones(1))
    return gain - occam - float(np.sum(np.log(widths))) + at_all_scales


def _of_amplitudes(result: FitResult, at: Sequence[int], scales: Float[np.ndarray, " t"] = SCALES) -> float:
    """ln B of some parameters against their prior means: density of posterior and prior there, both Gaussian.

    The Savage–Dickey ratio of nested models (Dickey 1971, Ann. Math. Stat. 42, 204), with the prior at all `scales`:
    what the data alone say is the information of the posterior without that of the prior.
    """
    if not at:
        return 0.0
    mean, width = np.transpose([result.model.parameters[i].prior for i in at])  # type: ignore[arg-type]
    information = np.linalg.inv(result.covariance[np.ix_(at, at)])
    scores = information @ (result.values[at] - mean)
    return log_bayes(information - np.diag(width**-2.0), scores, width, scales)


def try_effect(base: FitResult, instance: Effect, context: Context, prior_shapes: int = 1) -> Trial:
    """Add an effect at the given values to the fitted model and fit everything again."""
    return try_model(
        base, type(instance), with_effects(base.model, [instance], context), base.values, prior_shapes
    )


def try_sentences(base: FitResult, said: Described, context: Context, count: int) -> Trial:
    """Add sentences to the fitted model, beside those that it has, and fit again; they are among `count` of them."""
    model = base.model
    if Described.name in model.effect_names:
        earlier = model.instrument(base.values).effect(Described.name)
        assert isinstance(earlier, Described)
        said, model = earlier.joined(said), model_without(model, Described.name)
    return try_model(base, Described, with_effects(model, [said], context), base.values, count)


def try_model(
    base: FitResult, effect: type[Effect], model: Model, values: Float[np.ndarray, " n"], prior_shapes: int
) -> Trial:
    """Fit a model with an effect, from values of the parameters of the base and its own start values of others."""
    start = dict(zip(base.model.names, values, strict=True))
    likelihood = Likelihood.of(base.calset, model)
    result = fit(
        likelihood,
        start=np.array([start.get(p.name, p.start) for p in model.parameters]),
        noise_scale=base.noise_scale,
        worth=base.posterior.objective,
    )
    bayes = log_evidence_ratio(base, result) - (float(np.log(prior_shapes)) if prior_shapes > 1 else 0.0)
    return Trial(effect, bayes, result.chi2, result.explains_data, fit=result)


def try_shapes(base: FitResult, item: Ranked, context: Context, shapes: int, policy: Policy) -> Trial:
    """Refit an effect from the amplitudes of its linear steps at the shapes that may be best, and keep the best."""
    places = ((item.probe, item.score), *item.others)
    trials = [
        try_effect(base, item.effect.combine(probe.group, score.amplitudes), context, shapes)
        for probe, score in places
    ]
    best = max(trials, key=lambda t: t.evidence if _converged(t) else -np.inf)
    alike = [t for t in trials if _converged(t) and t.evidence > best.evidence - policy.even_odds]
    told = dict.fromkeys(in_words(t.instance) for t in alike if _differ(t, best, policy.separation))
    return dataclasses.replace(best, alternatives=tuple(told))


def _converged(trial: Trial) -> bool:
    return trial.fit is not None and trial.fit.converged


def _differ(one: Trial, other: Trial, separation: float) -> bool:
    assert one.fit is not None
    assert other.fit is not None
    if one.instance.choices() != other.instance.choices():
        return True
    at = one.fit.model.positions(one.effect.name)
    sigma = np.maximum(one.fit.sigma[at], other.fit.sigma[at])
    away = np.asarray(values_of(one.instance)) - np.asarray(values_of(other.instance))
    return bool(np.any(np.abs(away) > separation * np.where(sigma > 0, sigma, np.inf)))


def in_words(effect: Effect) -> str:
    """Choices and values of an effect, e.g. "camera = 2, depth = 0.006"."""
    values = {
        leaf.name: f"{v:.4g}" for leaf, v in zip(leaves(effect), np.asarray(values_of(effect)), strict=True)
    }
    return ", ".join(f"{name} = {value}" for name, value in (spoken_choices(effect) | values).items())


def spoken_choices(effect: Effect) -> dict[str, Any]:
    """Discrete choices that mean something to a reader: a camera, a crystal, a star."""
    return {name: value for name, value in effect.choices().items() if isinstance(value, int | str)}


def amplitude_positions(model: Model, name: str) -> list[int]:
    """Positions of the free amplitudes of an active effect that have a prior."""
    effect = model.template.effect(name)
    at = [model.index(f"{name}.{label}") for f in effect.amplitudes() for label in effect.labels(f)]
    return [i for i in at if model.parameters[i].free and model.parameters[i].prior is not None]


def with_refuted_priors_widened(model: Model, values: Float[np.ndarray, " n"], name: str) -> Model:
    """The model with the priors of strongly deviating amplitudes widened to one width at the fitted value.

    A prior says how large such an effect usually is. One that the data refute would go on pulling at the value and
    count the square of its distance as a misfit, of data that are explained to within the noise.
    """
    for i in amplitude_positions(model, name):
        mean, width = model.parameters[i].prior  # type: ignore[misc]
        away = abs(float(values[i]) - mean)
        if away > PRIOR_EDGE * width:
            model = model.change(model.names[i], prior=(mean, away))
    return model


def beyond_prior(result: FitResult, name: str) -> dict[str, float]:
    """Amplitudes of an effect that lie beyond the prior of their declaration, widened or not, in its widths."""
    effect = result.model.template.effect(name)
    declared = {f"{name}.{leaf.name}": leaf.width for leaf in leaves(effect)}
    found = {}
    for i in amplitude_positions(result.model, name):
        p = result.model.parameters[i]
        widths = abs(float(result.values[i]) - p.prior[0]) / (declared[p.name] or np.inf)  # type: ignore[index]
        if widths > PRIOR_EDGE:
            found[p.name.removeprefix(f"{name}.")] = widths
    return found


def evidence_of_presence(result: FitResult, name: str) -> float:
    """ln B of a fitted model against the one without an effect: the density that prior and posterior have at neutral.

    Infinite for an effect without parameters.
    """
    at = amplitude_positions(result.model, name)
    return _of_amplitudes(result, at) if at else float("inf")


def refit_without(result: FitResult, name: str) -> FitResult:
    """Take an effect out of a fitted model and fit again, with errors scaled only if what is left needs it."""
    model = model_without(result.model, name)
    start = dict(zip(result.model.names, result.values, strict=True))
    return fit(Likelihood.of(result.calset, model), start=np.array([start[n] for n in model.names]))


def signature(result: FitResult, name: str, context: Context) -> Float[np.ndarray, " _"]:
    """Change of the residuals (data rows) by an active effect: theirs without it, minus theirs with it."""
    effect = result.model.template.effect(name)
    if type(effect).is_structural():
        model = model_without(result.model, name)
        kept = [result.model.index(n) for n in model.names]
        bare = Likelihood.of(result.calset, model).residuals(result.values[kept])[1]
    else:
        values = result.values.copy()
        values[result.model.positions(name)] = np.asarray(values_of(effect.at_neutral(context)))
        bare = result.likelihood.residuals(values)[1]
    change = bare - result.likelihood.residuals(result.values)[1]
    return change[result.likelihood.used].reshape(-1) / result.noise_scale


# ------------------------------------------------------------------------------- what an effect does, by two fits


def before_and_after(name: str, before: Design, after: Design) -> dict[str, Any]:
    """The fields of a `Step` that compare the fits without and with an effect."""
    effect = after.fit.model.instrument(after.fit.values).effect(name)
    # An effect with a number for every exposure, or for one of them, cannot predict exposures that it has not seen.
    many = any(np.size(getattr(effect, f)) > 4 for f in effect.amplitudes())
    many |= isinstance(effect, Described) and any("exposure" in text for text in effect.sentences)
    scheme = "field blocks" if many else "exposures"
    old, new = (instrument_matrices(design.fit) for design in (before, after))
    return {
        "chi2_before": before.fit.chi2,
        "chi2_after": after.fit.chi2,
        "heldout_scheme": scheme,
        "heldout_before": held_out(before, scheme),
        "heldout_after": held_out(after, scheme),
        "change_of_qu": largest_change(old, new),
        "residual_before": before.measured.residual,
        "residual_after": after.measured.residual,
    }


def refitted_in_order(steps: Sequence[Step], start: Design, end: Design) -> list[Step]:
    """The steps as they lead, one after the other, from one fit to another that has no effects beside theirs.

    The models between the two are fitted again; what belongs to the discovery of an effect stays.
    """
    fits = [end.fit] if steps else []
    for step in reversed(steps[1:]):
        fits.append(refit_without(fits[-1], step.effect))
    compared, before = [], start
    for step, result in zip(steps, reversed(fits), strict=True):
        after = end if result is end.fit else Design.of(result)
        compared.append(dataclasses.replace(step, **before_and_after(step.effect, before, after)))
        before = after
    return compared


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
    widths = np.concatenate([one.widths for one in terms])
    own = design.stacked([one.columns for one in terms])
    prior = np.zeros((len(widths), design.jacobian.shape[1]))
    rows = np.vstack([np.hstack([design.jacobian, own]), np.hstack([prior, np.diag(1.0 / widths)])])
    residual = np.append(design.residual, np.zeros(len(widths)))
    calset = design.fit.calset
    units = {"cells": field_cells(calset)[design.point]}
    if of_states:
        units["states"] = states(calset)[design.exposure]
    for kind, unit in units.items():
        if kind == "cells" and len(np.unique(unit)) < 2:
            continue
        before = _predictions(design.jacobian, design.residual, unit, design.projector.free)
        after = _predictions(rows, residual, unit, design.projector.free)
        gain, closer = (after - before).T
        if len(gain) < 2 or gain.mean() < least * gain.std(ddof=1) / np.sqrt(len(gain)):
            return False
        if kind == "states" and closer.mean() > 0.0:
            return False
    return True


def gains_by_kind(before: Design, after: Design) -> dict[str, float]:
    """Gain in ln p of the exposures of each KIND, as all others predict them, by what one design has beyond another.

    Polariser, Moon and standards see one instrument: what is true makes none of them less probable given the others.
    The gains of a KIND and of all others by themselves add up to the evidence.
    """
    kinds = before.fit.calset.exposures.kind[before.exposure]
    names = np.unique(kinds)
    if len(names) < 2:
        return {}
    one, other = ((d.jacobian, d.residual, d.projector.free, d.fit.noise_scale) for d in (before, after))
    return dict(zip(map(str, names), gains_of_units(kinds, one, other).tolist(), strict=True))


def gains_of_units(unit: np.ndarray, before: LaidOut, after: LaidOut) -> Float[np.ndarray, " u"]:
    """Gain in ln p of each unit of the data rows, as all others predict it, of one model over another.

    Of each model the Jacobian, the residuals at its minimum, priors last, its degrees of freedom, and the factor on the
    errors in whose units the data rows are.
    """
    count, found = np.unique(unit, return_counts=True)[1], []
    for rows, residual, free, noise in (before, after):
        density = _predictions(rows, residual, unit, free)[:, 0]
        found.append(density - count * free / len(unit) * np.log(noise))
    return found[1] - found[0]


def _predictions(
    rows: Float[np.ndarray, "r n"],
    residual: Float[np.ndarray, " r"],
    unit: np.ndarray,
    free: int,
) -> Float[np.ndarray, "u 2"]:
    """ln p of the data rows of each unit as all the others predict them, and the square of how far they are off.

    Rows beyond those of `unit` are priors.
    """
    norm = np.linalg.norm(rows, axis=0)
    scaled = rows / np.where(norm > 0, norm, 1.0)
    ridge = 1e-12 * np.eye(len(norm))
    gram, along = scaled.T @ scaled + ridge, scaled.T @ residual
    step = np.linalg.solve(gram, along)
    scale = max(1.0, float(residual @ residual - along @ step) / max(free, 1))
    whole = np.linalg.slogdet(gram)[1]
    found = []
    for one in np.unique(unit):
        a, r = scaled[: len(unit)][unit == one], residual[: len(unit)][unit == one]
        rest = gram - a.T @ a
        d = r - a @ np.linalg.solve(rest, along - a.T @ r)
        pull = a.T @ d
        square = d @ d - pull @ np.linalg.solve(gram, pull)
        spread = whole - np.linalg.slogdet(rest)[1]
        density = -0.5 * (square / scale + spread + len(r) * free / len(unit) * np.log(scale))
        found.append((density, float(d @ d)))
    return np.array(found)


# ----------------------------------------------------------------------------------------------------------- the search

State = TypeVar("State", bound=Evidence)


def search(state: State, judge: Any, policy: Policy) -> Iterator[tuple[Trial, State, State]]:
    """Additions until nothing is missing or none is found, each with the evidence before and after."""
    for _ in range(policy.most_steps):
        if not (state.alarm and judge.time_left()):
            return
        found = _next(state, judge, policy)
        if found is None:
            return
        before, state = state, judge.adopted(state, found)
        yield found, before, state


def linear_trials(state: Evidence, policy: Policy) -> list[Trial]:
    """The leading names, and sentences that are more probable than every name, by linear steps; best first."""
    trials = [linear_trial(state, item) for item in leaders(state.significant, policy)]
    said = state.sentences_before_names()[: policy.most_sentences]
    trials += [linear_trial(state, item) for item in said]
    return sorted(trials, key=lambda trial: names_first(trial, policy))


def linear_trial(state: Evidence, item: Ranked) -> Trial:
    """Trial of one candidate by its linear step; `linear` is what a fit should find, with its errors."""
    noise, statistic = state.table.noise_scale, item.score.statistic
    left = state.chi2 - statistic * (noise * state.scale) ** 2
    return Trial(
        item.effect,
        item.log_bayes,
        left,
        explains(left, state.dof - item.score.rank),
        item=item,
        linear=item.log_bayes + 0.5 * statistic * (noise**2 - 1.0),
    )


def names_first(trial: Trial, policy: Policy) -> float:
    """Order of trials: by evidence, but a sentence only where it is clearly more probable than a name."""
    return -trial.evidence + (policy.even_odds if trial.effect is Described else 0.0)


def _worth(state: Evidence, trial: Trial) -> bool:
    return state.is_worth_telling(
        trial.effect, trial.evidence, trial.left, noise=trial.noise, item=trial.item
    )


def _promising(state: Evidence, trial: Trial, policy: Policy) -> bool:
    """True if a linear trial could be worth telling, were it better by as much as linear steps may miss."""
    if trial.evidence <= policy.linear_below:
        return _worth(state, trial)
    more = 1.0 + policy.linear_share
    left = state.chi2 - more * (state.chi2 - trial.left)
    return _worth(state, dataclasses.replace(trial, evidence=more * trial.evidence, left=left))


def _next(state: Evidence, judge: Any, policy: Policy) -> Trial | None:
    """The addition with the highest evidence that is worth telling and confirmed; None where there is none."""
    waiting = [trial for trial in linear_trials(state, policy) if _promising(state, trial, policy)]
    tried, ready = list(waiting), []
    others_asked = sentences_asked = False
    while True:
        new = []
        while waiting and judge.time_left():
            first = waiting.pop(0)
            trial = judge.fitted(state, first)
            if trial is None or not _worth(state, trial):
                continue
            new.append(trial)
            tried = [trial if one is first else one for one in tried]
            error = abs(trial.evidence - trial.linear)
            reach = 2.0 * error if error > policy.linear_good else 0.0
            if trial.noise or not waiting or trial.linear - waiting[0].linear >= reach:
                break
        if not (new or sentences_asked):  # names that came first by linear steps that were not to be believed
            sentences_asked = True
            waiting = _sentences_behind(state, tried, policy)
            tried += waiting
            if waiting:
                continue
        missing = state.chi2 - state.dof
        explained = any(t.noise or state.chi2 - t.left > policy.good_share * missing for t in new)
        if not others_asked and not explained and (state.poor or not new):
            others_asked = True
            others = [trial for trial in judge.others(state) if _worth(state, trial)]
            new += others
            tried += others
        ready = judge.decided(sorted(new, key=lambda trial: names_first(trial, policy)))
        for trial in ready:
            if judge.confirmed(state, trial):
                return _with_rivals(state, trial, tried, policy)
        if not waiting or not judge.time_left():
            return None


def _sentences_behind(state: Evidence, tried: Sequence[Trial], policy: Policy) -> list[Trial]:
    """The leading sentences that are promising, without those that were tried."""
    known = [trial.item for trial in tried]
    some = [item for item in state.significant_sentences if item not in known][: policy.most_sentences]
    return [one for one in (linear_trial(state, item) for item in some) if _promising(state, one, policy)]


def _with_rivals(state: Evidence, trial: Trial, tried: Sequence[Trial], policy: Policy) -> Trial:
    """A trial with what is not improbable beside it, and other shapes of its effect that are as probable."""
    rivals, shapes = [], list(trial.alternatives)
    for other in tried:
        if other is trial:
            continue
        linear = other.fit is None and not np.isnan(trial.linear)
        apart = abs(other.linear - trial.linear if linear else other.evidence - trial.evidence)
        if other.effect is not trial.effect and apart < policy.improbable:
            rivals.append(other.effect.name)
        elif other.effect is trial.effect and other.fit is not None and apart < policy.even_odds:
            shapes.append(in_words(other.instance))
    item = trial.item or next((r for r in state.ranked if r.effect is trial.effect), None)
    nameless = () if item is None else state.nameless(item, trial.sentences)
    rivals += () if item is None else state.held_in_part(item)
    return dataclasses.replace(
        trial, alternatives=tuple(shapes), rivals=tuple(dict.fromkeys(rivals)), nameless=nameless
    )
