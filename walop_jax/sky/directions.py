"""Directions of stars: field coordinates, position angles, Galactic coordinates, and stars that are the same.

    east = X sin R + Y cos R,    north = X cos R − Y sin R      on the tangent plane (deg), R = ROTATOR

X and Y are coordinates on the sky: the distortion between sky and detector is in the WCS of an image, not in
them. The axes of the instrument are carried along great circles from the field centre to a star (docs: conventions), so
that +X has at the star the position angle

    R + φ' − φ        φ, φ' position angles, at the field centre and at the star, of the great circle through both

Astropy does the spherical trigonometry.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from astropy import units
from astropy.coordinates import SkyCoord, angular_separation
from astropy.wcs import WCS
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from walop_jax.io.shapes import Vector


@dataclasses.dataclass(frozen=True)
class Pointing:
    """Right ascension and declination of a field centre, and the position angle of +X there (deg)."""

    ra: float
    dec: float
    rotator: float

    def _plane(self) -> WCS:
        """The tangent plane, its coordinates X and Y in degrees."""
        sin, cos = np.sin(np.deg2rad(self.rotator)), np.cos(np.deg2rad(self.rotator))
        plane = WCS(naxis=2)
        plane.wcs.ctype = ["RA---TAN", "DEC--TAN"]
        plane.wcs.crval = [self.ra, self.dec]
        plane.wcs.crpix = [0.0, 0.0]
        plane.wcs.cd = [[sin, cos], [cos, -sin]]
        return plane

    def field_of(self, ra: Vector, dec: Vector) -> tuple[Vector, Vector]:
        """X and Y (deg) of stars in the hemisphere about the field centre."""
        x, y = self._plane().wcs_world2pix(ra, dec, 1)
        return np.asarray(x, float), np.asarray(y, float)

    def sky_of(self, x: Vector, y: Vector) -> tuple[Vector, Vector]:
        """Right ascension and declination (deg) of field points."""
        ra, dec = self._plane().wcs_pix2world(x, y, 1)
        return np.mod(np.asarray(ra, float), 360.0), np.asarray(dec, float)

    def rotator_at(self, ra: Vector, dec: Vector) -> Vector:
        """Position angle of +X (deg) at stars, from their own north."""
        centre, stars = _directions(self.ra, self.dec), _directions(ra, dec)
        outward = np.asarray(centre.position_angle(stars).deg)
        back = np.asarray(stars.position_angle(centre).deg) + 180.0
        return np.mod(
            self.rotator + np.where(separation(self.ra, self.dec, ra, dec) > 0.0, back - outward, 0.0), 360.0
        )


def separation(ra: Any, dec: Any, other_ra: Any, other_dec: Any) -> Float[np.ndarray, "*n"]:
    """Angle between directions (all in degrees)."""
    return np.asarray(np.rad2deg(angular_separation(*map(np.deg2rad, (ra, dec, other_ra, other_dec)))))


def galactic(ra: Vector, dec: Vector) -> tuple[Vector, Vector, Vector]:
    """Galactic longitude and latitude of directions, and the position angle of Galactic north there (all in deg).

    A position angle from Galactic north is the angle from equatorial north less the position angle of Galactic north.
    """
    stars: Any = _directions(ra, dec)
    pole: Any = SkyCoord(0.0, 90.0, unit="deg", frame="galactic")
    in_galactic = stars.galactic
    longitude, latitude, north = (
        np.asarray(angle.deg, float)
        for angle in (in_galactic.l, in_galactic.b, stars.position_angle(pole.icrs))
    )
    return longitude, latitude, north


def designations(ra: Vector, dec: Vector) -> np.ndarray:
    """Names of directions (deg) by their coordinates, Jhhmmss.ss+ddmmss.s, cut off as the IAU asks."""
    seconds = np.floor(np.mod(ra, 360.0) / 15.0 * 360000.0 + 1e-6).astype(int) % 8640000  # hundredths
    arcsec = np.floor(np.abs(dec) * 36000.0 + 1e-6).astype(int)  # tenths
    sign = np.where(np.asarray(dec) < 0, "-", "+")
    return np.array(
        [
            f"J{s // 360000:02d}{s // 6000 % 60:02d}{s % 6000 / 100:05.2f}"
            f"{plus}{a // 36000:02d}{a // 600 % 60:02d}{a % 600 / 10:04.1f}"
            for s, plus, a in zip(seconds.tolist(), sign.tolist(), arcsec.tolist(), strict=True)
        ]
    )


def same_stars(ra: Vector, dec: Vector, tolerance: float) -> Int[np.ndarray, " n"]:
    """The number of the star of every position (deg): positions chained by steps within a tolerance (arcsec) are one
    star.
    """
    stars = _directions(ra, dec)
    first, second, *_ = stars.search_around_sky(stars, tolerance * units.arcsec)
    pairs = coo_array((np.ones(len(first)), (first, second)), shape=(len(ra), len(ra)))
    return connected_components(pairs, directed=False)[1]


@dataclasses.dataclass(frozen=True)
class Registration:
    """A shift (arcsec, towards X and Y) and a rotation (deg, from X to Y) of positions on a plane about its origin.

    `pairs` is the number of stars that it comes from; 0: the positions have nothing in common.
    """

    shift: Float[np.ndarray, " 2"]
    rotation: float
    pairs: int

    def apply(self, place: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Positions (deg) that were shifted and rotated so, put back."""
        angle = np.deg2rad(self.rotation)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return (place - self.shift / 3600.0) @ turn.T


NOT_MOVED = Registration(np.zeros(2), 0.0, 0)
FEWEST_REGISTERED = 3
"""Stars that a peak needs; positions of fewer are taken as they are."""
BRIGHTEST = 300
"""Stars by which positions are registered."""
REACH = 300.0  # arcsec: a larger shift is taken for another field
_CELL = 4.0  # arcsec, of the histogram of differences
_ROUNDS = 4


def registered(
    place: Float[np.ndarray, "n 2"],
    reference: Float[np.ndarray, "m 2"],
    brightness: Float[np.ndarray, " n"],
    of_reference: Float[np.ndarray, " m"],
    tolerance: float,
) -> Registration:
    """The shift and rotation of positions (deg, on the tangent plane) against reference positions of the same stars.

    Differences of all pairs of bright stars within `REACH` have a peak at the shift. The pairs in the peak give shift
    and rotation by least squares; each round takes the pairs that are closer. Without a peak above chance `pairs` is 0.
    """
    bright = place[np.argsort(-brightness, kind="stable")[:BRIGHTEST]]
    bright_reference = reference[np.argsort(-of_reference, kind="stable")[:BRIGHTEST]]
    difference = 3600.0 * (bright[:, None] - bright_reference[None]).reshape(-1, 2)
    difference = difference[np.abs(difference).max(axis=1) < REACH]
    if not len(difference):
        return NOT_MOVED
    edges = np.arange(-REACH, REACH + _CELL, _CELL)
    count = np.histogram2d(*difference.T, bins=[edges, edges])[0]
    count = count + np.roll(count, 1, 0)  # a peak may lie on the edges of four cells
    count = count + np.roll(count, 1, 1)
    peak, chance = np.unravel_index(count.argmax(), count.shape), count.mean()
    if count.max() < max(
        float(FEWEST_REGISTERED),
        chance + 6.0 * np.sqrt(chance),
        0.05 * min(len(bright), len(bright_reference)),
    ):
        return NOT_MOVED
    registration = Registration(np.array([edges[k] for k in peak]), 0.0, int(count.max()))
    for radius in np.geomspace(2.0 * _CELL, max(3.0 * tolerance, 1.0), _ROUNDS):
        _, rows, matches = mutual(registration.apply(bright), bright_reference, radius)
        if len(rows) < FEWEST_REGISTERED:
            break
        # By least squares, small rotations: place = reference + shift + angle × (−Y, X).
        x, y = bright_reference[matches].T
        ones, zeros = np.ones(len(x)), np.zeros(len(x))
        design = np.concatenate([np.stack([ones, zeros, -y], 1), np.stack([zeros, ones, x], 1)])
        off = (bright[rows] - bright_reference[matches]).T.ravel()
        *shift, angle = np.linalg.lstsq(design, off, rcond=None)[0]
        registration = Registration(3600.0 * np.array(shift), float(np.rad2deg(angle)), len(x))
    return registration


def mutual(
    place: Float[np.ndarray, "n 2"], reference: Float[np.ndarray, "m 2"], tolerance: float
) -> tuple[Bool[np.ndarray, " n"], Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Pairs of positions (deg, near the origin) that are each other's nearest, within a tolerance (arcsec).

    Returned are: True for positions that are ambiguous, as a second one of the reference lies within the tolerance as
    well; then the pairs, by their numbers in the two lists.
    """
    if not len(place) or not len(reference):
        return np.zeros(len(place), bool), np.zeros(0, int), np.zeros(0, int)
    stars, references = (_directions(*positions.T) for positions in (place, reference))
    nearest, apart, _ = stars.match_to_catalog_sky(references)
    back, *_ = references.match_to_catalog_sky(stars)
    pairs = np.flatnonzero((back[nearest] == np.arange(len(place))) & (apart.arcsec <= tolerance))
    ambiguous = np.zeros(len(place), bool)
    if len(reference) > 1:
        ambiguous = stars.match_to_catalog_sky(references, nthneighbor=2)[1].arcsec <= tolerance
    return np.asarray(ambiguous), pairs, np.asarray(nearest)[pairs]


def _directions(ra: float | Vector, dec: float | Vector) -> Any:
    return SkyCoord(ra, dec, unit="deg", frame="icrs")
