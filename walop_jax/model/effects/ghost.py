"""A ghost image of the field, turned by 180°.

Equation    N(X, Y) → N(X, Y) + share · N(−X, −Y) in the same camera, for extended sources (SOURCE = −1)
Symbols     share: of the light at the opposite field point
Source      reflections between detector and window are point-symmetric
            about the axis.
Neutral     share = 0
Revealed by polariser and Moon exposures whose response resembles that of the opposite field point, while
            stars at the same place do not show it.

An extended source is taken to be as bright at the opposite point; its polarisation is that of the source
there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from walop_jax.model.cameras import GhostPart
from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "reflections between detector and window: expected size"


class PointGhost(GhostPart):
    """A share of the light of the opposite field point, for extended sources: one, or one for each camera."""

    share: Scalar | Float[Array, " k"]

    def seen(self, extended: Bool[Array, " e"], opposite: Float[Array, "e k"]) -> Float[Array, "e k"]:
        """What the opposite point adds."""
        return jnp.where(extended[:, None], self.share * opposite, 0.0)


class Ghost(Effect):
    """Ghost image of the field, turned by 180°."""

    share: Scalar = param(
        unit="", about="share of the opposite point", source=SOURCE, width=0.005, default=0.0
    )

    name: ClassVar[str] = "ghost"
    over_field: ClassVar[bool] = True
    reference: ClassVar[str] = SOURCE
    one_sided: ClassVar[tuple[str, ...]] = ("share",)
    revealed_by: ClassVar[str] = "extended sources and stars at the same field points"
    separated_by: ClassVar[str] = (
        "a star dithered over the field: its ghost moves the other way, flats and throughput do not"
    )

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """Light of the opposite field point in every camera."""
        return tuple(f"light of opposite in {name}" for name in instrument.cameras.names)

    def patch(self, instrument: Instrument) -> Instrument:
        """Add the opposite field point."""
        return instrument.with_part("ghosts", PointGhost(self.share))
