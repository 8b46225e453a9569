"""Nights made in other processes, and on a Dask cluster that loses a worker, against those of one process."""

import contextlib
import dataclasses
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from command import run_program
from small_run import SMALL

import walop_jax as walop
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.io.errors import DataError
from walop_jax.likelihood import workers
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.likelihood.workers import executor_of
from walop_jax.nights.equations import SIDEREAL
from walop_jax.nights.stacking import stack
from walop_jax.simulation.simulate import simulate


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files of five nights, a week apart, and a run of the first."""
    place = tmp_path_factory.mktemp("nights")
    first = simulate(SMALL, seed=1)
    walop.write_calibration_set(place / "night0.fits", first.calset)
    for k in range(1, 5):
        plan = dataclasses.replace(SMALL, mjd=SMALL.start + 7.0 * k)
        night = simulate(plan, seed=1 + k, instrument=first.truth, catalogue_seed=1).calset
        walop.write_calibration_set(place / f"night{k}.fits", night)
    calset = walop.read(place / "night0.fits")
    fit(Likelihood.of(calset, base_model(calset))).with_verdict().save(place / "RUN")
    return place


@pytest.fixture(scope="module")
def given(folder):
    return [folder / "RUN", *(folder / f"night{k}.fits" for k in range(1, 5))]


@pytest.fixture(scope="module")
def here(given):
    return stack(given)


def assert_identical(one, two):
    """Two surveys, to the last bit."""
    assert one.document() == two.document()
    for mine, other in zip(one.data.nights, two.data.nights, strict=True):
        assert (mine.key, mine.chi2) == (other.key, other.chi2)
        np.testing.assert_array_equal(mine.reference, other.reference)
        np.testing.assert_array_equal(mine.gradient, other.gradient)
        np.testing.assert_array_equal(mine.matrix, other.matrix)
    np.testing.assert_array_equal(one.solution.values, two.solution.values)


@pytest.mark.long
def test_threads_make_the_same_survey(given, here, tmp_path):
    with ThreadPoolExecutor(1) as executor:
        assert_identical(stack(given, executor=executor, partial=tmp_path), here)
    assert len(list(tmp_path.glob("night-*.fits"))) == len(given)


def test_another_process_is_set_up_as_a_command_is(monkeypatch):
    """Without kept programs every worker would compile its own, for as long as twenty nights take."""
    switched = []
    monkeypatch.setattr(workers, "switch_on", lambda: switched.append(True))
    workers._prepare.cache_clear()
    workers._prepare(os.getpid(), ())
    assert not switched
    workers._prepare(-1, ())
    assert switched


@pytest.mark.long
def test_copies_are_refused_whoever_makes_them(folder, given, tmp_path):
    """The second night once more, a sidereal day later: its measurements are the same."""
    calset = walop.read(folder / "night1.fits")
    later = dataclasses.replace(calset.exposures, mjd=calset.exposures.mjd + 1 / SIDEREAL)
    copy = tmp_path / "copy.fits"
    walop.write_calibration_set(copy, dataclasses.replace(calset, exposures=later))
    with ThreadPoolExecutor(1) as executor, pytest.raises(DataError, match=r"100 % .*night1\.fits"):
        stack([*given, copy], executor=executor)


@pytest.mark.long
def test_a_worker_that_is_killed_is_replaced(given, here, tmp_path):
    """Two processes of a Dask cluster on this machine; the first that leaves a night is killed."""
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "host": "127.0.0.1"}
    with contextlib.ExitStack() as hold:
        cluster = hold.enter_context(distributed.LocalCluster(**options))
        workers = {info["name"]: worker.process.pid for info, worker in zip(
            cluster.scheduler_info["workers"].values(), cluster.workers.values(), strict=True)}  # fmt: skip
        killed = []

        def kill():
            while not list(tmp_path.glob("night-*.fits")):
                time.sleep(0.05)
            killed.append(pid := next(iter(workers.values())))
            os.kill(pid, signal.SIGKILL)

        thread = threading.Thread(target=kill, daemon=True)
        thread.start()
        executor = hold.enter_context(executor_of(scheduler=cluster.scheduler_address))
        survey = stack(given, partial=tmp_path, executor=executor)
    assert killed
    assert_identical(survey, here)


def test_workers_and_scheduler_exclude_each_other(tmp_path):
    """A usage error or advice, before anything is read."""
    pytest.importorskip("distributed")
    words = ("-o", tmp_path / "S", "--workers", "2", "--scheduler", "tcp://127.0.0.1:1")
    result = run_program("stack", tmp_path / "none.fits", *words)
    assert result.exit_code == 2
    assert "exclude each other" in result.stderr
    assert not (tmp_path / "S").exists()
