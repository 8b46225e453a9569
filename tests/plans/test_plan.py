"""Plans of exposures: their information is that of the likelihood, their promise that of a fit to such data."""

from __future__ import annotations

import dataclasses
import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from own_instrument import OWN
from small_run import SMALL as SMALL_RUN
from small_run import small_fit

import walop_jax as walop
from walop_jax.calibration.accuracy import p_errors
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import matrix_slopes
from walop_jax.data.inspection import inspect
from walop_jax.data.settings import Settings
from walop_jax.data.user_tables import in_memory
from walop_jax.diagnosis.trust import examined
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import refit
from walop_jax.io.names import PLANNED
from walop_jax.io.text import json_text
from walop_jax.likelihood.flux import FluxGroups
from walop_jax.likelihood.likelihood import prior_rows
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.instrument import Instrument
from walop_jax.model.noise import with_noise
from walop_jax.plans.available import Available, Costs, with_stops
from walop_jax.plans.criteria import FieldErrors, criterion_by_name, field_errors
from walop_jax.plans.exposures import (
    Illumination,
    candidates,
    errors_of,
    fewer_points,
    information_of,
    with_members,
)
from walop_jax.plans.plan import Line, _changes, plan_from
from walop_jax.reports.page import kind_of_run, render_other
from walop_jax.simulation.observing_plan import ObservingPlan, Stop, plan_text, read_plan
from walop_jax.simulation.simulate import PhotonNoise, as_planned, effect_from_text, simulate

SMALL = ObservingPlan(
    grid=4, standard_grid=2, moon_patches=3, standards=2, unpolarised=1, throughput_degree=2
)


@pytest.fixture(scope="module")
def small():
    return candidates(Available(SMALL), draws=1)


@pytest.fixture(scope="module")
def field(small) -> FieldErrors:
    return field_errors(small, colours=(float("nan"),))


@pytest.fixture(scope="module")
def planned(small, field):
    return plan_from(small, 15.0, criterion_by_name(small, field, "worst"), field)


def test_the_promise_is_the_error_of_a_fit(small, field):
    """A fit to noiseless data of some exposures has the errors of p that their information promises."""
    angles = (0.0, 20.0, 41.0, 77.0, 100.0, 120.0, 147.0, 170.0)
    plan = dataclasses.replace(SMALL, stops=tuple(Stop(a) for a in angles), patches=(0, 2), stars=(1, 1, 0))
    truth = small.model.instrument(small.values[0])
    calset = simulate(plan, seed=0, instrument=truth, noiseless=True, steady=True).calset
    calibration = Calibration.from_fit(examined(refit(calset, base_model(calset, throughput_degree=2))))
    families = small.families
    total = small.prior + families[0].at(np.deg2rad(2 * np.array(angles)))[0].sum(axis=0)
    total += families[1].information([0, 2])[0].sum(axis=0)
    total += families[2].information([1, 1, 0])[0].sum(axis=0)
    promised = field.error(np.linalg.pinv(total, rcond=1e-14, hermitian=True)[None])[0]
    matrix, covariance = calibration.matrix(field.x, field.y)
    found = p_errors(matrix, covariance)
    seen = np.isfinite(promised)
    assert 0.5 < seen.mean() < 1.0
    np.testing.assert_allclose(promised[seen], found[seen], rtol=0.02)


STARS = ObservingPlan(
    grid=2, standard_grid=4, moon_patches=0, standards=1, unpolarised=0, zero_stars=6, zero_scatter=0.05,
    throughput_degree=0,
)  # fmt: skip


def test_a_standard_has_all_places_of_its_raster_and_stars_of_a_field_scatter():
    """By hand: a factor on a camera, its flux eliminated, from the counts of 16 places; q of six stars that scatter."""
    found = candidates(Available(STARS), draws=1)
    plan = dataclasses.replace(STARS, stops=(Stop(0.0), Stop(None, kind="standard")))
    truth = found.model.instrument(found.values[0])
    block = simulate(plan, instrument=truth, noiseless=True, steady=True).calset.intensities.block(0, 99)
    counts, sigma = (values[block.used[:, 1], 1] for values in (block.counts, block.sigma))
    assert len(counts) == 16
    weight = (counts / sigma) ** 2
    information = np.sum(weight[:, 1] - weight[:, 1] ** 2 / weight.sum(axis=1))
    name = "throughput.n1.p00"
    i, value = found.names.index(name), found.values[0, found.model.index(name)]
    standards = found.families[-1].information([0, 1])[0]
    assert standards[0, i, i] == pytest.approx(information / value**2, rel=1e-3)
    # Photon noise is nothing beside their scatter: six numbers make a mean. Not all of them show u.
    of_field = [found.names.index(f"standard.ZERO.{axis}") for axis in "qu"]
    known = np.linalg.eigvalsh(standards[1][np.ix_(of_field, of_field)])
    assert known[-1] == pytest.approx(6 / 0.05**2, rel=1e-2)


def test_fewer_points_have_the_sums_of_all():
    """Of polynomials, by the 144 points themselves: uneven weights, for at the edge they are further apart."""
    plan = ObservingPlan()
    few, weight = fewer_points(plan)
    assert len(weight) == len(few.points()) == 49 + 25
    assert (weight > 0).all()
    assert (weight[49:] == 1).all()
    of_plan, of_few = plan.points(), few.points()
    for i, j in itertools.product(range(7), repeat=2):
        total = np.sum(of_plan.x[:144] ** i * of_plan.y[:144] ** j)
        part = np.sum(weight[:49] * of_few.x[:49] ** i * of_few.y[:49] ** j)
        assert part == pytest.approx(total, rel=1e-9, abs=1e-12)
    np.testing.assert_allclose(fewer_points(SMALL)[1], 1.0, rtol=1e-12)
    np.testing.assert_allclose(fewer_points(ObservingPlan.bench(11))[1].sum(), 11.0)


def test_every_place_of_a_raster_is_there_to_be_chosen():
    few, _ = fewer_points(ObservingPlan())
    choices, _ = Available(ObservingPlan(), places=True).choices()
    (standards,) = (choice for choice in choices if choice.kind == "standard")
    assert with_stops(few, standards.stops).layout()[0].sum() == 8 * 25


def test_what_a_calibration_knows_holds_its_priors_once():
    """With the priors that every plan has its information gives the errors of the calibration itself."""
    known = Calibration.from_fit(small_fit())
    model = known.model
    names = [model.names[i] for i in model.free if model.parameters[i].part != "sky"]
    rows = prior_rows(model).jacobian(np.eye(len(model.names)))[:, [model.index(name) for name in names]]
    before = information_of(known, names) + rows.T @ rows
    sigma = np.array([float(np.sqrt(known.covariance[i, i])) for i in map(model.index, names)])
    np.testing.assert_allclose(np.sqrt(np.diag(np.linalg.inv(before))), sigma, rtol=1e-3)
    # Moonlight is depolarised by another amount in another night.
    assert not information_of(known, ["sky.depolarisation"]).any()


def test_errors_have_the_floor_of_the_instrument():
    """Two cameras, by hand: both errors 1 % of the mean of 6·10⁵ and 4·10⁵, the flux eliminated."""
    light = Illumination(np.array([1e6]), PhotonNoise(1.0), 0.01, FluxGroups(None), np.ones(1))
    information = light.information(np.array([[[0.6, 0.4]]]), np.array([[[[1.0], [-1.0]]]]))
    assert information[0, 0, 0] == pytest.approx(2 * 200.0**2 - 40.0**2 / 0.52, rel=1e-12)
    gain = light.gain(np.array([[[0.6], [0.4]]]), np.array([[[1.0], [-1.0], [1.0]]]))
    assert gain == pytest.approx(information[0, 0], rel=1e-12)


def test_errors_that_grow_with_the_light_are_those_of_the_cameras():
    """By hand: counts 6·10⁵ and 4·10⁵; errors 2 √N beside 0.1 % of the counts in the second camera alone."""
    errors = np.array([4.0, 4.0]), np.array([0.0, 1e-6])
    light = Illumination(np.array([1e6]), PhotonNoise(1e-9), 0.0, FluxGroups(None), np.ones(1), errors=errors)
    information = light.information(np.array([[[0.6, 0.4]]]), np.array([[[[1.0], [-1.0]]]]))
    first, second = 1e12 / (4.0 * 6e5), 1e12 / (4.0 * 4e5 + 1e-6 * 1.6e11)
    flux = (0.6 * first - 0.4 * second) ** 2 / (0.36 * first + 0.16 * second)
    assert information[0, 0, 0] == pytest.approx(first + second - flux, rel=1e-9)
    gain = light.gain(np.array([[[0.6], [0.4]]]), np.array([[[1.0], [-1.0], [1.0]]]))
    assert gain == pytest.approx(information[0, 0], rel=1e-12)


def test_errors_of_a_plan_are_those_that_a_fit_has_found():
    calset = small_fit().calset
    model = with_noise(base_model(calset), scale="clp", fraction="E1")
    plain = Calibration.from_fit(small_fit())
    values = np.append(plain.values, [1.5, 0.002])
    covariance = np.zeros(2 * (len(values),))
    covariance[:-2, :-2] = plain.covariance
    known = dataclasses.replace(plain, model=model, values=values, covariance=covariance, hidden=None)
    cameras = model.template.cameras.names
    squared, added = errors_of(SMALL_RUN, "clp", cameras, known)
    np.testing.assert_allclose(squared, 2.25)
    np.testing.assert_allclose(added, [0.0, 4e-6, 0.0, 0.0])
    assert errors_of(SMALL_RUN, "moon", cameras, known)[0].tolist() == [1.0] * 4
    rough = dataclasses.replace(SMALL_RUN, noise_scale=2.0, noise_fraction=0.001)
    assert errors_of(rough, "moon", cameras, None)[0].tolist() == [4.0] * 4


def test_a_plan_is_proven_and_reads_back(planned, tmp_path):
    assert 0.0 <= planned.weights_gap <= 0.01
    assert planned.value >= planned.bound_of_go >= planned.bound
    # The best that a go leaves room for, but for the changes and a remainder too short for an exposure.
    exposing = sum(line.seconds for line in planned.lines) / (15 * 60)
    assert (planned.value / planned.bound_of_go) ** 2 <= 1.03 / exposing
    assert exposing > 0.9
    assert 0.6 < planned.efficiency <= 1.0
    assert planned.efficiency == pytest.approx((planned.bound / planned.value) ** 2, rel=1e-12)
    assert planned.seconds <= 15 * 60
    assert all(line.left_out > 1.0 for line in planned.lines)
    assert min(planned.beside.values()) >= planned.bound
    seen = np.isfinite(planned.after)
    assert np.all(planned.after[seen] < planned.before[seen])
    path = tmp_path / "plan.toml"
    path.write_text(plan_text(planned.observing_plan))
    again = read_plan(path)
    first, second = planned.observing_plan.exposures(), again.exposures()
    assert len(first) == sum(line.times for line in planned.lines)
    for name in ("kind", "clp_angle", "mjd", "ra", "filter"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert "no plan of this time gets below" in repr(planned)


def turn_of(exposures) -> tuple[int, float]:
    """Number of directions behind the polariser, and the widest gap (deg) of its angles in a whole turn."""
    angles = np.sort(np.mod(exposures.clp_angle[exposures.clp_in], 360.0))
    gaps = np.diff(np.append(angles, angles[0] + 360.0))
    return len(np.unique(np.mod(angles, 180.0).round(2))), float(gaps.max())


def test_the_plan_of_a_night_contains_what_a_go_needs(planned):
    """Two or three angles alone make p best. By hand: eight directions, over a full turn, and light from the sky."""
    exposures = planned.observing_plan.exposures()
    directions, gap = turn_of(exposures)
    assert directions >= 8
    assert gap <= 180.0
    assert exposures.direct("moon", "standard").any()
    assert planned.lacks == ()
    assert repr(planned).startswith("Plan of ")
    assert "a go needs it" in repr(planned)
    calset = simulate(planned.observing_plan, noiseless=True, steady=True).calset
    assert [str(finding) for finding in inspect(calset).findings] == []
    shown = {line["kind"] for line in planned.document()["exposures"] if line["needed"]}
    assert shown == {"clp", "moon"}


def test_a_plan_without_the_sky_is_no_go_and_its_first_line_says_so(small, field):
    """0.20 % of telescope polarisation, as `check` would say it of a fit."""
    polariser_alone = dataclasses.replace(small, choices=small.choices[:1], families=small.families[:1])
    plan = plan_from(polariser_alone, 15.0, criterion_by_name(small, field, "worst"), field)
    first = repr(plan).splitlines()[0]
    assert first.startswith("No go with this plan alone: ")
    assert "telescope_polarisation.q, telescope_polarisation.u not measured" in first
    assert "q or u off by 0.20 % (median) at the usual size" in first
    assert "observe an unpolarised and a polarised standard, or the moonlit sky" in first
    assert turn_of(plan.observing_plan.exposures())[0] >= 8
    assert plan.document()["lacks"] == list(plan.lacks) != []


def test_standards_show_the_sky_as_well(small, field):
    """Without the Moon one star that is polarised and one that is not."""
    keep = [i for i, choice in enumerate(small.choices) if choice.kind != "moon"]
    starry = dataclasses.replace(
        small,
        choices=tuple(small.choices[i] for i in keep),
        families=tuple(small.families[i] for i in keep),
    )
    plan = plan_from(starry, 20.0, criterion_by_name(small, field, "worst"), field)
    numbers = {line.number for line in plan.lines if line.kind == "standard"}
    assert numbers == {0, 1}  # of SMALL the first is unpolarised
    assert plan.lacks == ()


def test_a_time_that_does_not_pay_for_a_go(small, field):
    plan = plan_from(small, 3.0, criterion_by_name(small, field, "worst"), field)
    assert not any(line.needed for line in plan.lines)
    assert repr(plan).startswith("No go with this plan alone: ")


def test_a_time_that_pays_for_a_go_alone(small, field):
    """Two Moon patches with the way between them take 4.5 minutes, eight directions 6.7."""
    plan = plan_from(small, 11.7, criterion_by_name(small, field, "worst"), field)
    assert plan.lacks == ()
    assert turn_of(plan.observing_plan.exposures())[0] == 8
    assert {line.kind for line in plan.lines if line.needed} == {"clp", "moon"}
    assert plan.seconds <= 60 * 11.7


def test_what_a_calibration_has_already_counts(small, field):
    """Ten minutes beside a run with the sky and eight directions over a full turn are as they were."""
    criterion = criterion_by_name(small, field, "worst")
    information = np.diag(np.full(len(small.names), 1e6))
    run = dataclasses.replace(SMALL, polariser_angles=tuple(40.0 * k for k in range(9))).exposures()
    beside = plan_from(small, 10.0, criterion, field, known=information, had=(run,))
    assert not any(line.needed for line in beside.lines)
    assert beside.efficiency >= 0.95
    assert not repr(beside).startswith("No go")
    blind = dataclasses.replace(SMALL, moon_patches=0, standards=0, unpolarised=0).exposures()
    beside = plan_from(small, 10.0, criterion, field, known=information, had=(blind,))
    assert {line.kind for line in beside.lines if line.needed} == {"moon"}  # it has 15 directions


def test_nothing_known_is_no_error(planned):
    """154 % of p was said of stars with 5 % of p at most."""
    assert np.median(planned.before[np.isfinite(planned.before)]) > 0.05
    assert "nothing known without them" in repr(planned)


def test_exposures_that_come_when_the_night_is_over_are_told():
    """Exposures are 5.8 minutes apart: 150 of them take 14 hours."""
    moon = tuple(Stop(None, kind="moon", number=k % 3) for k in range(150))
    (doubt,) = Available(SMALL).doubts(dataclasses.replace(SMALL, stops=moon, patches=(), stars=()))
    assert doubt.endswith("of 150 exposures of the sky come too late in this order: it is not dark")
    assert int(doubt.split()[0]) > 50
    for few in (moon[:6], (Stop(0.0),) * 150):  # the polariser does not need the night
        assert Available(SMALL).doubts(dataclasses.replace(SMALL, stops=few, patches=(), stars=())) == ()


def test_a_plan_takes_the_time_that_it_is_for(planned):
    """15 minutes over its exposures, not 5.76 minutes each."""
    mjd = planned.observing_plan.exposures().mjd
    assert 1440 * np.ptp(mjd) == pytest.approx(15.0 * (1 - 1 / len(mjd)), rel=1e-3)


def test_targets_that_set_before_a_plan_ends_are_left_out():
    """The night is over after 14 hours; the polariser does not need it."""
    choices, notes = Available(SMALL, throughout=840.0).choices()
    assert {choice.kind for choice in choices} == {"clp"}
    assert len(notes) == 2
    assert "they cannot be observed for all of the 840 minutes" in notes[0]
    choices, notes = Available(SMALL, throughout=30.0).choices()
    assert {choice.kind for choice in choices} == {"clp", "moon", "standard"}
    assert notes == ()


def test_a_plan_whose_targets_set_is_made_again(planned, monkeypatch):
    """Of targets that are up for all of its minutes; where that determines nothing it stays, with its doubts."""
    moon = tuple(Stop(None, kind="moon", number=k % 3) for k in range(150))
    late = dataclasses.replace(
        planned, observing_plan=dataclasses.replace(SMALL, stops=moon, patches=(), stars=())
    )
    asked = []

    def plan(available, **options):
        asked.append(available.throughout)
        if available.throughout and options["draws"] == 2:
            raise ValueError("nothing could be observed")
        return planned if available.throughout else late

    monkeypatch.setattr("walop_jax.plans.plan.plan_exposures", plan)
    assert walop.plan(SMALL, minutes=15.0, draws=1) is planned
    assert walop.plan(SMALL, minutes=15.0, draws=2) is late
    assert asked == [0.0, 15.0, 0.0, 15.0]


def test_a_schedule_is_planned_in_whole_seconds():
    available = Available(SMALL, seconds={"clp": (0.4, 12.6, 13.2), "moon": (60.0,)})
    assert available.in_whole_seconds().seconds == {"clp": (1.0, 13.0), "moon": (60.0,)}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stops": (Stop(0.0, filter="NB-660"),)}, "NB-660"),
        ({"stops": (Stop(0.0, moving={"CHPW": 3.0}),)}, "CHPW"),
        ({"patches": (3,)}, "from 0 to 2"),
        ({"stars": (-1,)}, "from 0 to 1"),
    ],
)
def test_exposures_that_are_not_there(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SMALL, **changes)


def test_exposures_that_say_nothing_of_what_is_wanted(small):
    """The polariser is behind the telescope: its light has nothing of the sky."""
    polariser_alone = dataclasses.replace(small, choices=small.choices[:1], families=small.families[:1])
    with pytest.raises(ValueError, match=r"sky.depolarisation: no possible exposure .* no moon or standard"):
        plan_from(polariser_alone, 15.0, criterion_by_name(polariser_alone, None, "sky.depolarisation"))


def test_a_time_that_pays_for_nothing(small, field):
    with pytest.raises(ValueError, match=r"single exposure: the shortest takes 0\.83"):
        plan_from(small, 0.5, criterion_by_name(small, field, "worst"), field)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"costs": {"clp": -1}}, "0 or more"),
        ({"costs": {"slewing": 1}}, "slew"),
        ({"seconds": {"clp": [0.0]}}, "above 0"),
        ({"seconds": {"arc": [1.0]}}, "arc"),
        ({"altitude": 120}, "below 90"),
    ],
)
def test_costs_and_times_that_contradict_themselves(entries, message):
    with pytest.raises(ValueError, match=message):
        Available.read({"grid": 4, **entries}, Path())


def test_what_is_down_is_left_out_and_said():
    """Half a day later the Moon of the night is below the horizon and the Sun is up."""
    day = dataclasses.replace(SMALL, mjd=SMALL.start + 0.5)
    choices, notes = Available(day).choices()
    assert {choice.kind for choice in choices} == {"clp"}
    assert len(notes) == 2
    better = float(notes[0].split("mjd = ")[1].split(" ")[0])
    choices, notes = Available(dataclasses.replace(SMALL, mjd=better)).choices()
    assert {choice.kind for choice in choices} == {"clp", "moon", "standard"}
    assert notes == ()


def test_other_criteria_by_name(small, field, planned):
    """Rms over the field is no more than the largest; a parameter has the error of its own covariance."""
    mean = plan_from(small, 15.0, criterion_by_name(small, field, "mean"), field)
    assert mean.value < planned.value
    name = "collimator.curvature" if "collimator.curvature" in small.names else small.names[0]
    one = plan_from(small, 15.0, criterion_by_name(small, field, name), field)
    assert one.bound <= one.value
    with pytest.raises(ValueError, match="criterion"):
        criterion_by_name(small, field, "best")


def test_changes_take_time_from_the_plan(small, field):
    """With slews a hundred times as long fewer exposures fit; the bound, which knows of no changes, is the same."""
    slow = dataclasses.replace(small, available=dataclasses.replace(small.available, costs=Costs(slew=10.0)))
    criterion = criterion_by_name(small, field, "worst")
    first, second = plan_from(small, 15.0, criterion, field), plan_from(slow, 15.0, criterion, field)
    assert second.seconds <= 15 * 60
    assert second.bound == pytest.approx(first.bound, rel=1e-6)
    assert second.value >= first.bound


def test_standards_are_as_far_apart_as_they_are_on_the_sky(small):
    """A second for each degree, by astropy; a star that is observed again stands where it stood."""
    plan = dataclasses.replace(SMALL, moon_patches=0, standards=4)
    found = dataclasses.replace(small, available=Available(plan), choices=Available(plan).choices()[0])
    stars, standard = (0, 2, 2, 3, 1), next(i for i, c in enumerate(found.choices) if c.kind == "standard")
    changes = list(_changes(found, [Line(0, 0, 3), *(Line(standard, k, 2) for k in stars)]))
    each = tuple(Stop(None, kind="standard", number=k) for k in range(4))
    e = dataclasses.replace(plan, stops=each, stars=()).exposures()
    where = SkyCoord(e.ra, e.dec, unit="deg")[list(stars)]
    apart = where[:-1].separation(where[1:]).deg
    np.testing.assert_allclose(changes, [0.0, 0.0, *apart], atol=1e-9)
    assert min(apart[[0, 2, 3]]) > 10.0


def test_without_a_polariser_no_exposure_goes_through_one(tmp_path):
    text = OWN.replace('path = ["polariser", "window"]', 'path = ["window"]')
    (tmp_path / "own.toml").write_text(re.sub(r"\[elements\.polariser\]\n(?:.+\n){3}", "", text))
    plan = ObservingPlan(
        Instrument.read(tmp_path / "own.toml"),
        moon_patches=0,
        standards=0,
        lamps=1,
        moving={"WIN": (0.0, 45.0)},
    )
    choices, _ = Available(plan).choices()
    assert [choice.kind for choice in choices] == ["lamp", "lamp"]


@pytest.fixture(scope="module")
def turning():
    """The calibration plate may stand at any angle, the Moon and standards are left out."""
    return candidates(
        Available(dataclasses.replace(SMALL, moon_patches=0, standards=0, unpolarised=0), any_plate=True),
        draws=1,
    )


def gain_at(family, phases, g) -> np.ndarray:
    """The gain for its cost of exposures at any angles, each by its own derivatives."""
    return np.einsum("sab,ba->s", family.at(phases)[0], g[0]) / family.cost[0]


def test_gains_of_the_grid_are_those_of_its_exposures(turning):
    """And no angle between them gains more than the finer grid says, but for what is between that."""
    assert turning.truncation < 1e-6
    family, rng = turning.families[3], np.random.default_rng(2)  # the plate at 15°
    start = sum(f.information(range(0, 120, 20))[0].sum(axis=0) for f in turning.families[:6])
    g = np.linalg.pinv(start + turning.prior, rcond=1e-13, hermitian=True)[None]
    phases = 2 * np.pi * np.arange(120) / 120
    np.testing.assert_allclose(family.gains(g) / family.cost, gain_at(family, phases, g), rtol=1e-9)
    tried = np.concatenate([phases, 2 * np.pi * rng.random(2000)])
    assert gain_at(family, tried, g).max() == pytest.approx(family.between(g), rel=1e-3)


def test_a_plate_of_the_grid_is_that_plate(turning):
    """The information with any plate allowed is that of a plan that lists the plate at 30°."""
    listed = candidates(Available(dataclasses.replace(turning.available.plan, plate=(30.0,))), draws=1)
    (number,) = (i for i, choice in enumerate(turning.choices) if choice.positions["CHWP"] == 30.0)
    assert [choice.positions["CHWP"] for choice in turning.choices][:3] == [None, 0.0, 7.5]
    numbers = [turning.choices[number].number(angle) for angle in (0.0, 21.0, 78.0)]
    assert [turning.choices[number].stops[n].polariser_angle for n in numbers] == [0.0, 21.0, 78.0]
    expected = listed.families[0].information(numbers)
    found = turning.families[number].information(numbers)
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


def test_stars_of_a_table_have_the_errors_of_their_own_p(small):
    """A changed calibration changes p of each star by what its target says: |M₁⁻¹ (m₀ − m₁ + M₀ s)| − |s|."""
    at, star = (np.array([0.1, -0.2]), np.array([0.05, 0.15])), np.array([[0.02, 0.01], [-0.003, 0.03]])
    table = in_memory({"X": at[0], "Y": at[1], "Q": star[:, 0], "U": star[:, 1]})
    criterion = criterion_by_name(small, None, table)
    size = np.array([small.model.parameters[i].scale for i in small.model.free])
    change = 1e-6 * size * np.random.default_rng(1).normal(size=len(size))
    select, values = small.model.selection(), small.values[0]
    setting = Settings.default(1, "SDSS-r")

    def matrix(there):
        return matrix_slopes(small.model.instrument(there), setting, SMALL.curves(), *at)[0]

    (before, after), light = (matrix(values), matrix(values + select @ change)), star[..., None]
    seen = before[..., :1] + before[..., 1:] @ light
    found = np.linalg.solve(after[..., 1:], seen - after[..., :1])[..., 0]
    moved = 100 * (np.linalg.norm(found, axis=1) - np.linalg.norm(star, axis=1))
    told = np.sqrt(((criterion.targets[0].swapaxes(1, 2) @ change) ** 2).sum(axis=1))
    np.testing.assert_allclose(told, np.abs(moved), rtol=2e-3)
    plan = plan_from(small, 15.0, criterion)
    assert plan.bound <= plan.value
    with pytest.raises(ValueError, match="no p"):
        criterion_by_name(small, None, in_memory({"X": [0.1], "Y": [0.1], "Q": [0.0], "U": [0.0]}))


def test_the_page_of_a_plan(planned, tmp_path):
    shown = {"shown": planned.display().document()}
    (tmp_path / PLANNED).write_text(json_text(planned.document() | shown))
    text, missing = render_other(tmp_path, kind_of_run(tmp_path))
    assert not missing
    assert f"gets below {planned.bound:.3g}" in text
    assert text.count("<tr><td>clp") == len([line for line in planned.lines if line.kind == "clp"])
    assert "even angles and the Moon" in text


def test_effects_to_tell_apart_need_the_size_of_one(small):
    with pytest.raises(ValueError, match="size of one"):
        criterion_by_name(
            dataclasses.replace(small, effects={"clp_zero": False, "hwp1_axis": False}), None, "apart"
        )


@pytest.mark.parametrize(
    ("effect", "column"), [("flexure=rate_x:0.003,rate_y:0.0", "HA"), ("hwp_temperature", "TEMP")]
)
def test_effects_of_conditions_that_no_plan_chooses_are_refused(small, effect, column):
    """Where hour angles went with the angles of the polariser flexure was promised four times its distance."""
    with pytest.raises(ValueError, match=f"grows with {column}, which no plan chooses; leave it out"):
        with_members(small.model, as_planned(SMALL), ("hwp2_axis", effect))


@pytest.mark.long
def test_the_distance_of_two_effects_is_that_of_a_fit():
    """Noiseless data with one effect, fitted with the other: the least χ² is the square of the distance promised."""
    pair = ("hwp2_axis=0.005", "hwp2_crossing")
    found = candidates(Available(SMALL), draws=1, effects=pair)
    plan = plan_from(found, 15.0, criterion_by_name(found, None, "apart"))
    truth = dataclasses.replace(found.model.instrument(found.values[0]), effects=())
    context = effect_context(truth, plan.observing_plan.exposures())
    effect = effect_from_text(pair[0], context)
    calset = simulate(
        plan.observing_plan, 0, instrument=truth, effects=(effect,), noiseless=True, steady=True
    ).calset
    rival = with_effects(base_model(calset, throughput_degree=2), pair[1:], context)
    # Priors are centred on the design, the truth is not: what they cost is taken out by a fit of the truth's own model.
    own = with_effects(base_model(calset, throughput_degree=2), (effect.name,), context)
    chi2 = [fit.expansion.objective for fit in (refit(calset, rival), refit(calset, own))]
    assert np.sqrt(chi2[0] - chi2[1]) == pytest.approx(plan.value, rel=0.05)


def test_stars_of_a_field_tell_no_more_of_their_mean_than_their_scatter_allows():
    """Information of an exposure with the covariance 1 + A Aᵀ of its stars; of many electrons 1/s² a star."""
    rng = np.random.default_rng(1)
    size, unit = 1e-3, np.full((6, 1, 4), 0.25)
    slopes = np.zeros((6, 1, 4, 3))
    slopes[..., 0], slopes[..., 1] = [0.25, -0.25, 0.0, 0.0], [0.0, 0.0, 0.25, -0.25]
    slopes[..., 2] = rng.normal(size=(6, 1, 4)) * 0.1
    light = Illumination(
        np.full(6, 4e10), PhotonNoise(30.0), 0.0, FluxGroups(), np.ones(6), {0: size, 1: size}
    )
    found = light.information(unit, slopes)[0]
    np.testing.assert_allclose(np.diag(found)[:2], 6.0 / size**2, rtol=1e-3)
    alone = light._replace(scatter={}).information(unit, slopes)[0]
    assert alone[0, 0] > 1e3 * found[0, 0]
    # What is of no star is known as well as before: given q and u of each.
    assert found[2, 2] < alone[2, 2]
