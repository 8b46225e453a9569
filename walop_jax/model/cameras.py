"""The cameras: throughput over the field, cross-talk, ghosts, and the response of the detectors to electrons.

Everything here but the throughput is empty in the base model; an effect or a description adds parts. A part acts at one
stage, that of its class:

    Transmission    factors of the throughput at a field point
    Mixing          analysis vectors behind the throughput: part of the instrument, linear in the light
    GhostPart       light of the opposite field point
    ExposurePart    linear in the flux, but specific to each exposure
    DetectorPart    acts on electrons: may be not linear in the light, or mix cameras in single exposures

`dependence.left_behind` lists the effects that do not carry over to other exposures.
"""

from __future__ import annotations

import abc
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from walop_jax.model import legendre
from walop_jax.model.conventions import FIELD_SCALE
from walop_jax.model.parameters import Component, Parameter
from walop_jax.model.sources import ExposureArrays, Scalar

FieldCoordinate = Scalar | Float[Array, " e"]
"""Field coordinate (deg) of all exposures, or of each."""


class Throughput(Component):
    """Throughput of each camera as a Legendre series over the field (total degree `degree`)."""

    degree: int = eqx.field(static=True)
    coefficients: Float[Array, "k t"]
    declared: Parameter = eqx.field(static=True)
    scale: float = eqx.field(static=True, default=FIELD_SCALE)  # h, degrees

    def declarations(self) -> Mapping[str, Parameter]:
        """The series, a parameter of every instrument."""
        return {"coefficients": self.declared}

    def labels(self, field: str) -> Sequence[str]:
        """Camera and degrees in X and Y: n0.p21 is the term of camera N0 of second degree in X and first in Y."""
        terms = legendre.terms(self.degree)
        return tuple(f"n{k}.p{i}{j}" for k in range(self.coefficients.shape[0]) for i, j in terms)

    def basis(self, x: Float[Any, ...], y: Float[Any, ...]) -> Float[Any, "... t"]:
        """Values of the terms of the series at field positions in degrees; arrays of numpy stay so."""
        return legendre.basis(x, y, self.degree, self.scale)

    def at(self, x: Scalar, y: Scalar) -> Float[Array, " k"]:
        """Throughput (k) of the cameras at a field point (deg)."""
        return self.coefficients @ self.basis(x, y)


class Transmission(Component):
    """A factor of the throughput, such as the shadow of a grain of dust."""

    @abc.abstractmethod
    def factors(self, x: Scalar, y: Scalar) -> Float[Array, " k"] | Scalar:
        """Factors of the cameras at a field point (deg)."""


class Mixing(Component):
    """A change of the analysis vectors behind the throughput, such as light of one camera in another."""

    @abc.abstractmethod
    def vectors(self, vectors: Float[Array, "b k 4"], x: Scalar, y: Scalar) -> Float[Array, "b k 4"]:
        """The analysis vectors (band, camera, Stokes) with this change."""


class GhostPart(Component):
    """Light of the opposite field point, reflected into the image."""

    @abc.abstractmethod
    def seen(self, extended: Bool[Array, " e"], opposite: Float[Array, "e k"]) -> Float[Array, "e k"]:
        """Counts (e, k) to add; `opposite` are those of the same source at (−X, −Y), `extended` is true for light all
        over the field.
        """


class ExposurePart(Component):
    """Factors of the counts of single exposures, or a fraction of the response to unpolarised light that is added to
    them.
    """

    @property
    def exposures_known(self) -> int | None:
        """Number of exposures with values; None: any number."""
        return None

    def factors(self, exposures: ExposureArrays, x: Scalar, y: Scalar) -> Float[Array, "e k"] | float:
        """Factors (e, k) of the counts."""
        return 1.0

    def share(self, exposures: ExposureArrays, x: Scalar, y: Scalar) -> Float[Array, "e k"] | float:
        """Fractions (e, k) of the response to unpolarised light that are added."""
        return 0.0


class DetectorPart(Component):
    """The response of the detectors to electrons, such as a gain that depends on the counts."""

    @abc.abstractmethod
    def reported(
        self, counts: Float[Array, "e k"], exposures: ExposureArrays, x: FieldCoordinate, y: FieldCoordinate
    ) -> Float[Array, "e k"]:
        """Reported counts for arriving counts (electrons) at a field point (deg), or at one for each row (e)."""


class Cameras(Component):
    """Names of the cameras, the cameras of each arm (`arms`, by number), and their parts beyond the throughput.

    `split`: the fractions of the light that go into the arms are unknown and not smooth over the field, so that every
    arm has a flux of its own (`likelihood.flux`). `noise_floor`: no standard error is smaller than this fraction of the
    mean counts of a row over the cameras (0.002 of WALOP-NORTH).
    """

    names: tuple[str, ...] = eqx.field(static=True)
    transmission: tuple[Transmission, ...] = ()
    mixing: tuple[Mixing, ...] = ()
    ghosts: tuple[GhostPart, ...] = ()
    exposures: tuple[ExposurePart, ...] = ()
    detectors: tuple[DetectorPart, ...] = ()
    arms: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())
    split: bool = eqx.field(static=True, default=False)
    noise_floor: float = eqx.field(static=True, default=0.0)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def fluxes(self) -> int:
        """Number of unknown fluxes of a row: one, or one for each arm that is `split`."""
        return len(self.arms) if self.split else 1

    @property
    def ratio_references(self) -> tuple[int, ...]:
        """Reference cameras where only ratios of counts can be measured: the first of each `split` arm, or of a single
        pair.
        """
        alone = len(self.arms) == 1 and len(self.names) == 2
        return tuple(arm[0] for arm in self.arms) if self.split or alone else ()

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Cameras of the arms that have two: each such arm has a row of the instrument matrix."""
        return tuple((arm[0], arm[1]) for arm in self.arms if len(arm) > 1)

    @property
    def together(self) -> Float[np.ndarray, "k k"] | None:
        """Matrix (k, k) that is 1 for two cameras with a common flux; None if all cameras have one flux."""
        if not self.split:
            return None
        arm = np.zeros(len(self.names), int)
        for number, members in enumerate(self.arms):
            arm[list(members)] = number
        return (arm[:, None] == arm).astype(float)

    @property
    def orthogonal(self) -> tuple[int, ...]:
        """For each camera the number of the camera in the other beam of its analyser; its own number without one."""
        partners = list(range(len(self)))
        for a, b in self.pairs:
            partners[a], partners[b] = b, a
        return tuple(partners)


ALL_ORDERS = 4  # cameras up to which all orders are tried, beyond pairs alone


def other_orders(count: int) -> list[tuple[int, ...]]:
    """Orders in which `count` cameras may have been written by mistake; camera k is found at `order[k]`.

    Of up to four cameras these are all other orders, of more cameras those with two exchanged.
    """
    if count <= ALL_ORDERS:
        return list(itertools.permutations(range(count)))[1:]
    pairs = itertools.combinations(range(count), 2)
    return [tuple(b if k == a else a if k == b else k for k in range(count)) for a, b in pairs]


def with_noise_floor(
    sigma: Float[np.ndarray, "p a b"],
    counts: Float[np.ndarray, "p a b"],
    floor: float | Float[np.ndarray, "*c"],
    cameras: int = 2,
) -> Float[np.ndarray, "p a b"]:
    """Standard errors of counts, none smaller than `floor` × the mean counts over the axis `cameras`."""
    return sigma if not np.any(floor) else np.maximum(sigma, floor * counts.mean(axis=cameras, keepdims=True))
