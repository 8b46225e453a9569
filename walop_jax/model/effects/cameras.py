"""Changes of cameras and detectors: gains, light from elsewhere, afterglow of the preceding exposure.

Equation    N_k → N_k + a f g_k, with g_k
            gain           N_k; growing with the counts to the power p: N_k (N_k / 10⁶)^p
            reported gain  N_k as reported, behind all other changes of the detector
            light          N_j of another camera; of no origin: the median counts of the exposure; of opposite: N_k at
                           (−X, −Y), extended sources only
                           A fraction of another camera that is the same in all exposures is part of the analysis
                           vectors, which stars see; one that differs between them acts where counts are reported
            afterglow      N_k of the preceding exposure
Symbols     a amplitude, f product of the factors; the place is a camera, or, but for light of another camera, an arm
            for both of its cameras
Limits      Light of another camera is counted in the flux of the camera that it goes into while it is the same in all
            exposures, and in the flux of the camera that it comes from otherwise. The two differ where arms have fluxes
            of their own (`Cameras.split`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from walop_jax.model.cameras import (
    DetectorPart,
    ExposurePart,
    FieldCoordinate,
    GhostPart,
    Mixing,
    Transmission,
)
from walop_jax.model.effects.change import (
    KINDS,
    OPPOSITE,
    SINGLE,
    SLOW,
    AtPoint,
    Change,
    ChangeKind,
    Combinations,
    Grows,
    Scalar,
    SlotTerm,
    Term,
    in_exposures,
    with_factors,
)
from walop_jax.model.effects.factors import COUNTS, EXPOSURE, FIELD, WAVELENGTH
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import Component, unknown_name
from walop_jax.model.sources import ExposureArrays

CameraWeights = tuple[float, ...]
REFERENCE_COUNTS = 1e6  # electron


class _Cameras(Component):
    """Changes, each of some of the cameras."""

    amplitudes: tuple[Scalar, ...]
    changes: tuple[Change, ...] = eqx.field(static=True)
    cameras: tuple[CameraWeights, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, instrument: Instrument, terms: Sequence[Term], **fixed: Any) -> _Cameras:
        """The changes `terms`, each with the weight of every camera of the instrument."""
        changes, amplitudes = (tuple(column) for column in zip(*terms, strict=True))
        return cls(amplitudes, changes, tuple(cameras_of(instrument, c.place) for c in changes), **fixed)

    @property
    def sizes(self) -> Float[Array, "c k"]:
        """Amplitude of every change in every camera."""
        return jnp.stack(self.amplitudes)[:, None] * np.array(self.cameras)


class Shade(_Cameras, Transmission):
    """Gains that depend on the field alone."""

    def factors(self, x: Scalar, y: Scalar) -> Float[Array, " k"]:
        """1 + Σ amplitude × pattern, the factor of each camera (k) at a field point."""
        patterns = jnp.stack([jnp.asarray(change.factor(AtPoint(x, y)), float) for change in self.changes])
        return 1.0 + patterns @ self.sizes


class GainOfExposures(_Cameras, ExposurePart):
    """Gains that depend on the exposure, or on exposure and field."""

    def factors(self, exposures: ExposureArrays, x: Scalar, y: Scalar) -> Float[Array, "e k"]:
        """1 + Σ amplitude × pattern, the factor of each camera in every exposure (e, k)."""
        patterns = jnp.stack([in_exposures(change, exposures, x, y) for change in self.changes])
        return 1.0 + patterns.T @ self.sizes


class CrossTalk(Mixing):
    """Fractions of the light of cameras in other ones, the same in all exposures."""

    amplitudes: tuple[Scalar, ...]
    changes: tuple[Change, ...] = eqx.field(static=True)
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)  # (target, origin)

    def vectors(self, vectors: Float[Array, "b k 4"], x: Scalar, y: Scalar) -> Float[Array, "b k 4"]:
        """The analysis vectors (b, k, 4) with the light of other cameras added."""
        targets, origins = (np.array(column) for column in zip(*self.pairs, strict=True))
        shares = with_factors(zip(self.changes, self.amplitudes, strict=True), AtPoint(x, y))
        sizes = jnp.stack([jnp.asarray(share, float) for _, share in shares])
        return vectors.at[:, targets].add(sizes[:, None] * vectors[:, origins])


class Ghost(GhostPart):
    """Fractions (k) of the light of the opposite field point that reach each camera, for extended sources."""

    shares: Float[Array, " k"]

    def seen(self, extended: Bool[Array, " e"], opposite: Float[Array, "e k"]) -> Float[Array, "e k"]:
        """Counts (e, k) that the light of the opposite point adds."""
        return jnp.where(extended[:, None], self.shares * opposite, 0.0)


def _before(counts: Float[Array, "e k"], exposures: ExposureArrays) -> Float[Array, "e k"]:
    """Counts of the preceding exposure."""
    order = jnp.argsort(exposures.hours)
    return jnp.zeros_like(counts).at[order[1:]].set(counts[order[:-1]])


def _root(counts: Float[Array, "e k"], _: ExposureArrays) -> Float[Array, "e k"]:
    """N √(N/N₀), which is proportional to N below one electron: its derivatives are finite at 0."""
    return counts * jnp.sqrt(jnp.maximum(counts, 1.0) / REFERENCE_COUNTS)


ADDED: Mapping[str, Callable[[Float[Array, "e k"], ExposureArrays], Float[Array, "e k"]]] = {
    "root": _root,
    "square": lambda counts, _: counts**2 / REFERENCE_COUNTS,
    "cube": lambda counts, _: counts**3 / REFERENCE_COUNTS**2,
    "reported": lambda counts, _: counts,
    "median": lambda _, exposures: exposures.median,
    "afterglow": _before,
}
"""Additions to arriving counts by a change of amplitude 1 without further factors, by stage."""
POWERS = {"root counts": "root", "counts": "square", "counts squared": "cube"}
"""Stages of gains that grow with a power of their counts, by factor."""


class OfDetectors(_Cameras, DetectorPart):
    """Additions to arriving counts, of one stage of `ADDED`; `origins` are the cameras whose counts are added, None
    where those of a camera are added to itself.
    """

    stage: str = eqx.field(static=True, default="reported")
    origins: tuple[int | None, ...] = eqx.field(static=True, kw_only=True)

    def reported(
        self, counts: Float[Array, "e k"], exposures: ExposureArrays, x: FieldCoordinate, y: FieldCoordinate
    ) -> Float[Array, "e k"]:
        """The counts (e, k) with the additions of this stage."""
        added, total = ADDED[self.stage](counts, exposures), counts
        for change, origin, size in zip(self.changes, self.origins, self.sizes, strict=True):
            differs = _differs_between_exposures(change)
            pattern = in_exposures(change, exposures, x, y) if differs else change.factor(AtPoint(x, y))
            light = added if origin is None else added[:, origin, None]
            total = total + size * light * jnp.asarray(pattern, float)[..., None]
        return total


def _differs_between_exposures(change: Change) -> bool:
    return any(factor.depends_on == EXPOSURE for factor in change.grows_with)


def stage_of(change: Change) -> str:
    """The stage at which a change acts: a key of `ADDED`, "throughput", "counts", "mixed" or "opposite"."""
    if change.kind == "light":
        of_camera = "reported" if _differs_between_exposures(change) else "mixed"
        return {"": "median", OPPOSITE: "opposite"}.get(change.origin, of_camera)
    if change.kind != "gain":
        return {"reported gain": "reported", "afterglow": "afterglow"}[change.kind]
    if powers := [factor.text for factor in change.grows_with if factor.depends_on == COUNTS]:
        if len(powers) > 1:
            raise ValueError(f"{change.text!r}: a gain grows with one of {', '.join(POWERS)}")
        return POWERS[powers[0]]
    still = all(factor.depends_on in (FIELD, WAVELENGTH) for factor in change.grows_with)
    return "throughput" if still else "counts"


def _patch(instrument: Instrument, terms: Sequence[Term]) -> Instrument:
    """The instrument with changes that act at one stage."""
    stage = stage_of(terms[0][0])
    origins = tuple(_origin(instrument, change) for change, _ in terms)
    if stage in ADDED:
        detectors = OfDetectors.of(instrument, terms, stage=stage, origins=origins)
        return instrument.with_part("detectors", detectors)
    if stage == "throughput":
        return instrument.with_part("transmission", Shade.of(instrument, terms))
    if stage == "counts":
        return instrument.with_part("exposures", GainOfExposures.of(instrument, terms))
    if stage == "opposite":
        shares = [size * np.array(cameras_of(instrument, change.place)) for change, size in terms]
        return instrument.with_part("ghosts", Ghost(jnp.sum(jnp.stack(shares), axis=0)))
    changes, amplitudes = (tuple(column) for column in zip(*terms, strict=True))
    targets = [cameras_of(instrument, change.place).index(1.0) for change in changes]
    pairs = tuple((k, origin) for k, origin in zip(targets, origins, strict=True) if origin is not None)
    return instrument.with_part("mixing", CrossTalk(amplitudes, changes, pairs))


def _origin(instrument: Instrument, change: Change) -> int | None:
    """Number of the camera whose light a change adds; None for light of no single camera.

    Raises ValueError where its light comes from several cameras, or from and to the same, or goes into several.
    """
    if change.origin in ("", OPPOSITE):
        return None
    weights, targets = (cameras_of(instrument, name) for name in (change.origin, change.place))
    if sum(weights) != 1.0 or sum(targets) != 1.0 or weights == targets:
        raise ValueError(f"{change.text!r}: give one camera and another one, as in 'light of E1 in O1'")
    return weights.index(1.0)


def _together(change: Change) -> tuple[str, bool]:
    """Changes that act at one stage are patched together, those that are the same in all exposures by themselves.

    Catalogues are corrected for these alone (`model.dependence`).
    """
    return stage_of(change), _differs_between_exposures(change)


_WITH: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(POWERS.values(), (COUNTS, FIELD, EXPOSURE)),
    **dict.fromkeys(("reported", "median", "afterglow", "mixed"), (FIELD, EXPOSURE)),
    "throughput": (FIELD,),
    "counts": (FIELD, EXPOSURE),
}


_CAMERA = (
    Combinations(along=tuple(POWERS), among=("alone", "arm", "all")),
    Combinations(("smooth",), tuple(POWERS), ("alone", "arm")),
    Combinations(along=("harmonics to 6", *SLOW, *SINGLE, "side", "night", "step", "exposure", "kind")),
    Combinations(
        along=(*SLOW, *SINGLE, "side", "night", "step", "kind"), among=("arm",)
    ),  # a contrast of two
    Combinations(("tilt",), ("harmonics to 1",), ("alone", "all")),  # an image that moves in a circle
    Combinations(("tilt", "focus"), SLOW),
    Combinations(("tilt",), (*SINGLE, "kind", "side"), ("alone", "arm")),
    Combinations(("smooth",), (*SLOW, *SINGLE, "kind", "side"), ("alone", "arm")),
    Combinations(("any",), among=("alone", "arm")),  # finer than the throughput of the model
)
_NONLINEAR = (Combinations(("even", "any"), (*SLOW, *SINGLE, "kind"), ("alone", "arm")),)
_ARM = (
    Combinations(along=(*SLOW, *SINGLE, "side", "night", "step", "kind")),
    Combinations(("rings",)),
    Combinations(("tilt",), (*SLOW, *SINGLE, "kind")),
)
_LIGHT = (
    Combinations(("even", "any"), ("steady", *SLOW, *SINGLE, "kind")),
    Combinations(among=("all",)),
)


def _grows(instrument: Instrument, change: Change) -> Grows:
    stage, tried = stage_of(change), (Combinations(among=("alone", "all")),)
    if change.kind == "afterglow":
        tried = (*tried, Combinations(("any",)))
    elif change.kind == "gain" and stage in POWERS.values():
        tried = _NONLINEAR
    elif change.kind == "gain":
        tried = _CAMERA if change.place in instrument.cameras.names else _ARM
    elif change.kind == "light" and change.origin != OPPOSITE:
        tried = _LIGHT
    return Grows(_WITH.get(stage, ()), None, tried)


def _slots(instrument: Instrument, change: Change) -> list[SlotTerm]:
    """A stage and the cameras, and the camera whose light it is; for analysis vectors a slot for each camera, or target
    and origin.
    """
    stage, cameras = stage_of(change), cameras_of(instrument, change.place)
    origin = _origin(instrument, change)
    slots: list[tuple[Any, ...]] = [(stage, cameras) if origin is None else (stage, cameras, origin)]
    if stage == "mixed":
        slots = [(stage, cameras.index(1.0), origin)]
    elif stage == "throughput":
        slots = [(stage, camera) for camera, share in enumerate(cameras) if share]
    return [SlotTerm(slot, 1.0, change.factors) for slot in slots]


_OF_GAINS = "a lamp that does not change, seen by all cameras in turn"
_TESTS = {
    "gain": _OF_GAINS,
    "reported gain": _OF_GAINS,
    "afterglow": "a dark exposure after a bright one",
    "light": "the same field points at another flux, and darks",
}
KINDS |= {
    name: ChangeKind("share", _patch, _together, test, _grows, slots=_slots) for name, test in _TESTS.items()
}


def cameras_of(instrument: Instrument, place: str) -> CameraWeights:
    """Weights of the cameras: 1 for the cameras of `place`, a camera or an arm, else 0.

    Raises ValueError for any other name.
    """
    names = instrument.cameras.names
    for arm in instrument.arms:
        if arm.name == place:
            return tuple(float(name in arm.analyser.cameras) for name in names)
    if place not in names:
        raise unknown_name("camera or arm", place, (*names, *(arm.name for arm in instrument.arms)))
    return tuple(float(name == place) for name in names)
