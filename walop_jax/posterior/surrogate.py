"""The surrogate: a polynomial form of the exact posterior, built from exact residuals and compared with it.

Near the fit the residuals are polynomials: with the sampled coefficients in whitened coordinates z and the
near-linear ones in whitened coordinates s,

    x = x̂ + A z + (C_λφ C_φφ⁻¹) A z + S s          A Aᵀ = C_φφ,  S Sᵀ = C_λλ − C_λφ C_φφ⁻¹ C_φλ   (Laplace)
    r(z, s) ≈ r₀ + Γ y,    y = (h, s),    h = (1, z_i, z_i z_j, and z_i z_j z_k where the model bends most)

Γ is fitted by least squares to exact residuals at design points (`build_surrogate`). Only the Gram matrix of the
exact residuals is kept, so χ² = yᵀ Q y costs the same for 10⁴ and 10⁹ data. s is marginalised:

    −2 ln p(z) = h (Q_hh − Q_hs Q_ss⁻¹ Q_sh) h + z · ∇_z ln det H_ss
    s | z ~ N(−Q_ss⁻¹ Q_sh h − ½ ∇_s ln det H_ss, Q_ss⁻¹)

H is the true half Hessian of the objective. Its determinant tilts the marginal, and the skewness behind it displaces
the means of s from the mode; ∇ ln det H_ss = Σ_j (g(S_j) + g(−S_j) − 2 g(0)) from exact half gradients g.

A common scale s of the errors of the data (`noise.scale`) is f times its fitted value, and Q_ss = D/f² + P is diagonal
in the common eigenvectors of D and P; − n ln f + ln f is added, for the n data and for a prior that is flat in s. Its
coordinate is ln f √(2n). Other parameters of the errors need the exact posterior.

`compare_with_exact` compares it with the exact posterior, all coefficients together, at draws of the surrogate's.

Source   Laplace marginals: Tierney & Kadane 1986, JASA 81, 82. Compression as in reduced-order quadrature:
         Canizares et al. 2013, Phys. Rev. D 87, 124005.
"""

from __future__ import annotations

import dataclasses
import inspect
import itertools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from walop_jax.model.compiled import compiled
from walop_jax.model.noise import COMMON
from walop_jax.posterior.samplers import Density
from walop_jax.posterior.target import Draws, Target, choose_sampled, ln_scale_unit

Stacked = Float[np.ndarray, "..."]

OVERSAMPLING = 1.5  # design points per feature
LEAST = 1.1  # pairs of points ±u per odd feature, and per even feature: a pair measures one of each
SPREAD = 1.2  # of the design, in standard errors
BENT = 8  # directions that get cubic terms


@dataclasses.dataclass(frozen=True)
class Surrogate:
    """The surrogate: everything needed to evaluate it and to draw from it.

    x = centre + along @ z + across @ s. `data` and `prior` are Q in the features y for the errors as given; `linear`
    turns s into the common eigenvectors of both, with eigenvalues `share` for the data and 1 − `share` for the priors;
    `slope` and `skew` are ∇_z and ∇_s of ln det H_ss. `pairs` and `triples` are the monomials of h. `scale` is the
    fitted value of a common scale of the errors, whose ln f is then the last sampled coordinate; None: the errors are
    as they are.
    """

    names: tuple[str, ...]
    sampled: Int[np.ndarray, " k"]
    centre: Float[np.ndarray, " f"]
    along: Float[np.ndarray, "f k"]
    across: Float[np.ndarray, "f s"]
    pairs: Int[np.ndarray, "p 2"]
    triples: Int[np.ndarray, "t 3"]
    data: Stacked
    prior: Stacked
    linear: Float[np.ndarray, "s s"]
    share: Float[np.ndarray, " s"]
    slope: Float[np.ndarray, " k"]
    skew: Float[np.ndarray, " s"]
    measured: int
    scale: float | None = None

    @property
    def dimension(self) -> int:
        """Number of sampled coordinates."""
        return self.along.shape[1] + int(self.scale is not None)

    def scales(self, z: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, " *n"]:
        """The common scale of the errors of every draw; 1 where there is none."""
        if self.scale is None:
            return np.ones(z.shape[:-1])
        return self.scale * np.exp(ln_scale_unit(self.measured) * z[..., -1])

    def weight(self, z: Draws) -> Float[np.ndarray, " n"]:
        """1/f² of every draw (n), f the factor on the errors."""
        return (self.scales(z) / (self.scale or 1.0)) ** -2

    def features(self, z: Draws) -> Float[np.ndarray, "n h"]:
        """The features h (n, h) of the equations in the head of this file, for every draw."""
        return np.asarray(features_of(jnp.asarray(z), jnp.asarray(self.pairs), jnp.asarray(self.triples)))

    def density(self) -> Density:
        """The marginal density of the sampled coordinates, many positions at a time."""
        h = self.data.shape[0] - len(self.share)
        pairs, triples = jnp.asarray(self.pairs), jnp.asarray(self.triples)
        if self.scale is not None:
            mixed = [self.linear.T @ q[h:, :h] for q in (self.data, self.prior)]
            prior = self._tilted(self.prior[:h, :h])
            constants = (self.data[:h, :h], prior, *mixed, self.share, np.asarray(float(self.measured)))
            function, arrays = _inflated, (pairs, triples, *(jnp.asarray(p) for p in constants))
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
    def monitored_names(self) -> tuple[str, ...]:
        """Names of the sampled parameters."""
        return (*(self.names[i] for i in self.sampled), *((COMMON,) if self.scale is not None else ()))

    def monitored(self, z: Float[np.ndarray, "... k"]) -> Float[np.ndarray, "... q"]:
        """The sampled coefficients themselves, and the scale of the errors, at sampled coordinates."""
        k = self.along.shape[1]
        physical = self.centre[self.sampled] + z[..., :k] @ self.along[self.sampled].T
        return physical if self.scale is None else np.append(physical, self.scales(z)[..., None], axis=-1)

    def _tilted(self, form: Stacked) -> Stacked:
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
        """Free parameters (n, f) at given coordinates z and s."""
        return self.centre + z[:, : self.along.shape[1]] @ self.along.T + s @ self.across.T

    def moments(self, z: Draws) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, "f f"]]:
        """Mean and covariance of all free parameters: E and Var of the conditional, averaged (Rao–Blackwell)."""
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
        weight, skew = self.weight(z), self.skew @ self.linear
        mean, variance = self._conditional(z)
        # Of s only the way from its conditional mean is in it, as it is drawn: what is left of the square is taken off.
        tilt = z[:, :k] @ self.slope + s @ self.skew - (mean + 0.25 * variance * skew) @ skew
        return weight * np.sum((y @ self.data) * y, axis=1) + np.sum((y @ self.prior) * y, axis=1) + tilt


def features_of(z: Array, pairs: Array, triples: Array) -> Array:
    """h of the module's equations, for every row of z."""
    features = [jnp.ones((z.shape[0], 1)), z, z[:, pairs[:, 0]] * z[:, pairs[:, 1]]]
    if triples.shape[0]:
        features.append(z[:, triples[:, 0]] * z[:, triples[:, 1]] * z[:, triples[:, 2]])
    return jnp.concatenate(features, axis=1)


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
    return -0.5 * chi2 - (measured - 1.0) * ln_f


def _axes(covariance: Stacked, scale: Float[np.ndarray, " k"]) -> Stacked:
    """A with A Aᵀ = covariance, columns along the principal axes in the units of `scale`."""
    value, vector = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * vector * np.sqrt(np.clip(value, value.max(initial=0.0) * 1e-15, None))


def _coordinates(target: Target, sampled: Int[np.ndarray, " k"]) -> tuple[Stacked, Stacked]:
    marginalised = np.setdiff1d(np.arange(len(target.free)), sampled)
    c, scale = target.covariance, target.scale
    axes = _axes(c[np.ix_(sampled, sampled)], scale[sampled])
    follow = np.linalg.solve(axes, c[np.ix_(sampled, marginalised)]).T  # C_λφ A⁻ᵀ
    along, across = np.zeros((len(c), len(sampled))), np.zeros((len(c), len(marginalised)))
    along[sampled], along[marginalised] = axes, follow
    conditional = c[np.ix_(marginalised, marginalised)] - follow @ follow.T
    across[marginalised] = _axes(conditional, scale[marginalised])
    return along, across


def _gram(
    target: Target, x: Float[np.ndarray, "m f"], progress: Callable[[int, int], None] | None
) -> Stacked:
    """Gram matrix of (r₀, r(x_1) − r₀, r(x_2) − r₀, …) over all data."""
    gram, batches = np.zeros((len(x) + 1, len(x) + 1)), target.likelihood.points
    for number, batch in enumerate(batches):
        first = target.residuals(target.centre, batch)
        rows = np.empty((len(x) + 1, first.size))
        rows[0] = first
        for m, point in enumerate(x, start=1):
            rows[m] = target.residuals(point, batch) - first
            if progress is not None:
                progress(number * len(x) + m, len(batches) * len(x))
        gram += rows @ rows.T
    return gram


def build_surrogate(
    target: Target,
    *,
    sampled: Int[np.ndarray, " k"] | None = None,
    order: int = 3,
    scale: float | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Surrogate:
    """Fit the surrogate (`order` 2 or 3) to exact residuals at about 1.5 design points per feature.

    `scale` is the fitted value of a common scale of the errors, which is sampled as well; None: no scale.
    """
    if order not in (2, 3):
        raise ValueError(f"order {order}: the surrogate is of order 2 or 3")
    sampled = choose_sampled(target) if sampled is None else sampled
    along, across = _coordinates(target, sampled)
    k, s = along.shape[1], across.shape[1]
    pairs = np.array(list(itertools.combinations_with_replacement(range(k), 2)), int).reshape(-1, 2)
    bent = np.sort(np.argsort(-target.bending(along))[:BENT]).tolist() if order == 3 else []
    triples = np.array(list(itertools.combinations_with_replacement(bent, 3)), int).reshape(-1, 3)
    odd, even = k + len(triples) + s, 1 + len(pairs)
    n_features = odd + even
    # Points ±u with u normal: odd and even parts of the residuals separate.
    count = max(0.5 * OVERSAMPLING * n_features, LEAST * max(odd, even)) + 1.0
    half = SPREAD * np.random.default_rng([seed, 20]).standard_normal((int(np.ceil(count)), k + s))
    design = np.concatenate([half, -half])
    x = target.centre + design[:, :k] @ along.T + design[:, k:] @ across.T
    features = features_of(*(jnp.asarray(a) for a in (design[:, :k], pairs, triples)))
    y = np.concatenate([np.asarray(features), design[:, k:]], axis=1)
    q, r = np.linalg.qr(y)
    inverse, gram = np.linalg.solve(r, q.T), _gram(target, x, progress)
    data, cross = inverse @ gram[1:, 1:] @ inverse.T, inverse @ gram[1:, 0]
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
        slope=slope, skew=skew, measured=target.measured, scale=scale,
    )  # fmt: skip


def _prior_form(target: Target, along: Stacked, across: Stacked, n_features: int) -> Stacked:
    """Q of priors and weak pulls: they are linear in x, hence exact."""
    first = target.prior_rows(target.centre)
    rows = np.zeros((len(first), n_features))
    rows[:, 0] = first
    rows[:, 1 : 1 + along.shape[1]] = target.prior_slopes(along)
    rows[:, n_features - across.shape[1] :] = target.prior_slopes(across)
    return rows.T @ rows


def _determinant_slopes(
    target: Target, along: Stacked, across: Stacked
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " s"]]:
    """Derivatives of ln det H_ss along both kinds of coordinates; columns of `across` make H_ss the unit matrix."""
    total, twice = np.zeros(len(target.centre)), 2.0 * target.half_gradient(target.centre)
    for step in across.T:
        up, down = (target.half_gradient(target.centre + sign * step) for sign in (1, -1))
        total += up + down - twice
    return total @ along, total @ across


def _common_axes(data: Stacked, prior: Stacked) -> tuple[Stacked, Float[np.ndarray, " s"]]:
    """W with Wᵀ (D + P) W = 1 and Wᵀ D W diagonal."""
    if len(data) == 0:
        return np.zeros((0, 0)), np.zeros(0)
    root = np.linalg.inv(np.linalg.cholesky(data + prior)).T
    share, vector = np.linalg.eigh(root.T @ data @ root)
    return root @ vector, np.clip(share, 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """The surrogate against the exact posterior at `count` draws of the former, all coefficients together.

    `spread` is the standard deviation of ln(exact/surrogate), `efficiency` the effective fraction of importance
    weights. The exact posterior has means that differ by `shift` standard deviations and widths that differ
    by the factor `width` from those of the surrogate: the worst of all coefficients, ± one standard error.
    """

    count: int
    spread: float
    efficiency: float
    shift: tuple[str, float, float]
    width: tuple[str, float, float]

    @property
    def exact_enough(self) -> bool:
        """True where sampling the surrogate is sampling the posterior: means to 0.1 σ, widths to 5 %."""
        pairs = self.shift[1:], (self.width[1] - 1.0, self.width[2])
        shift, width = (abs(value) - 3.0 * error for value, error in pairs)
        return bool(np.isfinite(self.spread)) and self.efficiency > 0.5 and shift < 0.1 and width < 0.05


def compare_with_exact(target: Target, surrogate: Surrogate, z: Draws, rng: np.random.Generator) -> Accuracy:
    """Compare with the exact posterior at coordinates z, which are draws of the surrogate's posterior.

    With ρ = ln(exact/surrogate) and a standardised coefficient t, to first order the exact mean is off by
    Cov(ρ, t) and the exact variance by the factor 1 + Cov(ρ, t²).
    """
    x, weight = surrogate.draw(z, rng), surrogate.weight(z)
    data = np.array([target.data(point) for point in x])
    exact = weight * data + np.array([np.sum(target.prior_rows(point) ** 2) for point in x])
    ln_ratio = -0.5 * (exact - surrogate.joint(z, x))
    ln_ratio = ln_ratio - ln_ratio.mean()
    importance = np.exp(np.clip(ln_ratio, -50.0, 50.0))
    t = (x - x.mean(axis=0)) / x.std(axis=0)

    def worst(product: Float[np.ndarray, "n f"]) -> tuple[str, float, float]:
        mean, error = product.mean(axis=0), product.std(axis=0) / np.sqrt(len(z))
        i = int(np.argmax(np.abs(mean)))
        return surrogate.names[i], float(mean[i]), float(error[i])

    shift, variance = worst(ln_ratio[:, None] * t), worst(ln_ratio[:, None] * (t**2 - 1.0))
    width = variance[0], 1.0 + 0.5 * variance[1], 0.5 * variance[2]
    efficiency = float(importance.mean() ** 2 / np.mean(importance**2))
    return Accuracy(len(z), float(np.std(ln_ratio)), efficiency, shift, width)
