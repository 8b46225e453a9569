"""The true instrument of an outside set, rebuilt by the oracle from what its truth files say.

The throughput maps are not in the files, but M21 and M31 at many points are: each pair's ratio is one of two
polynomials of degree 4, found as the null vector of P_a − ratio · P_b = 0, and the constants are in the files.
"""

from __future__ import annotations

import numpy as np
from oracle import forward, validate
from south_sets import SouthSet


class TrueInstrument:
    """Analysis vectors of the true instrument anywhere in the field, by the oracle, SDSS-r, 5772 K."""

    def __init__(self, south: SouthSet) -> None:
        params, self.table = validate.read_truth(south)
        data = forward.load(south.path)
        self.band = forward.band(*data["filters"]["SDSS-r"], 5772.0)
        x, y = self.table["X"], self.table["Y"]
        unit = {**params, "throughput": np.eye(1, 15).repeat(4, 0)}
        ratio = validate.throughput_ratios(forward.analysis_vectors(unit, x, y, *self.band), self.table)
        level = south.as_built()["throughput"]
        basis = forward.legendre_basis(x, y)
        throughput = np.zeros((4, 15))
        for a in (0, 2):
            _, size, vt = np.linalg.svd(np.concatenate([basis, -ratio[:, a, None] * basis], axis=1))
            assert size[-1] < 1e-7 * size[-2]
            both = vt[-1] * level[a + 1] / vt[-1][15]
            throughput[a], throughput[a + 1] = both[:15], both[15:]
            np.testing.assert_allclose(throughput[a][0], level[a], rtol=1e-9)
        self.params = {**params, "throughput": throughput}
        matrix = self.matrix(x, y)
        for k, values in validate.truth_matrix(self.table).items():
            np.testing.assert_allclose(matrix[k], values, atol=1e-7)

    def matrix(self, x: np.ndarray, y: np.ndarray) -> dict[str, np.ndarray]:
        """m21 … m33 at field positions (deg)."""
        return forward.matrix(self.params, x, y, *self.band)

    def vectors(self, x: np.ndarray, y: np.ndarray, plate: float | None = None) -> np.ndarray:
        return forward.analysis_vectors(self.params, np.asarray(x), np.asarray(y), *self.band, plate)[..., :3]
