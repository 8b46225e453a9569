"""Patterns without a name, for residuals beyond all effects of the catalogue.

Not a name, never a candidate: `diagnose` adds it, labelled, so that a calibration improves without a known cause.
Blocks that were not requested have no elements.

Equation    vectors     a_k → a_k + a_k0 · Σ_t v_kst P_t(x, y) e_s, s = q, u: any linear effect smooth in the field
            harmonics   N_k → N_k + N⁰_k · Σ_ht (c_kht cos hθ + s_kht sin hθ) P_t(x, y), θ polariser angle
            fine        N_k → N_k + N⁰_k · Σ_t f_kt P_t(x, y), P_t of higher degree than the throughput: light
            fine_gains  N_k → N_k · (1 + Σ_t f_kt P_t(x, y)), the same P_t: gains of the cameras
            exposures   N_k → N_k + N⁰_k · g_ek: light in single exposures
            exposure_gains  N_k → N_k · (1 + g_ek): gains of the cameras in single exposures
Symbols     a_k analysis vector of camera k, a_k0 its response to unpolarised light; N_k counts and N⁰_k those of
            unpolarised light of the same flux; P_t products of Legendre polynomials, in the scale
            of the field of the instrument
Source      the strata of the free-form score test (`diagnosis.design`), with the same plausible size
Neutral     all zero
Revealed by any data that no model explains
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model import legendre
from walop_jax.model.cameras import ExposurePart, Mixing
from walop_jax.model.effects.base import Context, Effect, Scalar
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import param, unknown_name
from walop_jax.model.sources import ExposureArrays

WIDTH = 0.003  # plausible size, in units of the response to unpolarised light
SMOOTH, FINE, GRADIENT = 4, 8, 1  # degrees of the field polynomials
HARMONICS = (1, 3, 4, 5, 6)
BLOCKS = ("vectors", "harmonics", "fine", "fine_gains", "exposures", "exposure_gains")
_SMOOTH_TERMS = legendre.terms(SMOOTH)
_GRADIENT_TERMS = legendre.terms(GRADIENT)
_FINE_TERMS = legendre.terms(FINE)[len(_SMOOTH_TERMS) :]


def _pattern(about: str) -> Any:
    return param(unit="", about=about, source="free-form term, no physics behind it", width=WIDTH)


def _tags(terms: Sequence[tuple[int, int]]) -> list[str]:
    return [f"p{i}{j}" for i, j in terms]


def _cameras(count: int) -> list[str]:
    return [f"n{k}" for k in range(count)]


def _fine(coefficients: Float[Array, "k f"], x: Scalar, y: Scalar, scale: float) -> Float[Array, " k"]:
    return coefficients @ legendre.basis(x, y, FINE, scale)[len(_SMOOTH_TERMS) :]


class Pattern(Mixing):
    """Fine gains, smooth changes of q and u elements, fine changes of the response to unpolarised light."""

    smooth: Float[Array, "k 2 s"]
    fine: Float[Array, "c f"]
    gains: Float[Array, "g f"]  # any of the three may be empty
    scale: float = eqx.field(static=True)  # of the field, degrees

    def vectors(self, vectors: Float[Array, "b k 4"], x: Scalar, y: Scalar) -> Float[Array, "b k 4"]:
        """Multiply by the gains, and add the patterns relative to the response to unpolarised light."""
        if self.gains.size:
            vectors = vectors * (1.0 + _fine(self.gains, x, y, self.scale))[:, None]
        plain = vectors[:, :, 0]
        if self.smooth.size:
            change = self.smooth @ legendre.basis(x, y, SMOOTH, self.scale)
            vectors = vectors.at[:, :, 1:3].add(plain[..., None] * change)
        if self.fine.size:
            vectors = vectors.at[:, :, 0].add(plain * _fine(self.fine, x, y, self.scale))
        return vectors


class FreeShares(ExposurePart):
    """Harmonics of the polariser angle and single exposures."""

    harmonics: Float[Array, "c h 2 g"]
    exposures: Float[Array, "e k"]
    gains: Float[Array, "f k"]  # of single exposures; any of the three may be empty
    fine: Float[Array, "d t"]  # structure beyond the response of the throughput; may be empty
    scale: float = eqx.field(static=True)  # of the field, degrees

    @property
    def exposures_known(self) -> int | None:
        """Number of exposures of the blocks of single exposures."""
        return len(self.exposures) or len(self.gains) or None

    def factors(self, exposures: ExposureArrays, x: Scalar, y: Scalar) -> Float[Array, "e k"] | float:
        """Gains of the cameras in single exposures."""
        return 1.0 + self.gains if self.gains.size else 1.0

    def share(self, exposures: ExposureArrays, x: Scalar, y: Scalar) -> Float[Array, "e k"] | float:
        """Light (e, k) to add, in units of the response to unpolarised light."""
        if not (self.harmonics.size or self.exposures.size):
            return 0.0
        total = jnp.zeros(())
        if self.harmonics.size:
            angle = exposures.clp_angle[:, None] * jnp.asarray(HARMONICS)
            waves = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
            size = self.harmonics @ legendre.basis(x, y, GRADIENT, self.scale)
            total += jnp.where(exposures.clp_in[:, None], jnp.einsum("ehw,khw->ek", waves, size), 0.0)
        if self.exposures.size:
            total += self.exposures
        return total / (1.0 + _fine(self.fine, x, y, self.scale)) if self.fine.size else total


class FreeForm(Effect):
    """Smooth patterns of the analysis vectors, harmonics of the polariser, fine structure, single exposures."""

    vectors: Float[Array, "k 2 s"] = _pattern("change of an analysis vector, relative to its first element")
    harmonics: Float[Array, "k h 2 g"] = _pattern("harmonic of the polariser angle, cos and sin")
    fine: Float[Array, "k f"] = _pattern("fine structure of added light over the field")
    fine_gains: Float[Array, "k f"] = _pattern("fine structure of the gain over the field")
    exposures: Float[Array, "e k"] = _pattern("light on one camera in one exposure")
    exposure_gains: Float[Array, "e k"] = _pattern("gain of one camera in one exposure")
    blocks: tuple[str, ...] = eqx.field(static=True, default=(), converter=tuple)

    name: ClassVar[str] = "free_form"
    starts = ()  # a pattern is found by its own score test
    revealed_by: ClassVar[str] = "any data that no model explains"
    separated_by: ClassVar[str] = "a physical effect that explains the same pattern with fewer numbers"

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """The effect with all blocks, all coefficients 0."""
        return cls.of(context, blocks=BLOCKS)

    @classmethod
    def of(cls, context: Context, **values: Any) -> Self:
        """The effect with the requested `blocks`, all coefficients 0. Raises ValueError for an unknown block."""
        blocks = tuple(values.pop("blocks", BLOCKS))
        for name in [*blocks, *values]:
            if name not in BLOCKS:
                raise unknown_name("block of free_form", name, BLOCKS)
        shapes = {
            "vectors": (len(context.cameras), 2, len(_SMOOTH_TERMS)),
            "harmonics": (len(context.cameras), len(HARMONICS), 2, len(_GRADIENT_TERMS)),
            "fine": (len(context.cameras), len(_FINE_TERMS)),
            "fine_gains": (len(context.cameras), len(_FINE_TERMS)),
            "exposures": (context.exposures, len(context.cameras)),
            "exposure_gains": (context.exposures, len(context.cameras)),
        }
        zeros = {
            name: jnp.zeros(shape if name in blocks else (0, *shape[1:])) for name, shape in shapes.items()
        }
        return dataclasses.replace(cls(**zeros, blocks=blocks), **values)

    def labels(self, field: str) -> Sequence[str]:
        """Names such as "vectors.n0.q.p12"; "harmonics.n3.4theta.sin.p10"; "exposures.7.n1" counts positions."""
        shape = getattr(self, field).shape
        waves = [f"{h}theta.{wave}" for h in HARMONICS for wave in ("cos", "sin")]
        parts: Sequence[Sequence[str]] = {
            "vectors": (_cameras(shape[0]), "qu", _tags(_SMOOTH_TERMS)),
            "harmonics": (_cameras(shape[0]), waves, _tags(_GRADIENT_TERMS)),
            "fine": (_cameras(shape[0]), _tags(_FINE_TERMS)),
            "fine_gains": (_cameras(shape[0]), _tags(_FINE_TERMS)),
            "exposures": ([str(i) for i in range(shape[0])], _cameras(shape[1])),
            "exposure_gains": ([str(i) for i in range(shape[0])], _cameras(shape[1])),
        }[field]
        return [".".join((field, *label)) for label in itertools.product(*parts)]

    def patch(self, instrument: Instrument) -> Instrument:
        """Add the blocks: smooth and fine patterns to the cameras, harmonics and single exposures to the exposures."""
        scale = instrument.units.field
        if self.vectors.size or self.fine.size or self.fine_gains.size:
            pattern = Pattern(self.vectors, self.fine, self.fine_gains, scale)
            instrument = instrument.with_part("mixing", pattern)
        if self.harmonics.size or self.exposures.size or self.exposure_gains.size:
            shares = FreeShares(self.harmonics, self.exposures, self.exposure_gains, self.fine, scale)
            instrument = instrument.with_part("exposures", shares)
        return instrument
