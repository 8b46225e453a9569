"""A calibration: what a fit has learnt of an instrument, ready to be asked for the matrix in the field.

It is made from a fit, goes into a calibration product and comes back from one with the same answers.
"""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.calibration.matrix import matrices, matrix_draws
from walop_jax.calibration.matrix_slopes import change_of_qu, matrix_slopes
from walop_jax.calibration.product import CalibrationProduct, MatrixMaps, ParameterTable, in_ascii
from walop_jax.calibration.records import ResidualMap
from walop_jax.data.filters import BUILTIN_FILTERS, DEFAULT_FILTER, builtin_filter, single_wavelength
from walop_jax.data.frames import Grid
from walop_jax.data.quantities import in_unit
from walop_jax.data.records import CALIBRATION_PLATE, Exposures, FilterCurve, InputFile, Site, Sources
from walop_jax.data.settings import Settings
from walop_jax.fit.model_builder import model_without_data, standard_names
from walop_jax.fit.model_file import render
from walop_jax.fit.parameter_table import HEAD, parameter_notes, parameter_rows, parameter_table
from walop_jax.fit.refit import FitResult
from walop_jax.fit.verdict import Hidden, Quality, Verdict
from walop_jax.instruments.description import parsed
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import DataError, nearest
from walop_jax.io.software import software_versions
from walop_jax.model import carried
from walop_jax.model.build import adapted, build, nominal_instrument
from walop_jax.model.dependence import needs
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.specification import Model, effect_context

Vector = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]

MAP_SIZE = 31  # pixels along each axis of the maps of a product: 0.02° over ±0.3°
HIGH_CROSSTALK = 10.0  # condition number of the local 2 × 2 inverse
TEMPERATURE_MARGIN = 2.0  # K beyond the temperatures of the exposures


@dataclasses.dataclass(frozen=True, repr=False)
class Calibration(Displayed):
    """An instrument as fitted: model, values and covariance of all parameters, and where they come from.

    `field` is (smallest x, largest x, smallest y, largest y) in degrees of the points that were used. With `draws` of a
    posterior, matrices and their covariance are means over these instead of the linear propagation of `covariance`.
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
    draws: Float[np.ndarray, "d n"] | None = None
    hidden: Hidden | None = None

    @classmethod
    def from_fit(cls, result: FitResult, residuals: ResidualMap | None = None) -> Calibration:
        """The calibration that a fit gives, with the verdict on it.

        `residuals` is what the model leaves over the field (`residual_map`), worth its pass for large sets.
        Raises RuntimeError for a fit that nobody has examined.
        """
        calset = result.calset
        return cls(
            model=result.model,
            values=result.values,
            covariance=0.5 * (result.covariance + result.covariance.T),
            verdict=result.checked_verdict(),
            filters=calset.filters,
            exposures=calset.exposures,
            sources=calset.sources,
            site=calset.site,
            origin=calset.origin,
            field=result.posterior.census.field,
            inputs=calset.inputs,
            residuals=residuals,
            hidden=result.hidden,
        )

    @property
    def sigma(self) -> Vector:
        """Standard errors of all parameters."""
        return np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))

    def to_table(self) -> Any:
        """All parameters as an astropy table: value, error, unit, start, prior, and whether it was free."""
        return parameter_table(self.model, self.values, self.sigma)

    def display(self) -> Display:
        """What it is good for, and the parameters."""
        v, (low_x, high_x, low_y, high_y) = self.verdict, self.field
        facts = {
            "χ²/dof": f"{v.chi2:.1f} / {v.dof} = {v.chi2 / max(v.dof, 1):.4g}",
            "field": f"X {low_x:+.3f} … {high_x:+.3f}°, Y {low_y:+.3f} … {high_y:+.3f}°",
            "filters": ", ".join(sorted({str(name) for name in self.exposures.filter})),
            "effects": ", ".join(self.model.effect_names) or "none beyond the base model",
            "errors from": f"covariance of the {v.covariance_from}, {v.errors_from}",
        }
        return Display(
            title=f"Calibration of {self.model.name}: {v.words}",
            facts=tuple(facts.items()),
            head=HEAD,
            rows=parameter_rows(self.model, self.values, self.sigma),
            notes=(*parameter_notes(self.model, self.sigma), *v.warnings),
        )

    # ------------------------------------------------------------------------------- asking for the matrix

    def matrix(
        self, x: Any, y: Any, settings: Settings | None = None
    ) -> tuple[Float[np.ndarray, "*p m"], Float[np.ndarray, "*p m m"]]:
        """m21, m22, m23, m31, … and their covariance at field positions (deg, or quantities), a setting for each.

        Without `settings` those of `usual_settings`; a single one serves all positions. Beyond the field of the
        instrument all is NaN. Raises `DataError` for a unit that is none of angles, a position that is not finite and a
        filter that neither the calibration nor the package knows, ValueError for a moving element that the instrument
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
        size = 3 * len(self.model.template.arms)
        m, covariance = np.full((count, size), np.nan), np.full((count, size, size), np.nan)
        if inside.size:
            m[inside], covariance[inside] = self._elements(x[inside], y[inside], settings[inside])
        return m.reshape(*shape, size), covariance.reshape(*shape, size, size)

    def _elements(
        self, x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"], settings: Settings
    ) -> tuple[Float[np.ndarray, "p m"], Float[np.ndarray, "p m m"]]:
        filters = {str(name): self.filter_curve(str(name)) for name in np.unique(settings.filter)}
        if self.draws is not None:
            drawn = matrix_draws(self.model, self.draws, settings, filters, x, y)
            away = drawn - drawn.mean(axis=0)
            return drawn.mean(axis=0), np.einsum("dpi,dpj->pij", away, away) / (len(drawn) - 1)
        instrument = self.model.instrument(self.values)
        values, covariance = matrices(instrument, settings, filters, x, y, self.covariance)
        return values, covariance + self._of_structure(values)

    def protection(
        self, x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"], settings: Settings | None = None
    ) -> tuple[Float[np.ndarray, " p"], str]:
        """Largest error of q and u, at field positions (deg), of a mistake that would not have been found, and which.

        For stars polarised by up to 5 %, in one setting (default: the usual one); NaN where u is hardly measured, and
        where nobody asked.
        """
        if self.hidden is None or not len(self.hidden):
            return np.full(len(x), np.nan if self.hidden is None else 0.0), ""
        settings = self.usual_settings() if settings is None else settings
        filters = {str(settings.filter[0]): self.filter_curve(str(settings.filter[0]))}
        matrix, slopes = matrix_slopes(self.model.instrument(self.values), settings, filters, x, y)
        errors = np.array([change_of_qu(matrix, matrix + slopes @ change) for change in self.hidden.changes])
        worst = int(np.argmax(np.nan_to_num(errors).max(axis=1)))
        return np.nanmax(errors, axis=0), self.hidden.names[worst]

    def _of_structure(self, values: Float[np.ndarray, "p m"]) -> Float[np.ndarray, "p m m"]:
        """What the structure of field points adds to the covariance of the matrix at a place.

        Gains g of the two cameras of an arm change its elements by (g₁ − g₂)/2 · (1 − m₁², −m₁m₂, −m₁m₃), their
        responses to q and u the last two by half of their difference.
        """
        structure, size = self.verdict.structure, values.shape[1]
        added = np.zeros((len(values), size, size))
        for first in range(0, size if structure else 0, 3):
            m = values[:, first : first + 3]
            slope = np.array([1.0, 0.0, 0.0]) - m[:, :1] * m
            at = slice(first, first + 3)
            added[:, at, at] = 0.5 * structure.gain**2 * slope[:, :, None] * slope[:, None, :]
            added[:, at, at] += 0.5 * structure.response**2 * np.diag([0.0, 1.0, 1.0])
        return added

    def usual_settings(self, count: int = 1, filter_name: str = DEFAULT_FILTER) -> Settings:
        """Flat photon spectrum, 10 °C, on the meridian, moving elements out.

        Those `always_in` stand where they did in most exposures, as without them the instrument was never seen.
        """
        settings = Settings.default(count, filter_name)
        for prefix in self.always_in:
            angles, number = np.unique(self.exposures.position(prefix).angle, return_counts=True)
            settings = settings.at(**{prefix: float(angles[np.argmax(number)])})
        return settings

    @property
    def always_in(self) -> tuple[str, ...]:
        """Column prefixes of the moving elements, calibration plate apart, that were in the beam in all exposures."""
        moving = (p for p in self.model.template.patched().moving() if p != CALIBRATION_PLATE)
        return tuple(prefix for prefix in moving if self.exposures.position(prefix).inside.all())

    @property
    def left_behind(self) -> tuple[str, ...]:
        """Effects of the model of which a part belongs to its exposures, so that no matrix and no star can have it."""
        return carried.left_behind(self.model.template)

    def filter_curve(self, name: str) -> FilterCurve:
        """The curve of a filter; `DataError` with the nearest names when there is none."""
        if name in self.filters:
            return self.filters[name]
        if name in BUILTIN_FILTERS or single_wavelength(name) is not None:
            return builtin_filter(name)
        known = (*self.filters, *BUILTIN_FILTERS)
        raise DataError(f"FILTER: the calibration has no filter {name!r}; {nearest(name, known)}")

    def flags(
        self,
        x: Float[np.ndarray, " p"],
        y: Float[np.ndarray, " p"],
        settings: Settings,
        values: Float[np.ndarray, "p m"] | None = None,
    ) -> Int[np.ndarray, " p"]:
        """Bits of `Quality` at field positions: beyond the field or the settings; for matrices, high cross-talk.

        A single arm sees one combination of q and u, which has no inverse: it is marked only where it sees neither.
        """
        flags = np.zeros(len(x), np.int64)
        if values is not None:
            blocks = values.reshape(len(x), values.shape[1] // 3, 3)[:, :, 1:]
            known = np.all(np.isfinite(values), axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                condition = np.linalg.cond(np.where(known[:, None, None], blocks, np.eye(*blocks.shape[1:])))
            flags[~(condition <= HIGH_CROSSTALK)] |= Quality.HIGH_CROSSTALK
        margin = 0.5 / MAP_SIZE * (self.field[1] - self.field[0])
        low_x, low_y = self.field[0] - margin, self.field[2] - margin
        high_x, high_y = self.field[1] + margin, self.field[3] + margin
        flags[(x < low_x) | (x > high_x) | (y < low_y) | (y > high_y)] |= Quality.BEYOND_FIELD
        flags[self.beyond_settings(settings)] |= Quality.BEYOND_SETTINGS
        return flags

    def beyond_settings(self, settings: Settings) -> Bool[np.ndarray, " p"]:
        """Which settings have a filter, or where that matters a temperature, that the exposures do not cover."""
        beyond = ~np.isin(settings.filter, np.unique(self.exposures.filter))
        if "temperature" in needs(self.model.template).conditions:
            low, high = np.nanmin(self.exposures.temp), np.nanmax(self.exposures.temp)
            beyond |= settings.temperature < low - TEMPERATURE_MARGIN
            beyond |= settings.temperature > high + TEMPERATURE_MARGIN
        return beyond

    def maps(self, size: int = MAP_SIZE) -> MatrixMaps:
        """The matrix over the field on a regular grid, for a look at it.

        In `usual_settings`, through SDSS-r or the first filter of the exposures where they do not use that.
        """
        used = [str(name) for name in np.unique(self.exposures.filter)]
        name = DEFAULT_FILTER if DEFAULT_FILTER in used or not used else used[0]
        half = float(np.ceil(np.max(np.abs(self.field)) * 50.0) / 50.0) or 0.3
        step = 2.0 * half / (size - 1)
        centre = 0.5 * (size + 1)
        grid = Grid(size, size, (centre, centre), (0.0, 0.0), ((step, 0.0), (0.0, step)))
        points = grid.points
        settings = self.usual_settings(size * size, name)
        values, covariance = self._elements(points.x, points.y, settings)
        errors = np.sqrt(np.clip(np.diagonal(covariance, axis1=1, axis2=2), 0.0, None))
        planes = (-1, size, size)
        return MatrixMaps(
            grid, name, values.T.reshape(planes), errors.T.reshape(planes), settings[:1].further()
        )

    # ------------------------------------------------------------------------------- into a file and back

    def to_product(self) -> CalibrationProduct:
        """The record that `write_product` writes; its texts are in plain ASCII."""
        parameters = self.model.parameters
        priors = np.array([p.prior or (np.nan, np.nan) for p in parameters]).reshape(-1, 2)
        maps = self.maps()
        against = tuple(
            dataclasses.replace(doubt, sentence=in_ascii(doubt.sentence)) for doubt in self.verdict.against
        )
        return CalibrationProduct(
            instrument=self.model.name,
            site=self.site,
            origin=in_ascii(self.origin),
            date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds").replace("+00:00", ""),
            verdict=dataclasses.replace(self.verdict, against=against),
            parameters=ParameterTable(
                name=np.array([p.name for p in parameters]),
                value=self.values,
                sigma=self.sigma,
                unit=np.array([p.unit for p in parameters]),
                prior_mean=priors[:, 0],
                prior_width=priors[:, 1],
                free=np.array([p.free and p.tie is None for p in parameters]),
            ),
            covariance=self.covariance,
            maps=maps,
            field=self.field,
            exposures=self.exposures,
            filters=self.filters,
            sources=self.sources,
            model=tuple(_lines(render(self.model))),
            inputs=self.inputs,
            versions=software_versions(),
            residuals=self.residuals,
            description=tuple(_lines(self.model.template.description)),
            hidden=self.hidden,
        )

    @classmethod
    def from_product(
        cls, product: CalibrationProduct, catalogue: Sequence[type[Effect]] = EFFECTS
    ) -> Calibration:
        """The calibration that a product holds; parameters go by name, whatever their order there.

        `catalogue` are the effects that its model may have.
        Raises ValueError if the model of the product cannot be rebuilt, or has other parameters than it
        lists.
        """
        model = model_of_product(product, catalogue)
        names = [str(name) for name in product.parameters.name]
        if sorted(model.names) != sorted(names):
            odd = sorted(set(model.names) ^ set(names)) or ["one of them twice"]
            raise DataError(
                f"the model of the product has other parameters than it lists ({', '.join(odd[:3])}): it was "
                "made by a version with other physics; fit again"
            )
        place = {name: n for n, name in enumerate(names)}
        order = np.array([place[name] for name in model.names])
        return cls(
            model=model,
            values=product.parameters.value[order],
            covariance=product.covariance[np.ix_(order, order)],
            verdict=product.verdict,
            filters=product.filters,
            exposures=product.exposures,
            sources=product.sources,
            site=product.site,
            origin=product.origin,
            field=product.field,
            inputs=product.inputs,
            residuals=product.residuals,
            hidden=None
            if product.hidden is None
            else dataclasses.replace(product.hidden, changes=product.hidden.changes[:, order]),
        )


def _lines(text: str) -> Iterator[str]:
    return (in_ascii(line) for line in text.splitlines() if line.strip())


def instrument_as_designed(product: CalibrationProduct) -> Instrument:
    """The instrument of a product as designed, from the description that it holds or that comes with the package.

    Raises `DataError` for elements that only the fit has known: such a product is rebuilt where they are known.
    """
    if not product.description:
        return nominal_instrument(product.instrument)
    return build(
        parsed("\n".join(product.description), f"the description of {product.instrument} in the product")
    )


def model_of_product(product: CalibrationProduct, catalogue: Sequence[type[Effect]] = EFFECTS) -> Model:
    """The model of a product from its lines of TOML, its standards and its exposures."""
    sources = product.sources
    names = standard_names(sources)
    standards = list(zip(names, sources.q.tolist(), sources.u.tolist(), strict=True))
    design = instrument_as_designed(product)
    context = effect_context(adapted(design, standards=standards), product.exposures)
    text = "\n".join(product.model)
    return model_without_data(design, text, standards=standards, context=context, catalogue=catalogue)
