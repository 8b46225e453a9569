"""Fit, limits, certificate and commissioning state one number for what could hide, the largest of one table."""

from __future__ import annotations

import re

from small_run import SEED, SMALL

import walop_jax as walop
from walop_jax.fit.verdict import DATA, EFFECT
from walop_jax.simulation.simulate import simulate


def percent(text: str) -> tuple[str, ...]:
    """Median and largest of a sentence."""
    return tuple(re.findall(r"([\d.]+) %", text)[:2])


def test_every_command_states_the_largest_of_one_table():
    fitted = walop.refit(simulate(SMALL, seed=SEED).calset)
    limits = walop.limits(fitted)
    answer = walop.check(fitted)
    facts = dict(answer.display().facts)
    level = re.sub("p ≤ 5 %", "", limits.protection_in_words())
    (check,) = [one for one in answer["commissioning"].checks if one.name == "protection"]
    assert percent(facts["undetectable"]) == percent(level) == percent(check.found)
    worst = limits.mistakes[0]
    assert worst.name in facts["caused by"]
    assert worst.name in level
    assert worst.name in check.found
    assert worst.error[0] == max(one.error[0] for one in limits.mistakes)
    document = limits.document()["could_hide"]
    assert document[0]["name"] == worst.name
    rows = limits.display().rows
    titles = [i for i, row in enumerate(rows) if row[0] in ("EFFECTS", "ERRORS IN THE DATA")]
    assert len(titles) == 2
    assert {one.kind for one in limits.mistakes} == {EFFECT, DATA}
    for first, last in ((titles[0] + 1, titles[1]), (titles[1] + 1, len(rows))):
        sizes = [float(row[4].split(" … ")[0].replace("−", "-")) for row in rows[first:last] if row[4]]
        assert sizes == sorted(sizes, reverse=True)
