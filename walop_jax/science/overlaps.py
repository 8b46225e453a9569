"""Stars seen at several places of the field: their q and u there are the same, unless an error depends on the place.

    χ² = Σ dᵀ W d      W = (C_photon + k C_other)⁻¹,  d = (q, u) of a row less the mean of its star, weighted by W

C_other is all else that Q_ERR holds: calibration, colours, changes that the catalogue shows. Such errors are common to
all stars and have k = `COMMON`, so that they raise no alarm by themselves. The sum of the cameras has no part in χ², so
that it sees errors that no other check of a catalogue does.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy import special

from walop_jax.calibration.calibration import Calibration
from walop_jax.science.apply import STAR_SAMPLE, apply
from walop_jax.science.catalogue import Catalogue
from walop_jax.science.star_columns import ALARM

APART = 0.02  # deg: rows of a star that lie farther apart than that are at two places
COMMON = float(special.chdtri(1, ALARM))  # square of a normal deviate that is exceeded with that probability
_OUTLIER = 1e-6  # of a row: left out


@dataclasses.dataclass(frozen=True)
class Overlap:
    """Comparison of rows of `stars` stars at several places; `excess` is the scatter of q or u beyond the errors."""

    stars: int
    chi2: float
    dof: int
    excess: float

    @property
    def differs(self) -> bool:
        """True if q and u depend on the place."""
        return self.dof > 0 and float(special.chdtrc(self.dof, self.chi2)) < ALARM

    def warnings(self) -> list[str]:
        """A sentence where they do."""
        if not self.differs:
            return []
        return [
            f"q and u of {self.stars} stars that are seen at places more than {APART:g} deg apart differ by "
            f"{100.0 * self.excess:.2g} % beyond their errors (χ²/dof {self.chi2 / self.dof:.2f}): an error depends on "
            "the place in the field, and is not in Q_ERR"
        ]


def extents(catalogue: Catalogue) -> Float[np.ndarray, " s"]:
    """The largest distance in X or Y (deg) between the rows of every star."""
    x, y = catalogue.points.x, catalogue.points.y
    ends = np.full((4, catalogue.star.max() + 1), -np.inf)
    for end, values in zip(ends, (x, -x, y, -y), strict=True):
        np.maximum.at(end, catalogue.star, values)
    return np.maximum(ends[0] + ends[1], ends[2] + ends[3])


def overlap(calibration: Calibration, catalogue: Catalogue, *, force: bool = False) -> Overlap | None:
    """Comparison of q and u of stars at several places, each row by itself; None where no star is seen so.

    None, too, where rows do not hold q and u, each by itself. Of more than `STAR_SAMPLE` rows the first are compared.
    Raises `DataError` as `apply` does.
    """
    chosen = (extents(catalogue) > APART)[catalogue.star]
    chosen &= catalogue.star < np.sort(catalogue.star[chosen])[:STAR_SAMPLE].max(initial=-1) + 1
    if not chosen.any() or not np.isfinite(catalogue.rotator[chosen]).any():
        return None
    subset = catalogue.of_rows(chosen)
    by_row = apply(calibration, dataclasses.replace(subset, star=np.arange(len(subset))), force=force)
    covariance = by_row.photon + COMMON * (by_row.covariance - by_row.photon)
    good = np.isfinite(by_row.qu).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    if not good.any():
        return None
    number, qu, covariance = subset.star[good], by_row.qu[good], covariance[good]
    weight = np.linalg.inv(covariance)

    def away(keep: Bool[np.ndarray, " r"]) -> Float[np.ndarray, "r 2"]:
        """(q, u) of rows less the means of the rows of their stars that are kept."""
        total, moment = np.zeros((number.max() + 1, 2, 2)), np.zeros((number.max() + 1, 2))
        np.add.at(total, number[keep], weight[keep])
        np.add.at(moment, number[keep], np.einsum("rij,rj->ri", weight[keep], qu[keep]))
        empty = ~np.any(total, axis=(1, 2))
        total[empty] = np.eye(2)
        return qu - np.linalg.solve(total, moment[..., None])[number, :, 0]

    all_rows = np.ones(len(qu), bool)
    keep = special.chdtrc(2, np.einsum("ri,rij,rj->r", away(all_rows), weight, away(all_rows))) > _OUTLIER
    difference = away(keep)[keep]
    count = np.bincount(number[keep])
    dof, stars = 2 * int(np.sum(count[count > 1] - 1)), int(np.sum(count > 1))
    if not dof:
        return None
    chi2 = float(np.einsum("ri,rij,rj->", difference, weight[keep], difference))
    typical = float(np.median(np.einsum("rii->r", covariance[keep]))) / 2.0
    return Overlap(stars, chi2, dof, float(np.sqrt(max(chi2 / dof - 1.0, 0.0) * typical)))
