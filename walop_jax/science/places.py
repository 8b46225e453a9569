"""Places of the field where stars disagree with a calibration together: dust on a camera, a ghost, a blemish.

A camera that is brighter by the share β g, g = exp(−d²/2s²) at distance d from a centre, leaves (`star_residuals`)

    r = β g P c + noise,    c the counts of the model in that camera

Of every star and camera  z = cᵀr / √(v₀ cᵀPc)  is normal with unit variance, v₀ that of its residuals, and
α = √(cᵀPc / v₀) says how well it sees the camera. At every star as a centre, for every size s and camera

    Z = Σ w ψ(z) / √(v Σ w²),    w = α g or w = g

ψ cuts z at ±`CUT`, v = max(1, mean ψ²) of the catalogue: no star has more influence than `CUT`, so that four are
needed, and stars that are off alone, however far, make no place. Z is normal, or has shorter tails; Bonferroni's bound
over centres, sizes, cameras and weights keeps false alarms below `ALARM` a catalogue. A matched filter with a bounded
score: Huber 1981, Robust Statistics, chapter 4.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage, optimize

from walop_jax.io.text import some, with_error
from walop_jax.science.instrument_changes import ALARM, RIVAL, chance_of
from walop_jax.science.star_residuals import StarResiduals, own_variance

CUT = 3.0
SIZES = (1 / 32, 1 / 16, 1 / 8, 1 / 4)
"""Sizes s that are looked for, as shares of the largest |X|, |Y| of the stars: 0.009 to 0.07° of a WALOP."""
_CELLS = 3  # in a size, along a side
_REACH = 3.0  # sizes: beyond, nothing is left of a place
_TOGETHER = 1 / 64  # of the largest |X|, |Y|: rows of a star that lie closer are one
_BLIND = 1e-3  # cᵀPc over cᵀc below which a star does not see a camera
_MOST = 8  # places
_WIDER = 2.0  # than the size that was looked for a place may be, and so far off its centre


class CameraAtPlace(NamedTuple):
    """A camera that may have changed at a place: by what share of its counts in the centre, with standard error."""

    camera: int
    name: str
    size: float
    error: float


@dataclasses.dataclass(frozen=True)
class DisagreeingPlace:
    """A place where stars disagree: centre and size (deg), significance, stars, cameras that it may be (best first)."""

    x: float
    y: float
    size: float
    sigma: float
    stars: int
    alike: tuple[CameraAtPlace, ...]

    def profile(self, x: Float[np.ndarray, " r"], y: Float[np.ndarray, " r"]) -> Float[np.ndarray, " r"]:
        """g at field positions: 1 in the centre, 0 beyond three sizes."""
        far = ((x - self.x) ** 2 + (y - self.y) ** 2) / self.size**2
        return np.where(far < _REACH**2, np.exp(-0.5 * far), 0.0)

    def words(self) -> str:
        """The place in a sentence."""
        details = [
            f"{c.name} {('brighter', 'fainter')[c.size < 0]} by {with_error(100 * abs(c.size), 100 * c.error)} %"
            for c in self.alike
        ]
        return (
            f"{self.stars} stars near X {self.x:+.3f}°, Y {self.y:+.3f}° (within {2 * self.size:.2g}°) disagree with "
            f"the calibration together, {abs(self.sigma):.0f} σ: {some(details, 4, ' or ')} in the centre. Is there "
            "dust, a ghost, a bright neighbour? Their errors were enlarged"
        )

    def document(self) -> dict[str, Any]:
        """The place as plain data."""
        about = dataclasses.asdict(self)
        return about | {"alike": [camera._asdict() for camera in self.alike]}


class _Seen(NamedTuple):
    """Stars at places: positions, z and α of every camera; χ² and its degrees of freedom."""

    x: Float[np.ndarray, " s"]
    y: Float[np.ndarray, " s"]
    z: Float[np.ndarray, "s k"]
    alpha: Float[np.ndarray, "s k"]
    chi2: Float[np.ndarray, " s"]
    dof: Float[np.ndarray, " s"]


def places_of(
    stars: StarResiduals,
    cameras: Sequence[str],
    residual: Float[np.ndarray, "r k"] | None = None,
    variance: Float[np.ndarray, " s"] | None = None,
    alarm: float = ALARM,
) -> tuple[DisagreeingPlace, ...]:
    """Places of the field where stars disagree together, the most significant first; none in `alarm` of catalogues.

    `cameras` are names. `residual` is that of `stars`, with or without changes, `variance` that of the
    residuals of every star over that of its noise (None: `own_variance`).
    """
    stars_seen = _seen(
        stars,
        stars.residual if residual is None else residual,
        own_variance(stars) if variance is None else variance,
    )
    extent = max(float(np.abs([stars_seen.x, stars_seen.y]).max(initial=0.0)), 1e-9)
    places: list[DisagreeingPlace] = []
    remaining = np.ones(len(stars_seen.x), bool)
    while len(places) < _MOST and remaining.sum() > 1:
        subset = _Seen(*(values[remaining] for values in stars_seen))
        centre, sigma, trials = _strongest(subset, extent)
        if trials * chance_of(sigma) >= alarm:
            break
        place = _described(subset, centre, sigma, cameras)
        places.append(place)
        remaining &= place.profile(stars_seen.x, stars_seen.y) == 0.0
    return tuple(places)


def _seen(
    stars: StarResiduals, residual: Float[np.ndarray, "r k"], variance: Float[np.ndarray, " s"]
) -> _Seen:
    """z and α of the stars; rows of one star at different places are stars of their own."""
    columns = []
    extent = max(float(np.abs([stars.x, stars.y]).max(initial=0.0)), 1e-9)
    cell = np.round(np.stack([stars.x, stars.y], axis=1) / (_TOGETHER * extent)).astype(int)
    for numbers, rows, subset in stars.blocks():
        key = np.concatenate([subset.star[:, None], cell[rows]], axis=1)
        _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
        group = group.reshape(-1)
        cameras = subset.model.shape[1]
        free, _ = subset.projected(subset.model[:, :, None] * np.eye(cameras))
        along = np.einsum("rik,crk->ric", subset.tangent, free, optimize=True)

        def summed(
            values: np.ndarray, group: Int[np.ndarray, " r"] = group, first: Any = first
        ) -> np.ndarray:
            total = np.zeros((len(first), *values.shape[1:]))
            np.add.at(total, group, values)
            return total

        score = summed(np.einsum("crk,rk->rc", free, residual[rows]))
        square, projected = summed(np.einsum("crk,crk->rc", free, free)), summed(along)
        of_star = subset.star[first]
        chi2 = square - np.einsum(
            "sic,sij,sjc->sc", projected, subset.photon[of_star], projected, optimize=True
        )
        sees = chi2 > _BLIND * summed(subset.model**2)
        spread = variance[numbers][of_star][:, None]
        root = np.sqrt(np.where(sees, chi2, 1.0) * spread)
        columns.append(
            _Seen(
                subset.x[first],
                subset.y[first],
                np.where(sees, score / root, 0.0),
                np.where(sees, root / spread, 0.0),
                summed(np.sum(residual[rows] ** 2, axis=1)) / spread[:, 0],
                np.maximum(subset.dof[of_star] / np.bincount(of_star)[of_star], 0.5),
            )
        )
    return _Seen(*(np.concatenate(values) for values in zip(*columns, strict=True)))


def _strongest(seen: _Seen, extent: float) -> tuple[tuple[float, float, float], float, int]:
    """Centre and size (deg) of the largest |Z|, with its sign, and the number of trials."""
    centre, strongest, trials = (0.0, 0.0, 0.0), 0.0, 0
    cut = np.clip(seen.z, -CUT, CUT)
    sees = (seen.alpha > 0).astype(float)
    variance = max(1.0, float(np.sum(cut**2) / max(sees.sum(), 1.0)))
    for share in SIZES:
        size = share * extent
        cell = size / _CELLS
        place = np.floor(np.stack([seen.x, seen.y]) / cell).astype(int)
        place -= place.min(axis=1, keepdims=True)
        shape = tuple(int(n) + 1 for n in place.max(axis=1))
        index = np.asarray(np.ravel_multi_index(tuple(place), shape))
        occupied = np.unique(index)
        for k in range(seen.z.shape[1]):
            for weight in (seen.alpha[:, k], sees[:, k]):
                top = _smoothed(index, weight * cut[:, k], shape, 1)[occupied]
                bottom = _smoothed(index, weight**2, shape, 2)[occupied]
                z = top / np.sqrt(variance * np.where(bottom > 0, bottom, np.inf))
                best = int(np.argmax(np.abs(z)))
                if abs(z[best]) > abs(strongest):
                    inside = index == occupied[best]
                    middle = seen.x[inside].mean(), seen.y[inside].mean()
                    centre, strongest = (float(middle[0]), float(middle[1]), size), float(z[best])
                trials += len(occupied)
    return centre, strongest, trials


def _smoothed(
    index: Int[np.ndarray, " s"], values: Float[np.ndarray, " s"], shape: tuple[int, ...], power: int
) -> Float[np.ndarray, " c"]:
    """Sums of values over cells with the weights g (`power` 1) or g² (2)."""
    steps = np.arange(-_CELLS * int(_REACH), _CELLS * int(_REACH) + 1) / _CELLS
    kernel = np.exp(-0.5 * power * steps**2)
    sums = np.bincount(index, values, minlength=int(np.prod(shape))).reshape(shape)
    for axis in (0, 1):
        sums = ndimage.correlate1d(sums, kernel, axis=axis, mode="constant")
    return sums.ravel()


def _described(
    seen: _Seen, centre: tuple[float, float, float], sigma: float, cameras: Sequence[str]
) -> DisagreeingPlace:
    """The place about a centre, with the cameras that describe its stars as well as the best one."""
    near = (
        DisagreeingPlace(centre[0], centre[1], _WIDER * centre[2], sigma, 0, ()).profile(seen.x, seen.y) > 0
    )
    subset = _Seen(*(values[near] for values in seen))
    fits = []
    for k, name in enumerate(cameras):
        x, y, size = _fitted(subset, k, centre)
        place = DisagreeingPlace(x, y, size, sigma, 0, ())
        share, error, gain = _share(subset, k, place.profile(subset.x, subset.y))
        fits.append((gain, place, CameraAtPlace(k, name, share, error)))
    fits.sort(key=lambda fit: -fit[0])
    best, place = fits[0][0], fits[0][1]
    scatter = (subset.chi2.sum() - best) / max(subset.dof.sum() - 4.0, 1.0)
    alike = [camera for gain, _, camera in fits if gain > best - RIVAL * max(1.0, scatter)]
    g = place.profile(subset.x, subset.y)
    return dataclasses.replace(place, stars=int((g > np.exp(-2.0)).sum()), alike=tuple(alike))


def _fitted(seen: _Seen, camera: int, centre: tuple[float, float, float]) -> tuple[float, float, float]:
    """Centre and size of the place that describes the stars best by one camera, near those that were looked for."""
    x, y, size = centre

    def place(moved: Float[np.ndarray, " 3"]) -> tuple[float, float, float]:
        return x + size * moved[0], y + size * moved[1], size * float(np.exp(moved[2]))

    def misfit(moved: Float[np.ndarray, " 3"]) -> float:
        g = DisagreeingPlace(*place(moved), 0.0, 0, ()).profile(seen.x, seen.y)
        return float(moved @ moved) - _share(seen, camera, g)[2]

    bounds = [(-_WIDER, _WIDER)] * 2 + [(-1.0, np.log(_WIDER))]
    first = np.vstack([np.zeros(3), 0.5 * np.eye(3)])
    options = {"maxiter": 200, "xatol": 0.01, "fatol": 0.1, "initial_simplex": first}
    solution = optimize.minimize(misfit, np.zeros(3), method="Nelder-Mead", bounds=bounds, options=options)
    return place(solution.x)


def _share(seen: _Seen, camera: int, g: Float[np.ndarray, " s"]) -> tuple[float, float, float]:
    """β of a camera, its standard error, and by how much it makes χ² smaller."""
    shape = seen.alpha[:, camera] * g
    square, score = float(shape @ shape), float(shape @ seen.z[:, camera])
    return (score / square, square**-0.5, score**2 / square) if square > 0 else (0.0, np.inf, 0.0)
