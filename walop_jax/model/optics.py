"""Geometry of the rays: from the field through the collimator and the wedges to the plates.

Pupil       (X, Y) leaves the collimator along (tan M X′, tan M (1 + a) Y′, 1), X′ = X (1 + κ r²): M magnification,
            κ distortion [deg⁻²], r² = X² + Y² [deg²], a aspect.
Wedge       exact refraction at a front face with normal n = (sin w, 0, cos w) and a rear face normal to z:
            in the glass k_g = k + (√(N² − 1 + (k·n)²) − k·n) n; behind the rear face the transverse part of k_g
            stays. N index of the glass, w wedge angle [rad]. No loss.
Rotation    at a face the plane of vibration follows the ray by the smallest rotation that takes the old direction to
            the new one. Carried axes (from z to k by the smallest rotation) do not: directions a, b and z span a
            spherical triangle, and light that goes from a to b turns by its signed area against the carried axes,
            tan(Ω/2) = z·(a × b) / (1 + a·b + a·z + b·z). Faces normal to z add nothing.
Source      vector form of Snell's law, Born & Wolf 1.5.1; mapping: Paper II, appendix B; rotation: Chipman, Lam &
            Young 2018, Polarized Light and Optical Systems, ch. 17 (parallel transport); Van Oosterom & Strackee
            1983, IEEE Trans. Biomed. Eng. 30, 125 (area).
Limits      w = 0 leaves the direction as it is; X = Y = 0 goes along z.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

Real = Float[Array, "..."]


def pupil_direction(
    x: Real, y: Real, magnification: Real, distortion: Real, aspect: Real | float = 0.0
) -> tuple[Real, Real, Real]:
    """Unit direction behind the collimator of the field point x, y (degrees)."""
    stretch = magnification * (1.0 + distortion * (x**2 + y**2)) * (jnp.pi / 180.0)
    tx, ty = jnp.tan(stretch * x), jnp.tan(stretch * (1.0 + aspect) * y)
    norm = 1.0 / jnp.sqrt(1.0 + tx**2 + ty**2)
    return tx * norm, ty * norm, norm


def rotated(kx: Real, ky: Real, angle: Real) -> tuple[Real, Real]:
    """A transverse direction turned by `angle` (deg) from +X toward +Y."""
    c, s = jnp.cos(jnp.deg2rad(angle)), jnp.sin(jnp.deg2rad(angle))
    return c * kx - s * ky, s * kx + c * ky


def behind_wedge(direction: tuple[Real, Real, Real], angle: Real, index: Real) -> tuple[Real, Real]:
    """Transverse direction (sx, sy) behind a wedge of `angle` (rad) and refractive `index`."""
    kx, ky, kz = direction
    nx, nz = jnp.sin(angle), jnp.cos(angle)
    incidence = kx * nx + kz * nz
    bend = jnp.sqrt(index**2 - 1.0 + incidence**2) - incidence
    return kx + bend * nx, ky + jnp.zeros_like(bend)


def transport_rotation(before: tuple[Real, Real, Real], after: tuple[Real, Real, Real]) -> Real:
    """Angle (rad, from the first carried axis to the second) by which light turns on the way between two directions."""
    (ax, ay, az), (bx, by, bz) = before, after
    return 2.0 * jnp.arctan2(ax * by - ay * bx, 1.0 + ax * bx + ay * by + az * bz + az + bz)


def wedge_rotation(direction: tuple[Real, Real, Real], angle: Real, index: Real) -> Real:
    """Angle (rad) by which the front face of a wedge turns light against the carried axes; the rear face adds none."""
    sx, sy = behind_wedge(direction, angle, index)
    gx, gy = sx / index, sy / index
    return transport_rotation(direction, (gx, gy, jnp.sqrt(1.0 - gx**2 - gy**2)))
