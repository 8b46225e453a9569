"""What users of other packages type first: a run answers like the fit, models and sets show their numbers."""

from __future__ import annotations

import numpy as np
from command import call

import walop_jax as walop

__all__ = ["call"]


def test_a_run_answers_like_its_fit(fitted):
    run, held = walop.read(fitted.run), fitted.calibration
    assert run.names == held.model.names
    np.testing.assert_array_equal(run.values, held.values)
    np.testing.assert_array_equal(run.covariance, held.covariance)
    np.testing.assert_array_equal(run.sigma, held.sigma)
    assert run["half1.wedge"] == held["half1.wedge"]
    assert run.trusted is held.verdict.trusted
    table = run.to_table()
    assert list(table["NAME"]) == list(held.model.names)
    assert "walop_jax" in type(run.plot("modulation")).__module__


def test_only_draws_are_called_a_posterior(fitted):
    run = walop.read(fitted.run)
    fit = run.fit()
    assert not hasattr(fit, "posterior")
    assert fit.expansion.chi2 == fit.chi2
    assert run.posterior is None  # nothing has been drawn


def test_a_model_shows_its_parameters(fitted):
    model = walop.base_model(walop.read(fitted.calset)).change("half1.wedge", free=False)
    table = model.to_table()
    row = table[table["NAME"] == "half1.wedge"][0]
    assert (row["STATE"], row["UNIT"], row["START"]) == ("fixed", "rad", -0.23)
    assert (row["PRIOR_MEAN"], row["PRIOR_SIGMA"]) == (-0.23, 0.001)
    assert repr(model).startswith("Model of WALOP-SOUTH: ")
    assert len(repr(model)) < 100
    written = walop.model(fitted.calset)
    assert "half1.wedge" in written.summary()
    assert "<table>" in written._repr_html_()


def test_intensities_print_as_a_line(fitted):
    intensities = walop.read(fitted.calset).intensities
    assert repr(intensities).startswith(f"{intensities.rows} rows of ")
    assert len(repr(intensities)) < 100


def test_a_set_becomes_arrays_and_comes_back(fitted):
    calset = walop.read(fitted.calset)
    arrays = calset.to_arrays()
    again = walop.from_arrays(**arrays)
    old, new = (one.intensities.block(0, len(one.points)) for one in (calset, again))
    for name in ("counts", "sigma", "used", "source", "x", "y"):
        np.testing.assert_array_equal(getattr(new, name), getattr(old, name))
    for name, column in calset.exposures.columns().items():
        np.testing.assert_array_equal(again.exposures.columns()[name], column)
    np.testing.assert_array_equal(again.sources.q, calset.sources.q)
    assert again.site == calset.site


def test_sources_print_as_lines(fitted):
    lines = repr(walop.cite(fitted.run)).splitlines()
    assert lines[1].startswith("polariser: Goldstein")
    assert len(lines) == len(walop.cite(fitted.run))


def test_figures_print_as_lines(call, fitted):
    figures = walop.plot(walop.read(fitted.run))
    assert repr(figures) == call("plot", fitted.run).stdout.rstrip("\n")
    assert len(repr(figures).splitlines()) == len(figures)


def test_measured_parameters_stand_first(fitted):
    states = [row[-1] for row in walop.read(fitted.run).display().rows if not row[0].startswith("standard.")]
    assert states == sorted(states, key=lambda state: state == "prior only")


def test_help_is_no_dump(capsys):
    for name in ("Model", "Run", "CalibrationSet"):
        help(getattr(walop, name))
        text = capsys.readouterr().out
        assert max(map(len, text.splitlines())) < 400, name


def test_commands_are_grouped_in_the_help(call):
    text = call("-h").output
    titles = [
        line.rstrip(":") for line in text.splitlines() if line.endswith(":") and not line.startswith(" ")
    ]
    assert titles[:4] == ["Options", "Begin", "Calibrate", "Correct stars"]
