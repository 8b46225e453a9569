"""Everything that was tried or ranked has a reason for which it was not added, and the folder answers for it."""

import numpy as np
import pytest
from linear_judge import Linear
from test_naming_search import NAMES, evidence

from walop_jax.diagnosis.findings import of_diagnosis
from walop_jax.diagnosis.reasons import why
from walop_jax.diagnosis.search import State, search
from walop_jax.fit.verdict import Doubt, Quality, Verdict

STEP = {
    "effect": "clp_zero",
    "p_value": 1e-9,
    "log_bayes": 50.0,
    "equivalent": ["pupil_turn"],
    "sentences": [],
}
FOUND = {
    "verdict": "effect_found",
    "p_value": 1e-12,
    "steps": [STEP],
    "candidates": [
        {"effect": "clp_zero", "score": 110.0, "p_value": 1e-20},
        {"effect": "ghost", "score": 3.5, "p_value": 0.4},
        {"effect": "pupil_turn", "score": 99.0, "p_value": 1e-18},
    ],
    "rounds": [
        {
            "p_value": 1e-12,
            "added": "clp_zero",
            "asked": [
                {"name": "clp_zero", "evidence": 50.0, "p_value": 1e-20, "fitted": True, "reason": ""},
                {
                    "name": "pupil_turn", "evidence": 41.0, "p_value": 1e-18, "fitted": False,
                    "reason": "clp_zero is more probable, by 9 in ln B",
                },
            ],
        }
    ],
    "cannot_be_tested": ["chwp_axis"],
    "not_scored": {"turn of polariser": "it is an effect of the catalogue by another name"},
    "choices": [{"change": "half1.wedge turned by 90 deg", "left": 0.93, "better_by": None}],
    "limits": [{"effect": "ghost", "parameter": "share", "unit": "", "below_95": 2e-4}],
    "descriptions": 1234,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("clp_zero", ["was named (ln B = 50, p = 1.0 × 10⁻⁹)", "round 1: ln B = 50 fitted", "added"]),
        (
            "pupil_turn",
            [
                "by 9 in ln B; clp_zero was added",
                "ln B = 41 by a linear step",
                "cannot distinguish it from clp_zero",
            ],
        ),
        (
            "ghost",
            ["score is 3.5 (p = 0.4", "not significant by itself, so not tried", "share is below 0.0002"],
        ),
        ("chwp_axis", ["these data are insensitive to it"]),
        ("turn of polariser", ["by another name"]),
        ("half1.wedge turned by 90 deg", ["leaves 93 % of the squared residuals; it was not fitted"]),
        (
            "gain of O1 * x",
            ["one of 1234 descriptions", "round 1: the most probable was clp_zero (ln B = 50)"],
        ),
    ],
)
def test_the_answer_has_the_numbers(name, told):
    answer = why(FOUND, name)
    for text in told:
        assert text in answer


def test_where_nothing_was_missing_it_says_so():
    quiet = FOUND | {"verdict": "consistent", "p_value": 0.37, "steps": [], "rounds": []}
    assert "nothing was tried: of all candidates together p = 0.37" in why(quiet, "ghost")
    assert "nothing was tried: of all candidates together p = 0.37" in why(quiet, "gain of O1 * x")


def test_a_fit_without_evidence_is_told_without_a_number():
    asked = {
        "name": "ghost",
        "evidence": None,
        "p_value": 0.1,
        "fitted": True,
        "reason": "its fit did not converge",
    }
    rounds = [{"p_value": 1e-12, "added": "", "asked": [asked]}]
    assert "round 1: no ln B fitted, p = 0.1: its fit did not converge" in why(
        FOUND | {"rounds": rounds}, "ghost"
    )
    assert "the most probable" not in why(FOUND | {"rounds": rounds}, "gain of O1 * x")


def test_what_was_added_and_is_gone_is_told():
    assert "taken out again: the final model does not need it" in why(FOUND | {"steps": []}, "clp_zero")
    part = {"parts": ["clp_zero (χ²/dof 69 → 24)"]}
    assert "explains a part only" in why(FOUND | {"steps": [], "unexplained": part}, "clp_zero")


@pytest.mark.parametrize(("name", "near"), [("gohst", "ghost"), ("clp_zer0", "clp_zero")])
def test_a_name_that_nobody_knows_gets_the_nearest(name, near):
    with pytest.raises(
        ValueError, match=rf"no candidate of this diagnosis '{name}'; did you mean .*'{near}'"
    ):
        why(FOUND, name)


def test_every_candidate_of_a_search_has_one_reason():
    """Of two that are much alike one is added; the other, and what noise makes of the third, have their reasons."""
    state = search(State(evidence([14.0])), Linear())
    (turn,) = state.rounds
    reasons = {one.name: one.reason for one in turn.asked}
    assert turn.added == NAMES[0]
    assert reasons[NAMES[0]] == ""
    assert reasons[NAMES[1]] != ""
    assert all(np.isfinite(one.evidence) and 0.0 <= one.p_value <= 1.0 for one in turn.asked)
    assert len(reasons) == len(turn.asked)


def test_what_a_pattern_explains_better_is_told():
    state = search(State(evidence([0.0, 0.0, 4.0, 30.0])), Linear())
    reasons = [one.reason for turn in state.rounds for one in turn.asked if one.name != turn.added]
    assert all(
        "a pattern without a name is more probable" in text or "was added first" in text for text in reasons
    ), reasons


def test_a_diagnosis_does_not_send_to_a_diagnosis():
    """Its first line ended with "walop-jax diagnose looks for missing effects"."""
    doubts = (
        Doubt(
            Quality.UNEXPLAINED, "χ²/dof = 7; do not use this (walop-jax diagnose looks for missing effects)"
        ),
        Doubt(
            Quality.DOUBTED, "the residuals hold patterns (p = 1e-5): walop-jax diagnose looks for the cause"
        ),
        Doubt(Quality.UNEXPLAINED, "χ²/dof = 7"),
        Doubt(Quality.NOT_CONVERGED, "no step lowers χ² any more"),
    )
    fit = Verdict(doubts=doubts)
    assert all("walop-jax diagnose" in doubt.words for doubt in doubts[:3])
    found = of_diagnosis(fit, None, "Diagnosis", complete=False).doubts
    words = [doubt.words for doubt in found]
    assert not [text for text in words if "walop-jax diagnose" in text]
    assert words[0] == "χ²/dof = 7; do not use this; walop-jax report shows where it is"
    assert words[1] == "the residuals hold patterns (p = 1e-5); walop-jax report shows where it is"
    assert words[3] == doubts[3].words
    assert [doubt.bit for doubt in found[:4]] == [doubt.bit for doubt in doubts]
