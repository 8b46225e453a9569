"""Passes over many points: the same on any number of threads and devices, with progress."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from frame_run import frame_run
from jax import monitoring
from small_run import SEED, SMALL

from walop_jax.fit.base_model import base_model
from walop_jax.likelihood import limits
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.likelihood.runner import Runner
from walop_jax.simulation.simulate import simulate

RUN = frame_run(40)
PLAN = """
import jax
jax.config.update("jax_enable_x64", True)
import json
"""


def made(**options):
    calset = simulate(RUN, seed=5).calset
    model = base_model(calset, throughput_degree=2)
    return Likelihood.of(calset, model, batch=64, interpolate=True, **options)


@pytest.fixture
def likelihood():
    return made()


def test_the_number_of_threads_changes_nothing(likelihood):
    found = []
    for threads in (1, 2, 5):
        there = dataclasses.replace(likelihood, runner=Runner(threads=threads))
        found.append(there.expand(likelihood.model.start))
    assert likelihood.layout.part == 64
    for other in found[1:]:
        assert other.data == found[0].data
        np.testing.assert_array_equal(other.gradient, found[0].gradient)
        np.testing.assert_array_equal(other.matrix, found[0].matrix)


def run(code: str, *arguments: str, **options) -> subprocess.Popen:
    """Another Python that knows the tests and solves as many places together as this one: equal to the last bit."""
    code = f"from walop_jax.likelihood import limits\nlimits.BATCH = {limits.BATCH}\n{code}"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, **options,
    )  # fmt: skip


def result_of(process: subprocess.Popen) -> dict:
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err[-3000:]
    return json.loads(out.splitlines()[-1])


EXPAND = """
from test_runner import made
p = made()
found = p.expand(p.model.start)
print(json.dumps({"devices": jax.local_device_count(), "data": found.data, "rows": found.used_data.rows.tolist(),
                  "gradient": found.gradient.tolist(), "matrix": found.matrix.tolist()}))
"""


@pytest.mark.long
def test_two_devices_give_the_same(likelihood):
    code = PLAN.replace("import json", 'jax.config.update("jax_num_cpu_devices", 2)\nimport json', 1) + EXPAND
    found = result_of(run(code))
    here = likelihood.expand(likelihood.model.start)
    assert found["devices"] == 2
    assert found["data"] == here.data
    np.testing.assert_array_equal(found["gradient"], here.gradient)


def test_an_error_in_one_part_ends_the_pass():
    """It comes out as it is, and no part that has not begun is begun."""
    begun = []

    def work(number):
        begun.append(number)
        if number == 2:
            raise OSError("the disk is gone")
        time.sleep(0.01)
        return number

    with pytest.raises(OSError, match="the disk is gone"):
        list(Runner(threads=2).each("", work, 1000, 10))
    assert len(begun) < 50


def test_results_come_in_the_order_of_the_parts():
    """Also where the first ones take longest; the last part has fewer points."""

    def work(number):
        time.sleep(0.002 * (7 - number))
        return number

    assert list(Runner(threads=3).each("", work, 61, 10)) == list(range(7))


def test_progress_counts_every_point_once(likelihood, monkeypatch):
    """On a clock that ticks every two seconds: 64 points a tick."""
    told = []
    monkeypatch.setattr(time, "perf_counter", iter(np.arange(0.0, 1e6, 2.0)).__next__)
    dataclasses.replace(likelihood, runner=Runner(progress=told.append)).expand(likelihood.model.start)
    assert len(told) == 25
    label = "χ², gradient and matrix"
    assert told[0] == f"{label}: 64 of 1,600 points, 32 points/s, 48 s left of this pass"
    assert told[12] == f"{label}: 832 of 1,600 points, 32 points/s, 24 s left of this pass"
    assert told[-1] == f"{label}: 1,600 of 1,600 points, 32 points/s, 0 s left of this pass"


def test_short_passes_are_not_told_of(likelihood):
    told = []
    assert dataclasses.replace(likelihood, runner=Runner(progress=told.append)).used_data.n_data
    assert told == []


def test_a_copy_in_another_process_reports_no_progress():
    assert pickle.loads(pickle.dumps(Runner(threads=3, progress=print))) == Runner(threads=3)


@pytest.mark.skipif(
    not hasattr(monitoring, "unregister_event_duration_listener"), reason="this JAX keeps its listeners"
)
def test_a_pass_leaves_its_programs_to_what_comes_after_it():
    """A device that is asked for by name is part of what JAX knows a program by: on one device none is."""
    calset = simulate(SMALL, seed=SEED).calset
    likelihood = Likelihood.of(calset, base_model(calset))
    values, built = likelihood.model.start, []

    def heard(event, seconds, **about):
        if event.endswith("jaxpr_trace_duration"):
            built.append(about.get("fun_name", ""))

    likelihood.expand(values)
    monitoring.register_event_duration_secs_listener(heard)
    try:
        likelihood.jacobian(values)
    finally:
        monitoring.unregister_event_duration_listener(heard)
    assert not [name for name in built if "residuals" in name]
