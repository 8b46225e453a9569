"""Where a minimum is sought: ties that hold by construction, and places one order of retardance away."""

from __future__ import annotations

import numpy as np
import pytest
from one_arm import one_arm
from small_run import SEED, SMALL

import walop_jax as walop
from walop_jax.fit.base_model import base_model
from walop_jax.fit.minimise import TOLERANCE
from walop_jax.fit.model_file import model_without_data
from walop_jax.fit.search import _order_starts, _search, find_minimum
from walop_jax.instruments.description import parsed
from walop_jax.likelihood.likelihood import Expansion, Likelihood, OpticsUsed, UsedData
from walop_jax.model.effects import effect_by_name
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.instrument import build
from walop_jax.simulation.simulate import simulate

# One wave is 0.62 µm / (n_e − n_o): 1.38892 − 1.37714 of MgF2 (Dodge 1984), 1.55211 − 1.54305 of quartz (Ghosh 1999).
ONE_WAVE = {"mgf2": 52.6, "quartz": 68.4}  # µm
LAYERS = [f"{plate}.{name}" for plate in ("half1.plate", "half2.plate", "chwp") for name in ONE_WAVE]


@pytest.fixture(scope="module")
def north() -> Likelihood:
    """All plates of WALOP-NORTH are tied to those of one half; its counts do not matter here."""
    counts = 1e5 * (1.0 + np.random.default_rng(1).random((2, 4, 4)))
    angles = [0.0, 30.0, 60.0, 90.0]
    calset = walop.from_arrays(
        counts, np.sqrt(counts), [0.0, 0.1], [0.1, 0.0], angles, instrument="WALOP-NORTH"
    )
    return Likelihood.of(calset, base_model(calset))


def ties(model):
    return [(i, model.index(p.tie)) for i, p in enumerate(model.parameters) if p.tie is not None]


def steps_of(likelihood: Likelihood) -> dict[str, list[float]]:
    """Change of the start values of untied parameters, by name; each start changes one of them and names it."""
    model, steps = likelihood.model, {}
    for label, start in _order_starts(likelihood):
        (changed,) = (i for i in model.free if start[i] != model.start[i])
        assert model.names[changed] in label
        steps.setdefault(model.names[changed], []).append(float(start[changed] - model.start[changed]))
    return steps


def test_every_layer_is_tried_one_order_up_and_one_down():
    calset = simulate(SMALL, seed=SEED).calset
    steps = steps_of(Likelihood.of(calset, base_model(calset)))
    assert sorted(steps) == sorted(LAYERS)
    for name, found in steps.items():
        wave = ONE_WAVE[name.rpartition(".")[2]]
        assert sorted(found) == pytest.approx([-wave, wave], rel=0.01)


def test_tied_layers_move_together(north):
    """One order away all plates are: those of a start are as equal as those of the instrument."""
    assert len(ties(north.model)) >= 6
    assert sorted(steps_of(north)) == ["half2.plate.mgf2", "half2.plate.quartz"]
    for _, start in _order_starts(north):
        assert all(start[i] == start[master] for i, master in ties(north.model))


TURNING = """
[elements.turning]
kind = "wave_plate"
moves = "HWP"
[[elements.turning.layers]]
name = "thick"
material = "mgf2"
thickness = { value = 500.0, sigma = 3.0, unit = "um", name = "t1" }
[[elements.turning.layers]]
name = "fixed"
material = "quartz"
axis = 90.0
thickness = 650.0
[[elements.turning.layers]]
name = "thin"
material = "quartz"
axis = 45.0
thickness = { value = 20.0, sigma = 1.0, unit = "um" }
"""


def test_layers_are_found_whatever_they_are_called():
    """Free ones of any crystal, those next to the air behind their plate first."""
    model = model_without_data(build(parsed(one_arm("ONE", ["turning"], TURNING), "a text")))
    found = [(model.names[i], layer.material) for i, layer in model.thicknesses().items()]
    assert found == [("turning.thin", "quartz"), ("t1", "mgf2")]


# ------------------------------------------------------------------------------------------------------------- ties


def test_a_tied_parameter_has_the_value_of_its_master_whatever_else_is_said(north):
    model, rng = north.model, np.random.default_rng(1)
    free, anything = rng.normal(size=len(model.free)), rng.normal(size=len(model.names))
    values = model.full(free, anything)
    np.testing.assert_array_equal(values[model.free], free)
    assert all(values[i] == values[master] for i, master in ties(model))
    held = [i for i, p in enumerate(model.parameters) if p.tie is None and not p.free]
    np.testing.assert_array_equal(values[held], anything[held])
    # The derivative is that of the map: finite differences, exact for what is linear.
    slopes = [model.full(free + step, anything) - values for step in np.eye(len(free))]
    np.testing.assert_allclose(np.transpose(slopes), model.selection(), atol=1e-15)


def test_a_search_ends_with_equal_plates_wherever_it_began(north, monkeypatch):
    """From values that are not those of the masters: at each place that is looked at, and at the end."""
    model, seen = north.model, []
    goal = model.start[model.free] + 1e-3

    def expand(values, scale, near):
        seen.append(values)
        away = values[model.free] - goal
        used_data = UsedData(np.ones(4, int), (0.0, 0.1, 0.0, 0.1), 4)
        square = float(away @ away)
        return Expansion(square, 0.0, 0.0, scale, away, np.eye(len(away)), used_data, 1, OpticsUsed(None))

    first = model.start.copy()
    for i, _ in ties(model):
        first[i] += 0.5
    monkeypatch.setattr(Likelihood, "expand", lambda _, values, scale, near: expand(values, scale, near))
    end = _search(north, "", first, 1.0).x
    np.testing.assert_allclose(end[model.free], goal, rtol=0, atol=TOLERANCE)  # errors are 1
    for values in (*seen, end):
        assert all(values[i] == values[master] for i, master in ties(model))


# ----------------------------------------------------------------------------------------------- orders of fringes

BANDS = np.concatenate([0.58 + np.linspace(-0.0075, 0.0075, 5), 0.66 + np.linspace(-0.0075, 0.0075, 5)])  # µm
GAP, CONTRAST, SIGMA, DOF = 11.0, 0.01, 1e-4, 10_000


def fringe(contrast, gap):
    """Diattenuation in each of some wavelengths (head of `effects.etalon`), and its derivatives."""
    phase = 4.0 * np.pi * gap / BANDS
    slope = -contrast * np.sin(phase) * 4.0 * np.pi / BANDS
    return contrast * np.cos(phase), np.stack([np.cos(phase), slope], axis=1)


@pytest.mark.parametrize("start", [11.0, 10.7, 11.3, 10.0, 11.6])
def test_fringes_of_another_order_are_no_end(start, monkeypatch):
    """A gap that begins some fringes off is found: 10.70 µm is a minimum of its own beside 11.00 µm."""
    counts = 1e5 * (1.0 + np.random.default_rng(1).random((2, 4, 4)))
    calset = walop.from_arrays(counts, np.sqrt(counts), [0.0, 0.1], [0.1, 0.0], [0.0, 30.0, 60.0, 90.0])
    bare = base_model(calset)
    context = effect_context(bare.template, calset.exposures)
    etalon = effect_by_name("etalon").of(context, contrast=CONTRAST, gap=start)
    model = with_effects(bare, [etalon], context)
    likelihood = Likelihood.of(calset, model)
    at = [int(np.flatnonzero(model.free == model.index(f"etalon.{name}"))[0]) for name in ("contrast", "gap")]
    truth, begin = fringe(CONTRAST, GAP)[0], model.start[model.free]

    def expand(self, values, scale=1.0, near=None):
        x = values[model.free]
        there, slopes = fringe(*x[at])
        residual, jacobian = (there - truth) / SIGMA, slopes / SIGMA
        others = np.eye(len(x))
        others[at, at] = 0.0
        gradient = others @ (x - begin)
        square = float(residual @ residual + gradient @ gradient)
        gradient[at] += jacobian.T @ residual
        matrix = others.copy()
        matrix[np.ix_(at, at)] += jacobian.T @ jacobian
        used_data = UsedData(np.ones(4, int), (0.0, 0.1, 0.0, 0.1), 4)
        return Expansion(square, 0.0, 0.0, scale, gradient, matrix, used_data, DOF, OpticsUsed(None))

    monkeypatch.setattr(Likelihood, "expand", expand)
    assert model.gaps() == (model.index("etalon.gap"),)
    assert bare.gaps() == ()
    found = find_minimum(likelihood, model.start, None, None)
    assert found.x[model.index("etalon.gap")] == pytest.approx(GAP, abs=2e-3)
    assert found.x[model.index("etalon.contrast")] == pytest.approx(CONTRAST, abs=1e-4)
