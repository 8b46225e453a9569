"""Normal equations of nights against fits of the whole, and the table of bad input."""

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
import pytest
from small_run import SMALL

from walop_jax.data.merge import merge_calibration_sets
from walop_jax.data.records import InputFile, Position
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.variance_components import groupings
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import effect_by_name
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.nights import equations, night_file
from walop_jax.nights.equations import data_hash, model_hash, night_equations, with_candidates_of
from walop_jax.nights.together import check_together, together
from walop_jax.simulation.simulate import simulate
from walop_jax.sky.nights import night_of

SAAO = 20.8  # deg


@pytest.fixture(scope="module")
def two():
    """Two nights, a week apart, of one instrument."""
    first = simulate(SMALL, seed=1)
    later = dataclasses.replace(SMALL, mjd=SMALL.start + 7.0)
    return first.calset, simulate(later, seed=2, instrument=first.truth, catalogue_seed=1).calset


def test_data_are_identified_by_their_files_or_their_content(two):
    """A set that comes from no file: any change of exposures or measurements, however small, is another set."""
    calset = two[0]
    content = data_hash(calset)
    assert data_hash(simulate(SMALL, seed=1).calset) == content
    exposures = calset.exposures.placed(CLP=Position.at(calset.exposures.clp_angle + 1e-9))
    assert data_hash(dataclasses.replace(calset, exposures=exposures)) != content
    rows = calset.intensities
    counts = rows.counts.copy()
    counts[-1, -1] += 1e-6
    assert (
        data_hash(dataclasses.replace(calset, intensities=dataclasses.replace(rows, counts=counts)))
        != content
    )
    files = (InputFile(Path("a.fits"), "0" * 64), InputFile(Path("b.fits"), "1" * 64))
    assert data_hash(dataclasses.replace(calset, inputs=files[:1])) == "0" * 64
    both = hashlib.sha256(b"0" * 64 + b"1" * 64).hexdigest()
    assert data_hash(dataclasses.replace(calset, inputs=files)) == both


@pytest.fixture(scope="module")
def nights(two):
    model = base_model(two[0])
    return [night for calset in two for night in night_equations(calset, model, model.start)]


def test_a_night_lasts_from_noon_to_noon():
    """Local mean noon at 20.8° east is 10:37 UTC."""
    mjd = 61000.0 + np.array([10.5, 10.7, 23.9, 24.1, 34.5, 34.7]) / 24.0
    assert night_of(mjd, SAAO).tolist() == [60999, 61000, 61000, 61000, 61000, 61001]
    # Without a site noon is in the middle of the longest part of the day without exposures, at 17:18 UTC.
    assert night_of(mjd, np.nan).tolist() == [60999, 60999, 61000, 61000, 61000, 61000]


def test_longitudes_east_of_180_are_those_west_of_it():
    """Las Campanas at −70.7° or 289.3°: noon at 16:43 UTC."""
    mjd = 60000.0 + np.array([0.03, 0.4, 0.68, 0.71, 1.03])
    for longitude in (-70.7, 289.3):
        assert night_of(mjd, longitude).tolist() == [59999, 59999, 59999, 60000, 60000]


def test_files_of_one_night_without_a_longitude_are_of_one_night():
    """One begins before midnight UTC and one after it; nights of a day later are others, also in one file."""
    first, second = 59000.99 + np.array([0.0, 0.15, 0.31]), 59001.02 + np.array([0.0, 0.03])
    assert set(night_of(first, np.nan)) == set(night_of(second, np.nan)) == {59000.0}
    two = np.array([59001.05, 59001.15, 59001.95, 59002.1])
    assert night_of(two, np.nan).tolist() == [59000, 59000, 59001, 59001]


def test_nights_that_overlap_are_refused(nights):
    """A walk would go backwards in time."""
    first = nights[0]
    other = dataclasses.replace(
        first, number=first.number + 1, begin=first.begin + 0.01, end=first.end + 0.01, sha256="other"
    )
    with pytest.raises(DataError, match=r"overlap: .* \(SITELONG"):
        check_together([first, other])


def test_nights_without_a_longitude_are_asked_for_too(monkeypatch):
    """Two nights of a set without a site are a component of the noise, told apart by the gap between them."""
    run = simulate(dataclasses.replace(SMALL, moon_patches=0, standards=0), seed=3)
    e = run.calset.exposures
    later = np.where(np.arange(len(e)) < len(e) // 2, e.mjd, e.mjd + 1.0)
    calset = dataclasses.replace(
        run.calset,
        exposures=dataclasses.replace(e, mjd=later),
        site=dataclasses.replace(run.calset.site, longitude=np.nan),
    )
    design = Design.of(fit(Likelihood.of(calset, base_model(calset))))
    (nights,) = (one for one in groupings(design) if one.name == "nights")
    assert [len(np.unique(row)) for row in nights.place] == [2] * len(calset.points)


def test_exposures_whose_time_is_not_known_are_of_no_night():
    found = night_of(np.array([np.nan, 10.2, 11.2, 10.3]), np.nan)
    assert np.isnan(found[0])
    assert found[1:].tolist() == [9.0, 10.0, 9.0]  # observed after midnight UTC
    assert night_of(np.array([10.2, np.nan]), 90.0)[0] == 9.0


def test_the_gauge_of_the_throughputs_is_a_candidate_with_the_slope_of_its_camera(nights):
    """All throughputs by the same factor are flux: Σ t ∂r/∂t = 0, the one that is held among them."""
    night = nights[0]
    gauge = night.names.index("throughput.n0.p00")
    assert gauge >= len(night.names) - night.candidates
    assert night.reference[gauge] == night.parameters[gauge].start == 0.5
    along = np.array(
        [v if n.startswith("throughput.") else 0.0 for n, v in zip(night.names, night.reference, strict=True)]
    )
    assert np.count_nonzero(along) > 3
    one = along[gauge] * np.sqrt(night.matrix[gauge, gauge])
    assert np.sqrt(max(along @ night.matrix @ along, 0.0)) < 1e-5 * one
    assert together(nights).gauge.nonzero()[0].size == 1


def test_a_model_that_holds_an_outlier_of_a_standard_elsewhere_is_another_model(two):
    """What belongs to sky and stars does so by its part, not by the beginning of its name."""
    context = effect_context(base_model(two[0]).template, two[0].exposures)
    model = with_effects(base_model(two[0]), [effect_by_name("standard_outlier").neutral(context)], context)
    name = next(n for n in model.names if n.startswith("standard_outlier."))
    held = [model.change(name, free=False, start=value) for value in (0.0, 0.01)]
    assert model_hash(held[0]) != model_hash(held[1])
    name = next(n for n in model.names if n.startswith("standard."))
    held = [model.change(name, free=False, start=value) for value in (0.0, 0.01)]
    assert model_hash(held[0]) == model_hash(held[1])


def test_equations_are_those_of_the_fit(two, nights):
    """χ², gradient and matrix in the free parameters, against the pass of a fit: another program."""
    model = base_model(two[0])
    terms, _ = Likelihood.of(two[0], model).data_terms(model.start)
    select, night = model.selection(), nights[0]
    n = len(model.free)
    assert night.chi2 == pytest.approx(terms.data, rel=1e-9)
    assert night.gradient[:n] == pytest.approx(select.T @ terms.gradient, rel=1e-7, abs=1e-6)
    assert night.matrix[:n, :n] == pytest.approx(select.T @ terms.matrix @ select, rel=1e-7, abs=1e-6)


@pytest.mark.parametrize(
    "name", ["clp_zero.angle", "hwp2_axis.angle", "telescope_polarisation.q", "filter_shift.wavelength"]
)
def test_candidates_are_effects_at_neutral(two, nights, name):
    """Gradient and curvature of an amplitude that the model lacks: those of the model that has it."""
    model = base_model(two[0])
    kind, _, parameter = name.partition(".")
    context = effect_context(model.template, two[0].exposures)
    larger = with_effects(model, [effect_by_name(kind).neutral(context)], context)
    terms, _ = Likelihood.of(two[0], larger).data_terms(larger.start)
    i, k = larger.index(f"{kind}.{parameter}"), nights[0].names.index(name)
    assert nights[0].gradient[k] == pytest.approx(terms.gradient[i], rel=1e-6)
    assert nights[0].matrix[k, k] == pytest.approx(terms.matrix[i, i], rel=1e-6)


def test_a_set_of_two_nights_comes_apart(two, nights):
    whole = merge_calibration_sets(*two)
    apart = night_equations(whole, base_model(whole), base_model(whole).start)
    assert [night.number for night in apart] == [night.number for night in nights]
    for one, other in zip(apart, nights, strict=True):
        names = [name for name in other.names if name in one.names]
        a, b = (np.array([n.names.index(name) for name in names]) for n in (one, other))
        assert one.chi2 == pytest.approx(other.chi2, rel=1e-9)
        assert one.gradient[a] == pytest.approx(other.gradient[b], rel=1e-6, abs=1e-4)


def test_nights_are_written_and_read(tmp_path, nights):
    path = tmp_path / "night.fits"
    night_file.write_nights(path, nights[:1])
    (found,) = night_file.read_nights(path)
    for field in dataclasses.fields(found):
        if field.name != "parameters":
            assert np.all(getattr(found, field.name) == getattr(nights[0], field.name)), field.name
    assert [(p.name, p.prior, p.loose) for p in found.parameters] == [
        (p.name, p.prior, p.loose) for p in nights[0].parameters
    ]
    damaged = path.read_bytes()
    path.write_bytes(damaged[:-9000] + b"damaged?" + damaged[-8992:])
    with pytest.raises(DataError, match="do not agree"):
        night_file.read_nights(path)


def test_the_order_of_nights_does_not_matter(nights):
    one, other = together(nights), together(nights[::-1])
    assert [n.number for n in one.nights] == [n.number for n in other.nights]
    assert np.array_equal(one.equations.matrix, other.equations.matrix)


def test_a_night_twice_is_refused(nights):
    with pytest.raises(DataError, match="twice: the same data"):
        together([*nights, nights[0]])
    copied = dataclasses.replace(nights[0], sha256="0" * 64, source="copy.fits")
    with pytest.raises(
        DataError, match=r"exposures of the same times are in copy.fits and .*; leave one out"
    ):
        together([*nights, copied])


def test_other_instruments_and_models_are_refused(nights):
    with pytest.raises(DataError, match=r"two instruments, .* stack the instruments apart"):
        together([nights[0], dataclasses.replace(nights[1], instrument="WALOP-NORTH")])
    with pytest.raises(DataError, match="two models"):
        together([nights[0], dataclasses.replace(nights[1], model="f" * 64)])


def test_exposures_without_a_time_are_refused(two):
    e = two[0].exposures
    lost = dataclasses.replace(e, mjd=np.where(np.arange(len(e)) == 1, np.nan, e.mjd))
    with pytest.raises(DataError, match="MJD: not given in 1 of"):
        list(equations.split(dataclasses.replace(two[0], exposures=lost)))


def test_values_without_finite_counts_are_refused(two):
    """Where nights far from their common model have led it, numbers end."""
    with pytest.raises(DataError, match=r"no finite counts .* leave out those not trusted"):
        night_equations(two[0], base_model(two[0]), {"half2.plate.quartz": np.inf}, {})


@pytest.mark.parametrize("hours", [2.0, -7.0])
def test_clocks_in_local_time_are_refused(two, hours):
    e = two[0].exposures
    equations.check_clock(e, two[0].site)
    local = dataclasses.replace(e, mjd=e.mjd + hours / 24.0)
    with pytest.raises(DataError, match=rf"is [+-]{abs(hours):.2f} h from UTC"):
        equations.check_clock(local, two[0].site)


def test_candidates_follow_a_night_that_is_linearised_anew(nights):
    """In a linear problem, r(θ) = r₀ + J θ + C c, they do so exactly; elsewhere no information is made up."""
    rng, (n, k) = np.random.default_rng(0), (len(nights[0].names), nights[0].candidates)
    cut = n - k
    columns, r = rng.normal(size=(3 * n, n)), rng.normal(size=3 * n)
    columns[:, cut] = columns[:, 0] + 1e-6 * columns[:, cut]  # one that is nearly a parameter
    moved = rng.normal(size=cut)

    def at(theta, J, candidates):
        """The night with some candidates, by their positions."""
        keep = [*range(cut), *candidates]
        left, some = r + J[:, :cut] @ theta, J[:, keep]
        return dataclasses.replace(
            nights[0],
            parameters=tuple(nights[0].parameters[i] for i in keep),
            candidates=len(candidates),
            reference=np.append(theta, np.zeros(len(candidates))),
            gradient=some.T @ left,
            matrix=some.T @ some,
        )

    every, few = range(cut, n), (cut + 3, cut + 7)
    before, there = at(np.zeros(cut), columns, every), at(moved, columns, every)
    largest = np.abs(there.gradient).max()
    for some in ((), few):
        found = with_candidates_of(at(moved, columns, some), before)
        assert found.names == there.names
        np.testing.assert_allclose(found.matrix, there.matrix, rtol=1e-9, atol=1e-9 * there.matrix.max())
        np.testing.assert_allclose(found.gradient, there.gradient, rtol=1e-8, atol=1e-8 * largest)
    bent = columns * (1.0 + 0.01 * rng.normal(size=columns.shape))
    size = np.sqrt(np.diag(before.matrix))
    found = with_candidates_of(at(moved, bent, ()), before)
    assert np.linalg.eigvalsh(found.matrix / np.outer(size, size))[0] > -1e-12
    np.testing.assert_allclose(found.matrix[:cut, :cut], (bent.T @ bent)[:cut, :cut], rtol=1e-12)
    found, keep = with_candidates_of(at(moved, bent, few), before), [*range(cut), *few]
    np.testing.assert_allclose(
        found.matrix[np.ix_(keep, keep)], (bent.T @ bent)[np.ix_(keep, keep)], rtol=1e-12
    )
