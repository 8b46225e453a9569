"""The extension COMPRESSION: of a calibration set that stands for the pixels of whole frames, what they were.

A table NAME, VALUE of the model's parameters at which the pixels were summed; in its header NPIXELS, CHI2 and DOF of
the pixels there, and the frames, FILE1, SHA1, …; STRUCTG and STRUCTR, by how much single pixels differ (docs: files).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from walop_jax.data.records import Compression, InputFile
from walop_jax.data.schema import Place

EXTENSION = "COMPRESSION"


def compression_hdu(found: Compression) -> fits.BinTableHDU:
    """The extension of a record."""
    names = np.array(list(found.values), dtype="U")
    hdu = fits.BinTableHDU.from_columns(
        [
            fits.Column(name="NAME", format=f"{max(1, names.dtype.itemsize // 4)}A", array=names),
            fits.Column(name="VALUE", format="D", array=np.array(list(found.values.values()))),
        ],
        name=EXTENSION,
    )
    hdu.header["NPIXELS"] = (found.pixels, "pixels that the field points stand for")
    hdu.header["CHI2"] = (found.chi2, "chi-square of the pixels at these values")
    hdu.header["DOF"] = (found.dof, "its degrees of freedom")
    if found.gain is not None and found.response is not None:
        hdu.header["STRUCTG"] = (found.gain, "rms gain of a camera at a pixel")
        hdu.header["STRUCTR"] = (found.response, "rms response of a camera to q, u there")
    for number, entry in enumerate(found.frames, start=1):
        hdu.header[f"FILE{number}"] = str(entry.path.name)
        hdu.header[f"SHA{number}"] = entry.sha256
    return hdu


def read_compression(hdu: Any, path: Path) -> Compression:
    """The record of an extension; `DataError` for one that lacks something."""
    place, header = Place(path, EXTENSION), hdu.header
    for name in ("NPIXELS", "CHI2", "DOF"):
        if not isinstance(header.get(name), int | float) or isinstance(header.get(name), bool):
            raise place.fail("is missing or no number", name, "compress the frames again")
    names = [name.upper() for name in getattr(getattr(hdu, "columns", None), "names", [])]
    if sorted(names) != ["NAME", "VALUE"]:
        raise place.fail("has not the columns NAME and VALUE", advice="compress the frames again")
    values = np.asarray(hdu.data["VALUE"], float)
    if not np.isfinite(values).all():
        raise place.fail("is not finite", "VALUE", "compress the frames again")
    frames = []
    while f"SHA{len(frames) + 1}" in header:
        number = len(frames) + 1
        frames.append(InputFile(Path(str(header.get(f"FILE{number}", ""))), str(header[f"SHA{number}"])))
    return Compression(
        pixels=int(header["NPIXELS"]),
        chi2=float(header["CHI2"]),
        dof=int(header["DOF"]),
        values={
            str(name).strip(): float(value) for name, value in zip(hdu.data["NAME"], values, strict=True)
        },
        frames=tuple(frames),
        gain=_asked(header, "STRUCTG"),
        response=_asked(header, "STRUCTR"),
    )


def _asked(header: Any, name: str) -> float | None:
    """A number of the header; None where it is missing."""
    value = header.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def remark(found: Compression, points: int) -> str:
    """What to bear in mind with a set that stands for pixels."""
    return (
        f"{points} field points stand for {found.pixels:,} pixels, of which χ²/dof was "
        f"{found.chi2 / max(found.dof, 1):.5g}: what is smaller than a twentieth of the field is not seen here"
    )
