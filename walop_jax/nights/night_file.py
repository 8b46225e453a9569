"""The file of nights, `nights.fits`: normal equations that are kept (docs: files).

A row of 127 parameters takes 67 kB. All extensions carry checksums; the file appears whole or not at all.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits

from walop_jax.data.hdus import sign_and_write, table_hdu
from walop_jax.data.schema import Column, read_table
from walop_jax.data.units import Place
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import fail
from walop_jax.io.fits_reading import OpenFile, open_fits
from walop_jax.io.names import NIGHTS
from walop_jax.io.text import in_ascii
from walop_jax.model.parameters import Parameter
from walop_jax.nights.equations import EffectAmplitude, Night

NIGHTVER = 1
_NAN = float("nan")
_AGAIN = "make the nights again and write them anew"
_OF_PARAMETERS = ("START", "PRIOR_MEAN", "PRIOR_WIDTH", "LOOSE", "SCALE")
_PARAMETERS = {
    **dict.fromkeys(("NAME", "UNIT"), Column("str")),
    **dict.fromkeys(_OF_PARAMETERS, Column("float", missing=_NAN)),
    "CANDIDATE": Column("bool"),
}
_NIGHTS = {
    "NIGHT": Column("int"),
    **dict.fromkeys(("MJD_BEG", "MJD_END", "MJD"), Column("float", "d")),
    **dict.fromkeys(("FILTERS", "SOURCE", "SHA256"), Column("str")),
    **dict.fromkeys(("NDATA", "DOF"), Column("int")),
    "CHI2": Column("float"),
    **dict.fromkeys(("REFERENCE", "GRADIENT", "MATRIX"), Column("float", width=None)),
}


_PLAIN = {
    "NIGHT": ("number", int),
    "MJD_BEG": ("begin", float),
    "MJD_END": ("end", float),
    "MJD": ("mjd", float),
    "SOURCE": ("source", str),
    "SHA256": ("sha256", str),
    "NDATA": ("n_data", int),
    "DOF": ("dof", int),
    "CHI2": ("chi2", float),
    "REFERENCE": ("reference", np.asarray),
    "GRADIENT": ("gradient", np.asarray),
}
"""Columns of NIGHTS that hold a field of `Night` as it is, and the field's kind."""


def write_nights(path: str | os.PathLike[str], nights: Sequence[Night], *, overwrite: bool = False) -> None:
    """Write nights of the same parameters to a file, which appears whole or not at all.

    Raises `DataError` if the file exists and `overwrite` is False, and ValueError for nights of different parameters.
    """
    first = nights[0]
    if any(night.names != first.names or night.model != first.model for night in nights):
        raise ValueError("nights of different parameters go into files of their own")
    priors = np.array([p.prior or (_NAN, _NAN) for p in first.parameters]).reshape(-1, 2)
    n, lower = len(first.names), np.tril_indices(len(first.names))
    parameters = {
        "NAME": _texts(first.names),
        "UNIT": _texts(p.unit for p in first.parameters),
        "START": np.array([p.start for p in first.parameters]),
        "PRIOR_MEAN": priors[:, 0],
        "PRIOR_WIDTH": priors[:, 1],
        "LOOSE": np.array([_NAN if p.loose is None else p.loose for p in first.parameters]),
        "SCALE": np.array([p.scale for p in first.parameters]),
        "CANDIDATE": np.arange(n) >= n - first.candidates,
    }
    rows = {
        name: (_texts if kind is str else np.array)([getattr(night, field) for night in nights])
        for name, (field, kind) in _PLAIN.items()
    }
    rows["FILTERS"] = _texts(" ".join(night.filters) for night in nights)
    rows["MATRIX"] = np.stack([night.matrix[lower] for night in nights])
    primary = fits.PrimaryHDU()
    cards = {"INSTRUME": first.instrument, "CREATOR": "walop-jax", "MODEL": first.model}
    primary.header.update(NIGHTVER=NIGHTVER, **cards)
    tables = ("PARAMETERS", parameters, _PARAMETERS), ("NIGHTS", rows, _NIGHTS)
    hdus = [primary, *(table_hdu(name, columns, path, rules) for name, columns, rules in tables)]
    with atomic_path(path, overwrite=overwrite) as temporary:
        sign_and_write(hdus, temporary)


def _texts(values: Iterable[str]) -> np.ndarray:
    return np.array([in_ascii(str(value)) for value in values], dtype=np.str_)


def read_nights(path: str | os.PathLike[str]) -> list[Night]:
    """The nights of a file. Raises `DataError`, with advice, for one that is damaged, of another kind, or newer."""
    with open_fits(path, _AGAIN) as opened:
        return _nights(opened)


def _nights(opened: OpenFile) -> list[Night]:
    path, header = opened.path, opened.hdus[0].header
    version = header.get("NIGHTVER")
    if not isinstance(version, int) or isinstance(version, bool):
        raise fail("is no file of nights", file=path, column="NIGHTVER", advice=_AGAIN)
    if version > NIGHTVER:
        raise fail(f"is of version {version}, newer than this program", file=path, advice="update walop-jax")
    hdus = {hdu.name.strip().upper(): hdu for hdu in opened.hdus[1:]}
    for name in ("PARAMETERS", "NIGHTS"):
        if name not in hdus:
            raise fail("the extension is missing", file=path, extension=name, advice=_AGAIN)
    table, _ = read_table(hdus["PARAMETERS"], _PARAMETERS, Place(path, "PARAMETERS"))
    rows, _ = read_table(hdus["NIGHTS"], _NIGHTS, Place(path, "NIGHTS"))
    n = len(table["NAME"])
    for name, width in (("REFERENCE", n), ("GRADIENT", n), ("MATRIX", n * (n + 1) // 2)):
        if rows[name].shape[1] != width or not np.isfinite(rows[name]).all():
            what = f"is not {width} finite numbers a row"
            raise fail(what, file=path, extension="NIGHTS", column=name, advice=_AGAIN)
    numbers, parameters = (table[name].tolist() for name in _OF_PARAMETERS), []
    entries = zip(table["NAME"], table["UNIT"], *numbers, table["CANDIDATE"], strict=True)
    for name, unit, start, mean, width, loose, scale, candidate in entries:
        texts = {
            "name": str(name),
            "unit": str(unit),
            "about": "",
            "source": "",
            "part": str(name).partition(".")[0],
        }
        limits = {
            "prior": None if np.isnan(width) else (mean, width),
            "loose": None if np.isnan(loose) else loose,
        }
        p = Parameter(**texts, start=start, scale=scale, **limits)
        # Candidates that start elsewhere are gauges of the model.
        parameters.append(EffectAmplitude.read(p) if candidate and start == 0.0 else p)
    lower, nights = np.tril_indices(n), []
    for k in range(len(rows["NIGHT"])):
        matrix = np.zeros((n, n))
        matrix[lower] = rows["MATRIX"][k]
        matrix = matrix + np.tril(matrix, -1).T
        nights.append(
            Night(
                instrument=str(header.get("INSTRUME", "")),
                model=str(header.get("MODEL", "")),
                filters=tuple(str(rows["FILTERS"][k]).split()),
                parameters=tuple(parameters),
                candidates=int(table["CANDIDATE"].sum()),
                matrix=matrix,
                **{field: kind(rows[name][k]) for name, (field, kind) in _PLAIN.items()},
            )
        )
    return nights


def nights_in(place: str | os.PathLike[str]) -> list[Night]:
    """The nights of a file, or of all files of a folder (RUN, or a folder of night files). `DataError` for none."""
    path = Path(place)
    if not path.is_dir():
        return read_nights(path)
    files = [path / NIGHTS] if (path / NIGHTS).exists() else sorted(path.glob("night*.fits"))
    if not files:
        raise fail("holds no nights", file=place, advice="give sets, RUNs of walop-jax refit or a SURVEY")
    return [night for file in files for night in read_nights(file)]
