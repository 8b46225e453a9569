"""The page about a run: whole by itself, true to the files, honest about what is missing."""

from __future__ import annotations

import json
import re

import handmade_run
import numpy as np
import pytest
from html_page import Page
from matplotlib.figure import Figure

from walop_jax.io.errors import DataError
from walop_jax.io.plain_tables import astropy_table, write_table
from walop_jax.io.text import probability, value_and_error, with_error
from walop_jax.model.effects import EFFECTS
from walop_jax.posterior.run import Run
from walop_jax.reports import page as page_module
from walop_jax.reports.page import render
from walop_jax.reports.run import read_run
from walop_jax.reports.wording import effect_in_words, verdict_of_diagnosis
from walop_jax.science.field_accuracy import FieldAccuracy


def number(text: str) -> float:
    return float(text.replace("−", "-"))


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory):
    folder = handmade_run.make_diagnosis(tmp_path_factory.mktemp("runs") / "a <i>run")
    return render(read_run(folder))


@pytest.fixture(scope="module")
def refitted(tmp_path_factory):
    return render(read_run(handmade_run.make_refit(tmp_path_factory.mktemp("runs") / "run")))


def test_page_stands_by_itself(diagnosed, refitted):
    for text in (diagnosed, refitted):
        page = Page(text)
        for reference in page.references:
            inside = reference.startswith("data:image/") or reference.removeprefix("#") in page.ids
            assert inside, reference[:80]
        outside = re.sub(r"data:image/[^\"]*", "", text)
        assert not re.search(r"https?:|url\(|@import|<script|<link|<iframe", outside)
        assert all(image["alt"] for image in page.images)


def test_a_commissioning_is_told_first(tmp_path):
    folder = handmade_run.make_refit(tmp_path / "run")
    asked = {
        "what": "p known to 0.050 % in 50 % of the field",
        "found": "0.088 %",
        "advice": "3.1 times the light",
    }
    told = {"go": False, "requirements": [{**asked, "met": False, "needed": True}]}
    (folder / "commissioning.json").write_text(json.dumps(told))
    text = render(read_run(folder))
    page = Page(text)
    assert page.headings[0] == "Go or no-go"
    assert "No-go – trusted" in page.text
    row = ("p known to 0.050 % in 50 % of the field (required)", "no", "0.088 %", "3.1 times the light")
    assert "".join(row) in page.text  # cells side by side
    assert 'class="verdict good"' not in text


def test_every_section_is_there(diagnosed, refitted):
    both = [
        "Warnings",
        "Instrument matrix",
        "Largest pulls from the priors",
        "Parameters",
        "Inputs and versions",
    ]
    page = Page(refitted)
    lacking = "What this page lacks"  # the data of a run made by hand
    assert page.headings == ["The data", "Residuals before and after the fit", *both, lacking]
    assert "The data of this run cannot be found" in page.text
    assert len(page.images) == 2
    page = Page(diagnosed)
    assert [heading for heading in page.headings if heading in both] == both
    wanted = {"What was found", "Residuals before and after", "Candidates", "What these data cannot test",
              "What is unexplained", "Where clp_wobble sits"}  # fmt: skip
    assert wanted <= set(page.headings)
    assert len(page.images) == 5  # maps, curves, shares, matrix, errors; two rungs are a sentence
    assert "What this page lacks" not in page.headings


def test_verdict_and_what_was_found(diagnosed):
    text = " ".join(Page(diagnosed).text.split())
    assert (
        "The starting model does not explain these data (χ²/dof = 1.625, p = 2.1 × 10⁻⁷). They are consistent with "
        "clp_wobble (error of the polariser's encoder, once per turn: amplitude = 0.0613 ± 0.0012 deg), with which "
        "χ²/dof is 1.029. They cannot distinguish clp_wobble from camera_gain_drift."
    ) in text
    assert "What would: polariser angles over a full turn." in text
    assert "caused by" not in text
    assert "cos(3θ − 57°), θ the polariser angle" in text
    assert "chwp_axis – fast axis of the calibration plate" in text


def test_numbers_are_those_of_the_files(diagnosed):
    page = Page(diagnosed)
    for name, entry in handmade_run.SUMMARY["parameters"].items():
        row = [row for row in page.rows if row and row[0] == name][-1]  # the table of pulls comes before
        assert number(row[1]) == pytest.approx(entry["value"], abs=0.06 * entry["sigma"])
        assert (
            row[2] == "fixed"
            if entry["sigma"] == 0
            else number(row[2]) == pytest.approx(entry["sigma"], rel=0.05)
        )
        assert row[3] == entry["unit"]
    assert "With clp_wobble χ² goes from 1950.2 (1200 degrees of freedom) to 1234.5 (1200)" in page.text
    assert "χ²/dof from 1.625 to 1.029" in page.text
    assert "noise alone gives about 0.75" in page.text
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
    text = Page(render(found)).text
    assert [sentence.split()[0] for sentence in found.missing] == ["calibration.fits", "diagnosis.fits"]
    assert all(" ".join(sentence.split()) in " ".join(text.split()) for sentence in found.missing)
    assert "The pictures of this diagnosis are not in the folder." in text


def test_files_of_different_diagnoses_are_not_mixed(tmp_path):
    run = handmade_run.make_diagnosis(tmp_path / "run", steps=[], verdict="consistent")
    handmade_run.write_figure_data(run / "diagnosis.fits", handmade_run.figure_data(), overwrite=True)
    assert "diagnosis.fits is of another diagnosis" in read_run(run).missing[0]
    handmade_run.make_refit(run, chi2=1300.0)
    assert "diagnosis.json is of another fit" in read_run(run).missing[1]


def test_a_summary_with_the_necessary_keys_alone_is_enough(tmp_path):
    run = handmade_run.make_refit(tmp_path / "run")
    keys = ("chi2", "dof", "n_data", "parameters", "converged", "message", "seconds", "versions", "inputs")
    (run / "summary.json").write_text(json.dumps({key: handmade_run.SUMMARY[key] for key in keys}))
    assert "Trusted" in Page(render(read_run(run))).text


def test_unexplained_and_unknown_names(tmp_path):
    step = handmade_run.DIAGNOSIS["steps"][0]
    many = {f"vectors_{i}": {"value": 0.1 * i, "sigma": 0.2, "unit": ""} for i in range(40)}
    steps = [step, step | {"effect": "free_form", "parameters": many, "equivalent": []}]
    unexplained = {"p_value": 1e-30, "description": "patterns <without> a name", "patterns": []}
    run = handmade_run.make_diagnosis(
        tmp_path / "run", verdict="unexplained", steps=steps, unexplained=unexplained
    )
    page = Page(render(read_run(run)))
    assert "Patterns <without> a name (p < 10⁻¹⁵)" in page.text
    assert "free_form (unidentified patterns: 40 parameters)" in " ".join(page.text.split())
    assert page.row("vectors_7")[1] == "0.70"
    assert len(page.images) == 9  # two steps (the second of a kind that has no name), rms over all exposures


def test_a_fit_that_is_not_trusted_says_so(tmp_path):
    misfit = {
        "camera": {"O1": 3.25}, "kind": {"clp": 4.0}, "filter": {"band": 4.0}, "calibration_plate": {"out": 4.0},
        "matrix_element": {"m21": 0.0123, "m22": None},
    }  # fmt: skip
    run = handmade_run.make_refit(tmp_path / "run", trusted=False, quality=8192, misfit=misfit)
    page = Page(render(read_run(run)))
    assert "Not trusted" in page.text
    assert "Flag: the model does not explain the data." in page.text
    assert ["", "m22", "–"] in page.rows
    assert ["rms disagreement over the field (%)", "m21", "1.23"] in page.rows


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
def test_what_is_no_run_is_refused(tmp_path, spoil, said):
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
        (1.2346e-10, 2.2e-12, ("1.235e−10", "2.2e−12")),
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


def test_consistent_data_are_called_so():
    found = {"verdict": "consistent", "steps": [], "p_value": 0.426, "chi2_per_dof_before": 1.002}
    label, sentence = verdict_of_diagnosis(found)
    assert label == "Consistent"
    assert "consistent with the starting model (χ²/dof = 1.002)" in sentence


def test_a_free_form_term_is_shown_as_what_it_is(tmp_path):
    unexplained = {
        "p_value": 1e-30, "description": "patterns without a name", "patterns": [], "free_form": ["harmonics"],
        "chi2_before": 1950.25, "chi2_after": 1234.5, "change_of_qu": 0.00123,
    }  # fmt: skip
    run = handmade_run.make_diagnosis(
        tmp_path / "run", verdict="unexplained", steps=[], unexplained=unexplained
    )
    handmade_run.write_figure_data(
        run / "diagnosis.fits", handmade_run.figure_data(("free_form",)), overwrite=True
    )
    found = read_run(run)
    assert found.missing == ()
    page = Page(render(found))
    text = " ".join(page.text.split())
    assert (
        "A free-form term (harmonics) stands for it in this calibration: χ² goes from 1950.2 to 1234.5"
        in text
    )
    assert "by at most 0.12 %" in text
    assert len(page.images) == 5


def test_a_sampled_run_shows_its_posterior(tmp_path):
    run = handmade_run.make_refit(tmp_path / "run")
    (run / "posterior.nc").write_bytes(b"")
    assert [s.split()[0] for s in read_run(run).missing] == [
        "sample.json",
        "posterior.ecsv",
        "posterior_corner.png",
        "Residuals",
    ]
    (run / "sample.json").write_text('{"message": "converged after 5000 steps", "trusted": true}')
    (run / "posterior_corner.png").write_bytes(b"\x89PNG")
    numbers = np.array([[15.751, 15.730, 15.772, 15.709, 15.793, 812.0], [0.5, 0.4, 0.6, 0.3, 0.7, np.nan]])
    names = ("MEDIAN", "LOW68", "HIGH68", "LOW95", "HIGH95", "ESS")
    columns = {"NAME": (np.array(["pupil.magnification", "throughput.n0.p00"]), "", "")}
    columns |= {"UNIT": (np.array(["", "deg"]), "", "")}
    columns |= {name: (values, "", "") for name, values in zip(names, numbers.T, strict=True)}
    write_table(run / "posterior.ecsv", astropy_table(columns))
    page = Page(render(read_run(run)))
    shown = ["pupil.magnification", "15.751", "0.021", "", "15.709", "15.793", "812"]
    assert shown in page.rows
    assert (
        sum(row[0] == "throughput.n0.p00" for row in page.rows) == 1
    )  # not sampled: with the parameters only
    assert "converged after 5000 steps – trusted." in " ".join(page.text.split())
    assert page.images[-1]["src"] == "data:image/png;base64,iVBORw=="


def test_limits_and_consequences(tmp_path):
    limit = {
        "effect": "ghost",
        "parameter": "share",
        "unit": "",
        "value": 1e-4,
        "sigma": 2e-4,
        "below_95": 5e-4,
    }
    step = handmade_run.DIAGNOSIS["steps"][0] | {
        "change_of_qu": 2e-5,
        "negligible": True,
        "robust_error_ratio": 2.5,
    }
    page = Page(render(read_run(handmade_run.make_diagnosis(tmp_path / "run", limits=[limit], steps=[step]))))
    assert ["ghost", "share", "0.00010", "0.00020", "0.0005", ""] in page.rows
    text = " ".join(page.text.split())
    assert "by at most 0.002 %, which hardly matters." in text
    assert "are 2.5 times as large" in text


def test_every_effect_has_words_of_its_own():
    from walop_jax.model.effects import EFFECTS

    words = [effect_in_words(effect.name) for effect in EFFECTS]
    assert len(set(words)) == len(EFFECTS)
    assert [text for text in words if len(text) < 15 or "=" in text] == []


def test_error_that_rounds_up_to_the_next_decade_keeps_two_digits():
    assert with_error(1.23456, 0.0996) == "1.23 ± 0.10"
    assert with_error(123456.0, 1234.0) == "123500 ± 1200"


def test_accuracy_comes_first_and_says_its_share(tmp_path):
    error = np.array([[2e-4, 5e-4], [9e-4, 0.02]])
    accuracy = FieldAccuracy(error, (-0.2, 0.2, -0.2, 0.2), "SDSS-r")
    page = Page(render(read_run(handmade_run.make_refit(tmp_path / "run")), accuracy))
    assert page.headings[:2] == ["Accuracy of p over the field", "The data"]
    text = " ".join(page.text.split())
    assert "uncertain by 0.070 % in the median of the field" in text  # of 0.02, 0.05, 0.09 and 2 %
    assert "over 75 % of the field" in text
    assert "Error of p, median of the field0.070 %" in text  # on the first screen
    assert "walop-jax apply run STARS.fits" in text


def test_what_is_not_trusted_looks_like_it(tmp_path):
    """No number stands out, figures are grey, and the accuracy is called what it would be."""
    accuracy = FieldAccuracy(np.full((2, 2), 5e-4), (-0.2, 0.2, -0.2, 0.2), "SDSS-r", trusted=False)
    html = render(read_run(handmade_run.make_refit(tmp_path / "run", trusted=False, quality=8192)), accuracy)
    assert '<body class="untrusted">' in html
    page = Page(html)
    text = " ".join(page.text.split())
    assert "If the model explained the data, the error would be 0.050 %" in text
    assert "<strong>0.050" not in html
    assert "not known: the calibration is not trusted" in text
    assert "walop-jax apply" not in text


def test_an_accuracy_beside_an_unidentified_residual_is_conditional(tmp_path):
    """The fit itself is trusted, so it is not that which is said to be at fault."""
    accuracy = FieldAccuracy(np.full((2, 2), 5e-4), (-0.2, 0.2, -0.2, 0.2), "SDSS-r", trusted=True)
    run = handmade_run.make_diagnosis(tmp_path / "run", verdict="unexplained")
    page = Page(render(read_run(run), accuracy))
    text = " ".join(page.text.split())
    assert "of the field, if nothing were missing" in text
    assert "An unidentified residual remains, and the covariance knows nothing of it." in text
    assert "The calibration is not trusted" not in text


def test_the_data_are_told_of(tmp_path):
    text = " ".join(Page(render(read_run(handmade_run.make_refit(tmp_path / "run")))).text.split())
    assert "Exposures2 (2 through the polariser)" in text
    assert "Polariser angles2 modulo 180°, widest gap 135°" in text
    assert "Standardsnone" in text


def test_figures_are_drawn_from_the_run_that_was_given(tmp_path, monkeypatch):
    """With its effects and with its data, wherever they are: without these they could not be drawn."""
    drawn = []

    def draw(name, source):
        drawn.append((name, source.run.catalogue, source.run.data))
        return Figure()

    monkeypatch.setattr(page_module, "draw", draw)
    folder = handmade_run.make_refit(tmp_path / "run")
    render(read_run(Run(folder, EFFECTS[:2], ("elsewhere.fits",))))
    assert drawn == [("residuals", EFFECTS[:2], ("elsewhere.fits",))]
