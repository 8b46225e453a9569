"""Analysers: where an arm ends and the beams of its cameras begin.

Equation    beams of an arm ½ (1, ±η cos 2α, ±η sin 2α, 0), first camera +, with η ± ξ in the place of η
            with a dispersion κ the first camera sees the band at λ (1 + κ), the second at λ (1 − κ), to first order:
            M → M ± κ λ ∂M/∂λ, M the train ahead of the analyser
            with balance g and loss l, curves over wavelength taken at the mean wavelength of a band, the beams of η = 1
            are ½ (1 ± g) (1, ±(1 − l) cos 2α, ±(1 − l) sin 2α, 0): what differs from band to band
Symbols     η efficiency, near 1, ξ half its difference between the beams; α axis of the first beam, from +X toward +Y;
            κ half the relative difference of the wavelengths of the two beams
Source      Wollaston prism as a pair of crossed analysers: Goldstein 2003, Polarized Light, ch. 9.
Limits      no balance, no loss: as if g = l = 0
            η = 1, α = 0 are ideal analysers along +X and +Y; κ = 0: both see the filter as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.elements.base import Element
from walop_jax.model.elements.spectral import Curve, check_curve, spline
from walop_jax.model.parameters import number

Scalar = Float[Array, ""]


class Analyser(Element):
    """A polarising beam splitter: two beams, one for each of its cameras.

    What depends on the light ahead of it (`seen`) and what does not (`shares`) are kept apart: only the first
    enters the band integral.
    """

    efficiency: Scalar = number(unit="", about="η of the analysers ½(1, ±η, 0, 0)", default=1.0)
    contrast: Scalar | None = number(
        unit="", about="ξ, half the difference of the efficiencies", default=None
    )
    angle: Scalar | None = number(unit="deg", about="rotation of the analysers", default=None)
    dispersion: Scalar | None = number(
        unit="", about="κ, first beam at λ (1 + κ), second at λ (1 − κ)", default=None
    )
    balance: Curve | None = number(
        unit="", about="half the relative difference of the beams at `balance_at`", default=None, several=True
    )
    loss: Curve | None = number(
        unit="", about="share of the polarisation lost at `loss_at`", default=None, several=True
    )
    balance_at: tuple[float, ...] = eqx.field(static=True, default=())
    loss_at: tuple[float, ...] = eqx.field(static=True, default=())
    cameras: tuple[str, ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = "analyser"
    reference: ClassVar[str] = "Goldstein 2003, Polarized Light, ch. 9"

    rows: ClassVar[int] = 2

    def seen(self, mueller: Float[Array, "*n 4 4"]) -> Float[Array, "*n 2 4"]:
        """Rows of the Mueller matrix ahead of it that the beams are made of: S0 and what is analysed."""
        analysed = mueller[..., 1, :]
        if self.angle is not None:
            twice = 2.0 * jnp.deg2rad(self.angle)
            analysed = jnp.cos(twice) * mueller[..., 1, :] + jnp.sin(twice) * mueller[..., 2, :]
        return jnp.stack([mueller[..., 0, :], analysed], axis=-2)

    def __check_init__(self) -> None:
        check_curve("balance", self.balance, self.balance_at)
        check_curve("loss", self.loss, self.loss_at)

    def labels(self, field: str) -> Sequence[str]:
        """Values of a curve are numbered from 1, by wavelength."""
        knots = {"balance": self.balance_at, "loss": self.loss_at}.get(field)
        return (field,) if knots is None else tuple(f"{field}{i + 1}" for i in range(len(knots)))

    def in_band(self, rows: Float[Array, "b r 4"], wavelength: Float[Array, " b"]) -> Float[Array, "b r 4"]:
        """Band-integrated rows of `seen` (or of their slopes) with balance and loss, at mean wavelengths (µm)."""
        whole, analysed = rows[:, 0], rows[:, 1]
        if self.loss is not None:
            analysed = (1.0 - spline(self.loss_at, self.loss, wavelength))[:, None] * analysed
        if self.balance is not None:
            g = spline(self.balance_at, self.balance, wavelength)[:, None]
            whole, analysed = whole + g * analysed, analysed + g * whole
        return jnp.stack([whole, analysed], axis=1)

    def shares(self) -> Float[Array, "k 2"]:
        """What each beam takes of `seen`."""
        half = 0.5 * jnp.ones_like(self.efficiency)
        extra = jnp.zeros_like(half) if self.contrast is None else 0.5 * self.contrast
        along = 0.5 * self.efficiency
        return jnp.stack([jnp.stack([half, along + extra]), jnp.stack([half, extra - along])])

    def shares_of_slopes(self) -> Float[Array, "k 2"]:
        """What each beam takes of λ ∂/∂λ of `seen`."""
        kappa = jnp.zeros_like(self.efficiency) if self.dispersion is None else self.dispersion
        return self.shares() * jnp.stack([kappa, -kappa])[:, None]
