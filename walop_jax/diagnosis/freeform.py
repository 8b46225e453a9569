"""Patterns without a name: what a disagreement could look like in any instrument of this kind.

Each stratum perturbs the counts of the cameras, N_k → N_k + F · pattern, and is one candidate of the score test:

vector          one element (q or u) of the analysis vector of one camera × field polynomials up to degree 4:
                anything linear in the light (a Mueller effect) that is smooth in the field
harmonic        1θ, 3θ, 4θ, 5θ, 6θ of the polariser angle in one camera × field polynomials up to degree 1: what no
                Mueller matrix behind the polariser can make
time, flux, temperature   gain of a camera linear in that quantity
kind, filter, plate       response of a camera that differs between kinds of exposure, filters, plate settings;
                for kinds also gradients over the field
exposure        gain of each camera in each single exposure, where it is seen at several field points
state           gain of each camera in each state, the same in all filters, where there are several: a state is all
                exposures that differ in nothing but the filter
fine structure  gain of a camera × field polynomials of degree 5 to 8
rings           gain of a camera × polynomials of the squared field radius, of degree 3 to 8 in it

The columns carry the unit "share of the unpolarised counts of the camera".
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.polynomial.legendre import legvander

from walop_jax.data.records import POLARISER, CalibrationSet, Exposures
from walop_jax.diagnosis.score import Candidate
from walop_jax.fit.robust import states
from walop_jax.likelihood import limits
from walop_jax.likelihood.flux import Sharing, project_flux
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model import legendre
from walop_jax.model.effects.free_form import FINE, HARMONICS, SMOOTH, WIDTH
from walop_jax.model.instrument import Instrument

RINGS = (3, 4, 5, 6, 7, 8)  # degrees; the throughput takes up what is smoother
SINGLE_EXPOSURES = "single exposures"
STATES = "states"

Cube = Float[np.ndarray, "p e k"]


def numpy_sharing(likelihood: Likelihood) -> Sharing:
    """What has a flux in common, in arrays of numpy."""
    groups = likelihood.plan.exposures.shared
    return Sharing(likelihood.model.template.cameras.together, None if groups is None else np.asarray(groups))


class Measured:
    """The measurements at a best fit, laid out for building columns of residual derivatives."""

    def __init__(self, likelihood: Likelihood, values: Float[np.ndarray, " n"]) -> None:
        self.likelihood, self.values = likelihood, values
        self.weight: Cube = likelihood.points.gathered("weight")
        self.counts: Cube = likelihood.points.gathered("counts")
        self.used: Bool[np.ndarray, "p e"] = likelihood.used
        self.flux, self.residual = likelihood.residuals(values)
        # Weighted model at unit flux, from data = flux · model + residual.
        flux = np.where(self.flux == 0, 1.0, self.flux)[..., None]
        self.model: Cube = (self.counts * self.weight - self.residual) / flux
        self.known, self.shared = likelihood.flux_known, numpy_sharing(likelihood)
        self.cameras = likelihood.cameras
        # Of the model, not of the counts: patterns that know the noise would find it in the residuals.
        unit = self.model / np.where(self.weight > 0, self.weight, 1.0)
        seen = np.maximum(self.used.sum(axis=1), 1)[:, None]
        self.level: Float[np.ndarray, "p k"] = np.where(self.used[..., None], unit, 0.0).sum(axis=1) / seen

    def column(self, pattern: Cube) -> Float[np.ndarray, " _"]:
        """Derivative of the residuals with respect to the amplitude of N_k → N_k + F · level_k · pattern."""
        change = self.flux[..., None] * pattern * self.level[:, None, :] * self.weight
        return -project_flux(change, self.model, self.known, self.shared)[self.used].reshape(-1)

    @property
    def has_gains(self) -> bool:
        """Whether exposures are seen at so many field points that gains of single ones are not all there is."""
        return bool(self.used.sum() >= limits.MANY_POINTS * self.used.any(axis=0).sum())

    @property
    def gained(self) -> list[int]:
        """Cameras that have a gain beside the flux."""
        return [k for k in range(self.cameras) if self.together[k, k + 1 :].any()]

    @property
    def together(self) -> Float[np.ndarray, "k k"]:
        """1 for two cameras with a flux in common."""
        shared = self.shared.cameras
        return np.ones((self.cameras,) * 2) if shared is None else np.asarray(shared)

    @cached_property
    def unit_model(self) -> Float[np.ndarray, "r k"]:
        """Weighted model of every used row, of unit length over the cameras with a flux in common; 0 if that is known.

        Where exposures have no flux in common, a row without the part along it is what elimination of the flux leaves.
        """
        power = self.shared.summed(self.model**2)
        unit = self.model / np.sqrt(np.where(power > 0, power, 1.0))
        return np.where(self.known[:, None], 0.0, unit)[self.used]

    def changes(self, strata: Sequence[Stratum]) -> Float[np.ndarray, "r a"]:
        """What every pattern does to its camera in every used row, in standard errors, the flux held."""
        size = (self.flux[..., None] * self.level[:, None, :] * self.weight)[self.used]
        points, exposures = np.nonzero(self.used)
        each = [(k, pattern) for one in strata for k, pattern in zip(one.camera, one.patterns, strict=True)]
        changes = np.empty((len(size), len(each)), order="F")
        for a, (k, pattern) in enumerate(each):
            there = np.broadcast_to(pattern, self.used.shape)[points, exposures]
            np.multiply(size[:, k], there, out=changes[:, a])
        return changes

    def candidate(self, stratum: Stratum) -> Candidate:
        """The columns of a stratum, intensity by intensity."""
        camera, one = np.asarray(stratum.camera), np.eye(self.cameras)
        if self.shared.exposures is None:
            changes, m = self.changes([stratum]), self.unit_model
            columns = np.empty((len(m), self.cameras, len(camera)))
            for c in range(self.cameras):
                left = one[c, camera] - self.together[c, camera] * m[:, c, None] * m[:, camera]
                np.multiply(-changes, left, out=columns[:, c])
            columns = columns.reshape(-1, len(camera))
        else:
            patterns = zip(camera, stratum.patterns, strict=True)
            columns = np.column_stack([self.column(pattern[..., None] * one[k]) for k, pattern in patterns])
        return Candidate(stratum.name, columns, stratum.widths, stratum.block)


class Stratum(NamedTuple):
    """Patterns of gains of single cameras, each of shape (points or 1, exposures or 1), and the camera of each.

    `block` is the block of the free-form term that can take it up.
    """

    name: str
    camera: Sequence[int]
    patterns: Sequence[Float[np.ndarray, "_ _"]]
    block: str | None = None

    @property
    def widths(self) -> Float[np.ndarray, " _"]:
        """Prior standard deviations of the amplitudes."""
        return np.full(len(self.camera), WIDTH)

    @classmethod
    def of_all(
        cls,
        cameras: Sequence[int],
        name: str,
        patterns: Sequence[Float[np.ndarray, "_ _"]],
        block: str | None = None,
    ) -> Stratum:
        """Each pattern in each of these cameras."""
        return cls(
            name, [k for _ in patterns for k in cameras], [p for p in patterns for _ in cameras], block
        )


def number_of_columns(calset: CalibrationSet, instrument: Instrument) -> int:
    """Number of columns of all strata together, or a few more."""
    e, cameras = calset.exposures, len(instrument.cameras)
    turning = 1 + len(instrument.patched().moving())
    of_camera = 2 * len(legendre.terms(SMOOTH)) + len(legendre.terms(FINE)) + len(RINGS)
    of_camera += 6 * len(HARMONICS) * turning + 3  # time, temperature, flux
    of_camera += 5 * (len(np.unique(e.kind)) - 1) + 3 * (len(np.unique(e.filter)) - 1)
    for prefix in instrument.patched().moving():
        of_camera += 3 * (len(np.unique(_positions(e, prefix))) - 1)
    gains = (len(e) + int(states(calset).max()) + 1) * (cameras - instrument.cameras.fluxes)
    return cameras * of_camera + gains


def _positions(e: Exposures, prefix: str) -> np.ndarray:
    position = e.position(prefix)
    return np.array([f"{a:g}" if i else "out" for i, a in zip(position.inside, position.angle, strict=True)])


def strata(measured: Measured) -> Iterator[Stratum]:
    """All strata that the exposures of the set allow."""
    e, points = measured.likelihood.calset.exposures, measured.likelihood.calset.points
    names = measured.likelihood.model.template.cameras.names
    every = range(len(names))
    # Calibration plates that are put in at one or two angles are compared as groups, below.
    further = [(f" {prefix}", prefix) for prefix in measured.likelihood.plan.moving if prefix in e.moving]
    turning = [("θ", POLARISER), *further]

    smooth = legendre.basis(points.x, points.y, SMOOTH)
    fine = legendre.basis(points.x, points.y, FINE)[:, smooth.shape[1] :]
    square = points.x**2 + points.y**2
    rings = legvander(2.0 * square / max(float(square.max()), 1e-300) - 1.0, RINGS[-1])[:, RINGS]
    stokes = measured.likelihood.stokes(measured.values)
    for k, camera in enumerate(names):
        for i, element in ((1, "q"), (2, "u")):
            patterns = [term[:, None] * stokes[..., i] for term in smooth.T]
            yield Stratum.of_all([k], f"vector {element} of {camera}", patterns, "vectors")
        for symbol, prefix in turning:
            position = e.position(prefix)
            through = position.inside & measured.used.any(axis=0)
            angle = np.deg2rad(np.where(through, position.angle, 0.0))
            for harmonic in HARMONICS:
                if len(np.unique(np.round(np.mod(position.angle[through], 360.0), 3))) < 2 * harmonic + 1:
                    continue
                waves = [np.where(through, wave(harmonic * angle), 0.0) for wave in (np.cos, np.sin)]
                patterns = [term[:, None] * wave for term in smooth.T[:3] for wave in waves]
                block = "harmonics" if prefix == POLARISER else "exposures"
                yield Stratum.of_all([k], f"{harmonic}{symbol} of {camera}", patterns, block)
        yield Stratum.of_all([k], f"fine structure of {camera}", [t[:, None] for t in fine.T], "fine")
        yield Stratum.of_all([k], f"rings of {camera}", [ring[:, None] for ring in rings.T], "fine")
    for name, quantity, block in (
        ("time", e.mjd[None, :], "exposures"),
        ("temperature", e.temp[None, :], "exposures"),
        ("flux", measured.flux, None),
    ):
        known = quantity[measured.used] if quantity.shape == measured.used.shape else quantity
        if not np.isfinite(known).any():
            continue
        quantity = quantity - np.nanmean(known)
        spread = np.nanstd(quantity)
        if np.isfinite(spread) and spread > 1e-9 * max(1.0, float(np.nanmax(np.abs(quantity)))):
            yield Stratum.of_all(every, name, [np.nan_to_num(quantity / spread)], block)
    positions = [(prefix.lower(), _positions(e, prefix)) for prefix in measured.likelihood.plan.moving]
    for name, label, block in (
        ("kind", e.kind, "exposures"),
        ("filter", e.filter, None),
        *((("plate" if prefix == "chwp" else prefix), label, None) for prefix, label in positions),
    ):
        patterns = [
            np.where(label == group, stokes[..., i], 0.0) for group in np.unique(label)[1:] for i in range(3)
        ]
        if patterns:
            yield Stratum.of_all(every, name, patterns, block)
    sky_gradients = [
        np.where(e.kind == group, term[:, None], 0.0)
        for group in np.unique(e.kind)[1:]
        for term in smooth.T[1:3]
    ]
    if sky_gradients:
        yield Stratum.of_all(every, "kind, over the field", sky_gradients)
    if measured.has_gains:
        alone = list(np.eye(len(e))[:, None])
        yield Stratum.of_all(measured.gained, SINGLE_EXPOSURES, alone, "exposures")
    state = states(measured.likelihood.calset)
    several = np.unique(state) if len(np.unique(state)) < len(state) else ()
    if len(several) and measured.gained:
        patterns = [np.where(state == number, 1.0, 0.0)[None] for number in several]
        yield Stratum.of_all(measured.gained, STATES, patterns)
