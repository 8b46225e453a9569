"""The score test against closed forms, against a full refit, and against its own stated error rates."""

import numpy as np
import pytest
from scipy import stats

from walop_jax.diagnosis.score import Candidate, Projector, ScoreSpace, corrected_p, separations

ROWS, FREE = 400, 6


class Scoring:
    """Residuals in, table out."""

    def __init__(self, projector, candidates, rng):
        self.projector = projector
        each = [c.columns for c in candidates]
        self.columns = projector(np.column_stack(each))
        names, widths = [c.name for c in candidates], [c.widths for c in candidates]
        self.space = ScoreSpace.projected(projector, names, widths, each)
        self.smallest = self.space.smallest_p(rng)

    def __call__(self, residual):
        r = self.projector(residual)
        return self.space.table(self.columns.T @ r, r @ r, self.smallest)


@pytest.fixture(scope="module")
def design():
    rng = np.random.default_rng(11)
    base = rng.standard_normal((ROWS, FREE)) * np.logspace(-3, 3, FREE)
    columns = {name: rng.standard_normal((ROWS, k)) for name, k in (("one", 1), ("two", 2), ("three", 3))}
    candidates = [Candidate(name, c, np.ones(c.shape[1])) for name, c in columns.items()]
    return base, columns, Scoring(Projector(base), candidates, rng)


def refitted(residual, base):
    """χ² after a linear fit, by numpy."""
    x, *_ = np.linalg.lstsq(base, residual, rcond=None)
    return np.sum((residual - base @ x) ** 2)


def test_statistic_is_the_drop_of_chi2_in_a_joint_refit(design):
    base, columns, scorer = design
    r = np.random.default_rng(1).standard_normal(ROWS)
    table = scorer(r)
    for name, c in columns.items():
        drop = refitted(r, base) - refitted(r, np.column_stack([base, c]))
        assert table[name].statistic * table.noise_scale**2 == pytest.approx(drop, rel=1e-9)


def test_amplitudes_are_those_of_the_joint_refit(design):
    base, columns, scorer = design
    r = np.random.default_rng(2).standard_normal(ROWS)
    table = scorer(r)
    for name, c in columns.items():
        # r(ε) = r + C ε, so the refit's coefficients carry the opposite sign.
        joint, *_ = np.linalg.lstsq(np.column_stack([base, c]), r, rcond=None)
        np.testing.assert_allclose(table[name].amplitudes, -joint[FREE:], rtol=1e-8)
        everything = np.column_stack([base, c])
        covariance = np.linalg.inv(everything.T @ everything)[FREE:, FREE:] * table.noise_scale**2
        np.testing.assert_allclose(table[name].covariance, covariance, rtol=1e-6)


def test_evidence_is_the_ratio_of_gaussian_integrals(design):
    base, columns, scorer = design
    r = np.random.default_rng(3).standard_normal(ROWS)
    table = scorer(r)
    # Marginal likelihood with amplitudes N(0, t²), t one of four where there are several, and flat base: compare
    # densities of the projected data.
    q = np.linalg.svd(base, full_matrices=True)[0][:, FREE:]
    y = q.T @ r / table.noise_scale
    for name, c in columns.items():
        slope = q.T @ c / table.noise_scale
        with_scale = [
            stats.multivariate_normal(np.zeros(len(y)), np.eye(len(y)) + t**2 * slope @ slope.T).logpdf(y)
            for t in ((1.0, 0.3, 0.1, 0.03) if c.shape[1] > 1 else (1.0,))
        ]
        with_effect = np.logaddexp.reduce(with_scale) - np.log(len(with_scale))
        without = stats.norm.logpdf(y).sum()
        assert table[name].log_bayes == pytest.approx(with_effect - without, abs=1e-6)


def test_what_the_base_absorbs_is_untestable(design):
    base, _, _ = design
    mixture = base @ np.arange(1.0, FREE + 1.0)[:, None]
    scorer = Scoring(Projector(base), [Candidate("mimic", mixture, np.ones(1))], np.random.default_rng(0))
    table = scorer(np.random.default_rng(4).standard_normal(ROWS))
    assert not table["mimic"].testable
    assert table.p_global == 1.0


def test_false_alarms_come_at_the_stated_rate(design):
    _, _, scorer = design
    rng = np.random.default_rng(5)
    p = np.array([scorer(rng.standard_normal(ROWS)).p_global for _ in range(2000)])
    assert stats.kstest(p[p < 0.5], stats.uniform(0, 0.5).cdf).pvalue > 1e-3
    assert stats.binomtest(int(np.sum(p < 0.05)), len(p), 0.05).pvalue > 1e-3


@pytest.mark.parametrize("scale", [0.9, 1.0, 1.1])
def test_a_wrong_noise_scale_raises_no_alarms(design, scale):
    _, _, scorer = design
    rng = np.random.default_rng(6)
    p = np.array([scorer(scale * rng.standard_normal(ROWS)).p_global for _ in range(500)])
    assert stats.binomtest(int(np.sum(p < 0.05)), len(p), 0.05).pvalue > 1e-3


def test_an_injected_effect_is_found_with_its_amplitude(design):
    _, columns, scorer = design
    truth = np.array([0.9, -0.7])
    r = np.random.default_rng(7).standard_normal(ROWS) - columns["two"] @ truth
    table = scorer(r)
    assert min(table.scores, key=lambda score: score.log_p).name == "two"
    assert table.p_global < 1e-6
    score = table["two"]
    pull = np.linalg.solve(np.linalg.cholesky(score.covariance), score.amplitudes - truth)
    assert np.all(np.abs(pull) < 4)


def test_correction_for_trials():
    assert corrected_p(np.log(0.01), 1.0) == pytest.approx(0.01)
    assert corrected_p(np.log(1e-10), 50.0) == pytest.approx(5e-9, rel=1e-6)


def test_a_candidate_that_joins_the_base_is_as_if_it_had_always_been_there(design):
    base, columns, scoring = design
    r = np.random.default_rng(8).standard_normal(ROWS)
    joined = Projector(np.column_stack([base, columns["two"]]))
    left = [Candidate(name, columns[name], np.ones(columns[name].shape[1])) for name in ("one", "three")]
    direct = Scoring(joined, left, np.random.default_rng(0))(r)
    space, reduce = scoring.space.with_base(["two"])
    projected = scoring.projector(r)
    s, square = reduce(scoring.columns.T @ projected, projected @ projected)
    keep = space.chosen(["one", "three"])
    table = space.subset(["one", "three"]).table(s[keep], square)
    assert space.free == joined.free
    for name in ("one", "three"):
        assert table[name].statistic == pytest.approx(direct[name].statistic, rel=1e-8)
        assert table[name].log_bayes == pytest.approx(direct[name].log_bayes, rel=1e-8, abs=1e-10)
        np.testing.assert_allclose(table[name].amplitudes, direct[name].amplitudes, rtol=1e-7)


def test_candidates_that_join_one_after_the_other_join_together(design):
    """Of what leaves the Gram matrix only factors are kept: entries asked for are those of the whole matrix."""
    *_, scoring = design
    one_by_one = scoring.space.with_base(["two"])[0].with_base(["three"])[0]
    together = scoring.space.with_base(["two", "three"])[0]
    whole, at, place = (
        np.asarray(one_by_one.gram),
        one_by_one.places()["one"],
        one_by_one.places()["one"].start,
    )
    scale = np.diag(np.asarray(scoring.space.gram)).max()
    np.testing.assert_allclose(whole, together.gram, rtol=0, atol=1e-10 * scale)
    np.testing.assert_allclose(one_by_one.gram[at, at], whole[at, at], rtol=0, atol=1e-14 * scale)
    np.testing.assert_allclose(one_by_one.gram[:, place], whole[:, place], rtol=0, atol=1e-14 * scale)
    chosen = np.ix_(one_by_one.chosen(["one"]), one_by_one.chosen(["three", "one"]))
    np.testing.assert_allclose(one_by_one.gram[chosen], whole[chosen], rtol=0, atol=1e-14 * scale)
    np.testing.assert_allclose(one_by_one.gram.diagonal(), np.diag(whole), rtol=0, atol=1e-14 * scale)


def test_what_was_taken_out_of_the_columns_comes_back(design):
    """A basis of parameters that candidates were projected off, and are no longer: G + A Aᵀ."""
    base, columns, scoring = design
    every = [columns[name] for name in scoring.space.names]
    widths = [np.ones(own.shape[1]) for own in every]
    fewer = Projector(base[:, 1:])
    lost = fewer(base[:, :1])
    along = np.hstack(every).T @ (lost / np.linalg.norm(lost))
    back = scoring.space.with_known(along)
    free = ScoreSpace.projected(fewer, scoring.space.names, widths, every)
    np.testing.assert_allclose(np.asarray(back.gram), free.gram, rtol=0, atol=1e-10 * np.abs(free.gram).max())


def test_a_nuisance_of_known_width_is_the_covariance_it_adds(design):
    """Columns K with N(0, w²) amplitudes are the same as noise of covariance 1 + w² K Kᵀ."""
    base, columns, scoring = design
    r = np.random.default_rng(9).standard_normal(ROWS)
    width = 0.03
    space, reduce = scoring.space.with_base(["three"], np.full(3, width))
    projected = scoring.projector(r)
    s, square = reduce(scoring.columns.T @ projected, projected @ projected)
    q = np.linalg.svd(base, full_matrices=True)[0][:, FREE:]
    y, nuisance = q.T @ r, q.T @ columns["three"] * width
    inverse = np.linalg.inv(np.eye(len(y)) + nuisance @ nuisance.T)
    assert square == pytest.approx(y @ inverse @ y, rel=1e-9)
    at = space.places()["two"]
    c = q.T @ columns["two"]
    np.testing.assert_allclose(s[at], c.T @ inverse @ y, rtol=1e-8)
    np.testing.assert_allclose(space.gram[at, at], c.T @ inverse @ c, rtol=1e-8)


def test_separation_is_the_distance_to_the_closest_change_a_rival_can_make(design):
    base, columns, scoring = design
    change = scoring.projector(columns["two"] @ np.array([2.0, 1.0]))
    found = separations(scoring.space, scoring.columns.T @ change, change @ change)
    for name, c in columns.items():
        rest = refitted(columns["two"] @ np.array([2.0, 1.0]), np.column_stack([base, c]))
        assert found[name] == pytest.approx(np.sqrt(rest), abs=1e-5)


def test_fluxes_that_were_solved_for_leave_less_room_for_noise():
    """Four numbers of which one is fitted row by row: the noise scale must come out 1, not √(3/4)."""
    rng = np.random.default_rng(10)
    rows = 500
    direction = rng.standard_normal((rows, 4))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)

    def projected(v):
        v = v.reshape(rows, 4)
        return (v - np.sum(v * direction, axis=1, keepdims=True) * direction).reshape(-1)

    candidate = Candidate("one", projected(rng.standard_normal(4 * rows))[:, None], np.ones(1))
    scoring = Scoring(Projector(np.zeros((4 * rows, 0)), eliminated=rows), [candidate], rng)
    scales = [scoring(projected(rng.standard_normal(4 * rows))).noise_scale for _ in range(50)]
    assert np.mean(scales) == pytest.approx(1.0, abs=4 / np.sqrt(2 * 3 * rows * 50))


def test_noise_is_measured_behind_all_candidates_however_alike_they_are():
    """Columns that repeat and add up to others count once: their span is that of a QR decomposition with pivots."""
    rng = np.random.default_rng(3)
    columns = rng.standard_normal((ROWS, 12)) * np.logspace(-2, 3, 12)
    columns = np.hstack([columns, columns[:, :4], columns[:, 2:6] @ rng.standard_normal((4, 3))])
    base = rng.standard_normal((ROWS, FREE))
    names = [f"c{i}" for i in range(columns.shape[1])]
    residual = 1.3 * rng.standard_normal(ROWS)
    whole = np.hstack([base, columns[:, :12] / np.linalg.norm(columns[:, :12], axis=0)])
    left = residual - whole @ np.linalg.lstsq(whole, residual, rcond=None)[0]
    candidates = [Candidate(n, c[:, None], 1e3 * np.ones(1)) for n, c in zip(names, columns.T, strict=True)]
    table = Scoring(Projector(base), candidates, rng)(residual)
    assert table.noise_scale == pytest.approx(np.sqrt(left @ left / (ROWS - FREE - 12)), rel=1e-9)
