"""The page about a run: whole by itself, true to the files, honest about what is missing."""

from __future__ import annotations

import base64
import dataclasses
import json
import re

import handmade_run
import pytest
from builders import exposures
from calibration_in_words import changed
from handmade_run import FIT, FOUND
from html_page import Page
from matplotlib.figure import Figure

from walop_jax.io.display import Display, signed
from walop_jax.io.errors import DataError
from walop_jax.io.text import probability, value_and_error, with_error
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.posterior.run import Run
from walop_jax.reports import page as page_module
from walop_jax.reports.page import render
from walop_jax.reports.run import read_run
from walop_jax.reports.wording import data_in_words, effect_in_words


def page_of(folder) -> Page:
    return Page(render(read_run(folder))[0])


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A fit and a diagnosis, as `refit` and `diagnose` leave them."""
    runs = tmp_path_factory.mktemp("runs")
    return handmade_run.make_refit(runs / "run"), handmade_run.make_diagnosis(runs / "a <i>run")


@pytest.fixture(scope="module")
def drawn(folders):
    """Their pages with all figures."""
    return [render(read_run(folder))[0] for folder in folders]


@pytest.fixture
def blank_figures(monkeypatch):
    """For what is not about figures: drawing them takes most of the time of a page."""
    monkeypatch.setattr(page_module, "draw", lambda name, source: Figure())


@pytest.fixture
def refitted(folders, blank_figures):
    return render(read_run(folders[0]))[0]


@pytest.fixture
def diagnosed(folders, blank_figures):
    return render(read_run(folders[1]))[0]


def test_page_stands_by_itself(drawn):
    for text in drawn:
        page = Page(text)
        for reference in page.references:
            inside = reference.startswith("data:image/") or reference.removeprefix("#") in page.ids
            assert inside, reference[:80]
        outside = re.sub(r"data:image/[^\"]*", "", text)
        assert not re.search(r"https?:|url\(|@import|<script|<link|<iframe", outside)
        assert all(image["alt"] for image in page.images)


def test_figures_of_a_narrow_screen_have_the_width_of_a_column(drawn):
    """89 mm, so that panels go below each other and type is of 7 pt; nothing has to be moved sideways."""
    for text in drawn:
        narrow = re.findall(
            r'media="screen and \(max-width: 40rem\)" srcset="data:image/svg[^,]*,([^"]*)"', text
        )
        assert len(narrow) == len(Page(text).images)
        for svg in map(base64.b64decode, narrow):
            (width,) = re.findall(rb'<svg [^>]*width="([0-9.]+)pt"', svg)
            assert float(width) == pytest.approx(89.0 / 25.4 * 72.0, abs=0.1)
        assert "scroll sideways" not in text


def test_every_word_that_is_displayed_is_on_the_page(diagnosed, refitted):
    for text, displays in ((refitted, [FIT]), (diagnosed, [FIT, FOUND])):
        page = Page(text)
        for shown in displays:
            assert shown.title in page.text or shown is not displays[-1]
            for _, words in shown.facts:
                assert words in page.text
            for row in shown.rows:
                assert [signed(cell) for cell in row] in page.rows
            for note in shown.notes:
                assert note in page.text


def test_the_answer_comes_first(diagnosed, refitted):
    for text, shown in ((refitted, FIT), (diagnosed, FOUND)):
        head = text.partition("<main>")[0]
        assert 'class="verdict good"' in head
        assert f"<strong>{shown.title}</strong>" in head
        assert shown.facts[0][1] in head.replace("\N{NO-BREAK SPACE}", " ")


@pytest.mark.parametrize("rows", [3, 100])
def test_a_long_table_is_folded_with_its_facts_and_notes(rows):
    shown = Display(
        "of it all",
        (("limited by", "clouds"),),
        ("name", ">value"),
        tuple((f"a{k}", "1") for k in range(rows)),
        ("no more",),
    )
    section = page_module.Section("numbers", "Numbers", shown)
    text = page_module.filled(
        Display("yes"), [section], good=True, untrusted=False, title="", name="", about="", first=""
    )
    assert [text.count(words) for words in ("clouds", "no more", "<details>")] == [1, 1, int(rows > 32)]


def test_a_no_go_stands_first(tmp_path, blank_figures):
    folder = handmade_run.make_refit(tmp_path / "run")
    row = ("NO", "p known to 0.050 % in 50 % of the field", "0.088 % in 50 % of the field, 0.050 % allowed")
    shown = Display(
        "run/calibration.fits", head=("", "requirement", "result"), rows=(row,), notes=("more light",)
    )
    told = {"go": False, "answer": "no go", "product": handmade_run.product().content_hash()}
    told["commissioning"] = {"shown": shown.document()}
    (folder / "check.json").write_text(json.dumps(told))
    text = render(read_run(folder))[0]
    page = Page(text)
    assert page.headings[0] == "Go or no-go"
    assert text.index("No go") < text.index("Fit of WALOP-SOUTH")
    assert list(row) in page.rows
    assert "more light" in page.text
    assert 'class="verdict good"' not in text


def test_every_section_is_there(drawn):
    refitted, diagnosed = drawn
    both = [
        "Warnings",
        "Instrument matrix",
        "Largest pulls from the priors",
        "Parameters",
        "Inputs and versions",
    ]
    page = Page(refitted)
    assert page.headings == ["The data", *both, "Missing from this page"]  # the data of a run made by hand
    assert len(page.images) == 2
    page = Page(diagnosed)
    assert [heading for heading in page.headings if heading in both] == both
    assert {"Findings", "Residuals before and after", "Candidates"} <= set(page.headings)
    assert len(page.images) == 6  # maps, curves, ladder, shares, matrix, errors
    assert "cos(3θ − 57°), θ the polariser angle" in page.text


def test_a_diagnosis_without_additions_has_its_figures(tmp_path):
    """Residual maps of the one model, shares, matrix and errors: nothing to compare, no ladder."""
    folder = handmade_run.make_diagnosis(tmp_path / "run", verdict="consistent", steps=[])
    page = page_of(folder)
    assert "Residuals" in " ".join(page.headings)
    assert len(page.images) == 4


def test_numbers_are_those_of_the_files(diagnosed):
    page = Page(diagnosed)
    for name in ("throughput.n0.p00", "half1.efficiency"):  # which are not displayed
        entry = handmade_run.SUMMARY["parameters"][name]
        assert page.row(name)[1:] == [
            *(value_and_error(entry["value"], entry["sigma"])[:1]),
            value_and_error(entry["value"], entry["sigma"])[1] or "fixed",
            entry["unit"],
        ]
    assert page.row("ghost")[2:] == ["4.75", "0.64"]
    # (15.7512 − 15.63) / 0.05 and (−0.23012 + 0.23) / 0.001, the farthest first
    pulls = [row for row in page.rows if len(row) == 5 and row[4].startswith(("+", "−"))]
    assert [(row[0], row[4]) for row in pulls] == [
        ("pupil.magnification", "+2.42"), ("clp_wobble.amplitude", "+0.61"), ("half1.wedge", "−0.12"),
    ]  # fmt: skip


def test_names_are_escaped(diagnosed):
    assert "<b>one" not in diagnosed
    assert "&lt;b&gt;one&lt;/b&gt; &amp; two.fits" in diagnosed
    assert "a <i>run" not in diagnosed
    assert "half1.wedge lies <far> out" in Page(diagnosed).text


def test_missing_pieces_are_named(tmp_path):
    run = handmade_run.make_diagnosis(tmp_path / "run")
    (run / "diagnosis.fits").unlink()
    (run / "calibration.fits").write_bytes(b"no FITS")
    found = read_run(run)
    html, missing = render(found)
    text = Page(html).text
    assert [sentence.split()[0] for sentence in missing] == ["calibration.fits", "diagnosis.fits"]
    assert all(" ".join(sentence.split()) in " ".join(text.split()) for sentence in missing)


def test_files_of_different_diagnoses_are_not_mixed(tmp_path):
    run = handmade_run.make_diagnosis(tmp_path / "run", steps=[], verdict="consistent")
    handmade_run.write_figure_data(run / "diagnosis.fits", handmade_run.figure_data(), overwrite=True)
    assert "diagnosis.fits is of another diagnosis" in read_run(run).missing[0]
    handmade_run.make_refit(run, chi2=1300.0)
    assert "diagnosis.json is of another fit" in read_run(run).missing[1]


def test_a_summary_with_the_necessary_keys_alone_is_enough(tmp_path, blank_figures):
    run = handmade_run.make_refit(tmp_path / "run")
    keys = ("chi2", "dof", "n_data", "parameters", "converged", "message", "versions", "inputs", "shown")
    (run / "summary.json").write_text(json.dumps({key: handmade_run.SUMMARY[key] for key in keys}))
    assert "trusted" in page_of(run).text
    (run / "summary.json").write_text(json.dumps({key: handmade_run.SUMMARY[key] for key in keys[:-1]}))
    with pytest.raises(DataError, match=r"summary.json: does not hold its display \('shown'\)"):
        render(read_run(run))


def test_patterns_without_a_name(tmp_path):
    step = handmade_run.DIAGNOSIS["steps"][0]
    unexplained = {
        "p_value": 1e-30, "description": "left", "patterns": [{"pattern": "gradients", "p_value": 1e-30}],
    }  # fmt: skip
    steps = [step, step | {"effect": "free_form"}]
    run = handmade_run.make_diagnosis(
        tmp_path / "run", verdict="unexplained", steps=steps, unexplained=unexplained
    )
    html = render(read_run(run))[0]
    assert 'class="verdict good"' not in html
    page = Page(html)
    assert page.row("gradients") == ["gradients", "< 10⁻¹⁵"]
    assert len(page.images) == 9  # two steps (the second of a kind that has no name), rms over all exposures
    assert "walop-jax apply" not in page.text
    # More exposures do not explain an unknown effect: the next step is what the diagnosis saw.
    assert "walop-jax plan" not in page.text
    assert "say what makes gradients" in page.text
    assert "--effects OWN.toml" in page.text


def test_page_of_an_untrusted_fit(tmp_path, blank_figures):
    misfit = {"sentences": ["mean squared residual by camera: O1 3.25"]}
    run = handmade_run.make_refit(tmp_path / "run", trusted=False, quality=8192, misfit=misfit)
    html = render(read_run(run))[0]
    assert '<body class="untrusted">' in html
    head = Page(html.partition("<main>")[0] + "</body></html>").text
    assert "half1.wedge lies <far> out" in head
    page = Page(html)
    assert "Flag: the model does not explain the data." in page.text
    assert "mean squared residual by camera: O1 3.25" in page.text
    assert "walop-jax apply" not in page.text
    assert "Accuracy of p over the field" not in page.headings


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda run: (run / "summary.json").unlink(), "holds no summary.json; give the RUN"),
        (lambda run: (run / "summary.json").rename(run / "summary.failed.json"), "did not converge"),
        (lambda run: (run / "summary.json").write_text("{"), "summary.json: cannot be read"),
        (lambda run: (run / "summary.json").write_text('{"chi2": 1}'), "summary.json: has no 'dof'"),
        (lambda run: (run / "summary.json").write_text("[1]"), "summary.json: is no document of a run"),
    ],
)
def test_other_folders_are_refused(tmp_path, spoil, said):
    run = handmade_run.make_refit(tmp_path / "run")
    spoil(run)
    with pytest.raises(DataError, match=re.escape(said)):
        read_run(run)


@pytest.mark.parametrize(
    ("value", "sigma", "shown"),
    [
        (0.0613, 0.0012, ("0.0613", "0.0012")),
        (2408.2491, 0.7512, ("2408.25", "0.75")),
        (-1234.5, 67.0, ("−1234", "67")),
        (1.2346e-10, 2.2e-12, ("1.235e-10", "2.2e-12")),
        (0.5, 0.0, ("0.5", "")),
        (None, None, ("–", "")),
    ],
)
def test_two_digits_of_the_error(value, sigma, shown):
    assert value_and_error(value, sigma) == shown


def test_probabilities_in_words():
    assert [probability(p) for p in (0.426, 2.13e-7, 1e-300, 0.0, None)] == [
        "= 0.43", "= 2.1 × 10⁻⁷", "< 10⁻¹⁵", "< 10⁻¹⁵", "unknown",
    ]  # fmt: skip


def test_a_sampled_run_shows_its_posterior(tmp_path, blank_figures):
    run = handmade_run.make_refit(tmp_path / "run")
    (run / "posterior.nc").write_bytes(b"")
    assert [s.split()[0] for s in read_run(run).missing] == [
        "sample.json",
        "posterior_corner.png",
        "Residuals",
    ]
    row = ("pupil.magnification", "15.751", "0.021", "", "15.709 … 15.793", "812")
    head = ("coefficient", ">median", ">error", "unit", ">95 %", ">effective samples")
    shown = Display("Posterior: trusted", (("chains", "converged after 5000 steps"),), head, (row,))
    (run / "sample.json").write_text(json.dumps({"trusted": True, "shown": shown.document()}))
    (run / "posterior_corner.png").write_bytes(b"\x89PNG")
    page = page_of(run)
    assert list(row) in page.rows
    assert "converged after 5000 steps" in page.text
    assert "M pupil.magnification" in page.text
    assert page.images[-1]["src"] == "data:image/png;base64,iVBORw=="


def test_limits_on_what_was_not_found(tmp_path, blank_figures):
    limit = {
        "effect": "ghost",
        "parameter": "share",
        "unit": "",
        "value": 1e-4,
        "sigma": 2e-4,
        "below_95": 5e-4,
    }
    page = page_of(handmade_run.make_diagnosis(tmp_path / "run", limits=[limit]))
    assert ["ghost", "share", "0.00010", "0.00020", "0.0005", ""] in page.rows


def test_every_effect_has_words_of_its_own():
    words = [effect_in_words(effect.name) for effect in EFFECTS]
    assert len(set(words)) == len(EFFECTS)
    assert [text for text in words if len(text) < 15 or "=" in text] == []
    # Names keep their capital letter inside a sentence.
    assert {text.split()[0] for text in words if text[0].isupper()} == {"Stokes", "Wollaston"}


def test_an_effect_of_ones_own_has_those_of_its_docstring():
    class Mine(Effect):
        """Light of mine."""

        name = "of_mine"

    assert effect_in_words("of_mine", (*EFFECTS, Mine)) == "light of mine"
    assert effect_in_words("of_mine") == ""


def test_error_that_rounds_up_to_the_next_decade_keeps_two_digits():
    assert with_error(1.23456, 0.0996) == "1.23 ± 0.10"
    assert with_error(123456.0, 1234.0) == "123500 ± 1200"


def test_data_are_listed(tmp_path, blank_figures):
    text = " ".join(page_of(handmade_run.make_refit(tmp_path / "run")).text.split())
    assert "Exposures2 (2 through the polariser)" in text
    assert "Polariser angles2 modulo 180°, widest gap 135°" in text
    assert "Standardsnone" in text


def test_angles_that_are_one_are_counted_once():
    turned = exposures(*({"clp_angle": angle} for angle in (-1e-5, 0.0, 90.0, 180.0)))
    words = dict(data_in_words(changed(handmade_run.product(), exposures=turned)))
    assert words["Polariser angles"].startswith("2 modulo 180°, widest gap 90°")


def test_of_a_single_arm_no_plan_for_p_is_suggested(tmp_path, blank_figures):
    run = read_run(handmade_run.make_refit(tmp_path / "run"))
    assert "walop-jax plan" in Page(render(run)[0]).text
    maps = run.calibration.maps
    one_arm = dataclasses.replace(maps, values=maps.values[:3], errors=maps.errors[:3])
    calibration = changed(run.calibration, maps=one_arm)
    assert "walop-jax plan" not in Page(render(dataclasses.replace(run, calibration=calibration))[0]).text


def test_figures_are_drawn_from_the_run_that_was_given(tmp_path, monkeypatch):
    """With its effects and with its data, wherever they are: without these they could not be drawn."""
    drawn = []

    def draw(name, source):
        drawn.append((name, source.run.catalogue, source.run.data))
        return Figure()

    monkeypatch.setattr(page_module, "draw", draw)
    folder = handmade_run.make_refit(tmp_path / "run")
    render(read_run(Run(folder, EFFECTS[:2], ("elsewhere.fits",))))
    assert set(drawn) == {
        (name, EFFECTS[:2], ("elsewhere.fits",))
        for name in ("accuracy", "residuals", "matrix", "matrix-errors")
    }
