"""Elements that change where a ray goes: the mapping from field to pupil, wedges, flexure (equations: `optics`)."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.io.errors import nearest
from walop_jax.model import materials, mueller, optics
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.parameters import number
from walop_jax.model.ray import Ray

Scalar = Float[Array, ""]
FRAMES = ("kept", "turned")


class PupilMapping(Element):
    """From the field point to the direction of the collimated beam."""

    magnification: Scalar = number(unit="", about="field-to-pupil magnification", default=1.0)
    distortion: Scalar = number(unit="deg-2", about="cubic distortion")
    aspect: Scalar | None = number(
        unit="", about="magnification along Y over that along X, minus 1", default=None
    )

    kind: ClassVar[str] = "pupil_mapping"
    reference: ClassVar[str] = "Maharana et al. 2022, Paper II, appendix B"

    def ray(self, ray: Ray) -> Ray:
        """The collimated ray."""
        kx, ky, _ = optics.pupil_direction(
            ray.x, ray.y, self.magnification, self.distortion, 0.0 if self.aspect is None else self.aspect
        )
        return ray.toward(kx, ky)


class Wedge(Element):
    """A glass wedge: exact refraction, no loss.

    `frame` says what becomes of the plane of vibration: `kept` in the carried axes of the rays (no rotation), or
    `turned` with the ray at each face, as it is for light (see `optics.wedge_rotation`). `sense` −1: the other
    way round. It bends light along +X, or along `azimuth` from +X toward +Y.
    """

    angle: Scalar = number(unit="rad", about="wedge angle")
    azimuth: Scalar | None = number(
        unit="deg", about="where it bends light to, from +X toward +Y", default=None
    )
    material: str = eqx.field(static=True, default="BK7")
    frame: str = eqx.field(static=True, default=FRAMES[0])
    sense: float = eqx.field(static=True, default=1.0)

    kind: ClassVar[str] = "wedge"
    reference: ClassVar[str] = "Born & Wolf, Principles of Optics, 1.5.1"

    def __check_init__(self) -> None:
        if self.material not in materials.GLASSES:
            raise ValueError(f"unknown glass {self.material!r}; {nearest(self.material, materials.GLASSES)}")
        if self.frame not in FRAMES:
            raise ValueError(f"frame = {self.frame!r} of a wedge must be {' or '.join(FRAMES)}")

    def labels(self, field: str) -> tuple[str, ...]:
        """The angle has the name of the wedge."""
        return ("",) if field == "angle" else (field,)

    def ray(self, ray: Ray) -> Ray:
        """The ray behind the wedge."""
        behind = optics.behind_wedge(self.direction(ray), self.turn, self.index(ray))
        return ray.toward(*(behind if self.azimuth is None else optics.rotated(*behind, self.azimuth)))

    def direction(self, ray: Ray) -> tuple[Float[Array, ...], Float[Array, ...], Float[Array, ...]]:
        """The direction of a ray with +X where the wedge bends light to."""
        if self.azimuth is None:
            return ray.kx, ray.ky, ray.kz
        return *optics.rotated(ray.kx, ray.ky, -self.azimuth), ray.kz

    @property
    def turn(self) -> Scalar:
        """The angle with its sign."""
        return self.angle if self.sense == 1.0 else self.sense * self.angle

    def index(self, ray: Ray) -> Float[Array, ...]:
        """Refractive index of the glass at the wavelengths of a ray."""
        return materials.GLASSES[self.material].dispersion.refractive_index(ray.wavelength)

    def mueller(self, ray: Ray) -> Mueller | None:
        """Rotation of the plane of vibration against the carried axes; None where it is kept."""
        if self.frame == "kept":
            return None
        return mueller.rotation(-optics.wedge_rotation(self.direction(ray), self.turn, self.index(ray)))


class FieldShift(Element):
    """Field coordinates displaced: by a constant, and in proportion to the hour angle."""

    x: Scalar | None = number(unit="deg", about="displacement along X", default=None)
    y: Scalar | None = number(unit="deg", about="displacement along Y", default=None)
    rate_x: Scalar | None = number(unit="deg/h", about="displacement along X per hour", default=None)
    rate_y: Scalar | None = number(unit="deg/h", about="displacement along Y per hour", default=None)

    kind: ClassVar[str] = "field_shift"

    def ray(self, ray: Ray) -> Ray:
        """The ray from the place that the optics behind see."""
        x = ray.x if self.x is None else ray.x + self.x
        y = ray.y if self.y is None else ray.y + self.y
        if self.rate_x is not None:
            x = x + self.rate_x * ray.conditions.hour_angle
        if self.rate_y is not None:
            y = y + self.rate_y * ray.conditions.hour_angle
        x, y = jnp.broadcast_arrays(x, y)
        return ray.moved(x, y)
