"""What is to be computed for a set of exposures: wavelength nodes, bands, settings of the calibration plate.

Light is linear, so an exposure is a dot product with the analysis vectors of its *band* (filter, colour
temperature, calibration plate, conditions); the optics are worked out once per point and wavelength node,
never per exposure. Angles of the polariser never meet wavelengths.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from walop_jax.data.records import Exposures, FilterCurve, Sources
from walop_jax.model.effects.base import Conditions, Effect, ExposureArrays
from walop_jax.model.materials import REFERENCE_TEMPERATURE
from walop_jax.model.quadrature import band_rule


class Plan(eqx.Module):
    """Static layout of a computation.

    Nodes: `wavelength` (µm) and the `conditions` at which the plates are solved. Bands: rows of
    `node_weight`, sorted by setting of the calibration plate; `settings` holds (angle in degrees or None,
    first band, one past the last). `band_of[e, s + 1]` is the band of exposure e for light of source s (s =
    −1: no source).
    """

    wavelength: Float[Array, " n"]
    conditions: Conditions
    node_weight: Float[Array, "b n"]
    teff: Float[Array, " b"]
    exposures: ExposureArrays
    band_of: Int[np.ndarray, "e s"] = eqx.field(static=False)
    settings: tuple[tuple[float | None, int, int], ...] = eqx.field(static=True)

    @property
    def bands(self) -> int:
        """Number of bands."""
        return self.node_weight.shape[0]


def _setting(exposures: Exposures, e: int) -> float | None:
    return float(exposures.chwp_angle[e]) if exposures.chwp_in[e] else None


def _teff(exposures: Exposures, sources: Sources | None, e: int, s: int) -> float:
    if s >= 0 and sources is not None and np.isfinite(sources.teff[s]):
        return float(sources.teff[s])
    return float(exposures.teff[e])


def _condition(exposures: Exposures, e: int, depends_on: Collection[str]) -> tuple[float, float]:
    known = "temperature" in depends_on and np.isfinite(exposures.temp[e])
    temperature = float(exposures.temp[e]) if known else REFERENCE_TEMPERATURE
    hour_angle = float(np.nan_to_num(exposures.ha[e])) if "hour_angle" in depends_on else 0.0
    return temperature, hour_angle


def exposure_arrays(exposures: Exposures) -> ExposureArrays:
    """The exposures as the light path sees them (angles in radians)."""
    start = np.nanmin(exposures.mjd) if len(exposures) and np.isfinite(exposures.mjd).any() else 0.0
    return ExposureArrays(
        clp_in=jnp.asarray(exposures.clp_in),
        clp_angle=jnp.asarray(np.deg2rad(np.where(exposures.clp_in, exposures.clp_angle, 0.0))),
        moon=jnp.asarray((exposures.kind == "moon") & ~exposures.clp_in),
        flux_known=jnp.asarray(exposures.kind == "flux"),
        rotator=jnp.asarray(np.deg2rad(np.nan_to_num(exposures.rotator))),
        hours=jnp.asarray(np.nan_to_num((exposures.mjd - start) * 24.0)),
        temperature=jnp.asarray(exposures.temp),
        hour_angle=jnp.asarray(np.nan_to_num(exposures.ha)),
    )


def equivalent_width(curve: FilterCurve) -> float:
    """∫ THROUGHPUT dλ / max THROUGHPUT (µm); 0 for a monochromatic band."""
    return float(np.trapezoid(curve.throughput, curve.wavelength) / curve.throughput.max())


def plan_for(
    effects: Sequence[Effect],
    exposures: Exposures,
    filters: Mapping[str, FilterCurve],
    sources: Sources | None = None,
) -> Plan:
    """The plan of `exposures` as detailed as the active effects need it."""
    depends_on = {quantity for effect in effects for quantity in effect.optics_depend_on}
    return build_plan(exposures, filters, sources, depends_on, max((e.fringes for e in effects), default=0.0))


def build_plan(
    exposures: Exposures,
    filters: Mapping[str, FilterCurve],
    sources: Sources | None = None,
    depends_on: Collection[str] = (),
    fringes: float = 0.0,
) -> Plan:
    """Lay out the nodes and bands of `exposures`.

    `depends_on` names the exposure quantities on which the optics depend ("temperature", "hour_angle"),
    `fringes` the path difference (waves at 0.62 µm) that the nodes must follow beyond that of the plates.
    Raises KeyError for a filter that `filters` does not hold.
    """
    n_sources = 0 if sources is None else len(sources)
    # A band is (plate setting, filter, conditions, colour temperature); sorting puts equal settings together.
    # NaN (flat spectrum) and None (plate out) become sortable stand-ins.
    keys = {}
    for e in range(len(exposures)):
        standard = exposures.kind[e] == "standard" and not exposures.clp_in[e]
        for s in range(-1, n_sources if standard else 0):
            setting = _setting(exposures, e)
            teff = _teff(exposures, sources, e, s)
            keys[e, s] = (
                -np.inf if setting is None else setting,
                str(exposures.filter[e]),
                _condition(exposures, e, depends_on),
                teff if np.isfinite(teff) else 0.0,
            )
    bands = sorted(set(keys.values()))
    index = {key: i for i, key in enumerate(bands)}
    band_of = np.zeros((len(exposures), n_sources + 1), int)
    for e in range(len(exposures)):
        band_of[e] = index[keys[e, -1]]
        for s in range(n_sources):
            if (e, s) in keys:
                band_of[e, s + 1] = index[keys[e, s]]

    groups = sorted({(name, condition) for _, name, condition, _ in bands})
    rules = {
        name: band_rule(filters[name].wavelength, filters[name].throughput, fringes=fringes)
        for name, _ in groups
    }
    width = {name: equivalent_width(filters[name]) for name in rules}
    offset, start = {}, 0
    for group in groups:
        offset[group] = start
        start += len(rules[group[0]][0])
    weight = np.zeros((len(bands), start))
    for i, (_, name, condition, _) in enumerate(bands):
        first = offset[name, condition]
        weight[i, first : first + len(rules[name][1])] = rules[name][1]

    def per_node(values: list[float]) -> Float[Array, " n"]:
        return jnp.asarray(
            np.concatenate([np.full(len(rules[g[0]][0]), v) for g, v in zip(groups, values, strict=True)])
        )

    settings = []
    values = [key[0] for key in bands]
    for value in sorted(set(values)):
        angle = None if np.isinf(value) else float(value)
        settings.append((angle, values.index(value), len(values) - values[::-1].index(value)))
    return Plan(
        wavelength=jnp.asarray(np.concatenate([rules[g[0]][0] for g in groups])),
        conditions=Conditions(
            temperature=per_node([c[0] for _, c in groups]),
            hour_angle=per_node([c[1] for _, c in groups]),
            band_width=per_node([width[name] for name, _ in groups]),
        ),
        node_weight=jnp.asarray(weight),
        teff=jnp.asarray([key[3] for key in bands]),
        exposures=exposure_arrays(exposures),
        band_of=band_of,
        settings=tuple(settings),
    )


def with_median(plan: Plan, median: Float[np.ndarray, "e 4"]) -> Plan:
    """The plan with the median counts of every exposure and camera, which some effects need."""
    return eqx.tree_at(lambda p: p.exposures, plan, plan.exposures._replace(median=jnp.asarray(median)))
