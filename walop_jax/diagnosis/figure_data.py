"""What the figures of a diagnosis are drawn from: residuals over the field, over the exposures, and in groups.

Combination  r_pk = Σ_e w_e r_pek / (Σ_e w_e² over the used ones)^½ keeps unit noise. The weights w are those of what
             can be said in words (a harmonic of the polariser angle at its best phase, the mean of a kind of
             exposures, a trend with time) that holds most of the power of the disagreement; if all of them hold less
             than `WORDS_FROM` of what the best weights do (principal component over the exposures), the latter.
Curve        c_ek = Σ_p v_pk r_pek / Σ_p v_pk², with v the field pattern of the difference in that camera, rms 1: a
             pattern that changes sign over the field does not average out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.records import Exposures
from walop_jax.diagnosis.figure_file import (
    DiagnosisFigureData,
    ExposureLabels,
    Ladder,
    ResidualComparison,
    Shares,
)
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.diagnosis.location import HARMONICS
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import FreeForm

Cube = Float[np.ndarray, "p e k"]
PointMap = Float[np.ndarray, "p k"]
Weight = Float[np.ndarray, " e"]
Used = Bool[np.ndarray, "p e"]

WORDS_FROM = 0.3  # share of the best weights' power with which a combination in words is preferred
LEAST_COVERAGE = 0.5  # share of Σ w² that the exposures of a point must hold for the point to be shown
UNNAMED = FreeForm.name  # the effect that stands for patterns without a name


@dataclasses.dataclass(frozen=True)
class Combination:
    """Weights of the exposures (norm 1), what they are in words, and the harmonic of the polariser angle or −1."""

    words: str
    weight: Weight
    harmonic: int = -1

    def of(self, cube: Cube, used: Used) -> PointMap:
        """The combined residuals of every point and camera; NaN where too few of the exposures are used."""
        present = used @ self.weight**2
        norm = np.where(present > LEAST_COVERAGE, np.sqrt(present), np.nan)
        return np.einsum("pek,e->pk", cube, self.weight) / norm[:, None]


def figure_data(diagnosis: Diagnosis) -> DiagnosisFigureData:
    """The arrays from which the figures of a diagnosis are drawn, residuals with the errors as given.

    A free-form term that is in the final model without being a step comes as a last comparison of its own.
    """
    start, final = diagnosis.before, diagnosis.after
    exposures, used = final.calset.exposures, final.likelihood.used
    after = final.likelihood.residuals(final.values)[1]
    before = after if start is final else start.likelihood.residuals(start.values)[1]
    pairs = [("", before, after)]
    pairs += [(step.effect, step.residual_before, step.residual_after) for step in diagnosis.steps]
    if _unnamed_term(diagnosis):
        pairs.append((UNNAMED, pairs[-1][2] if diagnosis.steps else before, after))
    angle = np.where(exposures.clp_in, exposures.clp_angle, np.nan)
    return DiagnosisFigureData(
        points=final.calset.points,
        exposures=ExposureLabels(exposures.exposure, exposures.kind, exposures.mjd, angle),
        ladder=_ladder(diagnosis),
        shares=_shares(final.likelihood, before, after),
        comparisons=tuple(
            compare_residuals(name, first, second, used, exposures) for name, first, second in pairs
        ),
    )


def _unnamed_term(diagnosis: Diagnosis) -> bool:
    known = [*diagnosis.before.model.effect_names, *(step.effect for step in diagnosis.steps)]
    return UNNAMED in diagnosis.after.model.effect_names and UNNAMED not in known


def compare_residuals(
    effect: str, before: Cube, after: Cube, used: Used, exposures: Exposures
) -> ResidualComparison:
    """Two cubes of residuals (σ; 0 where unused) side by side, in the combination that shows their difference.

    Without a difference the combination is the one that shows the residuals themselves.
    """
    change = before - after
    shown = change if np.any(change) else before
    best = best_combination(shown, used, exposures)
    pattern = np.nan_to_num(best.of(shown, used))
    size = np.sqrt(np.mean(pattern**2, axis=0))
    pattern = np.where(size > 0, pattern / np.where(size > 0, size, 1.0), 1.0)
    power = used.T.astype(float) @ pattern**2
    known = np.where(power > 0, power, np.nan)
    curves = [np.einsum("pek,pk->ek", cube, pattern) / known for cube in (before, after)]
    scatter = np.sqrt(np.einsum("pek,pk->ek", after**2, pattern**2)) / known
    rows = used.sum(axis=1, keepdims=True)
    rows = np.where(rows > 0, rows, np.nan)
    return ResidualComparison(
        effect=effect,
        combination=best.words,
        harmonic=best.harmonic,
        before=best.of(before, used),
        after=best.of(after, used),
        mean_before=before.sum(axis=1) / rows,
        mean_after=after.sum(axis=1) / rows,
        rms_before=np.sqrt((before**2).sum(axis=1) / rows),
        rms_after=np.sqrt((after**2).sum(axis=1) / rows),
        curve_before=curves[0],
        curve_error=scatter,
        curve_after=curves[1],
    )


def best_combination(cube: Cube, used: Used, exposures: Exposures) -> Combination:
    """The combination of the exposures in which a pattern (σ) shows best, in words wherever that is possible."""

    def power(combination: Combination) -> float:
        return float(np.nansum(combination.of(cube, used) ** 2))

    flat = np.moveaxis(cube, 1, -1).reshape(-1, cube.shape[1])
    principal = np.linalg.eigh(flat.T @ flat)[1][:, -1]
    principal = principal * (np.sign(principal[np.abs(principal).argmax()]) or 1.0)
    free = Combination("the combination of all exposures that shows it best", principal)
    named = max(_in_words(cube, used, exposures), key=power, default=free)
    return named if power(named) >= WORDS_FROM * power(free) else free


def _in_words(cube: Cube, used: Used, exposures: Exposures) -> Iterator[Combination]:
    measured = used.any(axis=0)
    through = exposures.clp_in & measured
    angle = np.deg2rad(np.where(through, exposures.clp_angle, 0.0))
    for harmonic in HARMONICS[1:]:
        waves = [np.where(through, wave(harmonic * angle), 0.0) for wave in (np.cos, np.sin)]
        phase = _best_phase(cube, waves)
        weight = waves[0] * np.cos(phase) + waves[1] * np.sin(phase)
        if np.linalg.norm(weight) > 1e-6:
            words = f"cos({harmonic} theta - {np.rad2deg(phase) % 360:.0f} deg), theta the polariser angle"
            yield Combination(words, weight / np.linalg.norm(weight), harmonic)
    for kind in np.unique(exposures.kind[measured]):
        weight = ((exposures.kind == kind) & measured).astype(float)
        yield Combination(f"mean of the {kind} exposures", weight / np.linalg.norm(weight))
    hours = np.where(measured, exposures.mjd - exposures.mjd[measured].mean(), 0.0)
    if np.all(np.isfinite(hours)) and np.any(hours):
        yield Combination("trend with time", hours / np.linalg.norm(hours))


def _best_phase(cube: Cube, waves: list[Weight]) -> float:
    """The phase φ at which cos φ · (cosine part) + sin φ · (sine part) has the largest power."""
    cosine, sine = (np.einsum("pek,e->pk", cube, wave) for wave in waves)
    return 0.5 * float(np.arctan2(2.0 * np.sum(cosine * sine), np.sum(cosine**2) - np.sum(sine**2)))


def _ladder(diagnosis: Diagnosis) -> Ladder:
    """Starting model, every addition, and the final fit where it is another one than that of the last addition."""
    final = diagnosis.after
    dof, rungs = diagnosis.before.dof, [("starting model", diagnosis.before.chi2, diagnosis.before.dof)]
    for step in diagnosis.steps:
        added = [final.model.parameters[i] for i in final.model.positions(step.effect)]
        dof -= sum(p.free and p.tie is None and p.prior is None for p in added)
        rungs.append((step.effect, step.chi2_after, dof))
    if abs(final.chi2 - rungs[-1][1]) > 1e-6 * final.chi2:
        rungs.append((UNNAMED if _unnamed_term(diagnosis) else "final fit", final.chi2, final.dof))
    model, chi2, freedom = zip(*rungs, strict=True)
    return Ladder(np.array(model), np.array(chi2, float), np.array(freedom, int))


def _shares(likelihood: Likelihood, before: Cube, after: Cube) -> Shares:
    """Sums of squared residuals by camera, kind, filter and exposure."""
    e = likelihood.calset.exposures
    names = likelihood.model.template.cameras.names
    share = likelihood.data_per_row / len(names)
    expected = (likelihood.used.sum(axis=0) * share)[:, None] * np.ones(len(names))
    squares = [expected, (before**2).sum(axis=0), (after**2).sum(axis=0)]  # (exposure, camera)
    members: list[tuple[str, str]] = []
    sums: list[list[float]] = []
    for k, camera in enumerate(names):
        members.append(("camera", camera))
        sums.append([float(square[:, k].sum()) for square in squares])
    for group, label in (("kind", e.kind), ("filter", e.filter), ("exposure", e.exposure)):
        for member in np.unique(label):
            members.append((group, str(member)))
            sums.append([float(square[label == member].sum()) for square in squares])
    return Shares(*np.array(members).T, *np.array(sums).T)
