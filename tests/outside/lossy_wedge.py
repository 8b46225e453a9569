"""Depolarisation by the wedge ahead of HWP2: the linear polarisation of that half is smaller by a share."""

from typing import ClassVar

from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.elements.simple import Depolariser
from walop_jax.model.parameters import param


class LossyWedge(Effect):
    """A share of the linear polarisation is lost ahead of HWP2."""

    share: Scalar = param(unit="", about="share lost", source="a test", width=0.02, default=0.0)

    name: ClassVar[str] = "lossy_wedge"
    revealed_by: ClassVar[str] = "polariser exposures: both cameras of the u half modulate less"
    separated_by: ClassVar[str] = "nothing but the efficiency of the same half"

    def patch(self, instrument):
        """Insert a depolariser directly ahead of the plate."""
        return instrument.inserted(Depolariser(name=self.name, linear=self.share), before="half2.plate")
