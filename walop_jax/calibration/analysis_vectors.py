"""Analysis vectors at any field point and colour, with their derivatives: what turns counts into Stokes parameters.

    N_k = F a_k · (1, q, u)            camera k = O1, E1, O2, E2; light is linear (`model/light.py`)

The vectors of one optical setting (filter, calibration plate, temperature, hour angle) are computed at a few
hundred field points and colours and interpolated between them; every series is checked against vectors computed
where it has no node. A setting has one table, whatever the catalogue that asks for it.

The derivatives have the structure of the fit (`likelihood/engine.py`): a few parameters of the optics act
directly, the throughput series only through its four local values.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.field_series import FieldSeries, colour_nodes, colour_weights, field_nodes
from walop_jax.calibration.matrix import Settings, settings_plan
from walop_jax.likelihood import limits
from walop_jax.likelihood.nodes import rows_and_slopes
from walop_jax.model import light
from walop_jax.model.compiled import compiled
from walop_jax.model.dependence import optical_indices
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import values_of, with_values
from walop_jax.model.plan import Plan
from walop_jax.model.specification import series_indices

COLOURS = 12  # colour temperatures of the vectors
DERIVATIVE_COLOURS = 3
FIELD_TERMS = (20, 28, 40, 56, 80)  # tried in turn
DERIVATIVE_TERMS = (14, 20, 28, 40)
TOLERANCE = 1e-7  # of a vector's largest element
DERIVATIVE_TOLERANCE = 1e-3  # of a derivative's largest value: errors of errors
REACH = 1.25  # of the calibrated field: beyond, no polynomial of the throughput means anything


class Setting(NamedTuple):
    """What the optics are computed for, field point and colour apart.

    Filter name; angle of the calibration plate (deg, None: out); temperature (Celsius); hour angle (h).
    """

    filter: str
    plate: float | None = None
    temperature: float = 10.0
    hour_angle: float = 0.0


class Local(NamedTuple):
    """Derivatives of the vectors at a field point: to the parameters of the optics, to the four throughputs."""

    plain: Float[np.ndarray, "p 4 3 o"]
    throughput: Float[np.ndarray, "p 4 3 4"]


def _vectors(
    instrument: Instrument, plan: Plan, x: Float[Array, ""], y: Float[Array, ""]
) -> Float[Array, "b k 3"]:
    rows = light.band_rows(instrument, plan, x, y)
    vectors = light.camera_vectors(instrument, rows, light.throughput_at(instrument, x, y), x, y)
    return (vectors @ light.telescope(instrument, x, y))[..., :3]


def _derivatives(
    instrument: Instrument, plan: Plan, x: Float[Array, ""], y: Float[Array, ""]
) -> Float[Array, "n2 b k 3"]:
    """Derivatives to all parameters (zero for the throughput series), then to the four local throughputs."""
    values, to_instrument = values_of(instrument), with_values(instrument)
    optical = np.asarray(optical_indices(instrument), int)
    plain = np.setdiff1d(np.arange(values.size), np.asarray(series_indices(instrument), int))

    def vectors(
        rows: Float[Array, "b r 4"], all_values: Float[Array, " n"], local: Float[Array, " k"]
    ) -> Float[Array, "b k 3"]:
        there = to_instrument(all_values)
        return (light.camera_vectors(there, rows, local, x, y) @ light.telescope(there, x, y))[..., :3]

    rows, slopes = rows_and_slopes(instrument, plan, x, y)
    out, push = jax.linearize(vectors, rows, values, light.throughput_at(instrument, x, y))
    no_rows, no_values, no_local = (
        jnp.zeros_like(rows),
        jnp.zeros_like(values),
        jnp.zeros(len(instrument.cameras)),
    )
    d_rows = jnp.zeros((values.size, *rows.shape)).at[optical].set(slopes)
    d_plain = jax.vmap(lambda dr, dv: push(dr, dv, no_local))(d_rows[plain], jnp.eye(values.size)[plain])
    d_local = jax.vmap(lambda dt: push(no_rows, no_values, dt))(jnp.eye(no_local.size))
    return jnp.concatenate([jnp.zeros((values.size, *out.shape)).at[plain].set(d_plain), d_local])


_vectors_at = compiled(jax.vmap(_vectors, in_axes=(None, None, 0, 0)))
_derivatives_at = compiled(jax.vmap(_derivatives, in_axes=(None, None, 0, 0)))


@dataclasses.dataclass(frozen=True)
class _Table:
    """The series of one setting: vectors and derivatives, functions in the order (colour, camera, Stokes, …)."""

    vectors: FieldSeries
    derivatives: FieldSeries


class AnalysisVectors:
    """The analysis vectors of a calibration, ready to be asked for at many field points.

    `parameters` are the positions, in the calibration's list, of the parameters that the vectors depend on;
    `root` is a square root of their covariance, C = root rootᵀ. Positions reach to ±`half_width` (deg).
    """

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.instrument = calibration.model.instrument(calibration.values)
        reach = REACH * float(np.abs(calibration.field).max())
        self.half_width = min(calibration.model.template.field_limit, reach)
        self._tables: dict[Setting, _Table] = {}
        series = np.asarray(series_indices(self.instrument), int)
        uncertain = np.diag(calibration.covariance) > 0
        plain = np.setdiff1d(np.arange(len(calibration.values)), series)
        self._plain: Int[np.ndarray, " o"] = plain[uncertain[plain]]
        self.parameters: Int[np.ndarray, " k"] = np.concatenate([self._plain, series])
        value, vector = np.linalg.eigh(calibration.covariance[np.ix_(self.parameters, self.parameters)])
        self.root: Float[np.ndarray, "k k"] = vector * np.sqrt(np.clip(value, 0.0, None))

    # ------------------------------------------------------------------------------------ asking

    def at(
        self, setting: Setting, x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]
    ) -> Float[np.ndarray, "p c 4 3"]:
        """Vectors (point, colour, camera, Stokes) for the spectra that `colour_weights` mixes."""
        values = self._table(setting).vectors(x, y)
        return values.reshape(len(x), COLOURS + 1, 4, 3)

    def coloured(
        self,
        setting: Setting,
        x: Float[np.ndarray, " p"],
        y: Float[np.ndarray, " p"],
        teff: Float[np.ndarray, " p"] | None = None,
    ) -> Float[np.ndarray, "p 4 3"]:
        """Vectors (point, camera, Stokes) for sources of colour temperature `teff` (K; NaN, None: flat)."""
        teff = np.full(len(x), np.nan) if teff is None else teff
        return np.einsum("pc,pcks->pks", colour_weights(teff, COLOURS), self.at(setting, x, y))

    def derivatives(
        self,
        setting: Setting,
        x: Float[np.ndarray, " p"],
        y: Float[np.ndarray, " p"],
        teff: Float[np.ndarray, " p"],
    ) -> Local:
        """Derivatives of the vectors to the plain parameters and to the local throughputs."""
        weights = colour_weights(teff, DERIVATIVE_COLOURS)
        size = len(self._plain) + 4
        values = self._table(setting).derivatives(x, y).reshape(len(x), DERIVATIVE_COLOURS + 1, 12 * size)
        mixed = np.einsum("pc,pcf->pf", weights, values).reshape(len(x), 4, 3, size)
        return Local(mixed[..., :-4], mixed[..., -4:])

    def to_parameters(
        self,
        plain: Float[np.ndarray, "p 2 o"],
        throughput: Float[np.ndarray, "p 2 4"],
        x: Float[np.ndarray, " p"],
        y: Float[np.ndarray, " p"],
    ) -> Float[np.ndarray, "p 2 k"]:
        """Derivatives to `parameters`: those to the local throughputs are spread over the series."""
        basis = np.asarray(self.instrument.throughput.basis(jnp.asarray(x), jnp.asarray(y)))
        spread = throughput[..., None] * basis[:, None, None, :]
        return np.concatenate([plain, spread.reshape(*plain.shape[:2], -1)], axis=-1)

    # ------------------------------------------------------------------------------------ making the tables

    def exact(
        self, setting: Setting, x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"], teff: list[float]
    ) -> Float[np.ndarray, "p c 4 3"]:
        """Vectors (point, colour, camera, Stokes) without any table; `teff` NaN is a flat spectrum."""
        plan, bands = self._plan(setting, teff)
        return _in_chunks(lambda a, b: _vectors_at(self.instrument, plan, a, b), x, y)[:, bands]

    def _plan(self, setting: Setting, teff: list[float]) -> tuple[Plan, Int[np.ndarray, " c"]]:
        n = len(teff)
        plate = np.nan if setting.plate is None else setting.plate
        settings = Settings(
            filter=np.full(n, setting.filter),
            teff=np.array(teff),
            chwp_angle=np.full(n, plate),
            temp=np.full(n, setting.temperature),
            ha=np.full(n, setting.hour_angle),
        )
        curve = self.calibration.filter_curve(setting.filter)
        plan = settings_plan(settings, {setting.filter: curve}, self.instrument)
        return plan, np.asarray(plan.band_of)[:, 0]

    def _table(self, setting: Setting) -> _Table:
        if setting not in self._tables:
            self._tables[setting] = _Table(self._vector_series(setting), self._derivative_series(setting))
        return self._tables[setting]

    def _vector_series(self, setting: Setting) -> FieldSeries:
        teff = [np.nan, *colour_nodes(COLOURS).tolist()]
        x, y = np.random.default_rng(1).uniform(-self.half_width, self.half_width, (2, limits.VECTOR_CHECKS))
        between = [2300.0, 3500.0, 5772.0, 12000.0]
        truth = self.exact(setting, x, y, [*between, np.nan])
        weights = colour_weights(np.array([*between, np.nan]), COLOURS)
        error = np.inf
        for count in FIELD_TERMS:
            at = field_nodes(count, self.half_width)
            values = self.exact(setting, *at, teff)
            series = FieldSeries.through(self.half_width, values.reshape(len(values), -1))
            found = series(x, y).reshape(limits.VECTOR_CHECKS, COLOURS + 1, 4, 3)
            error = float(np.abs(np.einsum("tc,pcks->ptks", weights, found) - truth).max() / truth.max())
            if error < TOLERANCE:
                return series
        raise RuntimeError(_too_fast(error, TOLERANCE))

    def _derivative_series(self, setting: Setting) -> FieldSeries:
        plan, bands = self._plan(setting, [np.nan, *colour_nodes(DERIVATIVE_COLOURS).tolist()])
        n = len(self.calibration.values)
        wanted = [*self._plain.tolist(), *range(n, n + 4)]

        def exact(x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]) -> Float[np.ndarray, "p f"]:
            """Derivatives in the order point, (colour, camera, Stokes, parameter)."""
            values = _in_chunks(lambda a, b: _derivatives_at(self.instrument, plan, a, b), x, y)
            return np.moveaxis(values[:, wanted][:, :, bands], 1, -1).reshape(len(x), -1)

        x, y = np.random.default_rng(2).uniform(-self.half_width, self.half_width, (2, limits.VECTOR_CHECKS))
        truth = exact(x, y).reshape(-1, len(wanted))
        size = np.abs(truth).max(axis=0)
        error = np.inf
        for count in DERIVATIVE_TERMS:
            series = FieldSeries.through(self.half_width, exact(*field_nodes(count, self.half_width)))
            off = np.abs(series(x, y).reshape(truth.shape) - truth).max(axis=0)
            error = float(np.max(off / np.where(size > 0, size, 1.0)))
            if error < DERIVATIVE_TOLERANCE:
                return series
        raise RuntimeError(_too_fast(error, DERIVATIVE_TOLERANCE))


def _too_fast(error: float, tolerance: float) -> str:
    return (
        f"the optics vary too fast over the field to be interpolated (error {error:.1e}, {tolerance:g} is needed); an "
        "effect of the model has a very small scale"
    )


def _in_chunks(function, x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Apply a compiled function to slices of equal size: one compilation."""
    parts = []
    for start in range(0, len(x), limits.VECTOR_POINTS):
        px, py = x[start : start + limits.VECTOR_POINTS], y[start : start + limits.VECTOR_POINTS]
        pad = (0, limits.VECTOR_POINTS - len(px))
        out = function(jnp.asarray(np.pad(px, pad, mode="edge")), jnp.asarray(np.pad(py, pad, mode="edge")))
        parts.append(np.asarray(out)[: len(px)])
    return np.concatenate(parts)
