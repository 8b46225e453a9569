"""What tilted rays do to the plane of vibration: wedges that turn it, axes of prisms; numbers that depend on colour.

Outside truth: vectors turned by hand, face by face, and the closed forms of the docstrings.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.instruments.description import described
from walop_jax.io.errors import DataError
from walop_jax.model import materials
from walop_jax.model.elements.geometry import PupilMapping, Wedge
from walop_jax.model.elements.simple import RadialRetarder, Rotator
from walop_jax.model.elements.wave_plate import Layer, WavePlate
from walop_jax.model.instrument import nominal_instrument
from walop_jax.model.ray import Conditions, Ray

WAVELENGTH = jnp.array([0.62])


def ray(kx, ky, wavelength=WAVELENGTH):
    return Ray(
        jnp.array(0.1),
        jnp.array(-0.2),
        jnp.array(kx),
        jnp.array(ky),
        (wavelength, Conditions(jnp.zeros(()), {})),
    )


def unit(v):
    return v / np.linalg.norm(v)


def least_rotation(before, after):
    axis, cos = np.cross(before, after), before @ after
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cos)


def carried(direction):
    turned = least_rotation(np.array([0.0, 0.0, 1.0]), direction)
    return turned[:, 0], turned[:, 1]


def refracted(direction, normal, ratio):
    along = direction @ normal
    tangential = ratio * (direction - along * normal)
    return tangential + np.sqrt(1 - tangential @ tangential) * normal


def turn(matrix):
    """Angle (rad) by which a rotation Mueller matrix turns the plane of vibration, from +X toward +Y."""
    return 0.5 * np.arctan2(matrix[2, 1], matrix[1, 1])


@pytest.mark.parametrize(("kx", "ky", "angle"), [(0.03, 0.08, 0.24), (-0.1, 0.05, -0.24), (0.0, -0.08, 0.1)])
def test_wedge_turns_light_as_faces_do_one_by_one(kx, ky, angle):
    wedge = Wedge(angle=angle, frame="turned")
    matrix = np.asarray(wedge.mueller(ray(kx, ky)))[0]
    index = float(materials.BK7.refractive_index(WAVELENGTH)[0])
    direction = np.array([kx, ky, np.sqrt(1 - kx**2 - ky**2)])
    field = carried(direction)[0]
    z = np.array([0.0, 0.0, 1.0])
    glass = refracted(direction, np.array([np.sin(angle), 0.0, np.cos(angle)]), 1 / index)
    behind = refracted(glass, z, index)
    field = least_rotation(glass, behind) @ least_rotation(direction, glass) @ field
    first, second = carried(behind)
    assert turn(matrix) == pytest.approx(np.arctan2(field @ second, field @ first), abs=1e-13)
    assert abs(turn(matrix)) > 1e-4
    # the direction is the one that the ray gets
    assert np.allclose([float(wedge.ray(ray(kx, ky)).kx[0]), float(wedge.ray(ray(kx, ky)).ky[0])], behind[:2])


def test_wedge_keeps_the_frame_unless_told():
    assert Wedge(angle=0.2).mueller(ray(0.1, 0.1)) is None
    text = described("WALOP-NORTH").text.replace('frame = "turned"', 'frame = "twisted"', 1)
    from walop_jax.instruments.description import parsed
    from walop_jax.model.instrument import build

    with pytest.raises(DataError, match="kept or turned"):
        build(parsed(text, "here"))


@pytest.mark.parametrize(("along", "sign"), [((0.0, 1.0), 1.0), ((1.0, 0.0), -1.0)])
def test_skew_is_that_of_the_axes_of_a_crystal_prism(along, sign):
    index, kx, ky = 1.6, 0.02, 0.03
    inside = np.array([kx, ky, 0.0]) / index
    inside[2] = np.sqrt(1 - inside @ inside)
    first, second = carried(inside)
    ordinary = unit(np.cross(np.array([*along, 0.0]), inside))
    angle = np.arctan((ordinary @ second) / (ordinary @ first))
    if sign < 0:  # the other beam: perpendicular to n × k
        angle = -np.arctan((ordinary @ first) / (ordinary @ second))
    skew = sign / (2 * index**2)
    assert skew * kx * ky == pytest.approx(angle, rel=2e-3)
    axes = np.asarray(Rotator(skew=skew).mueller(ray(kx, ky)))
    assert -turn(axes) == pytest.approx(angle, rel=2e-3)
    # light vibrating along the turned axis is light along +X of the turned axes
    light = np.array([1.0, np.cos(0.2), np.sin(0.2), 0.0])
    assert np.asarray(Rotator(angle=np.rad2deg(0.1)).mueller(ray(0.0, 0.0))) @ light == pytest.approx(
        [1, 1, 0, 0]
    )


def test_dispersion_changes_the_retardance_by_its_polynomial():
    wavelength = jnp.array([0.54, 0.62, 0.7])
    layer = Layer(name="q", material="quartz", thickness=100.0)
    changed = dataclasses.replace(layer, slope=jnp.array(0.1), bend=jnp.array(-2.0), twist=jnp.array(3.0))
    index = [materials.CRYSTALS["quartz"].ordinary, materials.CRYSTALS["quartz"].extraordinary]
    difference = [np.asarray(n.refractive_index(wavelength)) for n in index]
    for made, factor in (
        (layer, np.ones(3)),
        (changed, [1 - 0.008 - 0.0128 - 0.001536, 1, 1 + 0.008 - 0.0128 + 0.001536]),
    ):
        matrix = np.asarray(WavePlate(layers=(made,)).mueller(ray(0.0, 0.0, wavelength)))
        delta = (
            2 * np.pi * 100.0 * (difference[1] - difference[0]) * np.array(factor) / np.asarray(wavelength)
        )
        assert matrix[:, 3, 3] / matrix[:, 0, 0] == pytest.approx(np.cos(delta), abs=2e-4)  # faces: 1e-5


def test_radial_retarder_changes_with_colour():
    wavelength = jnp.array([0.54, 0.62, 0.7])
    made = RadialRetarder(delta=0.01, slope=0.2, bend=-1.0)
    matrix = np.asarray(made.mueller(ray(0.0, 0.0, wavelength)))
    waves = np.array([0.01 - 0.016 - 0.0064, 0.01, 0.01 + 0.016 - 0.0064])
    assert matrix[:, 3, 3] == pytest.approx(np.cos(2 * np.pi * waves * (0.1**2 + 0.2**2) / 0.09), abs=1e-12)
    assert np.asarray(RadialRetarder(delta=0.01).mueller(ray(0.0, 0.0))).shape == (4, 4)


def test_aspect_stretches_the_pupil_along_y():
    plain, tall = PupilMapping(magnification=20.0), PupilMapping(magnification=20.0, aspect=0.01)
    a, b = plain.ray(ray(0.0, 0.0)), tall.ray(ray(0.0, 0.0))
    assert float(b.kx / b.kz) == pytest.approx(float(a.kx / a.kz), abs=1e-15)
    assert np.arctan(float(b.ky / b.kz)) == pytest.approx(1.01 * np.arctan(float(a.ky / a.kz)), rel=1e-12)


def test_north_has_these_elements():
    north = nominal_instrument("WALOP-NORTH")
    assert [e.kind for e in north.elements] == [
        "polariser",
        "collimator",
        "radial_retarder",
        "pupil_mapping",
        "wave_plate",
    ]
    assert [[e.kind for e in arm.elements] for arm in north.arms] == [
        ["wedge", "wave_plate", "rotator", "field_diattenuator", "analyser"]
    ] * 2
