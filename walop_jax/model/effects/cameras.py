"""Changes of cameras and detectors: gains, light of elsewhere, what the exposure before leaves behind.

Equation    N_k → N_k + a f g_k, with g_k
            gain           N_k; growing with the counts: N_k² / 10⁶
            reported gain  N_k as the detector reports it, behind whatever else it does
            light          N_j of another camera; of no origin: the median counts of the exposure; of opposite: N_k at
                           (−X, −Y), extended sources only
            afterglow      N_k of the exposure before
Symbols     a amplitude, f product of the factors; the place is a camera, or an arm for both of its cameras
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from walop_jax.model.cameras import DetectorPart, ExposurePart, GhostPart, Mixing, Transmission
from walop_jax.model.effects.change import OPPOSITE, AtPoint, Change, Kind, Scalar, Term, in_exposures
from walop_jax.model.effects.factors import COUNTS
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import Component, unknown_name
from walop_jax.model.sources import ExposureArrays

Weights = tuple[float, ...]
REFERENCE_COUNTS = 1e6  # electron


class _Cameras(Component):
    """Changes, each of some of the cameras."""

    amplitudes: tuple[Scalar, ...]
    changes: tuple[Change, ...] = eqx.field(static=True)
    cameras: tuple[Weights, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, instrument: Instrument, terms: Sequence[Term]) -> _Cameras:
        """The changes of an instrument."""
        changes, amplitudes = (tuple(column) for column in zip(*terms, strict=True))
        return cls(amplitudes, changes, tuple(cameras_of(instrument, change.place) for change in changes))

    @property
    def sizes(self) -> Float[Array, "c k"]:
        """Amplitude of every change in every camera."""
        return jnp.stack(self.amplitudes)[:, None] * np.array(self.cameras)


class Shade(_Cameras, Transmission):
    """Gains that depend on the field alone."""

    def factors(self, x: Scalar, y: Scalar) -> Float[Array, " k"]:
        """1 + Σ amplitude × pattern."""
        patterns = jnp.stack([jnp.asarray(change.factor(AtPoint(x, y)), float) for change in self.changes])
        return 1.0 + patterns @ self.sizes


class GainOfExposures(_Cameras, ExposurePart):
    """Gains that depend on the exposure, or on exposure and field."""

    def factors(self, exposures: ExposureArrays, x: Scalar, y: Scalar) -> Float[Array, "e k"]:
        """1 + Σ amplitude × pattern."""
        patterns = jnp.stack([in_exposures(change, exposures, x, y) for change in self.changes])
        return 1.0 + patterns.T @ self.sizes


class CrossTalk(Mixing):
    """Shares of the light of cameras in other ones."""

    amplitudes: tuple[Scalar, ...]
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)  # (target, origin)

    def vectors(self, vectors: Float[Array, "b k 4"], x: Scalar, y: Scalar) -> Float[Array, "b k 4"]:
        """Mix the analysis vectors."""
        del x, y
        targets, origins = (np.array(column) for column in zip(*self.pairs, strict=True))
        shares = jnp.stack(self.amplitudes)[:, None]
        return vectors.at[:, targets].add(shares * vectors[:, origins])


class Ghost(GhostPart):
    """Shares of the light of the opposite field point, for extended sources."""

    shares: Float[Array, " k"]

    def seen(self, extended: Bool[Array, " e"], opposite: Float[Array, "e k"]) -> Float[Array, "e k"]:
        """Addition from the opposite point."""
        return jnp.where(extended[:, None], self.shares * opposite, 0.0)


class OfDetectors(_Cameras, DetectorPart):
    """Additions to counts as they arrive."""

    def added(self, counts: Float[Array, "e k"], exposures: ExposureArrays) -> Float[Array, "e k"]:
        """Addition by a change of amplitude 1 without factors."""
        raise NotImplementedError

    def reported(self, counts: Float[Array, "e k"], exposures: ExposureArrays) -> Float[Array, "e k"]:
        """Counts with what is added."""
        added, whole = self.added(counts, exposures), counts
        for change, size in zip(self.changes, self.sizes, strict=True):
            if any(one.depends_on != COUNTS for one in change.grows_with):
                whole = whole + size * added * in_exposures(change, exposures)[:, None]
            else:
                whole = whole + size * added
        return whole


class NonLinear(OfDetectors):
    """A gain that grows with the counts."""

    def added(self, counts: Float[Array, "e k"], exposures: ExposureArrays) -> Float[Array, "e k"]:
        """The counts squared."""
        del exposures
        return counts**2 / REFERENCE_COUNTS


class Scaled(OfDetectors):
    """A gain behind the detector."""

    def added(self, counts: Float[Array, "e k"], exposures: ExposureArrays) -> Float[Array, "e k"]:
        """The counts."""
        del exposures
        return counts


class Diffuse(OfDetectors):
    """Light whatever falls in."""

    def added(self, counts: Float[Array, "e k"], exposures: ExposureArrays) -> Float[Array, "e k"]:
        """The median counts of the exposure."""
        del counts
        return exposures.median


class Left(OfDetectors):
    """Remainder of the exposure before."""

    def added(self, counts: Float[Array, "e k"], exposures: ExposureArrays) -> Float[Array, "e k"]:
        """The counts of the exposure before."""
        order = jnp.argsort(exposures.hours)
        return jnp.zeros_like(counts).at[order[1:]].set(counts[order[:-1]])


class Gain(Kind):
    """A gain of a camera, or of both cameras of an arm."""

    names: ClassVar[tuple[str, ...]] = ("gain",)
    parameter: ClassVar[str] = "share"
    test: ClassVar[str] = "a lamp that does not change, seen by all cameras in turn"

    @classmethod
    def together(cls, change: Change) -> tuple[type[Kind], Hashable]:
        """Those that act at one stage."""
        return cls, cls.part(change)

    @staticmethod
    def part(change: Change) -> tuple[str, type[_Cameras]]:
        """The slot of `Instrument.with_part`, and what goes there."""
        if "counts" in change.factors:
            return "detectors", NonLinear
        return ("exposures", GainOfExposures) if change.exposure_factors else ("transmission", Shade)

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """Add to the cameras."""
        slot, part = cls.part(terms[0][0])
        return instrument.with_part(slot, part.of(instrument, terms))


class ReportedGain(Kind):
    """A gain of the counts as the detector reports them."""

    names: ClassVar[tuple[str, ...]] = ("reported gain",)
    parameter: ClassVar[str] = "share"
    test: ClassVar[str] = Gain.test

    @classmethod
    def together(cls, change: Change) -> tuple[type[Kind], Hashable]:
        """All of them."""
        return cls, None

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """Add to the detectors."""
        return instrument.with_part("detectors", Scaled.of(instrument, terms))


class Afterglow(Kind):
    """A share of the exposure before in a camera."""

    names: ClassVar[tuple[str, ...]] = ("afterglow",)
    parameter: ClassVar[str] = "share"
    test: ClassVar[str] = "a dark exposure after a bright one"

    @classmethod
    def together(cls, change: Change) -> tuple[type[Kind], Hashable]:
        """All of them."""
        return cls, None

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """Add to the detectors."""
        return instrument.with_part("detectors", Left.of(instrument, terms))


class Light(Kind):
    """Light in a camera that comes from elsewhere: scattered, of another camera, of the opposite field point."""

    names: ClassVar[tuple[str, ...]] = ("light",)
    parameter: ClassVar[str] = "share"
    test: ClassVar[str] = "the same field points at another flux, and darks"

    @classmethod
    def together(cls, change: Change) -> tuple[type[Kind], Hashable]:
        """Those that come from the same kind of place."""
        return cls, OPPOSITE if change.origin == OPPOSITE else bool(change.origin)

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """Add to the cameras."""
        if not terms[0][0].origin:
            return instrument.with_part("detectors", Diffuse.of(instrument, terms))
        if terms[0][0].origin == OPPOSITE:
            shares = [size * np.array(cameras_of(instrument, change.place)) for change, size in terms]
            return instrument.with_part("ghosts", Ghost(jnp.sum(jnp.stack(shares), axis=0)))
        pairs = tuple(
            (
                cameras_of(instrument, change.place).index(1.0),
                cameras_of(instrument, change.origin).index(1.0),
            )
            for change, _ in terms
        )
        return instrument.with_part("mixing", CrossTalk(tuple(size for _, size in terms), pairs))


def cameras_of(instrument: Instrument, place: str) -> Weights:
    """1 for the cameras that a place means: one of them, or those of an arm. Raises ValueError for any other name."""
    names = instrument.cameras.names
    for arm in instrument.arms:
        if arm.name == place:
            return tuple(float(name in arm.analyser.cameras) for name in names)
    if place not in names:
        raise unknown_name("camera or arm", place, (*names, *(arm.name for arm in instrument.arms)))
    return tuple(float(name == place) for name in names)
