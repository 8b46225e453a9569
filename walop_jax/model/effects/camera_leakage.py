"""Light of the orthogonal camera.

Equation    N0 → N0 + share N1, N1 → N1 + share N0, and N2, N3 likewise (behind the throughput)
Symbols     share: of the orthogonal camera's light
Source      a wire-grid beam splitter mixes both polarisations into its
            reflected beam.
Neutral     share = 0
Revealed by efficiencies too low by 2 share in both halves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model.cameras import Mixing
from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "wire-grid beam splitters mix both polarisations into the reflected beam: expected size"


class Leakage(Mixing):
    """A share of the light of the orthogonal camera in each camera."""

    share: Scalar
    orthogonal: tuple[int, ...] = eqx.field(static=True)

    def vectors(self, vectors: Float[Array, "b k 4"], x: Scalar, y: Scalar) -> Float[Array, "b k 4"]:
        """Mix the analysis vectors of orthogonal cameras."""
        return vectors + self.share * vectors[:, np.array(self.orthogonal), :]


class CameraLeakage(Effect):
    """A share of the orthogonal camera's light in each camera."""

    share: Scalar = param(
        unit="", about="share of the orthogonal camera", source=SOURCE, width=0.003, default=0.0
    )

    name: ClassVar[str] = "camera_leakage"
    reference: ClassVar[str] = SOURCE
    one_sided: ClassVar[tuple[str, ...]] = ("share",)
    revealed_by: ClassVar[str] = "polariser exposures: an efficiency below what the analysers can have"
    separated_by: ClassVar[str] = (
        "nothing in intensities alone tells it from less efficient analysers beyond their prior; standards "
        "of 3–5 % tell it from the extinction of the polariser, flux levels from stray light"
    )

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """Light of every camera in its neighbour."""
        names = instrument.cameras.names
        return tuple(
            f"light of {names[j]} in {name}"
            for name, j in zip(names, instrument.cameras.orthogonal, strict=True)
        )

    def patch(self, instrument: Instrument) -> Instrument:
        """Mix the light of orthogonal cameras."""
        return instrument.with_part("mixing", Leakage(self.share, instrument.cameras.orthogonal))
