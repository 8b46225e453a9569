"""A calibration: an instrument as fitted, the content of `calibration.fits` (`product`).

It is made from a fit or read from a file, and is asked for the matrix anywhere in the field.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.calibration.accuracy import p_errors
from walop_jax.calibration.matrix import (
    MatrixMaps,
    ResidualMap,
    matrices,
    matrix_draws,
    matrix_names,
    of_structure,
    slopes_over_field,
)
from walop_jax.data.grid import Grid
from walop_jax.data.kinds import CALIBRATION_PLATE
from walop_jax.data.records import Exposures, FilterCurve, InputFile, Site, Sources
from walop_jax.data.schema import in_unit
from walop_jax.data.settings import (
    BUILTIN_FILTERS,
    DEFAULT_FILTER,
    Settings,
    builtin_filter,
    single_wavelength,
)
from walop_jax.fit.model_file import model_without_data, render
from walop_jax.fit.parameter_table import Fitted, parameter_notes
from walop_jax.fit.verdict import NOT_MEASURED, Hidden, Quality, Verdict
from walop_jax.instruments.description import parsed
from walop_jax.io.code import software_versions
from walop_jax.io.display import Display
from walop_jax.io.errors import DataError, PathLike, nearest
from walop_jax.io.text import in_ascii
from walop_jax.likelihood.inverses import pseudo_inverse
from walop_jax.model.dependence import left_behind, needs
from walop_jax.model.effects import EFFECTS, Deviations, EffectKind
from walop_jax.model.effects.in_models import effect_context
from walop_jax.model.elements.registry import defined_elements
from walop_jax.model.instrument import Instrument, adapted, build, nominal_instrument
from walop_jax.model.parameters import Parameter
from walop_jax.model.specification import Model, Vector

if TYPE_CHECKING:
    from walop_jax.fit.refit import FitResult

Matrix = Float[np.ndarray, "n n"]
Positions = Float[np.ndarray, " p"]  # deg
Elements = Float[np.ndarray, "p m"]  # m21, m22, m23, m31, … at positions
Covariances = Float[np.ndarray, "p m m"]
Columns = dict[str, tuple[np.ndarray, str]]  # values, description

MAP_SIZE = 31  # pixels along each axis of the maps: 0.02° over ±0.3°
MAP_NODES = (18, 24, 30)  # per side, of the tables that the maps are made of
MAP_ERRORS = 1e-6  # of the standard errors, relative: the elements themselves are then right to 10⁻⁹
HIGH_CROSSTALK = 10.0  # condition number of the local 2 × 2 inverse
UNCHECKED = (
    "made by an earlier version, whose content hash does not cover all words of the headers: fit again"
)
"""Remark of the verdict on a product whose content is not checked."""
TEMPERATURE_MARGIN = 2.0  # K beyond the temperatures of the exposures


def now() -> str:
    """Date and time, UTC, ISO 8601 to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds").replace("+00:00", "")


class Written(NamedTuple):
    """What the file of a calibration holds beside the calibration itself, as it stands there.

    `maps` are those of the matrix over the field, `model_lines` the lines of the model file of the fit, `description`
    those of the description of an instrument that does not come with the package, `content` is the content hash.
    """

    maps: MatrixMaps
    model_lines: tuple[str, ...]
    description: tuple[str, ...] = ()
    content: str = ""


class UnavailableInstrument(Instrument):
    """Stands in a model for an instrument that this process cannot build: asking it for anything raises the reason.

    For example the fit had an effect of one's own, and the file that defines the effect was not given.
    """

    @classmethod
    def because(cls, reason: Exception) -> UnavailableInstrument:
        """The instrument that cannot be built for this reason."""
        self = object.__new__(cls)
        object.__setattr__(self, "reason", reason)
        return self

    def __getattribute__(self, name: str) -> Any:
        # Protocols of Python, such as copy and isinstance, ask for names of their own.
        if name == "reason" or name.startswith("__"):
            return object.__getattribute__(self, name)
        raise object.__getattribute__(self, "reason")


@dataclasses.dataclass(frozen=True, repr=False, kw_only=True)
class Calibration(Fitted):
    """An instrument as fitted: model, values and covariance of all parameters, the verdict, and where they come from.

    In memory and as a file it is the same: `Calibration.from_fit` makes it, `Calibration.read` reads it.

    `field` is (smallest x, largest x, smallest y, largest y) in degrees of the points that were used. `residuals` are
    those of the model over the field, `hidden` are mistakes that would not have been detected; `date` is UTC,
    `versions` name the software. With `draws` of a posterior, matrices and their covariance are means over these
    instead of the linear propagation of `covariance`.

    `written` is what its file holds beside; `dataclasses.replace` forgets it, so that a changed calibration has maps of
    its own. Where the model in a file cannot be built here, all that needs no instrument can still be asked for, and
    `unavailable` is the reason. Raises ValueError for shapes that do not belong together.

    >>> m, covariance = walop.Calibration.from_fit(result).matrix(0.1, -0.05)
    >>> m.shape, covariance.shape
    ((6,), (6, 6))
    """

    model: Model
    values: Vector
    covariance: Matrix
    verdict: Verdict
    filters: Mapping[str, FilterCurve]
    exposures: Exposures
    sources: Sources
    site: Site
    origin: str
    field: tuple[float, float, float, float]
    inputs: tuple[InputFile, ...] = ()
    residuals: ResidualMap | None = None
    hidden: Hidden | None = None
    draws: Float[np.ndarray, "d n"] | None = None
    date: str = dataclasses.field(default_factory=now)
    versions: Mapping[str, str] = dataclasses.field(default_factory=software_versions)
    path: Path | None = None
    written: dataclasses.InitVar[Written | None] = None

    def __post_init__(self, written: Written | None) -> None:
        n = len(self.model.parameters)
        if self.covariance.shape != (n, n):
            raise ValueError(f"covariance has shape {self.covariance.shape}, there are {n} parameters")
        if written is not None and self.residuals is not None and self.residuals.arms != written.maps.arms:
            raise ValueError(
                f"a residual map of {self.residuals.arms} arms, the matrix has {written.maps.arms}"
            )
        object.__setattr__(self, "_written", written)

    @property
    def unavailable(self) -> Exception | None:
        """The reason why the model of the file cannot be built here; None where it could be."""
        template = self.model.template
        return template.reason if isinstance(template, UnavailableInstrument) else None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences if the calibration is not to be trusted, not checked, or lacks something that matters to stars."""
        where = "" if self.path is None else f"{self.path}: "
        if self.verdict.trusted:
            unchecked = (UNCHECKED,) if UNCHECKED in self.verdict.warnings else ()
            unseen = () if self.hidden is None else self.hidden.not_measured()
            unmeasured = (NOT_MEASURED.format("; ".join(unseen)),) if unseen else ()
            return tuple(f"{where}{sentence}" for sentence in (*unchecked, *unmeasured))
        why = "; ".join(self.verdict.warnings) or "see WARNINGS"
        return (f"{where}this calibration is not trusted: {why}",)

    @classmethod
    def from_fit(cls, result: FitResult, residuals: ResidualMap | None = None) -> Calibration:
        """The calibration by a fit, with the verdict on it: of a diagnosis the mean over the models still possible.

        `residuals` are those over the field (`residual_map`), worth its pass for large sets.
        Raises RuntimeError for a fit without a verdict.
        """
        calset = result.calset
        calibration = cls(
            model=result.model,
            values=result.values,
            covariance=0.5 * (result.covariance + result.covariance.T),
            verdict=result.checked_verdict(),
            filters=calset.filters,
            exposures=calset.exposures,
            sources=calset.sources,
            site=calset.site,
            origin=calset.origin,
            field=result.expansion.census.field,
            inputs=calset.inputs,
            residuals=residuals,
            hidden=result.hidden,
        )
        return calibration if result.alternatives is None else result.alternatives.averaged(calibration)

    def with_covariance(self, covariance: Float[np.ndarray, "f f"], errors_from: str) -> Calibration:
        """The calibration with the covariance of a posterior of its fit, made of errors from `errors_from`, now."""
        verdict = dataclasses.replace(self.verdict, covariance_from="posterior", errors_from=errors_from)
        made = {"date": now(), "versions": software_versions()}
        return dataclasses.replace(self, covariance=self.widened(covariance), verdict=verdict, **made)

    @property
    def fitted(self) -> Int[np.ndarray, " f"]:
        """Positions of the parameters of the fit: all but deviations, which a diagnosis adds."""
        return np.delete(np.arange(len(self.model.names)), self.model.positions(Deviations.name))

    def widened(self, covariance: Float[np.ndarray, "f f"]) -> Matrix:
        """The covariance of all parameters, from another one of the parameters of the fit."""
        total, fitted = self.of_deviations, self.fitted
        total[np.ix_(fitted, fitted)] += covariance
        return total

    @property
    def of_deviations(self) -> Matrix:
        """The part of the covariance that deviations from descriptions, and undetected changes, make."""
        at = self.model.positions(Deviations.name)
        across = self.covariance[:, at]
        return across @ pseudo_inverse(self.covariance[np.ix_(at, at)], 1e-12) @ across.T

    @property
    def instrument(self) -> str:
        """Name of the instrument."""
        return self.model.name

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters of the model."""
        return self.model.parameters

    @property
    def design(self) -> Instrument:
        """The instrument as designed.

        Where the model is `unavailable`, from the description in the file, or the one that comes with the package.
        Raises `DataError`, with the class that is missing, for a kind of element that this process has not defined.
        """
        if self.unavailable is None:
            return self.model.template
        return design_of(self.instrument, self.description)

    @staticmethod
    def read(path: PathLike, elements: PathLike | Sequence[type] | None = None) -> Calibration:
        """The calibration of a product, or of the folder of a run. Raises `DataError` for what cannot be read.

        `elements` are kinds of elements of one's own that its instrument has: a Python file, or classes.
        """
        from walop_jax.calibration.product import read_calibration
        from walop_jax.model.elements.registry import load_elements

        if elements is not None:
            load_elements(elements)
        return read_calibration(path)

    def display(self) -> Display:
        """The range of the calibration, its verdict and its parameters."""
        v, (low_x, high_x, low_y, high_y) = self.verdict, self.field
        facts = {
            "χ²/dof": f"{v.chi2:.1f} / {v.dof} = {v.chi2 / max(v.dof, 1):.4g}",
            "field": f"X {low_x:+.3f} … {high_x:+.3f}°, Y {low_y:+.3f} … {high_y:+.3f}°",
            "filters": ", ".join(sorted({str(name) for name in self.exposures.filter})),
            "effects": ", ".join(name for name in self.model.effect_names if name != Deviations.name)
            or "none beyond the base model",
            "errors from": f"covariance of the {v.covariance_from}, {v.errors_from}",
        }
        notes = (*parameter_notes(self.model, self.sigma), *v.warnings)
        return self.shown(f"Calibration of {self.model.name}: {v.words}", facts, notes)

    # ------------------------------------------------------------------------------- asking for the matrix

    def matrix(
        self, x: Any, y: Any, settings: Settings | None = None
    ) -> tuple[Float[np.ndarray, "*p m"], Float[np.ndarray, "*p m m"]]:
        """m21, m22, m23, m31, … and their covariance at field positions (deg, or quantities), a setting for each.

        Without `settings` those of `usual_settings`; a single one serves all positions. Beyond the field of the
        instrument all is NaN. Raises `DataError` for a unit that is none of angles, a position that is not finite and a
        filter unknown to the calibration and the package, ValueError for a moving element that the instrument
        does not have.
        """
        x, y = np.broadcast_arrays(in_unit(x, "deg", "x"), in_unit(y, "deg", "y"))
        if not np.all(np.isfinite(x) & np.isfinite(y)):
            raise DataError("x, y: a position is not finite; leave it out")
        count, shape = x.size, x.shape
        settings = settings or self.usual_settings(count)
        if len(settings) == 1:
            settings = settings[np.zeros(count, int)]
        x, y = x.ravel(), y.ravel()
        inside = np.flatnonzero(np.maximum(np.abs(x), np.abs(y)) <= self.model.template.field_limit)
        size = 3 * len(self.model.template.cameras.pairs)
        m, covariance = np.full((count, size), np.nan), np.full((count, size, size), np.nan)
        if inside.size:
            m[inside], covariance[inside] = self._elements(x[inside], y[inside], settings[inside])
        return m.reshape(*shape, size), covariance.reshape(*shape, size, size)

    def _elements(self, x: Positions, y: Positions, settings: Settings) -> tuple[Elements, Covariances]:
        filters = self.curves(settings)
        if self.draws is not None:
            drawn = matrix_draws(self.model, self.draws, settings, filters, x, y)
            values = drawn.mean(axis=0)
            covariance = np.einsum("dpi,dpj->pij", drawn - values, drawn - values) / (len(drawn) - 1)
        else:
            instrument = self.model.instrument(self.values)
            values, covariance = matrices(instrument, settings, filters, x, y, self.covariance)
        return values, covariance + of_structure(self.verdict.structure, values)

    def over_field(
        self, x: Positions, y: Positions, settings: Settings, counts: Sequence[int], tolerance: float
    ) -> tuple[Elements, Covariances, Float[np.ndarray, "p m n"]]:
        """Matrix, covariance and derivatives at many field positions (deg), interpolated (`slopes_over_field`).

        In one setting, a row of `settings`; from the covariance of the parameters, draws left aside.
        """
        at = self.model.instrument(self.values), settings, self.curves(settings), x, y
        matrix, slopes = slopes_over_field(*at, self.covariance, counts, tolerance)
        matrix, slopes = matrix.reshape(len(x), -1), slopes.reshape(len(x), matrix[0].size, -1)
        covariance = slopes @ self.covariance @ np.swapaxes(slopes, 1, 2)
        return matrix, covariance + of_structure(self.verdict.structure, matrix), slopes

    def usual_settings(self, count: int = 1, filter_name: str = DEFAULT_FILTER) -> Settings:
        """Flat photon spectrum, 10 °C, on the meridian, moving elements out.

        Elements that were in the beam in every exposure (`always_in`) are placed at their most frequent angle.
        """
        settings = Settings.default(count, filter_name)
        for prefix in self.always_in:
            angles, number = np.unique(self.exposures.position(prefix).angle, return_counts=True)
            settings = settings.at(**{prefix: float(angles[np.argmax(number)])})
        return settings

    @property
    def usual_filter(self) -> str:
        """SDSS-r, or the first filter of the exposures where they do not use that."""
        used = [str(name) for name in np.unique(self.exposures.filter)]
        return DEFAULT_FILTER if DEFAULT_FILTER in used or not used else used[0]

    def raster(self, size: int) -> Float[np.ndarray, "2 p"]:
        """X and Y (deg) of size × size places over the field, row by row."""
        low_x, high_x, low_y, high_y = self.field
        x, y = np.meshgrid(np.linspace(low_x, high_x, size), np.linspace(low_y, high_y, size))
        return np.stack([x.ravel(), y.ravel()])

    @property
    def always_in(self) -> tuple[str, ...]:
        """Column prefixes of the moving elements, calibration plate apart, that were in the beam in all exposures."""
        moving = (p for p in self.model.template.patched().moving() if p != CALIBRATION_PLATE)
        return tuple(prefix for prefix in moving if self.exposures.position(prefix).inside.all())

    @property
    def never_in(self) -> tuple[str, ...]:
        """Column prefixes of the moving elements that were in the beam in no exposure."""
        moving = self.model.template.patched().moving()
        return tuple(prefix for prefix in moving if not self.exposures.position(prefix).inside.any())

    @property
    def left_behind(self) -> tuple[str, ...]:
        """Effects of the model of which a part belongs to its exposures, so that no matrix and no star can have it."""
        return left_behind(self.model.template)

    def curves(self, settings: Settings) -> dict[str, FilterCurve]:
        """The curves of the filters of settings, by name; `DataError` as `filter_curve`."""
        return {str(name): self.filter_curve(str(name)) for name in np.unique(settings.filter)}

    def filter_curve(self, name: str) -> FilterCurve:
        """The curve of a filter; `DataError` with the nearest names when there is none."""
        if name in self.filters:
            return self.filters[name]
        if name in BUILTIN_FILTERS or single_wavelength(name) is not None:
            return builtin_filter(name)
        names = (*self.filters, *BUILTIN_FILTERS)
        raise DataError(f"FILTER: the calibration has no filter {name!r}; {nearest(name, names)}")

    def flags(
        self, x: Positions, y: Positions, settings: Settings, values: Elements | None = None
    ) -> Int[np.ndarray, " p"]:
        """Bits of `Quality` at field positions: beyond the field or the settings; for matrices, high cross-talk.

        A single arm sees one combination of q and u, which has no inverse: it is marked only where it sees neither.
        """
        flags = np.zeros(len(x), np.int64)
        if values is not None:
            blocks = values.reshape(len(x), values.shape[1] // 3, 3)[:, :, 1:]
            finite = np.all(np.isfinite(values), axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                condition = np.linalg.cond(np.where(finite[:, None, None], blocks, np.eye(*blocks.shape[1:])))
            flags[~(condition <= HIGH_CROSSTALK)] |= Quality.HIGH_CROSSTALK
        margin = 0.5 / MAP_SIZE * (self.field[1] - self.field[0])
        low_x, low_y = self.field[0] - margin, self.field[2] - margin
        high_x, high_y = self.field[1] + margin, self.field[3] + margin
        flags[(x < low_x) | (x > high_x) | (y < low_y) | (y > high_y)] |= Quality.BEYOND_FIELD
        flags[self.beyond_settings(settings)] |= Quality.BEYOND_SETTINGS
        for prefix in self.never_in:
            flags[np.isfinite(settings.position(prefix))] |= Quality.BEYOND_SETTINGS
        return flags

    def beyond_settings(self, settings: Settings) -> Bool[np.ndarray, " p"]:
        """True for settings whose filter, or temperature where that matters, the exposures do not cover."""
        beyond = ~np.isin(settings.filter, np.unique(self.exposures.filter))
        if "temperature" in needs(self.model.template).conditions:
            low, high = np.nanmin(self.exposures.temp), np.nanmax(self.exposures.temp)
            beyond |= settings.temperature < low - TEMPERATURE_MARGIN
            beyond |= settings.temperature > high + TEMPERATURE_MARGIN
        return beyond

    def new_maps(self, size: int = MAP_SIZE) -> MatrixMaps:
        """The matrix over the field on a regular grid, anew, in `usual_settings` through the `usual_filter`."""
        name = self.usual_filter
        half = float(np.ceil(np.max(np.abs(self.field)) * 50.0) / 50.0) or 0.3
        step = 2.0 * half / (size - 1)
        centre = 0.5 * (size + 1)
        grid = Grid(size, size, (centre, centre), (0.0, 0.0), ((step, 0.0), (0.0, step)))
        x, y, settings = grid.points.x, grid.points.y, self.usual_settings(size * size, name)
        if self.draws is not None:
            values, covariance = self._elements(x, y, settings)
        else:
            values, covariance, _ = self.over_field(x, y, settings[:1], MAP_NODES, MAP_ERRORS)
        errors = np.sqrt(np.clip(np.diagonal(covariance, axis1=1, axis2=2), 0.0, None))
        planes, flat = (-1, size, size), values.reshape(size * size, -1)
        return MatrixMaps(grid, name, flat.T.reshape(planes), errors.T.reshape(planes), settings[:1].inside())

    @functools.cached_property
    def maps(self) -> MatrixMaps:
        """The maps of its file, or made anew."""
        written = self._as_written
        return self.new_maps() if written is None else written.maps

    @property
    def model_lines(self) -> tuple[str, ...]:
        """The lines of the model file of the fit."""
        written = self._as_written
        return _lines(render(self.model)) if written is None else written.model_lines

    @property
    def description(self) -> tuple[str, ...]:
        """The lines of the description of the instrument, if it does not come with the package."""
        written = self._as_written
        return _lines(self.model.template.description) if written is None else written.description

    @property
    def _as_written(self) -> Written | None:
        return vars(self)["_written"]

    def content_hash(self) -> str:
        """The content hash of the file that it was read from, or of the one that it would be written as.

        SHA-256 of the instrument as calibrated: not of dates, paths and versions.
        """
        from walop_jax.calibration.product import content_of, hdus_of

        written = self._as_written
        held = "" if written is None else written.content
        return held or content_of(hdus_of(self, self.path))

    # ------------------------------------------------------------------------------- tables and contents

    def provenance(self, content: str = "") -> dict[str, str]:
        """Cards of a table of matrices: the calibration (hash of its content), and the origin of the errors."""
        verdict = self.verdict
        drawn = f"covariance of the {verdict.covariance_from}"
        if self.draws is not None:
            drawn = "draws of the posterior"
        return {
            "CALHASH": content or self.content_hash(),
            "ERRFROM": f"{drawn}, {verdict.errors_from}",
            "TRUSTED": str(verdict.trusted)[0],
        }

    def matrix_columns(
        self, x: Positions, y: Positions, settings: Settings, outside: Bool[np.ndarray, " p"]
    ) -> Columns:
        """Matrix elements, standard errors and FLAG, each with its description; NaN and 32 where `outside`."""
        inside = np.flatnonzero(~outside)
        elements, covariance = self.matrix(x[inside], y[inside], settings[inside])
        values, errors = np.full((2, len(x), elements.shape[1]), np.nan)
        values[inside] = elements
        errors[inside] = np.sqrt(np.clip(np.diagonal(covariance, axis1=1, axis2=2), 0.0, None))
        flag = np.full(len(x), Quality.BEYOND_FIELD, np.int32)
        flag[inside] = self.flags(x[inside], y[inside], settings[inside], values[inside])
        names = matrix_names(values.shape[1] // 3)
        about = [f"element {name.lower()} of the instrument matrix" for name in names]
        columns: Columns = dict(zip(names, zip(values.T, about, strict=True), strict=True))
        for name, column in zip(names, errors.T, strict=True):
            columns[f"{name}_ERR"] = column, f"standard error of {name}"
        if len(names) == 6:
            error_of_p = np.full(len(x), np.nan)
            error_of_p[inside] = p_errors(elements, covariance)
            columns["P_ERR"] = error_of_p, "error of p of a star with p <= 5 %, of the calibration alone"
        columns["FLAG"] = flag, "16 high cross-talk, 32 beyond the calibrated field, 64 filter or temperature"
        return columns


def design_of(instrument: str, description: Sequence[str]) -> Instrument:
    """The instrument of the lines of a description, or without any that of the package of this name.

    Its kinds of elements are those of the package and those that this process has defined. Raises `DataError`, with the
    class that is missing, for another kind.
    """
    if not description:
        return nominal_instrument(instrument)
    name = f"the description of {instrument} in the product"
    return build(parsed("\n".join(description), name), elements=defined_elements())


def built_model(
    instrument: str,
    written: Written,
    names: Sequence[str],
    standards: Any,
    exposures: Exposures,
    catalogue: tuple[EffectKind, ...] = EFFECTS,
) -> Model:
    """The model of the lines in a file, built anew.

    `names` are the parameters that the file lists, `standards` the polarised standards of its exposures, `catalogue`
    the effects that it may have. Raises ValueError where it cannot be built, `DataError` where the physics has changed
    since, so that it has other parameters.
    """
    design = design_of(instrument, written.description)
    context = effect_context(adapted(design, standards=standards), exposures)
    facts = {"standards": standards, "context": context, "catalogue": catalogue}
    model = model_without_data(design, "\n".join(written.model_lines), **facts)
    if sorted(model.names) != sorted(names):
        odd = sorted(set(model.names) ^ set(names)) or ["one of them twice"]
        what = f"the model of the product has other parameters than it lists ({', '.join(odd[:3])})"
        raise DataError(f"{what}: it was made by a version with other physics; fit again")
    return model


def _lines(text: str) -> tuple[str, ...]:
    return tuple(in_ascii(line) for line in text.splitlines() if line.strip())
