"""The verdict on a reduced catalogue: may its q and u be used? All doubts, the one that explains most first."""

from __future__ import annotations

import dataclasses

import numpy as np

from walop_jax.calibration.calibration import Calibration
from walop_jax.fit.verdict import Quality
from walop_jax.science.apply import Stars
from walop_jax.science.catalogue import Catalogue
from walop_jax.science.overlaps import Overlap

MOST = 0.5
"""Share of the stars from which bits of FLAG are about the catalogue, not about single stars."""
OF_STARS = (
    Quality.NO_STOKES,
    Quality.BEYOND_FIELD,
    Quality.BEYOND_SETTINGS,
    Quality.VALIDITY_FORCED,
    Quality.DISAGREES,
    Quality.PLACE,
    Quality.REPEATED,
)
"""Bits of FLAG of which most stars should have none."""


@dataclasses.dataclass(frozen=True)
class CatalogueVerdict:
    """Why the results of a catalogue are not to be trusted (`doubts`), and what concerns some of its stars only."""

    doubts: tuple[str, ...] = ()
    reservations: tuple[str, ...] = ()

    @property
    def trusted(self) -> bool:
        """True if nothing is doubted."""
        return not self.doubts

    @property
    def words(self) -> str:
        """The verdict as it is printed first."""
        if self.doubts:
            return f"NOT to be trusted: {self.doubts[0]}"
        return f"trusted, but {self.reservations[0]}" if self.reservations else "trusted"


def verdict_on(
    calibration: Calibration, rows: Catalogue, stars: Stars, seen_twice: Overlap | None = None
) -> CatalogueVerdict:
    """The verdict on the stars of a catalogue, reduced with a calibration."""
    check, doubts = stars.check, []
    places = tuple(f"{place.words()} (FLAG {Quality.PLACE:d})" for place in check.places)
    said = [f"{text} (FLAG {Quality.CATALOGUE:d})" for text in check.warnings()]
    of_check = [text for text in said if not any(place.words() in text for place in check.places)]
    if check.misread:
        doubts += of_check
    doubts += rows.doubts
    if not calibration.verdict.trusted:
        doubts += [text.replace("this calibration is", "the calibration is") for text in calibration.warnings]
    if not check.misread:
        doubts += of_check
    if seen_twice is not None:
        doubts += seen_twice.warnings()
    for bit in OF_STARS:
        share = float(np.mean(stars.flag & bit > 0)) if len(stars.flag) else 0.0
        if share > MOST and not calibration.verdict.quality & bit:
            doubts.append(f"FLAG {bit:d} of {100 * share:.0f} % of the stars: {bit.meaning}")
    return CatalogueVerdict(tuple(dict.fromkeys(doubts)), () if check.misread else places)
