"""What an effect is: a component with a name that acts at one stage of the light path, or at a few.

The light path (`light.py`) passes every stage through the active effects in order; the hooks below are the
stages, and each leaves the light as it is unless an effect overrides it. An effect that is not active is
not in the tree: it costs nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from walop_jax.model.parameters import Component, field_declarations, unknown_name
from walop_jax.model.plates import Plate

CONTRACT = "calibration contract, section 6"

Real = Float[Array, "..."]
Scalar = Float[Array, ""]


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
    median: Float[Array, "e 4"] | None = (
        None  # median counts over the field; only where an effect asks for it
    )


class Conditions(NamedTuple):
    """What the optics know of the moment: one element per wavelength node."""

    temperature: Float[Array, " n"]  # Celsius
    hour_angle: Float[Array, " n"]  # h
    band_width: Float[Array, " n"]  # µm: equivalent width of the filter that the node belongs to


class Context(NamedTuple):
    """What effects that grow with the data need to know of them.

    `moon` holds the positions of the Moon exposures and `moon_ids` their EXPOSURE numbers; `sources` the
    names of the standards, `exposures` the number of exposures.
    """

    exposures: int = 0
    moon: tuple[int, ...] = ()
    moon_ids: tuple[int, ...] = ()
    sources: tuple[str, ...] = ()


class Effect(Component):
    """A physical effect beyond the base model.

    Its parameters are the `param` fields; static fields are its discrete choices (which camera, which
    star). `shape` names the parameters that act non-linearly (phase, gap, position); all others are
    amplitudes, and nothing happens when they are neutral, whatever the shape. `starts` are groups of shapes
    from which to look for the effect: groups are alternatives, the members of a group are directions that
    are fitted together and that `combine` turns into one effect. `one_sided` names amplitudes that physics
    keeps above neutral. `optics_depend_on` names the exposure quantities ("temperature", "hour_angle") that
    make the optics differ from exposure to exposure; `fringes` is the path difference, in waves at 0.62 µm,
    that the wavelength nodes must follow; `uses_median` asks for the median counts of every exposure.
    """

    name: ClassVar[str] = ""
    shape: ClassVar[tuple[str, ...]] = ()
    starts: ClassVar[tuple[tuple[Mapping[str, Any], ...], ...]] = (({},),)
    one_sided: ClassVar[tuple[str, ...]] = ()
    revealed_by: ClassVar[str] = ""
    separated_by: ClassVar[str] = ""
    optics_depend_on: ClassVar[tuple[str, ...]] = ()
    fringes: ClassVar[float] = 0.0
    uses_median: ClassVar[bool] = False

    # ---------------------------------------------------------------------------------- making and describing

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """The effect with values that change nothing."""
        del context
        return cls()

    @classmethod
    def of(cls, context: Context, **values: Any) -> Self:
        """The neutral effect with some values replaced; a scalar fills a parameter that has many elements.

        Raises ValueError, with the nearest names, for a parameter that the effect does not have.
        """
        effect = cls.neutral(context)
        names = [field.name for field in dataclasses.fields(effect)]
        for name, value in values.items():
            if name not in names:
                raise unknown_name(f"parameter of {cls.name}", name, names)
            if name in field_declarations(cls):
                values[name] = jnp.broadcast_to(jnp.asarray(value, float), np.shape(getattr(effect, name)))
        return dataclasses.replace(effect, **values)

    @classmethod
    def probes(cls, context: Context) -> tuple[tuple[Self, ...], ...]:
        """Neutral effects at the shapes of `starts`: what a linear search differentiates."""
        return tuple(tuple(cls.of(context, **start) for start in group) for group in cls.starts)

    @classmethod
    def combine(cls, group: Sequence[Any], amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Self:
        """The effect with the amplitudes that a linear fit of the probes of a group has found.

        `amplitudes` are counted from neutral, member by member in the order of the fields. A group of one
        takes them as they are; groups of more know how to merge their members.
        """
        if len(group) != 1:
            raise NotImplementedError(f"{cls.name} does not say how its probes combine")
        rest = np.asarray(amplitudes, float)
        changed: dict[str, Any] = {}
        for name in cls.amplitudes():
            value = np.asarray(getattr(group[0], name))
            changed[name] = value + rest[: value.size].reshape(value.shape)
            rest = rest[value.size :]
        return dataclasses.replace(group[0], **changed)

    @classmethod
    def amplitudes(cls) -> tuple[str, ...]:
        """Names of the parameters in which the effect is linear at neutral."""
        return tuple(name for name in field_declarations(cls) if name not in cls.shape)

    @classmethod
    def is_structural(cls) -> bool:
        """Whether the effect has no parameter: it is there or it is not."""
        return not field_declarations(cls)

    def choices(self) -> dict[str, Any]:
        """Discrete choices that belong to the description of the effect, e.g. the number of a camera."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.metadata.get("static")}

    def survives(self, wavelength: Float[np.ndarray, " n"], weight: Float[np.ndarray, "b n"]) -> float:
        """Share of the effect that the band integrals leave of it; 1 unless it oscillates with wavelength."""
        return 1.0

    def at_neutral(self, context: Context) -> Self:
        """The same effect, discrete choices included, with values that change nothing."""
        return type(self).of(context, **self.choices())

    def standard_form(self) -> Self:
        """The same effect with positive amplitude and with angles in their principal range."""
        return self

    # --------------------------------------------------------------------------------------- the light itself

    def rotator(self, offset: Scalar | float) -> Scalar | float:
        """True position angle of +X minus the header's (rad)."""
        return offset

    def moon(self, beam: Float[Array, "e 2"], sky: Float[Array, "e 2"]) -> Float[Array, "e 2"]:
        """Polarisation (q, u) of the sky in the ICS; `sky` is that of single scattering for δ = 1."""
        return beam

    def catalogue(
        self, q: Float[Array, " s"], u: Float[Array, " s"], names: tuple[str, ...]
    ) -> tuple[Float[Array, " s"], Float[Array, " s"]]:
        """True Stokes parameters of the standards (equatorial frame)."""
        return q, u

    def telescope(self, mueller: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
        """Mueller matrix that light from the sky meets ahead of the polariser's place."""
        return mueller

    def polariser_angle(self, angle: Real, exposures: ExposureArrays) -> Real:
        """Transmission axis (rad) from the encoder reading (rad)."""
        return angle

    def extinction(self, ratio: Scalar | float) -> Scalar | float:
        """Extinction ratio of the polariser."""
        return ratio

    def polarised(self, stokes: Float[Array, "e 4"], exposures: ExposureArrays) -> Float[Array, "e 4"]:
        """Light behind the polariser."""
        return stokes

    # ------------------------------------------------------------------------------------------------- optics

    def field(self, x: Real, y: Real, conditions: Conditions) -> tuple[Real, Real]:
        """Field coordinates (deg) that the pupil mapping sees."""
        return x, y

    def upstream(self, mueller: Float[Array, "4 4"], x: Scalar, y: Scalar) -> Float[Array, "4 4"]:
        """Mueller matrix from behind the polariser to the calibration plate, collimator included."""
        return mueller

    def wavelengths(self, wavelength: Real, conditions: Conditions) -> Real:
        """Wavelengths (µm) of the nodes of the band."""
        return wavelength

    def calibration_plate(self, angle: float | None) -> float | None:
        """Angle (deg) of the calibration plate, None when it is out."""
        return angle

    def plates(self, where: str, plates: tuple[Plate, ...], conditions: Conditions) -> tuple[Plate, ...]:
        """Plates (quartz, MgF2) of a half-wave plate; `where` is "chwp", "half1" or "half2"."""
        return plates

    def ahead_of_plates(
        self,
        where: str,
        mueller: Float[Array, "n 4 4"],
        sx: Real,
        sy: Real,
        wavelength: Real,
        fast_axis: Real,
    ) -> Float[Array, "n 4 4"]:
        """Mueller matrix of a half-wave plate with whatever stands directly ahead of it."""
        return mueller

    def analyser_angle(self, angle: Scalar | float) -> Scalar | float:
        """Rotation (rad) of the Wollaston prisms."""
        return angle

    # ------------------------------------------------------------------------------------------------ cameras

    def throughput(self, throughput: Float[Array, 4], x: Scalar, y: Scalar) -> Float[Array, 4]:
        """Throughput of the cameras at a field point."""
        return throughput

    def cameras(self, vectors: Float[Array, "b 4 4"], x: Scalar, y: Scalar) -> Float[Array, "b 4 4"]:
        """Analysis vectors (band, camera, Stokes) behind the throughput."""
        return vectors

    def recorded(
        self,
        counts: Float[Array, "e 4"],
        unpolarised: Float[Array, "e 4"],
        exposures: ExposureArrays,
        x: Scalar,
        y: Scalar,
    ) -> Float[Array, "e 4"]:
        """Counts for light of unit flux; `unpolarised` are those of unpolarised light."""
        return counts

    def mirrored(
        self, counts: Float[Array, "e 4"], opposite: Float[Array, "e 4"], extended: Bool[Array, " e"]
    ) -> Float[Array, "e 4"]:
        """Counts for light of unit flux; `opposite` are those of the same source at (−X, −Y)."""
        return counts

    def detector(self, counts: Float[Array, "e 4"], exposures: ExposureArrays) -> Float[Array, "e 4"]:
        """What the detectors report for the counts (electrons) that reach them."""
        return counts


def per_camera(value: float = 0.0) -> Float[Array, 4]:
    """One value for each camera."""
    return jnp.full(4, value)


def check_camera(effect: Effect, camera: int) -> None:
    """Raise ValueError unless `camera` is 0, 1, 2 or 3."""
    if camera not in (0, 1, 2, 3):
        raise ValueError(f"{effect.name}: camera {camera!r} does not exist, choose 0, 1, 2 or 3")


def overridden(effects: Sequence[Effect], hook: str) -> bool:
    """Whether any of the effects does something at a hook."""
    return any(getattr(type(effect), hook) is not getattr(Effect, hook) for effect in effects)
