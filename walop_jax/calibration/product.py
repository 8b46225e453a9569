"""The calibration product, `calibration.fits` (PRODVERS = 1): what a fit has learnt, complete in one file.

    PRIMARY      instrument, verdict of the fit, validity (dates, temperatures, filters), versions of the software,
                 hash of the content
    PARAMETERS   NAME, VALUE, SIGMA, UNIT, PRIOR_MEAN, PRIOR_WIDTH, FREE
    COVARIANCE   image, in the order of PARAMETERS; tied and frozen parameters included
    M21 … M33    images of the instrument matrix over the field (filter of MAPFILT, flat photon spectrum,
                 calibration plate out), M21_ERR … M33_ERR their standard errors; linear WCS in degrees
    RESIDUAL…    of a large set: what the smooth model leaves, in cells of the field (see residual_map.py)
    FILTERS      the filter curves that were used          } as in a calibration set
    EXPOSURES    the exposures that went in                }
    SOURCES      the standards, if there were any          }
    MODEL        LINE: the model file of the fit, line by line
    INPUTS       PATH, SHA256 of the calibration sets
    WARNINGS     TEXT: what does not hold

FITS headers and tables hold ASCII only: Greek letters and signs are spelt out when a product is made.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from astropy.io import fits

from walop_jax.calibration.records import (
    MATRIX_NAMES,
    QUALITY_BITS,
    CalibrationProduct,
    MatrixMaps,
    ParameterTable,
    Verdict,
    in_ascii,
)
from walop_jax.calibration.residual_map_file import read_residual_map, residual_hdus
from walop_jax.data import schema
from walop_jax.data.calset import empty_sources
from walop_jax.data.checks import INSTRUMENTS, make_exposures, make_filters, make_sources
from walop_jax.data.frames import read_grid
from walop_jax.data.records import InputFile, Site
from walop_jax.data.schema import Column, Place, read_table
from walop_jax.data.write import filter_columns, grid_cards, sign_and_write, table_hdu
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import DataError, fail, nearest
from walop_jax.io.fits_reading import UNREADABLE, OpenFile, one_line, open_fits

__all__ = [
    "MATRIX_NAMES",
    "PRODVERS",
    "QUALITY_BITS",
    "CalibrationProduct",
    "MatrixMaps",
    "ParameterTable",
    "Verdict",
    "in_ascii",
    "read_product",
    "write_product",
]

PRODVERS = 1
"""Version of the file format that is written, and the newest that is read."""

_RULES: Mapping[str, Mapping[str, Column]] = {
    "PARAMETERS": {
        "NAME": Column("str"),
        "VALUE": Column("float"),
        "SIGMA": Column("float"),
        "UNIT": Column("str"),
        "PRIOR_MEAN": Column("float", missing=float("nan")),
        "PRIOR_WIDTH": Column("float", missing=float("nan")),
        "FREE": Column("bool"),
    },
    "MODEL": {"LINE": Column("str")},
    "INPUTS": {"PATH": Column("str"), "SHA256": Column("str")},
    "WARNINGS": {"TEXT": Column("str")},
    "EXPOSURES": schema.EXPOSURES,
    "FILTERS": schema.FILTERS,
    "SOURCES": schema.SOURCES,
}
_IMAGES = ("COVARIANCE", *MATRIX_NAMES, *(f"{name}_ERR" for name in MATRIX_NAMES))
_LONGEST_SOFTWARE_LIST = 30


# ------------------------------------------------------------------------------------------------- writing


def write_product(
    path: str | os.PathLike[str], product: CalibrationProduct, *, overwrite: bool = False
) -> None:
    """Write a calibration product with checksums; the file appears whole or not at all.

    Raises `DataError` if the file exists and `overwrite` is False, and if the folder is missing or read-only.
    """
    with atomic_path(path, overwrite=overwrite) as temporary:
        sign_and_write(_hdus(product, path), temporary)


def _hdus(product: CalibrationProduct, path: object) -> list[Any]:
    parameters = product.parameters
    tables = {
        "PARAMETERS": {name: getattr(parameters, name.lower()) for name in _RULES["PARAMETERS"]},
        "FILTERS": filter_columns(product.filters),
        "EXPOSURES": {name: getattr(product.exposures, name.lower()) for name in schema.EXPOSURES},
        "MODEL": {"LINE": _strings(product.model)},
    }
    if len(product.sources):
        tables["SOURCES"] = {name: getattr(product.sources, name.lower()) for name in schema.SOURCES}
    if product.inputs:
        paths = _strings(in_ascii(str(entry.path)) for entry in product.inputs)
        tables["INPUTS"] = {"PATH": paths, "SHA256": _strings(entry.sha256 for entry in product.inputs)}
    if product.verdict.warnings:
        tables["WARNINGS"] = {"TEXT": _strings(product.verdict.warnings)}
    made = {name: table_hdu(name, columns, path, _RULES[name]) for name, columns in tables.items()}
    images = [fits.ImageHDU(product.covariance, name="COVARIANCE")]
    for suffix, maps in (("", product.maps.values), ("_ERR", product.maps.errors)):
        for name, image in zip(MATRIX_NAMES, maps, strict=True):
            images.append(fits.ImageHDU(image, name=name + suffix))
            images[-1].header.update(grid_cards(product.maps.grid))
    if product.residuals is not None:
        images += residual_hdus(product.residuals)
    return [_primary(product), made.pop("PARAMETERS"), *images, *made.values()]


def _strings(values: Iterable[str]) -> np.ndarray:
    return np.array(list(values), dtype=np.str_)


def _primary(product: CalibrationProduct) -> fits.PrimaryHDU:
    verdict, site = product.verdict, product.site
    primary = fits.PrimaryHDU()
    cards: dict[str, tuple[Any, str]] = {
        "TELESCOP": (site.telescope, ""),
        "INSTRUME": (product.instrument, ""),
        "PRODVERS": (PRODVERS, "version of the calibration product format"),
        "ORIGIN": (product.origin, ""),
        "CREATOR": ("walop-jax", ""),
        "DATE": (product.date, "UTC, when the product was made"),
        "SITELAT": (site.latitude, "[deg] latitude"),
        "SITELONG": (site.longitude, "[deg] longitude, east positive"),
        "SITEELEV": (site.elevation, "[m] elevation"),
        "TRUSTED": (verdict.trusted, "converged and explains the data"),
        "CONVERGD": (verdict.converged, "the minimum was reached"),
        "CHI2": (verdict.chi2, "chi squared of data and priors"),
        "DOF": (verdict.dof, "degrees of freedom"),
        "NDATA": (verdict.n_data, "intensities used"),
        "NOISESCL": (verdict.noise_scale, "factor on the errors of the data"),
        "QUALITY": (verdict.quality, "bit mask, 0 is good"),
        "COVFROM": (verdict.covariance_from, "what COVARIANCE is of"),
        "MAPFILT": (product.maps.filter, "filter of the maps M21...M33"),
        **{
            f"FIELD{side}": (value, "[deg] extent of the field points used")
            for side, value in zip(("XMI", "XMA", "YMI", "YMA"), product.field, strict=True)
        },
        **_validity(product),
        "CONTHASH": (product.content_hash(), ""),
    }
    for name, (value, comment) in cards.items():
        if isinstance(value, float) and not np.isfinite(value):
            continue  # FITS headers know no NaN; a missing card is read as one
        primary.header[name] = (in_ascii(value) if isinstance(value, str) else value, comment)
    for number, (name, version) in enumerate(product.versions.items(), start=1):
        primary.header[f"SOFT{number}"] = in_ascii(f"{name} {version}")
    return primary


def _validity(product: CalibrationProduct) -> dict[str, tuple[Any, str]]:
    """What the product may be applied to, for a look: EXPOSURES says the same."""
    cards: dict[str, tuple[Any, str]] = {}
    for values, names, comment in (
        (product.exposures.mjd, ("MJD-BEG", "MJD-END"), "[d] UTC of the exposures"),
        (product.exposures.temp, ("TEMPMIN", "TEMPMAX"), "[Celsius] of the exposures"),
    ):
        known = values[np.isfinite(values)]
        if known.size:
            cards |= {names[0]: (float(known.min()), comment), names[1]: (float(known.max()), comment)}
    for number, name in enumerate(np.unique(product.exposures.filter).tolist(), start=1):
        cards[f"FILTER{number}"] = (name, "")
    return cards


# ------------------------------------------------------------------------------------------------- reading


def read_product(path: str | os.PathLike[str]) -> CalibrationProduct:
    """Read and check a calibration product.

    Raises `DataError`, with advice, for a file that is damaged, of another kind, from a newer version of the
    format, or changed since it was written.
    """
    with open_fits(path) as opened:
        try:
            return _from_hdus(opened)
        except DataError:
            raise
        except UNREADABLE as error:
            raise fail(
                f"cannot be read: {one_line(error)}", file=path, advice="make the product again"
            ) from error


def _from_hdus(opened: OpenFile) -> CalibrationProduct:
    path = opened.path
    header = _Header(opened.hdus[0].header, Place(path, "PRIMARY"))
    header.check_version()
    units: dict[str, Any] = {}
    for hdu in opened.hdus[1:]:
        name = hdu.name.strip().upper()
        if name in units:
            raise fail("is there twice", file=path, extension=name, advice="remove one")
        units[name] = hdu

    def table(name: str, *, optional: bool = False) -> dict[str, Any] | None:
        if name in units:
            return read_table(units[name], _RULES[name], Place(path, name))[0]
        if optional:
            return None
        _missing(path, name)

    images = {name: _image(units, name, path) for name in _IMAGES}
    grid = read_grid(units[MATRIX_NAMES[0]].header, Place(path, MATRIX_NAMES[0]))
    shape = (grid.height, grid.width)
    for name in _IMAGES[1:]:
        if images[name].shape != shape or read_grid(units[name].header, Place(path, name)) != grid:
            raise fail(f"does not lie on the grid of {MATRIX_NAMES[0]}", file=path, extension=name)
    maps = MatrixMaps(
        grid=grid,
        filter=header.text("MAPFILT"),
        values=np.stack([images[name] for name in MATRIX_NAMES]),
        errors=np.stack([images[f"{name}_ERR"] for name in MATRIX_NAMES]),
    )
    parameters = _parameters(table("PARAMETERS"), Place(path, "PARAMETERS"))
    _check_covariance(images["COVARIANCE"], parameters, Place(path, "COVARIANCE"))
    site = Site(
        header.text("TELESCOP"), *(header.number(f"SITE{n}", np.nan) for n in ("LAT", "LONG", "ELEV"))
    )
    filters = make_filters(table("FILTERS") or {}, Place(path, "FILTERS"))
    sources, inputs = table("SOURCES", optional=True), table("INPUTS", optional=True)
    warnings, model = table("WARNINGS", optional=True), table("MODEL") or {}
    product = CalibrationProduct(
        instrument=header.instrument(),
        site=site,
        origin=header.text("ORIGIN"),
        date=header.text("DATE"),
        verdict=Verdict(
            chi2=header.number("CHI2"),
            dof=int(header.number("DOF")),
            n_data=int(header.number("NDATA")),
            noise_scale=header.number("NOISESCL"),
            converged=header.flag("CONVERGD"),
            trusted=header.flag("TRUSTED"),
            quality=int(header.number("QUALITY")),
            warnings=() if warnings is None else tuple(warnings["TEXT"].tolist()),
            covariance_from=header.text("COVFROM") or "fit",
        ),
        parameters=parameters,
        covariance=images["COVARIANCE"],
        maps=maps,
        field=(
            header.number("FIELDXMI"), header.number("FIELDXMA"),
            header.number("FIELDYMI"), header.number("FIELDYMA"),
        ),
        exposures=make_exposures(table("EXPOSURES") or {}, filters, site, Place(path, "EXPOSURES")),
        filters=filters,
        sources=empty_sources() if sources is None else make_sources(sources, Place(path, "SOURCES")),
        model=tuple(model["LINE"].tolist()),
        inputs=()
        if inputs is None
        else tuple(InputFile(Path(p), s) for p, s in zip(inputs["PATH"], inputs["SHA256"], strict=True)),
        versions=header.versions(),
        residuals=read_residual_map(units, path),
    )  # fmt: skip
    if header.text("CONTHASH") != product.content_hash():
        raise fail(
            "the content is not what was written",
            file=path,
            extension="PRIMARY",
            column="CONTHASH",
            advice="a product is not edited by hand: fit again, with a model file for what should differ",
        )
    return product


def _missing(path: Path, name: str) -> NoReturn:
    raise fail("the extension is missing", file=path, extension=name, advice="make the product again")


@dataclasses.dataclass(frozen=True)
class _Header:
    """The primary header, read with types."""

    header: Any
    place: Place

    def check_version(self) -> None:
        version = self.header.get("PRODVERS")
        if version is None and "CALVERS" in self.header:
            raise self.place.fail(
                "this is a calibration set, not a calibration product",
                "PRODVERS",
                "run walop-jax refit on it",
            )
        if version is None:
            raise self.place.fail("is missing", "PRODVERS", "is this the calibration.fits of a fit?")
        if isinstance(version, bool) or not isinstance(version, int) or version < 1:
            raise self.place.fail(f"is {version!r}, not a version", "PRODVERS", "make the product again")
        if version > PRODVERS:
            raise self.place.fail(
                f"is {version}, this program reads up to {PRODVERS}",
                "PRODVERS",
                "use a newer walop-jax, or make the product again with this one",
            )

    def number(self, name: str, missing: float | None = None) -> float:
        value = self.header.get(name, missing)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.place.fail(f"is {value!r}, not a number", name, "make the product again")
        return float(value)

    def flag(self, name: str) -> bool:
        value = self.header.get(name)
        if not isinstance(value, bool):
            raise self.place.fail(f"is {value!r}, not T or F", name, "make the product again")
        return value

    def text(self, name: str) -> str:
        return str(self.header.get(name, "")).strip()

    def instrument(self) -> str:
        name = self.text("INSTRUME")
        if name not in INSTRUMENTS:
            raise self.place.fail(f"is {name!r}", "INSTRUME", nearest(name, INSTRUMENTS))
        return name

    def versions(self) -> dict[str, str]:
        found: dict[str, str] = {}
        for number in range(1, _LONGEST_SOFTWARE_LIST):
            name, _, version = self.text(f"SOFT{number}").partition(" ")
            if name:
                found[name] = version
        return found


def _image(units: Mapping[str, Any], name: str, path: Path) -> np.ndarray:
    if name not in units:
        _missing(path, name)
    data = getattr(units[name], "data", None)
    if not isinstance(data, np.ndarray) or data.ndim != 2 or data.dtype.kind not in "fiu":
        raise fail("is not an image with two axes", file=path, extension=name, advice="make it again")
    values = np.ascontiguousarray(data, dtype=np.float64)
    if not np.all(np.isfinite(values)):
        raise fail("is not finite everywhere", file=path, extension=name, advice="make the product again")
    return values


def _parameters(table: dict[str, Any] | None, place: Place) -> ParameterTable:
    assert table is not None
    names = table["NAME"].tolist()
    for name in names:
        if names.count(name) > 1:
            raise place.fail(f"{name!r} is there twice", "NAME", "make the product again")
        if not re.fullmatch(r"[\w.+-]+", name):
            raise place.fail(f"{name!r} is not a parameter name", "NAME", "make the product again")
    for column in ("VALUE", "SIGMA"):
        if not np.all(np.isfinite(table[column])):
            raise place.fail("is not finite everywhere", column, "make the product again")
    return ParameterTable(**{name.lower(): table[name] for name in _RULES["PARAMETERS"]})


def _check_covariance(covariance: np.ndarray, parameters: ParameterTable, place: Place) -> None:
    n = len(parameters)
    if covariance.shape != (n, n):
        raise place.fail(f"has shape {covariance.shape}, there are {n} parameters", "", "make it again")
    variance = np.diag(covariance)
    # Some elements are pure rounding: symmetry counts on the scale of the errors.
    scale = np.sqrt(np.outer(np.abs(variance), np.abs(variance)))
    if np.any(np.abs(covariance - covariance.T) > 1e-9 * scale) or np.any(variance < 0):
        raise place.fail("is not a covariance: not symmetric, or negative variances", "", "make it again")
    if not np.allclose(np.sqrt(variance), parameters.sigma, rtol=1e-6, atol=0):
        raise place.fail("does not agree with SIGMA of PARAMETERS", "", "make the product again")
