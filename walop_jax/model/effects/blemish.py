"""A dark spot in front of one camera.

Equation    throughput × (1 − depth · exp(−((X − x)² + (Y − y)²) / 2 size²)) in one camera
Symbols     x, y centre and size (standard deviation) [deg]; depth, a fraction
Source      dust near a focal plane, or a damaged coating.
Neutral     depth = 0, at any position
Revealed by a local zero offset of one half, the same in all exposures.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model.cameras import Transmission
from walop_jax.model.conventions import FIELD_SCALE
from walop_jax.model.effects.base import Context, Effect, Scalar, numbered_camera
from walop_jax.model.effects.change import Change
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import as_number, param

SOURCE = "dust near a focal plane, or a damaged coating: expected size"

GRID, SIZE = (-0.25, -0.15, -0.05, 0.05, 0.15, 0.25), 0.06  # degrees, in the field of WALOP


def _distance(spot: Any, x: Any, y: Any) -> Any:
    """Half the square of the distance from the centre, in standard deviations."""
    return ((x - spot.x) ** 2 + (y - spot.y) ** 2) / (2.0 * spot.size**2)


class Spot(Transmission):
    """A dark spot in front of one camera."""

    x: Scalar
    y: Scalar
    size: Scalar
    depth: Scalar
    camera: int = eqx.field(static=True)
    cameras: int = eqx.field(static=True)

    def factors(self, x: Scalar, y: Scalar) -> Float[Array, " k"]:
        """Fraction of the throughput behind the spot."""
        distance = _distance(self, x, y)
        return jnp.ones(self.cameras).at[self.camera].add(-self.depth * jnp.exp(-distance))


@dataclasses.dataclass(frozen=True)
class _Pattern:
    """The spot as a factor."""

    x: float
    y: float
    size: float

    def __call__(self, at: Any) -> Any:
        return np.exp(-_distance(self, at.x, at.y))


class Blemish(Effect):
    """A dark spot in front of one camera."""

    x: Scalar = param("deg", "centre along X", SOURCE, scale=0.02, loose=1.0, default=0.0)
    y: Scalar = param("deg", "centre along Y", SOURCE, scale=0.02, loose=1.0, default=0.0)
    size: Scalar = param("deg", "standard deviation of the spot", SOURCE, scale=0.02, loose=0.5, default=0.05)
    depth: Scalar = param("", "fraction that is missing", SOURCE, width=0.02, default=0.0)
    camera: int = eqx.field(static=True, default=0)

    name: ClassVar[str] = "blemish"
    over_field: ClassVar[bool] = True
    reference: ClassVar[str] = SOURCE
    shape: ClassVar[tuple[str, ...]] = ("x", "y", "size")
    one_sided: ClassVar[tuple[str, ...]] = ("depth",)
    revealed_by: ClassVar[str] = "any exposures over a grid of field points finer than the spot"
    separated_by: ClassVar[str] = (
        "the telescope dithered: a spot stays on the detector, anything of the sky moves"
    )

    @classmethod
    def probes(cls, context: Context) -> tuple[tuple[Self, ...], ...]:
        """Spots on a grid over the field, in any of the cameras."""
        scale = context.units.field / FIELD_SCALE
        neutral, places = cls.of(context, size=scale * SIZE), [as_number(scale * place) for place in GRID]
        cameras = range(len(context.cameras))
        spots = itertools.product(cameras, places, places)
        return tuple((neutral.replaced(camera=camera, x=x, y=y),) for camera, x, y in spots)

    def first_order(self, instrument: Instrument) -> tuple[tuple[tuple[float, Change], ...], ...]:
        """A gain of the camera with the pattern of the spot."""
        pattern = _Pattern(float(self.x), float(self.y), float(self.size))
        return (((-1.0, Change("gain", "of", instrument.cameras.names[self.camera], (pattern,))),),)

    def details(self) -> tuple[tuple[float, float], ...]:
        """The centre, and four places where the spot is steepest."""
        x, y, size = float(self.x), float(self.y), float(self.size)
        return tuple((x + a * size, y + b * size) for a, b in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)))

    def patch(self, instrument: Instrument) -> Instrument:
        """Darken the camera around the spot."""
        names = instrument.cameras.names
        camera = numbered_camera(self.name, self.camera, names)
        spot = Spot(self.x, self.y, self.size, self.depth, camera, len(names))
        return instrument.with_part("transmission", spot)
