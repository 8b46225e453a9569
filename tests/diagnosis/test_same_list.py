"""The verdict of a fit and a diagnosis ask the same list, and correct for it alike."""

import copy
import dataclasses

import numpy as np
import pytest
from fits_with import examined_with, fit_with, set_with
from small_run import small_fit

from walop_jax.diagnosis import thresholds, trust
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.examination import Examination, examine
from walop_jax.diagnosis.grammar import hypotheses
from walop_jax.diagnosis.hypotheses import Hypotheses
from walop_jax.diagnosis.score import corrected_p
from walop_jax.diagnosis.trust import candidate_scores
from walop_jax.likelihood import limits
from walop_jax.model.effects import EFFECTS
from walop_jax.model.effects.change import Change


def test_a_fit_and_a_diagnosis_score_alike():
    """Candidate by candidate; the number of independent trials by draws of both, to what the draws allow."""
    result = small_fit()
    model, calset = result.model, result.calset
    listed = hypotheses(EFFECTS, model.template, calset.exposures, len(calset.points))
    # A verdict asks each name; a diagnosis has names of the same change as one candidate, unless told otherwise.
    diagnosed = examine(result, listed, np.random.default_rng(0), synonyms_apart=True).table
    fitted = candidate_scores(Design.of(result))
    assert {score.name for score in fitted.scores} <= {score.name for score in diagnosed.scores}
    assert len(fitted.scores) > 0.9 * len(diagnosed.scores)  # patterns have scores of their own
    assert fitted.trials == pytest.approx(diagnosed.trials, rel=0.5)
    smallest = min(score.log_p for score in fitted.scores if score.testable)
    assert fitted.p_global == pytest.approx(corrected_p(smallest, fitted.trials))
    apart = [
        score.statistic * fitted.noise_scale**2 - diagnosed[score.name].statistic * diagnosed.noise_scale**2
        for score in fitted.scores
        if score.rank == diagnosed[score.name].rank
    ]
    assert np.max(np.abs(apart)) < 1.0  # a diagnosis allows single exposures a disturbance of their own


def test_columns_of_some_points_at_a_time_score_as_all_together(monkeypatch):
    """29 points in one piece, and in two: the products of their rows add up."""
    monkeypatch.setattr(limits, "RESPONSES_TOGETHER", 16)
    design = Design.of(small_fit())
    assert 16 < len(design.fit.calset.points) < trust.POINTS_TOGETHER
    together = candidate_scores(design)
    monkeypatch.setattr(trust, "POINTS_TOGETHER", 16)
    in_pieces = candidate_scores(design)
    assert [score.name for score in in_pieces.scores] == [score.name for score in together.scores]
    assert in_pieces.trials == pytest.approx(together.trials, rel=1e-3)  # draws are in single precision
    for found, expected in zip(in_pieces.scores, together.scores, strict=True):
        assert found.rank == expected.rank
        assert found.statistic == pytest.approx(expected.statistic, rel=1e-7, abs=1e-9)
        assert found.log_bayes == pytest.approx(expected.log_bayes, rel=1e-7, abs=1e-9)


@pytest.mark.parametrize(("factor", "like"), [(1.0, True), (1.02, False)])
def test_columns_serve_again_while_the_expected_counts_hardly_change(factor, like):
    """Throughput and fluxes may have changed by a factor in common: light is what a column is made of."""
    design = Design.of(small_fit())
    measured = copy.copy(design.measured)
    measured.model, measured.flux = factor * 1.3 * measured.model, measured.flux / 1.3
    earlier = object.__new__(Examination)
    vars(earlier)["design"] = design
    assert earlier.is_like(dataclasses.replace(design, measured=measured)) == like
    # Columns that come from another fit are as old as that fit.
    vars(earlier)["design"] = dataclasses.replace(design, measured=measured, served_by=design.measured)
    assert earlier.is_like(design)
    assert earlier.is_like(dataclasses.replace(design, measured=measured)) == like


def test_columns_of_a_fit_that_expects_the_same_are_its_own_to_that_accuracy():
    """A retarder of 0.01 rad is found; the model with it is asked again with the columns of the model without it."""
    text = "retardance q behind collimator"
    calset = set_with(5, {text: 0.01})
    earlier = examined_with(fit_with(calset))
    later = examine(fit_with(calset, text), Hypotheses(), np.random.default_rng(0), earlier)
    assert later.design.columns is earlier.design.columns
    own = Design.of(later.result)
    assert own.columns is not earlier.design.columns
    asked = [[(1.0, Change.parsed(other))] for other in ("retardance u behind collimator", "gain of O1 * x")]
    near, exact = later.design.columns.of(asked), own.columns.of(asked)
    assert 0.0 < np.linalg.norm(near - exact) < 2.0 * thresholds.LINEAR * np.linalg.norm(exact)
