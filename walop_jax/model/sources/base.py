"""What a source of light is: one class for each KIND of exposure."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from walop_jax.model.parameters import Component
from walop_jax.model.ray import NotPlannedError

Scalar = Float[Array, ""]


class ExposureArrays(eqx.Module):
    """What the light path needs to know of the exposures, one element each; `median` only where it is asked for.

    `kind` counts the kinds of `kinds`. Angles in radians; `clp_angle` is 0 when the polariser is out, `rotator`
    where it has no meaning; `shared` is 1 where an exposure belongs to a group that has its fluxes in common, None: no
    exposures have. `hours` since the first exposure, temperature in Celsius, hour angle in h.
    """

    kind: Int[Array, " e"]
    clp_in: Bool[Array, " e"]
    clp_angle: Float[Array, " e"]
    flux_known: Bool[Array, " e"]
    rotator: Float[Array, " e"]
    hours: Float[Array, " e"]
    temperature: Float[Array, " e"]
    hour_angle: Float[Array, " e"]
    median_counts: Float[Array, "e k"] | None = None
    shared: Float[Array, "e s"] | None = None
    kinds: tuple[str, ...] = eqx.field(static=True, default=())

    def of_kind(self, kind: str) -> Bool[Array, " e"]:
        """The exposures of a KIND."""
        if kind not in self.kinds:
            return jnp.zeros(self.kind.shape, bool)
        return self.kind == self.kinds.index(kind)

    def rotated(self, offset: Scalar) -> ExposureArrays:
        """The exposures with an angle (rad) added to ROTATOR."""
        return eqx.tree_at(lambda e: e.rotator, self, self.rotator + offset)

    @property
    def median(self) -> Float[Array, "e k"]:
        """Median counts over the field of every camera."""
        if self.median_counts is None:
            raise NotPlannedError("median")
        return self.median_counts


class Sight(NamedTuple):
    """What is looked at from one field point, exposure by exposure.

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

    `kind` is what EXPOSURES says, `flux_known` whether its flux is one (KIND `flux`) or unknown, `from_sky` whether it
    comes through the telescope; `reference` says where what is assumed of it comes from.
    """

    name: ClassVar[str] = ""
    kind: ClassVar[str] = ""
    flux_known: ClassVar[bool] = False
    from_sky: ClassVar[bool] = True
    reference: ClassVar[str] = ""

    def shines(self, sight: Sight) -> Bool[Array, " e"]:
        """The exposures that see it."""
        return sight.exposures.of_kind(self.kind)

    def polarisation(self, sight: Sight) -> Float[Array, "e 2"]:
        """(q, u) in the instrument frame; unpolarised unless a source says otherwise."""
        return jnp.zeros((sight.exposures.kind.shape[0], 2))


def turned(qu: Float[Array, "e 2"], angle: Float[Array, " e"]) -> Float[Array, "e 2"]:
    """(q, u) referred to axes turned by `angle` (rad): (q + iu) exp(−2i angle)."""
    cos, sin = jnp.cos(2 * angle), jnp.sin(2 * angle)
    return jnp.stack([qu[:, 0] * cos + qu[:, 1] * sin, qu[:, 1] * cos - qu[:, 0] * sin], axis=-1)
