"""Products in pieces are those of numpy in one, whatever the order in memory and the number of threads."""

import numpy as np
import pytest

from walop_jax.diagnosis import score
from walop_jax.likelihood import limits


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("count", [1, 7, 8, 30])
def test_pieces_make_the_whole(order, count, monkeypatch):
    monkeypatch.setattr(limits, "COLUMNS_TOGETHER", 7)
    columns = np.asarray(np.random.default_rng(count).standard_normal((50, count)), order=order)
    found = score.gram(columns)
    np.testing.assert_allclose(found, columns.T @ columns, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found, found.T)
    monkeypatch.setattr(score, "cores", lambda: 1)
    np.testing.assert_array_equal(score.gram(columns), found)


@pytest.mark.parametrize("priors", [0, 6])
def test_a_space_is_that_of_projected_columns(priors, monkeypatch):
    """Rows of priors, in which no candidate has a part, are behind the projection like all others."""
    monkeypatch.setattr(limits, "PRODUCT_ROWS", 7)
    rng = np.random.default_rng(priors)
    jacobian, data = rng.standard_normal((50, 4)), 50 - priors
    columns = [rng.standard_normal((data, count)) for count in (3, 1, 5)]
    widths = [np.ones(own.shape[1]) for own in columns]
    space = score.ScoreSpace.projected(score.Projector(jacobian), "abc", widths, columns, scale=2.0)
    whole = np.pad(np.hstack(columns), ((0, priors), (0, 0))) / 2.0
    left = whole - jacobian @ np.linalg.lstsq(jacobian, whole)[0]
    np.testing.assert_allclose(space.gram, left.T @ left, rtol=0, atol=1e-12)
    np.testing.assert_allclose(space.before, np.sum(whole**2, axis=0), rtol=1e-12)


def test_a_space_behind_another_projection_is_that_of_columns_projected_anew():
    """A base that has another parameter, and one whose columns have moved, for some of the candidates."""
    rng = np.random.default_rng(8)
    first = rng.standard_normal((60, 4))
    second = np.hstack([first + 0.1 * rng.standard_normal(first.shape), rng.standard_normal((60, 1))])
    base = rng.standard_normal((55, 6)).astype(np.float32)
    columns = [base[:, :2], base[:, 2:3], base[:, [1]] * np.float32(3.0), base[:, 3:]]
    widths = [np.ones(own.shape[1]) for own in columns]
    space = score.ScoreSpace.projected(score.Projector(first), "abcd", widths, columns, exact=0)
    kept = [columns[number] for number in (0, 2, 3)]
    projector = score.Projector(second)
    for jacobian in (first, second):  # one after the other: the second time from what the first time gave
        projector = score.Projector(jacobian)
        along = projector.basis[:55].T @ np.hstack(kept)
        space = space.subset("acd").behind(projector, along)
        whole = np.pad(np.hstack(kept).astype(float), ((0, 5), (0, 0)))
        left = whole - jacobian @ np.linalg.lstsq(jacobian, whole)[0]
        # Columns in single precision: a multiple is one to 10⁻⁷ of its length.
        np.testing.assert_allclose(np.asarray(space.gram), left.T @ left, rtol=0, atol=1e-5)
        np.testing.assert_allclose(space.gram.diagonal(), np.sum(left**2, axis=0), rtol=1e-12)
        for at in space.places().values():
            np.testing.assert_allclose(space.gram[at, at], left[:, at].T @ left[:, at], rtol=0, atol=1e-12)
        assert space.free == 60 - jacobian.shape[1]


def test_multiples_of_a_column_are_multiplied_once(monkeypatch):
    """A space of columns with copies, multiples and zeros is that of all columns; the root spans the same."""
    monkeypatch.setattr(limits, "COLUMNS_TOGETHER", 7)
    rng = np.random.default_rng(3)
    jacobian, base = rng.standard_normal((60, 4)), rng.standard_normal((60, 9)).astype(np.float32)
    again = (base[:, [2, 5, 7, 7]] * np.array([1.0, -2.0, 0.1, 30.0])).astype(np.float32)
    columns = [
        base[:, :3],
        base[:, 3:4],
        base[:, 4:],
        again[:, :3],
        np.zeros((60, 1), np.float32),
        again[:, 3:],
    ]
    names, widths = "abcdef", [np.ones(own.shape[1]) for own in columns]
    space = score.ScoreSpace.projected(score.Projector(jacobian), names, widths, columns, exact=3)
    assert len(space.gram.distinct) == 9 + 1  # column 2 is exact: its copy is one of its own
    whole = np.hstack(columns).astype(float)
    left = whole - jacobian @ np.linalg.lstsq(jacobian, whole)[0]
    length = np.linalg.norm(left, axis=0)
    scale = np.outer(length, length) + (length[:, None] * length == 0)
    np.testing.assert_array_less(np.abs(np.asarray(space.gram) - left.T @ left) / scale, 1e-6)
    for at in space.places().values():
        np.testing.assert_allclose(space.gram[at, at], left[:, at].T @ left[:, at], rtol=1e-9, atol=1e-15)
    residual = left @ rng.standard_normal(left.shape[1])
    assert space._root.rank == 9
    assert space._root.explained(left.T @ residual) == pytest.approx(residual @ residual, rel=1e-4)
    np.testing.assert_allclose(
        space._root.whole @ space._root.whole.T / scale, left.T @ left / scale, atol=1e-5
    )
