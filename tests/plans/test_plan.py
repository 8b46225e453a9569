"""Plans of exposures: their information is that of the likelihood, their promise that of a fit to such data."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from walop_jax.calibration.calibration import Calibration
from walop_jax.diagnosis.trust import examined
from walop_jax.fit.model_file import base_model
from walop_jax.fit.refit import refit
from walop_jax.plans.exposures import candidates
from walop_jax.plans.plan import plan_from
from walop_jax.science.field_accuracy import p_errors
from walop_jax.science.star_errors import sample_stars
from walop_jax.simulation.observing_plan import ObservingPlan, Stop
from walop_jax.simulation.plan_file import plan_text, read_plan
from walop_jax.simulation.simulate import simulate

ANGLES = 181
SMALL = ObservingPlan(
    grid=4, standard_grid=2, moon_patches=3, standards=2, unpolarised=1, throughput_degree=2
)


@pytest.fixture(scope="module")
def small():
    return candidates(SMALL, draws=1, angles=ANGLES, colours=(float("nan"),))


@pytest.fixture(scope="module")
def planned(small):
    return plan_from(small, SMALL, 15.0)


def test_the_promise_is_the_error_of_a_fit(small):
    """A fit to noiseless data of some exposures has the errors of p that their information promises."""
    angles = (0.0, 20.0, 41.0, 77.0, 100.0, 120.0, 147.0, 170.0)
    plan = dataclasses.replace(SMALL, stops=tuple(Stop(a) for a in angles), patches=(0, 2), stars=(1, 1, 0))
    calset = simulate(plan, seed=0, noiseless=True, steady=True).calset
    calibration = Calibration.from_fit(examined(refit(calset, base_model(calset, throughput_degree=2))))
    families = small.families
    places = np.deg2rad(2 * np.array(angles))[:, None]
    total = small.prior + np.tensordot(families[0].coefficients(places).sum(axis=0), families[0].basis[0], 1)
    total += families[1].basis[0, [0, 2]].sum(axis=0) + families[2].basis[0, [1, 1, 0]].sum(axis=0)
    promised = small.p_error(np.linalg.pinv(total, rcond=1e-14, hermitian=True)[None])[0]
    matrix, covariance = calibration.matrix(small.x, small.y)
    found = p_errors(matrix, covariance, sample_stars())
    seen = np.isfinite(promised)
    assert 0.5 < seen.mean() < 1.0
    np.testing.assert_allclose(promised[seen], found[seen], rtol=0.02)


def test_a_plan_is_proven_and_reads_back(planned, tmp_path):
    assert 0.0 <= planned.weights_gap <= 0.01
    assert planned.value >= planned.bound
    assert planned.gap <= 0.03
    seconds = sum(line.seconds for line in planned.lines)
    assert seconds <= 15 * 60
    assert all(line.left_out > 1.0 for line in planned.lines)
    assert min(planned.beside.values()) >= planned.bound
    seen = np.isfinite(planned.after)
    assert np.all(planned.after[seen] < planned.before[seen])
    path = tmp_path / "plan.toml"
    path.write_text(plan_text(planned.observing_plan))
    again = read_plan(path)
    first, second = planned.observing_plan.exposures(), again.exposures()
    assert len(first) == sum(line.times for line in planned.lines)
    for name in ("kind", "clp_angle", "mjd", "ra", "filter"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert "no plan of this time is better" in repr(planned)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stops": (Stop(0.0, filter="NB-660"),)}, "NB-660"),
        ({"stops": (Stop(0.0, times=0),)}, "leave it out"),
        ({"stops": (Stop(0.0, moving={"CHPW": 3.0}),)}, "CHPW"),
        ({"patches": (3,)}, "from 0 to 2"),
        ({"stars": (-1,)}, "from 0 to 1"),
    ],
)
def test_exposures_that_are_not_there(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SMALL, **changes)


def test_a_time_that_pays_for_nothing(small):
    with pytest.raises(ValueError, match="less than the cheapest candidate costs: 50"):
        plan_from(small, SMALL, 0.5)


@pytest.mark.long
def test_a_series_of_all_angles_is_the_information_between_them():
    plan = dataclasses.replace(SMALL, grid=6)
    assert candidates(plan, draws=1, colours=(float("nan"),)).truncation < 1e-3
