"""Plane waves through crystal plates: the exact single pass, and the paper's fixed-axis retarder.

The stack is air | plate 1 | plate 2 | … | air with its faces normal to z. The transverse wave vector s (in
units of ω/c) is the same in every medium; each crystal carries an ordinary and an extraordinary wave with a
direction and a field of its own. Optic axis c = (cos α, sin α, 0), in the surface:

Ordinary        k_z² = n_o² − s²,                                E ∝ k × c
Extraordinary   k_z² = n_e² (1 − (s·c)²/n_o²) − (s·c⊥)²,          E ∝ n_o² c − (k·c) k
Both            H = k × E (in units of 1/Z0)
Face            with 𝐄, 𝐇 the 2 × 2 matrices of the tangential fields of the two forward waves of a medium,
                the amplitudes go over as t = 2 (𝐄₁⁻¹𝐄₂ + 𝐇₁⁻¹𝐇₂)⁻¹. The backward waves have the same tangential
                E and the opposite tangential H because the axis lies in the surface; they enter the continuity
                and are then dropped (no multiple reflections).
Stack           J = t_out Π P_j t_j, P = diag(1, exp 2πi d (k_ze − k_zo)/λ); the ordinary phase is common.

Symbols     s = sin of the angle in air; d thickness [µm]; λ vacuum wavelength [µm]; n_o, n_e at λ.
Sources     Born & Wolf, Principles of Optics, ch. 15 (waves in uniaxial crystals) and 1.5 (continuity);
            Yeh 1982, Surf. Sci. 96, 41 (the matrix form). Fixed axis: Paper II, appendix B.
Limits      At normal incidence a plate of air indices is the identity; 𝐄 of air is the carried frame of
            `conventions.py`, smooth through normal incidence, hence so is every derivative.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.mueller import Matrix2, from_jones, retarder

Real = Float[Array, "..."]


class Plate(NamedTuple):
    """A uniaxial plate: thickness (µm), indices at the wavelengths, and the azimuth of its axis (rad)."""

    thickness: Real
    ordinary: Real
    extraordinary: Real
    axis: Real


class _Waves(NamedTuple):
    electric: Matrix2  # columns: the two forward waves; rows: tangential x, y
    magnetic: Matrix2
    phase: Real  # k_z of the second wave minus that of the first


def _tangential(kx: Real, ky: Real, kz: Real, e: tuple[Real, Real, Real]) -> tuple[Real, Real]:
    ex, ey, ez = e
    return ky * ez - kz * ey, kz * ex - kx * ez


def _air(sx: Real, sy: Real) -> _Waves:
    kz = jnp.sqrt(1.0 - sx**2 - sy**2)
    g = 1.0 / (1.0 + kz)
    first = (1.0 - g * sx**2, -g * sx * sy, -sx)
    second = (-g * sx * sy, 1.0 - g * sy**2, -sy)
    h1 = _tangential(sx, sy, kz, first)
    h2 = _tangential(sx, sy, kz, second)
    electric = Matrix2(first[0], second[0], first[1], second[1])
    return _Waves(electric, Matrix2(h1[0], h2[0], h1[1], h2[1]), jnp.zeros_like(kz))


def _crystal(sx: Real, sy: Real, plate: Plate) -> _Waves:
    cx, cy = jnp.cos(plate.axis), jnp.sin(plate.axis)
    no2, ne2 = plate.ordinary**2, plate.extraordinary**2
    along, across = sx * cx + sy * cy, -sx * cy + sy * cx
    kz_o = jnp.sqrt(no2 - sx**2 - sy**2)
    kz_e = jnp.sqrt(ne2 * (1.0 - along**2 / no2) - across**2)
    e_o = (-kz_o * cy, kz_o * cx, -across)
    e_e = (no2 * cx - along * sx, no2 * cy - along * sy, -along * kz_e)
    h_o = _tangential(sx, sy, kz_o, e_o)
    h_e = _tangential(sx, sy, kz_e, e_e)
    electric = Matrix2(e_o[0], e_e[0], e_o[1], e_e[1])
    return _Waves(electric, Matrix2(h_o[0], h_e[0], h_o[1], h_e[1]), kz_e - kz_o)


def _face(before: _Waves, after: _Waves) -> Matrix2:
    electric = before.electric.inverse() @ after.electric
    magnetic = before.magnetic.inverse() @ after.magnetic
    return electric.plus(magnetic).inverse().times(2.0)


def stack_jones(sx: Real, sy: Real, plates: tuple[Plate, ...], wavelength: Real) -> Matrix2:
    """Jones matrix of plates in contact, in air, for rays of direction (sx, sy, √(1 − s²)).

    Referred to the carried axes on both sides, Fresnel losses of every face included. All arguments
    broadcast; `wavelength` in µm.
    """
    sx, sy = jnp.broadcast_arrays(sx, sy)
    medium = _air(sx, sy)
    outside = medium
    jones = None
    for plate in plates:
        inside = _crystal(sx, sy, plate)
        face = _face(medium, inside)
        jones = face if jones is None else face @ jones
        turn = jnp.exp(2j * jnp.pi * plate.thickness * inside.phase / wavelength)
        jones = jones.scaled_rows(jnp.ones_like(turn), turn)
        medium = inside
    if jones is None:
        raise ValueError("a stack needs at least one plate")
    return _face(medium, outside) @ jones


def stack_mueller(sx: Real, sy: Real, plates: tuple[Plate, ...], wavelength: Real) -> Float[Array, "... 4 4"]:
    """Mueller matrix of plates in contact, in air (see `stack_jones`)."""
    return from_jones(stack_jones(sx, sy, plates, wavelength))


def fixed_axis_mueller(
    sx: Real, sy: Real, plates: tuple[Plate, ...], wavelength: Real
) -> Float[Array, "... 4 4"]:
    """The paper's approximation: one retarder whose axis stays that of the last plate, without Fresnel losses.

    δ = Σ ± 2π d (k_ze − k_zo)/λ, counted positive for plates whose axis is that of the last one. Misses up
    to 1–2 % of the cross-talk of thick crossed plates at 10° (kept for comparison). Both crystals are positive
    (n_e > n_o), so the optic axis is the slow one and the fast axis of a plate lies at axis + 90°.
    """
    total = jnp.zeros_like(sx)
    last = plates[-1].axis
    for plate in plates:
        cx, cy = jnp.cos(plate.axis), jnp.sin(plate.axis)
        along, across = sx * cx + sy * cy, -sx * cy + sy * cx
        kz_o = jnp.sqrt(plate.ordinary**2 - sx**2 - sy**2)
        kz_e = jnp.sqrt(plate.extraordinary**2 * (1.0 - along**2 / plate.ordinary**2) - across**2)
        sign = jnp.cos(2.0 * (plate.axis - last))
        total = total + sign * 2.0 * jnp.pi * plate.thickness * (kz_e - kz_o) / wavelength
    return retarder(total, last + 0.5 * jnp.pi)
