"""The likelihood of data whose errors have parameters (`model/noise.py`), their fluxes marginalised.

Equations   −2 ln L = Σ r² + Σ ln ρ + Σ_F ln (Σ a² / Σ ρ a²),     r = (N − F u)/σ,   ρ = σ²/N_ERR²,   a = u/σ
            of a parameter v of the errors, with α = ∂ ln σ/∂v and ê² = a²/Σ a² the part of the flux in a datum:
                half the gradient            −Σ r² α + Σ (1 − ê² − h) α
                half the expected Hessian     2 [Σ (1 − 2 ê²) β βᵀ + Σ_F (Σ ê² β) (Σ ê² β)ᵀ], β = α √(1 − h/(1 − ê²)),
                                              and for a fraction f the slope over f as well where that is positive:
                                              only f² enters
Symbols     N ± N_ERR a measured intensity, u the model for light of unit flux, F the flux, one for the intensities of a
            group (`flux.FluxGroups`); sums over F run over these groups; where F is known there is none, and ê = 0
            h  the part of a datum that the other parameters take up, x M⁻¹ xᵀ with x its row of the Jacobian in errors
               and M the matrix of all (0: they take up none)
Meaning     The third term is what a flat prior on F leaves when F is integrated out. Without it s would come out too
            small by √(3/4) for four cameras with one flux: each flux takes up one datum. The same is true of all other
            parameters together, which take up p of n data, some more than others: a fit, which has their best values,
            puts Σ (1 − h) ln ρ for the second term; a sampler, which draws them, h = 0.
Sources     restricted maximum likelihood: Patterson & Thompson 1971, Biometrika 58, 545; Harville 1977, JASA 72, 320
Limits      one scale s for all: s² = χ²/(n − n_F − p), the error of s is s/√(2 (n − n_F − p)).
            The expected Hessian has no terms between errors and other parameters: they are zero for symmetric noise.
            Of products of data with each other it has the sums that the projection on what is left fixes,
            Σ_b Q_ab² = Q_aa = 1 − ê² − h, each at its own α.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.likelihood.flux import ALONE, FluxGroups, namespace
from walop_jax.model.noise import ALL, Noise


class NoiseTerms(NamedTuple):
    """Which intensities each term of the errors concerns: 1 for those of its group, else 0."""

    scale: Float[Any, "s e k"]
    fraction: Float[Any, "f e k"]

    @classmethod
    def of(cls, noise: Noise, kinds: Sequence[str], cameras: Sequence[str]) -> NoiseTerms:
        """The groups of some terms for exposures with these KINDs and for these cameras."""
        kind, camera = np.array(kinds, dtype=str)[:, None], np.array(cameras, dtype=str)[None, :]

        def members(groups: Sequence[str]) -> np.ndarray:
            shape = (len(kind), camera.shape[1])
            inside = [np.broadcast_to((g == ALL) | (kind == g) | (camera == g), shape) for g in groups]
            return np.array(inside, float).reshape(-1, *shape)

        return cls(members(noise.scales), members(noise.fractions))


def factors(noise: Noise, terms: NoiseTerms) -> tuple[Float[Any, "e k"], Float[Any, "e k"]]:
    """s² and f² of every exposure and camera (e, k): σ² = s² N_ERR² + f² N². Numpy in, numpy out."""
    xp = namespace(noise.scale, noise.fraction)
    scale, fraction = xp.asarray(noise.scale), xp.asarray(noise.fraction)
    squared = xp.prod(xp.where(xp.asarray(terms.scale) > 0, (scale**2)[:, None, None], 1.0), axis=0)
    return squared, xp.einsum("f,fek->ek", fraction**2, xp.asarray(terms.fraction))


def variance_ratio(
    noise: Noise, terms: NoiseTerms, counts: Float[Any, "*p e k"], weight: Float[Any, "*p e k"]
) -> Float[Any, "*p e k"]:
    """ρ of intensities whose stated errors are 1/`weight`; 1 where the weight is 0 (unused). Numpy stays numpy."""
    xp = namespace(counts)
    squared, added = (xp.asarray(factor) for factor in factors(noise, terms))
    return xp.where(weight > 0, squared + added * (counts * weight) ** 2, 1.0)


def log_variance(
    ratio: Float[Any, "*p e k"],
    light: Float[Any, "*p e k"],
    flux_known: Bool[Any, " e"],
    shared: FluxGroups = ALONE,
) -> Float[Any, "*p e"]:
    """Σ ln ρ + Σ_F ln (Σ a² / Σ ρ a²) of every row (point, exposure); rows of one flux each have their part of it.

    `light` is a, of any common scale within a flux, 0 where unused.
    """
    xp = namespace(light)
    part, power = _parts(light, flux_known, shared)
    stated = xp.where(power > 0, shared.summed(ratio * light**2), 1.0)
    taken = xp.log(xp.where(power > 0, power, 1.0) / stated)
    return xp.sum(xp.log(ratio) + part * taken, axis=-1)


class NoiseExpansion(NamedTuple):
    """The terms of −2 ln L beside Σ r²: their value, half the gradient and half the expected Hessian of the errors.

    The gradient holds what Σ r² has of it as well. Terms are in the order of the parameters, scales first.
    """

    value: float
    gradient: Float[np.ndarray, " t"]
    matrix: Float[np.ndarray, "t t"]

    def joined(self, other: NoiseExpansion) -> NoiseExpansion:
        """The terms of two parts of a set."""
        return NoiseExpansion(
            self.value + other.value, self.gradient + other.gradient, self.matrix + other.matrix
        )


def noise_expansion(
    noise: Noise,
    terms: NoiseTerms,
    counts: Float[np.ndarray, "p e k"],
    weight: Float[np.ndarray, "p e k"],
    residual: Float[np.ndarray, "p e k"],
    flux_known: Bool[np.ndarray, " e"],
    shared: FluxGroups = ALONE,
    taken: Float[np.ndarray, "p e k"] | float = 0.0,
    light: Float[np.ndarray, "p e k"] | None = None,
) -> NoiseExpansion:
    """The expansion at residuals r = (N − F u)/σ; `weight` is 1/N_ERR, `taken` the h of the head of this file.

    `light` is F u/N_ERR, if it is not to be that of the residuals: a search that holds it has a gradient in the other
    parameters that is complete without the third term of −2 ln L.
    """
    ratio = variance_ratio(noise, terms, counts, weight)
    used = weight > 0
    if light is None:
        light = counts * weight - residual * np.sqrt(ratio)
    light = np.where(used, light / np.sqrt(ratio), 0.0)  # F u / σ
    part, _ = _parts(light, flux_known, shared)
    slopes = _slopes(noise, terms, counts * weight, ratio) * used
    gradient = np.sum((1.0 - part - taken - residual**2) * slopes, axis=(1, 2, 3))
    own = slopes * np.sqrt(np.clip(1.0 - taken / np.where(part < 1.0, 1.0 - part, 1.0), 0.0, None))
    mean = np.stack([shared.summed(part * slope) for slope in own]) if len(own) else own
    matrix = np.einsum("pek,spek,tpek->st", 1.0 - 2.0 * part, own, own, optimize=True)
    matrix += np.einsum("pek,spek,tpek->st", part, *2 * (np.broadcast_to(mean, own.shape),), optimize=True)
    matrix *= 2.0
    # Only f² enters: near f = 0 the slope is f times a number, which is the curvature that the expectation lacks.
    of_fraction = np.arange(len(slopes)) >= len(terms.scale)
    values = np.concatenate([np.asarray(noise.scale), np.asarray(noise.fraction)])
    bent = gradient / np.where(values != 0.0, values, 1.0)
    matrix += np.diag(np.where(of_fraction & (values != 0.0), np.maximum(bent, 0.0), 0.0))
    value = float(np.sum(log_variance(ratio, light, flux_known, shared)) - np.sum(taken * np.log(ratio)))
    return NoiseExpansion(value, gradient, matrix)


def _parts(
    light: Float[Any, "*p e k"], flux_known: Bool[Any, " e"], shared: FluxGroups
) -> tuple[Float[Any, "*p e k"], Float[Any, "*p e f"]]:
    """ê² of every intensity, and Σ a² of its flux; both 0 where the flux is known or nothing is used."""
    xp = namespace(light)
    power = xp.where(xp.asarray(flux_known)[:, None], 0.0, shared.summed(light**2))
    return xp.where(power > 0, light**2 / xp.where(power > 0, power, 1.0), 0.0), power


def _slopes(
    noise: Noise, terms: NoiseTerms, relative: Float[np.ndarray, "p e k"], ratio: Float[np.ndarray, "p e k"]
) -> Float[np.ndarray, "t p e k"]:
    """α = ∂ ln σ/∂v of every term; `relative` is N/N_ERR."""
    scale, fraction = np.asarray(noise.scale), np.asarray(noise.fraction)
    squared = np.asarray(factors(noise, terms)[0])
    of_scale = [member * squared / value / ratio for member, value in zip(terms.scale, scale, strict=True)]
    of_fraction = [
        member * value * relative**2 / ratio for member, value in zip(terms.fraction, fraction, strict=True)
    ]
    return np.array([*of_scale, *of_fraction]).reshape(-1, *ratio.shape)
