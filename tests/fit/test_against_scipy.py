"""The joint fit against another program: scipy's least squares on a numpy residual written from `docs: model`."""

import time

import numpy as np
import pytest
from oracle import fit as oracle_fit
from oracle import forward

from walop_jax.data.calset import read_calibration_set
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood.likelihood import Likelihood

PLATES = {f"half{k}.plate.{crystal}": f"{crystal}_{k}" for k in (1, 2) for crystal in ("quartz", "mgf2")}


@pytest.mark.long
def test_scipy_finds_the_same_minimum(either_south_set):
    """χ² at the minimum to 1e-6, every well determined parameter to a hundredth of its error.

    scipy starts from nominal values, but in the right order of the retardances: from elsewhere it ends in another.
    Printed (-s): seconds of both, scipy by finite differences, ours the second time.
    """
    path = either_south_set("a").path
    calset = read_calibration_set(path)
    likelihood = Likelihood.of(calset, base_model(calset))
    fit(likelihood)
    start = time.perf_counter()
    ours = fit(likelihood)
    ours_seconds = time.perf_counter() - start
    data = forward.load(path)
    start = time.perf_counter()
    begin = forward.nominal(data["sources"]["Q"].size)
    begin |= {"q": data["sources"]["Q"].copy(), "u": data["sources"]["U"].copy()}
    for name, other in PLATES.items():
        value, sigma = ours.value(name)
        begin[other] = value + 5.0 * sigma
    theirs = oracle_fit.fit(data, begin)
    theirs_seconds = time.perf_counter() - start
    print(
        f"χ² ours {ours.chi2:.6f} scipy {theirs['chi2']:.6f}; seconds {ours_seconds:.2f} and {theirs_seconds:.2f}"
    )
    assert ours.chi2 == pytest.approx(theirs["chi2"], rel=1e-6)
    # scipy counts all terms of the throughput; of those that all cameras have in common 14 are nearly fluxes.
    assert 0 <= ours.dof - theirs["dof"] <= 14
    for name, other in (
        ("pupil.magnification", "magnification"),
        ("half2.plate.mgf2", "mgf2_2"),
        ("sky.depolarisation", "delta"),
    ):
        value, sigma = ours.value(name)
        assert abs(value - theirs["params"][other]) < 0.01 * sigma
    assert np.isfinite(ours.covariance).all()
