"""Works that a model rests on: those that the instrument states and those of what it uses, no others."""

from __future__ import annotations

import pytest
from one_arm import one_arm

from walop_jax.fit.model_file import model_without_data
from walop_jax.instruments.description import parsed
from walop_jax.model.instrument import build, nominal_instrument
from walop_jax.model.references import bibtex, references

RETARDER = """
[elements.plate]
kind = "retarder"
delta = 1.0
"""


def cited(source: str, filters=()):
    text = one_arm("OTHER", ["plate"], RETARDER, head=source, degree=1)
    model = model_without_data(build(parsed(text, "a text")))
    return {entry.what: entry.source for entry in references(model, filters)}


def test_an_instrument_of_others_does_not_rest_on_the_paper_of_walop_calibration():
    """Elements and sources may name it for their own equations; the instrument does not."""
    assert "the instrument and its calibration" not in cited("")
    stated = cited('source = "Smith et al. 2020, A&A 1, 2"')
    assert stated["the instrument and its calibration"] == "Smith et al. 2020, A&A 1, 2"


def test_walop_south_still_names_it():
    found = references(model_without_data(nominal_instrument("WALOP-SOUTH")))
    assert found[0].what == "the instrument and its calibration"
    assert "Maharana et al. 2022" in found[0].source
    assert "maharana2022" in bibtex(found, "1")


@pytest.mark.parametrize(
    ("filters", "there"), [(("SDSS-r",), True), (("MONO-6500", "mine"), False), ((), False)]
)
def test_a_curve_is_cited_where_it_is_used(filters, there):
    assert any("Doi et al. 2010" in source for source in cited("", filters).values()) == there
