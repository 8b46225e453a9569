"""Stacks of nights against one joint fit, against fits of single nights, and against a known truth; bad input."""

import dataclasses
import json
import re
import textwrap
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from command import run_program
from small_run import SMALL

import walop_jax as walop
from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.merge import merge_calibration_sets
from walop_jax.fit.base_model import base_model
from walop_jax.fit.model_of_set import model_for, model_like
from walop_jax.fit.refit import fit
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Deviations, effect_by_name
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.specification import make_model
from walop_jax.nights import making, night_file, stacking, survey_folder
from walop_jax.nights.equations import night_equations
from walop_jax.nights.stacking import stack
from walop_jax.science import apply as application
from walop_jax.science.field_accuracy import field_accuracy
from walop_jax.simulation.simulate import simulate

TURN = 0.1  # deg, of the axis of a half-wave plate, between the third night and the fourth


def fitted(calset):
    return fit(Likelihood.of(calset, base_model(calset))).with_verdict()


@pytest.fixture(scope="module")
def sets():
    """Four nights, a week apart: nothing happens in three, and before the last a half-wave plate turns."""
    first = simulate(SMALL, seed=1)
    context = effect_context(first.truth, first.calset.exposures)
    model = make_model(SMALL.name, first.truth)
    model = with_effects(model, [effect_by_name("hwp1_axis").neutral(context)], context)
    values = model.start
    values[model.index("hwp1_axis.angle")] = TURN
    found = [first.calset]
    for k, instrument in enumerate((first.truth, first.truth, model.instrument(values)), 1):
        plan = dataclasses.replace(SMALL, mjd=SMALL.start + 7.0 * k)
        found.append(simulate(plan, seed=1 + k, instrument=instrument, catalogue_seed=1).calset)
    return found


@pytest.fixture(scope="module")
def single(sets):
    return fitted(sets[0])


@pytest.fixture(scope="module")
def quiet(sets, single):
    return stack([single, *sets[1:3]])


def test_errors_of_undetected_changes_remain_in_the_product_of_a_survey(sets, single):
    """Nights do not show them: the variance of the matrix is that of the nights and that of the deviations."""
    plain = Calibration.from_fit(single)
    context = effect_context(plain.model.template, plain.exposures)
    places = (f"behind {plain.model.template.path[-1]}",)
    model = with_effects(plain.model, [Deviations.of(context, places=places)], context)
    old, at = [model.index(name) for name in plain.model.names], model.positions(Deviations.name)
    values, covariance = model.start, np.zeros((len(model.names),) * 2)
    values[old] = plain.values
    covariance[np.ix_(old, old)] = plain.covariance
    covariance[at, at] = 1e-5**2
    wide = dataclasses.replace(plain, model=model, values=values, covariance=covariance)
    start = dict(zip(plain.model.names, plain.values.tolist(), strict=True))
    nights = night_equations(sets[0], model_like(sets[0], model), start, {})
    x, y = plain.raster(3)
    variances = [
        np.diagonal(c.matrix(x, y)[1], axis1=1, axis2=2)
        for c in (plain, wide, *(stack(nights, like=c, find=False).at(SMALL.start) for c in (plain, wide)))
    ]
    assert np.median(variances[1] / variances[0]) > 1.05
    np.testing.assert_allclose(variances[3] - variances[2], variances[1] - variances[0], rtol=1e-6)


def test_a_stack_is_the_joint_fit(sets, quiet):
    """A fit and two sets that were never fitted: values, errors and χ² of one fit to all of the data."""
    whole = merge_calibration_sets(*sets[:3])
    joint = fitted(whole)
    product = quiet.at(SMALL.start + 7.0)
    index = [joint.model.index(name) for name in product.model.names]
    sigma = joint.sigma[index]
    assert np.all(np.abs(product.values - joint.values[index]) <= 1e-3 * sigma)
    assert np.sqrt(np.diag(product.covariance)) == pytest.approx(sigma, rel=1e-3)
    assert quiet.verdict.chi2 == pytest.approx(joint.chi2, abs=0.01)
    assert (quiet.verdict.dof, quiet.verdict.n_data) == (joint.dof, joint.n_data)
    assert quiet.trusted


def test_a_night_alone_knows_p_as_well_as_its_fit_does(single):
    """The same quantity, of the same part of the field, in the same words."""
    survey = stack([single], find=False)
    alone = field_accuracy(Calibration.from_fit(single))
    assert survey.error_of_p(survey.last) == pytest.approx(alone.reached, rel=1e-3)
    assert f"in {alone.judged}, on the last night" in survey.display().text()
    assert survey.document()["without_u"] == pytest.approx(alone.without_u)


def test_nights_that_share_nothing_are_single_fits(sets, single):
    """Every parameter with a value of its own in every night: the fit of that night; χ² and degrees of freedom add."""
    other = fitted(sets[1])
    laws = {single.model.names[i]: {"per": "night"} for i in single.model.free}
    survey = stack([other, single], laws)
    for k, alone in enumerate((single, other)):
        product = survey.at(SMALL.start + 7.0 * k)
        assert np.all(np.abs(product.values - alone.values) <= 1e-3 * alone.sigma)
        assert np.sqrt(np.diag(product.covariance)) == pytest.approx(alone.sigma, rel=1e-3)
    assert survey.verdict.chi2 == pytest.approx(single.chi2 + other.chi2, abs=0.01)
    assert survey.verdict.dof == single.dof + other.dof


def test_a_break_is_found_and_named(sets, single):
    """The planted turn, without a law of it: its date, its size, its name or its class; then it is a law."""
    assert not stack([single, *sets[1:]], find=False).trusted
    survey = stack([single, *sets[1:]])
    (one,) = survey.breaks
    assert (one.kind, one.before, one.after) == (
        "step",
        survey.data.nights[2].end,
        survey.data.nights[3].begin,
    )
    assert "hwp1_axis.angle" in (one.name, *one.alike)
    assert survey.trusted
    assert one.p_value < 1e-6
    assert survey.changing[one.name].at == (one.date,)
    # Half-way between the nights it may have happened or not: half of it, and as uncertain as that.
    k = survey.data.names.index(one.name)
    (early, _), (middle, known), (late, _) = (
        survey.values_at(mjd) for mjd in (one.before, one.date, one.after)
    )
    assert middle[k] == pytest.approx(0.5 * (early[k] + late[k]), abs=1e-6 * abs(one.size))
    assert known[k, k] >= 0.25 * one.size**2
    assert survey.validity[0][1] == survey.validity[1][0] == one.date


def test_a_walk_knows_less_after_the_last_night(quiet):
    """Variance grows by rate² Δt; a parameter that may walk is known less well than one that all nights share."""
    name, rate = "half1.plate.mgf2", 1e-2
    survey = stack(quiet.data.nights, {name: {"per": "walk", "rate": rate}})
    k, last = survey.data.names.index(name), survey.data.nights[-1].mjd
    ((value, at_last), (later, after)) = (survey.values_at(last + days) for days in (0.0, 0.4))
    assert value[k] == later[k]
    assert after[k, k] - at_last[k, k] == pytest.approx(rate**2 * 0.4)
    assert at_last[k, k] > quiet.values_at(last)[1][k, k]
    # A state more for every night but the first, each with a step that is known beforehand.
    assert survey.verdict.dof == quiet.verdict.dof


def test_tracks_and_tables(quiet):
    tracks, nights = quiet.tracks, quiet.to_table()
    name = "half1.plate.mgf2"
    rows = tracks[tracks["NAME"] == name]
    product = quiet.at(SMALL.start)
    assert rows["VALUE"] == pytest.approx(np.full(3, product[name].value))
    assert rows["ERROR"] == pytest.approx(np.full(3, product[name].sigma))
    # A night that alone were free to differ: the law of a bad night gives the same change and error.
    night = quiet.data.nights[1]
    law = {"per": ["shared", "bad"], "bad": [[night.mjd - 1.0, night.mjd + 1.0]]}
    other = stack(quiet.data.nights, {name: law})
    k = other.data.names.index(name)
    change = np.diff([other.values_at(night.mjd + days)[0][k] for days in (-7.0, 0.0)])[0]
    assert rows["DEVIATION"][1] == pytest.approx(change, abs=1e-6 * rows["DEVIATION_ERR"][1])
    assert np.sum(nights["CHI2"]) == pytest.approx(quiet.solution.chi2)
    assert np.all(np.abs(quiet.excess) < 5.0)
    assert "Survey of WALOP-SOUTH: go" in repr(quiet)


def test_kept_nights_are_stacked(quiet, sets, single, tmp_path):
    """Files of nights that were linearised where all of them end: the same values, and no more is promised."""
    for k, night in enumerate(quiet.data.nights):
        night_file.write_nights(tmp_path / f"night{k}.fits", [night])
    kept = stack([tmp_path], like=single)
    assert kept.values_at(SMALL.start)[0] == pytest.approx(
        quiet.values_at(SMALL.start)[0], rel=1e-9, abs=1e-12
    )
    assert kept.at(SMALL.start).values == pytest.approx(quiet.at(SMALL.start).values, rel=1e-9, abs=1e-12)
    assert any("stay as they were linearised" in text for text in kept.verdict.warnings)
    with pytest.raises(DataError, match="no calibration is known"):
        stack([tmp_path]).at(SMALL.start)
    with pytest.raises(DataError, match="no values at which to linearise"):
        stack([sets[0]])


def test_outside_the_nights_only_by_force(quiet):
    start, stop = quiet.span
    assert quiet.at(start).verdict.trusted
    for mjd in (start - 0.01, stop):
        with pytest.raises(DataError, match="outside the validity"):
            quiet.at(mjd)
        assert any("outside the validity" in text for text in quiet.at(mjd, force=True).verdict.warnings)


def test_data_that_are_there_twice_are_known_by_their_noise(quiet, single, sets):
    """A night again at other times, and stars that have other values in one of the catalogues."""
    later = dataclasses.replace(sets[0].exposures, mjd=sets[0].exposures.mjd + 20.0)
    with pytest.raises(DataError, match=r"100 % of its measurements are in .* as well"):
        stack([sets[0], sets[1], dataclasses.replace(sets[0], exposures=later)], like=single)
    one, two, _ = quiet.data.nights
    others = tuple(
        dataclasses.replace(p, prior=(p.prior[0] + 0.001, p.prior[1]))
        if p.name.startswith("standard.")
        else p
        for p in two.parameters
    )
    with pytest.raises(DataError, match=r"SOURCES.*other values of STD"):
        stack([one, dataclasses.replace(two, parameters=others)])


def test_a_camera_that_drifts_is_the_law_even_if_its_throughput_is_the_gauge_of_the_fluxes():
    """O1 brighter by 0.4 % a month: no pedestal, which stars could not be corrected for, and errors stay small."""
    truth, found = simulate(SMALL, seed=1).truth, []
    for k in range(4):
        throughput = truth.throughput
        brighter = throughput.coefficients.at[0, 0].add(0.002 * k)
        instrument = dataclasses.replace(
            truth, throughput=dataclasses.replace(throughput, coefficients=brighter)
        )
        plan = dataclasses.replace(SMALL, mjd=SMALL.start + 30.0 * k)
        found.append(simulate(plan, seed=1 + k, instrument=instrument, catalogue_seed=1).calset)
    survey = stack(found, like=fitted(found[0]))
    (drift,) = survey.breaks
    assert (drift.kind, drift.name) == ("drift", "throughput.n0.p00")
    assert drift.size == pytest.approx(0.002 * 365.25 / 30.0, abs=5 * drift.error)
    assert survey.trusted
    product = survey.at(survey.last)
    assert "pedestal" not in product.model.effect_names
    # Ratios of cameras as they are: those to the one that drifts fall, the others stay.
    first = survey.at(survey.span[0] + 0.6)
    ratio = [p["throughput.n1.p00"].value / p["throughput.n0.p00"].value for p in (first, product)]
    assert ratio[0] / ratio[1] == pytest.approx(1.0 + 0.006 / 0.5, abs=1e-3)
    still = [p["throughput.n1.p00"].value / p["throughput.n2.p00"].value for p in (first, product)]
    assert still[0] == pytest.approx(still[1], rel=1e-6)
    one = first.covariance[first.model.index("throughput.n1.p00")].max() ** 0.5
    assert product.covariance[product.model.index("throughput.n1.p00")].max() ** 0.5 < 3.0 * one


def test_bad_input(quiet, single):
    one, two, three = quiet.data.nights
    with pytest.raises(DataError, match=r"there is twice|is there twice"):
        stack([one, one])
    with pytest.raises(DataError, match="other filters"):
        stack([one, dataclasses.replace(two, filters=("other",))])
    late = dataclasses.replace(three, number=three.number + 400, begin=three.begin + 400, end=three.end + 400)
    survey = stack([one, two, dataclasses.replace(late, mjd=three.mjd + 400)], like=single)
    assert any("no night from MJD" in text for text in survey.verdict.warnings)
    with pytest.raises(ValueError, match="did you mean"):
        stack([one, two], {"half1.plate.mgf": {"per": "night"}})
    drift = "camera_gain_drift#{}.rate"
    law = {"per": "step", "at": two.mjd - 1.0}
    shaped = stack([one, two, three], {drift.format(1): law}, like=single)
    assert shaped.at(two.mjd)["camera_gain_drift.rate"].sigma > 0.0
    both = stack([one, two, three], {drift.format(1): law, drift.format(2): law}, like=single)
    assert "Survey of" in repr(both)
    with pytest.raises(DataError, match="is one shape of its effect"):
        both.at(one.mjd)
    deaf = dataclasses.replace(two, matrix=np.zeros_like(two.matrix), gradient=np.zeros_like(two.gradient))
    free = next(p.name for p in one.parameters if p.prior is None and p.loose is None)
    with pytest.raises(DataError, match=r"has no information on .*, which has a value of its own there"):
        stack([one, deaf, three], {free: {"per": "night"}})
    scattered = dataclasses.replace(single, errors_from="residuals").with_verdict()
    with pytest.raises(DataError, match="do not explain its scatter"):
        stack([scattered])
    # The file to leave out is named, not what was typed into it.
    kept = Calibration.from_fit(single)
    verdict = dataclasses.replace(kept.verdict, errors_from="residuals")
    kept = dataclasses.replace(kept, verdict=verdict, path=Path("RUN7/calibration.fits"))
    with pytest.raises(DataError, match=r"errors of RUN7/calibration\.fits do not explain"):
        stack([one, two], like=kept)


@pytest.fixture(scope="module")
def kept(sets, single, tmp_path_factory):
    """A run of the first night, the sets of the first three, and their survey, made by the program."""
    folder = tmp_path_factory.mktemp("nights")
    for k, calset in enumerate(sets[:3]):
        walop.write_calibration_set(folder / f"night{k}.fits", calset)
    calset, run = walop.read(folder / "night0.fits"), folder / "RUN"
    law = "[law.'throughput.n1.p00']\nper = 'walk'\nrate = 1e-4\n"
    fit(Likelihood.of(calset, model_for(calset, law))).with_verdict().save(run)
    stopped, made = folder / "SURVEY", []

    def interrupted(*args, **more):
        made.append(len(made))
        if len(made) == 2:
            raise KeyboardInterrupt
        return night_equations(*args, **more)

    words = [run, folder / "night2.fits", folder / "night1.fits", "-o", stopped]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(making, "night_equations", interrupted)
        assert run_program("stack", *words).exit_code == 130
        assert [entry.name for entry in stopped.iterdir()] == ["partial"]
        # The first night is kept: the other two are made, then all three again at the common solution, as often as need
        # be, twice or three times.
        made[:] = [0, 1]
        assert run_program("stack", *words, "--quiet").exit_code == 0
    assert 2 + 3 <= len(made) - 2 <= 2 + 3 + 3 + 3
    return folder


def test_the_program_stacks_what_python_does(kept, sets, single, monkeypatch):
    """Resumed, from a run and two sets in another order, with the law of the model file; as if they were many."""
    survey = survey_folder.read_survey(kept / "SURVEY")
    monkeypatch.setattr(stacking, "Maker", lambda like, folder, count: making.Maker(like, folder, 1000))
    laws = {"throughput.n1.p00": {"per": "walk", "rate": 1e-4}}
    other = stack([single, *sets[1:3]], laws)
    assert survey.changing == other.changing
    for mjd in (SMALL.start, SMALL.start + 10.0):
        one, two = survey.at(mjd), other.at(mjd)
        assert np.all(np.abs(one.values - two.values) <= 1e-3 * two.sigma)
        assert np.sqrt(np.diag(one.covariance)) == pytest.approx(two.sigma, rel=1e-3)
    assert not (kept / "SURVEY" / "partial").exists()
    assert walop.read(kept / "SURVEY" / "calibration.fits").verdict.trusted
    found = json.loads((kept / "SURVEY" / "survey.json").read_text())
    assert (found["nights"], found["trusted"], found["laws"]) == (
        3,
        True,
        {k: {**v, "per": ["walk"]} for k, v in laws.items()},
    )


def test_stars_get_the_calibration_of_their_moment(kept, monkeypatch):
    """`apply` of a survey: what `at` gives; outside and without a time an error, by force with a flag."""
    tables = {}

    def tabulated(calibration):
        key = (calibration.values.tobytes(), calibration.verdict.quality)
        if key not in tables:
            tables[key] = AnalysisVectors(calibration)
        return tables[key]

    monkeypatch.setattr(application, "AnalysisVectors", tabulated)  # those of the same values are the same
    survey = survey_folder.read_survey(kept / "SURVEY")
    counts = np.array([[2.1e5, 1.9e5, 2e5, 2e5], [1.9e5, 2.1e5, 2e5, 2.1e5]])
    stars = {"X": [0.1, 0.2], "Y": [0.0, 0.1], "N": counts, "N_ERR": np.sqrt(counts)}
    start, stop = survey.span
    for mjd in (start, np.nextafter(stop, 0.0)):
        found = walop.apply(kept / "SURVEY", stars | {"MJD": [mjd, mjd]})
        assert found["Q"] == pytest.approx(np.asarray(walop.apply(survey.at(mjd), stars)["Q"]), abs=1e-12)
        assert not np.any(found["FLAG"] & 2048)
    for mjd in (start - 1e-6, stop):
        with pytest.raises(DataError, match="outside the validity"):
            walop.apply(kept / "SURVEY", stars | {"MJD": [mjd, mjd]})
    assert np.all(walop.apply(kept / "SURVEY", stars | {"MJD": [stop, stop]}, force=True)["FLAG"] & 2048)
    with pytest.raises(DataError, match=r"MJD.*is not given"):
        walop.apply(kept / "SURVEY", stars)
    with pytest.raises(DataError, match=r"spans 2.0 days"):
        walop.apply(kept / "SURVEY", stars | {"MJD": [start + 1.0, start + 3.0]})


@pytest.mark.long
def test_the_page_runs_as_it_stands(sets, tmp_path, monkeypatch, capsys):
    """The blocks of the page of nights, one after the other."""
    from walop_jax.commands.docs import pages

    blocks = re.findall(r"(?:^    .*\n|^\n(?=    ))+", pages()["nights"], re.MULTILINE)
    assert len(blocks) == 3
    blocks = [block for block in blocks if "dask_jobqueue" not in block]  # which needs a cluster
    monkeypatch.chdir(tmp_path)
    for k, calset in enumerate(sets[:3], 1):
        walop.write_calibration_set(tmp_path / f"night{k}.fits", calset)
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(textwrap.dedent(block), "nights", "exec"), names)
    assert "Survey of WALOP-SOUTH: go" in capsys.readouterr().out
    assert len(Table.read(tmp_path / "tracks.fits")) == 3 * len(names["survey"].data.names)
    turn = names["again"].tracks
    turn = turn[turn["NAME"] == "clp_zero.angle"]
    assert np.all(np.abs(turn["VALUE"]) < 4.0 * turn["ERROR"])
    assert np.all(turn["ERROR"] < 0.05)


def test_a_fit_says_how_nights_are_linearised(quiet, single):
    """From Python, as a fit in memory."""
    assert walop.stack(list(quiet.data.nights), {}, like=single, no_breaks=True).verdict.trusted
