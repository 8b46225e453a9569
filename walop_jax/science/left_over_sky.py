"""Polarised light of the sky that is left in the counts of stars: it is in no sum of cameras, but grows as 1/flux.

Equation    (q, u) of a star = m + c log₁₀ L + b S/L + its own; L its light, S the sky under it (electron, all cameras)
Symbols     b polarised light left over per unit of the sky's level, in the frame of (q, u); m, c what stars have in
            common: interstellar polarisation grows with distance, hence with faintness, but never as 1/flux
Method      weighted least squares for q and u; stars differ by a scatter of their own, such that χ² is its degrees of
            freedom (Paule & Mandel 1982, J. Res. NBS 87, 377); the larger of the errors from the weights and from
            the residuals (White 1980, Econometrica 48, 817); stars beyond `FAR` are left out
Limits      a sky of one polarisation in the whole catalogue; first order in S/L. Sky left over without polarisation
            lowers q and u by the same share of themselves, which nothing here shows.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from scipy import optimize

from walop_jax.fit.verdict import Quality
from walop_jax.io.text import with_error
from walop_jax.science.catalogue import Catalogue
from walop_jax.science.instrument_changes import MOST_LIKELY

if TYPE_CHECKING:
    from walop_jax.science.apply import Stars

CHANCE = 1e-5  # probability that noise finds something in a sound catalogue
FEWEST = 50  # stars
MOST = 20_000  # that are looked at
FAR = 5.0  # standard deviations
_ROUNDS = 4


Vector = Float[np.ndarray, " s"]  # a number for each star


@dataclasses.dataclass(frozen=True)
class LeftOverSky:
    """Polarised light of the sky left over, `share` (q, u) of its level, with `errors`, from so many `stars`."""

    share: Float[np.ndarray, " 2"]
    errors: Float[np.ndarray, " 2"]
    stars: int

    @property
    def p_value(self) -> float:
        """Chance of a share as large without any."""
        return float(np.exp(-0.5 * np.sum((self.share / self.errors) ** 2)))

    @property
    def found(self) -> bool:
        """True if there is some."""
        return self.p_value < CHANCE

    @property
    def bound(self) -> float:
        """The share that is not exceeded with a probability of 99 %."""
        return float(np.hypot(*self.share) + MOST_LIKELY * self.errors.max())

    def covariance(self, ratio: Vector) -> Float[np.ndarray, "s 2 2"]:
        """Covariance of its shift of stars with a `ratio` of sky to light, 0 where none was found."""
        of_share = np.outer(self.share, self.share) + np.diag(self.errors**2)
        return np.where(self.found, ratio**2, 0.0)[:, None, None] * of_share

    def words(self) -> str:
        """The finding in a sentence."""
        size = with_error(100 * float(np.hypot(*self.share)), 100 * float(self.errors.mean()))
        angle = np.rad2deg(0.5 * np.arctan2(self.share[1], self.share[0])) % 180.0
        return (
            f"polarised light of the sky is left in the stars: {size} % of the level in SKY at {angle:.0f}°, as q and "
            "u grow with SKY over N. Its shift is in the errors; subtract the sky anew"
        )

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        document = {**dict(zip("qu", self.share.tolist(), strict=True)), "errors": self.errors.tolist()}
        return document | {n: getattr(self, n) for n in ("p_value", "found", "bound", "stars")}


def left_over_sky(
    qu: Float[np.ndarray, "s 2"], photon: Float[np.ndarray, "s 2 2"], light: Vector, ratio: Vector
) -> LeftOverSky | None:
    """The sky left in stars of such light (electron) and sky over light; None of few stars, or of one ratio."""
    good = np.isfinite(qu).all(axis=1) & np.isfinite(photon).all(axis=(1, 2))
    chosen = np.flatnonzero(good & (light > 0) & np.isfinite(ratio) & (ratio >= 0))
    chosen = chosen[np.mod(np.arange(len(chosen)) * 0.6180339887498949, 1.0) < MOST / max(len(chosen), 1)]
    if len(chosen) < FEWEST or np.ptp(ratio[chosen]) <= 0:
        return None
    columns = np.stack([np.ones(len(chosen)), np.log10(light[chosen]), ratio[chosen]], axis=1)
    columns[:, 1] -= columns[:, 1].mean()
    slopes = [_slope(columns, qu[chosen, k], photon[chosen, k, k]) for k in range(2)]
    share, errors = np.array(slopes).T
    measured = np.isfinite(slopes).all() and (errors > 0).all()
    return LeftOverSky(share, errors, len(chosen)) if measured else None


def _slope(columns: Float[np.ndarray, "s 3"], values: Vector, variance: Vector) -> tuple[float, float]:
    """Coefficient of the last column, and its error."""
    scatter, used = 0.0, np.ones(len(values), bool)
    beta, inverse, residual = np.zeros(3), np.eye(3), values
    for rounds_left in reversed(range(_ROUNDS + 1)):
        weight = np.where(used, 1.0 / (variance + scatter), 0.0)
        inverse = np.linalg.pinv(columns.T @ (weight[:, None] * columns), hermitian=True)
        beta = inverse @ (columns.T @ (weight * values))
        residual = values - columns @ beta
        if rounds_left:
            scatter = _scatter(residual[used], variance[used])
            used = np.abs(residual) < FAR * np.sqrt(variance + scatter)
    pull = np.where(used, residual / (variance + scatter), 0.0)[:, None] * columns
    robust = inverse @ (pull.T @ pull) @ inverse
    return float(beta[2]), float(np.sqrt(max(inverse[2, 2], robust[2, 2])))


def _scatter(left: Vector, variance: Vector) -> float:
    """Variance beyond the stated one for which χ² of residuals is their number less three."""

    def excess(scatter: float) -> float:
        return float(np.sum(left**2 / (variance + scatter))) - (len(left) - 3.0)

    # Where the scatter is the mean square of all residuals, χ² is below their number, but not less than three below.
    highest = 2.0 * float(np.mean(left**2))
    return float(optimize.brentq(excess, 0.0, highest)) if excess(0.0) > 0 else 0.0  # pyright: ignore[reportArgumentType]


def with_sky(stars: Stars, catalogue: Catalogue) -> Stars:
    """The stars with errors and bounds of the sky left in them, where the catalogue states its level."""
    if catalogue.sky is None:
        return stars
    stated = np.isfinite(catalogue.counts) & np.isfinite(catalogue.sky)
    sums = (np.where(stated, values, 0.0).sum(axis=1) for values in (catalogue.counts, catalogue.sky))
    light, level = (np.bincount(catalogue.star, values) for values in sums)
    ratio = np.where(light > 0, level / np.where(light > 0, light, 1.0), np.nan)
    leftover = left_over_sky(stars.qu, stars.photon, light, ratio)
    if leftover is None:
        return stars
    changed = stars.changed + np.nan_to_num(leftover.covariance(ratio))
    flag = stars.flag | (Quality.CATALOGUE if leftover.found else 0)
    check, bound = dataclasses.replace(stars.check, sky=leftover), leftover.bound * ratio
    return dataclasses.replace(stars, changed=changed, flag=flag, check=check, sky_bound=bound)
