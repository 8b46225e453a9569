"""How far the surrogate may be trusted: a comparison with the exact posterior at its own draws."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from walop_jax.posterior.surrogate import Draws, Surrogate
from walop_jax.posterior.target import Target


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """The surrogate against the exact posterior at `count` draws of the former, all coefficients together.

    `spread` is the standard deviation of ln(exact/surrogate), `efficiency` the effective share of importance
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
        """Whether sampling the surrogate is sampling the posterior: means to 0.1 σ, widths to 5 %."""
        shift, width = (
            abs(value) - 3.0 * error
            for value, error in (self.shift[1:], (self.width[1] - 1.0, self.width[2]))
        )
        return bool(np.isfinite(self.spread)) and self.efficiency > 0.5 and shift < 0.1 and width < 0.05


def check(target: Target, surrogate: Surrogate, z: Draws, rng: np.random.Generator) -> Accuracy:
    """Compare with the exact posterior at coordinates z, which are draws of the surrogate's posterior.

    With ρ = ln(exact/surrogate) and a standardised coefficient t, to first order the exact mean is off by
    Cov(ρ, t) and the exact variance by the factor 1 + Cov(ρ, t²).
    """
    x, weight = surrogate.draw(z, rng), surrogate.weight(z)
    exact = [
        w * target.data(one) + float(np.sum(target.prior_rows(one) ** 2))
        for w, one in zip(weight, x, strict=True)
    ]
    ln_ratio = -0.5 * (np.array(exact) - surrogate.joint(z, x))
    ln_ratio = ln_ratio - ln_ratio.mean()
    importance = np.exp(np.clip(ln_ratio, -50.0, 50.0))
    t = (x - x.mean(axis=0)) / x.std(axis=0)

    def worst(product: Float[np.ndarray, "n f"]) -> tuple[str, float, float]:
        mean, error = product.mean(axis=0), product.std(axis=0) / np.sqrt(len(z))
        i = int(np.argmax(np.abs(mean)))
        return surrogate.names[i], float(mean[i]), float(error[i])

    shift, variance = worst(ln_ratio[:, None] * t), worst(ln_ratio[:, None] * (t**2 - 1.0))
    return Accuracy(
        count=len(z),
        spread=float(np.std(ln_ratio)),
        efficiency=float(importance.mean() ** 2 / np.mean(importance**2)),
        shift=shift,
        width=(variance[0], 1.0 + 0.5 * variance[1], 0.5 * variance[2]),
    )
