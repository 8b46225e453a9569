"""Detectors that are not linear: counts of a catalogue, corrected with a calibration.

Equation    reported(N, θ) = counts as measured, solved for N by fixed-point steps;
            dN/dθ = −(∂reported/∂θ) / (∂reported/∂N),    σ(N) = σ(measured) / (∂reported/∂N)
Symbols     N counts (electrons) that arrive, θ coefficients of the detectors, σ standard errors
Limits      Responses within some per cent of linear: each step gains as many digits as the first one is small.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.model import light
from walop_jax.model.dependence import AT, reported
from walop_jax.model.parameters import with_values

_ROUNDS = 16


def linearised(
    calibration: Calibration,
    counts: Float[np.ndarray, "n k"],
    x: Float[np.ndarray, " n"],
    y: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n k"]:
    """Counts at field points (deg) as linear detectors would report them, where the calibration has their response."""
    instrument = calibration.model.instrument(calibration.values)
    if light.is_linear(instrument):
        return counts
    true, at = counts, (jnp.asarray(x), jnp.asarray(y))
    for _ in range(_ROUNDS):
        true = true + (counts - np.asarray(reported(instrument, jnp.asarray(true), *at)))
    return true


def errors_of(
    calibration: Calibration,
    counts: Float[np.ndarray, "n k"],
    sigma: Float[np.ndarray, "n k"],
    x: Float[np.ndarray, " n"],
    y: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n k"]:
    """Standard errors of linearised `counts`, from those of the counts as measured (`sigma`)."""
    instrument = calibration.model.instrument(calibration.values)
    if light.is_linear(instrument):
        return sigma
    true = jnp.asarray(np.nan_to_num(counts))
    at = jnp.asarray(x), jnp.asarray(y)
    _, slope = jax.jvp(lambda n: reported(instrument, n, *at), (true,), (jnp.ones_like(true),))
    return sigma / np.abs(np.asarray(slope))


def detector_slopes(
    vectors: AnalysisVectors,
    counts: Float[np.ndarray, "r k"],
    x: Float[np.ndarray, " r"],
    y: Float[np.ndarray, " r"],
) -> Iterator[tuple[int, Float[np.ndarray, "r k"]]]:
    """Positions in `vectors.parameters` of those of the detectors, and d(linearised counts)/d(parameter).

    `counts` are linearised. From reported(N, θ) = counts as measured: dN/dθ = −(∂reported/∂θ) / (∂reported/∂N).
    """
    calibration = vectors.calibration
    template, values = calibration.model.template, jnp.asarray(calibration.values)
    if light.is_linear(vectors.instrument):
        return
    to_instrument, at = with_values(template), (jnp.asarray(x), jnp.asarray(y))

    def read(values: jax.Array, counts: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
        return reported(to_instrument(values), counts, x, y)

    probe = jnp.full((1, counts.shape[1]), 1e6), *jnp.array(AT)[:, None]
    active = np.abs(np.asarray(jax.jacfwd(read)(values, *probe))).max(axis=(0, 1)) > 0
    true = jnp.asarray(np.nan_to_num(counts))
    _, slope = jax.jvp(lambda c: read(values, c, *at), (true,), (jnp.ones_like(true),))
    for place in np.flatnonzero(active[vectors.parameters]):
        along = jnp.zeros_like(values).at[vectors.parameters[place]].set(1.0)
        _, change = jax.jvp(lambda v: read(v, true, *at), (values,), (along,))
        yield int(place), -np.asarray(change / slope)
