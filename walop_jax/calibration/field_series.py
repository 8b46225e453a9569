"""Smooth functions over the field and the colour of a source, as Chebyshev series.

    f(x, y) ≈ Σ_{i + j < n} c_ij T_i(x / R) T_j(y / R)

Source      Trefethen 2013, Approximation Theory and Approximation Practice, chapters 3 and 4: a function that is
            analytic beyond the interval is met with an error that falls geometrically with n.
Symbols     x, y field coordinates and R the half width of the field [deg]; t = 1/T of the source [1/K].

The optics are analytic in all of these, so a table of a few hundred field points stands for every pixel.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

Vector = Float[np.ndarray, " p"]

COOLEST = 2000.0
"""Colour temperature (K) below which no Planck curve describes a star's spectrum in a red filter."""


def nodes(count: int) -> Float[np.ndarray, " c"]:
    """The zeros of T_count on (−1, 1)."""
    return np.cos(np.pi * (np.arange(count) + 0.5) / count)


def _to_coefficients(count: int) -> Float[np.ndarray, "c c"]:
    """The matrix from values at `nodes` to Chebyshev coefficients."""
    matrix = 2.0 / count * chebyshev.chebvander(nodes(count), count - 1).T
    matrix[0] /= 2.0
    return matrix


def field_nodes(count: int, half_width: float) -> tuple[Vector, Vector]:
    """The count × count field points (deg) whose values a `FieldSeries` is made from."""
    t = half_width * nodes(count)
    x, y = np.meshgrid(t, t, indexing="ij")
    return x.ravel(), y.ravel()


@dataclasses.dataclass(frozen=True)
class FieldSeries:
    """Several functions of the field at once; `coefficients` (term, function), terms with i + j < count."""

    half_width: float
    count: int
    coefficients: Float[np.ndarray, "t f"]

    @classmethod
    def through(cls, half_width: float, values: Float[np.ndarray, "n2 f"]) -> FieldSeries:
        """The series through values at `field_nodes`, its terms beyond total degree count − 1 left out."""
        count = round(np.sqrt(len(values)))
        to = _to_coefficients(count)
        both = np.einsum("ai,bj,ijf->abf", to, to, values.reshape(count, count, -1), optimize=True)
        i, j = _terms(count)
        return cls(half_width, count, both[i, j])

    def __call__(self, x: Vector, y: Vector) -> Float[np.ndarray, "p f"]:
        """Values (point, function) at field positions in degrees."""
        i, j = _terms(self.count)
        across = chebyshev.chebvander(x / self.half_width, self.count - 1)
        along = chebyshev.chebvander(y / self.half_width, self.count - 1)
        return (across[:, i] * along[:, j]) @ self.coefficients


def _terms(count: int) -> tuple[np.ndarray, np.ndarray]:
    i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    low = i + j < count
    return i[low], j[low]


def colour_nodes(count: int) -> Float[np.ndarray, " c"]:
    """Colour temperatures (K) at which a series in 1/T over [0, 1/`COOLEST`] is made."""
    return COOLEST / (0.5 * (1.0 + nodes(count)))


def colour_weights(teff: Vector, count: int) -> Float[np.ndarray, "p c"]:
    """Weights of the functions (flat spectrum, then `colour_nodes`) for sources of temperature `teff` (K).

    NaN is a flat photon spectrum; what is cooler than `COOLEST` is taken as that.
    """
    flat = np.isnan(teff)
    t = 2.0 * np.minimum(COOLEST / np.where(flat, COOLEST, teff), 1.0) - 1.0
    lagrange = chebyshev.chebvander(t, count - 1) @ _to_coefficients(count)
    return np.concatenate([flat[:, None].astype(float), np.where(flat[:, None], 0.0, lagrange)], axis=1)
