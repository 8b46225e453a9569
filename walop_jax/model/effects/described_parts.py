"""What sentences put into an instrument: terms of the train and of the polariser, gains, cross-talk, detectors.

All of them are neutral at zero. Equations: `described`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model import mueller
from walop_jax.model.cameras import DetectorPart, ExposurePart, Mixing, Transmission
from walop_jax.model.effects.sentence import Sentence, factor
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.elements.polariser import Film
from walop_jax.model.ray import NotPlannedError, Ray
from walop_jax.model.sources import ExposureArrays

Scalar = Float[Array, ""]
Weights = tuple[float, ...]
REFERENCE_COUNTS = 1e6  # electron


# --------------------------------------------------------------------------------- what factors may ask for


@dataclasses.dataclass(frozen=True)
class _Place:
    """A field point, and nothing else: whatever a factor asks for beyond that is an error."""

    x: Any
    y: Any

    def __getattr__(self, name: str) -> Any:
        raise NotPlannedError(name)


@dataclasses.dataclass(frozen=True)
class _InTrain:
    """What a ray knows; `axis` (deg) is where the element stands that moves."""

    ray: Ray
    axis: Any

    def __getattr__(self, name: str) -> Any:
        known = self.ray if name in ("x", "y", "wavelength") else self.ray.conditions
        return getattr(known, name)

    def angle(self, prefix: str) -> Any:
        """That of the element itself."""
        del prefix
        return jnp.deg2rad(self.axis)


@dataclasses.dataclass(frozen=True)
class _InExposures:
    """What a list of exposures knows at a field point."""

    exposures: ExposureArrays
    x: Any = 0.0
    y: Any = 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.exposures, name)

    @property
    def number(self) -> Any:
        """Positions in the list."""
        return jnp.arange(self.exposures.hours.shape[0])

    def angle(self, prefix: str) -> Any:
        """That of the polariser; NaN where it is out."""
        del prefix
        return jnp.where(self.exposures.clp_in, self.exposures.clp_angle, jnp.nan)


def _of_exposures(sentence: Sentence, exposures: ExposureArrays, x: Any = 0.0, y: Any = 0.0) -> Any:
    """The factor of a sentence in every exposure, 0 where what it asks for is not known."""
    return jnp.nan_to_num(sentence.factor(_InExposures(exposures, x, y))) * jnp.ones(exposures.hours.shape[0])


# ------------------------------------------------------------------------------------------ in the light path


def matrix_of(kind: str, size: Any, x: Any, y: Any) -> Mueller:
    """Mueller matrix of a kind of the optics of a given size (array) at a field point (deg)."""
    size = jnp.asarray(size)
    if kind == "turn":  # of the light
        return mueller.one_retarder(3, -2.0 * jnp.deg2rad(size))
    if kind == "depolarisation":
        return jnp.eye(4) - size[..., None, None] * jnp.diag(jnp.array([0.0, 1.0, 1.0, 1.0]))
    name, axis = kind.split()
    along = {"retardance": mueller.one_retarder, "diattenuation": mueller.one_diattenuator}[name]
    if axis in ("q", "u", "v"):
        return along("quv".index(axis) + 1, size)
    straight, across = factor("x2-y2", _Place(x, y)), factor("xy", _Place(x, y))
    if axis == "diagonal":
        straight, across = -across, straight
    return along(1, size * straight) @ along(2, size * across)


class Terms(Element):
    """Sentences about one place of the train."""

    amplitudes: tuple[Scalar, ...] = ()
    axis: Scalar | float = 0.0
    sentences: tuple[Sentence, ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = "described"

    def mueller(self, ray: Ray) -> Mueller:
        """All of them, one behind the other."""
        at, matrix = _InTrain(ray, self.axis), jnp.eye(4)
        for sentence, amplitude in zip(self.sentences, self.amplitudes, strict=True):
            size = amplitude * sentence.factor(at)
            matrix = matrix_of(sentence.kind, size, ray.x, ray.y) @ matrix
        return matrix


class Displaced(Element):
    """A sentence about where the optics behind see the field point."""

    amplitude: Scalar | float = 0.0
    sentence: Sentence = eqx.field(static=True, default=Sentence("displacement x", "ahead of", "pupil"))

    kind: ClassVar[str] = "described"

    def ray(self, ray: Ray) -> Ray:
        """The ray from the place that the optics behind see."""
        by = self.amplitude * self.sentence.factor(_InTrain(ray, 0.0))
        along = (ray.x + by, ray.y) if self.sentence.kind.endswith("x") else (ray.x, ray.y + by)
        return ray.moved(*jnp.broadcast_arrays(*along))


class TermsOfPolariser(Film):
    """Sentences about the polariser: what the light behind it meets when it is in."""

    amplitudes: tuple[Scalar, ...]
    sentences: tuple[Sentence, ...] = eqx.field(static=True)

    def through(
        self, light: Float[Array, "e 4"], exposures: ExposureArrays, x: Scalar, y: Scalar
    ) -> Float[Array, "e 4"]:
        """All of them, one behind the other."""
        for sentence, amplitude in zip(self.sentences, self.amplitudes, strict=True):
            size = amplitude * _of_exposures(sentence, exposures, x, y)
            light = jnp.einsum("est,et->es", matrix_of(sentence.kind, size, x, y), light)
        return light


# ----------------------------------------------------------------------------------------------- the cameras


class Shade(Transmission):
    """A gain that depends on the field alone; `cameras` says what it is of."""

    amplitude: Scalar
    sentence: Sentence = eqx.field(static=True)
    cameras: Weights = eqx.field(static=True)

    def factors(self, x: Scalar, y: Scalar) -> Float[Array, " k"]:
        """1 + the amplitude × its pattern."""
        pattern = self.sentence.factor(_Place(x, y))
        return 1.0 + self.amplitude * pattern * jnp.asarray(self.cameras)


class Gain(ExposurePart):
    """A gain that depends on the exposure, or on exposure and field."""

    amplitude: Scalar
    sentence: Sentence = eqx.field(static=True)
    cameras: Weights = eqx.field(static=True)

    def factors(self, exposures: ExposureArrays, x: Scalar, y: Scalar) -> Float[Array, "e k"]:
        """1 + the amplitude × its pattern."""
        pattern = _of_exposures(self.sentence, exposures, x, y)
        return 1.0 + self.amplitude * pattern[:, None] * jnp.asarray(self.cameras)


class CrossTalk(Mixing):
    """A share of the light of one camera in another one."""

    amplitude: Scalar
    target: int = eqx.field(static=True)
    origin: int = eqx.field(static=True)

    def vectors(self, vectors: Float[Array, "b k 4"], x: Scalar, y: Scalar) -> Float[Array, "b k 4"]:
        """Mix the analysis vectors."""
        del x, y
        return vectors.at[:, self.target].add(self.amplitude * vectors[:, self.origin])


class DetectorTerm(DetectorPart):
    """A gain that grows with the counts, light whatever falls in, or what the exposure before leaves behind."""

    amplitude: Scalar
    sentence: Sentence = eqx.field(static=True)
    cameras: Weights = eqx.field(static=True)

    def reported(self, counts: Float[Array, "e k"], exposures: ExposureArrays) -> Float[Array, "e k"]:
        """Counts with what is added."""
        if self.sentence.kind == "gain":
            added = counts**2 / REFERENCE_COUNTS
        elif self.sentence.kind == "light":
            added = exposures.median
        else:
            order = jnp.argsort(exposures.hours)
            added = jnp.zeros_like(counts).at[order[1:]].set(counts[order[:-1]])
        if self.sentence.factors not in ((), ("counts",)):
            added = added * _of_exposures(self.sentence, exposures)[:, None]
        return counts + self.amplitude * added * jnp.asarray(self.cameras)
