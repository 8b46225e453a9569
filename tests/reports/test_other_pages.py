"""Pages about other results than a fit: true to what was displayed, honest about what is missing."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import handmade_run
import numpy as np
import pytest
from astropy.table import Table
from html_page import Page

import walop_jax as walop
from walop_jax.io import names
from walop_jax.io.display import Display
from walop_jax.io.errors import DataError
from walop_jax.reports.page import kind_of_run, render, render_other
from walop_jax.reports.run import read_limits, read_run
from walop_jax.reports.survey_figures import nights_figure, tracks_figure

SHOWN = Display(
    "The instrument HAS CHANGED",
    (("largest change", "hwp1_axis.angle by 0.05070 ± 0.00060 deg"),),
    ("parameter", ">old", ">new", "unit"),
    (("half1.wedge", "-0.23000", "-0.22890", "rad"),),
    ("67 more in to_table()",),
)


def written(folder: Path, kind: str, **document: Any) -> tuple[str, tuple[str, ...]]:
    """The page about a folder with such a document, and what it lacks."""
    (folder / names.DOCUMENTS[kind]).write_text(json.dumps({"shown": SHOWN.document(), **document}))
    assert kind_of_run(folder) == kind
    return render_other(folder, kind)


DOCUMENTS: dict[str, dict[str, Any]] = {
    "comparison": {"trusted": True},
    "plan": {},
    "survey": {
        "trusted": True,
        "laws": {},
        "breaks": [],
        "events": [],
        "by_night": [{"night": 1, "mjd": 1.9, "chi2": 9.0, "dof": 9, "excess": 0.0}],
    },
    "check": {"go": True, "watch": {"holds": True, "shown": SHOWN.document()}},
}


@pytest.mark.parametrize("kind", DOCUMENTS)
def test_displayed_text_is_on_the_page(tmp_path: Path, kind: str):
    html, _ = written(tmp_path, kind, **DOCUMENTS[kind])
    page = Page(html)
    assert 'class="verdict good"' in html
    assert page.row("half1.wedge") == ["half1.wedge", "−0.23000", "−0.22890", "rad"]
    for words in (SHOWN.title, SHOWN.facts[0][1], *SHOWN.notes):
        assert words in page.text
    assert html.index(SHOWN.facts[0][1][:15]) < html.index("<main>")
    lacking = {key: False for key in DOCUMENTS[kind] if key in ("trusted", "go")}
    if lacking:
        html, _ = written(tmp_path, kind, **DOCUMENTS[kind] | lacking, warnings=["χ²/dof = 5.99"])
        assert 'class="verdict good"' not in html
        assert "χ²/dof = 5.99" in html.partition("<main>")[0].replace("\N{NO-BREAK SPACE}", " ")
        assert ('class="untrusted"' in html) == (kind != "check")


@pytest.mark.parametrize("name", [name for name in names.DOCUMENTS if name != "summary"])
def test_every_folder_is_read_and_says_what_was_displayed(tmp_path: Path, name: str):
    """Of whichever command: the document as it is, and its verdict."""
    document = {"shown": SHOWN.document()}
    (tmp_path / names.DOCUMENTS[name]).write_text(json.dumps(document))
    run = walop.read(tmp_path)
    assert isinstance(run, walop.Run)
    assert run.documents == {name: json.loads(json.dumps(document))}
    assert re.search(rf"{name} +{SHOWN.title}", repr(run))


def test_a_document_that_holds_nothing_displayed_is_refused(tmp_path: Path):
    (tmp_path / "comparison.json").write_text("{}")
    with pytest.raises(DataError, match=r"comparison.json: has no 'shown'"):
        render_other(tmp_path, "comparison")


@pytest.mark.parametrize(
    ("kind", "name", "lacking"), [("comparison", "comparison_map.png", 3), ("check", "watch.png", 0)]
)
def test_pictures_that_the_command_has_drawn(tmp_path: Path, kind: str, name: str, lacking: int):
    (tmp_path / name).write_bytes(b"\x89PNG")
    html, missing = written(tmp_path, kind, **DOCUMENTS[kind])
    assert len(Page(html).images) == 1
    assert len(missing) == lacking
    assert ('class="scrolls"' in html) == ('class="hint"' in html) == (kind == "comparison")


def test_an_epoch_shows_what_has_changed_of_the_matrix(tmp_path: Path):
    for name in ("old", "new"):
        (tmp_path / name).mkdir()
        handmade_run.make_refit(tmp_path / name)
    (tmp_path / "new" / "summary.json").unlink()

    def epoch(folder: Path, **document: Any) -> tuple[str, tuple[str, ...]]:
        return written(folder, "check", epoch={**document, "shown": SHOWN.document()})

    html, missing = epoch(tmp_path / "new", fits=True, old_file=str(tmp_path / "old"))
    assert missing == ()
    assert len(Page(html).images) == 1
    html, missing = epoch(tmp_path, fits=False, old_file="lost.fits")
    assert "The change of the instrument matrix is not drawn" in missing[0]
    html, missing = epoch(tmp_path, fits=False, old_file=None)
    assert "the old calibration was in memory" in missing[0]
    for same in ({}, {"fits": None}, {"fits": True, "same": True}):
        html, missing = epoch(tmp_path / "new", **same, old_file=str(tmp_path / "old"))
        assert (missing, Page(html).images) == ((), [])


def test_the_tracks_of_a_survey(tmp_path: Path):
    nights = [{"night": k, "mjd": k + 0.9, "chi2": 900.0, "dof": 900, "excess": 0.0} for k in range(4)]
    document = {
        "trusted": True, "by_night": nights, "breaks": [], "events": [],
        "laws": {"half1.wedge": {"per": ["step"]}},
    }  # fmt: skip
    html, missing = written(tmp_path, "survey", **document)
    assert ("tracks.fits" in missing[0], len(Page(html).images)) == (True, 1)
    columns = {
        "MJD": [n["mjd"] for n in nights],
        "VALUE": [0.1] * 4,
        "ERROR": [0.01] * 4,
        "DEVIATION": [0.0] * 4,
        "DEVIATION_ERR": [0.02] * 4,
        "NAME": ["half1.wedge"] * 4,
        "UNIT": ["rad"] * 4,
    }
    micrometres = tracks_figure(Table(columns | {"UNIT": ["um"] * 4}), document)
    assert micrometres.axes[0].get_ylabel() == "half1.wedge\n(µm)"
    Table(columns).write(tmp_path / "tracks.fits")
    assert len(Page(written(tmp_path, "survey", **document)[0]).images) == 2


def test_a_bad_night_is_marked_where_it_was():
    """Not half way to the night before it, where its time begins."""
    mjd = [61220.9, 61235.9, 61250.9, 61251.9]
    table = Table(
        {"NIGHT": [3, 4, 5, 6], "MJD": mjd, "NAME": ["half1.wedge"] * 4, "UNIT": ["rad"] * 4}
        | {name: [0.1] * 4 for name in ("VALUE", "ERROR", "DEVIATION", "DEVIATION_ERR")}
    )
    bad = {
        "name": "half1.wedge",
        "kind": "bad night",
        "night": 5,
        "before": 61243.4,
        "after": 61251.4,
        "date": 61243.4,
    }
    document = {"breaks": [bad], "events": [], "laws": {}}
    for rows, expected in ((table, mjd[2]), (table[[0, 1, 3]], 0.5 * (61243.4 + 61251.4))):
        (axis,) = tracks_figure(rows, document).axes
        dashed = [line for line in axis.lines if line.get_linestyle() == "--"]
        assert [line.get_xdata()[0] for line in dashed] == [
            pytest.approx(expected - 40587.0)
        ]  # days since 1970


@pytest.mark.parametrize(
    ("days", "events", "width"),
    [([0.85], [], 1.0), ([0.85, 0.87], [], 1.0), ([0.85], [3.85], 3.3), ([0.85, 10.85], [], 11.0)],
)
def test_dates_are_drawn_over_their_own_days(days, events, width):
    """A single date has no extent: matplotlib would draw a tenth of all days since 1858."""
    nights = [{"mjd": 61220.0 + day, "excess": 1.0} for day in days]
    figure = nights_figure({"by_night": nights, "events": [{"mjd": 61220.0 + day} for day in events]})
    low, high = figure.axes[0].get_xlim()
    assert low < 61220.85 - 40587 < high  # days since 1970
    assert high - low == pytest.approx(width, abs=0.05)


def test_limits_come_back_from_their_file(tmp_path: Path):
    found, made = read_limits(handmade_run.make_limits(tmp_path) / "limits.json"), handmade_run.limits()
    assert found.limits[1].named == np.inf
    assert repr(found) == repr(made)
    for name in ("separation", "x", "y", "protection"):
        np.testing.assert_array_equal(getattr(found, name), getattr(made, name))
    (tmp_path / "limits.json").write_text('{"limits": [], "effects": [], "protection": {}}')
    with pytest.raises(DataError, match="walop-jax limits"):
        read_limits(tmp_path / "limits.json")


def test_page_of_limits(tmp_path: Path):
    assert kind_of_run(handmade_run.make_limits(tmp_path)) == "limits"
    page = Page(render_other(tmp_path, "limits")[0])
    assert page.row("ghost.share") == ["ghost.share", "0.00041", "0.00052", "", "0.030 … 1.2", ""]
    assert page.row("clp_zero.angle") == ["clp_zero.angle", "0.012 … 0.40", "never", "deg", "", "clp_wobble"]
    assert "bias q or u by 0.030 % (median over the field, stars with p ≤ 5 %; 1.2 % at worst)" in page.text
    assert "chwp_axis" in page.text
    assert len(page.images) == 2


def test_limits_of_the_same_data_stand_beside_the_fit(tmp_path: Path):
    """And those of other data are left out, and said to be."""
    handmade_run.make_limits(handmade_run.make_refit(tmp_path))
    text = Page(render(read_run(tmp_path))[0]).text
    assert "clp_zero.angle" in text
    assert "99 % probability: 2 amplitudes" in text.replace("\N{NO-BREAK SPACE}", " ")
    handmade_run.make_limits(tmp_path, sha256="cd" * 32)
    found = read_run(tmp_path)
    assert found.limits is None
    assert any("of other data" in sentence for sentence in found.missing)
