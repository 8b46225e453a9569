"""The first warning of a fit that does not explain its data is the remedy that repairs most, of remedies fitted."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from changed_sets import block_of, with_block
from small_run import SEED, SMALL, small_fit

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis.trust import examined
from walop_jax.fit.refit import FitResult, fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.simulate import effect_from_text, simulate


def with_verdict(calset: CalibrationSet) -> FitResult:
    return examined(fit(Likelihood.of(calset, small_fit().model)))


def scattered(calset: CalibrationSet, extra: np.ndarray) -> CalibrationSet:
    """More noise than the errors say, of this standard deviation."""
    block = block_of(calset)
    noise = np.random.default_rng(3).standard_normal(block.counts.shape) * extra
    return with_block(calset, counts=block.counts + noise)


def test_scintillation_is_an_error_of_the_errors():
    """0.4 % of every intensity beyond the noise of its photons: bright cameras scatter more, and nothing is missing."""
    calset = small_fit().calset
    first = with_verdict(scattered(calset, 0.004 * block_of(calset).counts)).warnings[0]
    share = re.search(r"N_ERR lacks ([\d.]+) ± ([\d.]+) % of N", first)
    assert share is not None
    assert float(share[1]) == pytest.approx(0.4, abs=4 * float(share[2]))
    assert 0.002 < float(share[2]) < 0.02
    assert "times too small" not in first
    assert "diagnose" not in first


def test_errors_that_are_too_small_by_a_factor_are_told_as_such():
    calset = small_fit().calset
    first = with_verdict(scattered(calset, np.sqrt(3.0) * block_of(calset).sigma)).warnings[0]
    told = re.search(r"N_ERR is ([\d.]+) ± ([\d.]+) times too small", first)
    assert told is not None
    assert float(told[1]) == pytest.approx(2.0, abs=4 * float(told[2]))
    assert float(told[2]) == pytest.approx(2.0 / np.sqrt(2.0 * small_fit().dof), rel=0.1)
    assert "diagnose" not in first


def test_cosmic_rays_are_left_out():
    calset = small_fit().calset
    block, rng = block_of(calset), np.random.default_rng(5)
    hit = rng.random(block.counts.shape[:2]) < 0.02
    counts = block.counts.copy()
    counts[..., 1] += 40.0 * hit * block.sigma[..., 1]
    result = with_verdict(with_block(calset, counts=counts))
    assert not result.trusted
    assert "walop-jax refit --clip 5 leaves them out" in result.warnings[0]
    assert "diagnose" not in result.warnings[0]


@pytest.mark.parametrize("text", ["nonlinearity=coefficient:0.03", "clp_wobble=amplitude:0.6"])
def test_a_missing_effect_is_a_matter_of_a_diagnosis(text):
    """Its residuals have tails as well: some per cent of the rows lie far off, and leaving them out repairs nothing."""
    calset = simulate(SMALL, seed=SEED, effects=[effect_from_text(text, SMALL.context())]).calset
    result = with_verdict(calset)
    assert result.chi2 > 1.5 * result.dof
    assert "walop-jax diagnose looks for missing effects" in result.warnings[0]
    assert not any("clip" in warning for warning in result.warnings)


def test_a_number_that_the_set_states_comes_before_a_diagnosis():
    """All field points displaced by 0.03°, as by a frame that was cut in another place."""
    calset = small_fit().calset
    x = calset.points.x + 0.03
    points = dataclasses.replace(calset.points, x=x)
    displaced = with_block(dataclasses.replace(calset, points=points), x=x)
    result = with_verdict(displaced)
    assert not result.explains_data
    assert "X of all field points changed by −0.0" in result.warnings[0]
    assert "diagnose" not in result.warnings[0]
