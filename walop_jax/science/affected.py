"""Results that a new calibration changes: the shift of every star in its standard errors, by catalogue and night.

Equation    z = √(δᵀ C⁻¹ δ),  δ = (q, u) by the new calibration − (q, u) by the old one, from the same rows
Symbols     C covariance of (q, u) by the old calibration: photons, calibration, colour
Limits      The same calibration: z = 0. z is the largest of |shift| / standard error over all directions of (q, u).

Photons are the same in both, so that z has no noise of theirs: it is what becomes of a result, not a test.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.fit.verdict import Doubt, Quality
from walop_jax.io.display import Display, Displayed
from walop_jax.io.text import beside, per_cent, some, two_digits, with_minus_sign
from walop_jax.science.apply import Stars, results_of
from walop_jax.science.catalogue import Catalogue
from walop_jax.sky.nights import night_of

ASKED = "ask the catalogues that the old calibration has made, by that calibration"
LIMIT = 0.5  # standard errors; a result that is off by a quarter of its variance is made again
MOST = 0.95  # fraction of the stars of a night that may shift by no more than the limit


class NightShift(NamedTuple):
    """The stars of a night in one catalogue: their shift (standard errors), and the mean shift of q and u themselves.

    The mean is weighted by the old errors: where q or u is hardly measured, shifts are large and mean nothing. `night`
    is the MJD of the evening, NaN where the catalogue has no times. `lost` stars have a result by the old calibration
    alone, `gained` stars by the new one alone, `beyond` stars have settings that the new calibration does not cover.
    """

    catalogue: str
    night: float
    stars: int
    median: float
    most: float
    largest: float
    q: float
    u: float
    above: int
    lost: int
    gained: int
    beyond: int
    again: bool


@dataclasses.dataclass(frozen=True, repr=False)
class Affected(Displayed):
    """Nights with the shift of their stars by another calibration; `old` and `new` are content hashes."""

    old: str
    new: str
    limit: float
    nights: tuple[NightShift, ...]
    warnings: tuple[str, ...] = ()

    @property
    def again(self) -> tuple[str, ...]:
        """The catalogues that must be made again, each once."""
        return tuple(dict.fromkeys(night.catalogue for night in self.nights if night.again))

    @property
    def against(self) -> tuple[Doubt, ...]:
        """A reason for every catalogue that must be made again: what the new calibration does to its stars."""
        doubts = []
        for name in self.again:
            nights = [night for night in self.nights if night.catalogue == name and night.again]
            worst = max(nights, key=lambda night: (night.most, night.lost + night.gained))
            off = max(float(np.hypot(night.q, night.u)) for night in nights)
            q, u = (with_minus_sign(f"{100 * mean:+.2g}") for mean in (worst.q, worst.u))
            shift = f"q by {q} %, u by {u} % in the mean, {two_digits(worst.most)} standard errors in 95 % of the stars"
            what = f"{name} changes ({self._reason(worst).removeprefix('again: ')}): {shift}"
            doubts.append(
                Doubt(Quality.CATALOGUE, what, off=off, remedy=f"make it again: walop-jax apply NEW {name}")
            )
        remarks = (Doubt(Quality(0), text, blocking=False, remedy=ASKED) for text in self.warnings)
        return (*doubts, *remarks)

    @property
    def stars_in_words(self) -> str:
        """The largest mean change of q and u of a night, in words."""
        largest = max((float(np.hypot(night.q, night.u)) for night in self.nights), default=0.0)
        return f"q, u change by {per_cent(largest)} % at most in the mean of a night"

    def _reason(self, night: NightShift) -> str:
        """Why a night must be made again, in a few words; empty where it need not."""
        if not night.again:
            return ""
        if night.most > self.limit:
            return "again: shifted"
        if night.lost or night.gained:
            return f"again: {night.lost} results lost, {night.gained} gained"
        return "again: one calibration is trusted, the other is not"

    def document(self) -> dict[str, Any]:
        """The nights as plain data, the part `affected` of check.json."""
        nights = [night._asdict() for night in self.nights]
        return dataclasses.asdict(self) | {"again": list(self.again), "nights": nights}

    def display(self) -> Display:
        """A line for each night, and what must be made again."""
        rows = []
        for night in self.nights:
            evening = f"{night.night:.0f}" if np.isfinite(night.night) else ""
            most, _ = beside(night.most, self.limit)
            shifts = two_digits(night.median), most, two_digits(night.largest)
            means = (f"{100 * mean:+.4f} %" for mean in (night.q, night.u))
            rows.append((night.catalogue, evening, f"{night.stars}", *shifts, *means, self._reason(night)))
        head = ("catalogue", ">night", ">stars", ">median", ">95 %", ">largest", ">q", ">u", "")
        limit, allowed = (
            f"{self.limit:g} standard errors",
            f"{100 * (1 - MOST):.0f} % of the stars of a night",
        )
        again = f"nothing: nowhere do more than {allowed} shift by more than {limit}"
        if self.again:
            again = some(list(self.again), 10)
        facts = (("to be made again", again), ("limit", f"{limit}; {allowed} may shift by more"))
        return Display("Shift of q, u by the new calibration, in standard errors", facts, head, tuple(rows))


def affected(
    old: Calibration, new: Calibration, catalogue: Catalogue, name: str, limit: float = LIMIT
) -> Iterator[NightShift]:
    """The nights of a catalogue, called `name`, with the shift of its stars; one of several nights is in each."""
    before, after = results_of(old, catalogue), results_of(new, catalogue)
    evening, star = night_of(catalogue.time, old.site.longitude), catalogue.star
    dated, everyone = np.isin(star, star[np.isfinite(evening)]), np.arange(len(before.qu))
    beyond = np.isin(everyone, star[new.beyond_settings(catalogue.points.settings)])
    measured_before, measured_after = (~np.isnan(stars.qu).any(axis=1) for stars in (before, after))
    every_z = shift(before, after)
    bad = Quality.NOT_CONVERGED | Quality.UNEXPLAINED
    verdicts = {int(np.bitwise_and.reduce(stars.flag)) & bad for stars in (before, after)}
    for night in np.unique(evening):
        rows = evening == night if np.isfinite(night) else ~dated
        if not rows.any():
            continue
        of_night = np.isin(everyone, star[rows])
        twice = of_night & measured_before & measured_after
        weight = 1.0 / np.diagonal(before.covariance[twice], axis1=1, axis2=2)
        change, z = (after.qu - before.qu)[twice], every_z[twice]
        mean = np.average(change, axis=0, weights=weight) if z.size else np.zeros(2)
        median, quantile, largest = map(float, np.quantile(z, [0.5, MOST, 1.0]) if z.size else np.zeros(3))
        lost = int((of_night & measured_before & ~measured_after).sum())
        gained = int((of_night & measured_after & ~measured_before).sum())
        yield NightShift(
            name, float(night), int(of_night.sum()), median, quantile, largest, float(mean[0]), float(mean[1]),
            above=int((z > limit).sum()), lost=lost, gained=gained, beyond=int((beyond & of_night).sum()),
            again=quantile > limit or lost + gained > 0 or len(verdicts) > 1,
        )  # fmt: skip


def shift(before: Stars, after: Stars) -> Float[np.ndarray, " s"]:
    """Shift of every star in standard errors of `before`, in the worst direction of (q, u); NaN without a result."""
    change = after.qu - before.qu
    measured = np.isfinite(change).all(axis=1)
    square = np.full(len(change), np.nan)
    inverse = np.linalg.inv(before.covariance[measured])
    square[measured] = np.einsum("si,sij,sj->s", change[measured], inverse, change[measured])
    return np.sqrt(square)
