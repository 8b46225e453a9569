"""Elements with curves over wavelength: mirrors, derotators, coatings, polarisation without a closed form.

Equation    M = depolariser(loss) · R(ρ) · [diattenuator(D) spread(s) retarder(δ), all along `axis`]; they commute
            each of δ(λ), D(λ), ρ(λ), loss(λ), s(λ) is the natural cubic spline through its values at its own
            wavelengths, continued as a straight line beyond the first and the last; one value: constant
            `FieldDiattenuator`: D(x, y, λ) = Σ c_ij(λ) P_i(x/h) P_j(y/h), i + j ≤ 2, along `axis`, c_ij(λ) such splines
Symbols     δ retardance [rad], of the fast axis; D diattenuation along `axis`; ρ rotation [deg] of the polarisation
            from +X toward +Y, a circular retardance of 2ρ (skew mirrors, optical activity);
            loss lost fraction of q, u, v; s lost fraction of the components not along `axis`, 1 − exp(−σ²/2) for a rms
            spread σ [rad] of the retardance over the beam or the band
Sources     mirrors as diattenuating retarders: van Harten, Snik & Keller 2009, PASP 121, 377; form of M: Lu & Chipman
            1996, JOSA A 13, 1106; diattenuation of oblique faces (Fresnel): Born & Wolf 1999, § 1.5;
            spline: de Boor 1978, A Practical Guide to Splines, ch. IV.
Limits      no values: the identity. A spline with as many knots as bands fits any curve without curvature
            within a band; with fewer it is smooth.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model import legendre, mueller
from walop_jax.model.conventions import FIELD_SCALE
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.parameters import Scalar, number, row
from walop_jax.model.ray import Ray

Curve = Float[Array, " k"]
FIELD_TERMS = {f"p{i}{j}": n for n, (i, j) in enumerate(legendre.terms(2))}


class WithCurves(Element):
    """An element with curves over wavelength: values of a number at the wavelengths (µm) of that number with `_at`."""

    def __check_init__(self) -> None:
        for knots in dataclasses.fields(self):
            if knots.name.endswith("_at"):
                name = knots.name.removesuffix("_at")
                check_curve(name, getattr(self, name), getattr(self, knots.name))

    def labels(self, field: str) -> Sequence[str]:
        """Values of a curve are numbered from 1 in the order of their wavelengths: `mirror.delta.1`."""
        knots = getattr(self, f"{field}_at", None)
        return (field,) if knots is None else tuple(f"{field}{i + 1}" for i in range(len(knots)))

    def curve(self, name: str, wavelength: Float[Array, " n"]) -> Float[Array, " n"]:
        """Values (n) of one of the curves at n wavelengths (µm), in the unit of the curve."""
        return spline(getattr(self, f"{name}_at"), getattr(self, name), wavelength)


def check_curve(name: str, values: Curve | None, knots: Sequence[float]) -> None:
    """Raise ValueError for values without their wavelengths (`name`_at), and the reverse."""
    if (values is None) != (len(knots) == 0):
        missing = name if values is None else f"{name}_at"
        raise ValueError(f"{missing} is missing: {name} and {name}_at (um) belong together")
    if any(b <= a for a, b in itertools.pairwise(knots)):
        raise ValueError(f"{name}_at must be wavelengths (um) that increase")
    if values is not None and jnp.ndim(values) == 1 and len(values) != len(knots):
        raise ValueError(f"{name} has {len(values)} values for {len(knots)} wavelengths in {name}_at")


def spline(knots: Sequence[float], values: Curve, at: Float[Array, " n"]) -> Float[Array, " n"]:
    """Natural cubic spline through `values` at `knots`, continued as straight lines."""
    if len(knots) == 1:
        return jnp.broadcast_to(values[0], jnp.shape(at))
    from scipy.interpolate import CubicSpline

    # Powers of each piece, from third to none, as linear functions of the values.
    natural = CubicSpline(np.asarray(knots, float), np.eye(len(knots)), bc_type="natural")
    piece = jnp.clip(jnp.searchsorted(jnp.asarray(natural.x), at) - 1, 0, len(knots) - 2)
    cubic, square, slope, start = (jnp.asarray(natural.c) @ values)[:, piece]
    inside = jnp.clip(at, natural.x[0], natural.x[-1])
    t = inside - jnp.asarray(natural.x)[piece]
    steep = (3.0 * cubic * t + 2.0 * square) * t + slope
    return ((cubic * t + square) * t + slope) * t + start + steep * (at - inside)


class SpectralElement(WithCurves):
    """A retarder, diattenuator and depolariser on one axis, each a smooth curve over wavelength."""

    delta: Curve | None = row("rad", "retardance at `delta_at`")
    diattenuation: Curve | None = row("", "diattenuation along the axis at `diattenuation_at`")
    rotation: Curve | None = row("deg", "turn of the polarisation at `rotation_at`")
    loss: Curve | None = row("", "fraction of the polarisation lost at `loss_at`")
    spread: Curve | None = row("", "share lost across the axis at `spread_at`")
    axis: Scalar = number("deg", "fast axis, from +X toward +Y")
    delta_at: tuple[float, ...] = eqx.field(static=True, default=())
    diattenuation_at: tuple[float, ...] = eqx.field(static=True, default=())
    rotation_at: tuple[float, ...] = eqx.field(static=True, default=())
    loss_at: tuple[float, ...] = eqx.field(static=True, default=())
    spread_at: tuple[float, ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = "spectral"
    reference: ClassVar[str] = "van Harten, Snik & Keller 2009, PASP 121, 377"

    def mueller(self, ray: Ray) -> Mueller | None:
        """The element at every wavelength."""
        return mueller.product(self._parts(ray))

    def retardances(self, wavelength: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], ...]:
        """One retardance, between its knots as straight lines."""
        if self.delta is None:
            return ()
        waves = np.interp(wavelength, self.delta_at, np.asarray(self.delta)) / (2.0 * np.pi)
        return waves, waves

    def _parts(self, ray: Ray) -> Iterator[Mueller]:
        axis = jnp.deg2rad(self.axis)
        if self.delta is not None:
            yield mueller.retarder(self.curve("delta", ray.wavelength), axis)
        if self.spread is not None:
            remaining, ones = 1.0 - self.curve("spread", ray.wavelength), jnp.ones_like(ray.wavelength)
            matrix = jnp.stack([ones, ones, remaining, remaining], axis=-1)[:, :, None] * jnp.eye(4)
            yield mueller.rotation(-axis) @ matrix @ mueller.rotation(axis)
        if self.diattenuation is not None:
            d = self.curve("diattenuation", ray.wavelength)
            yield mueller.diattenuator(d * jnp.cos(2.0 * axis), d * jnp.sin(2.0 * axis))
        if self.rotation is not None:
            yield mueller.rotation(-jnp.deg2rad(self.curve("rotation", ray.wavelength)))
        if self.loss is not None:
            remaining = 1.0 - self.curve("loss", ray.wavelength)
            yield jnp.stack([jnp.ones_like(remaining), remaining, remaining, remaining], axis=-1)[
                :, :, None
            ] * jnp.eye(4)


class FieldDiattenuator(Element):
    """A diattenuator on one axis that changes smoothly over field and wavelength: oblique faces, beams of a prism.

    Directly ahead of an analyser, with its axis, it is a ratio of the two beams: ½ (1 ± D) (1, ±1, 0, 0). The cameras
    have such a ratio too, in their throughput, the same at all wavelengths: with `none_at` (µm) the terms vanish there,
    and hold the change with colour alone.
    """

    p00: Curve | None = row("", "constant part at `at`")
    p10: Curve | None = row("", "term P₁(x/h) at `at`")
    p01: Curve | None = row("", "term P₁(y/h) at `at`")
    p20: Curve | None = row("", "term P₂(x/h) at `at`")
    p11: Curve | None = row("", "term P₁(x/h) P₁(y/h) at `at`")
    p02: Curve | None = row("", "term P₂(y/h) at `at`")
    axis: Scalar = number("deg", "axis, from +X toward +Y")
    at: tuple[float, ...] = eqx.field(static=True, default=())
    none_at: float = eqx.field(static=True, default=0.0)  # µm; 0: nowhere
    scale: float = eqx.field(static=True, default=FIELD_SCALE)  # h, degrees

    kind: ClassVar[str] = "field_diattenuator"
    reference: ClassVar[str] = "Born & Wolf 1999, Principles of Optics, 1.5"

    def __check_init__(self) -> None:
        for name in FIELD_TERMS:
            if (values := getattr(self, name)) is not None:
                check_curve(name, values, self.at)
        if self.none_at in self.at:
            raise ValueError(f"none_at = {self.none_at:g} um is in `at` as well: leave it out there")

    def labels(self, field: str) -> Sequence[str]:
        """Values of a term are numbered from 1, by wavelength."""
        return tuple(f"{field}_{i + 1}" for i in range(len(self.at))) if field in FIELD_TERMS else (field,)

    def mueller(self, ray: Ray) -> Mueller | None:
        """Mueller matrices (n, 4, 4) of the diattenuator at the wavelengths of a ray; None, the identity, without
        terms.
        """
        terms = legendre.basis(ray.x, ray.y, 2, self.scale)
        knots, gap = self.at, len(self.at)
        if self.none_at > 0.0:
            gap = sum(knot < self.none_at for knot in knots)
            knots = (*knots[:gap], self.none_at, *knots[gap:])
        contributions, none = [], jnp.zeros(len(knots) - len(self.at))
        for name, n in FIELD_TERMS.items():
            if (values := getattr(self, name)) is not None:
                values = jnp.concatenate([values[:gap], none, values[gap:]])
                contributions.append(terms[..., n] * spline(knots, values, ray.wavelength))
        if not contributions:
            return None
        d, twice = sum(contributions[1:], contributions[0]), 2.0 * jnp.deg2rad(self.axis)
        return mueller.diattenuator(d * jnp.cos(twice), d * jnp.sin(twice))


class Mirror(WithCurves):
    """A flat metal mirror; reflectance is part of the throughput.

    Equation    r_s = (cos θ − w)/(cos θ + w),  r_p = (N² cos θ − w)/(N² cos θ + w),  w = √(N² − sin² θ),  N = n + ik
                M of the Jones matrix diag(r_p, r_s), p along `axis`, over ½ (|r_p|² + |r_s|²)
    Symbols     θ angle of incidence; n, k index of refraction and extinction coefficient, natural cubic splines through
                their values at `n_at` and `k_at`; p in the plane of incidence, s normal to it
    Source      Born & Wolf 1999, § 14.2, for fields ∝ exp(i(kz − ωt)), k > 0 then absorbs; as an element of a
                telescope: van Harten, Snik & Keller 2009, PASP 121, 377
    Limits      θ = 0: diag(1, 1, −1, −1), the frame of the reflected beam being (p, s, k) as that of the beam that
                arrives; k = 0 and tan θ = n (Brewster): light polarised along s alone; k → ∞: no diattenuation.
    """

    n: Curve | None = row("", "index of refraction at `n_at`")
    k: Curve | None = row("", "extinction coefficient at `k_at`")
    incidence: Scalar = number("deg", "angle of incidence", default=45.0)
    axis: Scalar = number("deg", "plane of incidence, from +X toward +Y")
    n_at: tuple[float, ...] = eqx.field(static=True, default=())
    k_at: tuple[float, ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = "mirror"
    reference: ClassVar[str] = "Born & Wolf 1999, Principles of Optics, 14.2"

    def __check_init__(self) -> None:
        if (self.n is None) != (self.k is None):
            raise ValueError(f"{'n' if self.n is None else 'k'} is missing: a metal has both")

    def mueller(self, ray: Ray) -> Mueller | None:
        """Mueller matrices (n, 4, 4) of the mirror at the wavelengths of a ray, of unit mean reflectance.

        None, the identity, comes back for a mirror without a metal.
        """
        if self.n is None or self.k is None:
            return None
        index = self.curve("n", ray.wavelength) + 1j * self.curve("k", ray.wavelength)
        cos, sin = jnp.cos(jnp.deg2rad(self.incidence)), jnp.sin(jnp.deg2rad(self.incidence))
        inside = jnp.sqrt(index**2 - sin**2)
        s = (cos - inside) / (cos + inside)
        p = (index**2 * cos - inside) / (index**2 * cos + inside)
        nothing = jnp.zeros_like(p)
        matrix = mueller.from_jones(mueller.matrix2(p, nothing, nothing, s))
        axis = jnp.deg2rad(self.axis)
        return mueller.rotation(-axis) @ (matrix / matrix[..., :1, :1]) @ mueller.rotation(axis)
