"""The instrument matrix anywhere in the field, with its covariance from the fit.

Elements     m21, m22, m23, m31, m32, m33 of `light.instrument_matrix`, band integrated, throughput included.
Covariance   C_m = J C_θ Jᵀ with the exact J; the throughput series enters through its four local values.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from walop_jax.data.records import Exposures, FilterCurve
from walop_jax.likelihood import limits
from walop_jax.likelihood.nodes import rows_and_slopes
from walop_jax.model import light
from walop_jax.model.compiled import compiled
from walop_jax.model.dependence import optical_indices
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import values_of, with_values
from walop_jax.model.plan import Plan
from walop_jax.model.planning import plan_for
from walop_jax.model.ray import Conditions
from walop_jax.model.specification import series_indices


@dataclasses.dataclass(frozen=True)
class Settings:
    """Optical settings, one per row.

    Filter name, colour temperature (K, NaN flat), calibration plate (deg, NaN out), instrument temperature
    (Celsius) and hour angle (h).
    """

    filter: np.ndarray
    teff: Float[np.ndarray, " n"]
    chwp_angle: Float[np.ndarray, " n"]
    temp: Float[np.ndarray, " n"]
    ha: Float[np.ndarray, " n"]

    @classmethod
    def default(cls, count: int, filter_name: str = "SDSS-r") -> Settings:
        """SDSS-r, flat photon spectrum, calibration plate out, 10 °C, on the meridian."""
        nan = np.full(count, np.nan)
        return cls(np.full(count, filter_name), nan, nan, np.full(count, 10.0), np.zeros(count))

    def __len__(self) -> int:
        return len(self.teff)

    def layouts(self) -> list[tuple[Settings, Int[np.ndarray, " r"]]]:
        """One setting for each combination of filter and calibration plate, and the rows that have it.

        Only these two decide how a computation is laid out; the rest are numbers that go into it.
        """
        key = np.rec.fromarrays([self.filter.astype(str), np.nan_to_num(self.chwp_angle, nan=-1e30)])
        _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
        return [(self[k : k + 1], np.flatnonzero(inverse.reshape(-1) == n)) for n, k in enumerate(first)]

    def __getitem__(self, rows: slice | Int[np.ndarray, " r"]) -> Settings:
        return Settings(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))


def settings_plan(settings: Settings, filters: Mapping[str, FilterCurve], instrument: Instrument) -> Plan:
    """The plan of a set of optical settings, one "exposure" each (no light source: only analysis vectors)."""
    n = len(settings)
    nan, zero, off = np.full(n, np.nan), np.zeros(n), np.zeros(n, bool)
    chwp_in = np.isfinite(settings.chwp_angle)
    exposures = Exposures(
        exposure=np.arange(n), kind=np.full(n, "flux"), mjd=zero, exptime=zero, filter=settings.filter,
        clp_in=off, clp_angle=nan, chwp_in=chwp_in, chwp_angle=settings.chwp_angle, temp=settings.temp,
        ha=settings.ha, ra=nan, dec=nan, rotator=nan, teff=settings.teff,
    )  # fmt: skip
    return plan_for(instrument, exposures, filters)


def _point_vectors(
    instrument: Instrument, plan: Plan, x: Float[Array, ""], y: Float[Array, ""]
) -> Float[Array, "b k 4"]:
    rows = light.band_rows(instrument, plan, x, y)
    return light.camera_vectors(instrument, rows, light.throughput_at(instrument, x, y), x, y)


def _point_matrix(
    instrument: Instrument, plan: Plan, x: Float[Array, ""], y: Float[Array, ""]
) -> tuple[Float[Array, "b a 3"], Float[Array, "b a 3 n"]]:
    """Instrument matrices of a field point and their derivatives with respect to all parameters."""
    values, to_instrument = values_of(instrument), with_values(instrument)
    optical = np.asarray(optical_indices(instrument), int)
    series = np.asarray(series_indices(instrument), int)
    plain = np.setdiff1d(np.arange(values.size), series)
    basis = instrument.throughput.basis(x, y)
    throughput = light.throughput_at(instrument, x, y)

    def matrix(
        rows: Float[Array, "b r 4"], all_values: Float[Array, " n"], local: Float[Array, " k"]
    ) -> Float[Array, "b a 3"]:
        there = to_instrument(all_values)
        vectors = light.camera_vectors(there, rows, local, x, y)
        return light.instrument_matrix(vectors @ light.telescope(there, x, y), there.cameras.pairs)

    rows, slopes = rows_and_slopes(instrument, plan, x, y)
    m, push = jax.linearize(matrix, rows, values, throughput)
    d_rows = jnp.zeros((values.size, *rows.shape)).at[optical].set(slopes)
    unit = jnp.eye(values.size)
    d_plain = jax.vmap(lambda dr, dv: push(dr, dv, jnp.zeros_like(throughput)))(d_rows[plain], unit[plain])
    zero_rows, zero_values = jnp.zeros_like(rows), jnp.zeros_like(values)
    d_local = jax.vmap(lambda dt: push(zero_rows, zero_values, dt))(jnp.eye(throughput.size))
    d_series = (d_local[:, None] * basis[None, :, None, None, None]).reshape(series.size, *m.shape)
    derivative = jnp.zeros((values.size, *m.shape)).at[plain].set(d_plain).at[series].set(d_series)
    return m, jnp.moveaxis(derivative, 0, -1)


class _Row(NamedTuple):
    """A field point and the numbers of its setting; `teff` is 0 for a flat spectrum."""

    x: Float[Array, "*p"]
    y: Float[Array, "*p"]
    teff: Float[Array, "*p"]
    temperature: Float[Array, "*p"]
    hour_angle: Float[Array, "*p"]


def _row_plan(plan: Plan, row: _Row) -> Plan:
    """The plan of a layout (one band) with the numbers of a row."""
    nodes = plan.wavelength.shape
    own = {"temperature": row.temperature, "hour_angle": row.hour_angle}
    planned = {
        name: jnp.broadcast_to(own[name], nodes) if name in own else value
        for name, value in plan.conditions.planned.items()
    }
    conditions = Conditions(plan.conditions.band_width, planned)
    changed = (jnp.broadcast_to(row.teff, plan.teff.shape), conditions)
    return eqx.tree_at(lambda p: (p.teff, p.conditions), plan, changed)


def _matrices_with_covariance(
    instrument: Instrument, plan: Plan, rows: _Row, covariance: Float[Array, "n n"]
) -> tuple[Float[Array, "p m"], Float[Array, "p m m"]]:
    def one(row: _Row) -> tuple[Float[Array, "b a 3"], Float[Array, "b a 3 n"]]:
        return _point_matrix(instrument, _row_plan(plan, row), row.x, row.y)

    m, derivative = jax.vmap(one)(rows)
    flat = derivative[:, 0].reshape(len(m), m.shape[2] * 3, -1)
    return m[:, 0].reshape(len(m), -1), jnp.einsum("pin,nk,pjk->pij", flat, covariance, flat)


_matrices = compiled(_matrices_with_covariance)
_vectors = compiled(jax.vmap(_point_vectors, in_axes=(None, None, 0, 0)))


def analysis_vectors(
    instrument: Instrument, plan: Plan, x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]
) -> Float[np.ndarray, "p b k 4"]:
    """Analysis vectors (point, band, camera, Stokes) at field positions in degrees."""
    return _in_chunks(lambda a, b: (_vectors(instrument, plan, a, b),), x, y)[0]


def matrices(
    instrument: Instrument,
    settings: Settings,
    filters: Mapping[str, FilterCurve],
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "n n"],
) -> tuple[Float[np.ndarray, "p m"], Float[np.ndarray, "p m m"]]:
    """Instrument matrix (m21, m22, m23, m31, m32, m33) and its covariance at field positions (deg).

    `settings` has one row per position. Raises KeyError for a filter that `filters` does not hold.
    """
    size = 3 * len(instrument.arms)
    values, errors = np.empty((len(x), size)), np.empty((len(x), size, size))
    cov = jnp.asarray(covariance)
    columns = (x, y, np.nan_to_num(settings.teff), settings.temp, settings.ha)
    for layout, rows in settings.layouts():
        plan = settings_plan(layout, filters, instrument)
        values[rows], errors[rows] = _in_chunks(
            lambda *row, plan=plan: _matrices(instrument, plan, _Row(*row), cov), *(c[rows] for c in columns)
        )
    return values, errors


def _in_chunks(function: Callable[..., Any], *columns: Float[np.ndarray, " p"]) -> tuple[np.ndarray, ...]:
    """Apply a compiled function to slices of the columns, padded to one of two sizes: two compilations."""
    count = len(columns[0])
    few, many = limits.MATRIX_POINTS
    size = few if count <= few else many
    parts = []
    for start in range(0, count, size):
        slices = [column[start : start + size] for column in columns]
        missing = size - len(slices[0])
        # Padding with the last row keeps the arithmetic as tame as that of the data.
        result = function(*(jnp.asarray(np.pad(part, (0, missing), mode="edge")) for part in slices))
        parts.append([np.asarray(part)[: size - missing] for part in result])
    return tuple(np.concatenate(parts) for parts in zip(*parts, strict=True))
