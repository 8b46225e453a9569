"""Building the surrogate from exact residuals and exact gradients around the fit (equations: `surrogate`)."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from walop_jax.posterior.surrogate import Draws, Matrix, Surrogate, features_of
from walop_jax.posterior.target import Target, choose_sampled

OVERSAMPLING = 1.5  # design points per feature
LEAST = 1.1  # pairs of points ±u per odd feature, and per even feature: a pair measures one of each
SPREAD = 1.2  # of the design, in standard errors
BENT = 8  # directions that get cubic terms


def _axes(covariance: Matrix, scale: Float[np.ndarray, " k"]) -> Matrix:
    """A with A Aᵀ = covariance, columns along the principal axes in the units of `scale`."""
    value, vector = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * vector * np.sqrt(np.clip(value, value.max(initial=0.0) * 1e-15, None))


def _coordinates(target: Target, sampled: Int[np.ndarray, " k"]) -> tuple[Matrix, Matrix]:
    rest = np.setdiff1d(np.arange(len(target.free)), sampled)
    c, scale = target.covariance, target.scale
    own = _axes(c[np.ix_(sampled, sampled)], scale[sampled])
    follow = np.linalg.solve(own, c[np.ix_(sampled, rest)]).T  # C_λφ A⁻ᵀ
    along, across = np.zeros((len(c), len(sampled))), np.zeros((len(c), len(rest)))
    along[sampled], along[rest] = own, follow
    across[rest] = _axes(c[np.ix_(rest, rest)] - follow @ follow.T, scale[rest])
    return along, across


def _design(rng: np.random.Generator, odd: int, even: int, width: int) -> Draws:
    """Points ±u with u normal: odd and even parts of the residuals separate."""
    pairs = max(0.5 * OVERSAMPLING * (odd + even), LEAST * max(odd, even)) + 1.0
    half = SPREAD * rng.standard_normal((int(np.ceil(pairs)), width))
    return np.concatenate([half, -half])


def _gram(target: Target, x: Float[np.ndarray, "m f"], progress: Callable[[int, int], None] | None) -> Matrix:
    """Gram matrix of (r₀, r(x_1) − r₀, r(x_2) − r₀, …) over all data."""
    gram, chunks = np.zeros((len(x) + 1, len(x) + 1)), target.likelihood.points
    for number, chunk in enumerate(chunks):
        first = target.residuals(target.centre, chunk)
        rows = np.empty((len(x) + 1, first.size))
        rows[0] = first
        for m, here in enumerate(x, start=1):
            rows[m] = target.residuals(here, chunk) - first
            if progress is not None:
                progress(number * len(x) + m, len(chunks) * len(x))
        gram += rows @ rows.T
    return gram


def build_surrogate(
    target: Target,
    *,
    sampled: Int[np.ndarray, " k"] | None = None,
    order: int = 3,
    inflate: bool = False,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Surrogate:
    """Fit the surrogate to exact residuals at about 1.5 design points per feature; `order` 2 or 3.

    Raises ValueError for other orders.
    """
    if order not in (2, 3):
        raise ValueError(f"order {order}: the surrogate is of order 2 or 3")
    sampled = choose_sampled(target) if sampled is None else sampled
    along, across = _coordinates(target, sampled)
    k, s = along.shape[1], across.shape[1]
    pairs = np.array(list(itertools.combinations_with_replacement(range(k), 2)), int).reshape(-1, 2)
    triples = np.zeros((0, 3), int)
    if order == 3:
        triples = _cubic_terms(target, along, k)
    odd, even = k + len(triples) + s, 1 + len(pairs)
    n_features = odd + even
    design = _design(np.random.default_rng([seed, 20]), odd, even, k + s)
    x = target.centre + design[:, :k] @ along.T + design[:, k:] @ across.T
    y = np.concatenate(
        [np.asarray(features_of(*(jnp.asarray(a) for a in (design[:, :k], pairs, triples)))), design[:, k:]],
        axis=1,
    )
    q, r = np.linalg.qr(y)
    inverse = np.linalg.solve(r, q.T)
    gram = _gram(target, x, progress)
    data = inverse @ gram[1:, 1:] @ inverse.T
    cross = inverse @ gram[1:, 0]
    data[0] += cross
    data[:, 0] += cross
    data[0, 0] += gram[0, 0]
    prior = _prior_form(target, along, across, n_features)
    h = n_features - s
    linear, share = _common_axes(data[h:, h:], prior[h:, h:])
    slope, skew = _determinant_slopes(target, along, across)
    return Surrogate(
        names=target.names, sampled=sampled, centre=target.centre, along=along, across=across, pairs=pairs,
        triples=triples, data=0.5 * (data + data.T), prior=prior, linear=linear, share=share,
        slope=slope, skew=skew, measured=target.measured, inflate=inflate,
    )  # fmt: skip


def _cubic_terms(target: Target, along: Matrix, k: int) -> Int[np.ndarray, "t 3"]:
    bent = np.zeros(k)
    for chunk in target.likelihood.points:
        here = target.residuals(target.centre, chunk)
        for i in range(k):
            up, down = (target.residuals(target.centre + sign * along[:, i], chunk) for sign in (1, -1))
            bent[i] += np.sum((0.5 * (up + down) - here) ** 2)
    worst = np.sort(np.argsort(-bent)[:BENT])
    return np.array(list(itertools.combinations_with_replacement(worst.tolist(), 3)), int)


def _prior_form(target: Target, along: Matrix, across: Matrix, n_features: int) -> Matrix:
    """Q of priors and loose pulls: they are linear in x, hence exact."""
    first = target.prior_rows(target.centre)
    k, s = along.shape[1], across.shape[1]
    rows = np.zeros((len(first), n_features))
    rows[:, 0] = first
    for i in range(k):
        rows[:, 1 + i] = target.prior_rows(target.centre + along[:, i]) - first
    for i in range(s):
        rows[:, n_features - s + i] = target.prior_rows(target.centre + across[:, i]) - first
    return rows.T @ rows


def _determinant_slopes(
    target: Target, along: Matrix, across: Matrix
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " s"]]:
    """Derivatives of ln det H_ss along both kinds of coordinates.

    Columns of `across` make H_ss the unit matrix.
    """
    total, first = np.zeros(len(target.centre)), target.half_gradient(target.centre)
    for step in across.T:
        total += (
            target.half_gradient(target.centre + step)
            + target.half_gradient(target.centre - step)
            - 2.0 * first
        )
    return total @ along, total @ across


def _common_axes(data: Matrix, prior: Matrix) -> tuple[Matrix, Float[np.ndarray, " s"]]:
    """W with Wᵀ (D + P) W = 1 and Wᵀ D W diagonal."""
    if len(data) == 0:
        return np.zeros((0, 0)), np.zeros(0)
    root = np.linalg.inv(np.linalg.cholesky(data + prior)).T
    share, vector = np.linalg.eigh(root.T @ data @ root)
    return root @ vector, np.clip(share, 0.0, 1.0)
