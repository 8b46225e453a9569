"""Types of arrays of numpy that several rooms speak of, each with its shape: the one home of such a name.

A letter stands for a length, the same one throughout a signature; `_` for any length. Types that only one file needs,
and those of arrays of JAX, stay beside the equations that they belong to. No name of a type, or of a class, has two
homes (`tests/test_house.py`).

    def correlation(covariance: Matrix, sigma: Vector) -> Matrix       # n errors, and an n by n matrix of them
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

Vector = Float[np.ndarray, " n"]
"""Numbers of n things: the values of all parameters, the rows of a table."""
Matrix = Float[np.ndarray, "n n"]
"""A square matrix of the same n things, such as a covariance."""
AnyVector = Float[np.ndarray, " _"]
"""A vector of any length."""
AnyMatrix = Float[np.ndarray, "_ _"]
"""A matrix of any size."""
OfPoints = Float[np.ndarray, " p"]
"""A number for each of p field points: a coordinate (deg), an error."""
OfExposures = Float[np.ndarray, " e"]
"""A number for each of e exposures."""
OfStars = Float[np.ndarray, " s"]
"""A number for each of s stars."""
CountsOfRows = Float[np.ndarray, "n k"]
"""Counts (electrons) of the k cameras in each of n rows of a table."""
ByRowAndCamera = Float[np.ndarray, "r k"]
"""A number for each of some rows r of a table, and each camera k."""
RowIndex = Int[np.ndarray, " r"]
"""Numbers of some rows of a table, from 0."""
ResidualCube = Float[np.ndarray, "p e k"]
"""A number for each of p field points, e exposures and k cameras."""
ColumnProducts = Float[np.ndarray, "c c"]
"""Products of c columns with each other."""
