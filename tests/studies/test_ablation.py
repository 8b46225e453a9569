"""The switches of the ablation: every rule of the search is where the study replaces it, and shows where it decides."""

import sys
from pathlib import Path

import pytest

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parent / "benchmark")]

from ablation import RULES, SLOW, Rule, watched, without  # noqa: E402

from walop_jax.diagnosis import search  # noqa: E402
from walop_jax.diagnosis.exact import Trial  # noqa: E402
from walop_jax.diagnosis.findings import FitComparison  # noqa: E402
from walop_jax.model.effects import effect_by_name  # noqa: E402


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.text)
def test_every_rule_is_there_and_comes_back(rule: Rule):
    before = [getattr(owner, name) for owner, name in rule.places]
    with without(rule):
        now = [getattr(owner, name) for owner, name in rule.places]
        assert all(changed is not real for changed, real in zip(now, before, strict=True))
    assert [getattr(owner, name) for owner, name in rule.places] == before
    assert all(callable(getattr(owner, name)) for owner, name in (*rule.watched, *SLOW))


def test_a_name_that_left_out_data_speak_against_is_refused_by_one_rule_alone():
    worse = FitComparison(heldout_before=1.0, heldout_after=1.1)
    trial = Trial(effect_by_name("blemish"), 50.0, 10_825.0, leaves_noise=False, compared=worse)
    (rule,) = (rule for rule in RULES if rule.text.startswith("data that were left out"))
    with watched(RULES) as decided:
        assert search.against(trial).startswith("data that were left out agree worse")
    assert decided == {rule.text}
    with without(rule):
        assert search.against(trial) == ""
