"""Cells of frames joined to fewer field points: values, errors, gaps, round fields, points of tables beside them."""

from __future__ import annotations

import numpy as np
import pytest
from changed_sets import block_of

import walop_jax as walop
from walop_jax.data.joined_cells import joined_cells
from walop_jax.data.records import FineStructure

SIDE, MOST = 40, 410
ANGLES = np.linspace(0.0, 162.0, 10).tolist()
FINE = FineStructure(*[np.zeros(0)] * 2, *[np.zeros((0, 4))] * 2)
X, Y = (0.3 * side.ravel() for side in np.meshgrid(*[np.linspace(-1.0, 1.0, SIDE)] * 2))


def shares(x, y, degree=4):
    """Shares of the light (point, exposure, camera), polynomials over the field, and their sum is 1."""
    angle, slope = (
        np.radians(2.0 * np.array(ANGLES)),
        1.0 + 0.3 * (3.0 * x) ** degree - 0.5 * (3.0 * y) ** degree,
    )
    first = 0.25 * (1.0 + 0.5 * np.cos(angle) * slope[:, None])
    second = 0.25 * (1.0 + 0.5 * np.sin(angle) * (1.0 + x - y)[:, None])
    return np.stack([first, 0.5 - first, second, 0.5 - second], axis=-1)


def light():
    """As rough as it likes, from cell to cell."""
    return 1e8 * np.random.default_rng(1).uniform(0.5, 1.5, (X.size, len(ANGLES), 1))


def cells(counts, errors=None, x=X, y=Y, **others):
    """Cells of frames, with errors of which those of the shares are alike."""
    errors = np.full(counts.shape, 1e4) if errors is None else errors
    return walop.from_arrays(counts, errors, x, y, ANGLES, fine=FINE, **others)


def assert_shares(block, degree=4, rtol=1e-9):
    total = block.counts.sum(axis=-1, keepdims=True)
    expected = np.where(block.used[..., None], total * shares(block.x, block.y, degree), 0.0)
    np.testing.assert_allclose(block.counts, expected, rtol=rtol)


def test_points_are_the_polynomials_of_the_cells_however_rough_the_light():
    joined = joined_cells(cells(light() * shares(X, Y)), MOST)
    assert len(joined.points) == 400
    assert block_of(joined).used.all()
    assert_shares(block_of(joined))


def test_errors_hold_the_information_of_all_cells():
    """Each cell has 10⁸ electrons ± 10⁴ and noise of that size: Σ 1/σ² stays, and errors are those of noise."""
    rng, expected = np.random.default_rng(2), np.full((X.size, len(ANGLES), 4), 1e8)
    joined = block_of(joined_cells(cells(expected + 1e4 * rng.standard_normal(expected.shape)), MOST))
    np.testing.assert_allclose((1.0 / joined.sigma**2).sum(axis=0), X.size / 1e8, rtol=1e-3)
    deviates = (joined.counts - 1e8) / joined.sigma
    assert deviates.std() == pytest.approx(1.0, abs=6 / np.sqrt(2 * deviates.size / 4))
    neighbours = np.corrcoef(deviates[:-1, :, 0].ravel(), deviates[1:, :, 0].ravel())[0, 1]
    assert abs(neighbours) < 6 / np.sqrt(deviates[:, :, 0].size)


def test_gaps_of_an_exposure_leave_the_others_as_they_are():
    counts = light() * shares(X, Y)
    clean = block_of(joined_cells(cells(counts), MOST))
    counts[100:104, 3] = np.nan  # four cells, in a row
    gaps = block_of(joined_cells(cells(counts), MOST))
    assert_shares(gaps)
    worse = gaps.sigma[:, 3] / clean.sigma[:, 3]
    assert worse.max() > 1.05
    others = np.arange(len(ANGLES)) != 3
    np.testing.assert_allclose(gaps.sigma[:, others], clean.sigma[:, others], rtol=1e-2)


def test_an_exposure_with_half_of_a_rectangle_leaves_its_cells_single():
    counts = light() * shares(X, Y)
    counts.reshape(SIDE, SIDE, len(ANGLES), 4)[:5, :10, 3] = np.nan
    block = block_of(joined_cells(cells(counts), MOST))
    assert_shares(block)
    assert len(block.x) == 375 + 100
    assert block.used[:, 3].sum() == 375 + 50


def test_an_exposure_of_a_part_of_the_field_is_joined_there():
    counts = light() * shares(X, Y)
    counts[:800, 3:] = np.nan
    block = block_of(joined_cells(cells(counts), MOST))
    assert_shares(block)
    assert len(block.x) < 500
    assert block.used[block.y > 0.0].all()
    assert not block.used[block.y < 0.0, 3:].any()


def test_a_round_field_is_joined_where_cells_are_a_raster():
    inside = np.hypot(X, Y) < 0.3
    x, y = X[inside], Y[inside]
    joined = block_of(joined_cells(cells(light()[inside] * shares(x, y), x=x, y=y), MOST))
    assert_shares(joined)
    assert len(joined.x) < 0.75 * len(x)
    assert np.hypot(joined.x, joined.y).max() == pytest.approx(np.hypot(x, y).max())


def test_points_of_tables_stay_as_they_are():
    """Three field points of a standard, seen in other exposures than the frames."""
    x, y = np.append(X, [0.01, 0.02, 0.03]), np.append(Y, [0.0, 0.1, 0.2])
    counts = np.concatenate([light(), np.full((3, len(ANGLES), 1), 1e6)]) * shares(x, y)
    counts[:-3, 8:], counts[-3:, :8] = np.nan, np.nan
    source = np.where((np.arange(len(x)) >= len(X))[:, None] & (np.arange(10) >= 8), 1, -1)
    stars = {"SOURCE": [1], "NAME": ["star"], "Q": [0.01], "U": [0.0], "Q_ERR": [1e-4], "U_ERR": [1e-4]}
    kinds = ["clp"] * 8 + ["standard"] * 2
    angles = [*ANGLES[:8], np.nan, np.nan]
    calset = walop.from_arrays(
        counts, np.full(counts.shape, 1e4), x, y, angles, kinds, source=source, sources=stars, fine=FINE,
        mjd=60000.0, ha=0.0, ra=10.0, dec=-20.0, rotator=0.0,
    )  # fmt: skip
    block, whole = block_of(joined_cells(calset, MOST)), block_of(calset)
    assert len(block.x) == 403
    for name in ("x", "y", "counts", "sigma", "used", "source"):
        np.testing.assert_array_equal(getattr(block, name)[-3:], getattr(whole, name)[-3:])


def test_a_set_that_is_small_enough_stays_as_it_is():
    calset = cells(light() * shares(X, Y))
    assert joined_cells(calset, X.size) is calset
