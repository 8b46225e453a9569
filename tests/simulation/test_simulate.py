"""Synthetic calibration sets: what was planned is in them, their truth explains them, a seed decides all."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import sys
from pathlib import Path
from subprocess import run

import jax.numpy as jnp
import numpy as np
import pytest
from own_instrument import OWN

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.merge import merge_calibration_sets
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.write import write_calibration_set
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import refit
from walop_jax.instruments.description import shipped
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model import legendre
from walop_jax.model.effects import Described, effect_by_name
from walop_jax.model.effects.in_models import with_effects
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.parameters import leaves, values_of
from walop_jax.model.specification import make_model
from walop_jax.simulation.observing_plan import (
    NARROW_BANDS,
    ObservingPlan,
    filter_curve,
    polariser_turn,
    read_plan,
)
from walop_jax.simulation.simulate import Simulated, draw_instrument, simulate, true_instrument, truth_values
from walop_jax.sky.moon import body_direction

FITS_DATA = Path(__file__).resolve().parents[2] / "fits_data"
SMALL = ObservingPlan(
    grid=4, standard_grid=2, polariser_angles=polariser_turn(6), moon_patches=4, standards=3, unpolarised=1
)


def block_of(simulated: Simulated):
    return simulated.calset.intensities.block(0, len(simulated.calset.points))


def test_standards_lie_within_the_field():
    """A pattern of places that was made for one field would lie outside another, where nothing is calibrated."""
    assert ObservingPlan(grid=2).points().x[-1] == 0.232
    small = ObservingPlan(grid=4, field=0.09, standard_grid=3).points()
    assert np.abs(small.x).max() == np.abs(small.y).max() == 0.09
    assert np.abs(small.x[-9:]).max() == pytest.approx(0.072)


def at_truth(simulated: Simulated) -> tuple[Likelihood, np.ndarray]:
    """The base model of a set, with the effects that are in it, at the true values."""
    model = base_model(simulated.calset)
    added = [e.kind.of(SMALL.context(), **e.choices()) for e in simulated.truth.effects]
    model = with_effects(model, added, SMALL.context()) if added else model
    return Likelihood.of(simulated.calset, model), np.asarray(values_of(simulated.truth))


def chi2(likelihood: Likelihood, values: np.ndarray) -> float:
    return float((likelihood.residuals(values)[1] ** 2).sum())


# ---------------------------------------------------------------------------------------------- the plan


def test_the_plan_is_what_the_set_holds():
    calset, _ = simulate(ObservingPlan(), 0)
    e, p = calset.exposures, calset.points
    assert [int((e.kind == kind).sum()) for kind in ("clp", "moon", "standard")] == [15, 8, 8]
    np.testing.assert_allclose(e.clp_angle[e.clp_in], np.arange(0, 169, 12))
    assert len(p) == 144 + 25
    assert np.abs(p.x).max() == np.abs(p.y).max() == 0.29
    np.testing.assert_allclose(np.unique(np.round(p.x[144:], 6)), [-0.232, -0.116, 0.0, 0.116, 0.232])
    assert calset.intensities.rows == 144 * 23 + 25 * 8
    assert np.all(np.diff(e.mjd) > 0)
    assert np.all(calset.sources.q[:2] == 0.0)
    degree = np.hypot(calset.sources.q, calset.sources.u)[2:]
    assert degree.min() >= 0.01
    assert degree.max() <= 0.06


def test_plates_and_narrow_bands_multiply_the_polariser_and_alternate_on_the_sky():
    plan = dataclasses.replace(SMALL, plate=(None, 0.0, 45.0), filters=("SDSS-r", *NARROW_BANDS))
    e = simulate(plan, 1).calset.exposures
    assert (e.kind == "clp").sum() == 6 * 3 * 3
    assert set(e.filter[e.kind != "clp"]) == {"SDSS-r"}
    np.testing.assert_array_equal(e.position("CHWP").angle[e.kind == "moon"], [np.nan, 0.0, 45.0, np.nan])


@pytest.mark.parametrize("instrument", ["WALOP-SOUTH", "WALOP-NORTH"])
@pytest.mark.parametrize("mjd", [None, 60000.0])
def test_patches_lie_around_the_moon_wherever_it_is(instrument: str, mjd: float | None):
    plan = ObservingPlan(instrument, mjd=mjd)
    e = plan.exposures()
    moon = e.kind == "moon"
    ra, dec = (np.deg2rad(a) for a in body_direction("moon", e.mjd[moon], plan.site))
    field_ra, field_dec = np.deg2rad(e.ra[moon]), np.deg2rad(e.dec[moon])
    # Haversine form, exact for small angles too.
    chord = (
        np.sin((field_dec - dec) / 2) ** 2
        + np.cos(dec) * np.cos(field_dec) * np.sin((field_ra - ra) / 2) ** 2
    )
    separation = np.rad2deg(2 * np.arcsin(np.sqrt(chord)))
    assert separation.min() > 8.0
    assert separation.max() < 20.0
    assert np.ptp(separation) > 8.0
    assert len(set(e.rotator[moon])) == 4


@pytest.mark.parametrize("instrument", ["WALOP-SOUTH", "WALOP-NORTH"])
def test_default_nights_are_full_moon_and_the_moon_is_up(instrument: str):
    from astropy import units
    from astropy.coordinates import AltAz, EarthLocation, SkyCoord, get_body
    from astropy.time import Time
    from astropy.utils import iers

    plan = ObservingPlan(instrument)
    e = plan.exposures()
    moon = e.kind == "moon"
    site = ObservingPlan(instrument).site
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("iers_degraded_accuracy", "ignore"):
        time = Time(e.mjd[moon], format="mjd")
        place = EarthLocation.from_geodetic(site.longitude, site.latitude, site.elevation)
        moon_there, sun_there = (get_body(body, time, place) for body in ("moon", "sun"))
        separation = moon_there.separation(sun_there, origin_mismatch="ignore")
        frame = AltAz(obstime=time, location=place)
        fields = SkyCoord(e.ra[moon] * units.deg, e.dec[moon] * units.deg).transform_to(frame)
        sun = sun_there.transform_to(frame)
        # Hour angles of the plan against astropy's, to a minute.
        sidereal = time.sidereal_time("mean", site.longitude * units.deg)
        hour_angle = (sidereal - fields.icrs.ra).wrap_at("180d").hourangle
    assert separation.deg.min() > 165.0
    assert fields.alt.deg.min() > 25.0
    assert sun.alt.deg.max() < -18.0
    np.testing.assert_allclose(e.ha[moon], hour_angle, atol=1.0 / 60.0)


def test_narrow_bands_are_fifteen_nanometres_wide():
    for name, centre in NARROW_BANDS.items():
        curve = filter_curve(name)
        inside = curve.wavelength[curve.throughput >= 0.5 - 1e-9]
        assert inside[[0, -1]] == pytest.approx([centre - 0.0075, centre + 0.0075])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"instrument": "WALOP-EAST"}, "there is no instrument"),
        ({"grid": 0}, "grid"),
        ({"standards": -1}, "negative"),
        ({"electrons": 0.0}, "light"),
        ({"filters": ("SDSS-q",)}, "SDSS-q"),
        ({"plate": ()}, "calibration plate"),
        ({"polariser_angles": ()}, "polariser angle"),
    ],
)
def test_impossible_plans_are_refused(change: dict, message: str):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SMALL, **change)


# ---------------------------------------------------------------------------------------- as-built values


def test_as_built_values_follow_their_priors():
    model = make_model("WALOP-SOUTH", nominal_instrument())
    rng = np.random.default_rng(2)
    drawn = np.array([np.asarray(values_of(draw_instrument(model, rng))) for _ in range(400)])
    for i, p in enumerate(model.parameters):
        if p.prior is not None:
            z = (drawn[:, i] - p.prior[0]) / p.prior[1]
            assert abs(z.mean()) < 0.25, p.name
            assert z.std() == pytest.approx(1.0, abs=0.2), p.name
    assert drawn[:, model.index("half1.efficiency")].max() <= 1.0
    np.testing.assert_array_equal(drawn[:, model.index("throughput.n0.p00")], 0.5)  # the gauge
    assert drawn[:, model.index("throughput.n2.p00")].std() == pytest.approx(0.03 * np.sqrt(2), rel=0.15)


def test_throughputs_have_two_per_cent_of_structure():
    model = make_model("WALOP-SOUTH", nominal_instrument())
    rng = np.random.default_rng(3)
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-0.3, 0.3, 21)] * 2))
    basis = np.asarray(legendre.basis(jnp.asarray(x), jnp.asarray(y), 4))
    relative = []
    for _ in range(200):
        maps = np.asarray(draw_instrument(model, rng).throughput.coefficients) @ basis.T
        relative.append(maps / maps.mean(axis=1, keepdims=True) - 1.0)
    assert np.sqrt(np.mean(np.square(relative))) == pytest.approx(0.02, rel=0.15)


def test_arms_with_a_flux_of_their_own_are_drawn_by_the_ratio_of_their_cameras():
    """Two maps of degree 4 have a ratio of no degree at all, which no fit could follow."""
    model = make_model("WALOP-NORTH", nominal_instrument("WALOP-NORTH"))
    drawn = np.asarray(draw_instrument(model, np.random.default_rng(5)).throughput.coefficients)
    np.testing.assert_array_equal(drawn[[0, 2]], np.eye(1, drawn.shape[1])[[0, 0]] * 0.5)
    assert (drawn[[1, 3]] != 0.0).all()


def test_tied_parameters_are_built_alike():
    model = make_model("WALOP-SOUTH", nominal_instrument())
    model = model.change("half2.plate.mgf2", tie="half1.plate.mgf2")
    built = np.asarray(values_of(draw_instrument(model, np.random.default_rng(4))))
    first, second = (built[model.index(f"half{n}.plate.mgf2")] for n in (1, 2))
    assert first == second != model["half1.plate.mgf2"].start


def test_stars_scatter_around_their_catalogue():
    pulls = []
    for seed in range(20):
        calset, truth = simulate(dataclasses.replace(SMALL, grid=1), seed, noiseless=True)
        pulls.append((np.asarray(truth.standard.q) - calset.sources.q) / calset.sources.q_err)
    assert np.mean(pulls) == pytest.approx(0.0, abs=0.4)
    assert np.std(pulls) == pytest.approx(1.0, abs=0.25)


# ------------------------------------------------------------------------------------------ light and noise


def test_a_seed_decides_everything():
    one, two, other = (simulate(SMALL, seed) for seed in (7, 7, 8))
    first, second, third = (block_of(s) for s in (one, two, other))
    np.testing.assert_array_equal(first.counts, second.counts)
    np.testing.assert_array_equal(first.sigma, second.sigma)
    np.testing.assert_array_equal(np.asarray(values_of(one.truth)), np.asarray(values_of(two.truth)))
    assert not np.any(first.counts[first.used] == third.counts[third.used])


def test_the_truth_explains_the_data():
    simulated = simulate(SMALL, 9)
    likelihood, true = at_truth(simulated)
    rows = simulated.calset.intensities.rows
    assert chi2(likelihood, true) == pytest.approx(3 * rows, abs=4 * np.sqrt(6 * rows))
    assert list(truth_values(simulated.truth)) == list(likelihood.model.names)


def test_without_noise_nothing_is_left():
    simulated = simulate(SMALL, 9, noiseless=True)
    likelihood, true = at_truth(simulated)
    assert chi2(likelihood, true) < 1e-15


@pytest.mark.parametrize(
    ("name", "values"),
    [
        pytest.param("clp_wobble", {"amplitude": 0.06, "phase": 1.1}, marks=pytest.mark.long),
        ("ghost", {"share": 0.01}),
        pytest.param("pedestal", {"level": 0.01}, marks=pytest.mark.long),
        ("nonlinearity", {"coefficient": 0.02}),
        ("standard_outlier", {"source": "STD01", "q": 0.003}),
    ],
)
def test_effects_are_in_the_data(name: str, values: dict):
    effect = effect_by_name(name).of(SMALL.context(), **values)
    with_it = simulate(SMALL, 10, effects=[effect], noiseless=True)
    without = simulate(SMALL, 10, noiseless=True)
    changed, plain = (block_of(s) for s in (with_it, without))
    assert np.abs(changed.counts[changed.used] / plain.counts[plain.used] - 1.0).max() > 1e-4
    likelihood, true = at_truth(with_it)
    assert chi2(likelihood, true) < 1e-6
    bare = Likelihood.of(with_it.calset, base_model(with_it.calset))
    assert chi2(bare, np.asarray(values_of(without.truth))) > 10.0


def test_an_instrument_may_be_given():
    given = nominal_instrument()
    calset, truth = simulate(SMALL, 11, instrument=given)
    place = [leaf.name for leaf in leaves(truth)].index("pupil.magnification")
    assert values_of(truth)[place] == 15.63
    assert truth.standard.names == SMALL.star_names
    assert calset.sources.name.tolist() == list(SMALL.star_names)


def test_counts_are_at_the_level_that_was_asked_for():
    block = block_of(simulate(dataclasses.replace(SMALL, electrons=1e5), 12))
    level = block.counts[block.used].mean()
    # Transparency 0.7 … 1, and 14 % of the light is reflected by two plates in air.
    assert 0.6e5 < level < 1e5


@pytest.mark.parametrize(
    "plan",
    [
        dataclasses.replace(SMALL, instrument="WALOP-NORTH"),
        dataclasses.replace(ObservingPlan.bench(), polariser_angles=polariser_turn(6)),
    ],
    ids=["north", "bench"],
)
def test_other_instruments(plan: ObservingPlan, tmp_path: Path):
    calset, truth = simulate(plan, 13)
    write_calibration_set(tmp_path / "set.fits", calset)
    again = read_calibration_set(tmp_path / "set.fits")
    assert again.instrument == plan.instrument
    instrument = nominal_instrument(plan.instrument)
    model = base_model(again, instrument, throughput_degree=plan.throughput_degree)
    data = (4 - instrument.cameras.fluxes) * calset.intensities.rows
    assert chi2(Likelihood.of(again, model), np.asarray(values_of(truth))) == pytest.approx(
        data, abs=4 * np.sqrt(2 * data)
    )


@pytest.mark.parametrize(("name", "grid"), [("WALOP-SOUTH", 3), ("WALOP-NORTH", 3), ("WALOP-LAB", 12)])
def test_the_usual_set_of_a_shipped_instrument_can_be_fitted(name: str, grid: int):
    """χ² is within 4 of its standard deviations of its expectation."""
    instrument = nominal_instrument(name)
    plan = dataclasses.replace(ObservingPlan.usual(instrument), grid=grid, standard_grid=2)
    found = refit(simulate(plan, 0).calset)
    assert abs(found.chi2 - found.dof) < 4.0 * np.sqrt(2.0 * found.dof)


@pytest.mark.parametrize("name", shipped())
def test_instruments_drawn_from_the_priors_are_possible(name: str):
    """Of 60: places stay in their order and ahead of 90 deg, and no light is more than fully polarised."""
    design = nominal_instrument(name)
    model = make_model(name, design)
    r = np.linspace(0.0, design.raster[1] * (1.0 if design.raster[0] == "line" else np.sqrt(2.0)), 50)
    for seed in range(60):
        drawn = draw_instrument(model, np.random.default_rng(seed))
        pupil, collimator = drawn.element("pupil"), drawn.element("collimator")
        turn = float(pupil.magnification) * r * (1.0 + float(pupil.distortion) * r**2)
        assert np.all(np.diff(turn) > 0.0)
        assert turn[-1] < 90.0
        assert abs(float(collimator.diattenuation)) * r[-1] ** 2 < 1.0


def test_two_nights_can_be_merged():
    nights = [
        simulate(dataclasses.replace(SMALL, mjd=61220.85 + night, standards=0), 14).calset for night in (0, 1)
    ]
    assert len(merge_calibration_sets(*nights).exposures) == 2 * len(nights[0].exposures)


# ------------------------------------------------------------------------------------- the set in fits_data


def documented_command(name: str) -> list[str]:
    """The command in the README, or in the sealed file of a set whose README keeps quiet about what is in it."""
    readme, sealed = FITS_DATA / "README.md", FITS_DATA / f"{name}_sealed.json"
    text = (
        json.loads(sealed.read_text(encoding="utf-8"))["command"]
        if sealed.exists()
        else readme.read_text(encoding="utf-8")
    )
    found = re.search(r"^walop-jax (simulate .*)$", text, re.MULTILINE)
    assert found is not None
    return shlex.split(found[1])


@pytest.mark.parametrize(
    ("name", "truth"),
    [
        pytest.param("walop_south_small", "walop_south_small_truth", marks=pytest.mark.long),
        ("walop_south_hidden", "walop_south_hidden_sealed"),
    ],
)
def test_the_documented_command_makes_the_set_in_fits_data(tmp_path: Path, name: str, truth: str):
    arguments = [
        str((FITS_DATA if word.endswith(".toml") else tmp_path) / Path(word).name)
        if word.startswith("fits_data/")
        else word
        for word in documented_command(name)
    ]
    run([sys.executable, "-c", "from walop_jax.commands import main; main()", *arguments], check=True)
    stored = read_calibration_set(FITS_DATA / f"{name}.fits")
    made = read_calibration_set(tmp_path / f"{name}.fits")
    for part in ("exposures", "points", "sources"):
        ours, theirs = (
            entry.exposures.columns() if part == "exposures" else dataclasses.asdict(getattr(entry, part))
            for entry in (made, stored)
        )
        assert ours.keys() == theirs.keys()
        for column, values in ours.items():
            reference = theirs[column]
            if values.dtype.kind == "f":
                np.testing.assert_allclose(values, reference, rtol=1e-13, atol=1e-13)
            else:
                np.testing.assert_array_equal(values, reference)
    assert isinstance(made.intensities, TableIntensities)
    assert isinstance(stored.intensities, TableIntensities)
    # Electrons are drawn whole, so the last digit of an expectation may cost one here and there, or all of a point.
    off = np.abs(made.intensities.counts - stored.intensities.counts).max(axis=1)
    assert np.mean(off < 3.0) > 0.95
    assert (FITS_DATA / f"{name}.fits").stat().st_size < 300_000
    made_truth, stored_truth = (
        json.loads((folder / f"{truth}.json").read_text(encoding="utf-8")) for folder in (tmp_path, FITS_DATA)
    )
    stored_truth.pop("command", None)
    assert made_truth == stored_truth


def test_without_a_polariser_there_are_no_exposures_through_one(tmp_path):
    file = tmp_path / "own.toml"
    text = OWN.replace('path = ["polariser", "window"]', 'path = ["window"]')
    file.write_text(re.sub(r"\[elements\.polariser\]\n(?:.+\n){3}", "", text))
    instrument = Instrument.read(file)
    plan = ObservingPlan(
        instrument,
        grid=3,
        moon_patches=0,
        standards=0,
        lamps=4,
        moving={"WIN": (0.0, 45.0)},
        throughput_degree=1,
    )
    exposures = plan.exposures()
    assert set(exposures.kind.tolist()) == {"lamp"}
    assert len(exposures) == 8
    assert not exposures.clp_in.any()
    with pytest.raises(ValueError, match="no polariser"):
        dataclasses.replace(plan, polariser_angles=(0.0, 90.0))
    with pytest.raises(ValueError, match="no exposures"):
        dataclasses.replace(plan, lamps=0)


@pytest.mark.parametrize("full_turn", [None, False, True])
def test_a_number_of_polariser_angles_is_the_same_in_python_and_in_a_file(tmp_path, full_turn):
    step = 40.0 if full_turn else 20.0
    angles = tuple(step * k for k in range(9))
    word = {} if full_turn is None else {"full_turn": full_turn}
    assert ObservingPlan(polariser_angles=9, **word).polariser_angles == angles
    path = tmp_path / "plan.toml"
    path.write_text("polariser_angles = 9\n" + "".join(f"{k} = {str(v).lower()}\n" for k, v in word.items()))
    assert read_plan(path) == ObservingPlan(polariser_angles=angles)
    # What is made of it stays: another entry does not ask again.
    changed = dataclasses.replace(ObservingPlan(polariser_angles=9, **word), grid=3)
    assert changed.polariser_angles == angles
    assert ObservingPlan(full_turn=True).polariser_angles == tuple(24.0 * k for k in range(15))
    assert ObservingPlan(polariser_angles=np.array([0.0, 60.0])).polariser_angles == (0.0, 60.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("polariser_angles = 0", "must be at least 1, or a list of angles"),
        ("polariser_angles = 8.5", "must be a number of angles, such as 15, or a list"),
        ("polariser_angles = true", "must be a number of angles, such as 15, or a list"),
        ('polariser_angles = "8"', "must be a number of angles, such as 15, or a list"),
        ("polariser_angles = [0, 60]\nfull_turn = true", "of no use beside a list"),
        ('full_turn = "yes"', "full_turn = 'yes' must be true or false"),
    ],
)
def test_angles_that_are_neither_a_number_nor_a_list(tmp_path, text, message):
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_plan(path)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"polariser_angles": 0}, "must be at least 1, or a list of angles"),
        ({"polariser_angles": True}, "must be a number of angles, such as 15, or a list"),
        ({"polariser_angles": (0.0, 60.0), "full_turn": True}, "of no use beside a list"),
    ],
)
def test_the_same_in_python(entries, message):
    with pytest.raises(ValueError, match=message):
        ObservingPlan(**entries)


def test_every_standard_has_a_name_of_its_own():
    sources, _ = true_instrument(ObservingPlan(grid=2, moon_patches=0, standards=102))
    assert sources.name[[0, 10, 101]].tolist() == ["STD00", "STD10", "STD101"]
    assert len(np.unique(sources.name)) == 102


@pytest.mark.parametrize(
    ("unpolarised", "lmax"), [(3, [0.55, 0.55, 0.55]), (1, [0.55, 0.45, 0.65])], ids=["all", "one"]
)
def test_wavelengths_of_largest_polarisation_are_those_of_polarised_standards(unpolarised, lmax):
    """The first standards are the unpolarised ones; without any other the list is not used."""
    plan = ObservingPlan(grid=2, standards=3, unpolarised=unpolarised, star_lmax=(0.45, 0.65))
    _, truth = true_instrument(plan)
    np.testing.assert_array_equal(truth.standard.lmax, lmax)


@pytest.mark.parametrize("sentence", ["gain of E1 * counts * y", "gain of E1 * hours"])
def test_detectors_answer_at_the_place_of_the_light(sentence):
    """A gain 1 + a N y or 1 + a t: what it adds, over N² y or N, is one number in all points of an exposure."""
    sets = [
        simulate(SMALL, 10, effects=effects, noiseless=True)
        for effects in ([], [Described.saying([sentence], [1e-3])])
    ]
    plain, changed = map(block_of, sets)
    camera = nominal_instrument().cameras.names.index("E1")
    counts, used = plain.counts[..., camera], plain.used
    share = changed.counts[..., camera] / np.where(used, counts, 1.0) - 1.0
    by = counts * sets[0].calset.points.y[:, None] if "counts" in sentence else np.ones_like(counts)
    slopes = np.where(used & (by != 0.0), share / np.where(by == 0.0, 1.0, by), np.nan)
    typical = np.nanmedian(slopes, axis=0)
    assert np.abs(typical).max() > 0.0
    assert np.nanmax(np.abs(slopes - typical)) < 1e-9 * np.abs(typical).max()
