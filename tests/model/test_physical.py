"""Mueller matrices that elements and effects can make are physical: they turn light into light.

A Mueller matrix is a mean of Jones matrices if and only if its coherency matrix ¼ Σ mᵢⱼ σᵢ ⊗ σⱼ* has no negative
eigenvalue (Cloude 1986, Optik 75, 26).
"""

from __future__ import annotations

import dataclasses

import effect_scenes as scenes
import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.model import fold, light
from walop_jax.model.effects import EFFECTS, Effect, EffectKind
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import leaves, values_of, with_values
from walop_jax.model.ray import Ray

PAULI = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, -1j], [1j, 0]]])
ROUNDING = 1e-10
WIDTHS = 3.0


def least_eigenvalue(mueller: np.ndarray) -> float:
    """Smallest eigenvalue of the coherency matrices, in units of the transmission of unpolarised light."""
    products = np.einsum("iab,jcd->ijacbd", PAULI, PAULI.conj()).reshape(4, 4, 4, 4)
    coherency = 0.25 * np.einsum("...ij,ijab->...ab", mueller, products)
    return float((np.linalg.eigvalsh(coherency) / np.asarray(mueller)[..., 0, 0, None]).min())


def matrices(instrument: Instrument, x: float, y: float, plate: float | None) -> list[tuple[str, np.ndarray]]:
    """The Mueller matrix of every element of the train for light from a field point, by name."""
    layout = scenes.plan(instrument.effects)
    instrument = instrument.patched()
    spectrum = (light.node_wavelengths(instrument, layout), layout.conditions)
    ray = Ray.entering(jnp.asarray(x), jnp.asarray(y), spectrum)
    path = fold.Fold.of(instrument.behind_polariser(), instrument.arms, ray, layout.moving, [(plate,)])
    found = path.solved().items()
    return [(path.stations[n][0].name, np.asarray(matrix)) for (n, _), matrix in found if matrix is not None]


def anywhere(rng: np.random.Generator) -> Instrument:
    """An instrument with every number anywhere within three prior widths."""
    start = np.asarray(values_of(scenes.BASE))
    width = np.array([leaf.width or 0.0 for leaf in leaves(scenes.BASE)])
    return with_values(scenes.BASE)(jnp.asarray(start + WIDTHS * width * rng.uniform(-1, 1, len(start))))


def with_effect(kind: EffectKind, rng: np.random.Generator) -> Effect:
    """An effect with every amplitude anywhere within three prior widths, of either sign where it has two."""
    probe = kind.probes(scenes.CONTEXT)[0][0]
    changes = {}
    for name in kind.amplitudes():
        size = WIDTHS * (kind.numbers()[name].width or 0.0)
        drawn = size * rng.uniform(-1, 1, np.shape(getattr(probe, name)))
        changes[name] = jnp.asarray(np.abs(drawn) if name in kind.one_sided else drawn)
    return probe.replaced(**changes)


def unphysical(instrument: Instrument) -> list[str]:
    """Names of the elements whose matrices are not physical somewhere."""
    places = ((0.0, 0.0, None), (0.29, -0.29, 45.0))
    return [
        name
        for x, y, plate in places
        for name, matrix in matrices(instrument, x, y, plate)
        if not least_eigenvalue(matrix) > -ROUNDING
    ]


def test_the_measure_is_that_of_cloude():
    """A mirror of the sky that nothing can be, depolarisers of every strength, and a retarder."""
    assert least_eigenvalue(np.diag([1.0, 1.0, 1.0, -1.0])) == pytest.approx(-0.5)
    assert least_eigenvalue(np.diag([1.0, 0.3, 0.3, 0.3])) == pytest.approx(0.25 * 0.7)
    assert least_eigenvalue(np.diag([1.0, 1.0, 0.0, 0.0])) == pytest.approx(0.0, abs=1e-15)
    assert least_eigenvalue(np.diag([1.0, 1.0, 1.0, 0.9])) < -0.02
    c, s = np.cos(1.0), np.sin(1.0)
    assert least_eigenvalue(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, c, s], [0, 0, -s, c]])) > -1e-15


@pytest.mark.long
@pytest.mark.parametrize("seed", range(10))
def test_elements_within_three_prior_widths(seed):
    instrument = anywhere(np.random.default_rng(seed))
    names = [name for name, _ in matrices(instrument, 0.1, 0.2, 45.0)]
    assert len(names) >= 3, "there is something to look at"
    assert unphysical(instrument) == []


@pytest.mark.long
@pytest.mark.parametrize("kind", [k for k in EFFECTS if not k.is_structural()], ids=lambda kind: kind.name)
def test_effects_within_three_prior_widths(kind: EffectKind):
    rng = np.random.default_rng(1)
    for _ in range(3):
        device = dataclasses.replace(anywhere(rng), effects=(with_effect(kind, rng),))
        assert unphysical(device) == []
