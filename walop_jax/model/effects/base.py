"""What an effect is: a component with a name that acts at one stage of the light path, or at a few.

The light path (`light.py`) passes every stage through the active effects in order; the hooks below are the
stages, and each leaves the light as it is unless an effect overrides it. An effect that is not active is not in
the tree: it costs nothing.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

from jaxtyping import Array, Bool, Float

from walop_jax.model.parameters import Component
from walop_jax.model.plates import Plate

Real = Float[Array, "..."]


class ExposureArrays(NamedTuple):
    """What the light path needs to know of the exposures (one element each)."""

    clp_in: Bool[Array, " e"]
    clp_angle: Float[Array, " e"]  # rad; 0 when out
    moon: Bool[Array, " e"]
    flux_known: Bool[Array, " e"]
    rotator: Float[Array, " e"]  # rad; 0 where it has no meaning
    hours: Float[Array, " e"]  # since the first exposure
    temperature: Float[Array, " e"]  # Celsius
    hour_angle: Float[Array, " e"]  # h


class Conditions(NamedTuple):
    """What the optics know of the moment: one element per wavelength node."""

    temperature: Float[Array, " n"]
    hour_angle: Float[Array, " n"]


class Effect(Component):
    """A physical effect beyond the base model.

    `optics_depend_on` names the exposure quantities ("temperature", "hour_angle") that make the optics differ
    from exposure to exposure when this effect is active.
    """

    name: ClassVar[str] = ""
    optics_depend_on: ClassVar[tuple[str, ...]] = ()

    def sky(self, stokes: Float[Array, "e 4"], exposures: ExposureArrays) -> Float[Array, "e 4"]:
        """Light from the sky that does not pass the polariser, in the ICS."""
        return stokes

    def polariser_angle(self, angle: Real, exposures: ExposureArrays) -> Real:
        """Transmission axis (rad) from the encoder reading (rad)."""
        return angle

    def polarised(self, stokes: Float[Array, "e 4"], exposures: ExposureArrays) -> Float[Array, "e 4"]:
        """Light behind the polariser."""
        return stokes

    def field(self, x: Real, y: Real, conditions: Conditions) -> tuple[Real, Real]:
        """Field coordinates (deg) that the pupil mapping sees."""
        return x, y

    def upstream(self, mueller: Float[Array, "4 4"], x: Real, y: Real) -> Float[Array, "4 4"]:
        """Mueller matrix from behind the polariser to the calibration plate, collimator included."""
        return mueller

    def wavelengths(self, wavelength: Real) -> Real:
        """Wavelengths (µm) of the nodes of the band."""
        return wavelength

    def calibration_plate(self, angle: float | None) -> float | None:
        """Angle (deg) of the calibration plate, None when it is out."""
        return angle

    def plates(self, where: str, plates: tuple[Plate, ...], conditions: Conditions) -> tuple[Plate, ...]:
        """Plates of a half-wave plate; `where` is "chwp", "half1" or "half2"."""
        return plates

    def ahead_of_plates(
        self, where: str, mueller: Float[Array, "n 4 4"], sx: Real, sy: Real, wavelength: Real, fast_axis: Real
    ) -> Float[Array, "n 4 4"]:
        """Mueller matrix of a half-wave plate with whatever stands directly ahead of it."""
        return mueller

    def analyser_angle(self, angle: Real | float) -> Real | float:
        """Rotation (rad) of the Wollaston prisms."""
        return angle

    def throughput(self, throughput: Float[Array, "4"], x: Real, y: Real) -> Float[Array, "4"]:
        """Throughput of the cameras at a field point."""
        return throughput

    def counts(self, counts: Float[Array, "e 4"], exposures: ExposureArrays) -> Float[Array, "e 4"]:
        """Counts of the four cameras."""
        return counts
