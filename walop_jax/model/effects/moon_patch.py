"""Free mean polarisation of every Moon patch.

Equation    (q, u) of exposure e → (q, u) + (q_e, u_e), the same over the field, in the ICS
Symbols     q_e, u_e for each exposure of KIND `moon`
Source      neutral points and aerosol: a third of the patches of RoboPol
            were not what single scattering says (Maharana et al. 2023, A&A 679, A68).
Neutral     all 0
Revealed by Moon patches that disagree with each other under the instrument that polariser and standards
            give.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.effects.base import Context, Effect
from walop_jax.model.parameters import param
from walop_jax.model.sources import Patches

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Maharana et al. 2023, A&A 679, A68"


class MoonPatch(Effect):
    """Polarisation of each Moon patch beyond single scattering."""

    positions: tuple[int, ...] = eqx.field(static=True)
    ids: tuple[int, ...] = eqx.field(static=True)
    q: Float[Array, " m"] = param(unit="", about="added to q of the patch", source=SOURCE, width=0.005)
    u: Float[Array, " m"] = param(unit="", about="added to u of the patch", source=SOURCE, width=0.005)

    name: ClassVar[str] = "moon_patch"
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "Moon patches with polariser exposures"
    separated_by: ClassVar[str] = (
        "the same patch again an hour later, or at another ROTATOR angle: the sky turns, the telescope not"
    )

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """Nothing beyond single scattering in any patch."""
        zero = jnp.zeros(len(context.moon))
        return cls(q=zero, u=zero, positions=context.moon, ids=context.moon_ids)

    def labels(self, field: str) -> Sequence[str]:
        """One value per Moon exposure, by its EXPOSURE number."""
        return tuple(f"{field}.{number}" for number in self.ids)

    def choices(self) -> dict[str, Any]:
        """None: the exposures belong to the data."""
        return {}

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """Two Stokes parameters for every patch."""
        del instrument
        return tuple(f"polarisation {axis} of sky * exposure {n}" for n in self.positions for axis in "qu")

    def patch(self, instrument: Instrument) -> Instrument:
        """Add the values of each patch."""
        return instrument.changed("sky", patches=Patches(self.q, self.u, self.positions))
