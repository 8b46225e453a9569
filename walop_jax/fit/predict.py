"""The instrument matrix anywhere in the field, with its covariance from the fit.

Elements     m21, m22, m23, m31, m32, m33 of `light.instrument_matrix`, band integrated, throughput included.
Covariance   C_m = J C_θ Jᵀ with the exact J; the throughput series enters through its four local values.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from walop_jax.data.records import Exposures, FilterCurve
from walop_jax.model import legendre, light
from walop_jax.model.compiled import compiled
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan, plan_for
from walop_jax.model.specification import optical_indices, series_indices

CHUNK = 256


@dataclasses.dataclass(frozen=True)
class Settings:
    """Optical settings, one per row: filter name, colour temperature (K, NaN flat), calibration plate (deg, NaN out),
    instrument temperature (Celsius) and hour angle (h)."""  # fmt: skip

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

    def distinct(self) -> tuple[Settings, Int[np.ndarray, " n"]]:
        """The settings that differ, and which of them each row has."""
        key = np.rec.fromarrays(
            [
                self.filter.astype(str),
                *(np.nan_to_num(a, nan=-1e30) for a in (self.teff, self.chwp_angle, self.temp, self.ha)),
            ]
        )
        _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
        columns = (getattr(self, f.name)[first] for f in dataclasses.fields(self))
        return Settings(*columns), inverse.reshape(-1)


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
    return plan_for(instrument.effects, exposures, filters)


def _point_vectors(
    instrument: Instrument, plan: Plan, x: Float[Array, ""], y: Float[Array, ""]
) -> Float[Array, "b 4 4"]:
    rows = light.band_rows(instrument, plan, x, y)
    return light.camera_vectors(instrument, rows, light.throughput_at(instrument, x, y), x, y)


def _point_matrix(
    instrument: Instrument, plan: Plan, x: Float[Array, ""], y: Float[Array, ""]
) -> tuple[Float[Array, "b 2 3"], Float[Array, "b 2 3 n"]]:
    """Instrument matrices of a field point and their derivatives with respect to all parameters."""
    values, to_instrument = ravel_pytree(instrument)
    optical = np.asarray(optical_indices(instrument), int)
    series = np.asarray(series_indices(instrument), int)
    plain = np.setdiff1d(np.arange(values.size), series)
    basis = legendre.basis(x, y, instrument.throughput.degree)
    throughput = light.throughput_at(instrument, x, y)

    def optics(optical_values: Float[Array, " o"]) -> Float[Array, "b 2 2 4"]:
        return light.band_rows(to_instrument(values.at[optical].set(optical_values)), plan, x, y)

    def matrix(
        rows: Float[Array, "b 2 2 4"], all_values: Float[Array, " n"], local: Float[Array, 4]
    ) -> Float[Array, "b 2 3"]:
        there = to_instrument(all_values)
        vectors = light.camera_vectors(there, rows, local, x, y)
        return light.instrument_matrix(vectors @ light.telescope(there))

    rows, push_optics = jax.linearize(optics, values[optical])
    m, push = jax.linearize(matrix, rows, values, throughput)
    d_rows = (
        jnp.zeros((values.size, *rows.shape)).at[optical].set(jax.vmap(push_optics)(jnp.eye(optical.size)))
    )
    unit = jnp.eye(values.size)
    d_plain = jax.vmap(lambda dr, dv: push(dr, dv, jnp.zeros(4)))(d_rows[plain], unit[plain])
    zero_rows, zero_values = jnp.zeros_like(rows), jnp.zeros_like(values)
    d_local = jax.vmap(lambda dt: push(zero_rows, zero_values, dt))(jnp.eye(4))
    d_series = (d_local[:, None] * basis[None, :, None, None, None]).reshape(series.size, *m.shape)
    derivative = jnp.zeros((values.size, *m.shape)).at[plain].set(d_plain).at[series].set(d_series)
    return m, jnp.moveaxis(derivative, 0, -1)


def _matrices_with_covariance(
    instrument: Instrument,
    plan: Plan,
    x: Float[Array, " p"],
    y: Float[Array, " p"],
    covariance: Float[Array, "n n"],
) -> tuple[Float[Array, "p b 6"], Float[Array, "p b 6 6"]]:
    m, derivative = jax.vmap(_point_matrix, in_axes=(None, None, 0, 0))(instrument, plan, x, y)
    flat = derivative.reshape(*m.shape[:2], 6, -1)
    return m.reshape(*m.shape[:2], 6), jnp.einsum("pbin,nk,pbjk->pbij", flat, covariance, flat)


_matrices = compiled(_matrices_with_covariance)
_vectors = compiled(jax.vmap(_point_vectors, in_axes=(None, None, 0, 0)))


def analysis_vectors(
    instrument: Instrument, plan: Plan, x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]
) -> Float[np.ndarray, "p b 4 4"]:
    """Analysis vectors (point, band, camera, Stokes) at field positions in degrees."""
    return _in_chunks(lambda a, b: (np.asarray(_vectors(instrument, plan, a, b)),), x, y)[0]


def matrices(
    instrument: Instrument,
    settings: Settings,
    filters: Mapping[str, FilterCurve],
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
    covariance: Float[np.ndarray, "n n"],
) -> tuple[Float[np.ndarray, "p 6"], Float[np.ndarray, "p 6 6"]]:
    """Instrument matrix (m21, m22, m23, m31, m32, m33) and its covariance at field positions (deg), row by row.

    `settings` has one row per position. Raises KeyError for a filter that `filters` does not hold.
    """
    distinct, of_row = settings.distinct()
    values, errors = np.empty((len(x), 6)), np.empty((len(x), 6, 6))
    cov = jnp.asarray(covariance)
    for k in range(len(distinct)):
        rows = np.flatnonzero(of_row == k)
        one = Settings(*(getattr(distinct, f.name)[k : k + 1] for f in dataclasses.fields(distinct)))
        plan = settings_plan(one, filters, instrument)
        m, c = _in_chunks(
            lambda a, b, plan=plan: tuple(np.asarray(v) for v in _matrices(instrument, plan, a, b, cov)),
            x[rows],
            y[rows],
        )
        values[rows], errors[rows] = m[:, 0], c[:, 0]
    return values, errors


def _in_chunks(function, x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]) -> tuple[np.ndarray, ...]:
    size = min(CHUNK, max(len(x), 1))
    parts = []
    for start in range(0, len(x), size):
        a, b = x[start : start + size], y[start : start + size]
        missing = size - len(a)
        result = function(jnp.asarray(np.pad(a, (0, missing))), jnp.asarray(np.pad(b, (0, missing))))
        parts.append([part[: len(a)] for part in result])
    return tuple(np.concatenate(columns) for columns in zip(*parts, strict=True))
