"""What a user adds from outside the package, each as a file of its own beside this one, and how long it is."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import builders
import jax.numpy as jnp
import numpy as np
import pytest
from outside.blue_depolariser import BlueDepolariser
from outside.lossy_wedge import LossyWedge
from outside.twilight import Twilight

from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import refit
from walop_jax.model import light, materials, plates
from walop_jax.model.effects import EFFECTS
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.elements import geometry
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.planning import plan_for
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate, truth_values

HERE = Path(__file__).parent
SMALL = ObservingPlan(
    grid=4, standard_grid=2, polariser_angles=polariser_turn(8), moon_patches=2, standards=4, unpolarised=1
)


def matrix(instrument: Instrument, wavelength: float, x: float, y: float) -> np.ndarray:
    """Rows (m_1, m_q, m_u) of the instrument matrix in a monochromatic band."""
    curves = {"band": builders.monochromatic(wavelength)}
    plan = plan_for(instrument, builders.exposures({"kind": "flux"}), curves)
    vectors = builders.vectors(instrument, plan, x, y)[0, 0]
    return np.asarray(light.instrument_matrix(jnp.asarray(vectors), instrument.cameras.pairs))


# ----------------------------------------------------------------------- an effect where none acts today


def test_effect_at_a_new_place_by_closed_form():
    """Depolarisation directly ahead of a plate takes its share of m32 and m33, and of nothing else."""
    plain = dataclasses.replace(builders.south(np.random.default_rng(3)), effects=()).changed(
        "collimator", diattenuation=0.0, q=0.0, u=0.0
    )
    lossy = dataclasses.replace(plain, effects=(LossyWedge(share=0.03),))
    before, after = (matrix(one, 0.62, 0.12, -0.2) for one in (plain, lossy))
    np.testing.assert_allclose(after[0], before[0], atol=1e-14)
    np.testing.assert_allclose(after[1, 1:], 0.97 * before[1, 1:], atol=1e-13)


def test_effect_of_ones_own_is_simulated_and_fitted():
    calset, _ = simulate(SMALL, seed=7, effects=(LossyWedge(share=0.02),))
    model = base_model(calset)
    model = with_effects(model, [LossyWedge()], effect_context(model.template, calset.exposures))
    result = refit(calset, model)
    i = model.index("lossy_wedge.share")
    assert result.with_verdict().trusted
    assert abs(result.values[i] - 0.02) < 5 * result.sigma[i]
    assert result.sigma[i] < 0.002


# ----------------------------------------------------- an element of a new kind, arms with other plates


def other_arms() -> Instrument:
    return Instrument.read(HERE / "other_arms.toml", elements=[BlueDepolariser])


def test_other_arms_are_the_product_of_their_plates():
    """The first arm multiplied out by hand, at one wavelength: haze, plate ahead of the wedge, wedge, second plate."""
    lam, x, y = 0.61, 0.1, -0.15
    instrument = other_arms().changed("collimator", diattenuation=0.0)
    kx, ky, kz = geometry.pupil_direction(
        jnp.asarray(x), jnp.asarray(y), jnp.asarray(15.63), jnp.asarray(0.02)
    )

    def stack(kx, ky, *layers):
        made = []
        for name, thickness, axis in layers:
            crystal, wave = materials.CRYSTALS[name], jnp.asarray(lam)
            made.append(
                plates.Plate(
                    jnp.asarray(thickness),
                    crystal.ordinary.refractive_index(wave),
                    crystal.extraordinary.refractive_index(wave),
                    jnp.deg2rad(jnp.asarray(axis)),
                )
            )
        return np.asarray(plates.stack_mueller(kx, ky, tuple(made), jnp.asarray(lam)))

    first = stack(kx, ky, ("mgf2", 1900.0, 100.0), ("quartz", 2350.0, 10.0))
    glass = materials.BK7.refractive_index(jnp.asarray(lam))
    behind = geometry.behind_wedge((kx, ky, kz), jnp.asarray(-0.23), glass)
    second = stack(*behind, ("quartz", 51.3, 30.0))
    kept = 1.0 - 0.01 * (0.62 / lam) ** 4
    whole = second @ first @ np.diag([1.0, kept, kept, 1.0])
    up, down = (0.5 * (whole[0] + sign * 0.999 * whole[1]) for sign in (1, -1))
    expected = (up - down)[:3] / (up + down)[0]
    np.testing.assert_allclose(matrix(instrument, lam, x, y)[0], expected, atol=1e-12)


def test_unknown_kind_of_element_lists_the_nearest():
    with pytest.raises(ValueError, match="there is no kind of element 'blue_depolariser'"):
        Instrument.read(HERE / "other_arms.toml")


# ----------------------------------------------------------- two cameras, two turning elements, lamps


@pytest.fixture(scope="module")
def two_beams() -> ObservingPlan:
    return ObservingPlan(
        Instrument.read(HERE / "two_cameras.toml"), grid=3, polariser_angles=polariser_turn(5), moon_patches=0,
        standards=0, filters=("SDSS-r",), lamps=1,
        moving={"HWP": (0.0, 20.0, 45.0, 70.0), "DEROT": (0.0, 30.0, 75.0)},
    )  # fmt: skip


def test_two_cameras_are_simulated_and_fitted(two_beams):
    calset, truth = simulate(two_beams, seed=1)
    assert calset.cameras == 2
    result = refit(calset, base_model(calset, two_beams.design))
    assert result.with_verdict().trusted
    rows = calset.intensities.rows
    free = len(result.model.free)
    priors = sum(p.prior is not None for p in result.model.parameters)
    assert result.dof == rows + priors - free  # one number per row: two cameras, one flux
    # Fluxes take up what both cameras have in common, field by field: only their ratio is a parameter.
    assert not any(
        result.model[name].free for name in result.model.names if name.startswith("throughput.n0.")
    )
    true = truth_values(truth)
    pulls = [
        (value - true[p.name]) / sigma
        for p, value, sigma in zip(result.model.parameters, result.values, result.sigma, strict=True)
        if sigma > 0
    ]
    assert np.abs(pulls).max() < 4.5


@pytest.mark.long
def test_two_cameras_are_diagnosed(two_beams):
    """An encoder error is named; effects of elements that are not there are no candidates."""
    wobble = next(kind for kind in EFFECTS if kind.name == "clp_wobble")
    hidden = wobble.of(two_beams.context(), amplitude=0.3, phase=1.0)
    calset, _ = simulate(two_beams, seed=1, effects=(hidden,))
    names = {"clp_wobble", "clp_zero", "pedestal", "hwp1_axis"}  # all of them take a minute to compile
    catalogue = tuple(kind for kind in EFFECTS if kind.name in names)
    found = diagnose(calset, base_model(calset, two_beams.design), catalogue=catalogue)
    assert found.verdict == "effect_found"
    assert [step.effect for step in found.steps] == ["clp_wobble"]
    assert "hwp1_axis" not in {name for name, _, _ in found.candidates}


# ------------------------------------------------------------------------------------------ a new KIND


class Dusk(ObservingPlan):
    """A run that looks at the sky at dusk where others look at a lamp."""

    def exposures(self):
        lamps = super().exposures()
        return dataclasses.replace(lamps, kind=np.where(lamps.kind == "lamp", "twilight", lamps.kind))


def test_new_kind_of_exposure():
    instrument = nominal_instrument().with_source(Twilight())
    plan = Dusk(instrument, grid=4, polariser_angles=polariser_turn(6), moon_patches=0, standards=0, lamps=3)
    true = instrument.with_source(Twilight(degree=0.42))
    calset, _ = simulate(plan, seed=2, instrument=true)
    model = base_model(calset, instrument)
    result = refit(calset, model)
    i = model.index("twilight.degree")
    assert result.with_verdict().trusted
    assert abs(result.values[i] - 0.42) < 5 * result.sigma[i]


def test_kind_without_a_source_is_an_error():
    plan = Dusk(None, grid=2, polariser_angles=polariser_turn(3), moon_patches=0, standards=0, lamps=1)
    with pytest.raises(ValueError, match="'twilight'"):
        plan_for(nominal_instrument(), plan.exposures(), plan.curves())
