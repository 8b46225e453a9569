"""Moves, convergence and checkpoints: everything between a log-posterior and a verdict."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import emcee
import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.io.errors import DataError
from walop_jax.posterior import MOVES, Checkpoints, Density, Emcee, Surrogate, assess, r_hat

MARK = {"data": "a", "model": "b"}


def normal(z: np.ndarray) -> np.ndarray:
    return -0.5 * np.sum(z**2, axis=1)


def unit(dimension: int) -> Density:
    return Density(dimension, lambda z: -0.5 * jnp.sum(z**2), batch=normal)


@pytest.mark.parametrize("move", MOVES)
def test_moves_leave_a_gaussian_as_it_is(move: str) -> None:
    """Widths to 2 % at 10 dimensions; a move with a wrong Jacobian fails."""
    sampler, density = Emcee(moves=move), unit(10)
    state, stretch = sampler.advance(density, sampler.start(density, (1, 0)), 3000)
    positions = stretch.positions[400:]
    assert positions.std() == pytest.approx(1.0, abs=0.02)
    assert abs(positions.mean()) < 0.03
    assert 0.1 < stretch.acceptance.mean() < 0.9
    moved = np.any(np.diff(stretch.positions, axis=0) != 0, axis=2)
    np.testing.assert_array_equal(moved, stretch.acceptance[1:] == 1)
    assert state["positions"].shape == (64, 10)


def test_snooker_of_emcee_is_still_not_to_be_used() -> None:
    """The reason why it is not offered; when this fails, emcee has mended it (dfm/emcee pull request 531)."""
    sampler = emcee.EnsembleSampler(
        64, 10, normal, vectorize=True,
        moves=[(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)],
    )  # fmt: skip
    random = np.random.RandomState(2)
    sampler.run_mcmc(emcee.State(random.standard_normal((64, 10)), random_state=random.get_state()), 3000)
    assert sampler.get_chain(discard=500).std() < 0.97


@pytest.mark.parametrize("move", MOVES)
def test_blocks_go_on_bit_for_bit(move: str) -> None:
    sampler, density = Emcee(walkers=16, moves=move), unit(5)
    first = sampler.start(density, (7, 0))
    _, whole = sampler.advance(density, first, 40)
    middle, left = sampler.advance(density, first, 17)
    _, right = sampler.advance(density, middle, 23)
    np.testing.assert_array_equal(np.concatenate([left.positions, right.positions]), whole.positions)
    np.testing.assert_array_equal(np.concatenate([left.acceptance, right.acceptance]), whole.acceptance)


def autoregressive(rng: np.random.Generator, memory: float, steps: int, offset: float = 0.0) -> np.ndarray:
    """(ensembles, steps, walkers, 2) with τ = (1 + a)/(1 − a)."""
    x = rng.standard_normal((2, steps, 20, 2))
    for i in range(1, steps):
        x[:, i] = memory * x[:, i - 1] + np.sqrt(1 - memory**2) * x[:, i]
    x[1] += offset
    return x


def test_autocorrelation_time_is_that_of_the_process() -> None:
    chains = autoregressive(np.random.default_rng(1), 0.9, 4000)
    verdict = assess(chains, ("a", "b"), thin=3)
    np.testing.assert_allclose(verdict.tau, 3 * 19, rtol=0.15)
    assert verdict.converged, verdict.message()
    np.testing.assert_allclose(verdict.ess, 2 * 20 * 4000 / 19, rtol=0.15)
    assert verdict.needed == 0


def test_a_short_chain_is_sent_back() -> None:
    verdict = assess(autoregressive(np.random.default_rng(1), 0.95, 400), ("a", "b"))
    assert not verdict.converged
    assert verdict.steps + verdict.needed > 50 * 20
    assert "NOT converged" in verdict.message(0.01)
    assert "Go on for" in verdict.message(0.01)
    assert not assess(np.zeros((2, 10, 4, 1)), ("a",)).converged


def test_ensembles_that_disagree_are_found_out() -> None:
    verdict = assess(autoregressive(np.random.default_rng(1), 0.5, 2000, offset=0.4), ("a", "b"))
    assert not verdict.converged
    assert "R-hat" in verdict.reasons[0]
    wider = np.random.default_rng(2).standard_normal((2, 2000, 10, 1))
    wider[1] *= 1.4
    assert r_hat(wider)[0] > 1.01, "same mean, other width"


def test_r_hat_of_displaced_ensembles_is_that_of_the_definition() -> None:
    """√(1 + B/W): means of four halves at ±δ/2 have variance δ²/3, the variance inside is 1.

    δ has an error of 0.0063 here, which makes 0.0008 at δ = 0.4.
    """
    for offset in (0.0, 0.2, 0.4):
        chains = np.random.default_rng(1).standard_normal((2, 5000, 10, 1))
        chains[1] += offset
        assert r_hat(chains)[0] == pytest.approx(np.sqrt(1.0 + offset**2 / 3.0), abs=2.5e-3)


def test_drift_is_found_out() -> None:
    chains = autoregressive(np.random.default_rng(1), 0.5, 2000)
    chains += np.linspace(0, 3, 2000)[None, :, None, None]
    assert not assess(chains, ("a", "b")).converged


def test_a_stuck_coordinate_is_found_out() -> None:
    chains = np.random.default_rng(1).standard_normal((2, 500, 10, 2))
    chains[..., 1] = 1.0
    assert "b never moved" in assess(chains, ("a", "b")).message()


def test_checkpoints_come_back_and_refuse_what_is_not_theirs(gaussian: Surrogate, tmp_path: Path) -> None:
    there = Checkpoints(tmp_path / "chain", MARK)
    assert not there.exists()
    there.save_surrogate(gaussian, {"seconds": 1.5})
    loaded, extra = there.load_surrogate()
    assert loaded.names == gaussian.names
    assert extra["seconds"] == 1.5
    np.testing.assert_array_equal(loaded.data, gaussian.data)
    sampler, density = Emcee(walkers=16), unit(4)
    state, stretch = sampler.advance(density, sampler.start(density, (7, 0)), 10)
    stretch = stretch._replace(counts={"fruit": 3})
    there.save_block(1, [state, state], [stretch, stretch], 0.1)
    again, blocks, seconds = there.load_block(1)
    assert (there.count(), seconds) == (1, 0.1)
    for name in ("positions", "log_density", "acceptance"):
        np.testing.assert_array_equal(getattr(blocks[1], name), getattr(stretch, name))
    assert blocks[0].counts == {"fruit": 3}
    assert set(again[0]) == set(state)
    for name, value in state.items():
        np.testing.assert_array_equal(again[1][name], value)
        assert again[1][name].dtype == value.dtype

    with pytest.raises(DataError, match=r"other data \(a → z\)"):
        Checkpoints(tmp_path / "chain", {"data": "z", "model": "b"}).load_surrogate()
    with pytest.raises(DataError, match="exists already"):
        there.save_block(1, [state], [stretch], 0.1)
    path = there.block_path(1)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match="cannot be read"):
        there.load_block(1)
    spoilt = bytearray(whole)
    spoilt[whole.index(stretch.positions[3].tobytes())] ^= 1
    path.write_bytes(bytes(spoilt))
    with pytest.raises(DataError, match="not what was written"):
        there.load_block(1)
    there.clear()
    assert not there.exists()


SCRIPT = """
import sys, numpy as np
from walop_jax.posterior import Checkpoints, Density, Emcee
f = Density(4, lambda z: -0.5 * z @ z, batch=lambda z: -0.5 * np.sum(z**2, axis=1))
there = Checkpoints(sys.argv[1], {"data": "a"})
there.folder.mkdir(exist_ok=True)
sampler = Emcee(walkers=16, moves="de")
states = [sampler.start(f, (7, n)) for n in range(2)]
for number in range(1, there.count() + 1):
    states, _, _ = there.load_block(number)
for number in range(there.count() + 1, 13):
    both = [sampler.advance(f, state, 50) for state in states]
    states = [state for state, _ in both]
    there.save_block(number, states, [stretch for _, stretch in both], 0.0)
    print(number, flush=True)
"""


def test_a_killed_run_loses_one_block_and_ends_up_the_same(tmp_path: Path) -> None:
    def run(folder: str, kill_after: int | None = None) -> None:
        command = [sys.executable, "-c", SCRIPT, str(tmp_path / folder)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=dict(os.environ)) as process:
            assert process.stdout is not None
            if kill_after is not None:
                for line in process.stdout:
                    if int(line) >= kill_after:
                        time.sleep(0.003)  # into the middle of a block, or of writing one
                        process.send_signal(signal.SIGKILL)
                        break
            process.wait(timeout=120)

    run("whole")
    run("killed", kill_after=4)
    killed = Checkpoints(tmp_path / "killed", {"data": "a"})
    assert 4 <= killed.count() < 12
    run("killed")
    whole = Checkpoints(tmp_path / "whole", {"data": "a"})
    for number in range(1, 13):
        for ours, theirs in zip(killed.load_block(number)[1], whole.load_block(number)[1], strict=True):
            np.testing.assert_array_equal(ours.positions, theirs.positions)
