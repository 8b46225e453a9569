"""The sentences of an instrument: their columns, and the names that are sentences with a history."""

import dataclasses

import builders
import numpy as np
import pytest
import scenes
from own_instrument import OWN
from scipy import stats

from walop_jax.data.records import Position
from walop_jax.diagnosis import grammar, thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.hypotheses import all_candidates, applicable, probes, texts_of
from walop_jax.diagnosis.score import ScoreSpace, ScoreTable
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.instruments.description import parsed
from walop_jax.likelihood.columns import Columns
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import EFFECTS
from walop_jax.model.effects.change import Change
from walop_jax.model.effects.in_models import effect_context
from walop_jax.model.instrument import build, nominal_instrument
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import simulate

LISTED = (
    "turn of polariser * x; turn of polariser * y",
    "retardance q behind collimator * hours; retardance u behind collimator * hours",
    "gain of E1 * exposure 3",
    "gain of E1 * kind moon * x; gain of E1 * kind moon * y",
    "turn of polariser * exposure 4",
    "diattenuation radial ahead of half2.wedge",
    "gain of half1 * ring 3; gain of half1 * ring 4; gain of half1 * ring 5; "
    "gain of half1 * ring 6; gain of half1 * ring 7; gain of half1 * ring 8",
    "depolarisation of polariser * cos 2 CLP; depolarisation of polariser * sin 2 CLP",
    "afterglow in O1",
    "displacement x ahead of pupil * kelvin; displacement y ahead of pupil * kelvin",
    "light of opposite in E2",
    "polarisation of sky",
    "polarisation q of sky * exposure 13; polarisation u of sky * exposure 13",
    "shift of band",
)
QUICK = (
    LISTED[:5] + LISTED[7:9] + LISTED[11:12]
)  # without derivatives of crystals and ghosts, which take half a minute
TURNING = ObservingPlan(
    grid=4, standard_grid=2, polariser_angles=(0.0, 72.0, 144.0, 36.0, 108.0, 18.0),
    plate=(None, 0.0, 45.0, 20.0, 60.0, 30.0), moon_patches=4, standards=4,
)  # fmt: skip
COMBINED = (  # a pattern over the field with a dependence of the exposures, by kinds and places
    "retardance radial behind collimator * kelvin",
    "diattenuation diagonal ahead of polariser * hours",
    "retardance q behind half1.plate * x * kelvin; retardance q behind half1.plate * y * kelvin; "
    "retardance u behind half1.plate * x * kelvin; retardance u behind half1.plate * y * kelvin",
    "retardance radial of polariser * cos 1 CLP; retardance radial of polariser * sin 1 CLP",
    "depolarisation of chwp * cos 2 CHWP * r2; depolarisation of chwp * sin 2 CHWP * r2",
    "diattenuation radial of chwp * cos 1 CHWP; diattenuation radial of chwp * sin 1 CHWP",
    "added polarisation q ahead of polariser * r2 * hours; added polarisation u ahead of polariser * r2 * hours",
    "light in E2 * kind moon",
    "gain of O2 * side CHWP",
    "gain of O2 * counts * kelvin; gain of E2 * counts * kelvin",
    "gain of E1 * side CHWP * x; gain of E1 * side CHWP * y",
    "turn of polariser * kelvin * r2",
    "displacement x ahead of pupil * r2 * kelvin; displacement y ahead of pupil * r2 * kelvin",
    "axis of half2.plate * kelvin * x; axis of half2.plate * kelvin * y",
    "thickness of half1.plate.quartz * r2; thickness of half1.plate.mgf2 * r2",
)
ALSO = (  # as faint as their plausible sizes are
    "light in O1 * per EXPTIME",
    "gain of E2 * per EXPTIME * x; gain of E2 * per EXPTIME * y",
    "added polarisation q ahead of polariser * hours; added polarisation u ahead of polariser * hours",
    "diattenuation q ahead of polariser * kind standard; diattenuation u ahead of polariser * kind standard",
    "retardance radial behind half2.plate * hours",
    "gain of E1 * counts * per EXPTIME",
    "; ".join(
        f"{what} {axis} behind collimator * per EXPTIME"
        for what in ("diattenuation", "retardance", "depolarisation")
        for axis in "quv"
    ),
)
RATIO = 15.0  # of what is hidden to the noise, behind the base
HELD = 0.999  # share of the square of what an effect does that its sentences hold


@pytest.fixture(scope="module")
def laid():
    calset = simulate(scenes.PLAN, seed=11).calset
    model = base_model(calset)
    return fit(Likelihood.of(calset, model))


@pytest.fixture(scope="module")
def said(laid, request):
    """Columns of some listed groups; of all that there are where there is time."""
    found = grammar.descriptions(laid.model.template, laid.calset.exposures, len(laid.calset.points))
    if not request.config.getoption("--long"):
        found = [probe for probe in found if probe.name in QUICK]
        assert len(found) == len(QUICK)
    made = all_candidates(Columns(laid.likelihood, laid.values), found)
    return {name: candidate.columns for name, candidate in made.items()}


@pytest.mark.long
def test_names_are_sentences(laid, said):
    template = laid.model.template
    context = effect_context(template, laid.calset.exposures)
    wanted = list(probes(applicable(EFFECTS, context, template), context))
    wanted = [p for p in wanted if p.group[0].as_descriptions(template)]
    assert len({p.effect for p in wanted}) == 29
    single = {}
    for name, columns in said.items():
        single |= dict(zip(name.split("; "), columns.T, strict=True))
    theirs = all_candidates(Columns(laid.likelihood, laid.values), wanted)
    assert {p.effect.name for p in wanted if p.name not in theirs} == {"etalon"}, (
        "wide gaps, blurred by the bands"
    )
    for probe in (p for p in wanted if p.name in theirs):
        texts = [text for text in probe.group[0].as_descriptions(template) if text in single]
        if not texts:
            assert "chwp" in probe.effect.name, "of the calibration plate, which is never in"
            continue
        ours = np.column_stack([single[text] for text in texts])
        rest = theirs[probe.name].columns
        left = rest - ours @ np.linalg.lstsq(ours, rest, rcond=None)[0]
        held = 1.0 - np.sum(left**2) / np.sum(rest**2)
        print(probe.name, held)
        assert held > HELD, probe.name


def test_sentences_that_have_a_name_are_left_to_it(laid):
    template = laid.model.template
    context = effect_context(template, laid.calset.exposures)
    every = grammar.descriptions(template, laid.calset.exposures, len(laid.calset.points))
    left = {p.name for p in grammar.beside_names(every, EFFECTS, context, template)[0]}
    gone = {p.name for p in every} - left
    assert "turn of polariser" in gone
    assert "retardance q behind collimator; retardance u behind collimator" in gone
    assert "gain of O1 * hours" in gone
    assert "light of E1 in O1" in left, "leakage is the same in all cameras, this is of one alone"
    assert "turn of polariser * x; turn of polariser * y" in left


def test_parts_of_effects_stand_for_them(laid):
    """One Moon patch of all, the light in one camera of four: no sentences of their own, but no longer than one."""
    template = laid.model.template
    context = effect_context(template, laid.calset.exposures)
    every = grammar.descriptions(template, laid.calset.exposures, len(laid.calset.points))
    found = {
        p.name: {e.name for e in p.holders}
        for p in grammar.beside_names(every, EFFECTS, context, template)[1]
    }
    assert found["light in O1"] == {"pedestal"}
    patches = [name for name in found if name.startswith("polarisation q of sky * exposure")]
    assert len(patches) == 4
    assert all(found[name] == {"moon_patch"} for name in patches)
    left = {p.name for p in grammar.beside_names(every, EFFECTS, context, template)[0]}
    assert not left & set(found)
    assert "turn of polariser" not in found, "this is clp_zero as a whole"


def test_grammar_of_another_instrument():
    """Places, moving elements and cameras are those of the instrument: one arm, a window that turns, two cameras."""
    turns = [
        {"clp_angle": float(a), "moving": {"WIN": 10.0 * i}} for i, a in enumerate((0, 40, 80, 120, 160))
    ]
    instrument = build(parsed(OWN, "own.toml"))
    window = Position(np.ones(5, bool), np.array([0.0, 10.0, 20.0, 40.0, 80.0]))
    exposures = builders.exposures(*turns).placed(WIN=window)
    said = {p.name for p in grammar.descriptions(instrument, exposures, 25)}
    assert "retardance q behind window; retardance u behind window" in said
    assert "depolarisation of window * cos 2 WIN; depolarisation of window * sin 2 WIN" in said
    assert "axis of main.plate.second" in said
    # What turns with an element, and what does not: both may be anything that acts on polarisation.
    kinds = [f"{what} {axis}" for what in ("diattenuation", "retardance", "depolarisation") for axis in "quv"]
    for place in ("behind window", "of window", "of polariser"):
        assert "; ".join(f"{kind} {place} * r2" for kind in kinds) in said
    assert "light of left in right" in said
    assert not any("half1" in name or "O1" in name or "ahead of" in name for name in said)


@pytest.mark.parametrize("name", ["WALOP-SOUTH", "WALOP-NORTH"])
def test_every_description_can_be_made(name):
    """Factors that are tried of a kind are among those that it may have at that place (`Change.check_factors`)."""
    instrument = nominal_instrument(name)
    exposures = dataclasses.replace(TURNING, instrument=name).exposures()
    # EXPTIME by KIND alone is no more than the KIND.
    assert not any("EXPTIME" in probe.name for probe in grammar.descriptions(instrument, exposures, 20))
    exposures = dataclasses.replace(exposures, exptime=30.0 + 30.0 * (np.arange(len(exposures)) % 2))
    every = grammar.descriptions(instrument, exposures, 20)
    for probe in every:
        for text in texts_of(probe):
            Change.parsed(text).check_factors(instrument)
    assert {*COMBINED, *ALSO} <= {probe.name for probe in every}


@pytest.fixture(scope="module")
def turning():
    """A fit whose residuals are noise, columns of all descriptions, and their space."""
    calset = simulate(TURNING, seed=5).calset
    design = Design.of(fit(Likelihood.of(calset, base_model(calset))))
    every = grammar.descriptions(design.fit.model.template, calset.exposures, len(calset.points))
    made = all_candidates(design.columns, every).values()
    columns = [candidate.columns for candidate in made]
    names, widths = [candidate.name for candidate in made], [candidate.widths for candidate in made]
    return design, columns, ScoreSpace.projected(design.projector, names, widths, columns, exact=0)


@pytest.mark.long
@pytest.mark.parametrize("hidden", COMBINED)
def test_a_pattern_that_grows_is_found(turning, hidden):
    """What is hidden is the first of all descriptions, or none is much more probable."""
    design, columns, space = turning
    at = space.places()[hidden]
    amplitudes = np.random.default_rng(2).normal(size=at.stop - at.start) * space.widths[at]
    amplitudes *= RATIO / np.sqrt(amplitudes @ space.gram[at, at] @ amplitudes)
    change = design.stacked([columns[space.names.index(hidden)]]) @ amplitudes
    residual = design.projector(design.residual + change)
    scores = design.products(columns, residual)
    table = space.table_after(ScoreTable((), 1.0, 1.0, len(space.names)), scores)
    best = max(table.scores, key=lambda score: score.log_bayes)
    print(hidden, "|", best.name, best.log_bayes, table[hidden].log_bayes)
    assert table[hidden].log_bayes > best.log_bayes - thresholds.IMPROBABLE
    error = table[hidden].amplitudes + amplitudes  # those of the residuals, with the other sign
    assert error @ space.gram[at, at] @ error < stats.chi2.isf(1e-6, len(error))


@pytest.mark.parametrize(("second", "asked"), [(3.0, False), (24.0, True)])
def test_the_time_since_the_beginning_of_a_night_is_asked_of_several_nights(second, asked):
    exposures = builders.exposures(
        *(
            {"kind": "moon", "mjd": 61000.0 + (begin + hour) / 24.0}
            for begin in (0.0, second)
            for hour in (0, 1, 2)
        )
    )
    said = [
        p.group[0].sentences[0]
        for p in grammar.descriptions(nominal_instrument("WALOP-SOUTH"), exposures, 25)
    ]
    assert ("added polarisation q ahead of polariser * night hours" in said) == asked


def test_steps_part_the_exposures_evenly_and_are_dated_between():
    """Midway between exposures; of many exposures every fourth time at first, then all times of the neighbourhood."""
    few = builders.exposures(*({"mjd": 61000.0 + hour / 24.0} for hour in (0, 1, 3, 4)))
    assert grammar.starts_of_steps(few) == pytest.approx([0.5, 2.0, 3.5], abs=1e-6)
    assert grammar.between(2.0, grammar.end_of(few)) == "hours 2.0 to 4.5"
    instrument = nominal_instrument("WALOP-SOUTH")
    many = builders.exposures(
        *({"mjd": 61000.0 + hour / 24.0, "clp_angle": 3.0 * hour} for hour in range(65))
    )
    said = [p.group[0].sentences[0] for p in grammar.descriptions(instrument, many, 25)]
    steps = [text for text in said if text.startswith("axis of half1.plate * hours ") and " to " in text]
    assert len(steps) == 16
    assert (steps[0], steps[-1]) == (
        "axis of half1.plate * hours 2.5 to 64.5",
        "axis of half1.plate * hours 61.5 to 64.5",
    )
    spells = [text for text in said if text.startswith("turn of polariser * hours ") and " to " in text]
    spells = [text for text in spells if "64.5" not in text]
    assert len(spells) == 14 + 12 + 8
    assert spells[0] == "turn of polariser * hours 2.5 to 10.5"
    assert spells[-1] == "turn of polariser * hours 30.5 to 62.5"

    def near(text: str, end: int) -> list[str]:
        return [change.factors[0] for change in grammar.retimed(Change.parsed(text), many, end)]

    assert near(steps[5], 0) == [f"hours {hour}.5 to 64.5" for hour in range(18, 27)]
    assert near(steps[5], 1) == []
    assert near(spells[0], 1) == [f"hours 2.5 to {hour}.5" for hour in range(6, 15)]
    assert near("axis of half1.plate * hours", 0) == []
    assert near("axis of half1.plate * hours 1 to 2", 0) == []
