"""The verdict on a reduced catalogue: may its q and u be used? All doubts, the one that does most to q and u first.

What a doubt does is known of the stars together (`CatalogueCheck.against`), of places that differ (`Overlap.excess`)
and of a calibration whose verdict says it. It is not known of numbers that cannot be what they say, of another reading
of the rows, and of settings or places that were not calibrated: these may do anything to q and u, and come first, in
this order. What follows from a doubt about all stars is not told again of each.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from walop_jax.calibration.calibration import Calibration
from walop_jax.fit.verdict import Doubt, Quality, Verdict
from walop_jax.science.apply import Stars
from walop_jax.science.catalogue import Catalogue
from walop_jax.science.overlaps import Overlap
from walop_jax.science.star_words import CORRECT, LOOK

MOST = 0.5
"""Share of the stars from which bits of FLAG are about the catalogue, not about single stars."""
OF_STARS = {
    Quality.NO_STOKES: "give rows at several settings of the plate, and counts above 0 in all cameras",
    Quality.BEYOND_FIELD: "check X and Y (degrees), and the pointing; or calibrate more of the field",
    Quality.BEYOND_SETTINGS: "give the calibration of this filter and temperature",
    Quality.VALIDITY_FORCED: "give the calibration of this filter and temperature, without --force",
    Quality.DISAGREES: "check the background, the order of the cameras and the unit of N",
    Quality.PLACE: LOOK,
    Quality.REPEATED: "leave out the rows that are there twice",
}
"""Bits of FLAG of which most stars should have none, with a remedy."""


def verdict_on(
    calibration: Calibration, rows: Catalogue, stars: Stars, seen_twice: Overlap | None = None
) -> Verdict:
    """The verdict on the stars of a catalogue, reduced with a calibration."""
    return Verdict().with_doubts(_against(calibration, rows, stars, seen_twice))


def _against(
    calibration: Calibration, rows: Catalogue, stars: Stars, seen_twice: Overlap | None
) -> Iterator[Doubt]:
    check, of_fit = stars.check, calibration.verdict
    of_check = [
        dataclasses.replace(doubt, sentence=f"{doubt.sentence} (FLAG {doubt.bit:d})")
        for doubt in check.against
    ]
    if check.misread:
        yield from of_check
    yield from (Doubt(Quality.CATALOGUE, text, remedy=CORRECT) for text in rows.doubts)
    if not of_fit.trusted:
        (why,) = calibration.warnings
        text = why.replace("this calibration is", "the calibration is")
        first = of_fit.reasons[0]
        yield Doubt(of_fit.quality, text, off=first.off, remedy=first.cure)
    if not check.misread:
        yield from of_check
    if seen_twice is not None:
        yield from (
            Doubt(
                Quality.CATALOGUE,
                text,
                off=seen_twice.excess,
                remedy="walop-jax diagnose looks for the cause",
            )
            for text in seen_twice.warnings()
        )
    told = any(doubt.blocking for doubt in of_check)
    at_places = max((place.off for place in check.places if place.off is not None), default=None)
    for bit, cure in OF_STARS.items():
        share = float(np.mean(stars.flag & bit > 0)) if len(stars.flag) else 0.0
        if share > MOST and not of_fit.quality & bit and not (told and bit == Quality.DISAGREES):
            text = f"FLAG {bit:d} of {100 * share:.0f} % of the stars: {bit.meaning}"
            yield Doubt(bit, text, off=at_places if bit == Quality.PLACE else None, remedy=cure)
    if of_fit.trusted:
        for text in calibration.warnings:
            yield Doubt(
                Quality(0), text, blocking=False, remedy="Q_HIDDEN and U_HIDDEN of every star have its size"
            )
