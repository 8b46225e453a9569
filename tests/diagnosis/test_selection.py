"""The posterior over sets of things, against densities of normal distributions and truths that were drawn."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy import special, stats

from walop_jax.diagnosis.examination import Evidence
from walop_jax.diagnosis.hypotheses import Probe
from walop_jax.diagnosis.score import SCALES, Projector, ScoreSpace
from walop_jax.diagnosis.selection import JointScores, most_probable
from walop_jax.diagnosis.thresholds import CERTAIN
from walop_jax.model.effects import Context, Described, effect_by_name

ROWS = 60
SIZES = {"clp_zero": 1, "rotator_zero": 1, "turn of polariser": 2, "gain of O1": 1, "a pattern": 3}
WIDTHS = {name: np.full(size, 0.5 + 2.0 * k) for k, (name, size) in enumerate(SIZES.items())}
ONE_SIDED = "ghost"


def description(name, count):
    return Probe(name, Described, tuple(Described.saying([name], [0.0]) for _ in range(count)))


def scene(amplitudes, seed=3, columns=None, width=None):
    """Evidence of residuals that hide some amplitudes, by candidate; the columns and the residuals behind the base.

    The columns have unit length; `width` is that of all priors (default: `WIDTHS`).

    Noise has unit size: rows are many, so that the scatter behind all candidates is set to 1.
    """
    rng = np.random.default_rng(seed)
    base = rng.standard_normal((ROWS, 2))
    if columns is None:
        columns = {name: rng.standard_normal((ROWS, size)) for name, size in SIZES.items()}
        columns = {name: c / np.linalg.norm(c, axis=0) for name, c in columns.items()}
    residual = rng.standard_normal(ROWS) - sum(
        (columns[n] @ np.asarray(a, float) for n, a in amplitudes.items()), 0.0
    )
    projector = Projector(base)
    sizes = {name: c.shape[1] for name, c in columns.items()}
    names = list(sizes)
    widths = [WIDTHS[name] if width is None else np.full(size, width) for name, size in sizes.items()]
    space = ScoreSpace.projected(projector, names, widths, [columns[name] for name in names])
    projected = {name: projector(c) for name, c in columns.items()}
    residual = projector(residual)
    scores, square = np.concatenate([projected[n].T @ residual for n in names]), float(residual @ residual)
    table = dataclasses.replace(space.table(scores, square), noise_scale=1.0)
    kinds = [name for name in names if name in ("clp_zero", "rotator_zero", "lens_birefringence", ONE_SIDED)]
    found = Evidence(
        space=space,
        scores=scores,
        square=square,
        table=table,
        probes=[Probe(n, k, (k.neutral(Context()),)) for n in kinds for k in [effect_by_name(n)]],
        descriptions=[description(n, sizes[n]) for n in names if n not in kinds and n != "a pattern"],
        parts=(),
        patterns=[name for name in names if name == "a pattern"],
        chi2=square,
        dof=space.free,
    )
    return found, projected, residual


def log_density(residual, terms):
    """ln of the density of residuals for normal amplitudes: a column and its width for each, noise of unit size."""
    covariance = np.eye(len(residual)) + sum(
        (w**2 * np.outer(c, c) for c, w in terms), np.zeros((ROWS, ROWS))
    )
    return stats.multivariate_normal(np.zeros(len(residual)), covariance).logpdf(residual)


@pytest.mark.parametrize("members", [(), ("clp_zero",), ("turn of polariser", "gain of O1")])
def test_evidence_beside_members_is_a_ratio_of_densities_of_the_residuals(members):
    """ln p(r | M and g) − ln p(r | M), r ~ N(0, 1 + Σ t²w² c cᵀ), at every scale of the candidate."""
    found, columns, residual = scene({"clp_zero": [6.0], "turn of polariser": [4.0, -3.0]})
    candidates = JointScores(found)
    chosen = [(candidates.names.index(name), 0.3 if SIZES[name] > 1 else 1.0) for name in members]

    def terms(name, scale):
        return [(c, scale * w) for c, w in zip(columns[name].T, WIDTHS[name], strict=True)]

    given = list(itertools.chain(*(terms(candidates.names[k], scale) for k, scale in chosen)))
    evidence = candidates.beside(chosen)
    for number, name in enumerate(candidates.names):
        if name in members:
            continue
        for scale, value in zip(SCALES[: 1 if SIZES[name] == 1 else None], evidence[number], strict=False):
            expected = log_density(residual, [*given, *terms(name, scale)]) - log_density(residual, given)
            assert value == pytest.approx(expected, abs=1e-8)


def test_amplitudes_that_the_data_cannot_show_do_nothing():
    """The density without their columns, for candidates of one size of which different numbers are shown."""
    rng = np.random.default_rng(6)
    columns = {name: rng.standard_normal((ROWS, 3)) / np.sqrt(ROWS) for name in ("a pattern", "gain of O1")}
    columns["a pattern"][:, 0] = 0.0
    columns["gain of O1"][:, :2] *= 1e-6
    found, columns, residual = scene({}, columns=columns, width=3.0)
    evidence = JointScores(found).beside([])
    for number, (name, shown) in enumerate({"a pattern": (1, 2), "gain of O1": (2,)}.items()):
        for scale, value in zip(SCALES, evidence[number], strict=True):
            terms = [(columns[name][:, k], 3.0 * scale) for k in shown]
            assert value == pytest.approx(log_density(residual, terms) - log_density(residual, []), abs=1e-8)


def test_a_candidate_may_have_more_than_a_thousand_amplitudes():
    """As the disturbances of 334 exposures in three cameras have."""
    rng = np.random.default_rng(7)
    columns = {"a pattern": rng.standard_normal((ROWS, 1002)) / np.sqrt(ROWS)}
    found, columns, residual = scene({}, columns=columns, width=0.1)
    terms = [(column, 0.1 * SCALES[0]) for column in columns["a pattern"].T]
    expected = log_density(residual, terms) - log_density(residual, [])
    assert JointScores(found).beside([])[0, 0] == pytest.approx(expected, abs=1e-6)


def test_an_amplitude_that_physics_keeps_above_0_has_the_half_of_its_prior():
    """∫₀^∞ 2 N(a; 0, w²) p(r | a) da / p(r | 0), by numbers."""
    first, second = np.random.default_rng(4).standard_normal((2, ROWS, 1)) / np.sqrt(ROWS)
    for sign in (1.0, -1.0):
        columns = {ONE_SIDED: first, "clp_zero": second}
        found, columns, residual = scene({ONE_SIDED: [2.0 * sign]}, columns=columns, width=5.0)
        assert found.probes[0].one_sided.tolist() == [True]
        a, width = np.linspace(0.0, 60.0, 200_001), 5.0
        column = columns[ONE_SIDED][:, 0]
        # Columns are derivatives of the residuals data − model with the sign of an amplitude that is absent: r + a c.
        logs = -0.5 * (2.0 * a * (column @ residual) + a**2 * (column @ column))
        integral = np.trapezoid(2.0 * stats.norm(0.0, width).pdf(a) * np.exp(logs), a)
        assert JointScores(found).beside([])[0, 0] == pytest.approx(np.log(integral), abs=1e-6)


def test_nothing_is_certain_in_noise():
    """ν = ½, λ = 0.95: of 200 draws of noise in no more than one of 100 something is missing with P above 0.95."""
    totals = [JointScores(scene({}, seed=seed)[0])._best([])[2] for seed in range(200)]
    assert sum(special.expit(total) > CERTAIN for total in totals) <= 2


@pytest.mark.parametrize("seed", range(5))
def test_two_things_are_found_together_although_a_third_column_imitates_their_sum(seed):
    """A column that is like the sum of two things explains most by itself, and is exchanged once one of them is in."""
    rng = np.random.default_rng(seed)
    a, b, c, d, e, f = (v / np.linalg.norm(v) for v in rng.standard_normal((6, ROWS)))
    both = (a + b) / np.linalg.norm(a + b) + 0.7 * c
    columns = {
        "clp_zero": a[:, None],
        "rotator_zero": b[:, None],
        "turn of polariser": np.stack([d, e], axis=1),
        "gain of O1": (both / np.linalg.norm(both))[:, None],
        "a pattern": np.stack([d + f, e, f], axis=1),
    }
    found, *_ = scene({"clp_zero": [25.0], "rotator_zero": [25.0]}, 100 + seed, columns, 25.0)
    posterior = most_probable(found)
    assert sorted(thing.candidate.name for thing in posterior.things) == ["clp_zero", "rotator_zero"]
    assert posterior.nothing_more > 1.0 - CERTAIN


def test_a_pattern_without_a_name_competes_with_names():
    found, *_ = scene({"a pattern": [14.0, -12.0, 15.0]})
    posterior = most_probable(found)
    assert [thing.is_pattern for thing in posterior.things] == [True]


def both_in(wide, further, seed):
    """Evidence of two effects of opposite sign, whose columns are the first two of a candidate with `further` ones."""
    a, b, *others = (
        v / np.linalg.norm(v) for v in np.random.default_rng(seed).standard_normal((2 + further, ROWS))
    )
    columns = {
        "clp_zero": a[:, None],
        "rotator_zero": b[:, None],
        wide: np.stack([a, b, *others], axis=1),
    }
    found, *_ = scene({"clp_zero": [25.0], "rotator_zero": [-25.0]}, 200 + seed, columns, 25.0)
    return found


@pytest.mark.parametrize("seed", range(5))
def test_two_names_come_before_a_pattern_that_holds_both(seed):
    """The pattern explains most as one thing, and neither name is of use beside it; it has four numbers too many."""
    things = most_probable(both_in("a pattern", 4, seed)).things
    assert sorted(getattr(thing.candidate, "name", "") for thing in things) == ["clp_zero", "rotator_zero"]


@pytest.mark.parametrize("seed", range(5))
def test_two_effects_come_before_a_description_that_holds_both(seed):
    """No exchange leads from the description to both; two amplitudes are more probable than four that do the same."""
    found = both_in("turn of polariser", 2, seed)
    scores = JointScores(found)
    assert [scores.names[number] for number, _ in scores._grown([])] == ["turn of polariser"]
    assert sorted(t.candidate.name for t in most_probable(found).things) == ["clp_zero", "rotator_zero"]


@pytest.mark.parametrize("members", [(), ("gain of O1",), ("clp_zero", "turn of polariser")])
def test_effects_asked_alone_have_the_evidence_that_they_have_among_all(members):
    scores = JointScores(scene({"clp_zero": [9.0]})[0])
    of = [(scores.names.index(name), 1.0) for name in members]
    effects = scores._is_effect
    every, alone = scores.beside(of), scores.beside(of, effects)
    assert np.allclose(alone[effects], every[effects], rtol=1e-12, atol=1e-12)
    assert np.isneginf(alone[~effects]).all()


def test_the_set_of_a_thing_holds_names_that_are_the_same_to_the_data():
    """Two columns that are equal: half of the probability each where both are equally probable beforehand."""
    rng = np.random.default_rng(1)
    column = rng.standard_normal((ROWS, 1)) / np.sqrt(ROWS)
    other = rng.standard_normal((ROWS, 1)) / np.sqrt(ROWS)
    columns = {"clp_zero": column, "gain of O1": column, "turn of polariser": other}
    found, *_ = scene({"clp_zero": [20.0]}, columns=columns, width=20.0)
    (thing,) = most_probable(found).things
    assert thing.candidate.name == "clp_zero"
    assert set(thing.names) == {"clp_zero", "gain of O1"}
    assert [thing.equal[name] for name in thing.names] == pytest.approx([0.5, 0.5], abs=1e-6)
    # By prior: one name of a kind, one of two descriptions.
    assert [thing.probabilities[name] for name in thing.names] == pytest.approx([2 / 3, 1 / 3], abs=1e-6)


@pytest.mark.parametrize(("size", "least"), [(4.5, 0.9), (8.0, 0.9)])
def test_sets_hold_the_truth_as_often_as_they_say(size, least):
    """One thing of an amplitude drawn from its prior among four candidates that are alike; λ = 0.95 of the sets do."""
    rng, held, called = np.random.default_rng(8), 0, 0
    names = "clp_zero", "rotator_zero", "gain of O1", "turn of polariser"
    for _ in range(300):
        common = rng.standard_normal(ROWS)
        columns = {name: (common + 0.8 * rng.standard_normal(ROWS))[:, None] for name in names}
        columns = {name: c / np.linalg.norm(c) for name, c in columns.items()}
        truth = str(rng.choice(names))
        hidden, draw = {truth: [size * rng.standard_normal()]}, int(rng.integers(1_000_000))
        things = most_probable(scene(hidden, draw, columns, size)[0]).things
        if len(things) == 1:
            called += 1
            held += truth in things[0].names
    assert called > 50
    assert least <= held / called
