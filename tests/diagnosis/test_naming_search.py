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


def evidence(amplitudes, seed=1, shared=SHARED, pattern_like=0.0):
    """Two names that are much alike, a third one and a pattern beside a base of two parameters; noise of unit size.

    `pattern_like` is the cosine between the first name and the pattern.
    """
    rng = np.random.default_rng(seed)
    base, columns = rng.standard_normal((ROWS, 2)), rng.standard_normal((ROWS, 4))
    columns /= np.linalg.norm(columns, axis=0)
    columns[:, 1] = shared * columns[:, 0] + np.sqrt(1.0 - shared**2) * columns[:, 1]
    columns[:, 3] = pattern_like * columns[:, 0] + np.sqrt(1.0 - pattern_like**2) * columns[:, 3]
    residual = rng.standard_normal(ROWS) - columns[:, : len(amplitudes)] @ amplitudes
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
        descriptions=(),
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
        noise = trial.leaves_noise if not self.surprise else False
        return dataclasses.replace(trial, evidence=trial.expected + more, leaves_noise=noise)


def names(state, judge):
    return [trial.effect.name for trial in search(State(state), judge).steps]


def test_nothing_is_tried_where_nothing_is_missing():
    judge = Counting()
    assert names(evidence([0.0]), judge) == judge.fits == []


def test_a_name_that_leaves_noise_is_the_only_one_that_is_fitted():
    judge = Counting()
    assert names(evidence([14.0]), judge) == ["clp_zero"]
    assert judge.fits == ["clp_zero"]


@pytest.mark.parametrize(
    ("surprise", "expected", "fitted"), [(0.5, "clp_zero", False), (10.0, "rotator_zero", True)]
)
def test_a_fit_that_disagrees_with_its_linear_step_lets_the_next_rival_be_fitted(surprise, expected, fitted):
    """The leader turns out worse than thought by as much as the rival turns out better.

    By linear steps ln B differs by ½ 14² (1 − 0.97²) = 5.8: less than 10, more than 2 × 0.5.
    """
    judge = Counting({"clp_zero": -surprise, "rotator_zero": surprise})
    assert names(evidence([14.0]), judge)[0] == expected
    assert ("rotator_zero" in judge.fits) == fitted


def test_two_effects_are_found_one_after_the_other():
    assert sorted(names(evidence([25.0, 0.0, 20.0]), Linear())) == ["clp_zero", "lens_birefringence"]


def test_what_a_pattern_explains_better_is_not_given_a_name():
    """Nor is what is weaker: it would be fitted without the pattern."""
    judge = Counting()
    assert names(evidence([0.0, 0.0, 9.0, 30.0]), judge) == []
    assert len(judge.fits) == 1


@pytest.mark.parametrize(("surprise", "named"), [(0.0, []), (30.0, ["clp_zero"])])
def test_a_name_that_a_pattern_imitates_is_asked_by_its_fit(surprise, named):
    """A truth that a name misses by 14 %: ½ 30² (1 − 0.99²) = 9 in ln B, which its fit may find or not."""
    judge = Counting({"clp_zero": surprise})
    assert names(evidence([0.0, 0.0, 0.0, 30.0], pattern_like=0.99), judge) == named
    assert judge.fits[0] == "clp_zero"


def test_the_search_ends_after_the_steps_that_it_has(monkeypatch):
    monkeypatch.setattr(thresholds, "MOST_STEPS", 1)
    assert len(names(evidence([25.0, 0.0, 20.0]), Linear())) == 1


class AskingOthers(Counting):
    """A judge by whose fits nothing is explained, so that what has no linear step is asked for; `asked` counts that."""

    def __init__(self):
        super().__init__()
        self.asked = 0

    def fitted(self, evidence, trial):
        return dataclasses.replace(
            super().fitted(evidence, trial), leaves_noise=False, remaining=evidence.chi2
        )

    def others(self, state):
        self.asked += 1
        return [], {}


@pytest.mark.parametrize(
    ("descriptions", "searched", "asked"), [(0, True, True), (2, True, False), (3, False, False)]
)
def test_with_descriptions_in_its_model_a_search_asks_for_less(descriptions, searched, asked):
    """A third one ends the search; beside any of them no other instrument is thought of (of a poor fit: χ²/dof 2)."""
    poor = evidence([0.0, 0.0, 25.0])
    (added,) = search(State(poor), Linear()).steps
    poor = dataclasses.replace(poor, chi2=2.0 * poor.dof)
    steps = tuple(dataclasses.replace(added, groups={f"change {k}": ()}) for k in range(descriptions))
    search(State(poor, steps=steps), judge := AskingOthers())
    assert (bool(judge.fits), bool(judge.asked)) == (searched, asked)


class Refusing(Counting):
    """A judge by whose fits the model is more probable without the name that is asked first."""

    def fitted(self, evidence, trial):
        fitted = super().fitted(evidence, trial)
        evidence = -1.0 if trial.effect.name == self.fits[0] else fitted.evidence
        return dataclasses.replace(fitted, leaves_noise=False, evidence=evidence)


def test_the_other_name_of_the_set_is_asked_once_the_most_probable_one_is_refused():
    """Two columns with a cosine of 0.999: ½ 14² (1 − 0.999²) = 0.2 in ln B, so that both are in the set."""
    judge = Refusing()
    (added,) = names(evidence([14.0], shared=0.999), judge)
    assert added == judge.fits[1]
    assert sorted(judge.fits) == sorted(NAMES[:2])


class Unconfirmed(Counting):
    """A judge who finds in data that were left out that they contradict the name that is asked first."""

    def confronted(self, evidence, trial):
        against = "KIND moon" if trial.effect.name == self.fits[0] else ""
        return dataclasses.replace(trial, against=against)


def test_the_other_name_of_the_set_is_asked_once_data_contradict_the_most_probable_one():
    """As above: both are in the set. Of a set of one name nothing is left to ask."""
    judge = Unconfirmed()
    (added,) = names(evidence([14.0], shared=0.999), judge)
    assert added == judge.fits[1]
    assert sorted(judge.fits) == sorted(NAMES[:2])
    judge = Unconfirmed()
    assert names(evidence([14.0]), judge) == []
    assert judge.fits == [NAMES[0]]


def test_a_name_that_is_improbable_is_not_asked_in_its_stead():
    """0.97: ½ 14² (1 − 0.97²) = 5.8 in ln B, a probability of 0.3 %."""
    judge = Refusing()
    assert names(evidence([14.0]), judge) == []
    assert judge.fits == [NAMES[0]]


class Gross(Linear):
    """A judge of a gross misfit: in its large errors a description has more evidence than the effect that explains all.

    `left` is the χ² that the effect leaves once the errors are settled, beside 5000 of the description.
    """

    def __init__(self, left):
        self.left = left

    def fitted(self, evidence, trial):
        found, left = (40.0, 5000.0) if trial.effect is Described else (35.0, self.left)
        return dataclasses.replace(trial, evidence=found, remaining=left, leaves_noise=False)


@pytest.mark.parametrize(
    ("scale", "left", "first"),
    [(10.0, 400.0, "clp_zero"), (10.0, 6000.0, "described"), (1.0, 400.0, "described")],
)
def test_of_a_gross_misfit_the_effect_is_fitted_beside_a_description(monkeypatch, scale, left, first):
    """Linear steps prefer the description, by ½ 30² (1 − 0.99²) = 9 in ln B, and count where no misfit is gross."""
    like = evidence([0.0, 0.0, 0.0, 30.0], pattern_like=0.99)
    description = Probe(PATTERN, Described, ())
    gross = dataclasses.replace(
        like, descriptions=(description,), patterns=[], scale=scale, chi2=40_000.0, dof=400
    )
    monkeypatch.setattr(thresholds, "MOST_STEPS", 1)
    (step,) = search(State(gross), Gross(left)).steps
    assert step.effect.name == first
