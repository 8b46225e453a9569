"""Extinction ratio of the polariser other than the assumed one.

Equation    light behind the polariser (1, c cos 2θ, c sin 2θ, 0), c = (1 − ratio) / (1 + ratio)
Symbols     θ transmission axis; ratio: unwanted over wanted transmission
Source      calibration contract, section 6; the polariser of WALOP-South has an extinction above 5000,
            ratio < 2e-4 (Maharana et al. 2022, Paper II).
Neutral     ratio = 2e-5, the value of the base model
Revealed by efficiencies that the polariser finds lower, by 2 ratio, than polarised standards do.
"""

from __future__ import annotations

from typing import ClassVar

from walop_jax.model.conventions import EXTINCTION
from walop_jax.model.effects.base import CONTRACT, Effect, Scalar
from walop_jax.model.parameters import param


class ClpExtinction(Effect):
    """ε of the polariser is `ratio`."""

    ratio: Scalar = param(
        unit="", about="ε, instead of the base model's", source=CONTRACT, width=2e-4, default=EXTINCTION
    )

    name: ClassVar[str] = "clp_extinction"
    one_sided: ClassVar[tuple[str, ...]] = ("ratio",)
    revealed_by: ClassVar[str] = "polariser exposures together with standards polarised by several per cent"
    separated_by: ClassVar[str] = (
        "standards of 3–5 % (weakly), a second, crossed polariser in the laboratory, or two flux levels: "
        "leakage, analyser efficiency and stray light lower the efficiency as well"
    )

    def extinction(self, ratio: Scalar | float) -> Scalar | float:
        """Replace the extinction ratio."""
        return self.ratio
