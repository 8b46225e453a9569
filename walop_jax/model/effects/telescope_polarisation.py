"""Polarisation by the telescope.

Equation    M = [[1, 0], [(q, u, 0)ᵀ, 1]]: (0, q, u, 0) per unit of light is added to every beam from the
            sky
Symbols     q, u in the ICS
Source      0.3 % was found on a Cassegrain telescope with aged mirrors
            (Patat & Taubenberger 2011, A&A 529, A57), Paper II assumes less than 0.01 %.
Neutral     q = u = 0
Revealed by zero offsets of Moon and stars that polariser exposures do not have (light through the polariser
            forgets its past). Light of known flux (KIND `flux`) does not come from the sky.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.elements import AddedPolarisation
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Patat & Taubenberger 2011, A&A 529, A57"


class TelescopePolarisation(Effect):
    """Polarisation that the telescope adds to light from the sky."""

    q: Scalar = param(unit="", about="polarisation added along +X", source=SOURCE, width=0.002, default=0.0)
    u: Scalar = param(unit="", about="polarisation added along +45°", source=SOURCE, width=0.002, default=0.0)

    name: ClassVar[str] = "telescope_polarisation"
    said: ClassVar[tuple[str, ...]] = (
        "diattenuation q ahead of polariser",
        "diattenuation u ahead of polariser",
    )
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = (
        "unpolarised or known standards, with polariser exposures of the same field points"
    )
    separated_by: ClassVar[str] = (
        "standards at several ROTATOR angles: the telescope's part stays in the instrument frame, an error "
        "of the catalogue turns with the sky; Moon patches must see the same offset, an error of one patch "
        "does not"
    )

    def patch(self, instrument: Instrument) -> Instrument:
        """Insert what the telescope adds ahead of the polariser."""
        added = AddedPolarisation(name=self.name, q=self.q, u=self.u)
        return instrument.inserted(added, before="polariser")
