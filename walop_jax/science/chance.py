"""Probabilities that verdicts rest on."""

from __future__ import annotations

import jax.numpy as jnp
from jax.scipy.special import gammaincc


def chi2_tail(value: float, dof: int) -> float:
    """Probability that χ² with `dof` degrees of freedom exceeds a value: Q(dof/2, value/2)."""
    return float(gammaincc(jnp.asarray(0.5 * dof), jnp.asarray(0.5 * value)))
