"""The name: refits of the leading candidates, their evidence, and who cannot be told from whom.

Evidence       Laplace: ln B = ½ (O_base − O_g) − ½ (ln det H_g − ln det H_base) − Σ ln w, with O the objective (χ² of
               data and priors), H half its Hessian and w the prior widths of the added parameters.
Equivalence    The change D of the residuals that the named effect makes, projected off the other parameters, is fitted
               by each rival; the length of what the rival cannot follow is the separation in standard deviations
               (Atkinson & Fedorov 1975, Biometrika 62, 57). Below `SEPARATION` the data cannot tell the two apart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnose.columns import Probe, effect_candidates
from walop_jax.diagnose.design import Design
from walop_jax.diagnose.score import Score, ScoreTable, whitened
from walop_jax.fit.refit import FitResult, fit
from walop_jax.likelihood.problem import Problem
from walop_jax.model.effects import Context, Effect
from walop_jax.model.specification import Model, with_effects

SEPARATION = 3.0
MOST_LEADERS = 5
CLOSE = 8.0  # ln B below the best within which a rival is refitted
LARGE = 150.0  # ln B above which the linear ranking is not trusted
EVEN_ODDS = 3.0  # difference in ln B that is no preference


@dataclasses.dataclass(frozen=True)
class Ranked:
    """An effect with its best probe: evidence averaged over its alternative shapes."""

    effect: type[Effect]
    probe: Probe
    score: Score
    log_bayes: float


@dataclasses.dataclass(frozen=True)
class Trial:
    """An effect that was added and refitted."""

    effect: type[Effect]
    problem: Problem
    fit: FitResult
    log_bayes: float


def rank(table: ScoreTable, probes: Sequence[Probe]) -> list[Ranked]:
    """Effects by evidence, best first; alternative shapes share the prior of their effect."""
    by_effect: dict[type[Effect], list[tuple[Probe, Score]]] = {}
    for probe in probes:
        by_effect.setdefault(probe.effect, []).append((probe, table[probe.name]))
    ranked = []
    for effect, shapes in by_effect.items():
        alive = [(probe, score) for probe, score in shapes if score.testable]
        if not alive:
            continue
        probe, score = max(alive, key=lambda item: item[1].log_bayes)
        bayes = np.array([s.log_bayes for _, s in alive])
        mean = float(np.logaddexp.reduce(bayes) - np.log(len(shapes)))
        ranked.append(Ranked(effect, probe, score, mean))
    return sorted(ranked, key=lambda item: -item.log_bayes)


def leaders(ranked: Sequence[Ranked]) -> list[Ranked]:
    """Candidates whose linear evidence is too close to the best to decide without a refit."""
    best = ranked[0].log_bayes
    reach = max(CLOSE, 0.6 * best) if best > LARGE else CLOSE
    return [item for item in ranked[:MOST_LEADERS] if item.log_bayes > best - reach]


def _log_determinant(result: FitResult) -> float:
    return float(np.linalg.slogdet(result.posterior.matrix)[1])


def log_evidence_ratio(base: FitResult, extended: FitResult) -> float:
    """Laplace evidence of an extended fit against the base (parameters without a prior carry no Occam factor)."""
    known = set(base.model.names)
    widths = [
        p.prior[1] if p.prior is not None else (p.loose or p.scale)
        for p in extended.model.parameters
        if p.name not in known and p.free and p.tie is None
    ]
    gain = 0.5 * (base.posterior.objective - extended.posterior.objective)
    occam = 0.5 * (_log_determinant(extended) - _log_determinant(base))
    return gain - occam - float(np.sum(np.log(widths)))


def try_effect(
    calset: CalibrationSet, base: FitResult, instance: Effect, context: Context, prior_shapes: int = 1
) -> Trial:
    """Add an effect at the given values to the fitted model and fit everything again."""
    model = with_effects(base.model, [instance], context)
    start = dict(zip(base.model.names, base.values, strict=True))
    values = np.array([start.get(p.name, p.start) for p in model.parameters])
    problem = Problem(calset, model)
    result = fit(problem, start=values, noise_scale=base.noise_scale, worth=base.posterior.objective)
    bayes = log_evidence_ratio(base, result) - (float(np.log(prior_shapes)) if prior_shapes > 1 else 0.0)
    return Trial(type(instance), problem, result, bayes)


def start_of(item: Ranked) -> Effect:
    """The effect with the amplitudes that the linear step finds."""
    return item.effect.combine(item.probe.group, item.score.amplitudes)


def without(model: Model, name: str, context: Context) -> Model:
    """The model with one effect taken out."""
    rest = tuple(effect for effect in model.template.effects if effect.name != name)
    parameters = tuple(p for p in model.parameters if not p.name.startswith(f"{name}."))
    template = dataclasses.replace(model.template, effects=rest)
    return dataclasses.replace(model, template=template, parameters=parameters)


def equivalents(
    calset: CalibrationSet,
    final: FitResult,
    design: Design,
    name: str,
    context: Context,
    rivals: Sequence[Probe],
) -> tuple[dict[str, float], Float[np.ndarray, " _"]]:
    """Separation (σ) of every rival from an active effect, and the change of the residuals that the effect makes."""
    base = without(final.model, name, context)
    kept = [final.model.index(p.name) for p in base.parameters]
    base_values = final.values[kept]
    problem = Problem(calset, base)
    bare_fit = dataclasses.replace(
        final, model=base, values=base_values, covariance=final.covariance[np.ix_(kept, kept)]
    )
    bare = Design.of(problem, bare_fit)
    change = bare.residual[: bare.rows] - design.residual[: design.rows]
    extra = len(bare.residual) - bare.rows
    projected = bare.projector(np.pad(change, (0, extra)))
    candidates = bare.padded(list(effect_candidates(calset, base, base_values, rivals).values()))
    columns = [(p, bare.projector(c.columns)) for p, c in zip(rivals, candidates, strict=True)]
    return separations(projected, columns), change


def separations(
    change: Float[np.ndarray, " _"], rivals: Sequence[tuple[Probe, Float[np.ndarray, "_ _"]]]
) -> dict[str, float]:
    """How far (σ) each rival stays from a projected change of the residuals when it does its best to follow."""
    separation: dict[str, float] = {}
    for probe, columns in rivals:
        q = whitened(columns)[0]
        rest = float(np.linalg.norm(change - q @ (q.T @ change)))
        separation[probe.effect.name] = min(rest, separation.get(probe.effect.name, np.inf))
    return separation


def close_rivals(
    change: Float[np.ndarray, " _"], rivals: Sequence[tuple[Probe, Float[np.ndarray, "_ _"]]]
) -> frozenset[str]:
    """The rivals that these data cannot tell from an effect that changes the residuals by `change`."""
    return frozenset(name for name, s in separations(change, rivals).items() if s < SEPARATION)
