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

Sources     Born & Wolf, Principles of Optics, ch. 15 (waves in uniaxial crystals) and 1.5 (continuity);
            Yeh 1980, Surf. Sci. 96, 41 (the matrix form). Fixed axis: Paper II, appendix B.
Limits      At normal incidence a plate of air indices is the identity; 𝐄 of air is the carried frame of
            `conventions.py`, smooth through normal incidence, hence so is every derivative.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.mueller import Matrix2, from_jones, retarder

Real = Float[Array, "..."]


class Plate(NamedTuple):
    """A uniaxial plate: thickness (µm), indices at the wavelengths, azimuth of its optic axis (rad).

    `cut` is the angle (rad) of the optic axis out of the surface, None where it lies in the surface.
    """

    thickness: Real
    ordinary: Real
    extraordinary: Real
    axis: Real
    cut: Real | None = None


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
    e_o = (-kz_o * cy, kz_o * cx, -across)
    e_e = (no2 * cx - along * sx, no2 * cy - along * sy, -along * kz_e)
    h_o = _tangential(sx, sy, kz_o, e_o)
    h_e = _tangential(sx, sy, kz_e, e_e)
    electric = Matrix2(e_o[0], e_e[0], e_o[1], e_e[1])
    phase = _anisotropy(plate) * factor * (1.0 / (kz_e + kz_o))
    return _Waves(electric, Matrix2(h_o[0], h_e[0], h_o[1], h_e[1]), phase)


def _face(before: _Waves, after: _Waves) -> Matrix2:
    electric = before.electric.inverse() @ after.electric
    magnetic = before.magnetic.inverse() @ after.magnetic
    return electric.plus(magnetic).inverse().times(2.0)


# ------------------------------------------------------------------ optic axes out of the surface


class _BothWays(NamedTuple):
    forward: _Waves
    backward: _Waves  # tangential fields of the two backward waves; their phase is not used


def _air_both_ways(sx: Real, sy: Real) -> _BothWays:
    forward = _air(sx, sy)
    return _BothWays(forward, forward._replace(magnetic=forward.magnetic.times(-1.0)))


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


def _crystal_both_ways(sx: Real, sy: Real, plate: Plate) -> _BothWays:
    cut = 0.0 if plate.cut is None else plate.cut
    no2 = plate.ordinary**2
    cx, cy, cz = jnp.cos(plate.axis) * jnp.cos(cut), jnp.sin(plate.axis) * jnp.cos(cut), jnp.sin(cut)
    kz_o = jnp.sqrt(no2 - sx**2 - sy**2)

    def waves(kz_o: Real, kz_e: Real) -> _Waves:
        along = sx * cx + sy * cy + kz_e * cz
        e_o = (sy * cz - kz_o * cy, kz_o * cx - sx * cz, sx * cy - sy * cx)
        e_e = (no2 * cx - along * sx, no2 * cy - along * sy, no2 * cz - along * kz_e)
        h_o, h_e = _tangential(sx, sy, kz_o, e_o), _tangential(sx, sy, kz_e, e_e)
        electric = Matrix2(e_o[0], e_e[0], e_o[1], e_e[1])
        factor = 1.0 - along**2 * (1.0 / no2)
        phase = _anisotropy(plate) * factor * (1.0 / (kz_e + kz_o))
        return _Waves(electric, Matrix2(h_o[0], h_e[0], h_o[1], h_e[1]), phase)

    forward, backward = _extraordinary_kz(sx, sy, plate)
    return _BothWays(waves(kz_o, forward), waves(-kz_o, backward))


def _face_both_ways(before: _BothWays, after: _BothWays) -> Matrix2:
    y = (before.backward.magnetic @ before.backward.electric.inverse()).times(-1.0)
    transmitted = after.forward.magnetic.plus(y @ after.forward.electric)
    incident = before.forward.magnetic.plus(y @ before.forward.electric)
    return transmitted.inverse() @ incident


def _stack(
    media: list[_Waves] | list[_BothWays], phases: list[Real], face: Callable[[Any, Any], Matrix2]
) -> Matrix2:
    jones = face(media[0], media[1])
    for before, after, phase in zip(media[1:-1], media[2:], phases, strict=True):
        turn = jnp.exp(2j * jnp.pi * phase)
        jones = face(before, after) @ Matrix2(jones.a, jones.b, turn * jones.c, turn * jones.d)
    return jones


def stack_jones(sx: Real, sy: Real, plates: tuple[Plate, ...], wavelength: Real) -> Matrix2:
    """Jones matrix of plates in contact, in air, for rays of direction (sx, sy, √(1 − s²)).

    Referred to the carried axes on both sides, Fresnel losses of every face included. All arguments
    broadcast; `wavelength` in µm.
    """
    if not plates:
        raise ValueError("a stack needs at least one plate")
    sx, sy = jnp.broadcast_arrays(sx, sy)
    if any(plate.cut is not None for plate in plates):
        air = _air_both_ways(sx, sy)
        crystals = [_crystal_both_ways(sx, sy, plate) for plate in plates]
        inside = [crystal.forward for crystal in crystals]
        media, face = [air, *crystals, air], _face_both_ways
    else:
        air = _air(sx, sy)
        inside = [_crystal(sx, sy, plate) for plate in plates]
        media, face = [air, *inside, air], _face
    per_wavelength = 1.0 / wavelength
    phases = [p.thickness * w.phase * per_wavelength for p, w in zip(plates, inside, strict=True)]
    return _stack(media, phases, face)


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
        crystal = _crystal(sx, sy, plate) if plate.cut is None else _crystal_both_ways(sx, sy, plate).forward
        sign = jnp.cos(2.0 * (plate.axis - last))
        total = total + sign * 2.0 * jnp.pi * plate.thickness * crystal.phase / wavelength
    return total


def stack_retardance(sx: Real, sy: Real, plates: tuple[Plate, ...], wavelength: Real) -> Real:
    """Retardance (rad) of plates in contact for rays of direction (sx, sy), of the order of `fixed_axis_retardance`.

    With U = J / √det J = cos(δ/2) + i sin(δ/2) n·σ up to losses, n near the fast axis; unlike the trace of a Mueller
    matrix, cos(δ/2) has a slope at half a wave.
    """
    a, b, c, d = stack_jones(sx, sy, plates, wavelength)
    scale = 0.5 / jnp.sqrt(a * d - b * c)
    cosine = ((a + d) * scale).real
    fast = plates[-1].axis + 0.5 * jnp.pi
    along = (((a - d) * jnp.cos(2.0 * fast) + (b + c) * jnp.sin(2.0 * fast)) * scale).imag
    sine = jnp.sqrt(jnp.maximum(1.0 - cosine**2, 0.0))
    delta = 2.0 * jnp.arctan2(jnp.where(along < 0, sine, -sine), cosine)
    turns = (fixed_axis_retardance(sx, sy, plates, wavelength) - delta) / (2.0 * jnp.pi)
    return delta + 2.0 * jnp.pi * jax.lax.stop_gradient(jnp.round(turns))
