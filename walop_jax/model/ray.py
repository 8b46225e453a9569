"""A ray on its way through the train: field point, direction and conditions.

Units       field coordinates deg; direction cosines of the unit vector along the ray in air, axes of the instrument
            frame; vacuum wavelength µm. Leading achromatic elements are evaluated without a wavelength.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from walop_jax.model.mueller import Real

CONDITIONS = {"temperature": "TEMP", "hour_angle": "HA", "hours": "MJD", "exptime": "EXPTIME"}
"""Conditions on which the optics may depend from exposure to exposure, and their columns of EXPOSURES: temperature in
Celsius, hour angle in hours, hours since the first exposure, exposure time in seconds. Two more kinds of condition are
flags, 0 or 1: "this exposure has KIND k", and "this exposure was taken in this interval of hours"."""
SMOOTH = "smooth "
"""Opens the name of a condition on which the optics depend smoothly, such as "smooth temperature": they are computed at
a few values of it and interpolated between them (`planning.SMOOTH_NODES`)."""


def within(hours: Any, start: str, stop: str) -> Any:
    """True for times that lie in the interval from `start` to `stop` (hours, as typed: "1.5"); `stop` itself lies
    outside.
    """
    return (hours >= float(start)) & (hours < float(stop))


class NotPlannedError(ValueError):
    """The optics depend on a quantity for which the plan has no values.

    `quantity` is its name, with `SMOOTH` ahead of it if it was asked for as a smooth one.
    """

    def __init__(self, quantity: str) -> None:
        self.asked, self.quantity = quantity, quantity.removeprefix(SMOOTH)
        super().__init__(
            f"the optics ask for {self.quantity!r}, which this plan does not hold; make the plan with `plan_for` for "
            "the instrument that is computed, effects included"
        )


class Conditions(eqx.Module):
    """Values of the conditions (temperature, hour angle …) at every wavelength node: those that the optics use.

    `band_width` is the equivalent width (µm) of the filter of a node. An element reads `ray.conditions.temperature`.
    """

    band_width: Real
    planned: Mapping[str, Real]

    def __getattr__(self, name: str) -> Real:
        if name not in CONDITIONS:
            raise AttributeError(name)
        return self._planned(name)

    def smooth(self, name: str) -> Real:
        """The values of a condition on which the optics depend like a low polynomial, so that a few values serve.

        The interpolation between them is exact to all digits that count. Raises `NotPlannedError` if the plan has no
        values.
        """
        return self.planned[name] if name in self.planned else self._planned(SMOOTH + name)

    def holds(self, name: str) -> bool:
        """True if the plan has values of a condition, one for each exposure or a few for interpolation."""
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
    """A ray at one element of the train: its field point (`x`, `y`, deg) and its direction (kx, ky, kz) in air.

    `spectrum` holds the wavelengths (µm) of the nodes and the `Conditions` at them; None for elements that are
    evaluated without a wavelength.
    """

    x: Real
    y: Real
    kx: Real
    ky: Real
    spectrum: tuple[Real, Conditions] | None

    @classmethod
    def entering(cls, x: Real, y: Real, spectrum: tuple[Real, Conditions] | None = None) -> Ray:
        """The ray of a field point (deg) as it enters the train: along the axis, for the field tilts it only in the
        pupil mapping.
        """
        zero = jnp.zeros(())
        return cls(x, y, zero, zero, spectrum)

    @classmethod
    def on_trial(cls, quantities: Iterable[str]) -> Ray:
        """A test ray along the axis at one wavelength that carries the given conditions.

        An element is run with it to find out which conditions it asks for (`dependence`).
        """
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
        """The conditions at the wavelength nodes. Raises `NotPlannedError` for a ray without a wavelength."""
        if self.spectrum is None:
            raise NotPlannedError("conditions")
        return self.spectrum[1]

    def moved(self, x: Real, y: Real) -> Ray:
        """The same ray from the field point `x`, `y` (deg)."""
        return Ray(x, y, self.kx, self.ky, self.spectrum)

    def toward(self, kx: Real, ky: Real) -> Ray:
        """The same ray in the direction with the cosines `kx`, `ky`."""
        return Ray(self.x, self.y, kx, ky, self.spectrum)
