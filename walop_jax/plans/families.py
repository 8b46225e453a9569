"""Families of candidates whose information is linear in a few fixed matrices, M_i = Σ_j F_ij B_j.

A million candidates then cost a million short dot products: the best for their cost are those with the largest F·g,
g_j = tr G B_j, whatever G a plan asks with (`optimal`). A family may be a list, or a continuum.
"""

from __future__ import annotations

import abc
import dataclasses

import numpy as np
from jaxtyping import Float, Int

Matrices = Float[np.ndarray, "r j n n"]

COMPRESSED = 1e-6
"""Share of any element, in units of its mean diagonal, that the basis of a `Circle` may leave out."""
_GRID = 64  # points per period of the highest harmonic: the maximum is known to 1 / cos(π / 64), 0.12 %
_SPANNING = 20_000  # elements of all matrices from which the basis of a circle is found
_SPREAD = 16  # candidates of a family that a plan begins with


class Family(abc.ABC):
    """Candidates whose information is linear in a few fixed matrices, `basis` (draw, member, parameter, parameter)."""

    basis: Matrices

    @abc.abstractmethod
    def coefficients(self, places: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s j"]:
        """Coefficients F of the candidates at `places`, points of the family's own coordinates."""

    @abc.abstractmethod
    def cost_at(self, places: Float[np.ndarray, "s d"]) -> Float[np.ndarray, " s"]:
        """Cost of the candidates at `places`."""

    @abc.abstractmethod
    def best(self, gains: Float[np.ndarray, " j"], most: int) -> tuple[Float[np.ndarray, "s d"], float]:
        """Places of at most `most` local maxima of F·gains / cost, and an upper bound of it over all candidates."""

    @abc.abstractmethod
    def spread(self) -> Float[np.ndarray, "s d"]:
        """A few candidates that stand for all of the family: a plan begins with them."""


@dataclasses.dataclass(frozen=True)
class Listed(Family):
    """Candidates one by one: candidate i has the information Σ_j F_ij B_j; its place is its number i.

    With `basis` left out there is one matrix for each candidate.
    """

    basis: Matrices
    rows: Float[np.ndarray, "m j"]
    cost: float | Float[np.ndarray, " m"] = 1.0

    @classmethod
    def of(cls, information: Matrices, cost: float | Float[np.ndarray, " m"] = 1.0) -> Listed:
        """Candidates given by their own matrices (draw, candidate, n, n)."""
        return cls(information, np.eye(information.shape[1]), cost)

    def coefficients(self, places: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s j"]:
        """Coefficients of the candidates with these numbers."""
        return self.rows[self._numbers(places)]

    def cost_at(self, places: Float[np.ndarray, "s d"]) -> Float[np.ndarray, " s"]:
        """Cost of the candidates with these numbers."""
        return np.broadcast_to(self.cost, len(self.rows))[self._numbers(places)].astype(float)

    def best(self, gains: Float[np.ndarray, " j"], most: int) -> tuple[Float[np.ndarray, "s d"], float]:
        """The candidates with the largest gain for their cost."""
        ratio = self.rows @ gains / self.cost
        top = np.argpartition(-ratio, min(most, len(ratio)) - 1)[:most]
        return top[:, None].astype(float), float(ratio.max())

    def spread(self) -> Float[np.ndarray, "s d"]:
        """A few candidates, evenly through the list."""
        return np.unique(np.linspace(0, len(self.rows) - 1, _SPREAD).round())[:, None]

    @staticmethod
    def _numbers(places: Float[np.ndarray, "s d"]) -> Int[np.ndarray, " s"]:
        return np.rint(places[:, 0]).astype(int)


@dataclasses.dataclass(frozen=True)
class Circle(Family):
    """A continuum of candidates at an angle in [0, 2π), whose information is a Fourier series of degree H in it.

    F = (1, cos a, sin a, …, cos Ha, sin Ha) · `mixing`: most series hold far fewer matrices than harmonics.

    Limit: a trigonometric polynomial p of degree H is at least max |p| cos(πH/N) somewhere on a grid of N > 2H points
    (Ehlich & Zeller 1964, Math. Z. 86, 41), so a grid bounds the maximum over the continuum.
    """

    basis: Matrices
    mixing: Float[np.ndarray, "h j"]
    cost: float = 1.0

    @classmethod
    def sampled(
        cls, information: Float[np.ndarray, "r s n n"], cost: float = 1.0, tolerance: float = COMPRESSED
    ) -> Circle:
        """The series through matrices (draw, angle, n, n) at an odd number of equidistant angles, beginning at 0.

        Singular vectors that hold less than `tolerance` of any element, in units of its mean diagonal, are left out.
        """
        draws, samples, n, _ = information.shape
        size = np.sqrt(np.einsum("rsaa->ra", information) / samples)
        size = np.where(size > 0, size, 1.0)
        upper = np.triu_indices(n)
        scale = size[:, upper[0]] * size[:, upper[1]]
        flat = np.concatenate([m[:, *upper] / s for m, s in zip(information, scale, strict=True)], axis=1)
        # Some thousand elements span what all of them do.
        some = flat[:, :: max(flat.shape[1] // _SPANNING, 1)]
        value, vector = np.linalg.eigh(some @ some.T * (flat.shape[1] / some.shape[1]))
        left = vector[:, value > (tolerance * samples) ** 2]
        packed = (left.T @ flat).reshape(-1, draws, len(upper[0])) * scale
        basis = np.empty((draws, len(packed), n, n))
        basis[..., upper[0], upper[1]] = basis[..., upper[1], upper[0]] = packed.swapaxes(0, 1)
        angle = 2 * np.pi * np.arange(samples) / samples
        return cls(basis, np.linalg.solve(harmonics(angle, samples // 2), left), cost)

    @property
    def order(self) -> int:
        """Degree H of the series."""
        return len(self.mixing) // 2

    def coefficients(self, places: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s j"]:
        """Coefficients at these angles (rad)."""
        return harmonics(places[:, 0], self.order) @ self.mixing

    def cost_at(self, places: Float[np.ndarray, "s d"]) -> Float[np.ndarray, " s"]:
        """The cost, which is the same everywhere."""
        return np.full(len(places), float(self.cost))

    def best(self, gains: Float[np.ndarray, " j"], most: int) -> tuple[Float[np.ndarray, "s d"], float]:
        """Local maxima on a fine grid, each refined, and the bound over the continuum."""
        series, count = self.mixing @ gains, max(_GRID * self.order, 1)
        spectrum = np.zeros(count // 2 + 1, complex)
        spectrum[0] = series[0]
        spectrum[1 : self.order + 1] = 0.5 * (series[1::2] - 1j * series[2::2])
        values = np.fft.irfft(spectrum, count) * count
        peak = np.flatnonzero((values >= np.roll(values, 1)) & (values > np.roll(values, -1)))
        peak = peak if len(peak) else np.array([int(np.argmax(values))])
        peak = peak[np.argsort(-values[peak])][:most]
        low, mid, high = (values[(peak + k) % count] for k in (-1, 0, 1))
        bend = np.minimum(low - 2 * mid + high, -1e-300)
        shift = np.clip(0.5 * (low - high) / bend, -1, 1)
        top = float(values.max()) / (np.cos(np.pi * self.order / count) if self.order else 1.0)
        return (2 * np.pi / count * (peak + shift) % (2 * np.pi))[:, None], top / self.cost

    def spread(self) -> Float[np.ndarray, "s d"]:
        """Equidistant angles."""
        count = min(2 * self.order + 1, _SPREAD)
        return 2 * np.pi * np.arange(count)[:, None] / count


def harmonics(angle: Float[np.ndarray, " s"], order: int) -> Float[np.ndarray, "s h"]:
    """1, cos a, sin a, …, cos Ha, sin Ha at each angle."""
    turns = angle[:, None] * np.arange(1, order + 1)
    pairs = np.stack([np.cos(turns), np.sin(turns)], axis=2).reshape(len(angle), -1)
    return np.hstack([np.ones((len(angle), 1)), pairs])
