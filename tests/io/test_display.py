"""What results show of themselves, in a terminal and in a notebook."""

from __future__ import annotations

from html.parser import HTMLParser

import numpy as np
import pytest
from small_run import small_fit

from walop_jax.calibration.calibration import Calibration
from walop_jax.io.display import Display
from walop_jax.io.text import value_and_error

SHOWN = Display(
    "A <title>", (("a", "1"), ("long", "2 & 3")), ("name", ">n"), (("x", "10"), ("yy", "5")), ("note",)
)


class Texts(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.cells: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1] in ("td", "th"):
            self.cells.append(data)


def test_text_is_aligned():
    assert SHOWN.text().splitlines() == [
        "A <title>",
        "  a     1",
        "  long  2 & 3",
        "  name   n",
        "  x     10",
        "  yy     5",
        "  note",
    ]


def test_numbers_have_minus_signs_and_names_keep_their_hyphens():
    shown = Display(
        "t", (("X", "-0.29 … +0.29° (-1)"), ("on", "2026-06-29, SDSS-r")), ("a",), (("-.5 deg-2",),), ("-1",)
    )
    for text in (shown.text(), shown.html()):
        assert "−0.29 … +0.29° (−1)" in text
        assert "2026-06-29, SDSS-r" in text
        assert "−.5 deg-2" in text
    assert shown.text().endswith("  -1")  # a note may be a command line


def test_html_nests_and_escapes():
    assert Texts(SHOWN.html()).cells == ["a", "1", "long", "2 & 3", "name", "n", "x", "10", "yy", "5"]
    assert "A &lt;title&gt;" in SHOWN.html()


def test_fit_shows_rounded_numbers_alike_in_text_and_html():
    result = small_fit()
    cells = Texts(result._repr_html_()).cells
    for name in ("half1.plate.quartz", "collimator.q"):
        value, error = value_and_error(*result.value(name))
        line = next(line for line in repr(result).splitlines() if line.split()[:1] == [name])
        assert line.split()[1:3] == [value, error]
        assert cells[cells.index(name) + 1 : cells.index(name) + 3] == [value, error]


def test_fit_says_what_it_does_not_show_and_what_the_data_do_not_constrain():
    text = repr(small_fit())
    assert "throughput.n1" not in text
    assert "60 throughput terms not shown" in text
    assert (
        "constrained only by their priors: chwp.quartz, chwp.mgf2" in text
    )  # the plate was never in the beam


def test_table_of_a_fit():
    result = small_fit()
    table = result.to_table()
    assert list(table["NAME"]) == list(result.model.names)
    np.testing.assert_array_equal(table["VALUE"], result.values)
    states = dict(zip(table["NAME"], table["STATE"], strict=True))
    assert states["throughput.n0.p00"] == "fixed"
    assert states["chwp.quartz"] == "prior only"
    assert states["half1.plate.quartz"] == "free"


def test_tied_parameters_say_so():
    from walop_jax.fit.parameter_table import parameter_rows

    result = small_fit()
    model = result.model.change("half2.plate.mgf2", tie="half1.plate.mgf2")
    row = next(r for r in parameter_rows(model, result.values, result.sigma) if r[0] == "half2.plate.mgf2")
    assert row[-1] == "tied to half1.plate.mgf2"


@pytest.mark.parametrize("what", ["calset", "calibration"])
def test_sets_and_calibrations_are_short(what):
    result = small_fit()
    shown = result.calset if what == "calset" else Calibration.from_fit(result)
    assert "WALOP-SOUTH" in repr(shown).splitlines()[0]
    assert len(repr(shown)) < 4000
    assert len(shown.to_table()) == (14 if what == "calset" else len(result.model.names))
