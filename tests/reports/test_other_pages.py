"""Pages about comparisons, epochs and limits: true to their files, honest about what is missing."""

from __future__ import annotations

import json

import handmade_run
import numpy as np
import pytest
from astropy.table import Table
from html_page import Page
from own_instrument import OWN

from walop_jax.io.errors import DataError
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.reports.page import _noise_alone, kind_of_run, render, render_other
from walop_jax.reports.run import read_limits, read_run
from walop_jax.science.field_accuracy import FieldAccuracy


def test_page_of_a_comparison(tmp_path):
    numbers = {"median": 0.0123, "rms": 0.02, "p95": 0.03, "max": 0.04, "share_below_goal": 0.875}
    methods = {m: {"all": dict.fromkeys("qup", numbers)} for m in ("paper", "joint")}
    document = {"on_grid": methods, "between": methods, "joint_errors_from": "covariance"}
    (tmp_path / "comparison.json").write_text(json.dumps(document))
    (tmp_path / "comparison_map.png").write_bytes(b"\x89PNG")
    assert kind_of_run(tmp_path) == "comparison"
    text, missing = render_other(tmp_path, "comparison")
    page = Page(text)
    assert page.row("on the grid points")[2:] == ["Paper II", "0.012", "0.020", "0.030", "0.040", "87.5 %"]
    assert len(page.images) == 1
    assert len(missing) == 3
    (tmp_path / "comparison.json").write_text("{}")
    with pytest.raises(DataError, match="has no 'on_grid'"):
        render_other(tmp_path, "comparison")


def test_page_of_an_epoch(tmp_path):
    moved = {"name": "half1.wedge", "unit": "rad", "old": -0.23, "new": -0.2289, "error": 0.00021, "z": 5.2}
    document = {"fits": False, "p_value": 1e-5, "test": 60.0, "directions": 20, "moved": [moved],
                "star_errors": {"p": {"median": 0.012, "max": 0.2}}}  # fmt: skip
    (tmp_path / "epoch.json").write_text(json.dumps(document))
    assert kind_of_run(tmp_path) == "epoch"
    page = Page(render_other(tmp_path, "epoch")[0])
    assert page.row("half1.wedge") == ["half1.wedge", "−0.23000", "−0.22890", "+5.2", "rad"]
    assert "The instrument has changed" in page.text
    assert "half1 for the half of the pupil with HWP1" in page.text
    assert "The change of the instrument matrix is not drawn" in page.text
    assert not page.images


def test_an_epoch_shows_what_has_changed_of_the_matrix(tmp_path):
    for name in ("old", "new"):
        (tmp_path / name).mkdir()
        handmade_run.make_refit(tmp_path / name)
    document = {
        "fits": True, "p_value": 0.5, "moved": [], "star_errors": {"p": {"median": 0.0, "max": 0.0}},
        "old_file": str(tmp_path / "old"), "old_date": "2026-01-01T20:00:00", "new_files": ["b.fits"],
    }  # fmt: skip
    (tmp_path / "new" / "epoch.json").write_text(json.dumps(document))
    text, missing = render_other(tmp_path / "new", "epoch")
    assert missing == ()
    assert len(Page(text).images) == 1


def test_an_epoch_whose_own_fit_is_not_trusted_says_so(tmp_path):
    document = {
        "fits": False, "p_value": 0.0, "test": 812.25, "directions": 9, "new_trusted": False,
        "moved": [], "star_errors": {"p": {"median": 6.7, "max": 120.4}}, "warnings": ["χ²/dof = 5.99"],
        "diagnosis": {"steps": [{"effect": "ghost", "p_value": 1e-9, "equivalent": ["pedestal"]}], "unexplained": None},
    }  # fmt: skip
    (tmp_path / "epoch.json").write_text(json.dumps(document))
    html = render_other(tmp_path, "epoch")[0]
    text = Page(html).text
    assert "The new data are not explained" in text
    assert "up to 120\N{NO-BREAK SPACE}%" in html
    assert "χ²/dof = 5.99" in text
    assert "cannot distinguish it from pedestal" in text


def test_an_epoch_that_cannot_be_compared_shows_no_numbers_and_one_of_the_same_data_no_zeros(tmp_path):
    numbers = dict.fromkeys(
        ("p_value", "test", "directions", "largest", "visible", "chi2_old", "star_errors")
    )
    document = {
        "verdict": "The new data are not explained", "fits": None, "moved": [], "new_trusted": False,
        "warnings": ["χ²/dof = 5.99"], "diagnosis": None,
    } | numbers  # fmt: skip
    (tmp_path / "epoch.json").write_text(json.dumps(document))
    text = Page(render_other(tmp_path, "epoch")[0]).text
    assert "The new data are not explained" in text
    assert "significant" not in text
    assert "would bias" not in text
    assert "What has moved" not in text
    moved = {"name": "half1.wedge", "unit": "rad", "old": -0.23, "new": -0.23, "error": 1e-9, "z": 0.0}
    document = {
        "fits": True, "p_value": 1.0, "moved": [moved], "same": True,
        "star_errors": {"p": {"median": 9.5e-15, "max": 1e-13}},
    }  # fmt: skip
    (tmp_path / "epoch.json").write_text(json.dumps(document))
    page = Page(render_other(tmp_path, "epoch")[0])
    assert "nothing can have moved" in page.text
    assert "e-15" not in page.text
    assert "What has moved" not in page.text


def test_the_change_and_its_size_stand_at_the_head_of_the_page_of_an_epoch(tmp_path):
    largest = {
        "name": "hwp1_axis.angle",
        "size": 0.0507,
        "error": 0.0006,
        "unit": "deg",
        "z": 83.5,
        "alone": True,
    }
    document = {
        "fits": False, "p_value": 0.0, "moved": [], "new_trusted": True, "added": ["hwp1_axis"], "largest": largest,
        "star_errors": {"p": {"median": 0.013, "max": 0.2}},
    }  # fmt: skip
    (tmp_path / "epoch.json").write_text(json.dumps(document))
    text = Page(render_other(tmp_path, "epoch")[0]).text
    assert "The new data need hwp1_axis, which the old model lacks." in text
    assert "hwp1_axis.angle by 0.05070 ± 0.00060 deg, if it alone has changed" in " ".join(text.split())


def test_page_of_a_survey(tmp_path):
    """How good tonight, what has changed and what was done in the order of time, each night with its own trust."""
    found = {
        "kind": "step",
        "name": "half1.wedge",
        "unit": "rad",
        "size": -0.00123,
        "error": 0.00004,
        "z": -30.8,
        "night": 61012,
        "nights": [61011, 61013],
        "before": 61011.9,
        "after": 61012.9,
        "alike": ["hwp1_axis.angle"],
    }
    nights = [
        {
            "night": 61010 + k,
            "mjd": 61010.9 + k,
            "chi2": 900.0 + 300 * (k == 3),
            "dof": 900,
            "excess": 7.1 * (k == 3),
        }
        for k in range(4)
    ]
    document = {
        "trusted": True,
        "nights": 4,
        "first": 61010.85,
        "last": 61013.95,
        "valid_until": 61017.5,
        "error_of_p": 0.000234,
        "breaks": [found],
        "events": [{"mjd": 61012.4, "what": "HWP1 remounted"}],
        "laws": {"half1.wedge": {"per": ["step"]}},
        "by_night": nights,
        "advice": ["Calibrate again before MJD 61017.5."],
        "warnings": [],
    }
    columns = {
        "MJD": [n["mjd"] for n in nights],
        "VALUE": [0.1] * 4,
        "ERROR": [0.01] * 4,
        "DEVIATION": [0.0] * 4,
        "DEVIATION_ERR": [0.02] * 4,
        "NAME": ["half1.wedge"] * 4,
        "UNIT": ["rad"] * 4,
    }
    (tmp_path / "survey.json").write_text(json.dumps(document))
    assert kind_of_run(tmp_path) == "survey"
    text, missing = render_other(tmp_path, "survey")
    assert ("tracks.fits" in missing[0], len(Page(text).images)) == (True, 1)
    Table(columns).write(tmp_path / "tracks.fits")
    page = Page(render_other(tmp_path, "survey")[0])
    assert len(page.images) == 2
    assert "p of a star is known to 0.023 % or better in 95 % of the field" in page.text
    assert "Calibrate again before MJD 61017.5." in page.text
    wanted = [
        "61012 (61011 … 61013)",
        "step",
        "half1.wedge",
        "−0.001230",
        "0.000040",
        "rad",
        "−30.8",
        "hwp1_axis.angle",
    ]
    assert page.row("61012 (61011 … 61013)") == wanted
    assert page.row("61013") == ["61013", "1.333", "+7.1", "not trusted"]
    assert page.text.index("HWP1 remounted") > page.text.index("61011 … 61013")
    (tmp_path / "survey.json").write_text(
        json.dumps(document | {"trusted": False, "warnings": ["χ²/dof = 3"]})
    )
    assert "Not trusted: the laws do not explain the nights" in render_other(tmp_path, "survey")[0]


def test_limits_come_back_from_their_file(tmp_path):
    found, written = read_limits(handmade_run.make_limits(tmp_path) / "limits.json"), handmade_run.limits()
    assert found.limits[1].named == np.inf
    assert repr(found) == repr(written)
    for name in ("separation", "x", "y", "protection"):
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))
    (tmp_path / "limits.json").write_text('{"limits": [], "effects": [], "protection": {}}')
    with pytest.raises(DataError, match="walop-jax limits"):
        read_limits(tmp_path / "limits.json")


def test_page_of_limits(tmp_path):
    assert kind_of_run(handmade_run.make_limits(tmp_path)) == "limits"
    page = Page(render_other(tmp_path, "limits")[0])
    assert page.row("ghost.share") == ["ghost.share", "0.00041", "0.00052", "", "0.030 … 1.2", ""]
    assert page.row("clp_zero.angle") == ["clp_zero.angle", "0.012 … 0.40", "never", "deg", "", "clp_wobble"]
    assert (
        "could still bias q or u by 0.030 % (median over the field, stars with p ≤ 5 %; 1.2 % at worst): ghost.share"
        in page.text
    )
    assert "chwp_axis" in page.text


def test_limits_of_the_same_data_stand_beside_the_accuracy(tmp_path):
    """And those of other data are left out, and said to be."""
    handmade_run.make_limits(handmade_run.make_refit(tmp_path))
    accuracy = FieldAccuracy(np.full((4, 4), 0.001), (-0.2, 0.2, -0.2, 0.2), "band")
    page = Page(render(read_run(tmp_path), accuracy))
    assert "A mistake too small to be detected" in page.text
    assert "clp_zero.angle" in page.text
    handmade_run.make_limits(tmp_path, sha256="cd" * 32)
    found = read_run(tmp_path)
    assert found.limits is None
    assert any("of other data" in sentence for sentence in found.missing)


def test_noise_alone_depends_on_the_number_of_cameras(tmp_path):
    """A flux is fitted to the cameras of a row: 1 − 1/K is left, whatever the page said of four."""
    (tmp_path / "own.toml").write_text(OWN)
    two, four = Instrument.read(tmp_path / "own.toml"), nominal_instrument()
    for design, left in ((two, "0.5"), (four, "0.75")):
        assert _noise_alone(design.cameras) == left


def test_page_of_a_watch(tmp_path):
    group = {
        "time": 61220.8, "stars": 40, "chi2_per_dof": 1.02,
        "gain": {"O1": 0.0093, "E1": None}, "error": {"O1": 0.0004, "E1": None},
    }  # fmt: skip
    document = {"holds": False, "changes": [{}], "groups": [group], "warnings": ["O1 is brighter by 0.93 %"]}
    (tmp_path / "watch.json").write_text(json.dumps(document))
    assert kind_of_run(tmp_path) == "watch"
    text, missing = render_other(tmp_path, "watch")
    page = Page(text)
    assert "The calibration has changed" in page.text
    assert "O1 is brighter by 0.93" in page.text
    assert "+0.93 ± 0.04" in text.replace("\N{NO-BREAK SPACE}", " ")
    assert missing == ("watch.png is not there.",)
