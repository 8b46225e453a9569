"""Stress birefringence of the collimator lenses.

Equation    M = Ret(2π delta (r/0.3°)², φ) · collimator
Symbols     delta retardance in waves at 0.3°, fast axis radial; r, φ polar coordinates of the field point
Source      stress of mounted lenses grows like the radius squared (Selbing
            2005, arXiv:1010.4142; Patat & Romaniello 2006, PASP 118, 146, for the pattern in a focal
            reducer).
Neutral     delta = 0
Revealed by V picked up in proportion to r², with the pattern of cos 2φ and sin 2φ.

Written with (1 − cos Δ)/Δ² and sin Δ/Δ, both smooth at the centre of the field, Δ(cos 2φ, sin 2φ) being
k (x² − y², 2xy).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.elements import RadialRetarder
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Selbing 2010, arXiv:1010.4142; Patat & Romaniello 2006, PASP 118, 146"

REFERENCE_RADIUS = 0.3  # degrees


class LensBirefringence(Effect):
    """Retardance of the collimator with a radial fast axis."""

    delta: Scalar = param(unit="wave", about="retardance at 0.3°", source=SOURCE, width=0.005, default=0.0)

    name: ClassVar[str] = "lens_birefringence"
    said: ClassVar[tuple[str, ...]] = ("retardance radial behind collimator",)
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "polariser exposures over the field"
    separated_by: ClassVar[str] = (
        "the calibration plate at 45° turns what it makes; its radial pattern about the axis (errors of the "
        "plates have theirs about the wedge normal); narrow bands"
    )

    def patch(self, instrument: Instrument) -> Instrument:
        """Insert a radial retarder behind the collimator."""
        return instrument.inserted(RadialRetarder(name=self.name, delta=self.delta), before="pupil")
