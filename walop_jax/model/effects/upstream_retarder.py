"""A uniform retarder between the collimator and the plates.

Equation    M = Ret(delta, axis) · collimator
Symbols     delta retardance [rad]; axis of the fast direction, from +X toward +Y [deg]
Source      stress in a window or in the last lens (Selbing 2005,
            arXiv:1010.4142, needed five parameters for one lens).
Neutral     delta = 0, whatever the axis
Revealed by V picked up ahead of the plates: cross-talk in both halves that does not follow their field
            pattern.

Around neutral the effect is linear in delta · (cos 2 axis, sin 2 axis): two probes at 0° and 45° span it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.elements import Retarder
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Selbing 2010, arXiv:1010.4142"


class UpstreamRetarder(Effect):
    """Uniform linear retarder between the collimator and the plates."""

    delta: Scalar = param(unit="rad", about="retardance", source=SOURCE, width=0.02, default=0.0)
    axis: Scalar = param(unit="deg", about="fast axis", source=SOURCE, scale=10.0, loose=500.0, default=0.0)

    name: ClassVar[str] = "upstream_retarder"
    said: ClassVar[tuple[str, ...]] = ("retardance q behind collimator", "retardance u behind collimator")
    reference: ClassVar[str] = SOURCE
    shape: ClassVar[tuple[str, ...]] = ("axis",)
    starts: ClassVar[tuple[tuple[Mapping[str, Any], ...], ...]] = (({"axis": 0.0}, {"axis": 45.0}),)
    revealed_by: ClassVar[str] = "polariser exposures over the field"
    separated_by: ClassVar[str] = (
        "the calibration plate at 45° turns what it makes but not errors of HWP2; narrow bands and "
        "temperature tell it from retardance of the plates"
    )

    @classmethod
    def combine(cls, group: Sequence[Any], amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Self:
        """Retardance and axis from the two linear directions."""
        straight, diagonal = amplitudes
        axis = 0.5 * np.rad2deg(np.arctan2(diagonal, straight))
        return dataclasses.replace(group[0], delta=np.hypot(straight, diagonal), axis=axis)

    def standard_form(self) -> Self:
        """Positive retardance, axis in [0°, 180°)."""
        axis = (float(self.axis) + (90.0 if float(self.delta) < 0 else 0.0)) % 180.0
        return dataclasses.replace(self, delta=jnp.abs(self.delta), axis=axis)

    def patch(self, instrument: Instrument) -> Instrument:
        """Insert a retarder behind the collimator."""
        return instrument.inserted(Retarder(name=self.name, delta=self.delta, axis=self.axis), before="pupil")
