"""What a pass over the points gives: χ², its quadratic expansion, what was counted, and how the optics were solved."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]

STATED = "N_ERR"
"""What errors of a fit are made from where it explains the data: the stated errors."""


class Census(NamedTuple):
    """Number of points used in each exposure; smallest and largest x, then y (deg), of those used in any; cameras."""

    rows: Int[np.ndarray, " e"]
    field: tuple[float, float, float, float]
    cameras: int

    @property
    def n_data(self) -> int:
        """Number of intensities used."""
        return self.cameras * int(self.rows.sum())

    def joined(self, other: Census) -> Census:
        """What is used of two parts of a set."""
        (a, b, c, d), (e, f, g, h) = self.field, other.field
        return Census(self.rows + other.rows, (min(a, e), max(b, f), min(c, g), max(d, h)), self.cameras)


class DataTerms(NamedTuple):
    """χ² of the data, its half gradient and its Gauss–Newton matrix in all parameters, no priors; what was used."""

    data: float
    gradient: Vector
    matrix: Matrix
    census: Census

    def joined(self, other: DataTerms) -> DataTerms:
        """The terms of two parts of a set."""
        return DataTerms(
            self.data + other.data,
            self.gradient + other.gradient,
            self.matrix + other.matrix,
            self.census.joined(other.census),
        )


class OpticsUsed(NamedTuple):
    """How optics were found: on so many nodes per side, with that error between them; None: point by point."""

    nodes_per_side: int | None
    error: float = 0.0


@dataclasses.dataclass(frozen=True)
class Posterior:
    """χ² of data and priors at a point of parameter space, and its expansion there in the free parameters.

    `gradient` is half the gradient of the total and `matrix` half its Gauss–Newton Hessian, both with the
    errors of the data times `noise_scale`; `data` and `chi2` are with the errors as given. `loose` is the
    share of the weak pulls that are no prior knowledge; it is in the gradient and the matrix, not in
    `chi2`. `dof` counts three per used row (four when the flux is known), one per prior, minus the free parameters.
    """

    data: float
    priors: float
    loose: float
    noise_scale: float
    gradient: Vector
    matrix: Matrix
    census: Census
    dof: int
    optics: OpticsUsed

    @property
    def chi2(self) -> float:
        """Sum over data and priors."""
        return self.data + self.priors

    @property
    def objective(self) -> float:
        """What a fit minimises."""
        return self.data / self.noise_scale**2 + self.priors + self.loose

    @property
    def n_data(self) -> int:
        """Number of intensities used."""
        return self.census.n_data
