"""Effects added to a model: names, order, starts, priors."""

from __future__ import annotations

import builders
import effect_scenes as scenes
import pytest

from walop_jax.model.effects import effect_by_name
from walop_jax.model.specification import effect_context, make_model, with_effects

MODEL = make_model("WALOP-SOUTH", builders.south(standards=scenes.STARS)).change(
    "half1.efficiency", start=0.9985
)


def test_names_and_order_follow_the_light():
    model = with_effects(MODEL, ["nonlinearity", "clp_wobble", "moon_patch"], scenes.CONTEXT)
    added = model.names[len(MODEL.names) :]
    assert added == (
        "moon_patch.q.4", "moon_patch.q.5", "moon_patch.u.4", "moon_patch.u.5",
        "clp_wobble.amplitude", "clp_wobble.phase",
        "nonlinearity.coefficient.n0", "nonlinearity.coefficient.n1",
        "nonlinearity.coefficient.n2", "nonlinearity.coefficient.n3",
    )  # fmt: skip
    assert model.names[: len(MODEL.names)] == MODEL.names
    assert model["half1.efficiency"].start == 0.9985
    assert model.effect_names == ("moon_patch", "clp_wobble", "nonlinearity")


def test_what_belongs_to_a_component_is_found_by_its_name():
    model = with_effects(MODEL, ["clp_zero", "clp_wobble"], scenes.CONTEXT)
    wobble = model.template.effect("clp_wobble")
    assert [model.names[i] for i in model.positions("clp_wobble")] == [
        "clp_wobble.amplitude", "clp_wobble.phase"
    ]  # fmt: skip
    assert wobble.name == "clp_wobble"
    assert len(model.positions("half1")) == 4
    assert len(model.positions("clp")) == 0
    with pytest.raises(ValueError, match="nearest: clp_wobble"):
        model.template.effect("clp_wobbel")


def test_an_instance_starts_where_it_stands_with_a_prior_about_neutral():
    effect = effect_by_name("clp_extinction").of(scenes.CONTEXT, ratio=1e-4)
    parameter = with_effects(MODEL, [effect], scenes.CONTEXT)["clp_extinction.ratio"]
    assert parameter.start == pytest.approx(1e-4)
    assert parameter.prior == pytest.approx((2e-5, 2e-4))


def test_wrong_names_and_effects_twice_are_errors():
    with pytest.raises(ValueError, match="hwp1_axis"):
        with_effects(MODEL, ["hwp1_axes"], scenes.CONTEXT)
    with pytest.raises(ValueError, match="already"):
        with_effects(MODEL, ["clp_zero", "clp_zero"], scenes.CONTEXT)


def test_context_of_a_data_set():
    context = effect_context(MODEL.template, scenes.EXPOSURES)
    assert context == scenes.CONTEXT
