"""Samplers by name and from outside the package: the same density, the same answers."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.io.errors import DataError
from walop_jax.posterior.emcee import Emcee
from walop_jax.posterior.files import Chain
from walop_jax.posterior.result import Options
from walop_jax.posterior.samplers import SAMPLERS, Density, Sampler, Stretch, make_sampler
from walop_jax.posterior.sampling import Ensembles, sample

from .conftest import Scene

OWN_FILE = Path(__file__).with_name("random_walk.py")
OWN = f"{OWN_FILE}:Metropolis"
EVERY = (*(name for name in SAMPLERS if name != "bootstrap"), OWN)  # a bootstrap has no chains
COVARIANCE = np.array([[1.0, 0.9, 0.0], [0.9, 1.5, -0.3], [0.0, -0.3, 0.7]])
MEAN = np.array([0.3, 0.0, -0.2])


def gaussian() -> Density:
    """A normal density of known mean and covariance; the precision goes through `arrays`."""
    return Density(
        3,
        lambda z, mean, precision: -0.5 * (z - mean) @ precision @ (z - mean),
        arrays=(jnp.asarray(MEAN), jnp.asarray(np.linalg.inv(COVARIANCE))),
    )


def options_for(name: str, **others) -> Options:
    if name == "nuts":
        pytest.importorskip("blackjax")
    return Options(sampler=name, seed=2, walkers=16 if name == "emcee" else 0, **others)


def test_value_and_gradient_of_a_density():
    density, z = gaussian(), np.array([0.5, -1.0, 0.25])
    away = np.linalg.solve(COVARIANCE, z - MEAN)
    value, gradient = density.value_and_gradient(z)
    assert value == pytest.approx(-0.5 * (z - MEAN) @ away, rel=1e-14)
    np.testing.assert_allclose(gradient, -away, rtol=1e-13)
    np.testing.assert_array_equal(density.log_density(z[None]), [value])
    wall = Density(1, lambda z: jnp.log(z[0]))
    np.testing.assert_array_equal(wall.log_density(np.array([[-1.0], [1.0]])), [-np.inf, 0.0])


@pytest.mark.parametrize("name", EVERY, ids=lambda name: name.rsplit(":")[-1])
def test_every_sampler_draws_from_a_gaussian(name: str):
    """Mean and covariance within 4 standard errors of what they are, which the effective samples give."""
    options = options_for(name, interval=1000, maximum_steps=20_000)
    ensembles = Ensembles(options.make_sampler(), gaussian(), options)
    verdict = ensembles.until_converged(("a", "b", "c"))
    assert verdict.converged, verdict.message()
    draws = ensembles.kept()[0].reshape(-1, 3)
    variance = np.diag(COVARIANCE)
    assert np.all(np.abs(draws.mean(axis=0) - MEAN) < 4.0 * np.sqrt(variance / verdict.ess))
    # Squares forget no faster than the coordinates themselves in any of these, hence the smallest number.
    error = np.sqrt((np.outer(variance, variance) + COVARIANCE**2) / verdict.ess.min())
    assert np.all(np.abs(np.cov(draws.T) - COVARIANCE) < 4.0 * error)
    assert verdict.ess.min() > 300
    assert 0.2 < ensembles.acceptance < 1.0


def test_the_chain_of_emcee_is_taken_up_bit_for_bit(tmp_path: Path):
    options = options_for("emcee", interval=40)
    whole = Ensembles(options.make_sampler(), gaussian(), options)
    for folder in (tmp_path, tmp_path, tmp_path):  # a new process each time
        part = Ensembles(options.make_sampler(), gaussian(), options, Chain(folder, {}))
        part.go_on()
        whole.go_on()
    assert part.steps == whole.steps == 120
    for ours, theirs in zip(part.kept(), whole.kept(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    again = Ensembles(options.make_sampler(), gaussian(), options, Chain(tmp_path, {}))
    assert again.acceptance == pytest.approx(whole.acceptance)
    assert np.any(again.kept()[0][0] != again.kept()[0][1]), "ensembles are independent"


@pytest.mark.long
def test_a_sampler_of_ones_own_samples_the_surrogate(scene: Scene, tmp_path: Path):
    """The whole way, and against emcee on the same surrogate: means to 4 standard errors, widths to 10 %."""
    result = scene.result
    short = Options(
        sampler=OWN, seed=1, interval=200, maximum_steps=400, parameters=("half1.wedge",), checks=16
    )
    assert short.make_sampler().name == "metropolis"
    cut = sample(result, dataclasses.replace(short, parameters=None), folder=tmp_path / "chain")
    assert not cut.trusted
    assert cut.sampler == cut.document()["sampler"] == "metropolis"
    assert cut.to_arviz().posterior.attrs["sampler"] == "metropolis"
    assert cut.chains.shape[:3] == (2, 320, 1)
    assert not (tmp_path / "chain").exists()  # chains of others than emcee are not kept


def test_what_is_no_sampler_is_refused_with_advice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(
        DataError, match="no sampler 'emce'; choose one of emcee, nuts, bootstrap, or give your own as FILE"
    ):
        Options(sampler="emce")
    with pytest.raises(DataError, match=r"nowhere\.py: there is no such file"):
        Options(sampler="nowhere.py:Sampler")
    with pytest.raises(DataError, match="no sampler 'Metropolys'; did you mean 'Metropolis'"):
        Options(sampler=f"{OWN_FILE}:Metropolys")
    broken = tmp_path / "broken.py"
    broken.write_text("import nothing_of_the_kind\n")
    with pytest.raises(DataError, match=r"broken\.py: cannot be run: ModuleNotFoundError"):
        Options(sampler=f"{broken}:Any")
    broken.write_text(
        "from walop_jax.posterior.samplers import Sampler\nclass Half(Sampler):\n    name = 'half'\n"
    )
    with pytest.raises(DataError, match=r"cannot be made: .*abstract"):
        Options(sampler=f"{broken}:Half")
    with pytest.raises(DataError, match="'walkers' is no option of the sampler 'metropolis'"):
        Options(sampler=OWN, walkers=32)
    with pytest.raises(DataError, match="'moves' is no option of the sampler 'emcee'; set it in the sampler"):
        Options(sampler=Emcee(walkers=32), moves="de")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(DataError, match=r"nuts needs blackjax; pip install 'walop-jax\[nuts\]'"):
        Options(sampler="nuts")


def test_settings_reach_their_sampler():
    made = make_sampler("emcee", {"walkers": 32, "moves": "de"})
    assert made == Emcee(walkers=32, moves="de")
    assert make_sampler(made) is made
    assert make_sampler(Emcee) == Emcee()


class Flat(Sampler):
    """Forgets the axis of walkers."""

    name = "flat"

    def start(self, density, seed):
        return {"position": np.zeros(density.dimension)}

    def advance(self, density, state, steps):
        return state, Stretch(np.zeros((steps, density.dimension)), np.zeros(steps), np.zeros(steps))


def test_wrong_shapes_are_refused():
    ensembles = Ensembles(Flat(), gaussian(), Options(sampler=Flat(), interval=10))
    with pytest.raises(DataError, match=r"'flat' gave positions of shape \(10, 3\).*= \(10, …, 3\)"):
        ensembles.go_on()
