"""Maps over the field: elements of the instrument matrix, and residuals of the smooth model."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from walop_jax.data.frames import Grid

SMALLEST_DETERMINANT = 0.1
"""|m22 m33 − m23 m32| below which a single exposure holds hardly any u."""


def matrix_names(arms: int) -> tuple[str, ...]:
    """Names of the matrix elements of an instrument, three for each arm: M21, M22, M23, M31, … (two arms: to M33)."""
    return tuple(f"M{arm + 2}{column}" for arm in range(arms) for column in (1, 2, 3))


def residual_names(arms: int) -> tuple[str, ...]:
    """Quantities of a residual map: the matrix elements, and the throughput of each arm beside the first.

    The latter are RATIO for two arms (cameras N2, N3 of WALOP), RATIO2, RATIO3, … for more.
    """
    ratios = ("RATIO",) if arms == 2 else tuple(f"RATIO{arm}" for arm in range(2, arms + 1))
    return (*matrix_names(arms), *ratios)


@dataclasses.dataclass(frozen=True)
class MatrixMaps:
    """The elements of the instrument matrix over the field, for a look: order of `matrix_names`, three per arm.

    For the filter named, a flat photon spectrum, the calibration plate out, and the further moving elements at
    `positions` (deg by column prefix; those not there are out). Raises ValueError for another number of planes.
    """

    grid: Grid
    filter: str
    values: Float[np.ndarray, "m y x"]
    errors: Float[np.ndarray, "m y x"]
    positions: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.values) % 3 or not len(self.values):
            raise ValueError(f"{len(self.values)} maps of a matrix that has three elements for each arm")

    @property
    def arms(self) -> int:
        """Number of arms."""
        return len(self.values) // 3

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the elements."""
        return matrix_names(self.arms)


@dataclasses.dataclass(frozen=True)
class ResidualMap:
    """Residuals of the smooth model in cells of the field: planes in the order of `residual_names`.

    To be added to the matrix (throughput of an arm: relative); NaN where a cell has too few data. `chi2` is that of the
    residuals before the correction, per degree of freedom. Through `filter`, with the calibration plate at
    `chwp_angle` (deg, NaN out) and the further moving elements at `positions` (deg by column prefix; those not there
    are out). Raises ValueError for another number of planes.
    """

    grid: Grid
    filter: str
    chwp_angle: float
    values: Float[np.ndarray, "m y x"]
    errors: Float[np.ndarray, "m y x"]
    chi2: Float[np.ndarray, "y x"]
    positions: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.values) % 4 != 3:
            raise ValueError(
                f"{len(self.values)} planes, for A arms there are 3 A elements and A − 1 throughputs"
            )

    @property
    def arms(self) -> int:
        """Number of arms."""
        return (len(self.values) + 1) // 4

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities."""
        return residual_names(self.arms)

    def excess(self) -> dict[str, float]:
        """Rms over the field of every quantity beyond its standard errors; negative if below, as chance has it."""
        found = {}
        for name, value, error in zip(self.names, self.values, self.errors, strict=True):
            known = np.isfinite(value)
            variance = float(np.mean(value[known] ** 2 - error[known] ** 2)) if known.any() else np.nan
            found[name] = float(np.sign(variance) * np.sqrt(abs(variance)))
        return found

    def significance(self) -> float:
        """Excess scatter of all corrections over their errors, in standard deviations."""
        squares = (self.values / self.errors)[np.isfinite(self.values)] ** 2
        return float((squares.sum() - squares.size) / np.sqrt(2.0 * max(squares.size, 1)))
