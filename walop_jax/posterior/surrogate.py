"""A fast stand-in for the exact posterior, and how far it may be trusted.

Near the fit the residuals are polynomials: with the sampled coefficients in whitened coordinates z and the
near-linear ones in whitened coordinates s,

    x = x̂ + A z + (C_λφ C_φφ⁻¹) A z + S s          A Aᵀ = C_φφ,  S Sᵀ = C_λλ − C_λφ C_φφ⁻¹ C_φλ   (Laplace)
    r(z, s) ≈ r₀ + Γ y,    y = (h, s),    h = (1, z_i, z_i z_j, and z_i z_j z_k where the model bends most)

Γ is fitted by least squares to exact residuals at design points (`building`). Only the Gram matrix of the
exact residuals is kept, so χ² = yᵀ Q y costs the same for 10⁴ and 10⁹ data. s is marginalised:

    −2 ln p(z) = h (Q_hh − Q_hs Q_ss⁻¹ Q_sh) h + z · ∇_z ln det H_ss
    s | z ~ N(−Q_ss⁻¹ Q_sh h − ½ ∇_s ln det H_ss, Q_ss⁻¹)

H is the true half Hessian of the objective. Its determinant tilts the marginal, and the skewness behind it
displaces the means of s from the mode; ∇ ln det H_ss = Σ_j (g(S_j) + g(−S_j) − 2 g(0)) from exact half
gradients g.

With noise inflation the errors of the data are times f, and Q_ss = D/f² + P is diagonal in the common
eigenvectors of D and P; − n ln f is added, ln f having the prior N(0, 1). Its coordinate is ln f √(2n).

`accuracy.check` compares with the exact posterior, all coefficients together, at draws of the surrogate's.

Source   Laplace marginals: Tierney & Kadane 1986, JASA 81, 82. Compression as in reduced-order quadrature:
         Canizares et al. 2013, Phys. Rev. D 87, 124005.
"""

from __future__ import annotations

import dataclasses
import inspect

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from walop_jax.model.compiled import compiled
from walop_jax.posterior.density import Density
from walop_jax.posterior.target import INFLATION, LN_F_WIDTH

Matrix = Float[np.ndarray, "..."]
Draws = Float[np.ndarray, "n k"]


@dataclasses.dataclass(frozen=True)
class Surrogate:
    """Everything needed to evaluate and to draw; `inflate` adds ln f as the last sampled coordinate.

    x = centre + along @ z + across @ s. `data` and `prior` are Q in the features y for the errors as given;
    `linear` turns s into the common eigenvectors of both, with eigenvalues `share` for the data, 1 −
    `share` for the priors, `slope` and `skew` are ∇_z and ∇_s of ln det H_ss. `pairs` and `triples` are the
    monomials of h.
    """

    names: tuple[str, ...]
    sampled: Int[np.ndarray, " k"]
    centre: Float[np.ndarray, " f"]
    along: Float[np.ndarray, "f k"]
    across: Float[np.ndarray, "f s"]
    pairs: Int[np.ndarray, "p 2"]
    triples: Int[np.ndarray, "t 3"]
    data: Matrix
    prior: Matrix
    linear: Float[np.ndarray, "s s"]
    share: Float[np.ndarray, " s"]
    slope: Float[np.ndarray, " k"]
    skew: Float[np.ndarray, " s"]
    measured: int
    inflate: bool = False

    @property
    def dimension(self) -> int:
        """Number of sampled coordinates."""
        return self.along.shape[1] + int(self.inflate)

    @property
    def ln_f_unit(self) -> float:
        """What ln f changes by per unit of its coordinate."""
        return 1.0 / np.sqrt(2.0 * max(self.measured, 1))

    def weight(self, z: Draws) -> Float[np.ndarray, " n"]:
        """1/f² of every draw."""
        return np.exp(-2.0 * self.ln_f_unit * z[:, -1]) if self.inflate else np.ones(len(z))

    def features(self, z: Draws) -> Float[np.ndarray, "n h"]:
        """h for every draw."""
        return np.asarray(features_of(jnp.asarray(z), jnp.asarray(self.pairs), jnp.asarray(self.triples)))

    def density(self) -> Density:
        """The marginal density of the sampled coordinates, many positions at a time."""
        h = self.data.shape[0] - len(self.share)
        pairs, triples = jnp.asarray(self.pairs), jnp.asarray(self.triples)
        if self.inflate:
            mixed = [self.linear.T @ q[h:, :h] for q in (self.data, self.prior)]
            prior = self._tilted(self.prior[:h, :h])
            parts = (self.data[:h, :h], prior, *mixed, self.share, np.asarray(float(self.measured)))
            function, arrays = _inflated, (pairs, triples, *(jnp.asarray(p) for p in parts))
        else:
            q = self.data + self.prior
            schur = q[:h, :h] - q[:h, h:] @ np.linalg.solve(q[h:, h:], q[h:, :h])
            function = _plain
            arrays = (pairs, triples, jnp.asarray(self._tilted(0.5 * (schur + schur.T))))

        def one(z: Array, *arrays: Array) -> Array:
            return inspect.unwrap(function)(*arrays, z[None])[0]

        def many(z: Draws) -> Float[np.ndarray, " n"]:
            value = np.asarray(function(*arrays, jnp.asarray(z)), np.float64)
            return np.where(np.isfinite(value), value, -np.inf)

        return Density(self.dimension, one, arrays, batch=many)

    @property
    def quoted_names(self) -> tuple[str, ...]:
        """Names of what is sampled, as people quote it."""
        return (*(self.names[i] for i in self.sampled), *((INFLATION,) if self.inflate else ()))

    def quoted(self, z: Float[np.ndarray, "... k"]) -> Float[np.ndarray, "... q"]:
        """The sampled coefficients themselves (and ln f) at sampled coordinates."""
        k = self.along.shape[1]
        physical = self.centre[self.sampled] + z[..., :k] @ self.along[self.sampled].T
        return np.concatenate([physical, z[..., k:] * self.ln_f_unit], axis=-1)

    def _tilted(self, form: Matrix) -> Matrix:
        """A quadratic form in h with the linear term of the determinant added."""
        k, tilted = len(self.slope), form.copy()
        tilted[0, 1 : 1 + k] += 0.5 * self.slope
        tilted[1 : 1 + k, 0] += 0.5 * self.slope
        return tilted

    def _conditional(self, z: Draws) -> tuple[Float[np.ndarray, "n s"], Float[np.ndarray, "n s"]]:
        """Mean and variance of s in its eigenvectors, given the sampled coordinates."""
        k, h = self.along.shape[1], self.data.shape[0] - len(self.share)
        weight = self.weight(z)[:, None]
        precision = self.share * weight + (1.0 - self.share)
        y = self.features(z[:, :k])
        pull = weight * (y @ self.data[:h, h:] @ self.linear) + y @ self.prior[:h, h:] @ self.linear
        return -(pull + 0.5 * self.skew @ self.linear) / precision, 1.0 / precision

    def draw(self, z: Draws, rng: np.random.Generator) -> Float[np.ndarray, "n f"]:
        """Free parameters for sampled coordinates: the marginalised ones are drawn from their conditional."""
        mean, variance = self._conditional(z)
        s = (mean + np.sqrt(variance) * rng.standard_normal(mean.shape)) @ self.linear.T
        return self.place(z, s)

    def place(self, z: Draws, s: Float[np.ndarray, "n s"]) -> Float[np.ndarray, "n f"]:
        """Free parameters at given coordinates."""
        return self.centre + z[:, : self.along.shape[1]] @ self.along.T + s @ self.across.T

    def moments(self, z: Draws) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, "f f"]]:
        """Mean and covariance of all free parameters.

        E and Var of the conditional, averaged over draws (Rao–Blackwell).
        """
        mean, variance = self._conditional(z)
        x = self.place(z, mean @ self.linear.T)
        inner = (self.across @ self.linear) * np.sqrt(variance.mean(axis=0))
        return x.mean(axis=0), np.cov(x, rowvar=False).reshape(2 * (len(self.centre),)) + inner @ inner.T

    def joint(self, z: Draws, x: Float[np.ndarray, "n f"]) -> Float[np.ndarray, " n"]:
        """−2 ln posterior of the surrogate at full draws: χ² at the errors of the draw, plus priors."""
        k = self.along.shape[1]
        offset = x - self.centre - z[:, :k] @ self.along.T
        s = np.linalg.lstsq(self.across, offset.T, rcond=None)[0].T if len(self.share) else offset[:, :0]
        y = np.concatenate([self.features(z[:, :k]), s], axis=1)
        weight = self.weight(z)
        tilt = z[:, :k] @ self.slope + s @ self.skew
        return weight * np.sum((y @ self.data) * y, axis=1) + np.sum((y @ self.prior) * y, axis=1) + tilt


def features_of(z: Array, pairs: Array, triples: Array) -> Array:
    """h of the module's equations, for every row of z."""
    parts = [jnp.ones((z.shape[0], 1)), z, z[:, pairs[:, 0]] * z[:, pairs[:, 1]]]
    if triples.shape[0]:
        parts.append(z[:, triples[:, 0]] * z[:, triples[:, 1]] * z[:, triples[:, 2]])
    return jnp.concatenate(parts, axis=1)


@compiled
def _plain(pairs: Array, triples: Array, schur: Array, z: Array) -> Array:
    h = features_of(z, pairs, triples)
    return -0.5 * jnp.sum((h @ schur) * h, axis=1)


@compiled
def _inflated(
    pairs: Array, triples: Array, data: Array, prior: Array, by_data: Array, by_prior: Array, share: Array,
    measured: Array, z: Array,
) -> Array:  # fmt: skip
    ln_f = z[:, -1] / jnp.sqrt(2.0 * measured)
    weight = jnp.exp(-2.0 * ln_f)
    h = features_of(z[:, :-1], pairs, triples)
    chi2 = weight * jnp.sum((h @ data) * h, axis=1) + jnp.sum((h @ prior) * h, axis=1)
    precision = weight[:, None] * share + (1.0 - share)
    pull = weight[:, None] * (h @ by_data.T) + h @ by_prior.T
    chi2 = chi2 - jnp.sum(pull**2 / precision, axis=1) + jnp.sum(jnp.log(precision), axis=1)
    return -0.5 * (chi2 + (ln_f / LN_F_WIDTH) ** 2) - measured * ln_f
