"""Elements that deflect rays: the mapping from field to pupil, wedges.

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

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.io.errors import nearest
from walop_jax.model import materials, mueller
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.mueller import Real
from walop_jax.model.parameters import Scalar, number
from walop_jax.model.ray import Ray


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
    """Angle (rad, from the first carried axis to the second) of the rotation of light between two directions."""
    (ax, ay, az), (bx, by, bz) = before, after
    return 2.0 * jnp.arctan2(ax * by - ay * bx, 1.0 + ax * bx + ay * by + az * bz + az + bz)


def wedge_rotation(direction: tuple[Real, Real, Real], angle: Real, index: Real) -> Real:
    """Angle (rad) by which the front face of a wedge turns light against the carried axes; the rear face adds none."""
    sx, sy = behind_wedge(direction, angle, index)
    gx, gy = sx / index, sy / index
    return transport_rotation(direction, (gx, gy, jnp.sqrt(1.0 - gx**2 - gy**2)))


# --------------------------------------------------------------------------------------------------------- the elements

FRAMES = ("kept", "turned")


class PupilMapping(Element):
    """The mapping from the field point to the direction of the collimated beam, in the pupil."""

    magnification: Scalar = number("", "field-to-pupil magnification", default=1.0)
    distortion: Scalar = number("deg-2", "cubic distortion")
    aspect: Scalar | None = number("", "magnification along Y over that along X, minus 1", default=None)

    kind: ClassVar[str] = "pupil_mapping"
    reference: ClassVar[str] = "Maharana et al. 2022, Paper II, appendix B"

    def ray(self, ray: Ray) -> Ray:
        """The ray behind the collimator."""
        kx, ky, _ = pupil_direction(
            ray.x, ray.y, self.magnification, self.distortion, 0.0 if self.aspect is None else self.aspect
        )
        return ray.toward(kx, ky)


class Wedge(Element):
    """A glass wedge: exact refraction, no loss.

    `frame` is the treatment of the plane of vibration: `kept` in the carried axes of the rays (no rotation), or
    `turned` with the ray at each face, as for light (see `wedge_rotation`). `sense` −1 reverses the wedge.
    It bends light along +X, or along `azimuth` from +X toward +Y.
    """

    angle: Scalar = number("rad", "wedge angle")
    azimuth: Scalar | None = number("deg", "where it bends light to, from +X toward +Y", default=None)
    material: str = eqx.field(static=True, default="BK7")
    frame: str = eqx.field(static=True, default=FRAMES[0])
    sense: float = eqx.field(static=True, default=1.0)

    kind: ClassVar[str] = "wedge"
    reference: ClassVar[str] = "Born & Wolf, Principles of Optics, 1.5.1"

    def __check_init__(self) -> None:
        if self.material not in materials.GLASSES:
            raise ValueError(
                f"there is no glass {self.material!r}; {nearest(self.material, materials.GLASSES)}"
            )
        if self.frame not in FRAMES:
            raise ValueError(f"frame = {self.frame!r} of a wedge must be {' or '.join(FRAMES)}")

    def labels(self, field: str) -> tuple[str, ...]:
        """The parameter `angle` has the name of the wedge itself."""
        return ("",) if field == "angle" else (field,)

    @property
    def materials(self) -> tuple[str, ...]:
        """The glass of the wedge."""
        return (self.material,)

    def ray(self, ray: Ray) -> Ray:
        """The ray behind the wedge."""
        behind = behind_wedge(self.direction(ray), self.turn, self.index(ray))
        return ray.toward(*(behind if self.azimuth is None else rotated(*behind, self.azimuth)))

    def direction(self, ray: Ray) -> tuple[Float[Array, ...], Float[Array, ...], Float[Array, ...]]:
        """The direction of a ray, with +X along the deflection by the wedge."""
        if self.azimuth is None:
            return ray.kx, ray.ky, ray.kz
        return *rotated(ray.kx, ray.ky, -self.azimuth), ray.kz

    @property
    def turn(self) -> Scalar:
        """The wedge angle (rad) with its sign, `sense` × `angle`."""
        return self.angle if self.sense == 1.0 else self.sense * self.angle

    def index(self, ray: Ray) -> Float[Array, ...]:
        """Refractive index of the glass at the wavelengths of a ray."""
        return materials.GLASSES[self.material].dispersion.refractive_index(ray.wavelength)

    def mueller(self, ray: Ray) -> Mueller | None:
        """Rotation of the plane of vibration against the carried axes; None for a kept plane."""
        if self.frame == "kept":
            return None
        return mueller.rotation(-wedge_rotation(self.direction(ray), self.turn, self.index(ray)))
