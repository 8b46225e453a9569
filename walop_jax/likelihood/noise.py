"""The noise of the counts: one object that draws measurements and says how probable they are.

Equation    N = Poisson(μ) + Normal(0, read_noise²);   σ²(μ) = max(μ, 0) + read_noise²
Symbols     μ expected and N measured counts, read_noise per measurement [electron]
Source      Howell 2006, Handbook of CCD Astronomy, 4.4; N_ERR as given (docs: conventions).
Limits      The density is the normal one with variance σ²(μ), as good as exact from a variance of a few
            hundred on. What an observer states as N_ERR comes from the measured counts, σ(N): counts that
            came out low are given more weight, which biases a mean by −1 electron.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

Counts = Float[np.ndarray, "..."]


@dataclasses.dataclass(frozen=True)
class PhotonNoise:
    """Photon noise and read noise (electron rms per measurement)."""

    read_noise: float = 30.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.read_noise) and self.read_noise > 0):
            raise ValueError(f"read noise {self.read_noise} must be a positive number of electrons")

    def sigma(self, counts: Counts) -> Counts:
        """Standard deviation of a measurement that expects `counts` (electron), or that found them."""
        return np.sqrt(np.maximum(counts, 0.0) + self.read_noise**2)

    def draw(self, rng: np.random.Generator, expected: Counts) -> tuple[Counts, Counts]:
        """Return measured counts and the N_ERR that an observer would state for them.

        Raises ValueError for expected counts that are negative or not finite.
        """
        if not (np.isfinite(expected).all() and np.all(expected >= 0.0)):
            raise ValueError("expected counts must be finite and non-negative")
        # Read noise first: how many random numbers a Poisson draw takes depends on what is expected.
        read = self.read_noise * rng.standard_normal(expected.shape)
        counts = rng.poisson(expected) + read
        return counts, self.sigma(counts)

    def normalised_residuals(self, counts: Counts, expected: Counts) -> Counts:
        """(N − μ) / σ(μ): unit variance, whatever the expected counts."""
        return (counts - expected) / self.sigma(expected)

    def log_density(self, counts: Counts, expected: Counts) -> Counts:
        """Logarithm of the probability density of each measurement (per electron)."""
        residual = self.normalised_residuals(counts, expected)
        return -0.5 * residual**2 - np.log(self.sigma(expected)) - 0.5 * np.log(2.0 * np.pi)
