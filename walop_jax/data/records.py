"""The plain records that a calibration set becomes once it has been read and checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

CAMERAS = ("N0", "N1", "N2", "N3")
KINDS = ("clp", "moon", "standard", "flux")
FLAG_BITS = {1: "saturated", 2: "bad pixel", 4: "edge or vignetted", 8: "blended", 16: "ghost"}


@dataclasses.dataclass(frozen=True)
class Site:
    """Where the telescope stands.

    `latitude` and `longitude` in degrees (east positive), `elevation` in metres.
    """

    telescope: str
    latitude: float
    longitude: float
    elevation: float


@dataclasses.dataclass(frozen=True)
class FilterCurve:
    """Throughput of a filter against wavelength (µm, ascending); one wavelength means monochromatic."""

    name: str
    wavelength: Float[np.ndarray, " n"]
    throughput: Float[np.ndarray, " n"]


@dataclasses.dataclass(frozen=True)
class Position:
    """Where a moving element stands in every exposure."""

    inside: Bool[np.ndarray, " e"]
    angle: Float[np.ndarray, " e"]


@dataclasses.dataclass(frozen=True)
class Exposures:
    """One entry per exposure; angles in degrees, NaN where a quantity has no meaning.

    `mjd` UTC days at mid-exposure, `exptime` s, `temp` Celsius, `ha` hours, `teff` K (NaN: flat photon
    spectrum), `rotator` the position angle of ICS +X (north through east).
    """

    exposure: Int[np.ndarray, " e"]
    kind: Shaped[np.ndarray, " e"]
    mjd: Float[np.ndarray, " e"]
    exptime: Float[np.ndarray, " e"]
    filter: Shaped[np.ndarray, " e"]
    clp_in: Bool[np.ndarray, " e"]
    clp_angle: Float[np.ndarray, " e"]
    chwp_in: Bool[np.ndarray, " e"]
    chwp_angle: Float[np.ndarray, " e"]
    temp: Float[np.ndarray, " e"]
    ha: Float[np.ndarray, " e"]
    ra: Float[np.ndarray, " e"]
    dec: Float[np.ndarray, " e"]
    rotator: Float[np.ndarray, " e"]
    teff: Float[np.ndarray, " e"]

    def __len__(self) -> int:
        return len(self.exposure)

    def position(self, prefix: str) -> Position:
        """The moving element of a column prefix."""
        if prefix == "CLP":
            return Position(self.clp_in, self.clp_angle)
        return Position(self.chwp_in, self.chwp_angle)


@dataclasses.dataclass(frozen=True)
class Points:
    """Field points: `point` the identifier, `x` and `y` in degrees in the instrument frame."""

    point: Int[np.ndarray, " p"]
    x: Float[np.ndarray, " p"]
    y: Float[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.point)


@dataclasses.dataclass(frozen=True)
class Sources:
    """Standard stars: catalogue `q`, `u` and their errors in the equatorial frame, `teff` in K (or NaN)."""

    source: Int[np.ndarray, " s"]
    name: Shaped[np.ndarray, " s"]
    q: Float[np.ndarray, " s"]
    u: Float[np.ndarray, " s"]
    q_err: Float[np.ndarray, " s"]
    u_err: Float[np.ndarray, " s"]
    teff: Float[np.ndarray, " s"]

    def __len__(self) -> int:
        return len(self.source)


@dataclasses.dataclass(frozen=True)
class Block:
    """Intensities of some field points in all exposures, dense: what the likelihood is fed with.

    `counts` and `sigma` in electrons; `used` is False where there is no measurement, or a flagged or
    unusable one (counts 0 and sigma 1 stand there). `source` is a row of `Sources`, -1 for none.
    """

    x: Float[np.ndarray, " p"]
    y: Float[np.ndarray, " p"]
    counts: Float[np.ndarray, "p e 4"]
    sigma: Float[np.ndarray, "p e 4"]
    used: Bool[np.ndarray, "p e"]
    source: Int[np.ndarray, "p e"]


@dataclasses.dataclass(frozen=True)
class InputFile:
    """A file that went into a result: where it was and the SHA-256 of its bytes."""

    path: Path
    sha256: str


@dataclasses.dataclass(frozen=True)
class CalibrationSet:
    """A calibration set, read, checked and free of units.

    `intensities` gives the data of a slice of the points; whole frames are read from disk only then.
    """

    instrument: str
    site: Site
    origin: str
    exposures: Exposures
    points: Points
    sources: Sources
    filters: Mapping[str, FilterCurve]
    intensities: Intensities
    inputs: tuple[InputFile, ...] = ()
    remarks: tuple[str, ...] = ()


class Intensities:
    """The four intensities of every (exposure, point): a table in memory or frames on disk.

    `block` must be pure and may be called from several threads; the field points it counts in are those
    of `CalibrationSet.points`, the exposures those of `CalibrationSet.exposures`.
    """

    def block(self, start: int, stop: int) -> Block:
        """Return the data of the field points `start:stop`, dense in the exposures."""
        raise NotImplementedError

    @property
    def rows(self) -> int:
        """Number of used rows, that is of (exposure, point) pairs with four good intensities."""
        raise NotImplementedError
