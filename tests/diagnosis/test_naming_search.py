"""The search itself, on candidates that are plain columns: what is fitted, what is added, and when it stops."""

import dataclasses

import numpy as np
import pytest
from linear_judge import Linear

from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.examination import Evidence
from walop_jax.diagnosis.hypotheses import Probe
from walop_jax.diagnosis.score import Projector, ScoreSpace
from walop_jax.diagnosis.search import State, search
from walop_jax.model.effects import Context, Described, effect_by_name

ROWS, PATTERN = 400, "a pattern without a name"
NAMES = ("clp_zero", "rotator_zero", "lens_birefringence")
SHARED = 0.97  # cosine between the first two names


def evidence(amplitudes, seed=1, noise=1.0):
    """Two names that are much alike, a third one and a pattern beside a base of two parameters.

    `noise` is that of the data, where errors were scaled to 1.
    """
    rng = np.random.default_rng(seed)
    base, columns = rng.standard_normal((ROWS, 2)), rng.standard_normal((ROWS, 4))
    columns /= np.linalg.norm(columns, axis=0)
    columns[:, 1] = SHARED * columns[:, 0] + np.sqrt(1.0 - SHARED**2) * columns[:, 1]
    residual = noise * rng.standard_normal(ROWS) - columns[:, : len(amplitudes)] @ amplitudes
    projector = Projector(base)
    residual = projector(residual)
    names, each = [*NAMES, PATTERN], np.split(columns, 4, axis=1)
    space = ScoreSpace.projected(projector, names, [np.full(1, 10.0)] * 4, each)
    scores, square = columns.T @ residual, float(residual @ residual)
    kinds = [effect_by_name(name) for name in NAMES]
    return Evidence(
        space=space,
        scores=scores,
        square=square,
        table=space.table(scores, square, space.smallest_p(np.random.default_rng(0))),
        probes=[Probe(k.name, k, (dataclasses.replace(k.neutral(Context())),)) for k in kinds],
        sentences=(),
        parts=(),
        patterns=[PATTERN],
        chi2=square,
        dof=space.free,
    )


class Counting(Linear):
    """A judge that counts its fits; `surprise` is by how much the fit of a name is better than its linear step."""

    def __init__(self, surprise=None):
        self.fits, self.surprise = [], surprise or {}

    def fitted(self, evidence, trial):
        self.fits.append(trial.effect.name)
        more = self.surprise.get(trial.effect.name, 0.0)
        noise = trial.noise if not self.surprise else False
        return dataclasses.replace(trial, evidence=trial.linear + more, noise=noise)


def names(state, judge):
    return [trial.effect.name for trial in search(State(state), judge).steps]


def test_nothing_is_tried_where_nothing_is_missing():
    judge = Counting()
    assert names(evidence([0.0]), judge) == judge.fits == []


def test_a_name_that_leaves_noise_is_the_only_one_that_is_fitted():
    judge = Counting()
    assert names(evidence([14.0]), judge) == ["clp_zero"]
    assert judge.fits == ["clp_zero"]


@pytest.mark.parametrize(("surprise", "expected"), [(0.5, "clp_zero"), (10.0, "rotator_zero")])
def test_a_fit_that_disagrees_with_its_linear_step_lets_the_next_rival_be_fitted(surprise, expected):
    """The leader turns out worse than thought by as much as the rival turns out better."""
    judge = Counting({"clp_zero": -surprise, "rotator_zero": surprise})
    assert names(evidence([14.0]), judge)[0] == expected
    assert ("rotator_zero" in judge.fits) == (surprise > thresholds.LINEAR_GOOD)


def test_two_effects_are_found_one_after_the_other():
    assert sorted(names(evidence([25.0, 0.0, 20.0]), Linear())) == ["clp_zero", "lens_birefringence"]


def test_what_a_pattern_explains_better_is_not_given_a_name():
    assert names(evidence([0.0, 0.0, 4.0, 30.0]), Linear()) in ([], ["lens_birefringence"])


def test_the_search_ends_after_the_steps_that_it_has(monkeypatch):
    monkeypatch.setattr(thresholds, "MOST_STEPS", 1)
    assert len(names(evidence([25.0, 0.0, 20.0]), Linear())) == 1


@pytest.mark.parametrize(("noise", "size"), [(0.2, 5.0), (1.0, 9.0), (2.0, 30.0)])
def test_patterns_are_compared_with_fits_in_the_unit_of_fits(noise, size):
    """A fit with errors of 1 has ln B = ½ s²/(1 + w⁻²) − ½ ln(1 + w²); a linear step counts in the noise itself.

    Were the units different, a fit that explains all would be refused for a pattern that explains less (noise 0.2), or
    preferred to one that explains more (noise 2).
    """
    here = evidence([12.0, 0.0, 0.0, size], noise=noise)
    along = float(here.scores[-1] / np.sqrt(here.space.gram[-1, -1]))
    width = 10.0 * float(np.sqrt(here.space.gram[-1, -1]))
    exact = 0.5 * along**2 / (1.0 + width**-2.0) - 0.5 * np.log(1.0 + width**2)
    assert here.best_pattern(fitted=True) == pytest.approx(exact, abs=3.0)
    assert here.best_pattern() == pytest.approx(here.table[PATTERN].log_bayes)
    assert 0.5 < here.best_pattern() * noise**2 / exact < 2.0
    assert here.stands(Described, exact + 3.0, True)
    assert not here.stands(Described, exact - 7.0, True)


class Refusing(Counting):
    """A judge by whose fits the first name does not predict held-out data."""

    def fitted(self, evidence, trial):
        fitted = super().fitted(evidence, trial)
        return dataclasses.replace(fitted, noise=False, predicts=trial.effect.name != NAMES[0])


def test_a_description_comes_before_a_less_probable_name_once_the_best_name_is_refused():
    """ln B ≈ 450, 0.97² 450 = 423, 312: the second one is a description, and is tried though it was not the best."""
    here = evidence([30.0, 0.0, 25.0])
    description = Probe(NAMES[1], Described, (Described.saying(["turn of polariser"], [0.0]),))
    here = dataclasses.replace(here, probes=[here.probes[0], here.probes[2]], sentences=[description])
    judge = Refusing()
    assert names(here, judge)[0] == Described.name
    assert judge.fits[:2] == [NAMES[0], Described.name]
