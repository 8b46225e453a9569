"""A ray on its way through the train: field point, direction and conditions.

Units       field coordinates deg; direction cosines of the unit vector along the ray in air, axes of the instrument
            frame; vacuum wavelength µm. Leading achromatic elements are evaluated without a wavelength.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

Real = Float[Array, "..."]

CONDITIONS = {"temperature": "TEMP", "hour_angle": "HA", "hours": "MJD", "exptime": "EXPTIME"}
"""Conditions on which the optics may depend from exposure to exposure (Celsius; hours; hours since the first one; s),
and their columns of EXPOSURES. Whether an exposure is of some KIND is one more, for each KIND, as is whether it is of
some interval of hours."""
SMOOTH = "smooth "
"""Opens the name of a condition of which the optics are needed at a few values only (`planning.SMOOTH_NODES`)."""


def within(hours: Any, start: str, stop: str) -> Any:
    """True for hours of an interval, which is given as it is typed; the end is outside."""
    return (hours >= float(start)) & (hours < float(stop))


class NotPlannedError(ValueError):
    """The optics depend on a quantity that the plan lacks: `quantity`, `asked` for as a smooth one or not."""

    def __init__(self, quantity: str) -> None:
        self.asked, self.quantity = quantity, quantity.removeprefix(SMOOTH)
        super().__init__(
            f"the optics ask for {self.quantity!r}, which this plan does not hold; make the plan with `plan_for` for "
            "the instrument that is computed, effects included"
        )


class Conditions(eqx.Module):
    """Conditions of an exposure at every wavelength node: those that the optics use.

    `band_width` is the equivalent width (µm) of the filter of a node.
    """

    band_width: Real
    planned: Mapping[str, Real]

    def __getattr__(self, name: str) -> Real:
        if name not in CONDITIONS:
            raise AttributeError(name)
        return self._planned(name)

    def smooth(self, name: str) -> Real:
        """One of `CONDITIONS` on which the optics depend as a polynomial does, to all digits that count."""
        return self.planned[name] if name in self.planned else self._planned(SMOOTH + name)

    def holds(self, name: str) -> bool:
        """True if one of `CONDITIONS` is there, at its values or at a few."""
        return name in self.planned or SMOOTH + name in self.planned

    def between(self, start: str, stop: str) -> Real:
        """1 in exposures of an interval of hours, 0 in others."""
        return self._planned(f"hours {start} to {stop}")

    def of_kind(self, name: str) -> Real:
        """1 in exposures of a KIND, 0 in others."""
        return self._planned(f"kind {name}")

    def _planned(self, quantity: str) -> Real:
        if quantity not in self.planned:
            raise NotPlannedError(quantity)
        return self.planned[quantity]


class Ray(eqx.Module):
    """A ray at a place of the train; its direction is (kx, ky, kz), in air."""

    x: Real
    y: Real
    kx: Real
    ky: Real
    spectrum: tuple[Real, Conditions] | None

    @classmethod
    def entering(cls, x: Real, y: Real, spectrum: tuple[Real, Conditions] | None = None) -> Ray:
        """The ray from a field point (deg) ahead of the mapping from field to pupil: along the axis."""
        zero = jnp.zeros(())
        return cls(x, y, zero, zero, spectrum)

    @classmethod
    def on_trial(cls, quantities: Iterable[str]) -> Ray:
        """A ray along the axis at one wavelength, with some of `CONDITIONS`: for dependences."""
        ones, zero = jnp.ones(1), jnp.zeros(())
        return cls.entering(
            zero, zero, (0.62 * ones, Conditions(0.1 * ones, dict.fromkeys(quantities, ones)))
        )

    @property
    def kz(self) -> Real:
        """Cosine of the angle to the axis."""
        return jnp.sqrt(1.0 - self.kx**2 - self.ky**2)

    @property
    def wavelength(self) -> Real:
        """Vacuum wavelengths (µm) of the nodes."""
        if self.spectrum is None:
            raise NotPlannedError("wavelength")
        return self.spectrum[0]

    @property
    def conditions(self) -> Conditions:
        """Conditions of the exposure."""
        if self.spectrum is None:
            raise NotPlannedError("conditions")
        return self.spectrum[1]

    def moved(self, x: Real, y: Real) -> Ray:
        """The ray from another field point."""
        return Ray(x, y, self.kx, self.ky, self.spectrum)

    def toward(self, kx: Real, ky: Real) -> Ray:
        """The ray in another direction."""
        return Ray(self.x, self.y, kx, ky, self.spectrum)
