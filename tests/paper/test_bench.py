"""The laboratory table: cross-talk of the paper at its tilts, and errors that photon noise alone leaves."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "notebooks"))
from bench import PAPER_CROSS_TALK, PAPER_ERRORS, TILTS, bench_table


@pytest.mark.long
def test_bench_table():
    rows = bench_table(seed=1)
    assert [row.tilt for row in rows] == list(TILTS)
    np.testing.assert_allclose([row.cross_talk for row in rows], PAPER_CROSS_TALK, atol=0.04)
    paper, joint = (np.array([getattr(row, name) for row in rows]) for name in ("paper_here", "joint"))
    # No worse than on the real bench, in p at every tilt; the joint fit of all tilts better than polynomials.
    assert np.all(joint[:, 2] < np.array(PAPER_ERRORS)[:, 2])
    assert np.all(paper[:, 2] < 1.5 * np.array(PAPER_ERRORS)[:, 2])
    assert np.sqrt(np.mean(joint**2)) < 0.7 * np.sqrt(np.mean(paper**2))


@pytest.mark.long
def test_errors_fall_with_the_light():
    """Four times the electrons, half the error of the joint fit, up to the luck of one draw."""
    faint, bright = (np.array([row.joint for row in bench_table(seed=2, electrons=n)]) for n in (1e5, 1.6e6))
    assert 2 < np.sqrt(np.mean(faint**2) / np.mean(bright**2)) < 8
