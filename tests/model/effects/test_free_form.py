"""The free-form term: no name and no probe, but an effect like any other once it is in a model."""

from __future__ import annotations

import dataclasses

import effect_scenes as scenes
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial.legendre import legval

from walop_jax.fit.model_file import model_without_data, render
from walop_jax.model.effects import EFFECTS, FreeForm, effect_by_name, in_order
from walop_jax.model.effects.free_form import BLOCKS
from walop_jax.model.effects.in_models import with_effects
from walop_jax.model.parameters import leaves

FIELD = 0.3  # half width of the field (deg): the argument of the polynomials is x / FIELD


def test_it_is_found_by_name_but_is_no_candidate():
    assert effect_by_name("free_form") is FreeForm
    assert FreeForm not in EFFECTS
    assert FreeForm.probes(scenes.CONTEXT) == ()


def test_neutral_changes_nothing():
    plain = scenes.observe()
    # Rounding is a share of the light, not of what an analyser leaves of it.
    np.testing.assert_allclose(
        scenes.observe(FreeForm.neutral(scenes.CONTEXT)), plain, rtol=0, atol=1e-12 * plain.max()
    )


@pytest.mark.parametrize("blocks", [(), *((b,) for b in BLOCKS), BLOCKS])
def test_a_block_that_is_not_asked_for_has_no_parameters(blocks):
    effect = FreeForm.of(scenes.CONTEXT, blocks=blocks)
    names = [leaf.name for leaf in leaves(effect)]
    assert {name.split(".")[0] for name in names} == set(blocks)
    assert len(names) == len(set(names))


def test_unknown_block_lists_the_nearest():
    with pytest.raises(ValueError, match="harmonics"):
        FreeForm.of(scenes.CONTEXT, blocks=["harmonic"])


def place(effect: FreeForm, name: str) -> FreeForm:
    """The effect with one number, by its name, set to 0.01."""
    block = name.split(".")[0]
    mine = [leaf.name for leaf in leaves(effect) if leaf.name.startswith(block)]
    value = np.zeros(len(mine))
    value[mine.index(name)] = 0.01
    return dataclasses.replace(effect, **{block: jnp.asarray(value).reshape(getattr(effect, block).shape)})


def unpolarised() -> np.ndarray:
    """Response of each camera to unpolarised light at each point, from a flux exposure, per exposure."""
    return scenes.observe()[:, 8]


def test_exposure_and_fine_structure_add_a_share_of_the_unpolarised_counts():
    one = (
        scenes.observe(place(FreeForm.of(scenes.CONTEXT, blocks=("exposures",)), "exposures.8.n2"))
        - scenes.observe()
    )
    expected = np.zeros_like(one)
    expected[:, 8, 2] = 0.01 * unpolarised()[:, 2]
    np.testing.assert_allclose(one, expected, atol=1e-6)
    fine = (
        scenes.observe(place(FreeForm.of(scenes.CONTEXT, blocks=("fine",)), "fine.n1.p50")) - scenes.observe()
    )
    pattern = legval(scenes.X / FIELD, np.eye(6)[5])
    np.testing.assert_allclose(fine[:, 8, 1], 0.01 * pattern * unpolarised()[:, 1], rtol=1e-9)
    assert np.abs(fine[..., [0, 2, 3]]).max() < 1e-7  # rounding of 10⁵ electrons


def test_a_harmonic_follows_the_polariser_and_nothing_else():
    empty = FreeForm.of(scenes.CONTEXT, blocks=("harmonics",))
    sine, cosine, flat = (
        scenes.observe(place(empty, f"harmonics.n0.{name}")) - scenes.observe()
        for name in ("3theta.sin.p10", "3theta.cos.p10", "3theta.cos.p00")
    )
    angle = np.deg2rad([10.0, 55.0, 100.0, 145.0])
    np.testing.assert_allclose(
        sine[:, :4, 0] / cosine[:, :4, 0], np.tan(3 * angle) * np.ones((2, 1)), rtol=1e-6
    )
    np.testing.assert_allclose(
        cosine[:, :4, 0] / flat[:, :4, 0], (scenes.X / FIELD)[:, None] * np.ones(4), rtol=1e-6
    )
    assert np.abs(sine[:, 4:]).max() < 1e-7
    assert np.abs(sine[..., 1:]).max() < 1e-7


def test_a_vector_changes_what_polarised_light_gives():
    effect = place(FreeForm.of(scenes.CONTEXT, blocks=("vectors",)), "vectors.n3.u.p00")
    change = scenes.observe(effect) - scenes.observe()
    assert np.abs(change[:, 8]).max() < 1e-7  # unpolarised
    star = change[:, 6, 3] / unpolarised()[:, 3]
    turned = (STAR_Q + 1j * STAR_U) * np.exp(-2j * np.deg2rad(40.0))
    np.testing.assert_allclose(star, 0.01 * turned.imag, rtol=0.05)


STAR_Q, STAR_U = scenes.STARS[0][1:]


def test_it_survives_a_model_file():
    model = model_without_data("WALOP-SOUTH", context=scenes.CONTEXT)
    extended = with_effects(model, [FreeForm.of(scenes.CONTEXT, blocks=("fine", "vectors"))], scenes.CONTEXT)
    again = model_without_data("WALOP-SOUTH", render(extended), context=scenes.CONTEXT)
    assert again.names == extended.names
    assert sum(name.startswith("free_form.") for name in again.names) == 4 * 2 * 15 + 4 * 30


def test_effects_that_no_catalogue_lists_come_last():
    wobble, free = (
        effect_by_name("clp_wobble").neutral(scenes.CONTEXT),
        FreeForm.of(scenes.CONTEXT, blocks=()),
    )
    assert [e.name for e in in_order([free, wobble])] == ["clp_wobble", "free_form"]
