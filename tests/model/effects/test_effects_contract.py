"""What every effect owes: names, units, sources, neutrality, derivatives."""

from __future__ import annotations

import dataclasses
import inspect
import sys

import effect_scenes as scenes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from walop_jax.model.compiled import compiled
from walop_jax.model.effects import EFFECTS, effect_by_name
from walop_jax.model.effects.base import Effect
from walop_jax.model.parameters import field_declarations, leaves, values_of

# Names, parameters and units of docs: effects, typed by hand.
CONTRACT = {
    "clp_zero": {"angle": "deg"},
    "clp_wobble": {"amplitude": "deg", "phase": "rad"},
    "clp_extinction": {"ratio": ""},
    "clp_ellipticity": {"v": ""},
    "telescope_polarisation": {"q": "", "u": ""},
    "upstream_retarder": {"delta": "rad", "axis": "deg"},
    "lens_birefringence": {"delta": "wave"},
    "chwp_in_beam": {},
    "chwp_axis": {"angle": "deg"},
    "chwp_thickness": {"mgf2": "um", "quartz": "um"},
    "hwp1_axis": {"angle": "deg"},
    "hwp2_axis": {"angle": "deg"},
    "hwp1_crossing": {"angle": "deg"},
    "hwp2_crossing": {"angle": "deg"},
    "hwp1_axis_cut": {"angle": "deg"},
    "hwp2_axis_cut": {"angle": "deg"},
    "hwp_temperature": {"coefficient": ""},
    "etalon": {"contrast": "", "gap": "um"},
    "wollaston_axis": {"angle": "deg"},
    "camera_leakage": {"share": ""},
    "ghost": {"share": ""},
    "pedestal": {"level": ""},
    "nonlinearity": {"coefficient": ""},
    "camera_gain_drift": {"camera": None, "rate": "1/h"},
    "blemish": {"camera": None, "x": "deg", "y": "deg", "size": "deg", "depth": ""},
    "filter_shift": {"wavelength": "um"},
    "flexure": {"rate_x": "deg/h", "rate_y": "deg/h"},
    "moon_multiple_scattering": {"p": ""},
    "moon_patch": {"q": "", "u": ""},
    "rotator_zero": {"angle": "deg"},
    "standard_outlier": {"source": None, "q": "", "u": ""},
}
every_effect = pytest.mark.parametrize("kind", EFFECTS, ids=lambda kind: kind.name)
with_parameters = [kind for kind in EFFECTS if not kind.is_structural()]


def test_catalogue_is_the_contract():
    assert sorted(kind.name for kind in EFFECTS) == sorted(CONTRACT)
    assert all(effect_by_name(name).name == name for name in CONTRACT)


def test_unknown_effect_lists_the_nearest():
    with pytest.raises(ValueError, match="clp_wobble"):
        effect_by_name("clp_woble")


@every_effect
def test_parameters_units_and_sources(kind: type[Effect]):
    effect = kind.neutral(scenes.CONTEXT)
    expected = CONTRACT[kind.name]
    assert {name: d.unit for name, d in field_declarations(kind).items()} == {
        name: unit for name, unit in expected.items() if unit is not None
    }
    # Which crystal is cut has a default; every other choice is part of the name.
    assert {*effect.choices()} - {"crystal"} == {name for name, unit in expected.items() if unit is None}
    for declaration in field_declarations(kind).values():
        assert declaration.about
        assert declaration.source
        assert declaration.width or declaration.loose, "an amplitude has a prior, a shape a weak pull"
    assert kind.revealed_by
    assert kind.separated_by
    # Nothing in it is a number without a name.
    assert len(leaves(effect)) == ravel_pytree(effect)[0].size == values_of(effect).size


@every_effect
def test_file_says_what_it_holds(kind: type[Effect]):
    text = sys.modules[kind.__module__].__doc__ or ""
    for section in ("Equation", "Source", "Neutral", "Revealed by"):
        assert section in text, section
    assert kind.__doc__
    assert inspect.getsource(kind)


@every_effect
def test_names_in_class_variables_are_parameters(kind: type[Effect]):
    names = set(field_declarations(kind))
    assert {*kind.shape, *kind.one_sided} <= names
    assert not {*kind.shape} & {*kind.one_sided}
    for group in kind.probes(scenes.CONTEXT):
        for probe in group:
            for name in kind.amplitudes():
                assert np.array_equal(getattr(probe, name), getattr(kind.neutral(scenes.CONTEXT), name))


@every_effect
def test_unknown_value_lists_the_nearest(kind: type[Effect]):
    with pytest.raises(ValueError, match=f"unknown parameter of {kind.name}"):
        kind.of(scenes.CONTEXT, no_such_thing=1.0)


@pytest.mark.parametrize("kind", with_parameters, ids=lambda kind: kind.name)
def test_neutral_and_derivatives(kind: type[Effect]):
    """Neutral changes nothing; every amplitude does something; forward derivative = central difference."""
    probe = kind.probes(scenes.CONTEXT)[0][0]
    layout = scenes.plan([probe])
    data = scenes.points(layout)
    names = kind.amplitudes()
    neutral, unravel = ravel_pytree({name: getattr(probe, name) for name in names})
    step = 1e-3 * np.concatenate(
        [np.full(np.size(getattr(probe, n)), field_declarations(kind)[n].width) for n in names]
    )

    def counts(amplitudes: jax.Array) -> jax.Array:
        effect = dataclasses.replace(probe, **unravel(amplitudes))
        return scenes.counts(scenes.instrument(effect), layout, data)

    moved = neutral + np.concatenate([np.zeros((1, len(step))), np.diag(step), -np.diag(step)])
    values, slope = compiled(lambda v: (jax.vmap(counts)(v), jax.jacfwd(counts)(v[0])))(jnp.asarray(moved))
    without = scenes.observe(plan_of=[probe])
    assert np.abs(np.asarray(values[0]) - without).max() < 1e-12 * scenes.FLUX
    plus, minus = np.split(np.asarray(values[1:]), 2)
    for i, width in enumerate(step * 1e3):
        derivative = np.asarray(slope[..., i]) * width
        assert np.abs(derivative / without).max() > 1e-6, f"amplitude {i} does nothing"
        difference = (plus[i] - minus[i]) / 2e-3
        assert np.abs(difference - derivative).max() < 1e-5 * np.abs(derivative).max()
