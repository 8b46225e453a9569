"""`walop-jax sample`: a posterior beside a fit, kept, resumed, refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from walop_jax.calibration.product import read_calibration
from walop_jax.data.user_tables import read_input_table
from walop_jax.posterior.draws import read_draws

from .conftest import FittedSet

OWN = f"{Path(__file__).resolve().parents[1] / 'posterior' / 'random_walk.py'}:Metropolis"


@pytest.mark.long
def test_sample_writes_everything_and_resumes(call, fitted: FittedSet, tmp_path: Path):
    run = tmp_path / "RUN"
    shutil.copytree(fitted.run, run)
    before = read_calibration(run / "calibration.fits", any_model=True)
    short = call("sample", run, "--moves", "laplace", "--interval", 40, "--maximum-steps", 80)
    assert short.exit_code == 1
    assert "NOT converged" in short.stderr
    assert read_calibration(run / "calibration.fits", any_model=True).content_hash() == before.content_hash()
    assert json.loads((run / "sample.json").read_text())["converged"] is False
    assert call("sample", run, "--moves", "laplace", "--interval", 40).exit_code == 1, (
        "outputs are there already"
    )
    refused = call("sample", run, "--moves", "laplace", "--interval", 40, "--seed", 1, "--resume")
    assert refused.exit_code == 1
    assert "other settings" in refused.stderr

    done = call("sample", run, "--moves", "laplace", "--interval", 40, "--resume", "--json")
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["trusted"] is True
    assert found["steps"] > 50 * max(found["autocorrelation_steps"].values())
    for name in (
        "posterior.nc",
        "posterior.fits",
        "posterior.ecsv",
        "posterior_corner.png",
        "posterior_trace.png",
    ):
        assert (run / name).stat().st_size > 1000
    product = read_calibration(run / "calibration.fits", any_model=True)
    assert product.verdict.covariance_from == "posterior"
    np.testing.assert_array_equal(product.values, before.values)
    free = before.sigma > 0
    np.testing.assert_allclose(product.sigma[free] / before.sigma[free], 1.0, atol=0.25)
    draws = read_draws(run / "posterior.nc", product.model.names)
    np.testing.assert_allclose(draws.std(axis=0)[free], product.sigma[free], rtol=0.1)

    points = tmp_path / "points.csv"
    points.write_text("X,Y\n0.0,0.0\n0.2,-0.1\n")
    for name, options in (("linear", []), ("drawn", ["--posterior", run / "posterior.nc"])):
        result = call("matrix", run, "--points", points, "-o", tmp_path / f"{name}.ecsv", *options)
        assert result.exit_code == 0, result.stderr
    linear, drawn = (read_input_table(tmp_path / f"{name}.ecsv").table for name in ("linear", "drawn"))
    np.testing.assert_allclose(drawn["M32_ERR"], linear["M32_ERR"], rtol=0.3)
    np.testing.assert_allclose(drawn["M32"], linear["M32"], atol=float(max(linear["M32_ERR"])))


def test_sample_says_what_is_wrong(call, fitted: FittedSet, calset_file: Path, tmp_path: Path):
    assert "not a folder" in call("sample", calset_file).stderr
    assert call("sample", tmp_path).exit_code == 1
    run = tmp_path / "RUN"
    shutil.copytree(fitted.run, run)
    model = tmp_path / "model.toml"
    model.write_text('[model]\neffects = ["clp_zero"]\n')
    refused = call("sample", run, "--model", model)
    assert refused.exit_code == 1
    assert "another model" in refused.stderr
    assert "walks" in call("sample", run, "--moves", "walks").stderr
    assert "choose one of emcee, nuts, bootstrap, or give" in call("sample", run, "--sampler", "walk").stderr
    assert "no option" in call("sample", run, "--sampler", OWN, "--moves", "de").stderr
    assert not (run / "sampling").exists()


@pytest.mark.long
def test_a_sampler_of_ones_own(call, fitted: FittedSet, tmp_path: Path):
    """A file from outside the package: sampled, resumed, refused to another sampler, and on the page of the run."""
    run = tmp_path / "RUN"
    shutil.copytree(fitted.run, run)
    short = ("--sampler", OWN, "--interval", 250)
    done = call("sample", run, *short, "--maximum-steps", 250)
    assert done.exit_code == 1, done.stderr
    assert "NOT converged" in done.stderr
    assert json.loads((run / "sample.json").read_text())["sampler"] == "metropolis"
    more = call("sample", run, *short, "--maximum-steps", 500, "--resume", "--json")
    assert "the chain of metropolis is not kept: it started anew" in more.stderr
    found = json.loads(more.stdout)
    assert (found["sampler"], found["steps"], found["walkers"], found["ensembles"]) == (
        "metropolis",
        400,
        1,
        2,
    )
    assert found["surrogate"]["draws_checked"] > 0
    assert call("report", run).exit_code == 0
    assert "with metropolis" in (run / "report.html").read_text()


@pytest.mark.long
def test_nuts_from_the_command_line(call, fitted: FittedSet, tmp_path: Path):
    """The exact posterior, converged: covariance into the product, matrices by draws, the page."""
    pytest.importorskip("blackjax")
    run = tmp_path / "RUN"
    shutil.copytree(fitted.run, run)
    before = read_calibration(run / "calibration.fits", any_model=True)
    done = call("sample", run, "--sampler", "nuts", "--json")
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["sampler"], found["trusted"], found["surrogate"]) == ("nuts", True, None)
    assert found["sampler_counts"]["divergences"] == 0
    product = read_calibration(run / "calibration.fits", any_model=True)
    free = before.sigma > 0
    np.testing.assert_allclose(product.sigma[free] / before.sigma[free], 1.0, atol=0.25)
    points = tmp_path / "points.csv"
    points.write_text("X,Y\n0.0,0.0\n0.2,-0.1\n")
    options = ("--points", points, "-o", tmp_path / "drawn.ecsv", "--posterior", run / "posterior.nc")
    assert call("matrix", run, *options).exit_code == 0
    assert call("report", run).exit_code == 0
