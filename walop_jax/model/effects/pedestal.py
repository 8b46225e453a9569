"""Scattered light: a pedestal under the whole exposure.

Equation    N_k → N_k + level_k · median over the field of the measured counts of camera k in that exposure
Symbols     level per camera, a share
Source      0.1–1 % of diffuse light is common in focal reducers.
Neutral     level = 0
Revealed by efficiencies that are lower where the field is darker (vignetted corners, stars fainter than the
            median).
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

SOURCE = "diffuse light of 0.1 to 1 % is common in focal reducers: expected size"


class DiffuseLight(DetectorPart):
    """A share of the median counts of the exposure everywhere."""

    level: Float[Array, " k"]

    def reported(self, counts: Float[Array, "e k"], exposures: ExposureArrays) -> Float[Array, "e k"]:
        """Add the pedestal."""
        return counts + self.level * exposures.median


class Pedestal(Effect):
    """Scattered light: a pedestal under the whole exposure, one level per camera."""

    level: Float[Array, " k"] = param(unit="", about="share of the median counts", source=SOURCE, width=0.003)

    name: ClassVar[str] = "pedestal"
    over_field: ClassVar[bool] = True  # the median of one point is its own count
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = (
        "polariser exposures: modulation of one camera that is diluted by light of all angles"
    )
    separated_by: ClassVar[str] = (
        "two flux levels in one field, or stars brighter and fainter than the median: leakage and analysers "
        "go with the light of the same point"
    )

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """No pedestal in any camera."""
        return cls(level=per_camera(context.cameras))

    def labels(self, field: str) -> Sequence[str]:
        """One level per camera."""
        return tuple(f"{field}.n{k}" for k in range(self.level.shape[0]))

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """Light in every camera."""
        return tuple(f"light in {name}" for name in instrument.cameras.names)

    def patch(self, instrument: Instrument) -> Instrument:
        """Add the pedestal."""
        return instrument.with_part("detectors", DiffuseLight(self.level))
