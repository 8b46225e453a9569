"""Mistakes in a catalogue, tried where its stars contradict the calibration: other readings of the same rows.

Cameras in another order, a rotator of the wrong sign, a field that is mirrored, turned, shifted or stretched, radians,
magnitudes for intensities, another filter, other gains: each makes residuals that no change of an instrument makes, and
each is undone by rewriting the rows (`other_readings`). Readings are tried where more than a tenth of the stars
disagree; exchanges within arms always. What makes the loss smaller by `BETTER` and lets the stars
agree is reported, with all that do so as well.

Rows in which one camera holds another star than the others are no reading: its light differs from theirs by factors
that no polarisation of stars makes (`APART`), either way. Where they are many they are told ahead of all readings.

Where a tenth of the stars would still disagree, they may be those of another instrument, which is asked. That it is
another of the shipped ones is no reading: their descriptions state what was designed, from which real ones differ by
more than the noise of stars (300 stars of a WALOP-SOUTH: 85 % disagree with its own description, 19 % once its four
gains are fitted), and rows of WALOP-NORTH have no camera to spare, so that any counts agree with it. INSTRUME tells it.

Limits      One mistake at a time. A ROTATOR that is wrong beside right X and Y turns q and u of all stars alike: only
            rows of one star at several rotators, or RA and DEC, show it. A wrong FILTER shows where the cross-talk or
            the shares of the cameras differ between the two by more than the noise of the stars.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.science import other_readings as tried_as
from walop_jax.science.other_readings import FEWEST, CatalogueReading, CatalogueRows, Fit, Judge

STARS = 300  # that are looked at
DISAGREE = 0.1
"""Share of the stars from which on readings are tried."""
BETTER, ALIKE = 60.0, 30.0  # of the sum, by which a reading must improve it; within which others are as good
APART = 1.5
"""Factor by which a camera must differ from the others to hold another star; these differ by its root at most."""
_AGREEING = 3  # cameras that must agree on a star
_BRIGHT = 0.05  # relative error of a camera up to which a row is asked for other stars


class OtherStars(NamedTuple):
    """The `camera` that holds other stars than the others in `rows` of the `bright` rows of a sample."""

    camera: str
    rows: int
    bright: int

    @property
    def many(self) -> bool:
        """True if they are too many for blends."""
        return self.rows > DISAGREE * self.bright

    def words(self) -> str:
        """The finding in a sentence."""
        return (
            f"N of {self.camera} are those of other stars in {self.rows} of {self.bright} bright rows: they differ "
            f"from all other cameras by a factor of {APART:g} or more, either way (match its stars with theirs anew)"
        )


@dataclasses.dataclass(frozen=True)
class CatalogueReadings:
    """How a catalogue of so many `stars` (a sample) agrees as it stands, and the readings that mend it, best first.

    `others` is the camera that holds other stars in most rows (None: none does in any); `instrument` is calibrated.
    """

    stars: int
    stands: Fit
    better: tuple[CatalogueReading, ...] = ()
    others: OtherStars | None = None
    instrument: str = ""

    @property
    def mended(self) -> bool:
        """True if the catalogue is not what it says, and what it should be is known."""
        return bool(self.better) or (self.others is not None and self.others.many)

    def words(self) -> str:
        """What is wrong, in a sentence."""
        if self.others is not None and self.others.many:
            return self.others.words()
        reasons = "; or if ".join(f"{reading.what} ({reading.remedy})" for reading in self.better)
        number, best = round(self.stands.disagree * self.stars), self.better[0].fit
        if best.disagree > DISAGREE:
            reasons += f"; as they would not all agree: {tried_as.of_another(self.instrument)}?"
        then = f"{round(best.disagree * self.stars)} of {self.stars}"
        if number > max(DISAGREE * self.stars, 1.5 * best.disagree * self.stars):
            return (
                f"{number} of {self.stars} stars disagree with the calibration; they would agree (all but {then}) if "
                f"{reasons}"
            )
        if self.stands.misfit - self.stands.dof > 2.0 * max(best.misfit - best.dof, 0.0):
            return f"the stars together disagree with the calibration; they would agree if {reasons}"
        size = f"{100 * self.stands.scatter:.2g} %, {100 * best.scatter:.2g} % else"
        return f"q and u of the stars scatter by the cross-talk of the instrument; they would not ({size}) if {reasons}"

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        about = {"stars": self.stars, "disagree": self.stands.disagree, "scatter": self.stands.scatter}
        about |= {"other_stars": None if self.others is None else self.others._asdict()}
        return {**about, "readings": [reading.document() for reading in self.better]}


def readings_of(
    vectors: AnalysisVectors, rows: CatalogueRows, *, doubted: bool = False
) -> CatalogueReadings | None:
    """The readings of a sample of a catalogue that mend it; None of few stars, or without a camera to spare.

    `rows` are at any place of the field, those of `counts` that are not used NaN. All readings are tried where the
    stars disagree, or the catalogue is `doubted` for other reasons; else those that leave no trace in χ².
    """
    count = int(rows.star.max(initial=-1)) + 1
    if count < FEWEST:
        return None
    judge = Judge(vectors)
    stands = judge.fit(rows)
    if not np.isfinite(stands.loss):
        return None
    cameras = vectors.instrument.cameras
    others = _other_stars(judge, rows)
    if others is not None and others.many:
        return CatalogueReadings(count, stands, (), others)
    arms = [arm for arm in cameras.arms if len(arm) > 1]
    always = [*tried_as.orders(cameras.names, arms), *tried_as.units(rows)]
    tries: list[Iterable[CatalogueReading]] = [always]
    if doubted or stands.disagree > DISAGREE:
        named = [
            *tried_as.orders(cameras.names),
            *tried_as.units(rows),
            *tried_as.fields(),
            *tried_as.rotators(rows),
            *tried_as.radians(judge, rows),
        ]
        tries = [
            named,
            tried_as.turns(judge, rows),
            tried_as.scales(judge, rows),
            tried_as.shifts(judge, rows),
            tried_as.filters(vectors, rows),
        ]
        tries += [tried_as.gains(judge, rows), tried_as.all_gains(judge, rows)]
    gains = [judge.judged(item, rows) for item in tried_as.gains(judge, rows)] if len(tries) > 1 else []
    usual = min((item.fit.loss for item in gains if item.usual), default=np.inf)
    for tried in tries:
        judged = [judge.judged(item, rows) for item in tried if not item.usual]
        good = sorted((item for item in judged if _mends(item, stands)), key=lambda item: item.fit.loss)
        if good and usual < good[0].fit.loss + ALIKE:
            break
        if good:
            alike = tuple(item for item in good if item.fit.loss < good[0].fit.loss + ALIKE)
            return CatalogueReadings(count, stands, alike, others, vectors.instrument.name)
    return CatalogueReadings(count, stands, (), others)


def _mends(reading: CatalogueReading, stands: Fit) -> bool:
    """True if the stars agree with a reading, as they do not as the catalogue stands."""
    fit = reading.fit
    agrees = fit.disagree <= max(stands.disagree / 3.0, 0.5 * DISAGREE)
    excess, before = fit.misfit - fit.dof, max(stands.misfit - stands.dof, 0.0)
    sums = not reading.searched or fit.misfit < stands.misfit - BETTER
    return fit.loss < stands.loss - BETTER and agrees and sums and excess <= before / 4.0


def sample_of(rows: CatalogueRows) -> CatalogueRows:
    """Some `STARS` bright stars of rows that have all cameras, or as many as there are."""
    count = int(rows.star.max(initial=-1)) + 1
    with np.errstate(invalid="ignore", divide="ignore"):
        bright = np.nanmin(
            np.where(rows.sigma > 0, np.abs(rows.counts) / rows.sigma, np.nan), axis=1, initial=np.inf
        )
    whole = np.isfinite(rows.counts).all(axis=1)
    least = np.full(count, np.inf)
    np.minimum.at(least, rows.star, np.where(whole & np.isfinite(bright), bright, -np.inf))
    order = np.argsort(-least, kind="stable")[:STARS]
    chosen = np.zeros(count, bool)
    chosen[order[np.isfinite(least[order])]] = True
    return rows.of(chosen[rows.star])


def _other_stars(judge: Judge, rows: CatalogueRows) -> OtherStars | None:
    """The camera whose light in some rows is not that of the star that all others see; None where none is so."""
    names = judge.vectors.instrument.cameras.names
    inside = judge.within(rows)
    if not len(inside.x) or len(names) < _AGREEING + 1:
        return None
    counts, expected = judge.unpolarised(inside)
    with np.errstate(invalid="ignore", divide="ignore"):
        light = np.log(counts / expected)
        bright = (inside.sigma < _BRIGHT * counts).all(axis=1) & np.isfinite(light).all(axis=1)
    light, limit = light[bright], float(np.log(APART))
    if len(light) < FEWEST:
        return None
    light = light - np.median(light, axis=0)  # gains are no other stars
    number = []
    for k in range(len(names)):
        others = np.delete(light, k, axis=1)
        agree = np.ptp(others, axis=1) < 0.5 * limit
        number.append(int(np.sum(agree & (np.abs(light[:, k] - others.mean(axis=1)) > limit))))
    worst = int(np.argmax(number))
    return OtherStars(names[worst], number[worst], len(light)) if number[worst] else None
