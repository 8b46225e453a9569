"""Pages about single effects and elements: one for each, with the numbers that were worked out for it."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.diagnosis.score import ScoreSpace, separations
from walop_jax.model.effects import EFFECTS
from walop_jax.model.elements.registry import ELEMENTS
from walop_jax.model.gallery import numbers


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_a_page_for_every_effect(call, effect):
    text = call("docs", "effect", effect.name).output
    assert text.startswith(f"# {effect.name}\n")
    assert "Equation" in text
    assert "## How small it may be" in text
    known = numbers()["effects"].get(effect.name)
    if known is not None:
        assert f"{known['found'][0]:.2g}" in text
        assert all(f"`{rival}`" in text for rival, _ in known["rivals"])
        assert "## Its effect on the maps" in text


@pytest.mark.parametrize("kind", ELEMENTS, ids=lambda kind: kind.kind)
def test_a_page_for_every_element(call, kind):
    text = call("docs", "element", kind.kind).output
    assert text.startswith(f"# {kind.kind}\n")
    assert len(text) > 150


def test_lists_and_wrong_names(call):
    shown = call("docs", "effect").output
    assert all(effect.name in shown for effect in EFFECTS)
    wrong = call("docs", "effect", "clp_wobbel")
    assert wrong.exit_code == 2
    assert "clp_wobble" in wrong.output
    assert call("docs", "model", "x").exit_code == 2


def test_most_effects_have_numbers():
    found = numbers()["effects"]
    assert len(found) > 0.7 * len(EFFECTS)
    assert all(
        one["named"] >= one["found"][1] >= one["found"][0] > 0
        for one in found.values()
        if one["named"] is not None
    )


def test_what_a_rival_cannot_imitate():
    """Columns typed by hand: (1, 0, 1) beside the plane of (1, 0, 0) and (0, 1, 0) keeps its third component."""
    columns = np.array([[1.0, 0, 1], [1, 0, 0], [0, 1, 0]]).T
    gram = columns.T @ columns
    space = ScoreSpace(("own", "plane"), (1, 2), np.ones(3), np.diag(gram), gram, 10)
    assert separations(space, gram[:, 0], gram[0, 0])["plane"] == pytest.approx(1.0)
    assert separations(space, gram[:, 1], gram[1, 1])["plane"] == pytest.approx(0.0, abs=1e-9)
