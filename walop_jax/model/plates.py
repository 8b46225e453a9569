"""Plane waves through crystal plates: the exact single pass, and the paper's fixed-axis retarder.

The stack is air | plate 1 | plate 2 | … | air with its faces normal to z. The transverse wave vector s (in
units of ω/c) is the same in every medium; each crystal carries an ordinary and an extraordinary wave with a
direction and a field of its own. Optic axis c = (cos α, sin α, 0), in the surface:

Ordinary        k_z² = n_o² − s²,                                E ∝ k × c
Extraordinary   k_z² = n_e² (1 − (s·c)²/n_o²) − (s·c⊥)²,          E ∝ n_o² c − (k·c) k
Both            H = k × E (in units of 1/Z0)
Face            with 𝐄, 𝐇 the 2 × 2 matrices of the tangential fields of the two forward waves of a medium,
                the amplitudes go over as t = 2 (𝐄₁⁻¹𝐄₂ + 𝐇₁⁻¹𝐇₂)⁻¹. The backward waves have the same
                tangential E and the opposite tangential H because the axis lies in the surface; they enter
                the continuity and are then dropped (no multiple reflections).
Stack           J = t_out Π P_j t_j, P = diag(1, exp 2πi d (k_ze − k_zo)/λ); the ordinary phase is common.

Symbols     s = sin of the angle in air; d thickness [µm]; λ vacuum wavelength [µm]; n_o, n_e at λ.
Cut axis    with c = (cos α cos χ, sin α cos χ, sin χ) the extraordinary waves obey k·εk = n_o² n_e², a
            quadratic in k_z whose two roots are no mirror images; with 𝐄₋, 𝐇₋ the backward waves of the
            first medium and Y = 𝐇₋ 𝐄₋⁻¹ the face is t = (𝐇₂ − Y 𝐄₂)⁻¹ (𝐇₁ − Y 𝐄₁). Solved that way only if
            a plate has a `cut`.
Arrays      matrices (2, 2, …); inside a stack media or faces are the axis behind these.

Sources     Born & Wolf, Principles of Optics, ch. 15 (waves in uniaxial crystals) and 1.5 (continuity);
            Yeh 1980, Surf. Sci. 96, 41 (the matrix form). Fixed axis: Paper II, appendix B.
Limits      At normal incidence a plate of air indices is the identity; 𝐄 of air is the carried frame of
            `conventions.py`, smooth through normal incidence, hence so is every derivative.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.mueller import (
    Matrix2,
    Real,
    computed_once,
    from_jones,
    inverse2,
    matrix2,
    product2,
    retarder,
)


class Plate(NamedTuple):
    """A uniaxial plate: thickness (µm), indices at the wavelengths, azimuth of its optic axis (rad).

    `cut` is the angle (rad) of the optic axis out of the surface, None where it lies in the surface.
    """

    thickness: Real
    ordinary: Real
    extraordinary: Real
    axis: Real
    cut: Real | None = None


Wave = tuple[Real, Real, Real, Real]
"""k_z of a plane wave, and its electric field along x, y and z."""


class _Waves(NamedTuple):
    electric: Matrix2  # columns: the two waves; rows: tangential x, y
    magnetic: Matrix2
    phase: Real  # k_z of the second wave minus that of the first

    @classmethod
    def of(cls, kx: Real, ky: Real, first: Wave, second: Wave, phase: Real) -> _Waves:
        """Tangential fields of two waves."""
        (kz1, x1, y1, z1), (kz2, x2, y2, z2) = first, second
        magnetic = (ky * z1 - kz1 * y1, ky * z2 - kz2 * y2, kz1 * x1 - kx * z1, kz2 * x2 - kx * z2)
        return computed_once(cls(matrix2(x1, x2, y1, y2), matrix2(*magnetic), phase))


def _air(sx: Real, sy: Real) -> _Waves:
    kz = jnp.sqrt(1.0 - sx**2 - sy**2)
    g = 1.0 / (1.0 + kz)
    first = (kz, 1.0 - g * sx**2, -g * sx * sy, -sx)
    second = (kz, -g * sx * sy, 1.0 - g * sy**2, -sy)
    return _Waves.of(sx, sy, first, second, jnp.zeros_like(kz))


def _anisotropy(plate: Plate) -> Real:
    """n_e² − n_o², to the last digit: a difference of squares would lose 10⁻¹⁴, 10⁻¹² rad of a thick plate.

    The phase follows without a cancellation from k_ze² − k_zo² = (n_e² − n_o²)(1 − (s·c)²/n_o²).
    """
    return (plate.extraordinary - plate.ordinary) * (plate.extraordinary + plate.ordinary)


def _crystal(sx: Real, sy: Real, plate: Plate) -> _Waves:
    cx, cy = jnp.cos(plate.axis), jnp.sin(plate.axis)
    no2, ne2 = plate.ordinary**2, plate.extraordinary**2
    along, across = sx * cx + sy * cy, -sx * cy + sy * cx
    factor = 1.0 - along**2 * (1.0 / no2)
    kz_o = jnp.sqrt(no2 - sx**2 - sy**2)
    kz_e = jnp.sqrt(ne2 * factor - across**2)
    ordinary = (kz_o, -kz_o * cy, kz_o * cx, -across)
    extraordinary = (kz_e, no2 * cx - along * sx, no2 * cy - along * sy, -along * kz_e)
    phase = _anisotropy(plate) * factor * (1.0 / (kz_e + kz_o))
    return _Waves.of(sx, sy, ordinary, extraordinary, phase)


def _with_air(air: Matrix2, crystals: Matrix2) -> Matrix2:
    """The fields ahead of every interface, along the third axis: those of air, then those of the crystals."""
    ahead, inside = jnp.broadcast_arrays(air[:, :, None], crystals)
    return computed_once(jnp.concatenate([ahead[:, :, :1], inside], axis=2))


def _behind(ahead: Matrix2) -> Matrix2:
    """The fields behind every interface: those of the next medium, and of air behind the last."""
    return jnp.roll(ahead, -1, axis=2)


def _faces(air: _Waves, crystals: _Waves) -> Matrix2:
    """Matrices (2, 2, …) of the transmitted amplitudes, one for every interface of the stack."""
    electric, magnetic = (_with_air(*pair) for pair in zip(air[:2], crystals[:2], strict=True))
    passed = product2(inverse2(electric), _behind(electric))
    return 2.0 * inverse2(passed + product2(inverse2(magnetic), _behind(magnetic)))


# ------------------------------------------------------------------ optic axes out of the surface


def _extraordinary_kz(sx: Real, sy: Real, plate: Plate) -> tuple[Real, Real]:
    """Both roots k_z of k·εk = n_o² n_e², forward first."""
    cut = 0.0 if plate.cut is None else plate.cut
    no2, ne2 = plate.ordinary**2, plate.extraordinary**2
    along, cz = (sx * jnp.cos(plate.axis) + sy * jnp.sin(plate.axis)) * jnp.cos(cut), jnp.sin(cut)
    a = no2 + (ne2 - no2) * cz**2
    b = (ne2 - no2) * along * cz
    c = no2 * (sx**2 + sy**2) + (ne2 - no2) * along**2 - no2 * ne2
    root = jnp.sqrt(b**2 - a * c)
    return (root - b) / a, (-root - b) / a


def _crystal_both_ways(sx: Real, sy: Real, plate: Plate) -> tuple[_Waves, _Waves]:
    """Forward and backward waves; the phase of the backward ones is not used."""
    cut = 0.0 if plate.cut is None else plate.cut
    no2 = plate.ordinary**2
    cx, cy, cz = jnp.cos(plate.axis) * jnp.cos(cut), jnp.sin(plate.axis) * jnp.cos(cut), jnp.sin(cut)
    kz_o = jnp.sqrt(no2 - sx**2 - sy**2)

    def waves(kz_o: Real, kz_e: Real) -> _Waves:
        along = sx * cx + sy * cy + kz_e * cz
        ordinary = (kz_o, sy * cz - kz_o * cy, kz_o * cx - sx * cz, sx * cy - sy * cx)
        extraordinary = (kz_e, no2 * cx - along * sx, no2 * cy - along * sy, no2 * cz - along * kz_e)
        factor = 1.0 - along**2 * (1.0 / no2)
        phase = _anisotropy(plate) * factor * (1.0 / (kz_e + kz_o))
        return _Waves.of(sx, sy, ordinary, extraordinary, phase)

    forward, backward = _extraordinary_kz(sx, sy, plate)
    return waves(kz_o, forward), waves(-kz_o, backward)


def _faces_both_ways(air: _Waves, forward: _Waves, backward: _Waves) -> Matrix2:
    """The same as `_faces`, with backward waves that are no mirror images of the forward ones.

    In air the backward waves have the same tangential E and the opposite tangential H.
    """
    electric, magnetic = (_with_air(*pair) for pair in zip(air[:2], forward[:2], strict=True))
    back = _with_air(air.electric, backward.electric), _with_air(-air.magnetic, backward.magnetic)
    y = -product2(back[1], inverse2(back[0]))
    transmitted = _behind(magnetic) + product2(y, _behind(electric))
    return product2(inverse2(transmitted), magnetic + product2(y, electric))


def stack_jones(sx: Real, sy: Real, plates: tuple[Plate, ...], wavelength: Real) -> Matrix2:
    """Jones matrix of plates in contact, in air, for rays of direction (sx, sy, √(1 − s²)).

    Referred to the carried axes on both sides, Fresnel losses of every face included. All arguments
    broadcast; `wavelength` in µm. Plates are an axis of all arrays: the waves of one are compiled, not of each.
    """
    if not plates:
        raise ValueError("a stack needs at least one plate")
    (plates,) = alike([plates])
    dimensions = max(map(jnp.ndim, (sx, sy, wavelength, *jax.tree.leaves(plates))))
    sx, sy, _ = jnp.broadcast_arrays(sx, sy, jnp.zeros((1,) * dimensions))
    crystals = jax.tree.map(lambda *values: _stacked(values, dimensions), *plates)
    air = _air(sx, sy)
    if crystals.cut is None:
        inside = _crystal(sx, sy, crystals)
        faces = _faces(air, inside)
    else:
        inside, backward = _crystal_both_ways(sx, sy, crystals)
        faces = _faces_both_ways(air, inside, backward)
    turns = jnp.exp(2j * jnp.pi * (crystals.thickness * inside.phase * (1.0 / wavelength)))
    jones = faces[:, :, 0].astype(complex)
    for turn, face in zip(turns, jnp.moveaxis(faces[:, :, 1:], 2, 0), strict=True):
        jones = product2(face, jnp.stack(jnp.broadcast_arrays(jones[0], turn * jones[1])))
    return jones


def alike(stacks: Sequence[tuple[Plate, ...]]) -> list[tuple[Plate, ...]]:
    """The stacks with a `cut` in every plate if any plate has one, so that all plates have the same arrays."""
    if all(plate.cut is None for stack in stacks for plate in stack):
        return list(stacks)
    return [
        tuple(p if p.cut is not None else p._replace(cut=jnp.zeros(())) for p in stack) for stack in stacks
    ]


def _stacked(values: tuple[Real, ...], dimensions: int) -> Real:
    """A number of all plates along a new first axis, ahead of `dimensions` others."""
    stack = jnp.stack(jnp.broadcast_arrays(*values))
    return stack.reshape(len(values), *(1,) * (1 + dimensions - stack.ndim), *stack.shape[1:])


def stack_mueller(sx: Real, sy: Real, plates: tuple[Plate, ...], wavelength: Real) -> Float[Array, "... 4 4"]:
    """Mueller matrix of the plates of `stack_jones`."""
    return from_jones(stack_jones(sx, sy, plates, wavelength))


def fixed_axis_mueller(
    sx: Real, sy: Real, plates: tuple[Plate, ...], wavelength: Real
) -> Float[Array, "... 4 4"]:
    """The paper's approximation: one retarder whose axis is that of the last plate, without Fresnel losses.

    δ = Σ ± 2π d (k_ze − k_zo)/λ, counted positive for plates whose axis is that of the last one. Misses up
    to 1–2 % of the cross-talk of thick crossed plates at 10° (kept for comparison). Both crystals are
    positive (n_e > n_o), so the optic axis is the slow one and the fast axis of a plate lies at axis + 90°.
    """
    return retarder(fixed_axis_retardance(sx, sy, plates, wavelength), plates[-1].axis + 0.5 * jnp.pi)


def fixed_axis_retardance(sx: Real, sy: Real, plates: tuple[Plate, ...], wavelength: Real) -> Real:
    """Retardance (rad) of `fixed_axis_mueller`: the sum over the plates, not modulo 2π."""
    total = jnp.zeros_like(sx)
    last = plates[-1].axis
    for plate in plates:
        crystal = _crystal(sx, sy, plate) if plate.cut is None else _crystal_both_ways(sx, sy, plate)[0]
        sign = jnp.cos(2.0 * (plate.axis - last))
        total = total + sign * 2.0 * jnp.pi * plate.thickness * crystal.phase / wavelength
    return total


def stack_retardance(sx: Real, sy: Real, plates: tuple[Plate, ...], wavelength: Real) -> Real:
    """Retardance (rad) of plates in contact for rays of direction (sx, sy), of the order of `fixed_axis_retardance`.

    With U = J / √det J = cos(δ/2) + i sin(δ/2) n·σ up to losses, n near the fast axis; unlike the trace of a Mueller
    matrix, cos(δ/2) has a slope at half a wave.
    """
    (a, b), (c, d) = stack_jones(sx, sy, plates, wavelength)
    scale = 0.5 / jnp.sqrt(a * d - b * c)
    cosine = ((a + d) * scale).real
    fast = plates[-1].axis + 0.5 * jnp.pi
    along = (((a - d) * jnp.cos(2.0 * fast) + (b + c) * jnp.sin(2.0 * fast)) * scale).imag
    sine = jnp.sqrt(jnp.maximum(1.0 - cosine**2, 0.0))
    delta = 2.0 * jnp.arctan2(jnp.where(along < 0, sine, -sine), cosine)
    turns = (fixed_axis_retardance(sx, sy, plates, wavelength) - delta) / (2.0 * jnp.pi)
    return delta + 2.0 * jnp.pi * jax.lax.stop_gradient(jnp.round(turns))
