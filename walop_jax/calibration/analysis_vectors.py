"""Analysis vectors at any field point and colour, with their derivatives: what turns counts into Stokes parameters.

    N_k = F a_k · (1, q, u)            camera k; light is linear (`model/light.py`)

The vectors of one optical setting (filter, moving elements, temperature, hour angle) are computed at a few hundred
field points and colours and interpolated between them; every table is checked against vectors computed where it has
no node (`likelihood/field_table.py`). A setting has one table, whatever the catalogue that asks for it. Where none is
accurate, as beside a small spot, all is computed at every star.

The derivatives have the structure of the fit (`likelihood/field_table.py`): plain parameters act directly, the
throughput series only through its local values.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.could_hide import acting_effects, acts_in, turn_of, with_effect
from walop_jax.calibration.matrix import sky_vectors, vector_slopes
from walop_jax.data.settings import Settings
from walop_jax.io.shapes import OfPoints
from walop_jax.likelihood.field_table import accurate_table, details_of, held_out
from walop_jax.likelihood.inverses import square_root
from walop_jax.likelihood.optics import plain_positions, through_series
from walop_jax.model import chebyshev
from walop_jax.model.chebyshev import Rectangle
from walop_jax.model.dependence import needs
from walop_jax.model.effects import Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan
from walop_jax.model.planning import plan_for_settings
from walop_jax.model.specification import series_indices

LinearVectors = Float[np.ndarray, "p k 3"]  # point, camera, Stokes
TableValues = Float[np.ndarray, "p f"]  # of a table
OverField = Callable[[OfPoints, OfPoints], TableValues]
"""Values at field positions (deg): a table, or an exact function."""

COLOURS = 12  # colour temperatures of the vectors
DERIVATIVE_COLOURS = 3
NODES = (20, 28, 40, 56, 80)  # per side, tried in turn
DERIVATIVE_NODES = (14, 20, 28, 40)
TOLERANCE = 1e-7  # of a vector's largest element
DERIVATIVE_TOLERANCE = 1e-3  # of a derivative's largest value: errors of errors
ADDED_TOLERANCE = 1e-2  # of what effects that could hide add to starlight
BETWEEN = (2300.0, 3500.0, 5772.0, 12000.0, np.nan)  # colour temperatures (K) at which a table is checked
COOLEST = 2000.0  # K; no Planck curve describes the spectrum of a cooler star in a red filter
REACH = 1.25  # of the calibrated field: beyond, no polynomial of the throughput means anything


def colour_nodes(count: int) -> Float[np.ndarray, " c"]:
    """Colour temperatures (K) at which a Chebyshev series in 1/T over [0, 1/`COOLEST`] is made."""
    return COOLEST / (0.5 * (1.0 + chebyshev.nodes(count)))


def colour_weights(teff: OfPoints, count: int) -> Float[np.ndarray, "p c"]:
    """Weights of the functions (flat spectrum, then `colour_nodes`) for sources of temperature `teff` (K).

    NaN is a flat photon spectrum; sources cooler than `COOLEST` are taken as that.
    """
    flat = np.isnan(teff)
    t = 2.0 * np.minimum(COOLEST / np.where(flat, COOLEST, teff), 1.0) - 1.0
    lagrange = chebyshev.polynomials(t, count) @ chebyshev.to_coefficients(count)
    return np.concatenate([flat[:, None].astype(float), np.where(flat[:, None], 0.0, lagrange)], axis=1)


class Local(NamedTuple):
    """Derivatives of the vectors at a field point: in the plain parameters, and in the throughputs of the cameras
    there.
    """

    plain: Float[np.ndarray, "p k 3 o"]
    throughput: Float[np.ndarray, "p k 3 k"]


class AnalysisVectors:
    """The analysis vectors of a calibration, ready to be asked for at many field points.

    `parameters` are the positions, in the calibration's list, of the parameters that the vectors depend on; `root` is a
    square root of their covariance, C = root rootᵀ. Field positions reach to ±`half_width` (deg).

    Example: `AnalysisVectors(calibration).coloured(setting, x, y, teff)` are the responses (point, camera, 3) of all
    cameras to I, q and u of stars at x, y.
    """

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.instrument = calibration.model.instrument(calibration.values)
        reach = REACH * float(np.abs(calibration.field).max())
        self.half_width = min(self.instrument.field_limit, reach)
        self.cameras = len(self.instrument.cameras)
        self._tables: dict[tuple[object, ...], OverField] = {}
        self._details = details_of(self.instrument)
        self._acting_in: dict[tuple[object, ...], dict[int, Effect]] = {}
        series, plain = series_indices(self.instrument), plain_positions(self.instrument)
        self._uncertain: Int[np.ndarray, " o"] = np.flatnonzero(np.diag(calibration.covariance)[plain] > 0)
        self.parameters: Int[np.ndarray, " n"] = np.concatenate([plain[self._uncertain], series])
        covariance = calibration.covariance[np.ix_(self.parameters, self.parameters)]
        self.root: Float[np.ndarray, "n n"] = square_root(covariance)

    @property
    def plain(self) -> int:
        """Number of `parameters` that are not coefficients of the throughput series; they come first."""
        return len(self._uncertain)

    @property
    def named(self) -> list[tuple[str, str]]:
        """Names and units of `parameters`."""
        parameters = self.calibration.model.parameters
        return [(parameters[int(p)].name, parameters[int(p)].unit) for p in self.parameters]

    # ------------------------------------------------------------------------------------ asking

    def reduced(self, settings: Settings) -> Settings:
        """The settings with numbers that make no difference to these optics made equal, so that fewer distinct ones are
        left.
        """
        depends, neutral = needs(self.instrument).conditions, Settings.default(len(settings))
        patched = self.instrument.patched()
        return dataclasses.replace(
            settings,
            temperature=settings.temperature if "temperature" in depends else neutral.temperature,
            hour_angle=settings.hour_angle if "hour_angle" in depends else neutral.hour_angle,
            positions={
                prefix: patched.within_period(prefix, reading)
                for prefix, reading in settings.positions.items()
            },
        )

    def at(self, setting: Settings, x: OfPoints, y: OfPoints) -> Float[np.ndarray, "p c k 3"]:
        """Vectors (point, colour, camera, Stokes) in one setting, for the spectra that `colour_weights` mixes."""
        return self._kept(self._vector_table, setting)(x, y).reshape(len(x), COLOURS + 1, self.cameras, 3)

    def coloured(
        self, setting: Settings, x: OfPoints, y: OfPoints, teff: OfPoints | None = None
    ) -> LinearVectors:
        """Vectors (point, camera, Stokes) for sources of colour temperature `teff` (K; NaN, None: flat)."""
        teff = np.full(len(x), np.nan) if teff is None else teff
        return np.einsum("pc,pcks->pks", colour_weights(teff, COLOURS), self.at(setting, x, y))

    def derivatives(self, setting: Settings, x: OfPoints, y: OfPoints, teff: OfPoints) -> Local:
        """Derivatives of the vectors to the plain parameters that are not certain, and to the local throughputs."""
        weights = colour_weights(teff, DERIVATIVE_COLOURS)
        plain = self.plain
        size = plain + self.cameras
        table = self._kept(self._derivative_table, setting)
        values = table(x, y).reshape(len(x), DERIVATIVE_COLOURS + 1, -1)
        mixed = np.einsum("pc,pcf->pf", weights, values).reshape(len(x), self.cameras, 3, size)
        return Local(mixed[..., :plain], mixed[..., plain:])

    @functools.cached_property
    def acting(self) -> Mapping[int, Effect]:
        """Undetected errors that act on starlight itself, by number: effects at their sizes."""
        return acting_effects(self.calibration)

    @functools.cached_property
    def turns(self) -> Mapping[int, float]:
        """Rotations (rad) of the sky by the effects that have one."""
        angles = {number: turn_of(self.instrument, effect) for number, effect in self.acting.items()}
        return {number: turn for number, turn in angles.items() if turn}

    def added(self, setting: Settings, x: OfPoints, y: OfPoints) -> dict[int, LinearVectors]:
        """Change of the vectors by each effect of `acting` that is in the beam, for a flat spectrum."""
        if setting.key not in self._acting_in:
            acting = ((n, e) for n, e in self.acting.items() if acts_in(e, self.instrument, setting))
            self._acting_in[setting.key] = dict(acting)
        acting = self._acting_in[setting.key]
        if not acting:
            return {}
        table = self._kept(lambda entry: self._acting_table(entry, acting), setting, "added")
        values = table(x, y).reshape(len(x), len(acting), self.cameras, 3)
        return dict(zip(acting, np.moveaxis(values, 1, 0), strict=True))

    def to_parameters(
        self,
        plain: Float[np.ndarray, "p 2 o"],
        throughput: Float[np.ndarray, "p 2 k"],
        x: OfPoints,
        y: OfPoints,
    ) -> Float[np.ndarray, "p 2 n"]:
        """Derivatives in `parameters` (p, 2, n): those in the local throughputs are spread over the terms of the
        series.
        """
        spread = through_series(throughput[:, :, None], self.basis(x, y)[:, None, None])
        return np.concatenate([plain, spread], axis=-1)

    def basis(self, x: OfPoints, y: OfPoints) -> Float[np.ndarray, "p t"]:
        """Terms of the throughput series at field positions (deg)."""
        return self.instrument.throughput.basis(x, y)

    # ------------------------------------------------------------------------------------ making the tables

    def exact(
        self, setting: Settings, x: OfPoints, y: OfPoints, teff: Sequence[float] = (np.nan,)
    ) -> Float[np.ndarray, "p c k 3"]:
        """Vectors (point, colour, camera, Stokes) without any table; `teff` NaN is a flat spectrum."""
        plan, bands = self._plan(setting, teff)
        return sky_vectors(self.instrument, plan, x, y)[:, bands, :, :3]

    def _plan(self, setting: Settings, teff: Sequence[float]) -> tuple[Plan, Int[np.ndarray, " c"]]:
        same = dataclasses.replace(setting[np.zeros(len(teff), int)], teff=np.array(teff, float))
        plan = plan_for_settings(self.instrument, same, self.calibration.curves(setting))
        return plan, np.asarray(plan.band_of)[:, 0]

    def _kept(self, make: Callable[[Settings], OverField], setting: Settings, name: str = "") -> OverField:
        """The function of one setting, in the order (colour, camera, Stokes, …), made when asked for."""
        key = (name or make.__name__, setting.key)
        if key not in self._tables:
            self._tables[key] = make(setting)
        return self._tables[key]

    @property
    def _rectangle(self) -> Rectangle:
        corner = np.full(2, self.half_width)
        return Rectangle(-corner, corner)

    def _vector_table(self, setting: Settings) -> OverField:
        nodes = colour_nodes(COLOURS).tolist()
        teff = [np.nan, *nodes]
        weights = colour_weights(np.array(BETWEEN), COLOURS)

        def exact(x: OfPoints, y: OfPoints) -> TableValues:
            return self.exact(setting, x, y, teff).reshape(len(x), -1)

        def error(interpolated: TableValues, truth: Float[np.ndarray, "p t k 3"]) -> float:
            on_nodes = interpolated.reshape(len(interpolated), COLOURS + 1, self.cameras, 3)
            between = np.einsum("tc,pcks->ptks", weights, on_nodes)
            return float(np.abs(between - truth).max() / truth.max())

        # As many colours as on the nodes, for whose number the program is there.
        colours = (*BETWEEN, *nodes[len(BETWEEN) - 1 :])
        truth = self.exact(setting, *held_out(self._rectangle, self._details), colours)[:, : len(BETWEEN)]
        return self._accurate(exact, NODES, TOLERANCE, error, truth)

    def _derivative_table(self, setting: Settings) -> OverField:
        plan, bands = self._plan(setting, [np.nan, *colour_nodes(DERIVATIVE_COLOURS).tolist()])
        plain = plain_positions(self.instrument).size
        columns = np.concatenate([self._uncertain, plain + np.arange(self.cameras)])

        def exact(x: OfPoints, y: OfPoints) -> TableValues:
            """Derivatives in the order point, (colour, camera, Stokes, parameter)."""
            values = vector_slopes(self.instrument, plan, x, y)
            return np.moveaxis(values[:, columns][:, :, bands], 1, -1).reshape(len(x), -1)

        def error(interpolated: TableValues, truth: TableValues) -> float:
            interpolated, truth = (values.reshape(-1, len(columns)) for values in (interpolated, truth))
            largest = np.abs(truth).max(axis=0)
            off = np.abs(interpolated - truth).max(axis=0) / np.where(largest > 0, largest, 1.0)
            return float(off.max())

        return self._accurate(exact, DERIVATIVE_NODES, DERIVATIVE_TOLERANCE, error)

    def _acting_table(self, setting: Settings, acting: Mapping[int, Effect]) -> OverField:
        filters = self.calibration.curves(setting)
        flat = dataclasses.replace(setting, teff=np.full(1, np.nan))

        def vectors(instrument: Instrument, x: OfPoints, y: OfPoints) -> LinearVectors:
            return sky_vectors(instrument, plan_for_settings(instrument, flat, filters), x, y)[:, 0, :, :3]

        def exact(x: OfPoints, y: OfPoints) -> TableValues:
            """Change of the vectors in the order point, (effect, camera, Stokes)."""
            bare = vectors(self.instrument, x, y)
            changes = [vectors(with_effect(self.instrument, one), x, y) - bare for one in acting.values()]
            return np.stack(changes, axis=1).reshape(len(x), -1)

        def error(interpolated: TableValues, truth: TableValues) -> float:
            return float(np.abs(interpolated - truth).max() / max(np.abs(truth).max(), 1e-300))

        return self._accurate(exact, DERIVATIVE_NODES, ADDED_TOLERANCE, error)

    def _accurate(
        self, exact: OverField, counts: Sequence[int], tolerance: float, error: Any, truth: Any = None
    ) -> OverField:
        table, off = accurate_table(
            exact, self._rectangle, counts, tolerance, error, truth=truth, total=True, details=self._details
        )
        return exact if table is None or not off <= tolerance else table
