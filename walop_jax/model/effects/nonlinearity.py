"""Detectors that are not linear.

Equation    N → N (1 + coefficient · N / 10⁶)
Symbols     N counts [electron]; coefficient per camera
Source      "small non-linearities in the CCD" were the major obstacle in
            calibrating the Swedish solar telescope (Selbing 2010, arXiv:1010.4142); 1 % at full well is
            typical.
Neutral     coefficient = 0
Revealed by a cos 4θ in the normalised intensities of polariser exposures, of opposite sign in the two
            halves, that grows with the flux; stars and sky disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Self

from jaxtyping import Array, Float

from walop_jax.model.cameras import DetectorPart, per_camera
from walop_jax.model.effects.base import Context, Effect
from walop_jax.model.parameters import param
from walop_jax.model.sources import ExposureArrays

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Selbing 2010, arXiv:1010.4142"

REFERENCE_COUNTS = 1e6  # electron


class Distortion(DetectorPart):
    """Counts grow or shrink in proportion to themselves."""

    coefficient: Float[Array, " k"]

    def reported(self, counts: Float[Array, "e k"], exposures: ExposureArrays) -> Float[Array, "e k"]:
        """Distort the counts."""
        return counts * (1.0 + self.coefficient * counts / REFERENCE_COUNTS)


class Nonlinearity(Effect):
    """Detectors that are not linear."""

    coefficient: Float[Array, " k"] = param(
        unit="", about="relative change at 10⁶", source=SOURCE, width=0.02
    )

    name: ClassVar[str] = "nonlinearity"
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "polariser exposures: a fourth harmonic that grows with the flux"
    separated_by: ClassVar[str] = (
        "a few polariser angles at two flux levels: throughput imbalance and an encoder error twice per "
        "turn make the same harmonic at every flux"
    )

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """Linear cameras."""
        return cls(coefficient=per_camera(context.cameras))

    def labels(self, field: str) -> Sequence[str]:
        """One coefficient per camera."""
        return tuple(f"{field}.n{k}" for k in range(self.coefficient.shape[0]))

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """A gain of every camera."""
        return tuple(f"gain of {name} * counts" for name in instrument.cameras.names)

    def patch(self, instrument: Instrument) -> Instrument:
        """Distort the counts."""
        return instrument.with_part("detectors", Distortion(self.coefficient))
