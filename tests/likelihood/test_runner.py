"""Passes over many points: the same on any number of threads, devices and processes, and when they are resumed."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from frame_run import frame_run
from jax import monitoring
from small_run import SEED, SMALL

from walop_jax.fit.model_file import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood import limits, runner
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.likelihood.runner import Journal, LostProcessError, Processes, Runner
from walop_jax.simulation.simulate import simulate

RUN = frame_run(40)
PLAN = """
import jax
jax.config.update("jax_enable_x64", True)
import json, os, sys, time
import numpy as np
"""


def made(**options):
    calset = simulate(RUN, seed=5).calset
    model = base_model(calset, throughput_degree=2)
    return Likelihood.of(calset, model, points_per_chunk=64, interpolate=True, memory=1e6, **options)


@pytest.fixture
def likelihood():
    return made()


def test_the_number_of_threads_changes_nothing(likelihood):
    found = []
    for threads in (1, 2, 5):
        there = dataclasses.replace(likelihood, runner=Runner(threads=threads))
        found.append(there.expand(likelihood.model.start))
    assert likelihood.layout.slab == 64
    for other in found[1:]:
        assert other.data == found[0].data
        np.testing.assert_array_equal(other.gradient, found[0].gradient)
        np.testing.assert_array_equal(other.matrix, found[0].matrix)


def run(code: str, *arguments: str, **options) -> subprocess.Popen:
    """Another Python that knows the tests and solves as many places together as this one: equal to the last bit."""
    code = (
        f"from walop_jax.likelihood import limits\nlimits.SOLVED_TOGETHER = {limits.SOLVED_TOGETHER}\n{code}"
    )
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
print(json.dumps({"devices": jax.local_device_count(), "data": found.data, "rows": found.census.rows.tolist(),
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


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("localhost", 0))
        return one.getsockname()[1]


SHARED = """
from walop_jax.likelihood import limits, runner
from walop_jax.likelihood.runner import Runner
limits.LARGE_ABOVE, limits.SAMPLE = 0, 400
here = runner.join(sys.argv[1])
from test_runner import made  # makes arrays: not ahead of `join`
p = made(runner=Runner(processes=here))
assert p.layout.large
"""


@pytest.mark.long
def test_two_processes_fit_as_one_does(likelihood, monkeypatch):
    """To 1e-10 in every parameter, in units of its scale; each has done half of the work."""
    code = (
        PLAN
        + SHARED
        + """
from walop_jax.fit.refit import fit
found = fit(p)
seen = []
block = p.calset.intensities.block
object.__setattr__(p.calset.intensities, "block", lambda a, b: (seen.append(a), block(a, b))[1])
p.expand(found.values)
print(json.dumps({"values": found.values.tolist(), "sigma": found.sigma.tolist(), "chi2": found.chi2,
                  "dof": found.dof, "field": found.posterior.census.field, "converged": found.converged,
                  "seen": len(set(seen))}))
"""
    )
    port = free_port()
    both = [run(code, f"{n}/2@localhost:{port}") for n in range(2)]
    one, other = (result_of(process) for process in both)
    monkeypatch.setattr(limits, "LARGE_ABOVE", 0)
    monkeypatch.setattr(limits, "SAMPLE", 400)
    alone = fit(made())
    scale = np.array([p.scale for p in likelihood.model.parameters])
    assert one["converged"]
    assert one["values"] == other["values"]
    assert one["sigma"] == other["sigma"]
    np.testing.assert_allclose(np.array(one["values"]) / scale, alone.values / scale, rtol=0, atol=1e-10)
    np.testing.assert_allclose(one["sigma"], alone.sigma, rtol=1e-8)
    assert one["chi2"] == pytest.approx(alone.chi2, rel=1e-12)
    assert (one["dof"], tuple(one["field"])) == (alone.dof, alone.posterior.census.field)
    assert (one["seen"], other["seen"]) == (13, 12)


@pytest.mark.long
def test_a_dead_process_is_an_error_in_the_others():
    code = (
        PLAN
        + SHARED
        + """
p.expand(p.model.start)
print("ready", flush=True)
if here.index == 1:
    time.sleep(600)
try:
    p.expand(p.model.start)
except runner.LostProcessError as error:
    print(error, flush=True)
    os._exit(3)
"""
    )
    port = free_port()
    both = [run(code, f"{n}/2@localhost:{port}") for n in range(2)]
    try:
        for process in both:
            while "ready" not in (line := process.stdout.readline()):
                assert line, process.stderr.read()[-2000:]
        both[1].send_signal(signal.SIGKILL)
        began = time.monotonic()
        out, _ = both[0].communicate(timeout=60)
    finally:
        for process in both:
            process.kill()
            process.communicate()
    assert both[0].returncode == 3
    assert "has lost another one" in out
    assert time.monotonic() - began < 60


def test_processes_at_different_work_are_found_out(monkeypatch):
    from jax.experimental import multihost_utils

    def answer(row):
        return np.stack([row, row + 1.0])

    monkeypatch.setattr(multihost_utils, "process_allgather", answer)
    with pytest.raises(LostProcessError, match="same command"):
        Processes(0, 2).gather("gradient", np.zeros(3))


@pytest.mark.parametrize("place", ["", "1/2", "0/2@host", "2/2@host:1", "a/2@host:1", "0/2@host:port"])
def test_a_place_that_is_none_is_refused(place):
    with pytest.raises(ValueError, match="INDEX"):
        runner.join(place)


def test_more_processes_than_slabs_are_refused(likelihood):
    with pytest.raises(ValueError, match="use fewer"):
        Runner(processes=Processes(99, 100)).total("", None, lambda _: None, likelihood.layout)


# ------------------------------------------------------------------------------------------------- resuming


class StopError(Exception):
    pass


def interrupted(likelihood, after):
    """The likelihood with a disk that fails after so many slabs."""
    block, count = likelihood.calset.intensities.block, 0

    def failing(start, stop):
        nonlocal count
        count += 1
        if count > after:
            raise StopError
        return block(start, stop)

    object.__setattr__(likelihood.calset.intensities, "block", failing)
    return likelihood


def test_a_resumed_pass_is_the_same_to_the_last_bit(tmp_path):
    whole, kept = made(), Runner(journal=Journal(tmp_path / "partial", "one fit"))
    expected = whole.expand(whole.model.start)
    first = interrupted(dataclasses.replace(made(), runner=kept), 9)
    with pytest.raises(StopError):
        first.expand(first.model.start)
    again = dataclasses.replace(made(), runner=kept)
    asked = []
    block = again.calset.intensities.block
    object.__setattr__(again.calset.intensities, "block", lambda a, b: (asked.append(a), block(a, b))[1])
    found = again.expand(again.model.start)
    assert 25 - 9 <= len(asked) <= 25 - 7
    assert found.data == expected.data
    np.testing.assert_array_equal(found.matrix, expected.matrix)
    np.testing.assert_array_equal(found.census.rows, whole.census.rows)
    assert found.census.field == whole.census.field
    # A third time nothing is read at all; other values, another set or model are other work.
    asked.clear()
    again.expand(again.model.start)
    assert not asked
    again.expand(again.model.start * 1.001)
    assert len(asked) == 25
    asked.clear()
    other = Runner(journal=Journal(tmp_path / "partial", "another fit"))
    dataclasses.replace(again, runner=other).expand(again.model.start)
    assert len(asked) == 25


def test_what_is_damaged_is_done_again(tmp_path):
    journal = Journal(tmp_path, "fit")
    for number in range(3):
        journal.append("pass", number, np.arange(4.0) + number)
    path = journal.path("pass")
    content = bytearray(path.read_bytes())
    assert list(journal.read("pass")) == [0, 1, 2]
    # A crash in the middle of a record.
    path.write_bytes(content[:-11])
    assert list(journal.read("pass")) == [0, 1]
    journal.append("pass", 2, np.arange(4.0) + 2)
    assert path.read_bytes() == bytes(content)
    # A flipped bit: that record and what follows.
    content[8 + 72 + 20] ^= 1
    path.write_bytes(content)
    assert list(journal.read("pass")) == [0]
    np.testing.assert_array_equal(journal.read("pass")[0], np.arange(4.0))
    # Nothing sound is left at all.
    path.write_bytes(b"\x04")
    assert journal.read("pass") == {}
    journal.append("pass", 0, np.arange(4.0))
    np.testing.assert_array_equal(journal.read("pass")[0], np.arange(4.0))


def test_what_was_made_once_is_remembered(tmp_path):
    journal, calls = Journal(tmp_path, "fit"), []

    def make():
        calls.append(1)
        return np.array([1.5, -2.0])

    for _ in range(2):
        np.testing.assert_array_equal(journal.remembered("sample", make), [1.5, -2.0])
    assert len(calls) == 1


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
    assert dataclasses.replace(likelihood, runner=Runner(progress=told.append)).census.n_data
    assert told == []


def test_small_sets_are_neither_shared_nor_kept(tmp_path):
    """Every process would wait for the others longer than it computes."""
    runner = Runner(processes=Processes(1, 2), journal=Journal(tmp_path, "fit"), progress=print)
    small = made(runner=runner)
    assert not small.layout.large
    assert small.runner == Runner(runner.threads, progress=print)


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
