"""The headers of a catalogue of a camera: of its image, of its table, and the primary header of its file.

The header nearest to the stars counts, in this order. A later header that says something else is an error, which names
both.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.data.celestial import ICRS, Frame, frame_of, plane_of, sky_of_pixels
from walop_jax.data.header_words import Words, of_header
from walop_jax.data.schema import MISSING
from walop_jax.data.units import Place, degrees_of
from walop_jax.io.errors import DataError, fail
from walop_jax.io.fits_reading import open_fits

POINTING = ("RA", "DEC", "ROTATOR")
OF_EXPOSURES = ("FILTER", "MJD", "TEMP", "HA", "CHWP_ANGLE", "CHWP_IN", "CHWP_TURN")
"""Columns, or words of a header, about the exposure: they go with its stars."""
APART: Mapping[str, float] = {"MJD": 0.01, "TEMP": 0.5, "HA": 0.05, "ROTATOR": 0.05, "RA": 0.01, "DEC": 0.005}
"""Largest differences between statements on one exposure (RA and DEC in deg); other values are the same."""
LDAC_OBJECTS, LDAC_HEADER = "LDAC_OBJECTS", "LDAC_IMHEAD"
IMAGE, TABLE, PRIMARY = "of the image", "of the table", "primary"
"""Headers, the nearest to the stars first."""


@dataclasses.dataclass(frozen=True)
class Headers:
    """The headers of a file by name, the nearest to the stars first."""

    path: Path
    parts: tuple[tuple[str, Mapping[str, Any]], ...]

    def stated(self, name: str) -> list[tuple[str, Any]]:
        """The values of a word, each with the header that states it; none where it is empty."""
        found = ((where, header.get(name)) for where, header in self.parts)
        return [(where, value) for where, value in found if _is_stated(value)]

    def value(self, name: str) -> Any:
        """The value of a word in the header nearest to the stars; None if no header states it.

        Raises `DataError` where another header contradicts it.
        """
        stated = self.stated(name)
        if differ(name, [value for _, value in stated]):
            listed = " and ".join(f"{value} in the header {where}" for where, value in stated)
            option = f"give --{name.lower()}, or correct" if name in POINTING else "correct"
            raise fail(f"is {listed}", file=self.path, column=name, advice=f"{option} the word that is wrong")
        return stated[0][1] if stated else None

    @property
    def wcs(self) -> Mapping[str, Any]:
        """The first header with a WCS of the sky; an empty one where there is none."""
        return next((header for _, header in self.parts if "CRVAL1" in header), {})

    def frame(self, of_image: bool, mjd: float = math.nan) -> Frame:
        """The reference system of directions, from the first header that states one.

        The header of the image counts only if `of_image`.
        """
        for where, header in self.parts:
            frame = frame_of(header, Place(self.path, "header"), mjd)
            if frame != ICRS and (of_image or where != IMAGE):
                return frame
        return ICRS

    def worded(self, words: Words, names: Collection[str]) -> dict[str, Any]:
        """The columns `names` that the words of an observatory make of the headers, read as one."""
        asked = {word for name in names if name in words.columns for word in words.columns[name].word}
        merged: dict[str, Any] = {}
        for _, header in reversed(self.parts):
            merged |= {key: header[key] for key in dict.fromkeys(header) if key}
        merged |= {word: value for word in asked if (value := self.value(word)) is not None}
        return of_header(merged, words, names, self.path)


def read_headers(path: Path, of_table: Mapping[str, Any]) -> Headers:
    """The headers of a file; `of_table` is the header of its table. Raises `DataError` for damaged FITS files."""
    parts: list[tuple[str, Any]] = [(TABLE, {str(key).upper(): value for key, value in of_table.items()})]
    file = Path(str(path).partition("[")[0]) if not path.exists() else path
    try:
        with open_fits(file) as opened:
            names = [hdu.name for hdu in opened.hdus]
            if LDAC_HEADER in names:
                cards = np.asarray(opened.hdus[names.index(LDAC_HEADER)].data[0][0]).astype(str).ravel()
                parts.insert(0, (IMAGE, fits.Header.fromstring("".join(card.ljust(80) for card in cards))))
            parts.append((PRIMARY, opened.hdus[0].header.copy()))
    except DataError:
        if file.suffix.lower() in (".fits", ".fit", ".ldac"):
            raise
    return Headers(path, tuple(parts))


def is_ldac(path: Path) -> bool:
    """True for a FITS file with the objects of FITS_LDAC."""
    with contextlib.suppress(DataError), open_fits(path) as opened:
        return LDAC_OBJECTS in [hdu.name for hdu in opened.hdus]
    return False


def differ(name: str, stated: Sequence[Any]) -> bool:
    """True where values stated of one exposure are not the same; cameras have clocks and sensors of their own."""
    if len(stated) < 2:
        return False
    if name == "INSTRUME":
        return len({letters(str(value)) for value in stated}) > 1
    if name in APART:
        try:
            numbers = np.array([angle(name, value) if name in POINTING else float(value) for value in stated])
        except ValueError:
            return True
        if name in ("RA", "ROTATOR"):
            numbers = np.mod(numbers - numbers[0] + 180.0, 360.0)
        return float(np.ptp(numbers)) > APART[name]
    return len({str(value).strip() for value in stated}) > 1


def letters(name: str) -> str:
    """The letters and digits of a name, in capitals: names that differ in nothing else are one."""
    return "".join(filter(str.isalnum, name.upper()))


def angle(name: str, value: Any) -> float:
    """An angle of the pointing (deg): a number, or a text in hours (RA) or degrees; ValueError for others."""
    if isinstance(value, bool):
        raise ValueError(f"{value} is no angle")
    with contextlib.suppress(ValueError):
        return float(value)
    return float(degrees_of(str(value), "hourangle" if name == "RA" else "deg"))


def pointing_in(
    headers: Headers, worded: Mapping[str, Any], needed: Collection[str], mjd: float
) -> tuple[dict[str, float], list[str]]:
    """RA, DEC and ROTATOR (deg, ICRS), those of `needed` that the headers state, and remarks.

    Words of an observatory (`worded`) count before RA, DEC, ROTATOR of the headers. Raises `DataError` for a text that
    is no angle, for headers that contradict each other, and where one of RA and DEC alone is wanted of another system.
    """
    values, of_words, remarks = {}, set[str](), list[str]()
    for name in POINTING:
        value = worded.get(name) if _is_stated(worded.get(name)) else headers.value(name)
        if name not in needed or value is None:
            continue
        if not _is_stated(worded.get(name)):
            of_words.add(name)
        try:
            values[name] = angle(name, value)
        except ValueError:
            advice = f"give --{name.lower()} (deg) to walop-jax gather, or the word that holds it (--words)"
            raise Place(headers.path, "header").fail(f"{value!r} is no angle", name, advice) from None
    if directions := of_words & {"RA", "DEC"}:
        where = headers.stated(min(directions))[0][0]
        frame = frame_of(dict(headers.parts)[where], Place(headers.path, f"header {where}"), mjd)
        if frame == ICRS:
            frame = headers.frame(of_image=True, mjd=mjd)
        if not frame.is_icrs and len(directions) < 2:
            what = f"{min(directions)} of the header is in {frame}"
            raise fail(what, file=headers.path, advice="give --ra and --dec together (deg, ICRS)")
        if not frame.is_icrs:
            ra, dec = frame.to_icrs(values["RA"], values["DEC"])
            values |= {"RA": float(ra), "DEC": float(dec)}
            stated = f"RA {values['RA']:.6g}, DEC {values['DEC']:.6g} deg"
            remarks.append(f"RA and DEC of the header are in {frame}: converted to ICRS, {stated}")
            if "ROTATOR" in of_words:
                remarks.append("ROTATOR of the header is taken to be from the north of ICRS")
    return values, remarks


def centre_of(header: Mapping[str, Any], place: Place, mjd: float = math.nan) -> dict[str, float] | None:
    """RA and DEC of the centre of an image and the position angle of its axis x (deg, ICRS), by its WCS; None: no WCS.

    An image has NAXIS1 and NAXIS2, which a header of a table has not.
    """
    if "CRVAL1" not in header or "NAXIS1" not in header or "NAXIS2" not in header or "XTENSION" in header:
        return None
    if not plane_of(header).has_celestial:
        return None
    from astropy.coordinates import SkyCoord

    middle = [0.5 * (float(header[f"NAXIS{k}"]) + 1.0) for k in (1, 2)]
    ra, dec = sky_of_pixels(header, [middle[0], middle[0] + 1.0], [middle[1]] * 2, 1, place, mjd)
    places: Any = SkyCoord(ra, dec, unit="deg")
    turned = places[0].position_angle(places[1])
    return {"RA": float(ra[0]), "DEC": float(dec[0]), "ROTATOR": float(turned.deg)}


def _is_stated(value: Any) -> bool:
    undefined = value is None or isinstance(value, fits.card.Undefined)
    return not undefined and str(value).strip().lower() not in (*MISSING, "unknown")
