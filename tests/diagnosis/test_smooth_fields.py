"""Smooth fields: their prior against draws of the process, their products against columns that are written out."""

import dataclasses
from types import SimpleNamespace

import builders
import numpy as np
import pytest
from small_run import SMALL

from walop_jax.data.table_intensities import TableIntensities
from walop_jax.diagnosis.design import Design, Measured
from walop_jax.diagnosis.examination import examine
from walop_jax.diagnosis.findings import document
from walop_jax.diagnosis.grammar import hypotheses, smooth_fields
from walop_jax.diagnosis.hypotheses import Hypotheses, SmoothField, texts_of
from walop_jax.diagnosis.score import SCALES
from walop_jax.diagnosis.selection import JointScores
from walop_jax.diagnosis.smooth_fields import SmoothFields
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood.columns import Columns, own_columns
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model import legendre
from walop_jax.model.effects import Context, Described
from walop_jax.model.effects.change import Change
from walop_jax.model.effects.factors import SMOOTH_LENGTH, smooth_deviations
from walop_jax.model.effects.in_models import known_effects
from walop_jax.model.instrument import nominal_instrument
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

OF_OPTICS, OF_CAMERAS = 6, 8  # largest degrees of the terms of a smooth field


def test_the_prior_is_that_of_coefficients_of_a_gaussian_process():
    """Legendre coefficients of draws of the process with kernel exp(−Δ²/2ℓ²), whose variance is 1."""
    nodes, weights = np.polynomial.legendre.leggauss(60)
    kernel = np.exp(-0.5 * ((nodes[:, None] - nodes) / SMOOTH_LENGTH) ** 2)
    value, vector = np.linalg.eigh(kernel)
    draws = (vector * np.sqrt(np.clip(value, 0.0, None))) @ np.random.default_rng(1).standard_normal(
        (60, 20_000)
    )
    for degree, sigma in enumerate(smooth_deviations()):
        polynomial = np.polynomial.legendre.Legendre.basis(degree)(nodes)
        coefficients = (degree + 0.5) * (weights * polynomial) @ draws
        assert np.std(coefficients) == pytest.approx(sigma, rel=0.02)
    # What the degrees to eight hold of the variance of the process: nearly all.
    held = sum(s**2 / (2 * i + 1) for i, s in enumerate(smooth_deviations()))
    assert 0.99 < held < 1.0


def test_the_size_of_a_smooth_field_is_its_rms_over_the_square():
    """Mean square of Σ a f over a fine grid of the field, against the sum of the squares of a × rms of each term."""
    terms = legendre.terms(OF_CAMERAS)
    changes = [Change.parsed(f"gain of O1 * field {i} {j}") for i, j in terms]
    amplitudes = np.random.default_rng(2).standard_normal(len(terms))
    edges = np.linspace(-0.3, 0.3, 400)
    x, y = np.meshgrid(0.5 * (edges[1:] + edges[:-1]), 0.5 * (edges[1:] + edges[:-1]))

    @dataclasses.dataclass
    class At:
        x: np.ndarray
        y: np.ndarray

    field = sum(a * c.factor(At(x, y)) for a, c in zip(amplitudes, changes, strict=True))
    expected = np.sqrt(sum((a * c.smooth_rms) ** 2 for a, c in zip(amplitudes, changes, strict=True)))
    assert np.sqrt(np.mean(field**2)) == pytest.approx(expected, rel=1e-3)
    assert changes[0].candidate == "gain of O1 * smooth"
    assert Change.parsed("gain of O1 * hours").candidate == "gain of O1 * hours"


@pytest.fixture(scope="module")
def examined():
    calset = simulate(SMALL, seed=3).calset
    model = base_model(calset)
    result = fit(Likelihood.of(calset, model))
    listed = hypotheses(known_effects(model), model.template, calset.exposures, len(calset.points))
    few = Hypotheses(listed.names[:4], listed.descriptions[:60], (), listed.effects, (), listed.smooth)
    return examine(result, few, np.random.default_rng(0))


@pytest.mark.parametrize("name", ["WALOP-SOUTH", "WALOP-NORTH", "WALOP-LAB"])
def test_every_smooth_field_can_be_said_of_its_instrument(name):
    """Its terms are allowed where it is, and its laws are those of the exposures: each KIND, and steps in time."""
    instrument = nominal_instrument(name)
    kinds = ("clp", "clp", "clp", "clp", "moon", "moon", "standard", "standard", "clp", "clp")
    exposures = builders.exposures(
        *(
            {"kind": kind, "mjd": 61000.0 + hour / 24.0, "clp_in": kind == "clp", "clp_angle": 36.0 * hour}
            for hour, kind in enumerate(kinds)
        )
    )
    fields = smooth_fields(instrument, exposures, 25)
    assert len({field.name for field in fields}) == len(fields)
    context = Context()
    for field in fields:
        probe = field.probe(context)
        assert len(probe.widths) == len(field.changes) * len(field.terms)
        for text in texts_of(probe)[:: len(field.terms) - 1]:
            Change.parsed(text).check_factors(instrument)
            assert Change.parsed(text).candidate in field.name
    reference, camera, *_ = instrument.cameras.names
    changes = [change for field in fields for change in field.changes if change.place == camera]
    for origins in ([""], [reference]):  # diffuse light, and light of another camera
        light = {c.beside_field for c in changes if c.kind == "light" and c.origin in origins}
        assert {(), ("kind clp",), ("kind moon",), ("kind standard",), ("hours",)} <= light
    assert any(change.kind == "afterglow" for change in changes)
    of_optics = {change.beside_field for field in fields for change in field.changes if not change.of_camera}
    assert {("kind moon",), ("kind standard",)} <= of_optics
    assert ("kind clp",) not in of_optics, "hardly anything but a steady change by another name"
    laws = {change.beside_field for change in changes if change.kind == "gain"}
    assert {(), ("kind clp",), ("kind moon",), ("kind standard",), ("hours",)} <= laws
    assert any(len(law) == 1 and law[0].startswith("hours 4.5 to ") for law in laws)
    # Where a pair has a flux of its own, or none is known, a steady gain of one camera is one of the other.
    steady = {field.name for field in fields if {c.text for c in field.changes} == {f"gain of {reference}"}}
    assert bool(steady) == (name != "WALOP-NORTH")
    assert not smooth_fields(instrument, exposures, 4)  # too few points for a pattern


class Points:
    """Field points of a design made of random numbers."""

    def __init__(self, x, y):
        self.x, self.y = x, y

    def __len__(self):
        return len(self.x)


def made_up(rng, length=1.0):
    """Smooth fields of three changes beside random columns, parameters and residuals; and the matrices behind them.

    The columns have entries of about `length`.
    """
    x, y = rng.uniform(-0.3, 0.3, (2, 5))
    point = np.repeat(np.arange(5), (4, 8, 4, 12, 4))
    rows, priors = len(point), 3
    columns = (length * rng.standard_normal((rows, 3))).astype(np.float32)
    basis = np.linalg.qr(rng.standard_normal((rows + priors, 6)))[0]
    residual = rng.standard_normal(rows + priors)
    design = object.__new__(Design)
    vars(design).update(
        measured=object.__new__(Measured),
        point=point,
        residual=residual,
        projector=SimpleNamespace(free=rows - 6),
        fit=SimpleNamespace(
            noise_scale=2.0,
            calset=SimpleNamespace(points=Points(x, y)),
            model=SimpleNamespace(template=SimpleNamespace(units=SimpleNamespace(field=0.3))),
        ),
    )
    made = vars(design.measured)["columns"] = object.__new__(Columns)
    vars(made)["rounded"] = lambda changes, exact: (None, columns)
    changes = [
        Change.parsed(text) for text in ("gain of O1 * hours", "turn of polariser", "axis of half1.plate")
    ]
    fields = [SmoothField((changes[0],), False), SmoothField(tuple(changes[1:]), False)]
    smooth = SmoothFields(design, fields, Context(), (basis[:, :4], 0.5 * basis[:, 4:]))
    value = [
        np.polynomial.legendre.Legendre.basis(i)(x / 0.3) * np.polynomial.legendre.Legendre.basis(j)(y / 0.3)
        for i, j in legendre.terms(OF_CAMERAS)
    ]
    sigma = [smooth_deviations()[i] * smooth_deviations()[j] for i, j in legendre.terms(OF_CAMERAS)]
    terms = (np.array(value).T * sigma)[point]
    counts = len(legendre.terms(OF_CAMERAS)), *[len(legendre.terms(OF_OPTICS))] * 2
    written = np.hstack(
        [columns[:, k, None].astype(float) / 2.0 * terms[:, :n] for k, n in enumerate(counts)]
    )
    written = np.vstack([written, np.zeros((priors, written.shape[1]))])
    both = np.hstack(smooth.bases)
    return smooth, written, written - both @ (both.T @ written)


def test_products_of_random_columns_are_those_of_columns_written_out():
    """Gram matrices, scores and products with other columns, term by term, by plain matrix algebra."""
    smooth, written, behind = made_up(np.random.default_rng(4))
    count = len(legendre.terms(OF_CAMERAS))
    for gram, at in zip(smooth.grams, (slice(count), slice(count, None)), strict=True):
        # A disturbance with a prior takes up a part: CᵀC − (CᵀB)(CᵀB)ᵀ.
        assert np.allclose(gram, written[:, at].T @ behind[:, at], atol=1e-5)
    assert np.allclose(smooth.scores, behind.T @ smooth.design.residual, atol=1e-5)
    assert np.allclose(smooth.products(behind[: len(smooth.design.point)]), written.T @ behind, atol=1e-5)
    assert np.allclose(
        smooth.columns(smooth.names[1]), written[: len(smooth.design.point), count:], atol=1e-5
    )
    assert np.allclose(smooth.behind(written[: len(smooth.design.point)]), behind[: len(smooth.design.point)])


def test_a_smooth_field_is_fitted_with_the_most_probable_scale_of_its_prior():
    """Scale and amplitudes against densities of the residuals, and ridge regression, on columns written out."""
    smooth, written, behind = made_up(np.random.default_rng(5), 2000.0)
    name, count, noise = smooth.names[0], len(legendre.terms(OF_CAMERAS)), 0.7
    item = smooth.ranked(name, noise)
    c, residual, widths = written[:, :count], smooth.design.residual, item.probe.widths
    information, pull = c.T @ behind[:, :count] / noise**2, behind[:, :count].T @ residual / noise**2

    def log_density(t):
        matrix = np.linalg.inv(information + np.diag((t * widths) ** -2.0))
        determinant = np.linalg.slogdet(np.eye(count) + np.outer(t * widths, t * widths) * information)[1]
        return 0.5 * pull @ matrix @ pull - 0.5 * determinant

    assert item.scale == max(SCALES, key=log_density) < 1.0
    expected = -np.linalg.solve(information + np.diag((item.scale * widths) ** -2.0), pull)
    assert np.allclose(item.score.amplitudes, expected, atol=1e-4 * np.abs(expected).max())


PLACES = (
    "retardance q behind collimator * smooth; retardance u behind collimator * smooth",
    "depolarisation of polariser * kelvin * smooth",
    "diattenuation v ahead of polariser * smooth * kind moon",
    "gain of O1 * counts * smooth",
    "gain of O1 * counts * kind moon * smooth",
    "retardance v behind half1.plate * smooth * kind standard",
    "gain of E1 * smooth",
    "light of E1 in O1 * smooth",
    "light of O2 in E1 * hours * smooth",
    "afterglow in O2 * smooth",
)


@pytest.mark.parametrize("name", PLACES)
def test_columns_are_derivatives_of_the_whole_light_path(examined, name):
    """Each term of the field in the light path, differentiated."""
    smooth, fit_ = examined.smooth, examined.result
    texts = [text for member in smooth.probe(name).group for text in member.sentences]
    chosen = [0, 1, 9, len(texts) - 1]
    effect = Described.saying([texts[k] for k in chosen], np.zeros(len(chosen)))
    theirs = own_columns(fit_.likelihood, fit_.values, [effect]) / fit_.noise_scale
    ours = smooth.columns(name)[:, chosen]
    assert np.all(np.linalg.norm(ours - theirs, axis=0) < 1e-6 * np.linalg.norm(theirs, axis=0))


@pytest.mark.parametrize("name", PLACES)
def test_products_are_those_of_columns_written_out(examined, name):
    smooth, design = examined.smooth, examined.design
    written = smooth.behind(design.stacked([smooth.candidate(name).columns]))
    number = smooth.names.index(name)
    at = slice(sum(smooth.sizes[:number]), sum(smooth.sizes[: number + 1]))
    scale = np.outer(*2 * [np.sqrt(np.diag(smooth.grams[number]))])
    assert np.abs(
        written.T @ design.stacked([smooth.candidate(name).columns]) - smooth.grams[number]
    ).max() < (1e-5 * scale.max())
    expected = written.T @ design.residual
    assert np.abs(smooth.scores[at] - expected).max() < 1e-4 * max(1.0, np.abs(expected).max())
    other = examined.space.names[0]
    across = examined.products_with(other)[len(examined.scores) :][at]
    column = design.stacked([examined.candidates[other].columns])
    expected = written.T @ column
    norm = np.outer(np.linalg.norm(written, axis=0), np.linalg.norm(column, axis=0))
    assert np.abs(across - expected).max() < 1e-5 * norm.max()


def test_a_set_in_which_no_single_exposure_can_be_disturbed_has_smooth_fields_all_the_same(examined):
    """Z has no columns then: the Gram matrices are those behind the free parameters alone."""
    free, _ = examined.smooth.bases
    smooth = dataclasses.replace(examined.smooth, bases=(free, np.zeros((len(free), 0))))
    assert smooth.products(smooth.bases[1]).shape == (sum(smooth.sizes), 0)
    name = PLACES[0]
    number = smooth.names.index(name)
    written = examined.design.projector(examined.design.stacked([smooth.candidate(name).columns]))
    gram = smooth.grams[number]
    assert np.abs(written.T @ written - gram).max() < 1e-5 * np.diag(gram).max()


def test_evidence_beside_a_smooth_field_is_a_ratio_of_densities(examined):
    """ln p(r | field and g) − ln p(r | field) of normal residuals, by the determinant lemma on columns written out."""
    candidates, smooth, design = JointScores(examined), examined.smooth, examined.design
    noise = examined.table.noise_scale
    name, other = PLACES[1], "gain of O1 * counts * smooth"
    member = (candidates.names.index(name), 0.3)

    def log_density(columns):
        """ln p(P r) but for constants: r ~ N(0, noise² + C Cᵀ), in the rows behind the free parameters."""
        projected = smooth.behind(columns)
        matrix = np.eye(columns.shape[1]) + columns.T @ projected / noise**2
        along = projected.T @ design.residual / noise**2
        return 0.5 * along @ np.linalg.solve(matrix, along) - 0.5 * np.linalg.slogdet(matrix)[1]

    def column(which, scale):
        number = smooth.names.index(which)
        at = slice(sum(smooth.sizes[:number]), sum(smooth.sizes[: number + 1]))
        return scale * design.stacked([smooth.candidate(which).columns]) * smooth.widths[at]

    given = column(name, 0.3)
    both = np.hstack([given, column(other, 1.0)])
    found = candidates.beside([member])[candidates.names.index(other), 0]
    assert found == pytest.approx(log_density(both) - log_density(given), abs=1e-3)


def _square():
    """Places of a square field of the scale of WALOP."""
    edges = np.linspace(-0.3, 0.3, 201)
    return np.stack(np.meshgrid(edges, edges)).reshape(2, -1)


PLAN = ObservingPlan(
    grid=7, standard_grid=2, polariser_angles=polariser_turn(10), moon_patches=4, standards=4
)


def test_a_field_of_plane_waves_is_told_with_its_place_and_law():
    """A sum of plane waves, which is no polynomial: its place and law are named, and the field is that."""
    calset, truth = simulate(PLAN, seed=5)
    e = calset.exposures  # a temperature that does not follow the time
    calset = dataclasses.replace(
        calset, exposures=dataclasses.replace(e, temp=10.0 + np.cos(2.0 * np.arange(len(e))))
    )
    waves = np.random.default_rng(6).normal(0.0, 5.0, (3, 2))
    block = calset.intensities.block(0, len(calset.points))
    field = np.cos(waves @ np.stack([calset.points.x, calset.points.y])).sum(axis=0)
    hours = 24.0 * (calset.exposures.mjd - calset.exposures.mjd.min())
    factor = 1.0 + 4e-3 * field[:, None] * hours
    counts = np.array(block.counts)
    counts[..., 1] *= factor
    changed = dataclasses.replace(block, counts=counts)
    calset = dataclasses.replace(calset, intensities=TableIntensities.dense(calset.points, changed))
    found = diagnose(calset)
    assert found.verdict == "effect_found"
    (step,) = found.steps
    camera = truth.cameras.names[1]
    assert {change.candidate for change, *_ in step.descriptions} == {f"gain of {camera} * hours * smooth"}
    assert found.after.explains_data
    # The field that is told is the one that was put in, to its own errors; nothing is left of 99 % of it.
    (entry,) = document(found)["steps"][0]["sentences"]
    assert "in a smooth field" in step.in_words
    ((name, shown),) = step.shown.items()
    assert name == entry["sentence"]
    expected = 4e-3 * np.sqrt(np.mean(np.cos(waves @ _square()).sum(axis=0) ** 2))
    assert abs(shown[0] - expected) < 5.0 * shown[1]
    names = list(entry["terms"])
    assert len(names) == len(legendre.terms(OF_CAMERAS))
    at = [found.after.model.index(f"described.{Change.parsed(text).label}") for text in names]
    degrees = [tuple(map(int, text.rpartition("field ")[2].split())) for text in names]
    sigma = smooth_deviations()
    basis = np.stack(
        [
            sigma[i] * sigma[j] * np.polynomial.legendre.Legendre.basis(i)(calset.points.x / 0.3)
            * np.polynomial.legendre.Legendre.basis(j)(calset.points.y / 0.3)
            for i, j in degrees
        ],
        axis=-1,
    )  # fmt: skip
    told = basis @ [entry["terms"][name]["value"] for name in names]
    error = np.sqrt(np.einsum("pi,ij,pj->p", basis, found.after.covariance[np.ix_(at, at)], basis))
    off = told - 4e-3 * field
    assert np.mean((off / error) ** 2) < 2.0
    assert np.mean(off**2) < 0.02 * np.mean((4e-3 * field) ** 2)


def test_a_field_of_one_kind_may_as_well_begin_when_others_do():
    """The polariser comes first: a gain in its exposures alone, and its opposite from then on, are one class."""
    calset, truth = simulate(PLAN, seed=8)
    e = calset.exposures
    calset = dataclasses.replace(
        calset, exposures=dataclasses.replace(e, temp=10.0 + np.cos(2.0 * np.arange(len(e))))
    )
    waves = np.random.default_rng(9).normal(0.0, 5.0, (3, 2))
    block = calset.intensities.block(0, len(calset.points))
    field = np.cos(waves @ np.stack([calset.points.x, calset.points.y])).sum(axis=0)
    counts = np.array(block.counts)
    counts[..., 1] *= 1.0 + 4e-3 * field[:, None] * (e.kind == "clp")
    changed = dataclasses.replace(block, counts=counts)
    found = diagnose(dataclasses.replace(calset, intensities=TableIntensities.dense(calset.points, changed)))
    (addition,) = found.members.additions
    names = {addition.about, *addition.names}
    camera = truth.cameras.names[1]
    assert f"gain of {camera} * kind clp * smooth" in names
    assert any(name.startswith(f"gain of {camera} * hours ") for name in names)
    # Stars are seen through the one or the other: the error between the two dominates.
    assert addition.spread > 3.0 * addition.stated
    assert not found.after.trusted
