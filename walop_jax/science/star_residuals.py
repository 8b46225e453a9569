"""Residuals of stars once their flux and (q, u) are fitted: they watch a calibration.

A row of four cameras has three unknowns, so one number of it is left, whose expectation is 0. For the rows of a star,

    r = y − m,    y = N/σ,    m = F a·s/σ,    P = 1 − (flux of every row) − T H Tᵀ

with T the derivative of m to (q, u) behind the flux and H the covariance of (q, u): r = P r has covariance P. A change
of counts of shape c (over σ) and size β leaves P c β.

Normal matrix   Q = Σ w κ cᵀ P c,  score  g = Σ w cᵀ r over the stars that are kept; both of any list of columns. A
                camera's gain has the column m in that camera. The sum over all cameras is flux: P c = 0.
Calibration     Its errors θ, of covariance C, are columns like others, with the prior θᵀ C⁻¹ θ: errors of the
                calibration raise no alarm (`eliminated`).
Trimmed         Stars of χ² > q, with P(χ²_ν > q) = `TRIMMED`, are not used. For a normal distribution cut at a radius
                covariance and response are both smaller by κ = P(χ²_{ν+2} < q) (about 0.99), so that estimates are
                unbiased and errors known; what lies far off, however far, has no influence.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import special

from walop_jax.io.shapes import ColumnProducts, OfStars
from walop_jax.likelihood.flux import FluxGroups, project_flux
from walop_jax.likelihood.inverses import whitening
from walop_jax.likelihood.optics import through_series
from walop_jax.science.field_points import ANOTHER_PLACE

CHECKED_ROWS = 2048
"""Rows whose columns for the check of a catalogue are worked on together: a hundred columns of them take 7 MB."""

TRIMMED = 1e-3
CROWDED = 1.5
"""Variance over that of the noise from which scatter says nothing of N_ERR: most of it is structure, or colours."""
NO_NOISE = 1e-4  # χ² per degree of freedom below which counts hold no noise: computed, not measured
_ROUNDS = 50
FEW = 4  # stars, or degrees of freedom: of fewer a single star may be the scale
ABOUT_GAINS = 2
"""Rounds in which the scale of stars is found about the gains that fit them best, and these with that scale."""
SINGULAR = 1e-10
"""Share of the largest eigenvalue below which stars do not measure a direction of the fitted numbers."""
ROUNDING = 1e-12
"""Share of its square that a column must have once flux, q and u are fitted: less is rounding, of either sign."""
Residuals = Float[np.ndarray, "r k"]  # a number for each row and camera


_OF_ALL = ("together", "structure")  # fields that all stars have in common


@dataclasses.dataclass(frozen=True)
class StarResiduals:
    """Rows of stars for tests of changes; rows of a star follow each other, numbered from 0.

    `residual`, `model` and `tangent` (derivatives of the model to q, u, flux projected) are over σ, and 0 where a
    camera is not used; `root` is 1/σ. `photon` is the covariance H of a star's (q, u). `x`, `y`
    in degrees, `time` in days (NaN: not known). `plain` and `throughput` are derivatives of the model over σ to
    parameters and to the throughputs of the cameras, `basis` the terms of their series at the row; `colour` the changes
    of the model for stars without TEFF: mean and standard deviation of their colours. `together` is 1 where two
    cameras share a flux (None: all do); `structure` is the rms gain of a camera at a field point.
    """

    star: Int[np.ndarray, " r"]
    residual: Residuals
    model: Residuals
    tangent: Float[np.ndarray, "r 2 k"]
    photon: Float[np.ndarray, "s 2 2"]
    root: Residuals
    x: Float[np.ndarray, " r"]
    y: Float[np.ndarray, " r"]
    time: Float[np.ndarray, " r"]
    plain: Float[np.ndarray, "r k o"]
    throughput: Float[np.ndarray, "r k k"]
    basis: Float[np.ndarray, "r t"]
    colour: Float[np.ndarray, "r k 2"]
    together: Float[np.ndarray, "k k"] | None = None
    structure: float = 0.0

    @classmethod
    def joined(cls, parts: list[StarResiduals]) -> StarResiduals:
        """Several lists of stars as one."""
        names = [f.name for f in dataclasses.fields(cls) if f.name not in ("star", *_OF_ALL)]
        values = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
        first = np.cumsum([0, *(len(p.photon) for p in parts[:-1])])
        star = np.concatenate([p.star + start for p, start in zip(parts, first, strict=True)])
        return dataclasses.replace(parts[0], star=star, **values)

    def __len__(self) -> int:
        return len(self.star)

    @property
    def first(self) -> Int[np.ndarray, " s"]:
        """The first row of every star."""
        return np.flatnonzero(np.diff(self.star, prepend=-1))

    @property
    def rows(self) -> Int[np.ndarray, " s"]:
        """Rows of every star in which a camera is used."""
        return np.add.reduceat((self.root > 0).any(axis=1).astype(int), self.first)

    @property
    def dof(self) -> Int[np.ndarray, " s"]:
        """Degrees of freedom of every star: cameras used, less the fluxes and q, u."""
        used = self.root > 0
        arms = np.ones((1, used.shape[1])) if self.together is None else np.unique(self.together, axis=0)
        fluxes = ((used @ (arms > 0).T) > 0).sum(axis=1)
        return np.add.reduceat(used.sum(axis=1) - fluxes, self.first) - 2

    def chi2(self, residual: Residuals) -> OfStars:
        """χ² of every star: the sum of its squared residuals."""
        return np.add.reduceat(np.sum(residual**2, axis=1), self.first)

    def part(self, stars: slice) -> StarResiduals:
        """Some of the stars, a slice of them."""
        first = np.append(self.first, len(self))
        start, stop, _ = stars.indices(len(first) - 1)
        rows = slice(first[start], first[stop])
        cut = {name: values[rows] for name, values in vars(self).items() if name not in _OF_ALL}
        cut |= {"star": self.star[rows] - start, "photon": self.photon[stars]}
        return dataclasses.replace(self, **cut)

    def blocks(self) -> Iterator[tuple[slice, slice, StarResiduals]]:
        """Slices of stars and of rows, some `CHECKED_ROWS` of these, each with its part."""
        first = self.first
        cuts = np.searchsorted(first, np.arange(0, len(self), CHECKED_ROWS))
        for start, stop in zip(cuts, [*cuts[1:], len(first)], strict=True):
            if stop > start:
                stars = slice(int(start), int(stop))
                subset = self.part(stars)
                yield stars, slice(first[start], first[start] + len(subset)), subset

    def parameters(self) -> Float[np.ndarray, "r k n"]:
        """Derivatives of the model over σ to all parameters: plain ones, then the throughput series."""
        series = through_series(self.throughput[:, :, None], self.basis[:, None, None])
        return np.concatenate([self.plain, series], axis=-1)

    def projected(
        self, columns: Float[np.ndarray, "r k c"]
    ) -> tuple[Float[np.ndarray, "c r k"], Float[np.ndarray, "s 2 c"]]:
        """Columns without flux, and their products Tᵀ c with what q and u of a star do."""
        free = project_flux(np.moveaxis(columns, -1, 0), self.model, False, FluxGroups(self.together))
        along = np.einsum("rik,crk->ric", self.tangent, free, optimize=True)
        return free, np.add.reduceat(along, self.first)

    def left(self, change: Residuals) -> Residuals:
        """P c of one change of the counts over σ."""
        free, moved = self._without_flux(change)
        taken = np.einsum("rik,ri->rk", self.tangent, moved[self.star])
        return np.where(self.root > 0, free - taken, 0.0)

    def shift(self, change: Residuals) -> Float[np.ndarray, "s 2"]:
        """H Tᵀ c: by how much one change of the counts over σ moves (q, u) of every star."""
        return self._without_flux(change)[1]

    def _without_flux(self, change: Residuals) -> tuple[Residuals, Float[np.ndarray, "s 2"]]:
        free, along = self.projected(change[..., None])
        return free[0], np.einsum("sij,sj->si", self.photon, along[..., 0])

    def behind(self, residual: Residuals, change: Callable[[StarResiduals, slice], Residuals]) -> Residuals:
        """Residuals behind a change of the counts over σ, which `change` gives for some stars and their rows."""
        remaining = (residual[rows] - part.left(change(part, rows)) for _, rows, part in self.blocks())
        return np.concatenate(list(remaining))


def own_variance(stars: StarResiduals) -> OfStars:
    """Variance of residuals over that of noise: unknown colours and structure of the field add to it."""
    spread, most = np.zeros(len(stars.photon)), stars.model.shape[1] - 1
    for n in range(stars.colour.shape[-1] if stars.colour.any() else 0):
        spread += stars.chi2(stars.left(stars.colour[..., n]))
    if stars.structure > 0:
        of_gains, places = _of_gains(stars)
        spread, most = spread + stars.structure**2 * of_gains, most * places
    # Gains of the cameras make fewer independent residuals than a star of several rows has.
    return 1.0 + spread / np.clip(stars.dof, 1, most)


def _of_gains(stars: StarResiduals) -> tuple[OfStars, Int[np.ndarray, " s"]]:
    """Sum of cᵀ P c of every star over the gains of its cameras, one at each of its places; how many places it has."""
    spread, number = np.zeros(len(stars.photon)), np.zeros(len(stars.photon), int)
    for numbers, _, part in stars.blocks():
        free, _ = part.projected(part.model[..., None] * np.eye(part.model.shape[1]))
        half = np.linalg.cholesky(part.photon).swapaxes(1, 2)[part.star]
        place, of_place = by_place(part.star, part.x, part.y)
        along = np.zeros((len(of_place), 2, len(free)))
        np.add.at(along, place, half @ np.einsum("rik,crk->ric", part.tangent, free, optimize=True))
        taken = np.bincount(of_place, np.sum(along**2, axis=(1, 2)))
        spread[numbers] = np.bincount(part.star, np.sum(free**2, axis=(0, 2))) - taken
        number[numbers] = np.bincount(of_place)
    return spread, number


def by_place(
    star: Int[np.ndarray, " r"], x: Float[np.ndarray, " r"], y: Float[np.ndarray, " r"]
) -> tuple[Int[np.ndarray, " r"], Int[np.ndarray, " p"]]:
    """The place of every row, counted over all stars, and the star of every place; rows of a star follow each other.

    Positions (deg) of a star are at one place that lie in one cell of `ANOTHER_PLACE`, its first row in the middle of
    such a cell.
    """
    position = np.stack([x, y], axis=1)
    from_first = position - position[np.flatnonzero(np.diff(star, prepend=-1))][star]
    key = np.column_stack([star, np.round(from_first / ANOTHER_PLACE)])
    places, place = np.unique(key, axis=0, return_inverse=True)
    return place.reshape(-1), places[:, 0].astype(int)


class StarWeights(NamedTuple):
    """Weights of stars: `inverse` is 1/variance of the residuals, 0 for those left out, `share` is κ."""

    inverse: OfStars
    share: OfStars


ColumnsOfStars = Callable[
    [StarResiduals, slice], Float[np.ndarray, "r k c"]
]  # columns of some stars and their rows


def normal_matrix(
    stars: StarResiduals, residual: Residuals, columns: ColumnsOfStars, weights: StarWeights
) -> tuple[ColumnProducts, Float[np.ndarray, " c"]]:
    """Q and g (head of this file) of columns; `residual` is that of `stars`, with or without changes."""
    matrix, score, diagonal = np.zeros((0, 0)), np.zeros(0), np.zeros(0)
    for numbers, rows, subset in stars.blocks():
        values = columns(subset, rows)
        free, along = subset.projected(values)
        count = len(free)
        if not score.size:
            matrix, score, diagonal = np.zeros((count, count)), np.zeros(count), np.zeros(count)
        w, k = weights.inverse[numbers], weights.share[numbers]
        scaled = np.sqrt(w * k)
        flat = (free * scaled[subset.star, None]).reshape(count, -1)
        half = np.linalg.cholesky(subset.photon).swapaxes(1, 2) @ along * scaled[:, None, None]
        projected = half.reshape(-1, count)
        matrix += flat @ flat.T - projected.T @ projected
        score += values.reshape(-1, count).T @ (residual[rows] * w[subset.star, None]).ravel()
        diagonal += np.einsum("rkc,r->c", values**2, scaled[subset.star] ** 2)
    rounding = np.diag(matrix) <= ROUNDING * diagonal
    matrix[rounding], matrix[:, rounding], score[rounding] = 0.0, 0.0, 0.0
    return matrix, score


def eliminated(
    matrix: ColumnProducts, score: Float[np.ndarray, " c"], kept: int
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
    """Q and g of the first `kept` columns with all others fitted (these have their priors in Q and g)."""
    if kept == len(matrix):
        return matrix, score
    root = whitening(matrix[kept:, kept:], SINGULAR)
    cross = matrix[:kept, kept:] @ root
    return matrix[:kept, :kept] - cross @ cross.T, score[:kept] - cross @ (root.T @ score[kept:])


# -------------------------------------------------------------------------------------------- noise, robustly


class Scale(NamedTuple):
    """s² = χ²/ν of the stars that are kept, with the degrees of freedom that its accuracy is worth (2/variance)."""

    value: float
    worth: float
    kept: Bool[np.ndarray, " s"]
    share: OfStars


def noise_scale(chi2: OfStars, dof: OfStars) -> Scale:
    """The factor by which χ² of stars exceeds its degrees of freedom, whatever a few of them do.

    From the median, then from all stars within the cut, until these stay the same. Stars without degrees of freedom
    are not kept.
    """
    values, of = np.unique(dof, return_inverse=True)
    values, usable = np.maximum(values, 1e-12), np.isfinite(chi2) & (dof > 0)
    cut = special.chdtri(values, TRIMMED)
    inside = special.chdtr(values + 2.0, cut)
    mean = values * inside / (1.0 - TRIMMED)
    if not usable.any():
        return Scale(1.0, 0.0, usable, inside[of])
    scale = float(np.median(chi2[usable] / special.chdtri(values, 0.5)[of][usable]))
    selected = usable
    for _ in range(_ROUNDS):
        selected = usable & (chi2 <= cut[of] * scale)
        before, scale = scale, float(chi2[selected].sum() / max(mean[of][selected].sum(), 1e-300))
        if scale <= 0 or abs(scale - before) < 1e-9 * before:
            break
    density = np.exp(
        special.xlogy(values / 2, cut) - cut / 2 - special.xlogy(values / 2, 2) - special.gammaln(values / 2)
    )
    slope = values * inside - density * (cut - mean)  # cut · probability density = `density`
    fourth = values * (values + 2.0) * special.chdtr(values + 4.0, cut)
    variance = fourth - 2.0 * mean * values * inside + mean**2 * (1.0 - TRIMMED)
    number = np.bincount(of[selected], minlength=len(values))
    worth = 2.0 * float(number @ slope) ** 2 / max(float(number @ variance), 1e-300)
    return Scale(scale, worth, selected, inside[of])


def beside_fitted(scale: Scale, dof: OfStars, fitted: float) -> Scale:
    """The scale of χ² from which some fitted numbers have taken their part: of the degrees of freedom that are left."""
    number = float(dof[scale.kept].sum())
    share = max(1.0 - fitted / max(number, 1.0), 0.0)
    return scale._replace(value=scale.value / max(share, 1e-12), worth=scale.worth * share)


def of_few(scale: Scale, sigma: float) -> float:
    """Factor on a variance that is known from few stars: an alarm at `sigma` is then that of Student's t."""
    return float(special.stdtrit(scale.worth, special.ndtr(-sigma)) / sigma) ** 2


def chance_of_scale(scale: Scale) -> float:
    """Probability, both sides, of a scale as far from 1 by noise alone."""
    if scale.worth < FEW:
        return 1.0
    value = scale.value * scale.worth
    return float(min(1.0, 2.0 * min(special.chdtr(scale.worth, value), special.chdtrc(scale.worth, value))))


def is_off(scale: Scale, alarm: float) -> bool:
    """True if a scale is not that of noise; counts without any noise are expected ones, whose errors stand."""
    return scale.value > NO_NOISE and chance_of_scale(scale) < alarm


def shared_by_rows(stars: StarResiduals, residual: Residuals, variance: OfStars) -> Scale | None:
    """The factor by which the common part of the rows of a star exceeds its expectation; None where all have one.

    T = Σ_k (Σ_j r_jk)² over cameras k and rows j has expectation tr I and variance 2 tr I², I the covariance of the
    sums: T · ν / tr I is near χ² with ν = (tr I)² / tr I² degrees of freedom (Satterthwaite 1946).
    """
    several = stars.rows > 1
    if not several.any():
        return None
    value, dof = np.full(len(several), np.nan), np.zeros(len(several))
    for numbers, rows, subset in stars.blocks():
        cameras = subset.model.shape[1]
        same = np.eye(cameras) * (subset.root > 0)[:, :, None]
        free, along = subset.projected(same)
        products = np.einsum("arc,brc->rab", free, free, optimize=True)
        remaining = np.add.reduceat(products, subset.first) - np.einsum(
            "sia,sij,sjb->sab", along, subset.photon, along, optimize=True
        )
        total = np.add.reduceat(residual[rows], subset.first)
        trace, square = np.trace(remaining, axis1=1, axis2=2), np.sum(remaining**2, axis=(1, 2))
        good = several[numbers] & (trace > 1e-9 * subset.rows)
        safe = np.where(good, square, 1.0)
        dof[numbers] = np.where(good, trace**2 / safe, 0.0)
        value[numbers] = np.where(good, np.sum(total**2, axis=1) * trace / safe / variance[numbers], np.nan)
    return noise_scale(value, np.round(dof, 2))
