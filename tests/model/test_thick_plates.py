"""Wavelength nodes of instruments whose plates are thicker than those of WALOP, against sums over 4000 wavelengths."""

from __future__ import annotations

import dataclasses

import builders
import jax.numpy as jnp
import numpy as np
import pytest
from one_arm import POLARISER, one_arm

import walop_jax as walop
from walop_jax.calibration.matrix import matrix_draws
from walop_jax.data.records import FilterCurve
from walop_jax.data.settings import Settings, builtin_filter
from walop_jax.fit.model_file import model_without_data
from walop_jax.fit.model_of_set import model_for
from walop_jax.instruments.description import parsed
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.instrument import build, nominal_instrument
from walop_jax.model.planning import plan_for_settings

PUPIL = """
[elements.pupil]
kind = "pupil_mapping"
magnification = 15.6
"""
LAYER = """
[[elements.plate.layers]]
name = "{name}"
material = "{material}"
axis = {axis}
thickness = {{ value = {thickness}, sigma = 500.0, unit = "um" }}
"""
AXIS = 20.0


def instrument_of(plate: str):
    path, elements = ["polariser", "pupil", "plate"], POLARISER + PUPIL + plate
    return build(parsed(one_arm("THICK", path, elements, field="limit = 0.35\nscale = 0.3"), "a text"))


def plate(*layers: tuple[str, float, float]) -> str:
    head = f'[elements.plate]\nkind = "wave_plate"\naxis = {AXIS}\n'
    return head + "".join(
        LAYER.format(name=f"layer{n}", material=material, thickness=thickness, axis=axis)
        for n, (material, thickness, axis) in enumerate(layers)
    )


def sdss_r():
    return builtin_filter("SDSS-r")


def line():
    wavelength = np.array([0.55, 0.6, 0.65])
    return FilterCurve("band", wavelength, np.array([0.2, 1.0, 0.5]))


CURVES = {"SDSS-r": sdss_r, "three rows": line}


def fine(curve):
    """The lines between the rows of a curve, by the midpoints of 4000 steps and more."""
    edges = np.linspace(curve.wavelength[0], curve.wavelength[-1], 4001)
    edges = np.unique(np.concatenate([edges, curve.wavelength]))
    middle, step = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    weight = np.interp(middle, curve.wavelength, curve.throughput) * step
    return middle, weight / weight.sum()


def plan_of(instrument, curve):
    return plan_for_settings(instrument, Settings.default(1, curve.name), {curve.name: curve})


def intensities(instrument, plan):
    """Analysis vectors over their largest response to unpolarised light, on the axis and away from it."""
    rows = builders.vectors(instrument, plan, [0.0, 0.3], [0.0, -0.2])
    return rows / rows[..., 0].max()


def converged(instrument, curve):
    """Intensities with the nodes of a plan, after a comparison with those of 4000."""
    plan, (wavelength, weight) = plan_of(instrument, curve), fine(curve)
    conditions = dataclasses.replace(plan.conditions, band_width=jnp.full(wavelength.size, 0.1))
    finer = dataclasses.replace(
        plan, wavelength=jnp.asarray(wavelength), node_weight=jnp.asarray(weight)[None], conditions=conditions
    )
    rows = intensities(instrument, plan)
    np.testing.assert_allclose(rows, intensities(instrument, finer), rtol=0, atol=1e-6)
    return rows


@pytest.mark.parametrize("curve", CURVES)
@pytest.mark.parametrize("thickness", [2400.0, 6000.0, 8000.0, 10000.0, 25000.0])
def test_a_plate_of_any_thickness_is_integrated(thickness, curve):
    """To 10⁻⁶ of the intensities. In the r band nothing is left of the fringes: q answers to q by cos² 2α."""
    row = converged(instrument_of(plate(("quartz", thickness, 0.0))), CURVES[curve]())[0, 0, 0]
    if curve == "SDSS-r":
        assert row[1] / row[0] == pytest.approx(np.cos(np.deg2rad(2.0 * AXIS)) ** 2, abs=2e-3)


def test_so_are_two_that_turn_in_the_same_sense():
    """Layers with axes along each other retard by the sum of both."""
    two = converged(instrument_of(plate(("quartz", 4000.0, 0.0), ("quartz", 3000.0, 0.0))), sdss_r())
    whole = converged(instrument_of(plate(("quartz", 7000.0, 0.0))), sdss_r())
    np.testing.assert_allclose(two, whole, rtol=0, atol=1e-5)  # but for the face between them


def test_and_a_retarder_of_many_orders():
    """Retardance 90 waves at 0.62 µm that goes as 1/λ; at α q answers to q by cos² 2α + sin² 2α ⟨cos δ⟩."""
    text = f'[elements.plate]\nkind = "retarder"\naxis = {AXIS}\nwavelength = 0.62\n'
    text += f'delta = {{ value = {2 * np.pi * 90}, unit = "rad" }}\n'
    row = converged(instrument_of(text), sdss_r())[0, 0, 0]
    wavelength, weight = fine(sdss_r())
    mean, twice = np.cos(2.0 * np.pi * 90.0 * 0.62 / wavelength) @ weight, np.deg2rad(2.0 * AXIS)
    assert row[1] / row[0] == pytest.approx(np.cos(twice) ** 2 + np.sin(twice) ** 2 * mean, abs=1e-6)


def test_thick_layers_that_cancel_are_integrated_with_fewer_nodes():
    """Crossed plates of twice the thickness of those of WALOP: they leave a retarder of one wave."""
    crossed, along = (
        instrument_of(plate(("quartz", 4814.0, 0.0), ("mgf2", 3860.0, axis))) for axis in (90.0, 0.0)
    )
    # A table that is as fine as the sum: one of 86 rows may be read in ways that differ by 2·10⁻⁶ in v.
    wavelength = np.linspace(0.505, 0.735, 4601)
    curve = builders.curve(wavelength, np.exp(-(((wavelength - 0.62) / 0.062) ** 8)))
    converged(crossed, curve)
    usual, fewer, more = (
        plan_of(one, curve).wavelength.size for one in (nominal_instrument(), crossed, along)
    )
    assert usual < fewer < more


@pytest.mark.parametrize("name", ["WALOP-SOUTH", "WALOP-NORTH", "WALOP-LAB"])
def test_instruments_of_the_family_have_as_many_nodes_as_their_rule(name):
    assert plan_of(nominal_instrument(name), sdss_r()).wavelength.size == 41


# ----------------------------------------------------------------------------------------------------- fits


def likelihood_of(thickness: float, start: float | None = None) -> Likelihood:
    counts = 1e5 * (1.0 + np.random.default_rng(1).random((2, 4, 2)))
    instrument = instrument_of(plate(("quartz", thickness, 0.0)))
    calset = walop.from_arrays(
        counts, np.sqrt(counts), [0.0, 0.1], [0.1, 0.0], [0.0, 30.0, 60.0, 90.0], instrument=instrument.name
    )
    text = "" if start is None else f'[parameters."plate.layer0"]\nstart = {start}\n'
    return Likelihood.of(calset, model_for(calset, text, instrument))


def nodes(likelihood: Likelihood) -> int:
    return likelihood.plan.wavelength.size


def test_nodes_follow_the_start_of_a_model_file():
    assert nodes(likelihood_of(2000.0, 8000.0)) == nodes(likelihood_of(8000.0)) > nodes(likelihood_of(2000.0))


def test_nodes_follow_a_plate_that_a_fit_has_made_thicker():
    """And other likelihoods of the model of that fit have them as well."""
    thin, thick = likelihood_of(2000.0), likelihood_of(8000.0)
    values = thin.model.start
    values[thin.model.index("plate.layer0")] = 8000.0
    found = thin.following(values)
    assert nodes(found) == nodes(thick)
    assert found.following(values) is found
    assert nodes(Likelihood.of(found.calset, found.model)) == nodes(thick)
    np.testing.assert_array_equal(found.model.start, thin.model.start)


def test_a_step_of_a_fit_lays_nothing_out_anew():
    thick = likelihood_of(8000.0)
    values = thick.model.start
    values[thick.model.index("plate.layer0")] += 68.0  # one wave
    assert thick.following(values) is thick


def test_draws_of_a_matrix_have_nodes_for_the_draws():
    model = model_without_data(instrument_of(plate(("quartz", 2000.0, 0.0))))
    values = model.start
    values[model.index("plate.layer0")] = 8000.0
    here, filters = (np.zeros(1), np.zeros(1)), {"SDSS-r": sdss_r()}
    (found,) = matrix_draws(model, values[None], Settings.default(1), filters, *here)
    row = converged(model.instrument(values), sdss_r())[0, 0]
    assert found[0, 1] == pytest.approx((row[0, 1] - row[1, 1]) / (row[0, 0] + row[1, 0]), abs=1e-9)
