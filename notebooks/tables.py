"""Calibration sets out of tables of a laboratory: one field point, nothing said but what turns."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

import walop_jax as walop
from walop_jax import CalibrationSet, FilterCurve


def bench_set(
    instrument: str,
    origin: str,
    kind: str,
    filters: list[FilterCurve],
    of_filter: Float[np.ndarray, " e"],
    counts: Float[np.ndarray, "e k"],
    sigma: Float[np.ndarray, "e k"],
    moving: Mapping[str, Float[np.ndarray, " e"]],
    *,
    polariser: Float[np.ndarray, " e"] | None = None,
    mjd: Float[np.ndarray, " e"] | float = 60000.0,
) -> CalibrationSet:
    """A set of exposures of one KIND; `of_filter` numbers their filters, angles are in deg, NaN: out of the beam."""
    names = np.array([curve.name for curve in filters])
    return walop.from_arrays(
        np.asarray(counts, float)[None],
        np.asarray(sigma, float)[None],
        [0.0],
        [0.0],
        np.full(len(counts), np.nan) if polariser is None else polariser,
        kind,
        instrument=instrument,
        origin=origin,
        filters={curve.name: curve for curve in filters},
        filter=names[of_filter],
        mjd=mjd,
        exptime=1.0,
        **{f"{prefix}_in".lower(): np.isfinite(angle) for prefix, angle in moving.items()},
        **{f"{prefix}_angle".lower(): angle for prefix, angle in moving.items()},
    )


def left_over(result, values=None):
    """Measured minus fitted intensities, exposure by camera; `values` are those of another fit of the same model."""
    likelihood = result.likelihood
    _, residual = likelihood.residuals(result.values if values is None else values)
    return residual[0] / likelihood.points.gathered("weight")[0]


def saying(model, calset, sentences):
    """The model with what sentences say of it, for a fit to find the amplitudes of, without their priors."""
    said = walop.effect_by_name("described").saying(sentences, np.zeros(len(sentences)))
    made = walop.with_effects(model, [said], calset)
    for name in made.names:
        if name not in model.names:
            made = made.change(name, prior=None, loose=1.0)
    return made
