"""Laws of parameters: what a table says, and what it must not say."""

import pytest

from walop_jax.fit.model_file import model_without_data, render
from walop_jax.model.laws import Law, laws_of, resolved


def test_laws_are_read_written_and_resolved():
    """An exact name wins over a group; a candidate without a law is absent."""
    laws = {
        "half2.wedge": Law(("walk", "step"), rate=2e-5, at=(61250.0,)),
        "throughput.n?.p00": Law(("night",), spread=0.1),
        "throughput.n2.p00": Law(),
        "sky.depolarisation": Law(("shared", "bad"), bad=((61000.0, 61001.0),)),
    }
    assert laws_of({name: law.document() for name, law in laws.items()}) == laws
    names = ["half2.wedge", "throughput.n1.p00", "throughput.n2.p00", "sky.depolarisation", "x"]
    found = resolved(laws, names, ["clp_zero.angle"])
    assert [law and law.per[0] for law in found] == ["walk", "night", "shared", "shared", "shared", None]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"a": {"per": "nigth"}}, "did you mean 'night'"),
        ({"a": {"per": "walk"}}, "needs rate"),
        ({"a": {"per": "night", "rate": 1.0}}, "rate is used with per = walk"),
        ({"a": {"per": ["walk", "night"], "rate": 1.0}}, "only one of"),
        ({"a": {"per": "step", "at": [2.0, 1.0]}}, "ascending"),
        ({"a": {"per": "walk", "rate": -1.0}}, "above 0"),
        ({"a": {"pre": "walk"}}, "there is no key 'pre'"),
        ({"a": 3}, "must be a table"),
    ],
)
def test_wrong_laws_are_errors(table, words):
    with pytest.raises(ValueError, match=words):
        laws_of(table)


def test_a_law_of_nothing_is_an_error():
    with pytest.raises(ValueError, match=r"half2.plate.axes.*did you mean"):
        resolved({"half2.plate.axes": Law()}, ["half2.plate.axis"], [])


def test_a_model_file_keeps_laws():
    text = (
        "[law.'half2.plate.axis']\nper = 'night'\n\n[law.'clp_zero.angle']\nper = ['night']\nspread = 0.05\n"
    )
    model = model_without_data("WALOP-SOUTH", text.replace("half2.plate.axis", "half2.wedge"))
    wanted = {"half2.wedge": {"per": ["night"]}, "clp_zero.angle": {"per": ["night"], "spread": 0.05}}
    assert model.laws == model_without_data("WALOP-SOUTH", render(model)).laws == wanted
    with pytest.raises(ValueError, match=r"parameter of \[law\].*half2.wegde"):
        model_without_data("WALOP-SOUTH", text.replace("half2.plate.axis", "half2.wegde"))
    with pytest.raises(ValueError, match="needs rate"):
        model_without_data("WALOP-SOUTH", "[law.'half2.wedge']\nper = 'walk'\n")
