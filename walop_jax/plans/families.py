"""Families of candidates: a list, or a continuum of which the best is found, and bounded, from a grid of angles.

A plan asks for the candidates with the largest gain tr G M_i for their cost, whatever its G is (`optimal`). In a list
whose matrices are linear in a few fixed ones, M_i = Σ_j F_ij B_j, a million candidates cost a million short dot
products. In a continuum the gain is a Fourier series in one angle or several, known from its values on a grid.
"""

from __future__ import annotations

import abc
import dataclasses
import itertools

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy import fft

Matrices = Float[np.ndarray, "r j n n"]

_FINER = (64, 12)  # points per period of the highest harmonic, of one angle and of each of several
_POINTS = 256  # of a grid at least
_TAIL = 4  # last harmonics of each angle, which stand for those that are not there
_SPREAD = 16  # candidates of a family that a plan begins with


class Family(abc.ABC):
    """Candidates, each with an information matrix in every draw and a cost; a place says which."""

    @abc.abstractmethod
    def information(self, places: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "r s n n"]:
        """The matrices of the candidates at `places`, points of the family's own coordinates."""

    @abc.abstractmethod
    def turned(self, by: Float[np.ndarray, "b n m"]) -> Family:
        """The same in other parameters, Tᵀ M T for each T: draws are then one after the other for each of them."""

    @abc.abstractmethod
    def cost_at(self, places: Float[np.ndarray, "s d"]) -> Float[np.ndarray, " s"]:
        """Cost of the candidates at `places`."""

    @abc.abstractmethod
    def best(self, g: Float[np.ndarray, "r n n"], most: int) -> tuple[Float[np.ndarray, "s d"], float]:
        """Places of at most `most` local maxima of Σ_r tr G_r M_r / cost, and an upper bound over all candidates."""

    @abc.abstractmethod
    def spread(self) -> Float[np.ndarray, "s d"]:
        """A few candidates that stand for all of the family: a plan begins with them."""


@dataclasses.dataclass(frozen=True)
class Listed(Family):
    """Candidates one by one: candidate i has the information Σ_j F_ij B_j; its place is its number i.

    `basis` is B (draw, member, parameter, parameter), `rows` F; `of` takes one matrix for each candidate.
    """

    basis: Matrices
    rows: Float[np.ndarray, "m j"]
    cost: float | Float[np.ndarray, " m"] = 1.0

    @classmethod
    def of(cls, information: Matrices, cost: float | Float[np.ndarray, " m"] = 1.0) -> Listed:
        """Candidates given by their own matrices (draw, candidate, n, n)."""
        return cls(information, np.eye(information.shape[1]), cost)

    def information(self, places: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "r s n n"]:
        """Matrices of the candidates with these numbers."""
        r, j, n, _ = self.basis.shape
        return (self.rows[self._numbers(places)] @ self.basis.reshape(r, j, -1)).reshape(r, -1, n, n)

    def turned(self, by: Float[np.ndarray, "b n m"]) -> Listed:
        """The same list."""
        r, j = self.basis.shape[:2]
        basis = by.swapaxes(1, 2)[:, None] @ self.basis[:, None] @ by[:, None]
        return dataclasses.replace(self, basis=basis.reshape(r * len(by), j, *basis.shape[-2:]))

    def cost_at(self, places: Float[np.ndarray, "s d"]) -> Float[np.ndarray, " s"]:
        """Cost of the candidates with these numbers."""
        return np.broadcast_to(self.cost, len(self.rows))[self._numbers(places)].astype(float)

    def best(self, g: Float[np.ndarray, "r n n"], most: int) -> tuple[Float[np.ndarray, "s d"], float]:
        """The candidates with the largest gain for their cost."""
        ratio = self.rows @ np.einsum("rjab,rab->j", self.basis, g, optimize=True) / self.cost
        top = np.argpartition(-ratio, min(most, len(ratio)) - 1)[:most]
        return top[:, None].astype(float), float(ratio.max())

    def spread(self) -> Float[np.ndarray, "s d"]:
        """A few candidates, evenly through the list."""
        return np.unique(np.linspace(0, len(self.rows) - 1, _SPREAD).round())[:, None]

    @staticmethod
    def _numbers(places: Float[np.ndarray, "s d"]) -> Int[np.ndarray, " s"]:
        return np.rint(places[:, 0]).astype(int)


def even_angles(orders: tuple[int, ...]) -> Float[np.ndarray, "s d"]:
    """The grid of angles (rad) on which series of these degrees are known, the last angle first to change."""
    grids = [2 * np.pi * np.arange(2 * order + 1) / (2 * order + 1) for order in orders]
    return np.stack([a.ravel() for a in np.meshgrid(*grids, indexing="ij")], axis=1)


def spread_angles(orders: tuple[int, ...]) -> Float[np.ndarray, "s d"]:
    """A few places of a continuum of angles: while the first goes round once the others do so several times."""
    turns = np.arange(_SPREAD)[:, None] / _SPREAD * 5.0 ** np.arange(len(orders))
    return 2 * np.pi * (turns % 1.0)


def highest(values: Float[np.ndarray, ...], most: int) -> tuple[Float[np.ndarray, "s d"], float]:
    """Places (rad) of at most `most` local maxima of a Fourier series, and a bound of it over the continuum.

    `values` ≥ 0 are those at an odd number of equidistant angles along each axis.

    Limit: the series p, of degrees H, and its second derivatives p_ij, series as well, are bounded on a finer grid.
    Somewhere on N > 2H points of each angle |p| is at least max |p| Π cos(πH/N) (Ehlich & Zeller 1964, Math. Z. 86,
    41). Where p is largest its gradient vanishes, and the nearest point of the grid is no further than δ = π/N in each
    angle: there p is at least max p − ½ Σ δ_i δ_j max |p_ij| (Taylor). Other functions are taken to
    hold no more beyond them than the last harmonics do.
    """
    orders = [count // 2 for count in values.shape]
    counts = [max(_FINER[min(len(orders), 2) - 1] * order, _POINTS) for order in orders]
    waves = [np.fft.fftfreq(n, 1 / n) for n in values.shape]
    sparse = np.meshgrid(*waves, indexing="ij", sparse=True)
    series = np.asarray(fft.fftn(values)) / values.size
    last = np.zeros(values.shape, bool)
    for wave, order in zip(sparse, orders, strict=True):
        last |= np.abs(wave) > order - _TAIL
    beyond = float(np.abs(series[last]).sum()) if min(orders) > _TAIL else 0.0
    at = np.ix_(*(w.astype(int) % n for w, n in zip(waves, counts, strict=True)))

    def finer(series: Complex[np.ndarray, ...]) -> Float[np.ndarray, ...]:
        padded = np.zeros(counts, complex)
        padded[at] = series
        half = padded[..., : counts[-1] // 2 + 1]
        return np.asarray(fft.irfftn(half, counts)) * padded.size

    fine = finer(series)
    widest = 1 / np.prod([np.cos(np.pi * o / n) for o, n in zip(orders, counts, strict=True)])
    bend = 0.0
    for i, j in itertools.combinations_with_replacement(range(len(counts)), 2):
        largest = np.abs(finer(series * sparse[i] * sparse[j])).max() * widest
        bend += (0.5 if i == j else 1.0) * np.pi**2 / counts[i] / counts[j] * largest
    peak = np.ones(fine.shape, bool)
    for axis in range(len(counts)):
        peak &= (fine >= np.roll(fine, 1, axis)) & (fine > np.roll(fine, -1, axis))
    peak.flat[int(np.argmax(fine))] = True
    tops = np.argwhere(peak)
    tops = tops[np.argsort(-fine[tuple(tops.T)])][:most]
    places = np.empty(tops.shape)
    for axis, count in enumerate(counts):
        beside = np.eye(len(counts), dtype=int)[axis]
        low, mid, high = (fine[tuple(((tops + k * beside) % counts).T)] for k in (-1, 0, 1))
        shift = np.clip(0.5 * (low - high) / np.minimum(low - 2 * mid + high, -1e-300), -1, 1)
        places[:, axis] = 2 * np.pi / count * (tops[:, axis] + shift) % (2 * np.pi)
    return places, float(fine.max()) + bend + beyond


def harmonics(angle: Float[np.ndarray, " s"], order: int) -> Float[np.ndarray, "s h"]:
    """1, cos a, sin a, …, cos Ha, sin Ha at each angle."""
    turns = angle[:, None] * np.arange(1, order + 1)
    pairs = np.stack([np.cos(turns), np.sin(turns)], axis=2).reshape(len(angle), -1)
    return np.hstack([np.ones((len(angle), 1)), pairs])
