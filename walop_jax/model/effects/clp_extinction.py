"""Extinction ratio of the polariser other than the assumed one.

Equation    light behind the polariser (1, c cos 2θ, c sin 2θ, 0), c = (1 − ratio) / (1 + ratio)
Symbols     θ transmission axis; ratio: unwanted over wanted transmission
Source      the polariser of WALOP-South has an extinction above 5000,
            ratio < 2e-4 (Maharana et al. 2022, Paper II).
Neutral     ratio = 2e-5, the value of the base model
Revealed by efficiencies that the polariser finds lower, by 2 ratio, than polarised standards do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Self

import jax.numpy as jnp

from walop_jax.model.conventions import EXTINCTION
from walop_jax.model.effects.base import Context, Effect, Scalar
from walop_jax.model.parameters import param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Maharana et al. 2022, Paper II: extinction of the polariser above 5000"


class ClpExtinction(Effect):
    """Extinction ratio of the polariser other than the assumed one."""

    ratio: Scalar = param(
        unit="", about="ε, instead of the base model's", source=SOURCE, width=2e-4, default=EXTINCTION
    )

    name: ClassVar[str] = "clp_extinction"
    said: ClassVar[tuple[str, ...]] = ("depolarisation of polariser",)
    reference: ClassVar[str] = SOURCE
    one_sided: ClassVar[tuple[str, ...]] = ("ratio",)
    revealed_by: ClassVar[str] = "polariser exposures together with standards polarised by several per cent"
    separated_by: ClassVar[str] = (
        "standards of 3–5 % (weakly), a second, crossed polariser in the laboratory, or two flux levels: "
        "leakage, analyser efficiency and stray light lower the efficiency as well"
    )

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """The extinction ratio that the polariser has without the effect."""
        return cls(ratio=jnp.asarray(context.extinction))

    def patch(self, instrument: Instrument) -> Instrument:
        """Replace the extinction ratio."""
        return instrument.changed("polariser", extinction=self.ratio)
