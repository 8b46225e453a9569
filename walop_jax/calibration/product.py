"""The calibration product, `calibration.fits`: what a fit has learnt, complete in one file.

    PRIMARY      instrument, verdict of the fit, validity (dates, temperatures, filters), versions of the software,
                 hash of the content
    PARAMETERS   NAME, VALUE, SIGMA, UNIT, PRIOR_MEAN, PRIOR_WIDTH, FREE
    COVARIANCE   image, in the order of PARAMETERS; tied and frozen parameters included
    M21 … M33    images of the instrument matrix over the field (filter of MAPFILT, flat photon spectrum,
                 calibration plate out), M21_ERR … M33_ERR their standard errors; linear WCS in degrees; three for
                 each arm of the instrument, further moving elements at ANGLE1, … of the elements ELEM1, …
    RESIDUAL…    of a large set: what the smooth model leaves, in cells of the field (see residual_map.py)
    FILTERS      the filter curves that were used          } as in a calibration set
    EXPOSURES    the exposures that went in                }
    SOURCES      the standards, if there were any          }
    MODEL        LINE: the model file of the fit, line by line
    INSTRUMENT   LINE: the description file of an instrument that does not come with the package
    INPUTS       PATH, SHA256 of the calibration sets
    WARNINGS     TEXT: what does not hold

PRODVERS is 2 for an instrument that is none of the first three or has not two arms, for further moving elements and
for lamps, otherwise 1. FITS headers and tables hold ASCII only: Greek letters and signs are spelt out when a product
is made.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from astropy.io import fits

from walop_jax.calibration.product_header import (
    PRODVERS,
    ProductHeader,
    position_cards,
    primary_hdu,
    product_version,
    read_positions,
)
from walop_jax.calibration.records import (
    CalibrationProduct,
    MatrixMaps,
    ParameterTable,
    Verdict,
    in_ascii,
    matrix_names,
)
from walop_jax.calibration.residual_map_file import read_residual_map, residual_hdus
from walop_jax.data import schema
from walop_jax.data.calset import empty_sources
from walop_jax.data.checks import instrument_name, make_exposures, make_filters, make_sources
from walop_jax.data.frames import read_grid
from walop_jax.data.records import InputFile, Site
from walop_jax.data.schema import Column, Place, column_names, read_table, table_rules
from walop_jax.data.write import exposures_hdu, filter_columns, grid_cards, sign_and_write, table_hdu
from walop_jax.fit.verdict import Hidden, Structure
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import DataError, fail
from walop_jax.io.fits_reading import UNREADABLE, OpenFile, one_line, open_fits
from walop_jax.likelihood.expansion import STATED
from walop_jax.model.parameters import NAME

__all__ = [
    "PRODVERS",
    "CalibrationProduct",
    "MatrixMaps",
    "ParameterTable",
    "Verdict",
    "in_ascii",
    "read_product",
    "write_product",
]

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
    "INSTRUMENT": {"LINE": Column("str")},
    "INPUTS": {"PATH": Column("str"), "SHA256": Column("str")},
    "WARNINGS": {"TEXT": Column("str")},
    "FILTERS": schema.FILTERS,
    "SOURCES": schema.SOURCES,
}
_MATRIX_IMAGE = re.compile(r"M([1-9][0-9]{0,2})[123](_ERR)?")


# ------------------------------------------------------------------------------------------------- writing


def write_product(
    path: str | os.PathLike[str], product: CalibrationProduct, *, overwrite: bool = False
) -> None:
    """Write a calibration product with checksums; the file appears whole or not at all.

    Raises `DataError` if the file exists and `overwrite` is False, if the folder is missing or read-only, and for a
    parameter whose name could not be read again.
    """
    with atomic_path(path, overwrite=overwrite) as temporary:
        sign_and_write(_hdus(product, path), temporary)


def _hdus(product: CalibrationProduct, path: object) -> list[Any]:
    parameters = product.parameters
    for name in parameters.name.tolist():
        if not NAME.fullmatch(name):
            raise fail(f"{name!r} is not a parameter name", file=path, extension="PARAMETERS", column="NAME")
    tables = {
        "PARAMETERS": {name: getattr(parameters, name.lower()) for name in _RULES["PARAMETERS"]},
        "FILTERS": filter_columns(product.filters),
        "MODEL": {"LINE": _strings(product.model)},
    }
    if product.description:
        tables["INSTRUMENT"] = {"LINE": _strings(product.description)}
    if len(product.sources):
        tables["SOURCES"] = {name: getattr(product.sources, name.lower()) for name in schema.SOURCES}
    if product.inputs:
        paths = _strings(in_ascii(str(entry.path)) for entry in product.inputs)
        tables["INPUTS"] = {"PATH": paths, "SHA256": _strings(entry.sha256 for entry in product.inputs)}
    if product.verdict.warnings:
        tables["WARNINGS"] = {"TEXT": _strings(product.verdict.warnings)}
    made = {name: table_hdu(name, columns, path, _RULES[name]) for name, columns in tables.items()}
    version = product_version(product)
    instrument_name(product.instrument, version, Place(path, "PRIMARY"))
    exposures = exposures_hdu(product.exposures, version, path)
    images = [fits.ImageHDU(product.covariance, name="COVARIANCE")]
    if product.hidden is not None:
        images.append(_hidden_hdu(product.hidden))
    for suffix, maps in (("", product.maps.values), ("_ERR", product.maps.errors)):
        for name, image in zip(product.maps.names, maps, strict=True):
            images.append(fits.ImageHDU(image, name=name + suffix))
            images[-1].header.update(grid_cards(product.maps.grid) | position_cards(product.maps.positions))
    if product.residuals is not None:
        images += residual_hdus(product.residuals)
    parameters_hdu, filters = made.pop("PARAMETERS"), made.pop("FILTERS")
    primary = primary_hdu(product, version)
    return [primary, parameters_hdu, *images, filters, exposures, *made.values()]


def _hidden_hdu(hidden: Hidden) -> Any:
    """An image (mistake, parameter) of what each mistake does to the parameters; no data where there is none."""
    hdu = fits.ImageHDU(hidden.changes if len(hidden) else None, name="HIDDEN")
    for number, (name, size, unit) in enumerate(
        zip(hidden.names, hidden.sizes, hidden.units, strict=True), start=1
    ):
        hdu.header[f"HIDE{number}"] = in_ascii(name)
        hdu.header[f"SIZE{number}"] = size
        hdu.header[f"UNIT{number}"] = in_ascii(unit)
    return hdu


def _read_hidden(units: Mapping[str, Any], parameters: int, path: Path) -> Hidden | None:
    """The mistakes of the extension HIDDEN; None in products that nobody asked for them."""
    if "HIDDEN" not in units:
        return None
    header, place = units["HIDDEN"].header, Place(path, "HIDDEN")
    names, sizes, kept = [], [], []
    while (number := len(names) + 1) and f"HIDE{number}" in header:
        size = header.get(f"SIZE{number}")
        if isinstance(size, bool) or not isinstance(size, int | float):
            raise place.fail(f"is {size!r}, not a number", f"SIZE{number}", "make the product again")
        names.append(str(header[f"HIDE{number}"]))
        sizes.append(float(size))
        kept.append(str(header.get(f"UNIT{number}", "")))
    changes = _image(units, "HIDDEN", path) if names else np.zeros((0, parameters))
    if changes.shape != (len(names), parameters):
        raise place.fail(
            f"has shape {changes.shape}, not {(len(names), parameters)}", advice="make the product again"
        )
    return Hidden(tuple(names), tuple(sizes), tuple(kept), changes)


def _strings(values: Iterable[str]) -> np.ndarray:
    return np.array(list(values), dtype=np.str_)


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
    header = ProductHeader(opened.hdus[0].header, Place(path, "PRIMARY"))
    version = header.version()
    units: dict[str, Any] = {}
    for hdu in opened.hdus[1:]:
        name = hdu.name.strip().upper()
        if name in units:
            raise fail("is there twice", file=path, extension=name, advice="remove one")
        units[name] = hdu

    def table(name: str, *, optional: bool = False) -> dict[str, Any] | None:
        if name in units:
            place = Place(path, name)
            rules = _RULES.get(name) or table_rules(name, version, column_names(units[name], place), place)
            return read_table(units[name], rules, place)[0]
        if optional:
            return None
        _missing(path, name)

    covariance = _image(units, "COVARIANCE", path)
    maps = _maps(units, header.text("MAPFILT"), version, path)
    parameters = _parameters(table("PARAMETERS"), Place(path, "PARAMETERS"))
    _check_covariance(covariance, parameters, Place(path, "COVARIANCE"))
    site = Site(
        header.text("TELESCOP"), *(header.number(f"SITE{n}", np.nan) for n in ("LAT", "LONG", "ELEV"))
    )
    filters = make_filters(table("FILTERS") or {}, Place(path, "FILTERS"))
    sources, inputs = table("SOURCES", optional=True), table("INPUTS", optional=True)
    warnings, model = table("WARNINGS", optional=True), table("MODEL") or {}
    description = table("INSTRUMENT", optional=True)
    product = CalibrationProduct(
        instrument=header.instrument(version),
        site=site,
        origin=header.text("ORIGIN"),
        date=header.text("DATE"),
        verdict=Verdict.recorded(
            chi2=header.number("CHI2"),
            dof=int(header.number("DOF")),
            n_data=int(header.number("NDATA")),
            noise_scale=header.number("NOISESCL"),
            converged=header.flag("CONVERGD"),
            trusted=header.flag("TRUSTED"),
            quality=int(header.number("QUALITY")),
            warnings=() if warnings is None else tuple(warnings["TEXT"].tolist()),
            covariance_from=header.text("COVFROM") or "fit",
            errors_from=header.text("ERRFROM") or STATED,
            structure=Structure(header.number("STRUCTG", 0.0), header.number("STRUCTR", 0.0)),
        ),
        parameters=parameters,
        covariance=covariance,
        maps=maps,
        field=(
            header.number("FIELDXMI"), header.number("FIELDXMA"),
            header.number("FIELDYMI"), header.number("FIELDYMA"),
        ),
        exposures=make_exposures(
            table("EXPOSURES") or {}, filters, site, Place(path, "EXPOSURES"), version=version, kinds=None
        ),
        filters=filters,
        sources=empty_sources() if sources is None else make_sources(sources, Place(path, "SOURCES")),
        model=tuple(model["LINE"].tolist()),
        inputs=()
        if inputs is None
        else tuple(InputFile(Path(p), s) for p, s in zip(inputs["PATH"], inputs["SHA256"], strict=True)),
        versions=header.versions(),
        residuals=read_residual_map(units, maps.arms, path),
        description=() if description is None else tuple(description["LINE"].tolist()),
        hidden=_read_hidden(units, len(parameters), path),
    )  # fmt: skip
    if header.text("CONTHASH") not in (product.content_hash(), product.content_hash(every_column=False)):
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


def _maps(units: Mapping[str, Any], filter_name: str, version: int, path: Path) -> MatrixMaps:
    """The maps of the matrix: of two arms in version 1, of as many as there are images later on."""
    found = [int(match[1]) for name in units if (match := _MATRIX_IMAGE.fullmatch(name))]
    names = matrix_names(2 if version == 1 else max([1, *(row - 1 for row in found)]))
    errors = tuple(f"{name}_ERR" for name in names)
    images = {name: _image(units, name, path) for name in (*names, *errors)}
    grid = read_grid(units[names[0]].header, Place(path, names[0]))
    for name, image in images.items():
        same = image.shape == (grid.height, grid.width)
        if not same or read_grid(units[name].header, Place(path, name)) != grid:
            raise fail(f"does not lie on the grid of {names[0]}", file=path, extension=name)
    return MatrixMaps(
        grid=grid,
        filter=filter_name,
        values=np.stack([images[name] for name in names]),
        errors=np.stack([images[name] for name in errors]),
        positions=read_positions(units[names[0]].header, Place(path, names[0])),
    )


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
        if not NAME.fullmatch(name):
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
