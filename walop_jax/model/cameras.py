"""The cameras: throughput over the field, cross-talk, ghosts, and the response of the detectors to electrons.

Everything here but the throughput is empty in the base model; an effect or a description adds parts. A part acts at one
stage, that of its class:

    Transmission    factors of the throughput at a field point
    Mixing          analysis vectors behind the throughput: part of the instrument, linear in the light
    GhostPart       light of the opposite field point
    ExposurePart    linear in the flux, but specific to each exposure
    DetectorPart    acts on electrons; not linear in the light

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

Places = Scalar | Float[Array, " e"]
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
        """Camera and exponents: n0.p21 is camera N0, second degree in X, first in Y."""
        terms = legendre.terms(self.degree)
        return tuple(f"n{k}.p{i}{j}" for k in range(self.coefficients.shape[0]) for i, j in terms)

    def basis(self, x: Float[Any, ...], y: Float[Any, ...]) -> Float[Any, "... t"]:
        """Values of the terms of the series at field positions in degrees; arrays of numpy stay so."""
        return legendre.basis(x, y, self.degree, self.scale)

    def at(self, x: Scalar, y: Scalar) -> Float[Array, " k"]:
        """Throughput of the cameras at a field point."""
        return self.coefficients @ self.basis(x, y)


class Transmission(Component):
    """A factor of the throughput."""

    @abc.abstractmethod
    def factors(self, x: Scalar, y: Scalar) -> Float[Array, " k"] | Scalar:
        """Factors of the cameras at a field point (deg)."""


class Mixing(Component):
    """A change of the analysis vectors behind the throughput."""

    @abc.abstractmethod
    def vectors(self, vectors: Float[Array, "b k 4"], x: Scalar, y: Scalar) -> Float[Array, "b k 4"]:
        """Analysis vectors (band, camera, Stokes) from those ahead of it."""


class GhostPart(Component):
    """Light of the opposite field point."""

    @abc.abstractmethod
    def seen(self, extended: Bool[Array, " e"], opposite: Float[Array, "e k"]) -> Float[Array, "e k"]:
        """Addition to the counts; `opposite` are those of the same source at (−X, −Y)."""


class ExposurePart(Component):
    """Factors of the counts, or a share of the response to unpolarised light that is added, in some exposures."""

    @property
    def exposures_known(self) -> int | None:
        """Number of exposures with values; None: any number."""
        return None

    def factors(self, exposures: ExposureArrays, x: Scalar, y: Scalar) -> Float[Array, "e k"] | float:
        """Factors of the counts, exposure by exposure."""
        return 1.0

    def share(self, exposures: ExposureArrays, x: Scalar, y: Scalar) -> Float[Array, "e k"] | float:
        """The share, exposure by exposure."""
        return 0.0


class DetectorPart(Component):
    """Response of a detector to electrons."""

    @abc.abstractmethod
    def reported(
        self, counts: Float[Array, "e k"], exposures: ExposureArrays, x: Places, y: Places
    ) -> Float[Array, "e k"]:
        """Reported counts for arriving counts (electrons) at a field point (deg), or at one for each row (e)."""


class Cameras(Component):
    """Names of the cameras, those of each arm (`arms`), and their parts beyond the throughput.

    `split`: the shares of the light in the arms are unknown and not smooth over the field, so that every arm has a flux
    of its own (`likelihood.flux`). `floor`: no error is smaller than this share of the mean counts of a row.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    transmission: tuple[Transmission, ...] = ()
    mixing: tuple[Mixing, ...] = ()
    ghosts: tuple[GhostPart, ...] = ()
    exposures: tuple[ExposurePart, ...] = ()
    detectors: tuple[DetectorPart, ...] = ()
    arms: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())
    split: bool = eqx.field(static=True, default=False)
    floor: float = eqx.field(static=True, default=0.0)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def fluxes(self) -> int:
        """Number of unknown fluxes of a row."""
        return len(self.arms) if self.split else 1

    @property
    def ratio_references(self) -> tuple[int, ...]:
        """Reference cameras where only ratios can be measured: of `split` arms, of a single pair."""
        alone = len(self.arms) == 1 and len(self.names) == 2
        return tuple(arm[0] for arm in self.arms) if self.split or alone else ()

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Cameras of the arms that have two: each such arm has a row of the instrument matrix."""
        return tuple((arm[0], arm[1]) for arm in self.arms if len(arm) > 1)

    @property
    def together(self) -> Float[np.ndarray, "k k"] | None:
        """1 for two cameras with a common flux; None: one flux for all."""
        if not self.split:
            return None
        arm = np.zeros(len(self.names), int)
        for number, members in enumerate(self.arms):
            arm[list(members)] = number
        return (arm[:, None] == arm).astype(float)

    @property
    def orthogonal(self) -> tuple[int, ...]:
        """For each camera the one in the other beam of its analyser."""
        partners = list(range(len(self)))
        for a, b in self.pairs:
            partners[a], partners[b] = b, a
        return tuple(partners)


ALL_ORDERS = 4  # cameras up to which all orders are tried, beyond pairs alone


def other_orders(count: int) -> list[tuple[int, ...]]:
    """Orders in which so many cameras may have been written by mistake: all others, or of many cameras those with two
    exchanged. Camera k is found at `order[k]`."""
    if count <= ALL_ORDERS:
        return list(itertools.permutations(range(count)))[1:]
    pairs = itertools.combinations(range(count), 2)
    return [tuple(b if k == a else a if k == b else k for k in range(count)) for a, b in pairs]


def with_floor(
    sigma: Float[np.ndarray, "p a b"],
    counts: Float[np.ndarray, "p a b"],
    floor: float | Float[np.ndarray, "*c"],
    cameras: int = 2,
) -> Float[np.ndarray, "p a b"]:
    """Standard errors of counts, none smaller than `Cameras.floor` allows; `cameras` is the axis of these."""
    return sigma if not np.any(floor) else np.maximum(sigma, floor * counts.mean(axis=cameras, keepdims=True))
