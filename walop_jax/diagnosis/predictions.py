"""Predictions of data that took no part in a fit, and what two fits do: the comparisons of a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.accuracy import largest_change
from walop_jax.calibration.matrix import instrument_matrices
from walop_jax.diagnosis.design import Design, held_out
from walop_jax.diagnosis.score import Candidate
from walop_jax.fit.robust import field_cells, states
from walop_jax.model.effects import Described

LaidOut = tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, " _"], int, float]


def before_and_after(name: str, before: Design, after: Design) -> dict[str, Any]:
    """The fields of a `Step` that compare the fits without and with an effect."""
    effect = after.fit.model.instrument(after.fit.values).effect(name)
    # An effect with a number for every exposure, or for one of them, cannot predict exposures that it has not seen.
    many = any(np.size(getattr(effect, f)) > 4 for f in effect.kind.amplitudes())
    many |= isinstance(effect, Described) and any("exposure" in text for text in effect.sentences)
    scheme = "field blocks" if many else "exposures"
    old, new = (instrument_matrices(design.fit) for design in (before, after))
    return {
        "chi2_before": before.fit.chi2,
        "chi2_after": after.fit.chi2,
        "dof_after": after.fit.dof,
        "heldout_scheme": scheme,
        "heldout_before": held_out(before, scheme),
        "heldout_after": held_out(after, scheme),
        "change_of_qu": largest_change(old, new),
        "residual_before": before.measured.residual,
        "residual_after": after.measured.residual,
    }


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
    first, second = ((d.jacobian, d.residual, d.projector.free, d.fit.noise_scale) for d in (before, after))
    return dict(zip(map(str, names), gains_of_units(kinds, first, second).tolist(), strict=True))


def gains_of_units(unit: np.ndarray, before: LaidOut, after: LaidOut) -> Float[np.ndarray, " u"]:
    """Gain in ln p of each unit of the data rows, as all others predict it, of one model over another.

    Of each model the Jacobian, the residuals at its minimum, priors last, its degrees of freedom, and the factor on the
    errors in whose units the data rows are.
    """
    count, densities = np.unique(unit, return_counts=True)[1], []
    for rows, residual, free, noise in (before, after):
        density = _predictions(rows, residual, unit, free)[:, 0]
        densities.append(density - count * free / len(unit) * np.log(noise))
    return densities[1] - densities[0]


def _predictions(
    rows: Float[np.ndarray, "r n"], residual: Float[np.ndarray, " r"], unit: np.ndarray, free: int
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
        predictions.append((density, float(d @ d)))
    return np.array(predictions)
