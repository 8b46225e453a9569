"""What every effect owes: names, units, sources, neutrality, derivatives."""

from __future__ import annotations

import effect_scenes as scenes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from walop_jax.model.compiled import compiled
from walop_jax.model.effects import EFFECTS, EffectKind, effect_by_name
from walop_jax.model.parameters import leaves, values_of

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
    "standard_values": {"q": "", "u": ""},
    "standard_colour": {"source": None, "q": "", "u": ""},
    "standard_drift": {"source": None, "q": "1/h", "u": "1/h"},
    "standard_angles": {"angle": "deg"},
    "standard_degrees": {"share": ""},
}
every_effect = pytest.mark.parametrize("kind", EFFECTS, ids=lambda kind: kind.name)
# Standards of the scene are seen once each, in one filter: what changes them is in tests/model/test_standards.py.
OF_STANDARDS = ("standard_colour", "standard_drift")
with_parameters = [kind for kind in EFFECTS if not kind.is_structural() and kind.name not in OF_STANDARDS]


def test_catalogue_is_the_contract():
    known = {kind.name for kind in EFFECTS}
    assert known - {*CONTRACT} == set(), f"add {sorted(known - {*CONTRACT})} to CONTRACT in {__file__}"
    assert {*CONTRACT} - known == set(), f"no effect has these names: take them out of CONTRACT in {__file__}"
    assert all(effect_by_name(name).name == name for name in CONTRACT)


def test_unknown_effect_lists_the_nearest():
    with pytest.raises(ValueError, match="clp_wobble"):
        effect_by_name("clp_woble")


@every_effect
def test_parameters_units_and_sources(kind: EffectKind):
    effect = kind.neutral(scenes.CONTEXT)
    assert kind.name in CONTRACT, f"add {kind.name} to CONTRACT in {__file__}"
    expected = CONTRACT[kind.name]
    assert {name: d.unit for name, d in kind.numbers().items()} == {
        name: unit for name, unit in expected.items() if unit is not None
    }
    # Which crystal is cut has a default; every other choice is part of the name.
    assert {*effect.choices()} - {"crystal"} == {name for name, unit in expected.items() if unit is None}
    for declaration in kind.numbers().values():
        assert declaration.about
        assert declaration.source
        assert declaration.width or declaration.loose, "an amplitude has a prior, a shape a weak pull"
    assert kind.revealed_by
    assert kind.separated_by
    # Nothing in it is a number without a name.
    assert len(leaves(effect)) == ravel_pytree(effect)[0].size == values_of(effect).size


@every_effect
def test_names_in_class_variables_are_parameters(kind: EffectKind):
    names = set(kind.numbers())
    assert {*kind.shape, *kind.one_sided} <= names
    assert not {*kind.shape} & {*kind.one_sided}
    for group in kind.probes(scenes.CONTEXT):
        for probe in group:
            for name in kind.amplitudes():
                assert np.array_equal(getattr(probe, name), getattr(kind.neutral(scenes.CONTEXT), name))


@every_effect
def test_unknown_value_lists_the_nearest(kind: EffectKind):
    with pytest.raises(ValueError, match=f"there is no parameter of {kind.name}"):
        kind.of(scenes.CONTEXT, no_such_thing=1.0)


# In company one compilation serves all; each alone shows that none leans on what another one asks for.
@pytest.mark.parametrize(
    "kinds",
    [with_parameters, *(pytest.param([kind], marks=pytest.mark.long) for kind in with_parameters)],
    ids=lambda kinds: kinds[0].name if len(kinds) == 1 else "all",
)
def test_neutral_and_derivatives(kinds: list[EffectKind]):
    """Neutral changes nothing; every amplitude does something; forward derivative = central difference."""
    probes = [kind.probes(scenes.CONTEXT)[0][0] for kind in kinds]
    layout = scenes.plan(probes)
    data = scenes.points(layout)
    neutral, unravel = ravel_pytree(
        [{name: getattr(probe, name) for name in probe.kind.amplitudes()} for probe in probes]
    )
    labels = [
        (probe.name, name, probe.declarations()[name].width)
        for probe in probes
        for name in sorted(probe.kind.amplitudes())  # the order of a dictionary's leaves
        for _ in range(np.size(getattr(probe, name)))
    ]
    step = 1e-3 * np.array([width for *_, width in labels])

    def counts(amplitudes: jax.Array) -> jax.Array:
        effects = [
            probe.replaced(**values) for probe, values in zip(probes, unravel(amplitudes), strict=True)
        ]
        return scenes.counts(scenes.instrument(*effects), layout, data)

    moved = neutral + np.concatenate([np.zeros((1, len(step))), np.diag(step), -np.diag(step)])
    values, slope = compiled(lambda v: (jax.lax.map(counts, v), jax.jacfwd(counts)(v[0])))(jnp.asarray(moved))
    without = scenes.observe(plan_of=probes)
    assert np.abs(np.asarray(values[0]) - without).max() < 1e-12 * scenes.FLUX
    plus, minus = np.split(np.asarray(values[1:]), 2)
    for i, label in enumerate(labels):
        derivative = np.asarray(slope[..., i]) * step[i] * 1e3
        assert np.abs(derivative / without).max() > 1e-6, f"{label} does nothing"
        difference = (plus[i] - minus[i]) / 2e-3
        assert np.abs(difference - derivative).max() < 1e-5 * np.abs(derivative).max(), label
