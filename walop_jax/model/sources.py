"""Sources of light, one class for each KIND of exposures; `SOURCES` lists those that every instrument can look at.

Moon sky    (q, u) = δ (q₁, u₁) − p (q₁, u₁)/|(q₁, u₁)| + (q_e, u_e), (q₁, u₁) single Rayleigh scattering:
            p₁ = sin²γ / (1 + cos²γ), perpendicular to the scattering plane; γ angle from the Moon; δ depolarisation,
            one for all patches and wavelengths; p degree that multiple scattering takes away; q_e, u_e what a patch has
            beyond it
Standards   (q + iu) in the instrument frame = (Q + iU) exp(−2i ROTATOR), catalogue values in the equatorial frame
Sources     Maharana et al. 2022, Paper II, eq. 8; multiple scattering: Berry, Dennis & Lee 2004, New J. Phys. 6, 162.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from walop_jax.data.records import KINDS, ExposureKind
from walop_jax.model.parameters import Component, number, param
from walop_jax.model.ray import NotPlannedError

Scalar = Float[Array, ""]
PAPER_II = "Maharana et al. 2022, Paper II"


class ExposureArrays(eqx.Module):
    """Exposures as the light path needs to know them, one element each; `median` only where it is asked for.

    `kind` counts the kinds of `kinds`. Angles in radians; `clp_angle` is 0 when the polariser is out, `rotator` where
    it has no meaning; `shared` is 1 where an exposure belongs to a group that has its fluxes in common, None: no
    exposures have. `moving` holds angles of elements that move behind the polariser (NaN: out). `hours` since the first
    exposure, temperature in Celsius, hour angle in h, exposure time in s.
    """

    kind: Int[Array, " e"]
    clp_in: Bool[Array, " e"]
    clp_angle: Float[Array, " e"]
    flux_known: Bool[Array, " e"]
    rotator: Float[Array, " e"]
    hours: Float[Array, " e"]
    temperature: Float[Array, " e"]
    hour_angle: Float[Array, " e"]
    exptime: Float[Array, " e"]
    median_counts: Float[Array, "e k"] | None = None
    shared: Float[Array, "e s"] | None = None
    moving: Mapping[str, Float[Array, " e"]] = dataclasses.field(default_factory=dict)
    kinds: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def median(self) -> Float[Array, "e k"]:
        """Median counts over the field of every camera."""
        if self.median_counts is None:
            raise NotPlannedError("median")
        return self.median_counts

    def of_kind(self, name: str) -> Bool[Array | np.ndarray, " e"]:
        """True in exposures of a KIND."""
        return self.kind == (self.kinds.index(name) if name in self.kinds else -1)


class Sight(NamedTuple):
    """Target at one field point, exposure by exposure.

    `sky` is (q, u) in the instrument frame of singly scattered moonlight for δ = 1, `source` the row of the
    standard star or −1; field coordinates in degrees.
    """

    exposures: ExposureArrays
    sky: Float[Array, "e 2"]
    source: Int[Array, " e"]
    x: Scalar
    y: Scalar


class Source(Component):
    """Light of one KIND of exposures: its polarisation ahead of the instrument, per unit of flux.

    `kind` is what EXPOSURES says, `facts` what is true of all its exposures; `reference` is the source of what is
    assumed about it.
    """

    name: ClassVar[str] = ""
    kind: ClassVar[str] = ""
    facts: ClassVar[ExposureKind] = ExposureKind()
    reference: ClassVar[str] = ""

    def shines(self, sight: Sight) -> Bool[Array, " e"]:
        """The exposures that see it."""
        return jnp.asarray(sight.exposures.of_kind(self.kind))

    def polarisation(self, sight: Sight) -> Float[Array, "e 2"]:
        """(q, u) in the instrument frame; unpolarised unless a source says otherwise."""
        return jnp.zeros((sight.exposures.kind.shape[0], 2))


def turned(qu: Float[Array, "e 2"], angle: Float[Array, " e"]) -> Float[Array, "e 2"]:
    """(q, u) referred to axes turned by `angle` (rad): (q + iu) exp(−2i angle)."""
    cos, sin = jnp.cos(2 * angle), jnp.sin(2 * angle)
    return jnp.stack([qu[:, 0] * cos + qu[:, 1] * sin, qu[:, 1] * cos - qu[:, 0] * sin], axis=-1)


class MoonPatches(Component):
    """Polarisation of single Moon exposures, at some positions of the list, beyond single scattering."""

    q: Float[Array, " m"]
    u: Float[Array, " m"]
    positions: tuple[int, ...] = eqx.field(static=True, default=())

    def joined(self, other: MoonPatches) -> MoonPatches:
        """These and others; what both have adds up."""
        q, u = jnp.concatenate([self.q, other.q]), jnp.concatenate([self.u, other.u])
        return MoonPatches(q, u, (*self.positions, *other.positions))


class MoonSky(Source):
    """Singly scattered moonlight, depolarised."""

    depolarisation: Scalar = param(
        unit="",
        about="δ, one for all patches and wavelengths",
        source=f"{PAPER_II}, eq. 8",
        scale=0.05,
        default=0.8,
    )
    missing: Scalar | None = number(unit="", about="degree taken away by multiple scattering", default=None)
    patches: MoonPatches | None = None

    name: ClassVar[str] = "sky"
    kind: ClassVar[str] = "moon"
    reference: ClassVar[str] = f"{PAPER_II}, eq. 8"

    def shines(self, sight: Sight) -> Bool[Array, " e"]:
        """Moon exposures that are not taken through the polariser."""
        return super().shines(sight) & ~sight.exposures.clp_in

    def polarisation(self, sight: Sight) -> Float[Array, "e 2"]:
        """That of the patch."""
        sky = sight.sky
        qu = self.depolarisation * sky
        if self.missing is not None:
            power = jnp.sum(sky**2, axis=-1, keepdims=True)
            qu = qu - self.missing * sky / jnp.sqrt(jnp.where(power > 0, power, 1.0))
        if self.patches is not None:
            extra = jnp.stack([self.patches.q, self.patches.u], axis=-1)
            qu = qu.at[np.asarray(self.patches.positions, int)].add(extra)
        return qu


class Standards(Source):
    """Catalogue Stokes parameters of the standard stars."""

    names: tuple[str, ...] = eqx.field(static=True)
    q: Float[Array, " s"] = param(unit="", about="catalogue q", source="SOURCES table", scale=2e-4)
    u: Float[Array, " s"] = param(unit="", about="catalogue u", source="SOURCES table", scale=2e-4)

    name: ClassVar[str] = "standard"
    kind: ClassVar[str] = "standard"

    def labels(self, field: str) -> Sequence[str]:
        """One name per star."""
        return tuple(f"{name}.{field}" for name in self.names)

    def shines(self, sight: Sight) -> Bool[Array, " e"]:
        """Whatever has a star as its source."""
        seen = sight.source >= 0
        return seen if self.names else jnp.zeros_like(seen)

    def polarisation(self, sight: Sight) -> Float[Array, "e 2"]:
        """That of the star of each exposure."""
        if not self.names:
            return super().polarisation(sight)
        row = jnp.where(sight.source >= 0, sight.source, 0)
        return turned(jnp.stack([self.q[row], self.u[row]], axis=-1), sight.exposures.rotator)


class ThroughPolariser(Source):
    """Any source through the calibration polariser."""

    name: ClassVar[str] = "clp"
    kind: ClassVar[str] = "clp"


class Lamp(Source):
    """Light of unknown flux and polarisation near zero that enters behind the telescope."""

    name: ClassVar[str] = "lamp"
    kind: ClassVar[str] = "lamp"
    facts: ClassVar[ExposureKind] = KINDS[kind]


class KnownFlux(Source):
    """Unpolarised light of unit flux that enters behind the telescope, e.g. from an optical design program."""

    name: ClassVar[str] = "flux"
    kind: ClassVar[str] = "flux"
    facts: ClassVar[ExposureKind] = KINDS[kind]


class Steady(Source):
    """Unpolarised light behind the telescope, its flux unknown but the same in all exposures of a filter."""

    name: ClassVar[str] = "steady"
    kind: ClassVar[str] = "steady"
    facts: ClassVar[ExposureKind] = KINDS[kind]


SOURCES: tuple[type[Source], ...] = (MoonSky, Standards, ThroughPolariser, Lamp, KnownFlux, Steady)
