"""A dark spot in front of one camera.

Equation    throughput × (1 − depth · exp(−((X − x)² + (Y − y)²) / 2 size²)) in one camera
Symbols     x, y centre and size (standard deviation) [deg]; depth, a share
Source      calibration contract, section 6; dust near a focal plane, or a damaged coating.
Neutral     depth = 0, wherever it is
Revealed by a local zero offset of one half, the same in all exposures.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.effects.base import CONTRACT, Effect, Scalar, check_camera
from walop_jax.model.parameters import param

GRID = (-0.25, -0.15, -0.05, 0.05, 0.15, 0.25)  # degrees


class Blemish(Effect):
    """Throughput of one camera is lower around a field point."""

    x: Scalar = param(unit="deg", about="centre along X", source=CONTRACT, scale=0.02, loose=1.0, default=0.0)
    y: Scalar = param(unit="deg", about="centre along Y", source=CONTRACT, scale=0.02, loose=1.0, default=0.0)
    size: Scalar = param(
        unit="deg",
        about="standard deviation of the spot",
        source=CONTRACT,
        scale=0.02,
        loose=0.5,
        default=0.05,
    )
    depth: Scalar = param(unit="", about="share that is missing", source=CONTRACT, width=0.02, default=0.0)
    camera: int = eqx.field(static=True, default=0)

    name: ClassVar[str] = "blemish"
    shape: ClassVar[tuple[str, ...]] = ("x", "y", "size")
    starts: ClassVar[tuple[tuple[Mapping[str, Any], ...], ...]] = tuple(
        ({"camera": camera, "x": x, "y": y, "size": 0.06},)
        for camera, x, y in itertools.product(range(4), GRID, GRID)
    )
    one_sided: ClassVar[tuple[str, ...]] = ("depth",)
    revealed_by: ClassVar[str] = "any exposures over a grid of field points finer than the spot"
    separated_by: ClassVar[str] = (
        "the telescope dithered: a spot stays on the detector, anything of the sky moves"
    )

    def __check_init__(self) -> None:
        check_camera(self, self.camera)

    def throughput(self, throughput: Float[Array, 4], x: Scalar, y: Scalar) -> Float[Array, 4]:
        """Darken the camera around the spot."""
        distance = ((x - self.x) ** 2 + (y - self.y) ** 2) / (2.0 * self.size**2)
        return throughput.at[self.camera].multiply(1.0 - self.depth * jnp.exp(-distance))
