"""Effects of plates, bands and field: identities, hand-made numbers, eigenvectors for cut axes."""

from __future__ import annotations

import dataclasses

import builders
import effect_scenes as scenes
import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.model import light, materials, mueller, plates
from walop_jax.model.effects import effect_by_name
from walop_jax.model.elements.wave_plate import AirGap, Layer, WavePlate
from walop_jax.model.planning import plan_for
from walop_jax.model.plates import Plate
from walop_jax.model.ray import Conditions, Ray

LINE = 0.61


def make(name: str, **values):
    return effect_by_name(name).of(scenes.CONTEXT, **values)


def rows(device, *, x=0.1, y=-0.2, settings=(None,), band=None, **exposure) -> np.ndarray:
    """Mueller rows (band, row, Stokes) at a field point, in the order of `settings`.

    Rows are S0 and what is analysed in the first half, then the same in the second.
    """
    exposures = builders.exposures(
        *({} | exposure | ({} if s is None else {"chwp_angle": s}) for s in settings)
    )
    layout = plan_for(device, exposures, {"band": band or builders.monochromatic(LINE)})
    found = np.asarray(light.band_rows(device, layout, jnp.asarray(x), jnp.asarray(y)))
    return found[layout.band_of[:, 0]]


def straight(**options):
    """An instrument without wedges: the middle of the field is at normal incidence."""
    return builders.without_wedges(builders.south(**options))


def plate(device, name, *, kx=0.0, lam=LINE, temperature=10.0) -> np.ndarray:
    """Mueller matrix of a plate of the patched instrument in monochromatic light."""
    one = jnp.ones(1)
    conditions = Conditions(0.0 * one, {"temperature": temperature * one})
    zero = jnp.asarray(0.0)
    ray = Ray(zero, zero, jnp.asarray(kx), zero, (lam * one, conditions))
    return np.asarray(element(device, name).mueller(ray))[0]


def element(device, name):
    """An element of the patched instrument by its place, such as "half1.plate"."""
    *where, name = name.split(".")
    patched = device.patched()
    holder = next(arm for arm in patched.arms if arm.name == where[0]) if where else patched
    return next(one for one in holder.elements if one.name == name)


@pytest.mark.parametrize(("name", "half"), [("hwp1_axis", 0), ("hwp2_axis", 1)])
def test_turned_plate_at_normal_incidence(name, half):
    """R(−a) M R(a) with the matrix of the plate as it was; the other half does not care."""
    angle = 3.0
    plain, turned = straight(), straight(effects=(make(name, angle=angle),))
    there, back = (np.asarray(mueller.rotation(jnp.asarray(s * np.deg2rad(angle)))) for s in (1.0, -1.0))
    keys = ("half1.plate", "half2.plate")
    mine, other = keys[half], keys[1 - half]
    assert plate(turned, mine) == pytest.approx(back @ plate(plain, mine) @ there, abs=1e-12)
    assert np.array_equal(plate(turned, other), plate(plain, other))
    # Rows of the light path: those of the plates, S0 and S1, per unit of what each half gets.
    found = rows(turned, x=0.0, y=0.0)[0]
    assert found == pytest.approx(np.concatenate([plate(turned, key)[:2] for key in keys]), abs=1e-12)


def test_chwp_axis_is_its_setting():
    found = rows(builders.south(effects=(make("chwp_axis", angle=2.0),)), settings=(45.0, None))
    assert found == pytest.approx(rows(builders.south(), settings=(47.0, None)), abs=1e-13)


def test_chwp_in_beam_is_a_plate_at_zero():
    found = rows(builders.south(effects=(make("chwp_in_beam"),)), settings=(None, 45.0))
    assert found == pytest.approx(rows(builders.south(), settings=(0.0, 45.0)), abs=1e-15)


def test_chwp_thickness_adds_to_the_base_model():
    thick = builders.with_plates(builders.south(), 2405.0, 1933.0, ("chwp",))
    found = rows(builders.south(effects=(make("chwp_thickness", mgf2=3.0, quartz=-2.0),)), settings=(45.0,))
    assert found == pytest.approx(rows(thick, settings=(45.0,)), abs=1e-14)


def test_uncrossed_plates_add_their_retardance():
    """Turned by −90° the MgF2 lies parallel to the quartz: 2π (d₁Δn₁ + d₂Δn₂)/λ instead of the difference."""
    lam = jnp.asarray(LINE)
    quartz = float(materials.QUARTZ_E.refractive_index(lam) - materials.QUARTZ_O.refractive_index(lam))
    mgf2 = float(materials.MGF2_E.refractive_index(lam) - materials.MGF2_O.refractive_index(lam))
    matrix = plate(straight(effects=(make("hwp1_crossing", angle=-90.0),)), "half1.plate")
    delta = 2 * np.pi * (2407.0 * quartz + 1930.0 * mgf2) / LINE
    assert matrix[2, 2] / matrix[0, 0] == pytest.approx(np.cos(delta), abs=1e-4)  # Fresnel losses: 1e-5
    assert abs(matrix[2, 3]) / matrix[0, 0] == pytest.approx(abs(np.sin(delta)), abs=1e-4)


def stack(quartz=2407.0, mgf2=1930.0, lam=0.62) -> tuple[Plate, ...]:
    lam, zero = jnp.array([lam]), jnp.zeros(1)
    return (
        Plate(
            jnp.asarray(quartz),
            materials.QUARTZ_O.refractive_index(lam),
            materials.QUARTZ_E.refractive_index(lam),
            zero,
        ),
        Plate(
            jnp.asarray(mgf2),
            materials.MGF2_O.refractive_index(lam),
            materials.MGF2_E.refractive_index(lam),
            zero + 0.5 * jnp.pi,
        ),
    )


def crystals(device, name, *, temperature=10.0, lam=0.62) -> tuple[Plate, ...]:
    """Layers of a plate of the patched instrument."""
    one = jnp.ones(1)
    conditions = Conditions(0.0 * one, {"temperature": temperature * one})
    zero = jnp.asarray(0.0)
    return element(device, name).crystals(Ray(zero, zero, zero, zero, (lam * one, conditions)))


@pytest.mark.parametrize("name", ["chwp", "half1.plate", "half2.plate"])
def test_temperature_changes_retardance_by_published_amount(name):
    """0.84° per kelvin for 1.93 mm of MgF2 against 2.41 mm of quartz at 0.62 µm (NIST coefficients)."""
    device = builders.south(effects=(make("hwp_temperature", coefficient=1.0),))

    def retardance(temperature):
        warm = crystals(device, name, temperature=temperature)
        quartz, mgf2 = (float(p.thickness * (p.extraordinary - p.ordinary)[0]) for p in warm)
        return 360.0 * (mgf2 - quartz) / 0.62

    assert retardance(11.0) - retardance(10.0) == pytest.approx(0.84, abs=0.01)
    assert retardance(10.0) == pytest.approx(360.0 * (22.7506 - 21.8074) / 0.62, abs=2.0)


def test_temperature_of_the_exposure_reaches_the_plates():
    """Rows at 25 °C are those of plates whose birefringence is smaller by 15 · 1.23e-4 and 15 · 5.37e-5.

    To first order in the change: n_e − n_o enters with its thickness, and with the bending of the rays (1e-5).
    """
    warm = rows(builders.south(effects=(make("hwp_temperature", coefficient=1.0),)), temp=25.0)
    thin = builders.with_plates(builders.south(), 2407.0 * (1 - 15 * 1.23e-4), 1930.0 * (1 - 15 * 5.37e-5))
    cold = rows(builders.south())
    assert np.abs(warm - cold).max() > 0.05
    assert warm == pytest.approx(rows(thin), abs=3e-4)


@pytest.mark.parametrize(("name", "axis"), [("half1.plate", 0.0), ("half2.plate", 22.5), ("chwp", 0.0)])
def test_etalon_by_hand(name, axis):
    """What stands ahead of the plate: contrast along its fast axis, one fringe for 4π gap / λ = 2π."""
    device = builders.south(effects=(make("etalon", contrast=0.01, gap=0.31),))

    def ahead(sine):
        before, after = (plate(one, name, kx=sine, lam=0.62) for one in (builders.south(), device))
        return np.linalg.solve(before, after)[0]

    along, across = np.cos(2 * np.deg2rad(axis)), np.sin(2 * np.deg2rad(axis))
    assert ahead(0.0) == pytest.approx([1.0, 0.01 * along, 0.01 * across, 0.0], abs=1e-14)
    oblique = ahead(np.sin(np.pi / 3))  # cos 60° = ½
    assert oblique == pytest.approx([1.0, -0.01 * along, -0.01 * across, 0.0], abs=1e-14)


def test_the_air_gap_stands_ahead_of_its_plate():
    """Unpolarised light gets 2 % of polarisation along the first layer, 10°, and the plate then turns that.

    Behind the plate the gap would leave 2 % along 10°. The layers are not crossed: a plate of one axis commutes with
    the gap.
    """
    layers = (Layer(name="a", thickness=30.0), Layer(name="b", material="mgf2", thickness=20.0, axis=50.0))
    bare = WavePlate(name="plate", layers=layers, axis=10.0)
    gap = dataclasses.replace(
        bare, air_gaps=(AirGap(contrast=0.02, gap=0.31),)
    )  # 4π · 0.31 / 0.62: a maximum
    ray = Ray.entering(jnp.zeros(()), jnp.zeros(()), (jnp.array([0.62]), Conditions(jnp.zeros(1), {})))
    plate, whole = (np.asarray(one.mueller(ray))[0] for one in (bare, gap))
    polarised = np.array([1.0, 0.02 * np.cos(np.deg2rad(20.0)), 0.02 * np.sin(np.deg2rad(20.0)), 0.0])
    assert np.abs(plate @ polarised - polarised).max() > 0.005
    np.testing.assert_allclose(whole @ [1.0, 0.0, 0.0, 0.0], plate @ polarised, atol=1e-14)


def test_etalon_from_its_linear_directions():
    kind = effect_by_name("etalon")
    group = kind.probes(scenes.CONTEXT)[11]
    gap, lam = float(group[0].gap), 0.62
    wanted = gap + 0.05
    phase = 4 * np.pi * (wanted - gap) / lam
    found = kind.combine(group, (0.002 * np.cos(phase), 0.002 * np.sin(phase)))
    assert float(found.contrast) == pytest.approx(0.002)
    assert float(found.gap) == pytest.approx(wanted)


def test_wavelength_nodes_follow_the_etalon():
    """Band mean of cos(4π gap/λ) for a gap of 50 µm against the whole table."""
    curve = builders.broad_band()
    layout = plan_for(builders.south(effects=(make("etalon"),)), builders.exposures({}), {"band": curve})
    fine = np.linspace(curve.wavelength[0], curve.wavelength[-1], 200_001)
    weight = np.interp(fine, curve.wavelength, curve.throughput)
    exact = np.sum(weight * np.cos(4 * np.pi * 50.0 / fine)) / weight.sum()
    node, share = np.asarray(layout.wavelength), np.asarray(layout.node_weight[0])
    assert share @ np.cos(4 * np.pi * 50.0 / node) == pytest.approx(exact, abs=1e-4)


def test_wollaston_turned_by_90_degrees_swaps_the_cameras():
    turned = rows(builders.south(effects=(make("wollaston_axis", angle=90.0),)))
    plain = rows(builders.south())
    assert turned[:, 1::2] == pytest.approx(-plain[:, 1::2], abs=1e-15)
    assert np.array_equal(turned[:, ::2], plain[:, ::2])


def test_wollaston_at_45_degrees_sees_u():
    """Identity in front (plates of no thickness): q = 1 splits no longer, u = 1 goes into N0 and N2."""
    device = straight(effects=(make("wollaston_axis", angle=45.0),))
    device = builders.with_plates(device, 0.0, 0.0, ("half1.plate",))
    row = rows(device, x=0.0, y=0.0)[0, 1]
    assert row / row[2] == pytest.approx([0.0, 0.0, 1.0, 0.0], abs=1e-4)


@pytest.mark.parametrize("teff", [float("nan"), 4000.0])
def test_filter_shift_is_a_shifted_table(teff):
    curve = builders.curve([0.585, 0.60, 0.64, 0.655], [0.2, 1.0, 0.9, 0.1])
    shifted = dataclasses.replace(curve, wavelength=curve.wavelength + 0.004)
    found = rows(builders.south(effects=(make("filter_shift", wavelength=0.004),)), band=curve, teff=teff)
    assert found == pytest.approx(rows(builders.south(), band=shifted, teff=teff), abs=1e-9)


def test_filter_shift_leaves_narrow_bands_alone():
    narrow = builders.curve([0.60, 0.605, 0.61], [0.0, 1.0, 0.0])
    found = rows(builders.south(effects=(make("filter_shift", wavelength=0.004),)), band=narrow)
    assert np.array_equal(found, rows(builders.south(), band=narrow))


def test_flexure_moves_the_field_with_hour_angle():
    device = builders.south(effects=(make("flexure", rate_x=0.01, rate_y=-0.02),))
    found = rows(device, x=0.1, y=0.05, ha=2.0)
    assert found == pytest.approx(rows(builders.south(), x=0.12, y=0.01), abs=1e-14)
    assert rows(device, x=0.1, y=0.05, ha=0.0) == pytest.approx(
        rows(builders.south(), x=0.1, y=0.05), abs=1e-14
    )


# ------------------------------------------------------------------------------ optic axes out of the surface


def berreman(sx, sy, media, wavelength) -> np.ndarray:
    """Mueller matrix of plates from the eigenvectors of Berreman's 4 × 4 matrices, single pass; numpy alone.

    `media` are (thickness, dielectric tensor). Modes of Ψ = (Ex, Ey, Hx, Hy) with k_z from the eigenvalues.
    """

    def modes(eps):
        kx, ky, e33 = sx, sy, eps[2, 2]
        # Ez = −(ε31 Ex + ε32 Ey + kx Hy − ky Hx)/ε33, Hz = kx Ey − ky Ex
        ez = -np.array([eps[2, 0], eps[2, 1], -ky, kx]) / e33
        hz = np.array([-ky, kx, 0.0, 0.0])
        ex, ey, hx, hy = np.eye(4)
        # ∇×E and ∇×H: kz Ex = Hy + kx Ez, kz Ey = −Hx + ky Ez, kz Hx = kx Hz − Dy, kz Hy = ky Hz + Dx
        dx = eps[0, 0] * ex + eps[0, 1] * ey + eps[0, 2] * ez
        dy = eps[1, 0] * ex + eps[1, 1] * ey + eps[1, 2] * ez
        value, vector = np.linalg.eig(np.array([hy + kx * ez, -hx + ky * ez, kx * hz - dy, ky * hz + dx]))
        order = np.argsort(value.real)
        return value[order].real, vector[:, order]

    kz = np.sqrt(1 - sx**2 - sy**2)
    axes = np.array(
        [[1 - sx**2 / (1 + kz), -sx * sy / (1 + kz), -sx], [-sx * sy / (1 + kz), 1 - sy**2 / (1 + kz), -sy]]
    )
    forward = np.array([[*e[:2], *np.cross([sx, sy, kz], e)[:2]] for e in axes]).T
    backward = np.array([[*e[:2], *np.cross([sx, sy, -kz], e)[:2]] for e in axes * [1, 1, -1]]).T
    before, jones = (forward, backward), np.eye(2, dtype=complex)
    for thickness, eps in media:
        value, vector = modes(eps)
        inside = vector[:, 2:], vector[:, :2]
        jones = np.linalg.solve(np.hstack([inside[0], -before[1]]), before[0])[:2] @ jones
        jones = np.diag(np.exp(2j * np.pi * thickness * value[2:] / wavelength)) @ jones
        before = inside
    jones = np.linalg.solve(np.hstack([forward, -before[1]]), before[0])[:2] @ jones
    pauli = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]])
    return 0.5 * np.einsum("iab,bc,jcd,ad->ij", pauli, jones, pauli, jones.conj()).real


@pytest.mark.parametrize("cuts", [(0.0, 0.0), (2.0, 0.0), (-1.0, 20.0)])
@pytest.mark.parametrize(("sx", "sy"), [(0.17, 0.0), (-0.1, 0.12), (0.0, 0.21)])
def test_cut_plates_against_eigenvectors(cuts, sx, sy):
    lam, axis = 0.62, np.deg2rad(22.5)
    tilted, media = [], []
    for plate, turn, cut in zip(stack(), (axis, axis + np.pi / 2), np.deg2rad(cuts), strict=True):
        tilted.append(plate._replace(axis=jnp.array([turn]), cut=jnp.array([cut])))
        c = np.array([np.cos(turn) * np.cos(cut), np.sin(turn) * np.cos(cut), np.sin(cut)])
        o, e = float(plate.ordinary[0]) ** 2, float(plate.extraordinary[0]) ** 2
        media.append((float(plate.thickness), o * np.eye(3) + (e - o) * np.outer(c, c)))
    found = plates.stack_mueller(jnp.array([sx]), jnp.array([sy]), tuple(tilted), jnp.array([lam]))[0]
    assert np.asarray(found) == pytest.approx(berreman(sx, sy, media, lam), abs=1e-9)


def test_general_solver_without_cut_is_the_symmetric_one():
    rng = np.random.default_rng(1)
    sx, sy = jnp.asarray(rng.uniform(-0.25, 0.25, (2, 50)))
    flat = stack()
    general = tuple(p._replace(cut=jnp.zeros(1)) for p in flat)
    lam = jnp.array([0.62])
    found, expected = (np.asarray(plates.stack_mueller(sx, sy, s, lam)) for s in (general, flat))
    assert np.abs(found - expected).max() < 1e-12


def test_cut_makes_retardance_odd_in_the_field_angle():
    """0.1° in 36 waves of MgF2: about 0.57° (2 · 36 waves · 0.1° · 1° / n) per degree of incidence."""
    _, plate = stack(mgf2=36 * 0.62 / 0.011788)
    cut = plate._replace(axis=jnp.zeros(1), cut=jnp.array([np.deg2rad(0.1)]))

    def retardance(angle):
        sx = jnp.array([np.sin(np.deg2rad(angle))])
        o = np.sqrt(float(cut.ordinary[0]) ** 2 - float(sx[0]) ** 2)
        return (
            360
            * float(cut.thickness)
            / 0.62
            * (float(plates._extraordinary_kz(sx, jnp.zeros(1), cut)[0][0]) - o)
        )

    odd = 0.5 * (retardance(5.0) - retardance(-5.0)) / 5.0
    assert abs(odd) == pytest.approx(2 * 36 * 360 * np.deg2rad(0.1) * np.deg2rad(1.0) / 1.377, rel=0.02)


def test_cut_of_one_crystal():
    device = builders.south(effects=(make("hwp2_axis_cut", angle=0.5, crystal="mgf2"),))
    quartz, mgf2 = crystals(device, "half2.plate")
    assert quartz.cut is None
    assert float(mgf2.cut) == pytest.approx(np.deg2rad(0.5))
    assert all(crystal.cut is None for crystal in crystals(device, "half1.plate"))
    with pytest.raises(ValueError, match="choose quartz or mgf2"):
        make("hwp2_axis_cut", crystal="calcite")
