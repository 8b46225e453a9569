"""Descriptions that say what another candidate says are one candidate with several names, and only those."""

from __future__ import annotations

import numpy as np
import pytest
from fits_with import examined_with
from small_run import small_fit

from walop_jax.calibration.could_hide import change_by_effect
from walop_jax.calibration.matrix import first_setting
from walop_jax.diagnosis.examination import Examination, examine
from walop_jax.diagnosis.grammar import descriptions
from walop_jax.diagnosis.hypotheses import Hypotheses, Probe, probes
from walop_jax.diagnosis.score import Projector, ScoreSpace
from walop_jax.diagnosis.synonyms import _same_to_the_data
from walop_jax.model.effects import EFFECTS, Context, Described
from walop_jax.model.effects.in_models import effect_context

TURNED = "retardance v behind polariser * r2", "retardance v behind collimator * r2"
LOST = "depolarisation of polariser * r2", "depolarisation behind collimator * r2"


def described(name: str) -> Probe:
    """A description of one number or, joined by "; ", of several."""
    group = tuple(Described.of(Context(), sentences=(text,)) for text in name.split("; "))
    return Probe(name, Described, group)


def test_spans_are_the_same_where_all_their_angles_are_small():
    """A plane in other coordinates, one tilted by 0.04 (cos² = 0.9984), one tilted by 0.05 in one direction alone."""
    a, b, c = (np.eye(12)[:, k] for k in range(3))
    turn = np.array([[2.0, 1.0], [-3.0, 0.5]])
    columns = {
        "axis of half1.plate; cut of half1.plate.mgf2": np.column_stack([a, b]),
        "axis of half2.plate; cut of half2.plate.mgf2": np.column_stack([a, b]) @ turn,
        "axis of half1.plate * x; axis of half1.plate * y": np.column_stack([a, b + np.tan(0.04) * c]),
        "axis of half2.plate * x; axis of half2.plate * y": np.column_stack([a, b + np.tan(0.05) * c]),
        "axis of half1.plate": a[:, None],
    }
    nothing_free = Projector(np.eye(12)[:, 11:])
    widths = [np.full(block.shape[1], 10.0) for block in columns.values()]
    space = ScoreSpace.projected(nothing_free, list(columns), widths, list(columns.values()))
    groups = list(_same_to_the_data(space, [described(name) for name in columns]))
    first, second, tilted, *_ = columns
    assert np.cos(0.04) > 0.999 > np.cos(0.05)
    assert [[probe.name for probe in group] for group in groups] == [[first, second, tilted]]


@pytest.fixture(scope="module")
def asked() -> Examination:
    return examined_with(small_fit(), (*TURNED, *LOST).__contains__)


def test_what_says_the_same_is_one_candidate(asked):
    """Behind the polariser there is the collimator alone: what turns light there turns it behind the collimator too."""
    assert asked.synonyms == {TURNED[0]: (TURNED[1],)}
    assert sorted(probe.name for probe in asked.descriptions) == sorted([TURNED[0], *LOST])
    assert set(asked.space.names) == set(asked.bare.names) == set(asked.candidates)
    assert TURNED[1] not in asked.candidates
    assert [row.name for row in asked.ranked_descriptions].count(TURNED[0]) == 1


def test_what_data_cannot_tell_apart_and_stars_can_stays_apart(asked):
    """Light through the polariser alone is depolarised, or all light: stars do not come through the polariser."""
    places, gram = asked.bare.places(), asked.bare.gram
    i, j = (places[name].start for name in LOST)
    assert abs(gram[i, j]) > 0.999 * np.sqrt(gram[i, i] * gram[j, j])
    fit, points = small_fit(), small_fit().calset.points
    instrument = fit.model.instrument(fit.values)
    setting = first_setting(fit.calset, instrument)
    sizes = {
        text: np.abs(
            change_by_effect(
                instrument, Described.saying([text], [0.01]), setting, fit.calset.filters, points.x, points.y
            )
        ).max()
        for text in LOST
    }
    assert sizes[LOST[0]] < 1e-12
    assert sizes[LOST[1]] > 1e-4


def test_a_name_of_the_catalogue_goes_before_what_describes_it():
    """Angles of the standards are wrong: their light is turned, wherever that is. The width is that of the name."""
    fit = small_fit()
    context = effect_context(fit.model.template, fit.calset.exposures)
    (name,) = probes([kind for kind in EFFECTS if kind.name == "standard_angles"], context)
    longer = "retardance v ahead of polariser * kind standard"
    every = descriptions(fit.model.template, fit.calset.exposures, len(fit.calset.points))
    some = [probe for probe in every if probe.name == longer]
    found = examine(fit, Hypotheses(names=[name], descriptions=some), np.random.default_rng(0))
    assert found.synonyms == {"standard_angles": (longer,)}
    assert not found.descriptions
    np.testing.assert_array_equal(found.candidates["standard_angles"].widths, name.widths)
    again = examine(fit, Hypotheses(names=[name]), np.random.default_rng(0))
    evidence = [one.table["standard_angles"].log_bayes for one in (found, again)]
    assert evidence[0] == pytest.approx(evidence[1], rel=1e-3)
    # Where the light has hardly changed, columns and names of an earlier examination serve again.
    later = examine(fit, Hypotheses(names=[name], descriptions=some), np.random.default_rng(0), found)
    assert (later.synonyms, later.descriptions) == (found.synonyms, ())
