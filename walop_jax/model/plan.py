"""Plan of the computation for a set of exposures: wavelength nodes, bands, positions of the moving elements.

Light is linear, so an exposure is a dot product with the analysis vectors of its *band* (filter, colour temperature,
positions of the moving elements, conditions); the optics are worked out once per point and wavelength node, never per
exposure. Angles of the polariser never meet wavelengths. Plans are made by `planning`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from walop_jax.model.compiled import array
from walop_jax.model.fold import ElementPositions
from walop_jax.model.light_path import LightPath
from walop_jax.model.ray import SMOOTH, Conditions
from walop_jax.model.sources import ExposureArrays


class Plan(eqx.Module):
    """What a computation is laid out for: wavelength nodes, bands, and settings of the moving elements.

    Nodes are the `wavelength` (µm) and `conditions` at which the optics are solved. Bands are rows of `node_weight`,
    the weights of the nodes, sorted by the positions of the moving elements. `moving` holds the prefixes of the columns
    of these, `settings` (positions, first band, one past the last band); a position is an angle in degrees, `Turning`,
    or None for an element out of the beam. `band_of[e, s + 1]` is the band of exposure e for light of source s (s = −1:
    no source). Bands in which `slope` is 1 are weighted with the distance from their mean wavelength (µm); None: there
    are none. `work` counts places × exposures of a computation: programs for few of them are compiled without
    optimisation (`compiled`).

    Eight exposures through one filter with the calibration plate at 0° and 45° have two settings and two bands.
    """

    wavelength: Float[Array, " n"]
    conditions: Conditions
    node_weight: Float[Array, "b n"]
    teff: Float[Array, " b"]
    exposures: ExposureArrays
    band_of: Int[np.ndarray, "e s"] = eqx.field(static=False)
    settings: tuple[tuple[ElementPositions, int, int], ...] = eqx.field(static=True)
    moving: tuple[str, ...] = eqx.field(static=True)
    work: int = 0
    slope: Float[Array, " b"] | None = None

    @property
    def positions(self) -> list[ElementPositions]:
        """Positions of the moving elements, one tuple for each setting."""
        return [positions for positions, _, _ in self.settings]


def blank_exposures(instrument: LightPath, count: int) -> ExposureArrays:
    """Exposures without any information but their number."""
    zero, off = array(np.zeros(count)), array(np.zeros(count, bool))
    return ExposureArrays(
        kind=array(np.zeros(count, int)), clp_in=off, clp_angle=zero, flux_known=off, rotator=zero, hours=zero,
        temperature=zero, hour_angle=zero, exptime=zero, moving=dict.fromkeys(instrument.patched().moving(), zero),
        kinds=instrument.kinds,
    )  # fmt: skip


def blank_plan(instrument: LightPath, quantities: Collection[str] = (), median: bool = False) -> Plan:
    """A plan with every moving element in the beam, one node, one band: for shapes and derivatives."""
    patched, ones = instrument.patched(), jnp.ones(1)
    count = max((gain.exposures_known or 1 for gain in patched.cameras.exposures), default=1)
    exposures = blank_exposures(instrument, count)
    if median:
        exposures = dataclasses.replace(exposures, median_counts=jnp.ones((count, len(instrument.cameras))))
    moving = patched.moving()
    return Plan(
        wavelength=0.62 * ones,
        conditions=Conditions(band_width=0.1 * ones, planned=dict.fromkeys(quantities, ones)),
        node_weight=jnp.ones((1, 1)),
        teff=5000.0 * ones,
        exposures=exposures,
        band_of=np.zeros((count, 1 + len(instrument.standard.names)), int),
        settings=((tuple(30.0 for _ in moving), 0, 1),),
        moving=moving,
    )


def with_numbers(
    plan: Plan, teff: Float[Array, ""], temperature: Float[Array, ""], hour_angle: Float[Array, ""]
) -> Plan:
    """The plan of a single setting with other numbers; `teff` is 0 for a flat spectrum."""
    numbers = {"temperature": temperature, "hour_angle": hour_angle}
    planned = {
        name: jnp.broadcast_to(numbers.get(name.removeprefix(SMOOTH), value), plan.wavelength.shape)
        for name, value in plan.conditions.planned.items()
    }
    changed = (jnp.broadcast_to(teff, plan.teff.shape), Conditions(plan.conditions.band_width, planned))
    return eqx.tree_at(lambda p: (p.teff, p.conditions), plan, changed)


def with_median(plan: Plan, median: Float[np.ndarray, "e k"]) -> Plan:
    """The plan with the median counts of every exposure and camera, for some detectors."""
    return eqx.tree_at(
        lambda p: p.exposures.median_counts, plan, array(median), is_leaf=lambda leaf: leaf is None
    )
