"""The calibration polariser: light behind it forgets its past.

Equation    light behind it (1, c cos 2θ, c sin 2θ, v), c = (1 − ε)/(1 + ε), per unit of transmitted light
            θ = reading + zero
Symbols     θ transmission axis in the instrument frame; ε extinction ratio, unwanted over wanted transmission;
            v circular polarisation behind it; reading: encoder [deg]
Source      Malus' law for a polariser of finite extinction: Goldstein 2003, Polarized Light, ch. 9.
Limits      ε = 0 is the ideal polariser. What it does to the flux of polarised light is part of the unknown flux.
"""

from __future__ import annotations

import abc
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model import mueller
from walop_jax.model.elements.base import Element
from walop_jax.model.parameters import Component, number
from walop_jax.model.sources import ExposureArrays

Scalar = Float[Array, ""]
Angles = Float[Array, " e"]


class Film(Component):
    """What light meets directly behind the polariser, at its angle and only when it is in."""

    @abc.abstractmethod
    def through(
        self, light: Float[Array, "e 4"], exposures: ExposureArrays, x: Scalar, y: Scalar
    ) -> Float[Array, "e 4"]:
        """Stokes vectors behind it at a field point, one per exposure."""


class Polariser(Element):
    """A polariser whose axis is read from an encoder."""

    extinction: Scalar = number(unit="", about="ε, unwanted over wanted transmission")
    zero: Scalar | None = number(unit="deg", about="added to the encoder reading", default=None)
    ellipticity: Scalar | None = number(unit="", about="circular polarisation behind it", default=None)
    films: tuple[Film, ...] = ()

    kind: ClassVar[str] = "polariser"
    reference: ClassVar[str] = "Goldstein 2003, Polarized Light, ch. 9"

    def axis_of(self, reading: Angles) -> Angles:
        """Transmission axis (rad) from the encoder reading (rad)."""
        return reading if self.zero is None else reading + jnp.deg2rad(self.zero)

    def light(self, exposures: ExposureArrays, x: Scalar, y: Scalar) -> Float[Array, "e 4"]:
        """Stokes vectors behind it at a field point, per unit of transmitted light, one per exposure."""
        behind = mueller.polarised(self.axis_of(exposures.clp_angle), self.extinction)
        if self.ellipticity is not None:
            behind = behind.at[:, 3].add(self.ellipticity)
        for film in self.films:
            behind = film.through(behind, exposures, x, y)
        return behind
