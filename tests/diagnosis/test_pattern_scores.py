"""Scores of patterns from rows are those of their columns written out, intensity by intensity."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from small_run import small_fit_with_plate

from walop_jax.diagnosis.design import Design, _from_columns, _from_rows, strata
from walop_jax.likelihood.flux import FluxGroups


def arms_apart(design: Design) -> Design:
    """As if each arm had a flux of its own: another projection of the same columns."""
    measured = design.measured
    measured.shared = FluxGroups(np.kron(np.eye(2), np.ones((2, 2))))
    measured.flux = np.abs(measured.flux)
    return design


@pytest.mark.parametrize("scale", [1.0, 3.0])
@pytest.mark.parametrize("apart", [False, True])
def test_rows_are_columns(scale, apart):
    fit = small_fit_with_plate()
    expansion = dataclasses.replace(fit.expansion, noise_scale=scale)
    design = Design.of(dataclasses.replace(fit, expansion=expansion))
    design = arms_apart(design) if apart else design
    found = list(strata(design.measured))
    one = np.eye(design.measured.cameras)
    for stratum in found:  # with the flux eliminated as in a fit
        columns = design.measured.candidate(stratum).columns
        for a, (k, pattern) in enumerate(zip(stratum.camera, stratum.patterns, strict=True)):
            exact = design.measured.column(pattern[..., None] * one[k], stratum.sort)
            np.testing.assert_allclose(columns[:, a], exact, rtol=0, atol=1e-12 * np.abs(exact).max())
    one, scores, square = _from_rows(design, found)
    other, expected, total = _from_columns(design, found)
    assert (one.names, one.sizes, one.free) == (other.names, other.sizes, other.free)
    assert square == pytest.approx(total, rel=1e-12)
    np.testing.assert_allclose(one.before, other.before, rtol=1e-9)
    size = np.sqrt(other.before)
    np.testing.assert_allclose(one.gram / np.outer(size, size), other.gram / np.outer(size, size), atol=1e-12)
    np.testing.assert_allclose(scores / size, expected / size, rtol=0, atol=1e-10 * np.sqrt(total))
    np.testing.assert_array_equal(one.alive, other.alive)
