"""Effects added to a model: names, order, starts, priors; effects of one's own, by an entry or a class."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

import builders
import effect_scenes as scenes
import numpy as np
import pytest

from walop_jax.fit.model_file import model_without_data, render
from walop_jax.io.errors import DataError
from walop_jax.model.effects import EFFECTS, Described, effect_by_name
from walop_jax.model.effects.catalogue import catalogue_with
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.specification import make_model

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
    with pytest.raises(ValueError, match="did you mean 'clp_wobble'"):
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
    assert context._replace(largest={}) == scenes.CONTEXT._replace(largest={})


def test_prior_widths_are_those_of_the_largest_values_of_factors():
    """Nine exposures of 30 s in 3.6 h, up to 16 °C, hour angles to 2 h: 0.3 % of light at the end, not in an hour."""
    context = effect_context(MODEL.template, scenes.EXPOSURES)
    expected = {"hours": 3.6, "hour angle": 2.0, "kelvin": 6.0, "per EXPTIME": 1.0 / 30.0, "order": 8.0}
    assert {name: context.largest[name] for name in expected} == pytest.approx(expected)
    for factors, size in (
        ("", 1.0),
        (" * hours", 3.6),
        (" * per EXPTIME", 1.0 / 30.0),
        (" * x * kelvin", 6.0),
    ):
        text = f"gain of O1{factors}"
        width = 0.003 / size
        assert Described.saying([text], [0.0]).prior_widths(context) == pytest.approx(
            {text.replace(" ", "_"): width}
        )
        model = with_effects(MODEL, [Described.saying([text], [0.0])], context)
        (prior,) = (p.prior for p in model.parameters if p.name == f"described.{text.replace(' ', '_')}")
        assert prior == pytest.approx((0.0, width))


# ---------------------------------------------------------------------------------- effects of one's own

PAGE = Path(__file__).resolve().parents[3] / "walop_jax" / "docs" / "adding-an-effect.md"


def example(title: str, first: str) -> str:
    """The indented lines of a section of the page that begin with some text."""
    section = PAGE.read_text(encoding="utf-8").partition(f"## {title}\n")[2].partition("\n## ")[0]
    lines = section[section.index(f"    {first}") :].splitlines()
    stop = next((i for i, line in enumerate(lines) if line and not line.startswith("    ")), len(lines))
    return "\n".join(line.removeprefix("    ") for line in lines[:stop])


def test_an_entry_of_a_file_is_an_effect(tmp_path, monkeypatch):
    """The example of the page is the retarder of the catalogue by another name."""
    path = tmp_path / "window.toml"
    path.write_text(example("An entry", "[stressed_window]"), encoding="utf-8")
    *known, own = catalogue_with(path)
    assert tuple(known) == EFFECTS
    ours, theirs = (
        effect_by_name(name, (*known, own)).of(scenes.CONTEXT, delta=0.05, axis=20.0)
        for name in ("stressed_window", "upstream_retarder")
    )
    np.testing.assert_allclose(scenes.observe(ours), scenes.observe(theirs), rtol=1e-13)
    names = with_effects(MODEL, [own], scenes.CONTEXT).names
    assert [n for n in names if n.startswith("stressed")] == ["stressed_window.axis", "stressed_window.delta"]
    assert "M = Ret(delta, axis)" in own.head()
    saved = pickle.dumps((ours, own))
    monkeypatch.delitem(sys.modules, "walop_jax_own_window", raising=False)  # as in another session
    assert pickle.loads(saved) == (ours, own)


def test_a_model_file_brings_the_entries_of_its_effects_along(tmp_path):
    """As does the product of a fit, which holds one: nobody needs the file of effects any more."""
    path = tmp_path / "window.toml"
    path.write_text(example("An entry", "[stressed_window]"), encoding="utf-8")
    text = '[model]\neffects = ["stressed_window", "clp_zero"]\n'
    with pytest.raises(ValueError, match=r"there is no effect 'stressed_window'.*--effects"):
        model_without_data("WALOP-SOUTH", text)
    model = model_without_data("WALOP-SOUTH", text, catalogue=catalogue_with(path))
    again = model_without_data("WALOP-SOUTH", render(model))
    assert again.effect_names == ("clp_zero", "stressed_window")
    assert again.parameters == model.parameters
    assert render(again) == render(model)
    assert "[catalogue" not in render(model_without_data("WALOP-SOUTH", '[model]\neffects = ["clp_zero"]'))
    values = model.start + 1e-3
    np.testing.assert_array_equal(
        scenes.observe(again.instrument(values).effect("stressed_window")),
        scenes.observe(model.instrument(values).effect("stressed_window")),
    )


def test_the_class_of_the_page_is_an_effect(tmp_path):
    path = tmp_path / "spot.py"
    path.write_text(example("A class", '"""A dark spot.'), encoding="utf-8")
    own = catalogue_with(path)[-1].of(scenes.CONTEXT, x=0.21, size=0.1, depth=0.2)
    left = np.ones((2, 9, 4))
    left[..., :2] -= 0.2 * np.exp(-((scenes.X - 0.21) ** 2 + scenes.Y**2) / 0.02)[:, None, None]
    np.testing.assert_allclose(scenes.observe(own) / scenes.observe(), left)


ENTRY = 'about = "a"\nsource = "b"\nrevealed_by = "c"\nseparated_by = "d"\n'
GOOD = 'angle = { does = "turn of polariser", unit = "deg", width = 0.1, about = "e" }\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"[a]\n{ENTRY}", r"\[a\] needs a parameter"),
        (f"[a]\n{GOOD}", r"\[a\] needs about"),
        (f"[a]\n{ENTRY}{GOOD.replace('turn of', 'tun of')}", "cannot read 'tun of polariser'"),
        (f"[a]\n{ENTRY}{GOOD.replace('polariser', 'polariser * heat')}", "there is no factor 'heat'"),
        (f"[a]\n{ENTRY}{GOOD.replace('polariser', '{kamera}')}", "there is no choice of angle 'kamera'"),
        (
            f"[a]\n{ENTRY}{GOOD.replace('width', 'widht')}",
            "there is no key of angle 'widht'; did you mean 'width'",
        ),
        (f"[a]\n{ENTRY}{GOOD.replace(', width = 0.1', '')}", "angle: needs unit, about, and width"),
        (f'[a]\n{ENTRY}{GOOD}on_sided = ["angle"]\n', "there is no key 'on_sided'; did you mean 'one_sided'"),
        (
            f"[a]\n{ENTRY}{GOOD.replace('angle', 'moon')}",
            r"\[a\] moon: every effect has something of this name",
        ),
        (f"[clp_zero]\n{ENTRY}{GOOD}", "has the name of another effect"),
        ("a = 3\n", "must be a table"),
        ("", "defines no effect"),
    ],
)
def test_an_entry_that_is_wrong_is_refused(tmp_path, text, message):
    path = tmp_path / "own.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=message):
        catalogue_with(path)
