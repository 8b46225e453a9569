"""The true instrument of an outside set, rebuilt by the oracle from what its truth files say, and a fit beside it.

The throughput maps are not in the files, but M21 and M31 at many points are: each pair's ratio is one of two
polynomials of degree 4, found as the null vector of P_a − ratio · P_b = 0, and the constants are in the files.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from builders import ORACLE_NAMES
from oracle import forward, validate
from scipy import stats
from south_sets import SouthSet

from walop_jax.fit.refit import FitResult


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

    def values(self) -> dict[str, float]:
        """True values by the names of the base model, standards apart; the first throughput is held at ½ there."""
        throughput = self.params["throughput"] * (0.5 / self.params["throughput"][0, 0])
        return {ours: self.params[theirs] for ours, theirs in ORACLE_NAMES.items()} | {
            f"throughput.n{k}.p{i}{j}": value
            for k in range(4)
            for (i, j), value in zip(forward.TERMS, throughput[k], strict=True)
        }


def chance(result: FitResult, true: Mapping[str, float]) -> float:
    """The probability of values that are farther off, all together: (θ − θ_true)ᵀ C⁻¹ (θ − θ_true) is a χ²."""
    some = [i for i in result.model.free if result.model.names[i] in true]
    off = np.array([result.values[i] - true[result.model.names[i]] for i in some])
    sigma = result.sigma[some]
    correlation = result.covariance[np.ix_(some, some)] / np.outer(sigma, sigma)
    pulls = off / sigma
    return float(stats.chi2.sf(pulls @ np.linalg.solve(correlation, pulls), len(some)))
