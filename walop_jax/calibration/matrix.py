"""The instrument matrix anywhere in the field, with its covariance from the fit, and its derivatives.

Elements     three for each arm, m21, m22, m23, m31, … of `light.instrument_matrix`: band integrated, with throughput.
Covariance   C_m = J C_θ Jᵀ with the exact J; the throughput series enters through its local values.
Derivatives  to all parameters, and to the amplitudes of effects that are not there yet.

Impact       m = m₀ + A s with s = (q, u), so a star that is calibrated with (m₀, A) while (m₀ + δm₀, A + δA) is true
comes out wrong by A⁻¹ (δm₀ + δA s), at most |A⁻¹ δm₀| + p ‖A⁻¹ δA‖.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from walop_jax.calibration.thresholds import SMALLEST_DETERMINANT
from walop_jax.data.frames import Grid
from walop_jax.data.records import CalibrationSet, FilterCurve
from walop_jax.data.settings import Settings
from walop_jax.fit.refit import FitResult
from walop_jax.fit.verdict import Structure
from walop_jax.likelihood import limits, optics
from walop_jax.likelihood.field_table import Vector, accurate_table
from walop_jax.likelihood.optics import linearised, to_all
from walop_jax.likelihood.runner import usual_threads
from walop_jax.model import light
from walop_jax.model.chebyshev import Rectangle
from walop_jax.model.compiled import array, compiled
from walop_jax.model.effects.base import Effect, with_amplitudes
from walop_jax.model.instrument import Instrument, Scalar
from walop_jax.model.parameters import values_of, with_values
from walop_jax.model.plan import Plan, with_numbers
from walop_jax.model.planning import plan_for_settings
from walop_jax.model.specification import Model


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
    """The elements of the instrument matrix over the field, for a look: order of `matrix_names`, three per arm.

    For the filter named, a flat photon spectrum, and the moving elements at `positions` (deg by column prefix; those
    not there are out). Raises ValueError for another number of planes.
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
        """Number of arms."""
        return len(self.values) // 3

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the elements."""
        return matrix_names(self.arms)


@dataclasses.dataclass(frozen=True)
class ResidualMap:
    """Residuals of the smooth model in cells of the field: planes in the order of `residual_names`.

    To be added to the matrix (throughput of an arm: relative); NaN where a cell has too few data. `chi2` is that of the
    residuals before the correction, per degree of freedom. Through `filter`, with the moving elements at `positions`
    (deg by column prefix; those not there are out). Raises ValueError for another number of planes.
    """

    grid: Grid
    filter: str
    values: Float[np.ndarray, "m y x"]
    errors: Float[np.ndarray, "m y x"]
    chi2: Float[np.ndarray, "y x"]
    positions: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.values) % 4 != 3:
            raise ValueError(
                f"{len(self.values)} planes, for A arms there are 3 A elements and A − 1 throughputs"
            )

    @property
    def arms(self) -> int:
        """Number of arms."""
        return (len(self.values) + 1) // 4

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities."""
        return residual_names(self.arms)

    def excess(self) -> dict[str, float]:
        """Rms over the field of every quantity beyond its standard errors; negative if below, as chance has it."""
        found = {}
        for name, value, error in zip(self.names, self.values, self.errors, strict=True):
            known = np.isfinite(value)
            variance = float(np.mean(value[known] ** 2 - error[known] ** 2)) if known.any() else np.nan
            found[name] = float(np.sign(variance) * np.sqrt(abs(variance)))
        return found

    def significance(self) -> float:
        """Excess scatter of all corrections over their errors, in standard deviations."""
        squares = (self.values / self.errors)[np.isfinite(self.values)] ** 2
        return float((squares.sum() - squares.size) / np.sqrt(2.0 * max(squares.size, 1)))


# ----------------------------------------------------------------------------------------------------------- the matrix


STARS, LARGEST_P = 100, 0.05


def point_vectors(instrument: Instrument, plan: Plan, x: Scalar, y: Scalar) -> Float[Array, "b k 4"]:
    """Analysis vectors (band, camera, Stokes) at a field point for light behind the telescope, as a computation."""
    rows = light.band_rows(instrument, plan, x, y)
    return light.camera_vectors(instrument, rows, instrument.throughput.at(x, y), x, y)


def point_sky_vectors(instrument: Instrument, plan: Plan, x: Scalar, y: Scalar) -> Float[Array, "b k 4"]:
    """Analysis vectors (band, camera, Stokes) at a field point for light from the sky, inside a computation."""
    return point_vectors(instrument, plan, x, y) @ light.telescope(instrument, x, y)


def point_matrix(
    instrument: Instrument, plan: Plan, x: Scalar, y: Scalar
) -> tuple[Float[Array, "b a 3"], Float[Array, "b a 3 n"]]:
    """Instrument matrices of a field point and their derivatives with respect to all parameters."""
    to_instrument = with_values(instrument)

    def matrix(values: Float[Array, " n"], local: Float[Array, " k"]) -> Float[Array, "b a 3"]:
        there, rows = to_instrument(values), optics.band_rows(values, instrument, plan, x, y)
        vectors = light.camera_vectors(there, rows, local, x, y)
        return light.instrument_matrix(vectors @ light.telescope(there, x, y), there.cameras.pairs)

    m, plain, local = linearised(instrument, matrix, instrument.throughput.at(x, y))
    return m, to_all(instrument, plain, local, instrument.throughput.basis(x, y)[None])


def _slopes_at(
    instrument: Instrument, plan: Plan, *columns: Float[Array, " p"]
) -> tuple[Float[Array, "p m"], Float[Array, "p m n"]]:
    """At rows of x, y (deg), colour temperature (0: flat), temperature and hour angle; the plan has one band."""

    def one(x: Scalar, y: Scalar, *numbers: Scalar) -> tuple[Float[Array, "b a 3"], Float[Array, "b a 3 n"]]:
        return point_matrix(instrument, with_numbers(plan, *numbers), x, y)

    m, slopes = jax.vmap(one)(*columns)
    size = m.shape[2] * 3
    return m[:, 0].reshape(len(m), size), slopes[:, 0].reshape(len(m), size, slopes.shape[-1])


_slopes = compiled(_slopes_at, kept_as="slopes")
_vectors = compiled(jax.vmap(point_vectors, in_axes=(None, None, 0, 0)), kept_as="vectors")
_sky_vectors = compiled(jax.vmap(point_sky_vectors, in_axes=(None, None, 0, 0)), kept_as="sky_vectors")


def analysis_vectors(
    instrument: Instrument,
    plan: Plan,
    x: Vector,
    y: Vector,
    *,
    from_sky: bool = False,
) -> Float[np.ndarray, "p b k 4"]:
    """Analysis vectors (point, band, camera, Stokes) at field positions in degrees.

    For light behind the telescope, or `from_sky`, which passes the telescope first.
    """
    program, once = _sky_vectors if from_sky else _vectors, len(x) <= limits.MATRICES_ONCE
    return in_chunks(lambda a, b: (program(instrument, plan, a, b, once=once),), x, y)[0]


sky_vectors = functools.partial(analysis_vectors, from_sky=True)
"""Analysis vectors for light from the sky."""


def planned_matrices(instrument: Instrument, plan: Plan, x: Vector, y: Vector) -> Float[np.ndarray, "p a 3"]:
    """Instrument matrices at field positions (deg) in the one setting of a plan."""
    return light.instrument_matrix(sky_vectors(instrument, plan, x, y)[:, 0], instrument.cameras.pairs)


def matrices(
    instrument: Instrument,
    settings: Settings,
    filters: Mapping[str, FilterCurve],
    x: Vector,
    y: Vector,
    covariance: Float[np.ndarray, "n n"],
) -> tuple[Float[np.ndarray, "p m"], Float[np.ndarray, "p m m"]]:
    """Elements of the instrument matrix (three for each arm) and their covariance at field positions (deg).

    `settings` has one row per position. Raises KeyError for a filter that `filters` does not hold and ValueError for a
    moving element that the instrument does not have.
    """
    size = 3 * len(instrument.cameras.pairs)
    values, errors = np.empty((len(x), size)), np.empty((len(x), size, size))
    once = len(x) <= limits.MATRICES_ONCE
    for layout, rows in settings.layouts():
        plan = plan_for_settings(instrument, layout, filters)

        def part(*columns: Array, plan: Plan = plan) -> tuple[np.ndarray, np.ndarray]:
            found, slopes = map(np.asarray, _slopes(instrument, plan, *columns, once=once))
            return found, slopes @ covariance @ np.swapaxes(slopes, 1, 2)

        values[rows], errors[rows] = in_chunks(part, x[rows], y[rows], *_numbers(settings[rows]))
    return values, errors


def _numbers(settings: Settings) -> tuple[Vector, Vector, Vector]:
    """Settings that enter a program as numbers: colour temperature (0: flat), temperature, hour angle."""
    return np.nan_to_num(settings.teff), settings.temperature, settings.hour_angle


def matrix_draws(
    model: Model,
    draws: Float[np.ndarray, "d n"],
    settings: Settings,
    filters: Mapping[str, FilterCurve],
    x: Vector,
    y: Vector,
) -> Float[np.ndarray, "d p m"]:
    """Elements of the instrument matrix at field positions (deg) for every draw of all parameters."""
    result = np.empty((len(draws), len(x), 3 * len(model.template.cameras.pairs)))
    for setting, rows in settings.distinct():
        plan = plan_for_settings(model.instrument(draws.mean(axis=0)), setting, filters)
        for i, values in enumerate(draws):
            matrix = planned_matrices(model.instrument(values), plan, x[rows], y[rows])
            result[i, rows] = matrix.reshape(len(rows), -1)
    return result


def in_chunks(
    function: Callable[..., tuple[Array | np.ndarray, ...]], *columns: Float[np.ndarray, " p"]
) -> tuple[np.ndarray, ...]:
    """Apply a compiled function to slices of the columns, padded to `limits.MATRIX_POINTS` rows."""
    count, size = len(columns[0]), limits.MATRIX_POINTS

    def solved(start: int) -> list[np.ndarray]:
        slices = [column[start : start + size] for column in columns]
        missing = size - len(slices[0])
        # Padding with the last row keeps the arithmetic as tame as that of the data.
        result = function(*(array(np.pad(part, (0, missing), mode="edge")) for part in slices))
        return [np.asarray(part)[: size - missing] for part in result]

    # The first slice compiles; a slice keeps one core busy.
    parts = [solved(0)]
    with ThreadPoolExecutor(usual_threads()) as pool:
        parts += pool.map(solved, range(size, count, size))
    return tuple(np.concatenate(parts) for parts in zip(*parts, strict=True))


# ------------------------------------------------------------------------------------------ derivatives


def matrix_slopes(
    instrument: Instrument, setting: Settings, filters: Mapping[str, FilterCurve], x: Vector, y: Vector
) -> tuple[Float[np.ndarray, "p a 3"], Float[np.ndarray, "p a 3 n"]]:
    """Instrument matrix (point, arm, element) at positions in degrees, and its derivatives to all parameters.

    `setting` has one row. Raises KeyError for a filter that `filters` does not hold.
    """
    if not instrument.cameras.pairs:  # no row, and nothing to compile
        return np.zeros((len(x), 0, 3)), np.zeros((len(x), 0, 3, values_of(instrument).size))
    plan = plan_for_settings(instrument, setting, filters)
    numbers = (np.broadcast_to(number, len(x)) for number in _numbers(setting))
    once = len(x) <= limits.MATRICES_ONCE
    values, slopes = in_chunks(lambda *at: _slopes(instrument, plan, *at, once=once), x, y, *numbers)
    arms = (len(x), values.shape[1] // 3, 3)
    return values.reshape(arms), slopes.reshape(*arms, slopes.shape[-1])


def slopes_over_field(
    instrument: Instrument,
    setting: Settings,
    filters: Mapping[str, FilterCurve],
    x: Vector,
    y: Vector,
    covariance: Float[np.ndarray, "n n"],
    counts: Sequence[int],
    tolerance: float,
) -> tuple[Float[np.ndarray, "p a 3"], Float[np.ndarray, "p a 3 n"]]:
    """`matrix_slopes` at many positions, interpolated where the optics are smooth.

    `counts` of nodes per side are tried in turn, until standard errors are right to `tolerance` (relative) wherever
    that is checked (`field_table.held_out`).
    """

    def exact(x: Vector, y: Vector) -> tuple[np.ndarray, np.ndarray]:
        return matrix_slopes(instrument, setting, filters, x, y)

    def error(found: tuple[np.ndarray, np.ndarray], truth: tuple[np.ndarray, np.ndarray]) -> float:
        ours, theirs = (
            np.sqrt(np.sum(slopes @ covariance * slopes, axis=-1)) for _, slopes in (found, truth)
        )
        return float(np.max(np.abs(ours - theirs) / np.where(theirs > 0, theirs, 1.0)))

    corners = Rectangle(np.array([x.min(), y.min()]), np.array([x.max(), y.max()]))
    table = None
    if len(x) > counts[0] ** 2 and np.all(corners.high > corners.low):
        table, off = accurate_table(exact, corners, counts, tolerance, error)
        table = table if off <= tolerance else None
    return exact(x, y) if table is None else table(x, y)


def of_structure(structure: Structure, values: Float[np.ndarray, "p m"]) -> Float[np.ndarray, "p m m"]:
    """Contribution of the structure of field points to the covariance of the matrix at a place.

    Gains g of the two cameras of an arm change its elements by (g₁ − g₂)/2 · (1 − m₁², −m₁m₂, −m₁m₃), their
    responses to q and u the last two by half of their difference.
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


def errors_of_changes(
    matrix: Float[np.ndarray, "p a 3"],
    slopes: Float[np.ndarray, "p a 3 n"],
    changes: Float[np.ndarray, "c n"],
) -> Float[np.ndarray, "c p"]:
    """`change_of_qu` of every change of all parameters, to first order."""
    return np.array([change_of_qu(matrix, matrix + slopes @ change) for change in changes])


def change_of_qu(
    assumed: Float[np.ndarray, "p a 3"], true: Float[np.ndarray, "p a 3"], p: float = LARGEST_P
) -> Float[np.ndarray, " p"]:
    """Largest error of q and u at each field point for stars polarised by up to `p`; NaN where not measured."""
    found = np.full(len(assumed), np.nan)
    if assumed.shape[1] != 2:  # one exposure of one arm, or of three, does not give q and u and nothing else
        return found
    good = np.abs(np.linalg.det(assumed[:, :, 1:])) > SMALLEST_DETERMINANT
    inverse = np.linalg.inv(assumed[good, :, 1:])
    change = (true - assumed)[good]
    offset = np.linalg.norm(inverse @ change[:, :, :1], axis=(1, 2))
    found[good] = offset + p * np.linalg.norm(inverse @ change[:, :, 1:], ord=2, axis=(1, 2))
    return found


def sample_stars(count: int = STARS, seed: int = 0) -> Float[np.ndarray, "n 2"]:
    """(q, u) of sources with p evenly up to `LARGEST_P` and any angle."""
    rng = np.random.default_rng(seed)
    p, angle = rng.uniform(0.0, LARGEST_P, count), rng.uniform(0.0, np.pi, count)
    return np.stack([p * np.cos(2 * angle), p * np.sin(2 * angle)], axis=1)


def p_errors(
    matrix: Float[np.ndarray, "p 6"], covariance: Float[np.ndarray, "p 6 6"], stars: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " p"]:
    """Error of p for stars (q, u), rms over them, from the six elements of the matrix and their covariance."""
    form = p_forms(matrix, stars)
    variance = np.einsum("pni,pij,pnj->pn", form, covariance, form, optimize=True)
    return np.sqrt(np.mean(variance, axis=1))


def p_forms(
    matrix: Float[np.ndarray, "p 6"], stars: Float[np.ndarray, "*b n 2"]
) -> Float[np.ndarray, "p n 6"]:
    """δp = −e · M⁻¹ · (δm s) of every star as a linear form of the six elements; the same stars (q, u), or of each."""
    stars = np.broadcast_to(stars, (len(matrix), *stars.shape[-2:]))
    with np.errstate(divide="ignore", invalid="ignore"):
        (a, b), (c, d) = matrix[:, 1:3].T, matrix[:, 4:].T
        inverse = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], 1) / (a * d - b * c)[:, None, None]
        along = stars / np.hypot(stars[..., :1], stars[..., 1:])
        s = np.concatenate([np.ones((*stars.shape[:2], 1)), stars], axis=2)
        left = np.einsum("pnc,pcr->pnr", along, inverse)
        return np.einsum("pnr,pns->pnrs", left, s).reshape(*stars.shape[:2], 6)


def effect_slopes(
    instrument: Instrument,
    setting: Settings,
    filters: Mapping[str, FilterCurve],
    x: Vector,
    y: Vector,
    effects: tuple[Effect, ...],
) -> Float[np.ndarray, "p a 3 e"]:
    """Derivatives of the matrix with respect to the amplitudes of neutral effects, effect by effect in their order.

    What of an effect does not go with the matrix (single exposures, ghosts, detectors) has none.
    """
    if not effects:
        return np.zeros((len(x), len(instrument.cameras.pairs), 3, 0))
    there = dataclasses.replace(instrument, effects=(*instrument.effects, *effects))
    plan = plan_for_settings(there, setting, filters)
    return in_chunks(lambda a, b: (_effect_slopes(instrument, plan, effects, a, b),), x, y)[0][:, 0]


def _point_effect_slopes(
    instrument: Instrument, plan: Plan, effects: tuple[Effect, ...], x: Scalar, y: Scalar
) -> Float[Array, "b a 3 e"]:
    neutral, put = with_amplitudes(instrument, effects)

    def matrix(amplitudes: list[Float[Array, ...]]) -> Float[Array, "b a 3"]:
        there = put(amplitudes)
        return light.instrument_matrix(point_sky_vectors(there, plan, x, y), there.cameras.pairs)

    _, push = jax.linearize(matrix, neutral)
    flat, to_tree = ravel_pytree(neutral)
    return jnp.moveaxis(jax.vmap(lambda one: push(to_tree(one)))(jnp.eye(flat.size)), 0, -1)


_effect_slopes = compiled(
    jax.vmap(_point_effect_slopes, in_axes=(None, None, None, 0, 0)), kept_as="effect_slopes"
)


# ----------------------------------------------------------------------------------------- at the field points of a fit


def first_setting(calset: CalibrationSet, instrument: Instrument, exposure: int = 0) -> Settings:
    """Filter and positions of an exposure of a set, its first, all else as by default."""
    first = Settings.of(calset.exposures[exposure : exposure + 1], instrument.patched().moving())
    return Settings.default(1, str(first.filter[0])).at(**first.positions)


def instrument_matrices(result: FitResult) -> Float[np.ndarray, "p a 3"]:
    """Instrument matrix at the field points of a fit, in the filter and plate setting of its first exposure."""
    instrument, calset = result.model.instrument(result.values), result.calset
    plan = plan_for_settings(instrument, first_setting(calset, instrument), calset.filters)
    return planned_matrices(instrument, plan, calset.points.x, calset.points.y)


def largest_change(
    assumed: Float[np.ndarray, "p a 3"], true: Float[np.ndarray, "p a 3"], p: float = LARGEST_P
) -> float:
    """Largest of `change_of_qu` over the field; NaN when no point holds both q and u."""
    found = change_of_qu(assumed, true, p)
    return float(np.nanmax(found)) if np.isfinite(found).any() else float("nan")
