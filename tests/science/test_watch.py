"""A calibration watched by its stars: quiet nights, steps and drifts of cameras, optics that change, the bound."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from star_tables import read
from star_tables import stars as star_table
from studies import watch as study

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.data.user_tables import in_memory
from walop_jax.fit.verdict import Doubt, Quality, Verdict
from walop_jax.reports.survey_figures import watch_figure
from walop_jax.science.catalogue import read_catalogue
from walop_jax.science.star_columns import PossibleChange
from walop_jax.science.star_history import Watching, grouped
from walop_jax.science.star_residuals import StarWeights, noise_scale, normal_matrix
from walop_jax.science.star_words import FoundChange, Watch
from walop_jax.science.watch import dated, watch, with_rivals


@pytest.fixture(scope="module")
def vectors(calibration) -> AnalysisVectors:
    return AnalysisVectors(calibration)


@pytest.fixture(autouse=True)
def _without_rivals(vectors, monkeypatch):
    """The study on the parameters of the model alone: fewer tables."""
    monkeypatch.setattr(study, "vectors", lambda: vectors)


def test_nothing_is_seen_where_nothing_has_changed():
    """Through instruments that differ from the calibration by its own errors; gains scatter by what is stated."""
    found = [study.watched(100, seed) for seed in range(12)]
    assert all(watch.holds for watch in found)
    pulls = np.concatenate([(w.gain / w.error)[:, 0] for w in found])  # a night, one camera: independent
    assert np.sqrt(np.mean(pulls**2)) == pytest.approx(1.0, abs=4 / np.sqrt(2 * len(pulls)))


@pytest.mark.parametrize("size", [0.01, 0.003])
def test_a_step_is_found_at_its_night_with_its_size(size):
    for camera in range(4):
        watch = study.watched(600, camera, study.step(size, camera))
        assert not watch.holds
        (change,) = watch.changes
        assert change.time == 60000.0 + study.START
        assert change.best.history.kind == "step"
        named = {entry.name: entry for entry in change.alike}
        mine = named[watch.cameras[camera]]
        assert mine.size == pytest.approx(size, abs=4 * mine.error)
        assert change.camera in (None, watch.cameras[camera])


def test_the_smallest_step_that_is_promised_is_found_and_its_night_lies_between_those_told():
    bound = float(study.watched(600, 50).smallest[study.START, 0])
    assert 2e-4 < bound < 1e-3
    found = [study.watched(600, 60 + seed, study.step(bound)).changes for seed in range(12)]
    assert sum(map(bool, found)) >= 11  # 99 % each
    for change in (one[0] for one in found if one):
        first, last = change.between
        assert first <= 60000.0 + study.START <= last
        assert (f"it began between MJD {first:.4f} and MJD {last:.4f}" in change.words()) == (first < last)
    assert any(one[0].between[0] < one[0].between[1] for one in found if one)
    missed = [study.watched(600, 60 + seed, study.step(0.4 * bound)).holds for seed in range(12)]
    assert sum(missed) >= 8


def test_a_few_nights_of_few_stars_see_a_gross_change():
    """Ten stars a night that all lie off are a change, not outliers; three variable stars are no change."""
    assert study.watched(100, 3, study.step(0.01)).changes[0].time == 60000.0 + study.START
    assert not study.watched(100, 3, study.step(0.05)).holds


@pytest.mark.parametrize("stars", [60, 120])
def test_a_step_that_stars_of_a_night_share_is_no_noise_of_theirs(stars):
    """Six or twelve stars a night: χ²/dof of 100 about zero, of 1 about the gain that they share."""
    (change,) = study.watched(stars, 5, study.step(0.02), plates=(None,)).changes
    assert change.time == 60000.0 + study.START
    assert abs(change.best.size) == pytest.approx(0.02, rel=0.05)


def test_scatter_beyond_n_err_is_no_change_and_says_nothing_for_the_calibration():
    found = [study.watched(120, seed, plates=(None,), scatter=3.0) for seed in range(8)]
    assert not any(watch.changes or watch.holds for watch in found)
    assert "DO NOT SHOW" in found[0].display().text()


def test_a_camera_that_drifts_is_told_as_that():
    watch = study.watched(600, 1, study.drift(0.01))
    (change,) = watch.changes
    assert change.best.history == ("drift", 0)
    assert change.best.size == pytest.approx(np.sign(change.best.size) * 0.01, rel=0.1)
    assert "drifting since MJD 60000.0000" in watch.warnings[0]


def test_optics_that_change_are_not_named_as_a_camera():
    watch = study.watched(600, 7, turned=("half2.plate.mgf2", 3.0))
    change = watch.changes[0]
    assert change.camera is None
    assert {"half2.plate.mgf2", "half2.plate.quartz"} & {entry.name for entry in change.alike}
    assert change.time == 60000.0 + study.START


def test_single_exposures_do_not_name_a_camera_that_they_cannot_tell():
    watch = study.watched(600, 2, study.step(0.003), plates=(None,))
    (change,) = watch.changes
    assert change.camera is None
    assert {"O1", "O2"} <= {entry.name for entry in change.alike}


def test_records_of_a_watch():
    watch = study.watched(100, 4, study.step(0.01))
    document = watch.document()
    assert document["holds"] is False
    assert document["changes"][0]["time"] == 60006.0
    assert len(document["groups"]) == len(watch.time) == len(watch.to_table())
    assert "IS NO LONGER VALID" in watch.display().text()
    assert len(watch_figure(watch).axes) == 4
    assert document["smallest_step_seen"] == pytest.approx(watch.smallest.min())


@pytest.mark.parametrize("groups", [1, 2])
def test_reasons_of_a_survey_by_hand(groups):
    """Errors that lack √3 of 0.1 % do more than a camera by 0.05 %; what catalogues say of the scatter takes its place.

    A single exposure group has no course: there it takes the place of the change as well.
    """
    gain = PossibleChange("O1", True, size=1e-3, error=1e-4)
    of_groups, of_gains = np.zeros(groups), np.ones((groups, 1))
    found = Watch(
        ("O1",), 60000.0 + np.arange(groups), of_groups.astype(int), of_groups, of_gains, of_gains, of_gains,
        (FoundChange(gain, (gain,), 60000.0, (60000.0, 60000.0), 5e-4),), 4.0, 10, 5.0, photons=1e-3, odd=("one star",),
    )  # fmt: skip
    noise, change, remark = Verdict().with_doubts(found.against).reasons
    assert noise.off == pytest.approx(3**0.5 * 1e-3)
    assert "N_ERR is 2 times too small" in noise.sentence
    assert change.off == 5e-4
    assert (remark.blocking, remark.cure) == (False, noise.cure)
    better = dataclasses.replace(
        found, of_catalogues=(Doubt(Quality.CATALOGUE, "E2 is not linear", off=2e-3),)
    )
    said = [reason.sentence for reason in Verdict().with_doubts(better.against).reasons]
    assert said == ["E2 is not linear", *([change.sentence] if groups > 1 else []), "one star"]


def test_scale_of_noise_is_that_of_the_many():
    """Of stars with 1 and 4 degrees of freedom, errors 1.5 times too small, one in twenty far off."""
    rng = np.random.default_rng(0)
    dof = np.where(np.arange(4000) % 2, 1.0, 4.0)
    chi2 = 2.25 * rng.chisquare(dof)
    chi2[::20] *= 400.0
    scale = noise_scale(chi2, dof)
    assert scale.value == pytest.approx(2.25, abs=5 * 2.25 * np.sqrt(2 / scale.worth))
    assert 0.7 * dof.sum() < scale.worth < dof.sum()


def test_a_catalogue_that_is_not_what_it_says_is_told_in_place_of_changes(calibration, tmp_path):
    """Two nights, in the second of which two cameras of an arm are exchanged: its name, its order, and no change."""
    nights = []
    for night in range(2):
        table = star_table(study.vectors(), 200, np.random.default_rng(night), teff=5500.0)[0]
        table["MJD"] = 60000.0 + night
        nights.append(table)
    sound = [read(table, tmp_path) for table in nights]
    assert watch(calibration, sound).holds
    for name in ("N", "N_ERR"):
        nights[1][name] = nights[1][name][:, [1, 0, 2, 3]]
    found = watch(calibration, [sound[0], read(nights[1], tmp_path)], names=["a.fits", "b.fits"])
    assert not found.holds
    (doubt,) = (doubt for doubt in found.against if doubt.blocking)
    assert doubt.sentence.startswith("b.fits: ")
    assert "in the order E1, O1, O2, E2" in doubt.sentence
    assert found.document()["misread"] == [doubt.sentence]


def test_exposure_groups_are_joined_where_there_are_many():
    time = np.array([3.0, 1.0, 2.0, 2.0])
    times, group = grouped(time)
    assert times.tolist() == [1.0, 2.0, 3.0]
    assert group.tolist() == [2, 0, 1, 1]
    times, group = grouped(np.arange(10.0), most=4)
    assert times.tolist() == [0.0, 3.0, 6.0, 9.0]
    assert group.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3]


def test_dates_that_are_there_stay_and_what_has_none_is_left_out_by_name(vectors):
    def catalogue(*mjd):
        counts = np.full((len(mjd), 4), 1e6)
        rows = {"ID": np.arange(len(mjd)) // 2, "X": np.zeros(len(mjd)), "Y": 0.01 * np.arange(len(mjd))}
        rows |= {"N": counts, "N_ERR": np.sqrt(counts), "MJD": np.array(mjd)}
        return read_catalogue(in_memory(rows), vectors.calibration.model.template.patched())

    nan = np.nan
    given = catalogue(60000.1, 60000.1, 60001.2), catalogue(nan, nan), catalogue(nan, 60003.0, 60004.0)
    kept, remarks = dated(given, ["a.fits", "b.csv", "c.fits"])
    assert [one.time.tolist() for one in kept] == [[60000.1, 60000.1, 60001.2], [60003.0, 60004.0]]
    assert kept[1].star.tolist() == [0, 1]
    assert kept[1].points.y.tolist() == [0.01, 0.02]
    assert len(kept[1].points.settings) == len(kept[1].counts) == 2
    assert remarks[0].startswith("b.csv, MJD: all of ")
    assert remarks[1].startswith("c.fits, MJD: 1 of 3 rows have no time")
    # Where none has, each is a group of its own, in their order.
    kept, remarks = dated([given[1], given[1]], [])
    assert [one.time.tolist() for one in kept] == [[0.0, 0.0], [1.0, 1.0]]
    assert remarks == ()
    watch = study.watched(100, 4)
    assert "b.csv" in " ".join(dataclasses.replace(watch, remarks=("b.csv, MJD: none",)).warnings)


def test_optics_that_may_have_changed_are_added_at_neutral(calibration):
    there = with_rivals(calibration)
    assert {"hwp1_axis", "hwp2_axis", "chwp_axis"} <= set(there.model.effect_names)
    kept = [there.model.index(name) for name in calibration.model.names]
    np.testing.assert_array_equal(there.values[kept], calibration.values)
    assert np.all(there.sigma[np.setdiff1d(np.arange(len(there.values)), kept)] < 1e-8)


BOTH = (0, 1)  # O1 and E1: the cameras of an arm
WAYS = {
    "arm": study.step(-0.01, BOTH),
    "gradient": study.gradient(0.01, BOTH, 50.0),
    "spot": study.spot(-0.02, BOTH, 0.1, 0.05, 0.1),
}


@pytest.mark.parametrize("kind", WAYS)
def test_an_arm_a_gradient_and_a_spot_are_told_as_that(kind, vectors):
    """Where a plate of the optics described the stars better than single cameras, by amounts that none can have."""
    (change,) = study.watched(400, 4, WAYS[kind]).changes
    best = change.best
    assert (best.kind, best.name, change.camera) == (kind, "O1+E1", None)
    assert change.between[0] <= 60000.0 + study.START <= change.between[1]
    if kind == "arm":
        assert best.size == pytest.approx(-0.01, abs=5 * best.error)
    elif kind == "gradient":
        # 1 % at 0.28 degrees; sizes are those at the star that lies farthest out along X or Y.
        assert best.size == pytest.approx(0.01, abs=5 * best.error + 1e-4)
        assert best.place[0] == pytest.approx(50.0, abs=4.0)
    else:
        assert np.hypot(best.place[0] - 0.1, best.place[1] - 0.05) < 0.03
        assert best.size == pytest.approx(-0.02, rel=0.25)
    for entry in change.alike:
        if entry.kind == "optics":
            _, width = vectors.calibration.model[entry.name].prior
            assert abs(entry.size) <= 10.0 * width


@pytest.mark.parametrize(("depth", "radius"), [(0.1, 0.07), (0.01, 0.05)])
def test_a_spot_of_few_stars_is_found_however_deep(depth, radius):
    """Of 600 stars some twenty, and some twelve, lie in it: 100 σ off, and 10 σ."""
    (change,) = study.watched(600, 5, study.spot(-depth, 2, 0.05, -0.08, radius)).changes
    best, size = change.best, {entry.name: entry.size for entry in change.alike}
    assert best.kind == "spot"
    assert change.between[0] <= 60000.0 + study.START <= change.between[1]
    assert size["O2"] == pytest.approx(-depth, rel=0.15)
    assert np.hypot(best.place[0] - 0.05, best.place[1] + 0.08) < 0.2 * radius
    assert best.place[2] == pytest.approx(radius, rel=0.2)


def test_three_stars_that_lie_off_are_no_spot_and_no_optics():
    def odd(night, x, y):
        change = np.zeros((len(x), 4))
        change[[3, 17, 30]] = 0.1 * np.random.default_rng(5).standard_normal((3, 4))
        return change

    watch = study.watched(100, 2, odd)
    assert watch.holds
    assert not watch.changes
    (sentence,) = watch.warnings
    assert re.match(
        r"[123] of 100 stars disagree with the calibration each by itself and were left out", sentence
    )


def test_a_change_that_nothing_within_its_range_describes_has_no_name(monkeypatch):
    """The plate that has changed may do so by a thousandth of the width of its prior only."""
    monkeypatch.setattr("walop_jax.science.star_columns.FARTHEST", 1e-3)
    watch = study.watched(400, 7, turned=("half2.plate.mgf2", 3.0))
    assert not watch.holds
    assert any(change.best.kind == "unnamed" and change.camera is None for change in watch.changes)
    assert not any(entry.kind == "optics" for change in watch.changes for entry in change.alike)
    assert any("no camera, arm or place of the field" in sentence for sentence in watch.warnings)


def test_what_single_exposures_cannot_see_is_nothing_and_not_rounding(vectors):
    """q and u of the stars are free: whatever does to all counts what q does has no information, of either sign."""
    stars = study.watching(120, 3, study.step(0.01), plates=(None,)).stars
    ones, like_q = StarWeights(*np.ones((2, len(stars.photon)))), stars.tangent[:, 0]
    matrix, score = normal_matrix(stars, stars.residual, lambda part, _: part.tangent.swapaxes(1, 2), ones)
    assert not matrix.any()
    assert not score.any()
    # The same as a number of the optics: it is not seen, in no group, and no history of it is a change.
    plain = stars.plain.copy()
    number = int(np.flatnonzero(np.abs(plain).max(axis=(0, 1)) > 0)[0])
    plain[..., number] = 1e-3 * like_q
    watching = Watching(dataclasses.replace(stars, plain=plain), vectors)
    size, error, _ = watching.answers(*watching.scan(stars.residual, ones))
    column = [reading.name for reading in watching.questions].index(vectors.named[number][0])
    assert np.isinf(error[:, column]).all()
    assert not size[:, column].any()
    assert (error > 0).all()
