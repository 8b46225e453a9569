"""The switches of the ablation: every rule of the search is where the study replaces it, and shows where it decides."""

import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parent / "benchmark")]

from ablation import OF_LINEAR_STEPS, RULES, SLOW, Rule, watched, without  # noqa: E402

from walop_jax.diagnosis import search  # noqa: E402
from walop_jax.diagnosis.exact import Trial  # noqa: E402
from walop_jax.diagnosis.examination import Evidence  # noqa: E402
from walop_jax.model.effects import effect_by_name  # noqa: E402


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.text)
def test_every_rule_is_there_and_comes_back(rule: Rule):
    before = [getattr(owner, name) for owner, name in rule.places]
    with without(rule):
        now = [getattr(owner, name) for owner, name in rule.places]
        assert all(changed is not real for changed, real in zip(now, before, strict=True))
    assert [getattr(owner, name) for owner, name in rule.places] == before
    assert all(callable(getattr(owner, name)) for owner, name in (*rule.watched, *SLOW))


def test_a_name_that_explains_too_little_is_refused_by_one_rule_alone():
    """Of 1000 that are missing in χ² 717 are so surely: a quarter of them is 179, and 175 are explained."""
    evidence = Mock(
        Evidence,
        chi2=11_000.0,
        dof=10_000,
        poor=False,
        floor=1.0,
        evidence_needed=0.0,
        stands=lambda *_: True,
    )
    trial, rule = Trial(effect_by_name("blemish"), 50.0, 10_825.0, noise=False), RULES[0]
    with watched(OF_LINEAR_STEPS) as decided:
        assert search.refused(evidence, trial).startswith("it explains 175")
    assert decided == {rule.text}
    with without(rule):
        assert search.refused(evidence, trial) == ""
