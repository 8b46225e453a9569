"""Places of the field where stars disagree with a calibration together: dust on a camera, a ghost, a blemish.

A camera that is brighter by the share β g, g = exp(−d²/2s²) at distance d from a centre, leaves (`star_residuals`)

    r = β g P c + noise,    c the counts of the model in that camera

Of every star and camera  z = cᵀr / √(v₀ cᵀPc)  is normal with unit variance, v₀ that of its residuals, and
α = √(cᵀPc / v₀) says how well it sees the camera. At every star as a centre, for every size s and camera

    Z = Σ w ψ(z) / √(v Σ w²),    w = α g or w = g

ψ cuts z at ±`CUT`, v = max(1, mean ψ²) of the catalogue: no star has more influence than `CUT`, so that four are
needed, and stars that are off alone, however far, make no place. Z is normal, or has shorter tails; Bonferroni's bound
over centres, sizes, cameras and weights keeps false alarms below `ALARM` a catalogue. A matched filter with a bounded
score: Huber 1981, Robust Statistics, chapter 4. The watch of many nights looks for spots by the same, with the stars of
each group and of all that follow it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage, optimize

from walop_jax.io.text import some, with_error
from walop_jax.science import instrument_changes as alarms
from walop_jax.science.instrument_changes import Place, PossibleChange, profile
from walop_jax.science.star_residuals import Residuals, StarResiduals, own_variance

CUT = 3.0
SIZES = (1 / 32, 1 / 16, 1 / 8, 1 / 4)
"""Sizes s that are looked for, as shares of the largest |X|, |Y| of the stars: 0.009 to 0.07° of a WALOP."""
_CELLS = 3  # in a size, along a side
_TOGETHER = 1 / 64  # of the largest |X|, |Y|: rows of a star that lie closer are one
_BLIND = 1e-3  # cᵀPc over cᵀc below which a star does not see a camera
_MOST = 8  # places
_WIDER = 2.0  # than the size that was looked for a place may be, and so far off its centre


OfStars = Float[np.ndarray, " s"]


@dataclasses.dataclass(frozen=True)
class DisagreeingPlace:
    """A place where stars disagree: centre, size (deg), σ, stars, causes (best first): spots of these `cameras`."""

    x: float
    y: float
    size: float
    sigma: float
    stars: int
    alike: tuple[PossibleChange, ...]
    cameras: tuple[int, ...]

    def profile(self, x: Float[np.ndarray, " r"], y: Float[np.ndarray, " r"]) -> Float[np.ndarray, " r"]:
        """g at field positions: 1 in the centre, 0 beyond three sizes."""
        return profile(x, y, (self.x, self.y, self.size))

    def words(self) -> str:
        """The place in a sentence."""
        sizes = (with_error(100 * abs(c.size), 100 * c.error) for c in self.alike)
        words = (f"{c.name} {('brighter', 'fainter')[c.size < 0]}" for c in self.alike)
        details = [f"{word} by {size} %" for word, size in zip(words, sizes, strict=True)]
        return (
            f"{self.stars} stars near X {self.x:+.3f}°, Y {self.y:+.3f}° (within {2 * self.size:.2g}°) disagree with "
            f"the calibration together, {abs(self.sigma):.0f} σ: {some(details, 4, ' or ')} in the centre. Is there "
            "dust, a ghost, a bright neighbour? Their errors were enlarged"
        )

    def document(self) -> dict[str, Any]:
        """The place as plain data."""
        about = {name: getattr(self, name) for name in ("x", "y", "size", "sigma", "stars")}
        pairs = zip(self.cameras, self.alike, strict=True)
        alike = [{"camera": k, "name": c.name, "size": c.size, "error": c.error} for k, c in pairs]
        return about | {"alike": alike}


class Seen(NamedTuple):
    """Stars at places: positions, z and α of every camera, or of cameras together; χ² and its degrees of freedom."""

    x: OfStars
    y: OfStars
    z: Float[np.ndarray, "s k"]
    alpha: Float[np.ndarray, "s k"]
    chi2: OfStars
    dof: OfStars

    def of(self, chosen: Bool[np.ndarray, " s"]) -> Seen:
        """Some of the stars."""
        return Seen(*(values[chosen] for values in self))

    def near(self, place: Place) -> Seen:
        """The stars that a place of several times its size may hold."""
        return self.of(profile(self.x, self.y, (*place[:2], _WIDER * place[2])) > 0)


class Strongest(NamedTuple):
    """The place of the largest |Z|: its sign and size, the number of the camera, and the number of trials."""

    place: Place
    sigma: float
    camera: int
    trials: int


def places_of(
    stars: StarResiduals,
    cameras: Sequence[str],
    residual: Residuals | None = None,
    variance: OfStars | None = None,
    alarm: float = alarms.ALARM,
) -> tuple[DisagreeingPlace, ...]:
    """Places of the field where stars disagree together, the most significant first; none in `alarm` of catalogues.

    `cameras` are names. `residual` is that of `stars`, with or without changes, `variance` that of the
    residuals of every star over that of its noise (None: `own_variance`).
    """
    residual = stars.residual if residual is None else residual
    seen = _seen(stars, residual, own_variance(stars) if variance is None else variance)
    extent = max(float(np.abs([seen.x, seen.y]).max(initial=0.0)), 1e-9)
    places: list[DisagreeingPlace] = []
    remaining = np.ones(len(seen.x), bool)
    while len(places) < _MOST and remaining.sum() > 1:
        subset = seen.of(remaining)
        largest = strongest(subset, extent)
        if largest.trials * alarms.chance_of(largest.sigma) >= alarm:
            break
        place = _described(subset, largest, cameras)
        places.append(place)
        remaining &= place.profile(seen.x, seen.y) == 0.0
    return tuple(places)


Sums = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""cᵀr, cᵀPc ahead of q and u, the root of what these take of it, and cᵀc: of rows, or summed over those of a star."""


def _sums(stars: StarResiduals, residual: Residuals, members: Float[np.ndarray, "k c"]) -> Sums:
    """The sums of every row for cameras together: `members` are 1 for those."""
    columns = []
    for _, rows, part in stars.blocks():
        free, _ = part.projected(part.model[..., None] * members)
        half = np.linalg.cholesky(part.photon).swapaxes(1, 2)[part.star]
        along = half @ np.einsum("rik,crk->ric", part.tangent, free, optimize=True)
        score = (part.model * residual[rows]) @ members
        columns.append((score, np.sum(free**2, axis=-1).T, along, part.model**2 @ members))
    score, square, along, full = map(np.concatenate, zip(*columns, strict=True))
    return score, square, along, full


def _seeing(sums: Iterable[np.ndarray], spread: Float[np.ndarray, "s 1"]) -> tuple[np.ndarray, np.ndarray]:
    """z and α of stars with these sums; `spread` is the variance of their residuals."""
    score, square, along, full = sums
    information = square - np.sum(along**2, axis=1)
    sees = information > _BLIND * full
    root = np.sqrt(np.where(sees, information, 1.0) * spread)
    return np.where(sees, score / root, 0.0), np.where(sees, root / spread, 0.0)


def _seen(stars: StarResiduals, residual: Residuals, variance: OfStars) -> Seen:
    """z and α of the stars; rows of one star at different places are stars of their own."""
    extent = max(float(np.abs([stars.x, stars.y]).max(initial=0.0)), 1e-9)
    cell = np.round(np.stack([stars.x, stars.y], axis=1) / (_TOGETHER * extent)).astype(int)
    key = np.column_stack([stars.star, cell])
    _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)

    def summed(values: np.ndarray) -> np.ndarray:
        total = np.zeros((len(first), *values.shape[1:]))
        np.add.at(total, group.reshape(-1), values)
        return total

    star = stars.star[first]
    spread = variance[star]
    cameras = np.eye(stars.model.shape[1])
    z, alpha = _seeing(map(summed, _sums(stars, residual, cameras)), spread[:, None])
    chi2 = summed(np.sum(residual**2, axis=1)) / spread
    dof = np.maximum(stars.dof[star] / np.bincount(star)[star], 0.5)
    return Seen(stars.x[first], stars.y[first], z, alpha, chi2, dof)


def seen_from(
    stars: StarResiduals,
    group: Int[np.ndarray, " r"],
    members: Float[np.ndarray, "k c"],
    residual: Residuals,
    variance: OfStars,
) -> Iterator[Seen]:
    """The stars by their rows of each exposure group and of all that follow it; `members` as in `_sums`."""
    first, sums = stars.first, _sums(stars, residual, members)
    about = stars.chi2(residual) / variance, stars.dof.astype(float)
    for start in range(int(group.max()) + 1):
        on = (group >= start).astype(float)
        later = (np.add.reduceat((on * values.T).T, first) for values in sums)
        yield Seen(stars.x[first], stars.y[first], *_seeing(later, variance[:, None]), *about)


def strongest(seen: Seen, extent: float) -> Strongest:
    """The place of the largest |Z| of stars whose |X| and |Y| reach to `extent` (deg)."""
    best, trials = Strongest((0.0, 0.0, 0.0), 0.0, 0, 0), 0
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
                largest = int(np.argmax(np.abs(z)))
                if abs(z[largest]) > abs(best.sigma):
                    inside = index == occupied[largest]
                    centre = float(seen.x[inside].mean()), float(seen.y[inside].mean())
                    best = Strongest((*centre, size), float(z[largest]), k, 0)
                trials += len(occupied)
    return best._replace(trials=trials)


def _smoothed(
    index: Int[np.ndarray, " s"], values: OfStars, shape: tuple[int, ...], power: int
) -> Float[np.ndarray, " c"]:
    """Sums of values over cells with the weights g (`power` 1) or g² (2)."""
    reach = _CELLS * int(alarms.REACH)
    kernel = np.exp(-0.5 * power * (np.arange(-reach, reach + 1) / _CELLS) ** 2)
    sums = np.bincount(index, values, minlength=int(np.prod(shape))).reshape(shape)
    for axis in (0, 1):
        sums = ndimage.correlate1d(sums, kernel, axis=axis, mode="constant")
    return sums.ravel()


def _described(seen: Seen, found: Strongest, cameras: Sequence[str]) -> DisagreeingPlace:
    """The place about the strongest one, with the cameras that describe its stars as well as the best one."""
    subset = seen.near(found.place)
    fits: list[tuple[tuple[float, float, float], Place, int]] = []
    for k in range(len(cameras)):
        place = fitted(subset, k, found.place)
        fits.append((share_of(subset, k, profile(subset.x, subset.y, place)), place, k))
    fits.sort(key=lambda fit: -fit[0][2])
    (*_, best), place, _ = fits[0]
    scatter = (subset.chi2.sum() - best) / max(subset.dof.sum() - 4.0, 1.0)
    alike, numbers = [], []
    for (size, error, gain), _, k in fits:
        if gain > best - alarms.RIVAL * max(1.0, scatter):
            alike.append(PossibleChange(cameras[k], True, size=size, error=error, kind="spot", place=place))
            numbers.append(k)
    stars = int((profile(subset.x, subset.y, place) > np.exp(-2.0)).sum())
    x, y, size = place
    return DisagreeingPlace(x, y, size, found.sigma, stars, tuple(alike), tuple(numbers))


def fitted(seen: Seen, camera: int, start: Place) -> Place:
    """The place at which a camera describes the stars best, near the one that was looked for, its edge as sharp."""
    x, y, size, *edge = start

    def place(moved: Float[np.ndarray, " 3"]) -> Place:
        return (x + size * float(moved[0]), y + size * float(moved[1]), size * float(np.exp(moved[2])), *edge)

    def misfit(moved: Float[np.ndarray, " 3"]) -> float:
        return float(moved @ moved) - share_of(seen, camera, profile(seen.x, seen.y, place(moved)))[2]

    bounds = [(-_WIDER, _WIDER)] * 2 + [(-1.0, np.log(_WIDER))]
    first = np.vstack([np.zeros(3), 0.5 * np.eye(3)])
    options = {"maxiter": 200, "xatol": 0.01, "fatol": 0.1, "initial_simplex": first}
    solution = optimize.minimize(misfit, np.zeros(3), method="Nelder-Mead", bounds=bounds, options=options)
    return place(solution.x)


def described(seen: Seen, camera: int, place: Place, size: float) -> Bool[np.ndarray, " s"]:
    """Stars whose shift is that of a camera at a place, to `CUT` standard errors or to half of it: spots have edges."""
    shift = size * seen.alpha[:, camera] * profile(seen.x, seen.y, place)
    return (shift != 0) & (np.abs(seen.z[:, camera] - shift) < CUT + 0.5 * np.abs(shift))


def share_of(seen: Seen, camera: int, g: OfStars) -> tuple[float, float, float]:
    """β of a camera, its standard error, and by how much it makes χ² smaller."""
    shape = seen.alpha[:, camera] * g
    square, score = float(shape @ shape), float(shape @ seen.z[:, camera])
    return (score / square, square**-0.5, score**2 / square) if square > 0 else (0.0, np.inf, 0.0)
