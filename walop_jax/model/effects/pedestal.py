"""Scattered light: a pedestal under the whole exposure.

Equation    N_k → N_k + level_k · median over the field of the measured counts of camera k in that exposure
Symbols     level per camera, a share
Source      calibration contract, section 6; 0.1–1 % of diffuse light is common in focal reducers.
Neutral     level = 0
Revealed by efficiencies that are lower where the field is darker (vignetted corners, stars fainter than the
            median).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Self

from jaxtyping import Array, Float

from walop_jax.model.conventions import CAMERAS
from walop_jax.model.effects.base import CONTRACT, Context, Effect, ExposureArrays, per_camera
from walop_jax.model.parameters import param


class Pedestal(Effect):
    """A share of the exposure's median counts everywhere."""

    level: Float[Array, 4] = param(unit="", about="share of the median counts", source=CONTRACT, width=0.003)

    name: ClassVar[str] = "pedestal"
    uses_median: ClassVar[bool] = True
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
        return cls(level=per_camera())

    def labels(self, field: str) -> Sequence[str]:
        """One level per camera."""
        return tuple(f"{field}.{camera}" for camera in CAMERAS)

    def detector(self, counts: Float[Array, "e 4"], exposures: ExposureArrays) -> Float[Array, "e 4"]:
        """Add the pedestal."""
        if exposures.median is None:
            raise ValueError("pedestal: the median counts of the exposures are missing from the plan")
        return counts + self.level * exposures.median
