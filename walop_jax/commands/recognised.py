"""What is given beside a calibration: calibration sets or catalogues of stars, known by their content."""

from __future__ import annotations

import contextlib
import json
import os
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from walop_jax.commands.tables import table_of
from walop_jax.io.errors import DataError, fail

if TYPE_CHECKING:
    from walop_jax.data.user_tables import InputTable

NEITHER = "neither a calibration set nor a catalogue of stars"
LOOKED_AT = 100_000  # bytes of a file that is no table
WANTED = "give calibration sets (FITS with EXPOSURES), or catalogues of stars with X, Y, N and N_ERR"


FLUXES = frozenset({"FLUX_AUTO", "FLUX_APER", "FLUX_PSF", "FLUX_ISO", "FLUX", "APERTURE_SUM", "FLUX_FIT"})
ONE_CAMERA = "walop-jax gather O1 E1 O2 E2 -o STARS.fits makes one catalogue of those of all four"


class StarTable(NamedTuple):
    """A catalogue of stars with the name by which messages call it."""

    name: str
    table: InputTable


class Inputs(NamedTuple):
    """Calibration sets (paths, or sets in memory) and catalogues of stars, each in the order in which they came."""

    sets: Sequence[Any]
    stars: Sequence[StarTable]


def recognised(given: Sequence[Any], cameras: Sequence[str]) -> Inputs:
    """Sets and catalogues (with counts of `cameras`) among what was given, whatever the names of the files are.

    Raises `DataError`, naming every file that is neither, with what it is and where that is wanted.
    """
    from walop_jax import CalibrationSet

    sets, stars, faults = [], [], []
    for number, entry in enumerate(given, start=1):
        try:
            if isinstance(entry, CalibrationSet) or (_is_path(entry) and _is_set(Path(entry))):
                sets.append(entry)
            else:
                name = str(entry) if _is_path(entry) else f"catalogue {number}"
                stars.append(StarTable(name, _stars(entry, name, cameras)))
        except DataError as error:
            faults.append(str(error))
    if faults:
        raise DataError("; ".join(faults))
    return Inputs(sets, stars)


def _is_path(given: Any) -> bool:
    return isinstance(given, str | os.PathLike)


def _is_set(path: Path) -> bool:
    """True for a calibration set; `DataError` for what is another product of this package."""
    from walop_jax.io.fits_reading import primary_keywords

    if path.is_dir():
        what = f"is a folder, {NEITHER}"
        raise fail(what, file=path, advice="give a RUN first, and the RUN that it replaces with --against")
    if not path.exists() and str(path).endswith("]"):
        return False  # a table of a file, FILE.fits[NAME]
    keywords = primary_keywords(path)
    if "PRODVERS" in keywords:
        what = f"is a calibration, {NEITHER}"
        raise fail(
            what, file=path, advice="give it first, or with --against if it is the one that was replaced"
        )
    return "CALVERS" in keywords or _has_exposures(path, keywords)


def _has_exposures(path: Path, keywords: Sequence[str]) -> bool:
    """True for a FITS file with exposures: a set, if a damaged one, of which its reader says what is wrong."""
    from walop_jax.io.fits_reading import open_fits

    if not keywords:
        return False
    with open_fits(path) as opened:
        return any(hdu.name == "EXPOSURES" for hdu in opened.hdus)


def _stars(given: Any, name: str, cameras: Sequence[str]) -> InputTable:
    """A table that has counts of cameras; `DataError` for anything else."""
    from walop_jax.data.user_tables import spellings

    try:
        table = table_of(given, {})
    except DataError as error:
        if not _is_path(given) or not Path(given).is_file():
            raise
        known = _other_file(Path(given))
        if known is None:
            raise DataError(f"{error}; it is no calibration set either (FITS with EXPOSURES)") from None
        what, advice = known
        raise fail(f"is {what}, {NEITHER}", file=name, advice=advice) from error
    if not any(set(form) & set(table.names) for form in spellings("N", len(cameras), cameras)):
        what = f"holds {_content(table)}: it is {NEITHER}"
        raise fail(what, file=name, advice=_advice(table))
    return table


def _other_file(path: Path) -> tuple[str, str] | None:
    """What a file is that is no table, by its content, with advice; None where that is not known."""
    if _of_one_camera(path):
        return "the catalogue of a single camera", ONE_CAMERA
    with path.open("rb") as stream:
        content = stream.read(LOOKED_AT)
    begin = content.lstrip()[:15].lower()
    if begin.startswith((b"\x89png", b"%pdf", b"<!doctype html", b"<svg")):
        return "a page or a picture", WANTED
    with contextlib.suppress(ValueError):  # also bytes that are no text
        if begin.startswith((b"{", b"[")) and isinstance(json.loads(path.read_bytes()), dict | list):
            return "a JSON document, such as the truth of a simulation", WANTED
        if tomllib.loads(content.decode()):
            return "a TOML file, such as a plan or a model", f"walop-jax limits asks a plan; here {WANTED}"
    return None


def _of_one_camera(path: Path) -> bool:
    """True for a FITS file with fluxes of sources, as SExtractor writes it beside the header of the image."""
    from walop_jax.io.fits_reading import open_fits, primary_keywords

    if not path.is_file() or not primary_keywords(path):
        return False
    with open_fits(path) as opened:
        tables = (hdu for hdu in opened.hdus if type(hdu).__name__ == "BinTableHDU")
        return any(FLUXES & {name.upper() for name in hdu.columns.names} for hdu in tables)


def _content(table: InputTable) -> str:
    shown = ", ".join(table.names[:6])
    return f"the columns {shown}{', …' if len(table.names) > 6 else ''}, and no counts of the cameras (N)"


def _advice(table: InputTable) -> str:
    names = set(table.names)
    if names & FLUXES:
        return ONE_CAMERA
    if {"KIND", "CLP_ANGLE"} & names:
        return "a table of exposures: walop-jax exposures says how a set is made of it"
    if {"Q", "U"} <= names:
        return "results without the counts that they were made of: give the table that apply has read, or written"
    if {"CALHASH", "CHI2DOF"} <= names:
        return "a table of nights: rows are added to it with --append"
    return WANTED
