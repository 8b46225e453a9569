"""Functions of the colour of a source, as Chebyshev series in 1/T over [0, 1/`COOLEST`], beside a flat spectrum."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from walop_jax.model import chebyshev

COOLEST = 2000.0
"""Colour temperature (K) below which no Planck curve describes a star's spectrum in a red filter."""


def colour_nodes(count: int) -> Float[np.ndarray, " c"]:
    """Colour temperatures (K) at which a series is made."""
    return COOLEST / (0.5 * (1.0 + chebyshev.nodes(count)))


def colour_weights(teff: Float[np.ndarray, " p"], count: int) -> Float[np.ndarray, "p c"]:
    """Weights of the functions (flat spectrum, then `colour_nodes`) for sources of temperature `teff` (K).

    NaN is a flat photon spectrum; what is cooler than `COOLEST` is taken as that.
    """
    flat = np.isnan(teff)
    t = 2.0 * np.minimum(COOLEST / np.where(flat, COOLEST, teff), 1.0) - 1.0
    lagrange = chebyshev.polynomials(t, count) @ chebyshev.to_coefficients(count)
    return np.concatenate([flat[:, None].astype(float), np.where(flat[:, None], 0.0, lagrange)], axis=1)
