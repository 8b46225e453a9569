"""The instrument matrix anywhere in the field, with its covariance from the fit, and its derivatives.

Elements     three for each arm, m21, m22, m23, m31, … of `light.instrument_matrix`: band integrated, with throughput.
Covariance   C_m = J C_θ Jᵀ with the exact J; the throughput series enters through its local values.
Derivatives  to all parameters, and to the amplitudes of effects that are not there yet.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.calibration.accuracy import Matrices
from walop_jax.data.grid import Grid
from walop_jax.data.records import CalibrationSet, FilterCurve
from walop_jax.data.settings import Settings
from walop_jax.fit.verdict import Structure
from walop_jax.io.shapes import OfPoints
from walop_jax.likelihood import limits, optics
from walop_jax.likelihood.field_table import accurate_table, details_of, in_batches
from walop_jax.likelihood.optics import KnownOptics, directions, linearised, plain_positions, through_series
from walop_jax.model import light
from walop_jax.model.chebyshev import Rectangle
from walop_jax.model.compiled import array, compiled, usual_threads
from walop_jax.model.instrument import Instrument
from walop_jax.model.light_path import Scalar
from walop_jax.model.parameters import values_of, with_values
from walop_jax.model.plan import Plan
from walop_jax.model.planning import plan_for_settings
from walop_jax.model.specification import Model, series_indices

if TYPE_CHECKING:
    from walop_jax.fit.refit import FitResult

Slopes = Float[np.ndarray, "p a 3 n"]  # in all parameters
Filters = Mapping[str, FilterCurve]


def matrix_names(arms: int) -> tuple[str, ...]:
    """Names of the matrix elements of an instrument, three for each arm: M21, M22, M23, M31, … (two arms: to M33)."""
    return tuple(f"M{arm + 2}{column}" for arm in range(arms) for column in (1, 2, 3))


def residual_names(arms: int) -> tuple[str, ...]:
    """Quantities of a residual map: the matrix elements, and the throughput of each arm beside the first.

    The latter are RATIO for two arms (cameras N2, N3 of WALOP), RATIO2, RATIO3, … for more.
    """
    ratios = ("RATIO",) if arms == 2 else tuple(f"RATIO{arm}" for arm in range(2, arms + 1))
    return (*matrix_names(arms), *ratios)


@dataclasses.dataclass(frozen=True)
class MatrixMaps:
    """Maps of the elements of the instrument matrix over the field, for display; in the order of `matrix_names`.

    They are for the filter named, a flat photon spectrum, and the moving elements at `positions` (deg, by the prefix of
    their columns; an element without a position is out of the beam). Raises ValueError for another number of planes.
    """

    grid: Grid
    filter: str
    values: Float[np.ndarray, "m y x"]
    errors: Float[np.ndarray, "m y x"]
    positions: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.values) % 3 or not len(self.values):
            raise ValueError(f"{len(self.values)} maps of a matrix that has three elements for each arm")

    @property
    def arms(self) -> int:
        """Number of arms of the instrument, three maps for each."""
        return len(self.values) // 3

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the elements: M21, M22, …"""
        return matrix_names(self.arms)


@dataclasses.dataclass(frozen=True)
class ResidualMap:
    """Residuals of the smooth model in cells of the field: planes in the order of `residual_names`.

    They are to be added to the matrix elements (the throughput of an arm is a relative correction); NaN where a cell
    has too few data. `chi2` is χ² per degree of freedom of the residuals before the correction. They are for `filter`,
    with the moving elements at `positions` (deg, by the prefix of their columns; an element without a position is out
    of the beam). Raises ValueError for another number of planes.
    """

    grid: Grid
    filter: str
    values: Float[np.ndarray, "m y x"]
    errors: Float[np.ndarray, "m y x"]
    chi2: Float[np.ndarray, "y x"]
    positions: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.values) % 4 != 3:
            what = "for A arms there are 3 A elements and A − 1 throughputs"
            raise ValueError(f"{len(self.values)} planes, {what}")

    @property
    def arms(self) -> int:
        """Number of arms of the instrument."""
        return (len(self.values) + 1) // 4

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the planes, as `residual_names` gives them."""
        return residual_names(self.arms)

    def excess(self) -> dict[str, float]:
        """Rms over the field of every quantity beyond its standard errors; negative where chance makes it smaller than
        those.
        """
        rms = {}
        for name, value, error in zip(self.names, self.values, self.errors, strict=True):
            finite = np.isfinite(value)
            variance = float(np.mean(value[finite] ** 2 - error[finite] ** 2)) if finite.any() else np.nan
            rms[name] = float(np.sign(variance) * np.sqrt(abs(variance)))
        return rms

    def significance(self) -> float:
        """Excess scatter of all corrections over their errors, in standard deviations."""
        squares = (self.values / self.errors)[np.isfinite(self.values)] ** 2
        return float((squares.sum() - squares.size) / np.sqrt(2.0 * max(squares.size, 1)))


# ------------------------------------------------------------------------------------ vectors and their derivatives


def point_vectors(instrument: Instrument, plan: Plan, x: Scalar, y: Scalar) -> Float[Array, "b k 4"]:
    """Analysis vectors (band, camera, Stokes) at a field point for light behind the telescope, as a computation."""
    rows = light.band_rows(instrument, plan, x, y)
    return light.camera_vectors(instrument, rows, instrument.throughput.at(x, y), x, y)


def _vectors_at(
    instrument: Instrument, plan: Plan, x: Float[Array, " p"], y: Float[Array, " p"]
) -> tuple[Float[Array, "p b k 4"], Float[Array, "p 4 4"]]:
    """Analysis vectors for light behind the telescope, and the Mueller matrix of the telescope."""
    vectors = jax.vmap(functools.partial(point_vectors, instrument, plan))(x, y)
    return vectors, jax.vmap(functools.partial(light.telescope, instrument))(x, y)


def _slopes_at(
    instrument: Instrument, plan: Plan, known: KnownOptics, x: Float[Array, " p"], y: Float[Array, " p"]
) -> tuple[Float[Array, "p b k 3"], Float[Array, "p d b k 3"]]:
    """Analysis vectors (p, b, k, 3) for light from the sky, and their derivatives (p, d, b, k, 3), from known optics.

    Derivatives are in all parameters but the terms of the throughput, then in the throughputs at the field point.
    """
    to_instrument, index = with_values(instrument), jnp.asarray(directions(instrument, plan).index)

    def one(
        known: KnownOptics, x: Scalar, y: Scalar
    ) -> tuple[Float[Array, "b k 3"], Float[Array, "d b k 3"]]:
        def vectors(values: Float[Array, " n"], local: Float[Array, " k"]) -> Float[Array, "b k 3"]:
            changed, rows = to_instrument(values), optics.with_slopes(values, *known, index)
            seen = light.camera_vectors(changed, rows, local, x, y) @ light.telescope(changed, x, y)
            return seen[..., :3]

        derivatives = linearised(instrument, vectors, instrument.throughput.at(x, y))
        return derivatives.value, jnp.concatenate([derivatives.plain, derivatives.local])

    return jax.vmap(one)(known, x, y)


_vectors = compiled(_vectors_at, optimised_above=limits.OPTIMISED_ABOVE, kept_as="vectors")
_seen_slopes = compiled(_slopes_at, optimised_above=limits.OPTIMISED_ABOVE, kept_as="slopes")


def _slopes(
    instrument: Instrument, plan: Plan, *columns: OfPoints
) -> tuple[Float[Array, "p b k 3"], Float[Array, "p d b k 3"]]:
    """Analysis vectors and derivatives as of `_slopes_at`; `columns` as of `optics.known_optics`."""
    x, y, *numbers = map(array, columns)
    of_maps = dataclasses.replace(plan, work=limits.MAP_PLACES)
    return _seen_slopes(instrument, plan, optics.known_optics(instrument, of_maps, x, y, *numbers), x, y)


def analysis_vectors(
    instrument: Instrument, plan: Plan, x: OfPoints, y: OfPoints, *, from_sky: bool = False
) -> Float[np.ndarray, "p b k 4"]:
    """Analysis vectors (point, band, camera, Stokes) at field positions (deg), behind the telescope or `from_sky`."""
    plan = dataclasses.replace(plan, work=len(x))
    vectors, telescope = _in_chunks(lambda a, b: _vectors(instrument, plan, a, b), x, y)
    return vectors @ telescope[:, None] if from_sky else vectors


sky_vectors = functools.partial(analysis_vectors, from_sky=True)
"""Analysis vectors for light from the sky."""


def vector_slopes(
    instrument: Instrument, plan: Plan, x: OfPoints, y: OfPoints
) -> Float[np.ndarray, "p d b k 3"]:
    """Derivatives (p, d, b, k, 3) of `sky_vectors`: in all parameters but the series, then in the throughputs there."""
    return _in_chunks(lambda a, b: _slopes(instrument, plan, a, b), x, y)[1]


def _in_chunks(function: Callable[..., Any], *columns: Float[np.ndarray, " p"]) -> Any:
    """Results of a compiled function for the rows of columns; a chunk keeps one core busy."""
    return in_batches(function, *columns, size=limits.MATRIX_POINTS, threads=usual_threads())


# ----------------------------------------------------------------------------------------------------------- the matrix


def planned_matrices(instrument: Instrument, plan: Plan, x: OfPoints, y: OfPoints) -> Matrices:
    """Instrument matrices at field positions (deg) in the one setting of a plan."""
    return light.instrument_matrix(sky_vectors(instrument, plan, x, y)[:, 0], instrument.cameras.pairs)


def of_matrix(
    vectors: Float[np.ndarray, "... k 3"],
    added: Float[np.ndarray, "... k 3"],
    pairs: Sequence[tuple[int, int]],
) -> Float[np.ndarray, "... a 3"]:
    """Change of the instrument matrix, to first order, where the analysis vectors change.

    m = (a₁ − a₂) / (a₁₀ + a₂₀), a₁, a₂ the analysis vectors of the cameras of an arm.
    """
    i, j = (np.array([pair[n] for pair in pairs], int) for n in (0, 1))
    total = vectors[..., i, :1] + vectors[..., j, :1]
    common = light.instrument_matrix(vectors, tuple(pairs)) * (added[..., i, :1] + added[..., j, :1])
    return (added[..., i, :] - added[..., j, :] - common) / total


def _matrix_and_slopes(instrument: Instrument, plan: Plan) -> Callable[..., tuple[Matrices, Slopes]]:
    """A function of columns as those of `_slopes`: matrices in the one band of the plan, and their derivatives."""
    plain, series = plain_positions(instrument), series_indices(instrument)
    size, pairs = values_of(instrument).size, instrument.cameras.pairs

    def at(*columns: OfPoints) -> tuple[np.ndarray, np.ndarray]:
        vectors, slopes = (np.asarray(d)[..., 0, :, :] for d in _slopes(instrument, plan, *columns))
        change = np.moveaxis(of_matrix(vectors[:, None], slopes, pairs), 1, -1)
        basis = instrument.throughput.basis(*columns[:2])[:, None, None, None]
        result = np.empty((*change.shape[:-1], size))
        result[..., plain] = change[..., : len(plain)]
        result[..., series] = through_series(change[..., None, len(plain) :], basis)
        return light.instrument_matrix(vectors, pairs), result

    return at


def matrices(
    instrument: Instrument,
    settings: Settings,
    filters: Filters,
    x: OfPoints,
    y: OfPoints,
    covariance: Float[np.ndarray, "n n"],
) -> tuple[Float[np.ndarray, "p m"], Float[np.ndarray, "p m m"]]:
    """Elements of the instrument matrix (three for each arm) and their covariance at field positions (deg).

    `settings` has one row per position. Raises KeyError for a filter that `filters` does not hold and ValueError for a
    moving element that the instrument does not have.
    """
    size = 3 * len(instrument.cameras.pairs)
    values, errors = np.empty((len(x), size)), np.empty((len(x), size, size))
    for layout, rows in settings.layouts():
        plan = dataclasses.replace(plan_for_settings(instrument, layout, filters), work=len(x))
        exact = _matrix_and_slopes(instrument, plan)

        def with_covariance(*columns: OfPoints, exact: Any = exact) -> tuple[np.ndarray, np.ndarray]:
            elements, slopes = (a.reshape(len(a), size, *a.shape[3:]) for a in exact(*columns))
            return elements, slopes @ covariance @ np.swapaxes(slopes, 1, 2)

        values[rows], errors[rows] = _in_chunks(with_covariance, x[rows], y[rows], *_numbers(settings[rows]))
    return values, errors


def _numbers(settings: Settings) -> tuple[OfPoints, OfPoints, OfPoints]:
    """Settings that enter a program as numbers: colour temperature (0: flat), temperature, hour angle."""
    return np.nan_to_num(settings.teff), settings.temperature, settings.hour_angle


def matrix_draws(
    model: Model,
    draws: Float[np.ndarray, "d n"],
    settings: Settings,
    filters: Filters,
    x: OfPoints,
    y: OfPoints,
) -> Float[np.ndarray, "d p m"]:
    """Elements of the instrument matrix at field positions (deg) for every draw of all parameters."""
    result = np.empty((len(draws), len(x), 3 * len(model.template.cameras.pairs)))
    for setting, rows in settings.distinct():
        plan = plan_for_settings(model.instrument(draws.mean(axis=0)), setting, filters)
        for i, values in enumerate(draws):
            matrix = planned_matrices(model.instrument(values), plan, x[rows], y[rows])
            result[i, rows] = matrix.reshape(len(rows), -1)
    return result


# ------------------------------------------------------------------------------------------ derivatives


def matrix_slopes(
    instrument: Instrument,
    setting: Settings,
    filters: Filters,
    x: OfPoints,
    y: OfPoints,
) -> tuple[Matrices, Slopes]:
    """Instrument matrix (point, arm, element) at positions in degrees, and its derivatives to all parameters.

    `setting` has one row. Raises KeyError for a filter that `filters` does not hold.
    """
    if not instrument.cameras.pairs:  # no row, and nothing to compile
        return np.zeros((len(x), 0, 3)), np.zeros((len(x), 0, 3, values_of(instrument).size))
    plan = dataclasses.replace(plan_for_settings(instrument, setting, filters), work=len(x))
    numbers = (np.broadcast_to(number, len(x)) for number in _numbers(setting))
    return _in_chunks(_matrix_and_slopes(instrument, plan), x, y, *numbers)


def slopes_over_field(
    instrument: Instrument,
    setting: Settings,
    filters: Filters,
    x: OfPoints,
    y: OfPoints,
    covariance: Float[np.ndarray, "n n"],
    counts: Sequence[int],
    tolerance: float,
) -> tuple[Matrices, Slopes]:
    """The matrices and derivatives of `matrix_slopes` at many positions, interpolated where the optics are smooth.

    Numbers of nodes per side (`counts`) are tried in turn, until standard errors are right to `tolerance` (relative)
    wherever that is checked (`field_table.held_out`). No table is tried that has more nodes than half of the positions,
    as it would cost more than the positions themselves, and none beside local features, which no table follows.
    """
    exact = functools.partial(matrix_slopes, instrument, setting, filters)

    def error(interpolated: tuple[np.ndarray, np.ndarray], truth: tuple[np.ndarray, np.ndarray]) -> float:
        tables = interpolated, truth
        errors, true_errors = (np.sqrt(np.sum(s @ covariance * s, axis=-1)) for _, s in tables)
        return float(np.max(np.abs(errors - true_errors) / np.where(true_errors > 0, true_errors, 1.0)))

    corners = Rectangle(np.array([x.min(), y.min()]), np.array([x.max(), y.max()]))
    table, worth = None, [count for count in counts if 2 * count**2 <= len(x)]
    if worth and np.all(corners.high > corners.low) and not details_of(instrument):
        table, off = accurate_table(exact, corners, worth, tolerance, error)
        table = table if off <= tolerance else None
    return exact(x, y) if table is None else table(x, y)


def of_structure(structure: Structure, values: Float[np.ndarray, "p m"]) -> Float[np.ndarray, "p m m"]:
    """Covariance (p, m, m) of the matrix elements by structure of the field that is finer than the model.

    Gains g of the two cameras of an arm change its elements by (g₁ − g₂)/2 · (1 − m₁², −m₁m₂, −m₁m₃), their responses
    to q and u the last two by half of their difference.
    """
    size = values.shape[1]
    added = np.zeros((len(values), size, size))
    for first in range(0, size if structure else 0, 3):
        m = values[:, first : first + 3]
        slope = np.array([1.0, 0.0, 0.0]) - m[:, :1] * m
        at = slice(first, first + 3)
        added[:, at, at] = 0.5 * structure.gain**2 * slope[:, :, None] * slope[:, None, :]
        added[:, at, at] += 0.5 * structure.response**2 * np.diag([0.0, 1.0, 1.0])
    return added


# ----------------------------------------------------------------------------------------- at the field points of a fit


def first_setting(calset: CalibrationSet, instrument: Instrument, exposure: int = 0) -> Settings:
    """The setting of one exposure of a set, by default the first: its filter and positions; all else as by default."""
    first = Settings.of(calset.exposures[exposure : exposure + 1], instrument.patched().moving())
    return Settings.default(1, str(first.filter[0])).at(**first.positions)


def instrument_matrices(result: FitResult) -> Matrices:
    """Instrument matrix at the field points of a fit, in the filter and plate setting of its first exposure."""
    instrument, calset = result.model.instrument(result.values), result.calset
    plan = plan_for_settings(instrument, first_setting(calset, instrument), calset.filters)
    return planned_matrices(instrument, plan, calset.points.x, calset.points.y)
