"""Spots of the field in which a camera has lost or gained light: dust, dew, a blemish.

    f(d) = (1 − (d/R)ᵐ)²  within R of a place,     T = Σ f z / √(Σ f²)

over the stars near the place, z the gain of a camera (or an arm) that each star has by itself, in standard errors and
no more than `CLIPPED`: a star that lies off for reasons of its own is no spot, nor are three of them. Without a spot
T is normal. Places lie on a grid of R/2, for every R of `RADII` and m = 2. Place, R and m (of `EDGES`: a blurred spot
or a sharp one) are then those of the least Σ min((z − β f/σ)², c), c the square at which stars are no longer used.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize, sparse, spatial, special

from walop_jax.science.star_residuals import FEW, ROUNDING, TRIMMED, StarResiduals, Weights

RADII = (0.5, 0.25, 0.125)  # of the distance of the edge of the field
WIDEST = 0.7  # the same, of any spot
CLIPPED = float(-special.ndtri(0.5 * TRIMMED))  # 3.3 standard errors
Place = tuple[float, ...]


EDGES = (2.0, 8.0)
NO_SPOT = 1e12  # χ², above all that stars have


def profile(x: Float[np.ndarray, " r"], y: Float[np.ndarray, " r"], place: Place) -> Float[np.ndarray, " r"]:
    """f at positions (deg); a place is (x, y, R, m)."""
    distance = np.hypot(x - place[0], y - place[1]) / max(place[2], 1e-9)
    return (1.0 - np.minimum(distance, 1.0) ** place[3]) ** 2


class SpotFound(NamedTuple):
    """A significant spot: T, the number of the camera or arm, and (x, y, R in degrees, m)."""

    strength: float
    unit: int
    place: Place


class Spots:
    """Places in the field where the stars of a list would show a spot."""

    def __init__(self, stars: StarResiduals, edge: float) -> None:
        self.edge = edge
        self.x, self.y = x, y = stars.x[stars.first], stars.y[stars.first]
        tree, blocks, places = spatial.KDTree(np.column_stack([x, y])), [], []
        for radius in (share * edge for share in RADII):
            axis = np.arange(-edge, edge + 0.25 * radius, 0.5 * radius)
            centres = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
            near = spatial.KDTree(centres).sparse_distance_matrix(tree, radius, output_type="coo_matrix")
            value = np.clip(1.0 - (near.data / radius) ** 2, 0.0, None) ** 2
            shape = sparse.csr_array((value, (near.row, near.col)), shape=(len(centres), len(x)))
            enough = np.diff(shape.indptr) >= FEW
            blocks.append(shape[np.flatnonzero(enough)])
            places += [(float(a), float(b), radius, EDGES[0]) for a, b in centres[enough]]
        self.places: list[Place] = places
        self.shape = sparse.csr_array(sparse.vstack(blocks))
        self.square, self.within = (self.shape.copy() for _ in range(2))
        self.square.data = self.shape.data**2
        self.within.data = np.ones(self.shape.nnz)

    def __len__(self) -> int:
        return len(self.places)

    def strongest(self, z: Float[np.ndarray, "s k"]) -> SpotFound | None:
        """The place of the largest T; `z` is 0 for stars that do not see a camera. None where stars are too few."""
        measured = (z != 0).astype(float)
        enough = self.within @ measured >= FEW
        heavy = np.sqrt(np.maximum(self.square @ measured, 1e-300))
        strength = np.where(enough, np.abs(self.shape @ np.clip(z, -CLIPPED, CLIPPED)) / heavy, 0.0)
        if not strength.any():
            return None
        place, unit = np.unravel_index(strength.argmax(), strength.shape)
        return SpotFound(float(strength[place, unit]), int(unit), self.places[int(place)])

    def refined(
        self, spot: SpotFound, z: Float[np.ndarray, " s"], root: Float[np.ndarray, " s"]
    ) -> tuple[Place, Bool[np.ndarray, " s"]]:
        """The place near which a spot fits best, and the stars that it describes; `root` is 1/σ of each star's gain."""
        near = np.flatnonzero(
            (profile(self.x, self.y, (*spot.place[:2], 3.0 * spot.place[2], 2.0)) > 0) & (z != 0)
        )
        x, y, z, root = self.x[near], self.y[near], z[near], root[near]
        inside = profile(x, y, spot.place) > 0.1
        start = float(np.median(z[inside] / root[inside])) if inside.any() else 0.0
        unit = spot.place[2]

        def off(values: Float[np.ndarray, " v"], edge: float) -> Float[np.ndarray, " s"]:
            place = (unit * values[0], unit * values[1], unit * abs(values[2]), edge)
            return (z - start * values[3] * root * profile(x, y, place)) ** 2

        widest = WIDEST * self.edge / unit

        def cost(values: Float[np.ndarray, " v"], edge: float) -> float:
            if abs(values[2]) > widest or np.abs(values[:2] * unit).max() > self.edge:
                return NO_SPOT  # what covers the field
            return float(np.minimum(off(values, edge), CLIPPED**2).sum())

        begin = [spot.place[0] / unit, spot.place[1] / unit]
        ways = [
            (optimize.minimize(cost, [*begin, wide, 1.2], (edge,), method="Nelder-Mead"), edge)
            for edge in EDGES
            for wide in (0.7, 1.0, 1.4)
        ]
        best, edge = min(ways, key=lambda way: way[0].fun)
        place = (unit * float(best.x[0]), unit * float(best.x[1]), unit * abs(float(best.x[2])), edge)
        described = np.zeros(len(self.x), bool)
        described[near] = (off(best.x, edge) < CLIPPED**2) & (profile(x, y, place) > 0)
        return place, described


def of_stars(
    stars: StarResiduals,
    group: Int[np.ndarray, " r"],
    members: Float[np.ndarray, "k c"],
    residual: Float[np.ndarray, "r k"],
    weights: Weights,
) -> Iterator[tuple[Float[np.ndarray, "s c"], Float[np.ndarray, "s c"]]]:
    """For every exposure group the gain of cameras from it on, by each star alone, in standard errors; and 1/σ of it.

    Both are 0 where a star does not see it. `members` are 1 for the cameras that are taken together.
    """
    columns: list[list[np.ndarray]] = [[], [], [], []]
    for numbers, rows, subset in stars.blocks():
        inverse = weights.inverse[numbers]
        heavy = np.sqrt(inverse * weights.share[numbers])[subset.star, None]
        free, _ = subset.projected(subset.model[..., None] * members)
        half = np.linalg.cholesky(subset.photon).swapaxes(1, 2)[subset.star]
        along = half @ np.einsum("rik,ark->ria", subset.tangent, free, optimize=True)
        columns[0].append((subset.model * residual[rows]) @ members * inverse[subset.star, None])
        columns[1].append(np.sum(free**2, axis=-1).T * heavy**2)
        columns[2].append(along * heavy[..., None])
        columns[3].append(subset.model**2 @ members * heavy**2)
    score, single, along, full = map(np.concatenate, columns)
    for start in range(int(group.max()) + 1):
        on = (group >= start).astype(float)[:, None]
        pull, information, largest = (np.add.reduceat(on * v, stars.first) for v in (score, single, full))
        information -= np.sum(np.add.reduceat(on[..., None] * along, stars.first) ** 2, axis=1)
        informed = information > ROUNDING * largest
        root = np.sqrt(np.where(informed, information, 1.0))
        yield np.where(informed, pull / root, 0.0), np.where(informed, root, 0.0)
