"""A diagnosis in memory is its product everywhere: the mean over what its data leave open, not the last fit alone."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
from class_scene import TOLD, diagnosed, told

import walop_jax as walop
from walop_jax.calibration.calibration import Calibration
from walop_jax.commands.diagnose import write
from walop_jax.diagnosis.class_product import averaged
from walop_jax.fit.verdict import Quality
from walop_jax.simulation.observing_plan import ObservingPlan

X, Y = np.array([0.1, -0.2]), np.array([0.05, 0.2])


@pytest.fixture(scope="module")
def product() -> Calibration:
    """The mean over the class, made here of the plain fit."""
    result, classes = told()
    return averaged(Calibration.from_fit(result.with_verdict()), classes)


@pytest.fixture(params=["diagnosis", "its last fit"])
def given(request):
    return diagnosed() if request.param == "diagnosis" else diagnosed().after


def test_the_product_is_not_the_fit(product):
    plain = Calibration.from_fit(told()[0].with_verdict())
    (m, c), (one, alone) = product.matrix(X, Y), plain.matrix(X, Y)
    assert np.all(np.abs(m[:, 0] - one[:, 0]) > 2 * np.sqrt(alone[:, 0, 0]))
    assert np.all(c[:, 0, 0] > 5 * alone[:, 0, 0])


def test_matrices_are_those_of_the_product(given, product):
    table = walop.matrix(given, X, Y)
    m, c = product.matrix(X, Y)
    np.testing.assert_allclose(table["M21"], m[:, 0], rtol=1e-12)
    np.testing.assert_allclose(table["M21_ERR"], np.sqrt(c[:, 0, 0]), rtol=1e-6)
    assert np.all(np.asarray(table["FLAG"]) >= 0)


def test_stars_are_calibrated_with_the_product(given, product):
    counts = np.array([[5.0, 4.8, 4.9, 5.1], [4.9, 5.0, 5.2, 4.8]]) * 1e5
    stars = {"X": X, "Y": Y, "N": counts, "N_ERR": np.sqrt(counts)}
    ours, theirs = walop.apply(given, stars), walop.apply(product, stars)
    plain = walop.apply(Calibration.from_fit(told()[0].with_verdict()), stars)
    for name in ("Q", "U", "Q_ERR", "U_ERR", "CHI2"):
        np.testing.assert_array_equal(ours[name], theirs[name])
    assert np.all(np.abs(ours["Q"] - plain["Q"]) > 3e-4)


def test_it_is_certified_as_the_product(given, product):
    found = walop.check(given)["commissioning"]
    assert not found.go
    assert found.content == diagnosed().calibration().content_hash()
    assert [check.name for check in found.failed] == ["explains the data", "parents"]  # no files
    assert "only a class of causes" in found.failed[0].found


def test_its_light_path_is_that_of_the_product(given, product):
    ours, theirs = (walop.trace(one, x=0.1, y=0.05, q=0.02) for one in (given, product))
    assert repr(ours) == repr(theirs)


def test_it_is_cited_with_the_sentences_of_the_class(given, product):
    assert walop.cite(given) == walop.cite(product)


def test_it_cannot_be_sampled_as_one_fit(given):
    with pytest.raises(walop.DataError, match=r"mean over .* refit"):
        walop.sample(given)


def test_its_figures_are_of_the_product(given, product):
    from walop_jax.reports.run import FigureSource

    source = FigureSource.of(given)
    np.testing.assert_array_equal(source.required_calibration.covariance, product.covariance)
    assert walop.plot(given, "matrix") is not None


@pytest.mark.parametrize("whole", [True, False])
def test_it_is_saved_as_the_product(whole, product, tmp_path):
    if whole:
        write(diagnosed(), tmp_path / "RUN")
    else:
        diagnosed().after.save(tmp_path / "RUN")
    again = walop.read(tmp_path / "RUN").calibration
    for ours, theirs in zip(again.matrix(X, Y), product.matrix(X, Y), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-15)
    assert again.verdict.quality & Quality.CLASS_ONLY


def test_its_page_names_the_class(tmp_path):
    walop.report(diagnosed(), tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "only a class of causes was named" in page
    assert TOLD in page


def test_a_plan_adds_to_what_the_product_knows(given, product):
    could = ObservingPlan(grid=3, polariser_angles=(0.0, 45.0, 90.0, 135.0), moon_patches=2, standards=2)
    ours, theirs = (
        walop.plan(could, minutes=10.0, after=one, draws=1).document() for one in (given, product)
    )
    assert ours["value"] == pytest.approx(theirs["value"])


def test_limits_are_those_of_its_last_fit(given):
    found = walop.limits(given)
    assert {one.effect for one in found.limits}


def test_every_function_that_takes_a_fit_takes_a_diagnosis():
    """The annotations of all public functions, one by one."""
    for name in walop.__all__:
        one = getattr(walop, name)
        for parameter in inspect.signature(one).parameters.values() if hasattr(one, "command") else ():
            if "FitResult" in str(parameter.annotation):
                assert "Diagnos" in str(parameter.annotation), f"{name}: {parameter}"
