"""Wave plates: crystal layers in contact, solved as plane waves (equations: `plates`).

Layers      the optic axis of a layer has the azimuth fast axis + axis and leaves the surface by the angle cut.
Dispersion  n_e − n_o → (n_e − n_o) (1 + a u + b u² + c u³), u = λ − 0.62 µm: difference of a crystal, or of the
            catalogue of a design program, from the published curve; at 0.62 µm it is degenerate with thickness.
Thermal     n_e − n_o → (n_e − n_o) (1 − thermal · b · (T − 10 °C)), b the published change per kelvin.
Air gap     diattenuator D = contrast · cos(4π gap cos ϑ / λ) along the fast axis, directly ahead of the plate;
            ϑ angle of the ray in air.
Sources     Etzel, Rose & Wang 2000, Appl. Opt. 39, 5796 (thermal); Clarke 2005, A&A 434, 377 (fringes).
Limits      a plate without layers is the identity.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from walop_jax.io.errors import nearest
from walop_jax.model import materials, mueller, plates
from walop_jax.model.compiled import need_float64
from walop_jax.model.conventions import REFERENCE_WAVELENGTH
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.materials import REFERENCE_TEMPERATURE
from walop_jax.model.mueller import Real
from walop_jax.model.parameters import Component, Parameter, Scalar, number
from walop_jax.model.ray import Conditions, Ray

Known = dict[tuple[str, int], tuple[Real, Real]]
"""Ordinary and extraordinary indices by crystal and array of wavelengths (its `id`, while the rays live)."""
CROSSED = 1.5
"""Degrees off 0° or 90° between axes up to which layers by themselves interfere weakly: sin² of twice that is 0.003."""
MODELS = {"waves": plates.stack_mueller, "fixed_axis": plates.fixed_axis_mueller}


class Grown(Component):
    """A change of a number of a plate that grows with the conditions: `size` × the factors of `change`.

    `reading` is the angle (deg) at which a moving plate stands. Example: `axis of half1.plate * kelvin` adds `size`
    degrees to the axis for every kelvin.
    """

    size: Scalar
    reading: Scalar
    change: Any = eqx.field(static=True)


class Layer(Component):
    """One crystal of a plate."""

    name: str = eqx.field(static=True, default="")
    material: str = eqx.field(static=True, default="quartz")
    thickness: Scalar = number("um", "thickness")
    axis: Scalar = number("deg", "optic axis, from the fast axis of the plate")
    cut: Scalar | None = number("deg", "optic axis out of the surface", default=None)
    slope: Scalar | None = number("um-1", "dispersion: a of n_e − n_o", default=None)
    bend: Scalar | None = number("um-2", "dispersion: b of n_e − n_o", default=None)
    twist: Scalar | None = number("um-3", "dispersion: c of n_e − n_o", default=None)
    grown: tuple[Grown, ...] = ()
    declared: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        if self.material not in materials.CRYSTALS:
            raise ValueError(
                f"there is no crystal {self.material!r}; {nearest(self.material, materials.CRYSTALS)}"
            )

    def waves(self, wavelength: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Retardance along the normal, in waves, at wavelengths (µm); smaller for an axis out of the surface."""
        birefringence = materials.CRYSTALS[self.material].birefringence(wavelength)
        u = wavelength - REFERENCE_WAVELENGTH
        changes = enumerate((self.slope, self.bend, self.twist), start=1)
        factor = 1.0 + sum((float(c) * u**k for k, c in changes if c is not None), np.zeros_like(u))
        return np.abs(birefringence * factor) * abs(float(self.thickness)) / wavelength

    def labels(self, field: str) -> tuple[str, ...]:
        """The parameter `thickness` has the name of the layer itself: `half1.plate.mgf2`."""
        return ("",) if field == "thickness" else (field,)


class AirGap(Component):
    """An air gap ahead of a plate, which makes fringes of polarised light."""

    contrast: Scalar = number("", "diattenuation at a maximum")
    gap: Scalar = number("um", "thickness of the air")
    longest: float = eqx.field(static=True, default=0.0)  # µm: largest gap for the wavelength nodes


class WavePlate(Element):
    """Crystal layers in contact, in air, faces normal to the axis of the instrument."""

    layers: tuple[Layer, ...] = ()
    axis: Scalar = number("deg", "fast axis, from +X toward +Y")
    thermal: Scalar | None = number("", "thermal change, 1 as published", default=None)
    air_gaps: tuple[AirGap, ...] = ()
    grown: tuple[Grown, ...] = ()
    model: str = eqx.field(static=True, default="waves")
    always_in: bool = eqx.field(static=True, default=False)

    kind: ClassVar[str] = "wave_plate"
    period: ClassVar[float | None] = 360.0  # its own `turned` keeps the reading for factors of that angle
    reading_unit: ClassVar[str] = "deg"
    reference: ClassVar[str] = "Born & Wolf, Principles of Optics, ch. 15; Yeh 1980, Surf. Sci. 96, 41"

    def turned(self, angle: float) -> Self:
        """The plate turned by `angle` (deg); numbers that grow with a reading get that reading."""
        plate = super().turned(angle)
        if not any(component.grown for component in (self, *self.layers)):
            return plate
        layers = tuple(dataclasses.replace(layer, grown=_read_at(layer, angle)) for layer in self.layers)
        return dataclasses.replace(plate, grown=_read_at(self, angle), layers=layers)

    def position(self, angle: float | None) -> float | None:
        """The angle (deg) of the plate for a reading; 0 for a plate that is always in the beam, whatever the header
        says.
        """
        return 0.0 if angle is None and self.always_in else angle

    @property
    def path_difference(self) -> float:
        """Twice the thickest air gap (µm): light goes there and back."""
        return 2.0 * max((gap.longest for gap in self.air_gaps), default=0.0)

    @property
    def materials(self) -> tuple[str, ...]:
        """The crystals of the layers."""
        return tuple(layer.material for layer in self.layers)

    def retardances(self, wavelength: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], ...]:
        """Retardance of the plate in waves at wavelengths (µm), and the sum of the magnitudes of all layers.

        Layers that lie across the first one count negative.
        """
        waves = [layer.waves(wavelength) for layer in self.layers]
        if not waves:
            return ()
        turned = np.array([float(layer.axis) - float(self.layers[0].axis) for layer in self.layers])
        away = np.abs((turned + 45.0) % 90.0 - 45.0)
        sign = np.where(np.abs((turned + 90.0) % 180.0 - 90.0) < 45.0, 1.0, -1.0)
        sum_of_all = np.sum(waves, axis=0)
        return np.abs(sign @ np.array(waves)) if (away < CROSSED).all() else sum_of_all, sum_of_all

    def crystals(self, ray: Ray, indices: Known | None = None) -> tuple[plates.Plate, ...]:
        """The layers at the wavelengths of a ray; `indices` caches indices of refraction between plates."""
        crystals, indices = [], {} if indices is None else indices
        for layer in self.layers:
            crystal, case = materials.CRYSTALS[layer.material], (layer.material, id(ray.wavelength))
            if case not in indices:
                indices[case] = (
                    crystal.ordinary.refractive_index(ray.wavelength),
                    crystal.extraordinary.refractive_index(ray.wavelength),
                )
            ordinary, extraordinary = indices[case]
            changes = (layer.slope, layer.bend, layer.twist)
            if any(change is not None for change in changes):
                u = ray.wavelength - REFERENCE_WAVELENGTH
                factor = 1.0 + sum(c * u**k for k, c in enumerate(changes, start=1) if c is not None)
                extraordinary = ordinary + (extraordinary - ordinary) * factor
            thermal = _number(self, "thermal", ray)
            if thermal is not None:
                warmer = thermal * (ray.conditions.smooth("temperature") - REFERENCE_TEMPERATURE)
                extraordinary = ordinary + (extraordinary - ordinary) * (1.0 - crystal.thermal * warmer)
            axis = jnp.deg2rad(_number(self, "axis", ray) + _number(layer, "axis", ray))
            cut = _number(layer, "cut", ray)
            cut = None if cut is None else jnp.deg2rad(cut)
            crystals.append(
                plates.Plate(_number(layer, "thickness", ray), ordinary, extraordinary, axis, cut)
            )
        return tuple(crystals)

    def mueller(self, ray: Ray) -> Mueller | None:
        """Mueller matrices (n, 4, 4) of the plate with the air gaps ahead of it."""
        return self.solved([(self, ray)])[0]

    def retardance(
        self,
        incidence: ArrayLike,
        azimuth: ArrayLike,
        wavelength: ArrayLike,
        temperature: float = REFERENCE_TEMPERATURE,
    ) -> Real:
        """Retardance (deg, not modulo 360) for rays in air at an angle `incidence` (deg) to the normal, differentiable.

        `azimuth` (deg) of the plane of incidence counts from +X toward +Y, `wavelength` is in µm, the temperature in
        Celsius. Arrays broadcast. Positive is a lead of the wave along the fast axis of the last layer.
        Raises ValueError for a plate without layers, RuntimeError when float64 is switched off.
        """
        need_float64("the retardance")
        if not self.layers:
            raise ValueError(f"element {self.name!r} has no layers, hence no retardance")
        incidence, azimuth, wavelength = jnp.broadcast_arrays(
            *(jnp.asarray(v, float) for v in (incidence, azimuth, wavelength))
        )
        sine, direction = jnp.sin(jnp.deg2rad(incidence)), jnp.deg2rad(azimuth)
        planned = {"temperature": jnp.full_like(wavelength, temperature)}
        ray = Ray.entering(sine, sine, (wavelength, Conditions(jnp.zeros_like(wavelength), planned)))
        kx, ky = sine * jnp.cos(direction), sine * jnp.sin(direction)
        crystals = self.crystals(ray.toward(kx, ky))
        return jnp.rad2deg(plates.stack_retardance(kx, ky, crystals, wavelength))

    @classmethod
    def solved(cls, cases: Sequence[tuple[WavePlate, Ray]]) -> list[Mueller | None]:
        """Mueller matrices of several plates, in the order of `cases`.

        Plates with equal numbers of layers are rows of the same arrays: one computation, compiled once.
        """
        result: list[Mueller | None] = [None] * len(cases)
        groups: dict[tuple[int, str], list[int]] = {}
        for i, (plate, _) in enumerate(cases):
            if plate.layers:
                groups.setdefault((len(plate.layers), plate.model), []).append(i)
        for (_, model), members in groups.items():
            chosen = [cases[i] for i in members]
            for i, matrix in zip(members, _solved_together(chosen, model), strict=True):
                plate, ray = cases[i]
                for gap in plate.air_gaps:  # ahead of the layers: light meets it first
                    axis = jnp.deg2rad(_number(plate, "axis", ray) + _number(plate.layers[0], "axis", ray))
                    d = gap.contrast * fringe(gap.gap, ray)
                    matrix = matrix @ mueller.diattenuator(d * jnp.cos(2.0 * axis), d * jnp.sin(2.0 * axis))
                result[i] = matrix
        return result


def _number(part: WavePlate | Layer, name: str, ray: Ray) -> Any:
    """The value of a number of a plate or a layer for a ray, its growth included; None for an absent number."""
    value = getattr(part, name)
    for term in part.grown:
        if term.change.kind == name:
            by = term.size * term.change.in_train(ray, term.reading)
            value = by if value is None else value + by
    return value


def _read_at(part: WavePlate | Layer, angle: float) -> tuple[Grown, ...]:
    return tuple(dataclasses.replace(term, reading=term.reading + angle) for term in part.grown)


def _solved_together(cases: Sequence[tuple[WavePlate, Ray]], model: str) -> Float[Array, "c n 4 4"]:
    nodes = jnp.shape(cases[0][1].wavelength)

    def together(*values: Real) -> Float[Array, "c n"]:
        """Rows case by case; a single row for common arrays, a single column for numbers."""
        if all(value is values[0] for value in values):
            return jnp.atleast_1d(values[0])[None]
        shape = nodes if any(jnp.ndim(value) for value in values) else (1,)
        return jnp.stack([jnp.broadcast_to(value, shape) for value in values])

    indices: Known = {}
    stacks = plates.alike([plate.crystals(ray, indices) for plate, ray in cases])
    kx, ky, wavelength = (
        together(*(getattr(ray, name) for _, ray in cases)) for name in ("kx", "ky", "wavelength")
    )
    return MODELS[model](kx, ky, jax.tree.map(together, *stacks), wavelength)


def fringe(gap: Real, ray: Ray) -> Real:
    """Fringes of an air gap of some thickness (µm) at the wavelengths of a ray, 1 at a maximum."""
    return jnp.cos(4.0 * jnp.pi * gap * ray.kz / ray.wavelength)
