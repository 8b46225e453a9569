"""The file of a calibration, `calibration.fits`: the result of a fit, complete in one file (docs: files).

Of an instrument with A arms RESIDUAL has 4 A − 1 planes. Moving elements ELEM1, … of a map stand at ANGLE1, … PRODVERS
is 2 for an instrument that is none of the first three or has not two arms, for further moving elements and for lamps,
otherwise 1. FITS headers and tables hold ASCII only: Greek letters and signs are spelt out.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from astropy.io import fits
from jaxtyping import Float

from walop_jax.calibration.calibration import (
    UNCHECKED,
    Calibration,
    UnavailableInstrument,
    Written,
    built_model,
)
from walop_jax.calibration.matrix import MatrixMaps, ResidualMap, matrix_names, residual_names
from walop_jax.data import schema
from walop_jax.data.checks import instrument_name, make_exposures, make_filters, make_sources
from walop_jax.data.grid import Grid, grid_cards, read_grid
from walop_jax.data.hdus import filter_columns, set_table_hdu, sign_and_write, table_hdu
from walop_jax.data.kinds import CALIBRATION_PLATE, PREFIX
from walop_jax.data.records import InputFile, Site, Sources
from walop_jax.data.schema import Column, column_names, read_table, table_rules
from walop_jax.data.units import Place
from walop_jax.fit.verdict import STATED, Hidden, Structure, UndetectedError, Verdict
from walop_jax.instruments.description import shipped
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import PathLike, errors_naming, fail
from walop_jax.io.fits_reading import OpenFile, open_fits
from walop_jax.io.names import PRODUCT
from walop_jax.io.text import in_ascii
from walop_jax.model.effects import EFFECTS, EffectKind
from walop_jax.model.parameters import NAME, Parameter
from walop_jax.model.specification import Model
from walop_jax.model.standards import standards_of

HASHRULE = 2
"""Rule of CONTHASH; that of earlier products, without this word, left words of the headers aside."""
PRODVERS = 2
"""Newest version of the format; a product is written in the oldest version that can hold it."""

TABLES: Mapping[str, Mapping[str, Column]] = {
    "PARAMETERS": {
        "NAME": Column("str"),
        "VALUE": Column("float"),
        "SIGMA": Column("float"),
        "UNIT": Column("str"),
        "PRIOR_MEAN": Column("float", missing=float("nan")),
        "PRIOR_WIDTH": Column("float", missing=float("nan")),
        "FREE": Column("bool"),
    },
    "FILTERS": schema.FILTERS,
    "MODEL": {"LINE": Column("str")},
    "INSTRUMENT": {"LINE": Column("str")},
    "SOURCES": schema.SOURCES,
    "INPUTS": {"PATH": Column("str"), "SHA256": Column("str")},
    "WARNINGS": {"TEXT": Column("str")},
}
"""Tables and their columns, EXPOSURES apart, whose columns depend on the instrument."""

_RESIDUALS = {"RESIDUAL": "values", "RESIDUAL_ERR": "errors", "RESIDUAL_CHI2": "chi2"}
_WORDS_OF_HIDDEN = dict(
    zip(UndetectedError._fields, ("HIDE", "SIZE", "UNIT", "HKIND", "CURE", "ACTS", "SEEN"), strict=True)
)
"""Numbered words of HIDDEN by the field of `UndetectedError` that each one is."""
_FIELD = ("FIELDXMI", "FIELDXMA", "FIELDYMI", "FIELDYMA")
_FIRST_KINDS = ("clp", "moon", "standard", "flux")  # of version 1
_MATRIX_IMAGE = re.compile(r"M([1-9][0-9]{0,2})[123](_ERR)?")
_LONGEST_SOFTWARE_LIST = 30
_EXTENSIONS = re.compile(
    f"PRIMARY|EXPOSURES|COVARIANCE|HIDDEN|{_MATRIX_IMAGE.pattern}|{'|'.join((*TABLES, *_RESIDUALS))}"
)
_WORDS = re.compile(
    "TELESCOP|INSTRUME|(PROD|CAL)VERS|ORIGIN|SITE(LAT|LONG|ELEV)|TRUSTED|CONVERGD|CHI2|DOF|NDATA|NOISESCL|QUALITY|"
    r"COVFROM|ERRFROM|STRUCT[GR]|MAPFILT|FIELD[XY]M[AI]|MJD-(BEG|END)|TEMPM(IN|AX)|FILTER\d*|HASHRULE|"
    r"(CTYPE|CUNIT|CRPIX|CRVAL|CDELT|CROTA|ELEM|ANGLE|PLANE|HIDE|SIZE|UNIT|HKIND|CURE|ACTS|SEEN|TUNIT|TNULL)\d+|"
    r"(CD|PC)\d_\d|CHWPANG"
)
"""Words of headers that CONTHASH covers: all that are read, but for structure (FITS), date and software."""
_AGAIN = "make the product again"
_NEWER = "use a newer walop-jax, or make the product again with this one"


class Validity(NamedTuple):
    """Range of application of a calibration: MJD of its exposures, their filters, their temperatures (Celsius)."""

    mjd: tuple[float, float]
    filters: tuple[str, ...]
    temperature: tuple[float, float]


def validity(calibration: Calibration) -> Validity:
    """Dates, filters and temperatures of the exposures that a calibration was made from; NaN where none are known."""
    e = calibration.exposures
    return Validity(_range(e.mjd), tuple(np.unique(e.filter).tolist()), _range(e.temp))


def _range(values: Float[np.ndarray, " e"]) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else (float("nan"), float("nan"))


# ------------------------------------------------------------------------------------------------- writing


def write_calibration(path: PathLike, calibration: Calibration, *, overwrite: bool = False) -> None:
    """Write a calibration, with checksums; the file appears whole or not at all.

    Raises `DataError` if the file exists and `overwrite` is False, and if the folder is missing or read-only.
    """
    hdus = hdus_of(calibration, path)
    hdus[0].header["CONTHASH"] = content_of(hdus)
    with atomic_path(path, overwrite=overwrite) as temporary:
        sign_and_write(hdus, temporary)


def content_of(hdus: Iterable[Any]) -> str:
    """SHA-256 of words, columns, images, extensions in any order; not of dates, software, paths, additions."""
    digest = hashlib.sha256()
    for name, hdu in sorted(((hdu.name.strip().upper(), hdu) for hdu in hdus), key=lambda pair: pair[0]):
        if not _EXTENSIONS.fullmatch(name):
            continue
        digest.update(f"{name}\n".encode())
        for card in hdu.header.cards:
            if _WORDS.fullmatch(card.keyword):
                held: Any = fits.Card.fromstring(card.image)  # a header may not hold all digits of a number
                digest.update(f"{card.keyword} {held.value!r}\n".encode())
        if hdu.data is None:
            continue
        for column in hdu.data.dtype.names or ("",):
            values = np.asarray(hdu.data[column] if column else hdu.data)
            digest.update(f"{column} {values.shape}\n".encode())
            if (name, column) == ("INPUTS", "PATH"):
                continue
            if values.dtype.kind in "SU":
                digest.update("\n".join(values.astype(str).ravel().tolist()).encode())
            else:
                digest.update(values.astype("<f8" if values.dtype.kind == "f" else "<i8").tobytes())
    return digest.hexdigest()


def hdus_of(c: Calibration, path: object) -> list[Any]:
    """The extensions of a file, as they are written but for CONTHASH; `path` is for messages."""
    tables = {
        "PARAMETERS": _parameter_columns(c),
        "FILTERS": filter_columns(c.filters),
        "MODEL": {"LINE": _strings(c.model_lines)},
        "INSTRUMENT": {"LINE": _strings(c.description)},
        "SOURCES": c.sources.columns(),
        "INPUTS": {
            "PATH": _strings(in_ascii(str(entry.path)) for entry in c.inputs),
            "SHA256": _strings(entry.sha256 for entry in c.inputs),
        },
        "WARNINGS": {"TEXT": _strings(in_ascii(text) for text in c.verdict.warnings)},
    }
    hdus = {
        name: table_hdu(name, columns, path, TABLES[name])
        for name, columns in tables.items()
        if len(next(iter(columns.values())))
    }
    instrument_name(c.instrument, Place(path, "PRIMARY"))
    images = [fits.ImageHDU(c.covariance, name="COVARIANCE")]
    for suffix, planes in (("", c.maps.values), ("_ERR", c.maps.errors)):
        for name, image in zip(c.maps.names, planes, strict=True):
            images.append(_map_hdu(name + suffix, image, c.maps))
    if c.residuals is not None:
        images += _residual_hdus(c.residuals)
    if c.hidden is not None:
        images.append(_hidden_hdu(c.hidden))
    parameters, filters = hdus.pop("PARAMETERS"), hdus.pop("FILTERS")
    exposures = set_table_hdu("EXPOSURES", c.exposures.columns(), path)
    return [_primary(c), parameters, *images, filters, exposures, *hdus.values()]


def _parameter_columns(c: Calibration) -> dict[str, np.ndarray]:
    """The columns of PARAMETERS, priors NaN where there are none."""
    priors = np.array([p.prior or (np.nan, np.nan) for p in c.parameters]).reshape(-1, 2)
    return {
        "NAME": np.array(c.names),
        "VALUE": np.asarray(c.values),
        "SIGMA": c.sigma,
        "UNIT": np.array([p.unit for p in c.parameters]),
        "PRIOR_MEAN": priors[:, 0],
        "PRIOR_WIDTH": priors[:, 1],
        "FREE": np.array([p.free and p.tie is None for p in c.parameters]),
    }


def _strings(values: Iterable[str]) -> np.ndarray:
    return np.array(list(values), dtype=np.str_)


def _primary(c: Calibration) -> fits.PrimaryHDU:
    """The primary header: verdict, validity, software, content hash."""
    verdict, structure, span = c.verdict, c.verdict.structure, validity(c)
    newer = c.maps.arms != 2 or c.maps.positions or c.exposures.further or c.instrument not in shipped()
    version = 1 if not newer and np.isin(c.exposures.kind, _FIRST_KINDS).all() else PRODVERS
    cards: dict[str, tuple[Any, str]] = {
        "TELESCOP": (c.site.telescope, ""),
        "INSTRUME": (c.instrument, ""),
        "PRODVERS": (version, "version of the calibration product format"),
        "ORIGIN": (c.origin, ""),
        "CREATOR": ("walop-jax", ""),
        "DATE": (c.date, "UTC, when the product was made"),
        "SITELAT": (c.site.latitude, "[deg] latitude"),
        "SITELONG": (c.site.longitude, "[deg] longitude, east positive"),
        "SITEELEV": (c.site.elevation, "[m] elevation"),
        "TRUSTED": (verdict.trusted, "converged and explains the data"),
        "CONVERGD": (verdict.converged, "the minimum was reached"),
        "CHI2": (verdict.chi2, "chi squared of data and priors"),
        "DOF": (verdict.dof, "degrees of freedom"),
        "NDATA": (verdict.n_data, "intensities used"),
        "NOISESCL": (verdict.noise_scale, "factor on the errors of the data"),
        "QUALITY": (int(verdict.quality), "bit mask, 0 is good"),
        "COVFROM": (verdict.covariance_from, "what COVARIANCE is of"),
        "ERRFROM": (verdict.errors_from, ""),
        "STRUCTG": (structure.gain if structure else np.nan, "rms gain of a camera at a field point"),
        "STRUCTR": (structure.response if structure else np.nan, "rms response of a camera to q, u there"),
        "MAPFILT": (c.maps.filter, f"filter of the maps M21...{c.maps.names[-1]}"),
        **{n: (at, "[deg] extent of the field points used") for n, at in zip(_FIELD, c.field, strict=True)},
        "MJD-BEG": (span.mjd[0], "[d] UTC of the exposures"),
        "MJD-END": (span.mjd[1], "[d] UTC of the exposures"),
        "TEMPMIN": (span.temperature[0], "[Celsius] of the exposures"),
        "TEMPMAX": (span.temperature[1], "[Celsius] of the exposures"),
        **{f"FILTER{n}": (name, "") for n, name in enumerate(span.filters, start=1)},
        "HASHRULE": (HASHRULE, "what CONTHASH covers"),
        "CONTHASH": ("", ""),  # when all is there
    }
    primary = fits.PrimaryHDU()
    for name, (value, comment) in cards.items():
        if isinstance(value, float) and not np.isfinite(value):
            continue  # FITS headers have no NaN; a missing card is read as one
        primary.header[name] = (in_ascii(value) if isinstance(value, str) else value, comment)
    primary.header["INSTRUME"] = c.instrument  # blanks inside a name count
    for number, (name, release) in enumerate(c.versions.items(), start=1):
        primary.header[f"SOFT{number}"] = in_ascii(f"{name} {release}")
    return primary


def _map_hdu(name: str, image: np.ndarray, maps: MatrixMaps | ResidualMap) -> fits.ImageHDU:
    """An image of the field, with cards for the moving elements that are in the beam."""
    hdu = fits.ImageHDU(image, name=name)
    hdu.header.update(grid_cards(maps.grid))
    further = {prefix: angle for prefix, angle in maps.positions.items() if prefix != CALIBRATION_PLATE}
    for number, (prefix, angle) in enumerate(further.items(), start=1):
        hdu.header[f"ELEM{number}"], hdu.header[f"ANGLE{number}"] = prefix, angle
    return hdu


def _residual_hdus(residuals: ResidualMap) -> list[fits.ImageHDU]:
    hdus = [_map_hdu(name, getattr(residuals, field), residuals) for name, field in _RESIDUALS.items()]
    for hdu in hdus:
        hdu.header["FILTER"] = residuals.filter
        if (angle := residuals.positions.get(CALIBRATION_PLATE)) is not None:
            hdu.header["CHWPANG"] = (angle, "[deg] calibration plate; absent: out")
        if hdu.header["NAXIS"] == 3:
            for number, quantity in enumerate(residuals.names, start=1):
                hdu.header[f"PLANE{number}"] = quantity
    return hdus


def _hidden_hdu(hidden: Hidden) -> fits.ImageHDU:
    """An image (undetected error, parameter) of the shifts of the parameters by each error; no data without any."""
    hdu = fits.ImageHDU(hidden.changes if len(hidden) else None, name="HIDDEN")
    for number, each in enumerate(hidden.errors, start=1):
        for field, value in each._asdict().items():
            if field != "acts" or value:
                hdu.header[f"{_WORDS_OF_HIDDEN[field]}{number}"] = (
                    in_ascii(value) if isinstance(value, str) else value
                )
    return hdu


# ------------------------------------------------------------------------------------------------- reading


def read_calibration(
    run: PathLike, catalogue: Sequence[EffectKind] = EFFECTS, *, any_model: bool = False
) -> Calibration:
    """Read and check a calibration, given by its file or by the folder of a run.

    `catalogue` are the effects that its model may have. Raises `DataError`, with advice, for a file that is damaged, of
    another kind, from a newer version of the format, or changed since it was written; and if its model cannot be built,
    but with `any_model`: what needs no instrument can then be asked for all the same (`Calibration.unavailable`).
    """
    path = product_path(run)
    with open_fits(path, _AGAIN) as opened:
        calibration = _Reader(opened).calibration(tuple(catalogue))
    if calibration.unavailable is not None and not any_model:
        raise calibration.unavailable
    return calibration


def product_path(run: PathLike) -> Path:
    """The file that a folder of a run, or the file itself, stands for."""
    path = Path(run)
    return path / PRODUCT if path.is_dir() else path


class _Reader:
    """The parts of an open file by name; every method raises `DataError` for an invalid entry."""

    def __init__(self, opened: OpenFile) -> None:
        self.path, self.header, self.opened = opened.path, opened.hdus[0].header, opened.hdus
        self.primary = Place(self.path, "PRIMARY")
        self._check_version()
        self.hdus: dict[str, Any] = {}
        for hdu in opened.hdus[1:]:
            name = hdu.name.strip().upper()
            if name in self.hdus:
                raise fail("is there twice", file=self.path, extension=name, advice="remove one")
            self.hdus[name] = hdu

    def calibration(self, catalogue: tuple[EffectKind, ...]) -> Calibration:
        """The calibration, its content hash checked; `catalogue` are the effects that its model may have.

        Parameters go by name: values and covariance are in the order of the model, as far as it can be built.
        """
        covariance = self.image("COVARIANCE")
        maps = self.maps()
        table = self.table("PARAMETERS")
        self.check_parameters(table, covariance)
        model_lines = tuple(self.table("MODEL")["LINE"].tolist())
        numbers = (self.number(f"SITE{name}", np.nan) for name in ("LAT", "LONG", "ELEV"))
        site = Site(self.text("TELESCOP"), *numbers)
        filters = make_filters(self.table("FILTERS"), Place(self.path, "FILTERS"))
        stars, inputs = self.table("SOURCES", optional=True), self.table("INPUTS", optional=True)
        warnings, description = self.table("WARNINGS", optional=True), self.table("INSTRUMENT", optional=True)
        parents = zip(inputs["PATH"], inputs["SHA256"], strict=True)
        exposures, place = self.table("EXPOSURES"), Place(self.path, "EXPOSURES")
        low_x, high_x, low_y, high_y = map(self.number, _FIELD)
        written = Written(maps, model_lines, tuple(description["LINE"].tolist()), self.content())
        exposed = make_exposures(exposures, filters, site, place, kinds=None)
        sources = Sources.none()
        if "SOURCES" in self.hdus:
            sources = make_sources(stars, Place(self.path, "SOURCES"), filters)
        hidden = self.hidden(len(table["NAME"]))
        instrument = instrument_name(self.header.get("INSTRUME", ""), self.primary)
        names, order = table["NAME"].tolist(), np.arange(len(table["NAME"]))
        try:
            with errors_naming(self.path):
                standards = standards_of(sources, exposed, filters)
                model = built_model(instrument, written, names, standards, exposed, catalogue)
            order = np.array([names.index(name) for name in model.names])
        except ValueError as reason:
            with errors_naming(self.path):
                model = Model(
                    instrument,
                    UnavailableInstrument.because(reason),
                    _listed(table, model_lines),
                    catalogue,
                )
        if hidden is not None:
            hidden = dataclasses.replace(hidden, changes=hidden.changes[:, order])
        return Calibration(
            model=model,
            values=table["VALUE"][order],
            covariance=covariance[np.ix_(order, order)],
            verdict=Verdict.recorded(
                chi2=self.number("CHI2"),
                dof=int(self.number("DOF")),
                n_data=int(self.number("NDATA")),
                noise_scale=self.number("NOISESCL"),
                converged=self.flag("CONVERGD"),
                trusted=self.flag("TRUSTED"),
                quality=int(self.number("QUALITY")),
                warnings=(*warnings["TEXT"].tolist(), *(() if "HASHRULE" in self.header else (UNCHECKED,))),
                covariance_from=self.text("COVFROM") or "fit",
                errors_from=self.text("ERRFROM") or STATED,
                structure=Structure(self.number("STRUCTG", 0.0), self.number("STRUCTR", 0.0)),
            ),
            filters=filters,
            exposures=exposed,
            sources=sources,
            site=site,
            origin=self.text("ORIGIN"),
            field=(low_x, high_x, low_y, high_y),
            inputs=tuple(InputFile(Path(path), sha256) for path, sha256 in parents),
            residuals=self.residuals(maps.arms),
            hidden=hidden,
            date=self.text("DATE"),
            versions=self.versions(),
            path=self.path,
            written=written,
        )

    # ------------------------------------------------------------------------------------ the header

    def content(self) -> str:
        """The content hash; `DataError` where it is not that of the content. That of an earlier rule is not checked."""
        held, rule = self.text("CONTHASH"), self.header.get("HASHRULE")
        if rule == HASHRULE and held != content_of(self.opened):
            advice = "a product is not edited by hand: fit again, with a model file for what should differ"
            raise self.primary.fail("the content is not what was written", "CONTHASH", advice)
        if rule not in (None, HASHRULE):
            raise self.primary.fail(f"is {rule!r}, this version reads {HASHRULE}", "HASHRULE", _NEWER)
        return held

    def _check_version(self) -> None:
        version = self.header.get("PRODVERS")
        if version is None and "CALVERS" in self.header:
            what, advice = "this is a calibration set, not a calibration product", "run walop-jax refit on it"
        elif version is None:
            what, advice = "is missing", "is this the calibration.fits of a fit?"
        elif isinstance(version, bool) or not isinstance(version, int) or version < 1:
            what, advice = f"is {version!r}, not a version", _AGAIN
        elif version > PRODVERS:
            what, advice = f"is {version}, this program reads up to {PRODVERS}", _NEWER
        else:
            return
        raise self.primary.fail(what, "PRODVERS", advice)

    def number(self, name: str, missing: float | None = None) -> float:
        """A number; `missing` where it is absent, if that may be."""
        return _number(self.header, name, self.primary, missing)

    def flag(self, name: str) -> bool:
        """A truth value of the header: True for T, False for F."""
        value = self.header.get(name)
        if not isinstance(value, bool):
            raise self.primary.fail(f"is {value!r}, not T or F", name, _AGAIN)
        return value

    def text(self, name: str) -> str:
        """A text without blanks around it, empty where it is absent."""
        return str(self.header.get(name, "")).strip()

    def versions(self) -> dict[str, str]:
        """Versions of the software by name."""
        versions: dict[str, str] = {}
        for number in range(1, _LONGEST_SOFTWARE_LIST):
            name, _, version = self.text(f"SOFT{number}").partition(" ")
            if name:
                versions[name] = version
        return versions

    # ---------------------------------------------------------------------------- tables and images

    def table(self, name: str, *, optional: bool = False) -> dict[str, Any]:
        """The columns of a table; without rows for one that is `optional` and not there."""
        if optional and name not in self.hdus:
            return {column: np.zeros(0, np.str_) for column in TABLES[name]}
        hdu, place = self.hdu(name), Place(self.path, name)
        rules = TABLES.get(name) or table_rules(name, column_names(hdu, place), place)
        return read_table(hdu, rules, place)[0]

    def hdu(self, name: str) -> Any:
        """An extension that must be there."""
        if name not in self.hdus:
            self.fail(name, "the extension is missing")
        return self.hdus[name]

    def fail(self, name: str, what: str) -> NoReturn:
        """Raise `DataError` about an extension."""
        raise fail(what, file=self.path, extension=name, advice=_AGAIN)

    def image(self, name: str) -> np.ndarray:
        """An image with two axes, finite everywhere."""
        data = getattr(self.hdu(name), "data", None)
        if not isinstance(data, np.ndarray) or data.ndim != 2 or data.dtype.kind not in "fiu":
            self.fail(name, "is not an image with two axes")
        values = np.ascontiguousarray(data, dtype=np.float64)
        if not np.all(np.isfinite(values)):
            self.fail(name, "is not finite everywhere")
        return values

    def grid(self, name: str) -> Grid:
        """The pixels of an image."""
        return read_grid(self.hdus[name].header, Place(self.path, name))

    def positions(self, name: str) -> dict[str, float]:
        """Angles (deg) of the moving elements that were in the beam for an image, by column prefix."""
        header, angles = self.hdus[name].header, dict[str, float]()
        while (card := f"ELEM{len(angles) + 1}") in header:
            prefix, angle = header[card], header.get(f"ANGLE{len(angles) + 1}")
            valid = isinstance(prefix, str) and PREFIX.fullmatch(prefix) and prefix not in angles
            if not valid or isinstance(angle, bool) or not isinstance(angle, int | float):
                raise Place(self.path, name).fail(f"is {prefix!r} at {angle!r}", card, _AGAIN)
            angles[prefix] = float(angle)
        return angles

    def maps(self) -> MatrixMaps:
        """The maps of the matrix, of as many arms as there are images."""
        rows = [int(match[1]) for name in self.hdus if (match := _MATRIX_IMAGE.fullmatch(name))]
        names = matrix_names(max([1, *(row - 1 for row in rows)]))
        errors = tuple(f"{name}_ERR" for name in names)
        images = {name: self.image(name) for name in (*names, *errors)}
        grid = self.grid(names[0])
        for name, image in images.items():
            if image.shape != (grid.height, grid.width) or self.grid(name) != grid:
                self.fail(name, f"does not lie on the grid of {names[0]}")
        return MatrixMaps(
            grid=grid,
            filter=self.text("MAPFILT"),
            values=np.stack([images[name] for name in names]),
            errors=np.stack([images[name] for name in errors]),
            positions=self.positions(names[0]),
        )

    def residuals(self, arms: int) -> ResidualMap | None:
        """The residual map of an instrument with so many arms, None without one."""
        if not any(name in self.hdus for name in _RESIDUALS):
            return None
        images: dict[str, Any] = {}
        for name, attribute in _RESIDUALS.items():
            data = self.hdu(name).data
            grid = self.grid("RESIDUAL")
            shape = (grid.height, grid.width)
            expected = shape if attribute == "chi2" else (len(residual_names(arms)), *shape)
            if self.grid(name) != grid or not isinstance(data, np.ndarray) or data.shape != expected:
                self.fail(name, "is not an image on the grid of RESIDUAL")
            images[attribute] = np.ascontiguousarray(data, dtype=np.float64)
        header = self.hdus["RESIDUAL"].header
        plate = {CALIBRATION_PLATE: float(header["CHWPANG"])} if "CHWPANG" in header else {}
        return ResidualMap(
            grid=self.grid("RESIDUAL"),
            filter=str(header.get("FILTER", "")).strip(),
            positions=plate | self.positions("RESIDUAL"),
            **images,
        )

    def hidden(self, parameters: int) -> Hidden | None:
        """The undetected errors of the extension HIDDEN; None in products without it."""
        if "HIDDEN" not in self.hdus:
            return None
        header, place = self.hdus["HIDDEN"].header, Place(self.path, "HIDDEN")
        undetected, usual = list[UndetectedError](), {"unit": "", **UndetectedError._field_defaults}
        while f"HIDE{(number := len(undetected) + 1)}" in header:
            words = {field: f"{word}{number}" for field, word in _WORDS_OF_HIDDEN.items()}
            size, seen = _number(header, words.pop("size"), place), header.get(words.pop("measured"))
            texts = {field: str(header.get(name, usual.get(field))) for field, name in words.items()}
            undetected.append(UndetectedError(size=size, measured=seen is not False, **texts))
        changes = self.image("HIDDEN") if undetected else np.zeros((0, parameters))
        if changes.shape != (len(undetected), parameters):
            raise place.fail(f"has shape {changes.shape}, not {(len(undetected), parameters)}", advice=_AGAIN)
        return Hidden(tuple(undetected), changes)

    def check_parameters(self, table: Mapping[str, Any], covariance: np.ndarray) -> None:
        """Raise `DataError` for parameters that are none, and a covariance that is not theirs."""
        place, names = Place(self.path, "PARAMETERS"), table["NAME"].tolist()
        for name in names:
            if names.count(name) > 1:
                raise place.fail(f"{name!r} is there twice", "NAME", _AGAIN)
            if not NAME.fullmatch(name):
                raise place.fail(f"{name!r} is not a parameter name", "NAME", _AGAIN)
        for column in ("VALUE", "SIGMA"):
            if not np.all(np.isfinite(table[column])):
                raise place.fail("is not finite everywhere", column, _AGAIN)
        if covariance.shape != 2 * (len(names),):
            self.fail("COVARIANCE", f"has shape {covariance.shape}, there are {len(names)} parameters")
        variance = np.diag(covariance)
        # Some elements are pure rounding: symmetry counts on the scale of the errors.
        scale = np.sqrt(np.outer(np.abs(variance), np.abs(variance)))
        if np.any(np.abs(covariance - covariance.T) > 1e-9 * scale) or np.any(variance < 0):
            self.fail("COVARIANCE", "is not a covariance: not symmetric, or negative variances")
        if not np.allclose(np.sqrt(variance), table["SIGMA"], rtol=1e-12, atol=0):
            self.fail("COVARIANCE", "does not agree with SIGMA of PARAMETERS")


def _number(header: fits.Header, name: str, place: Place, missing: float | None = None) -> float:
    value = header.get(name, missing)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise place.fail(f"is {value!r}, not a number", name, _AGAIN)
    return float(value)


def _listed(table: Mapping[str, Any], model_lines: Sequence[str]) -> tuple[Parameter, ...]:
    """The parameters of a file, with ties as far as the lines of its model have them.

    A start that neither these lines nor a prior tell is the fitted value.
    """
    try:
        written = tomllib.loads("\n".join(model_lines)).get("parameters", {})
    except tomllib.TOMLDecodeError:
        written = {}
    parameters = []
    for name, value, _, unit, mean, width, free in zip(
        *(table[n] for n in TABLES["PARAMETERS"]), strict=True
    ):
        entry, prior = written.get(name, {}), (float(mean), float(width)) if np.isfinite(width) else None
        start = float(entry.get("start", value if prior is None else mean))
        part = str(name).partition(".")[0]  # names are all that a file has
        further = {"tie": entry.get("tie"), "part": part}
        parameters.append(Parameter(str(name), str(unit), "", "", start, prior, bool(free), 1.0, **further))
    return tuple(parameters)
