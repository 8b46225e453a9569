"""Derivatives of counts: forward = reverse = central differences, for every parameter of the base model."""

import builders
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import forward
from quick import quick

from walop_jax.data.records import Sources
from walop_jax.model import light
from walop_jax.model.compiled import compiled
from walop_jax.model.instrument import nominal_instrument
from walop_jax.model.parameters import leaves, values_of, with_values
from walop_jax.model.planning import plan_for
from walop_jax.model.sources import PointIllumination

STANDARDS = [("STAR", 0.04, -0.02)]
LAM = 0.63
SKY = jnp.asarray(np.array([[0, 0], [0, 0], [0.07, -0.03], [0, 0]], float))
SOURCE = jnp.asarray([-1, -1, -1, 0])


def plan():
    rows = [
        {"clp_angle": 20.0},
        {"clp_angle": 65.0, "chwp_angle": 45.0},
        {"kind": "moon"},
        {"kind": "standard", "rotator": 33.0, "teff": 5000.0},
    ]
    one = np.array([0.04])
    sources = Sources(
        np.array([1]), np.array(["STAR"]), one, -0.5 * one, 0.01 * one, 0.01 * one, np.array([np.nan])
    )
    filters = {"band": builders.curve([LAM, LAM + 0.0004], [1.0, 0.6])}
    return plan_for(TEMPLATE, builders.exposures(*rows), filters, sources)


TEMPLATE = nominal_instrument(standards=STANDARDS)
PLAN = plan()
NAMES = [leaf.name for leaf in leaves(TEMPLATE)]


def model(values, x, y):
    instrument = with_values(TEMPLATE)(values)
    rows = light.band_rows(instrument, PLAN, x, y)
    band = jnp.asarray(PLAN.band_of)[jnp.arange(4), SOURCE + 1]
    throughput = instrument.throughput.at(x, y)
    return light.counts(
        instrument, rows, throughput, PointIllumination(PLAN.exposures, SKY, SOURCE, x, y), band
    ).ravel()


counts, forward_jacobian, reverse_jacobian = map(compiled, (model, jax.jacfwd(model), jax.jacrev(model)))


def without_wedges():
    return builders.without_wedges(TEMPLATE)


def half_wave():
    """Thicknesses that make δ = π, a thin plate and no wedge: cos δ has its extremum there."""
    (q_o, q_e), (m_o, m_e) = forward.quartz(LAM), forward.mgf2(LAM)
    quartz = (300.0 * (m_e - m_o) - 0.5 * LAM) / (q_e - q_o)
    return builders.with_plates(without_wedges(), quartz, 300.0)


CASES = {
    "field corner": (lambda: TEMPLATE, 0.29, -0.29),
    "as built": (lambda: builders.as_built(TEMPLATE, np.random.default_rng(4)), -0.17, 0.08),
    "normal incidence": (without_wedges, 0.0, 0.0),
    "half wave, normal incidence": (half_wave, 0.0, 0.0),
    "half wave, off axis": (half_wave, 0.2, 0.2),
}


@pytest.mark.parametrize("case", quick(CASES, ["as built", "half wave, normal incidence"]))
def test_derivatives_agree(case):
    make, x, y = CASES[case]
    values = np.asarray(values_of(make()))
    point = jnp.asarray(x), jnp.asarray(y)
    ahead = np.asarray(forward_jacobian(jnp.asarray(values), *point))
    assert np.isfinite(ahead).all()
    np.testing.assert_allclose(reverse_jacobian(jnp.asarray(values), *point), ahead, rtol=1e-9, atol=1e-13)
    for i, leaf in enumerate(leaves(TEMPLATE)):
        step = 1e-2 * (leaf.width or leaf.scale)
        sides = []
        for signed in (step, -step, 2 * step, -2 * step):
            moved = values.copy()
            moved[i] += signed
            sides.append(np.asarray(counts(jnp.asarray(moved), *point)))
        # central differences of fourth order
        expected = (8 * (sides[0] - sides[1]) - (sides[2] - sides[3])) / (12 * step)
        size = np.abs(ahead[:, i]).max()
        np.testing.assert_allclose(
            ahead[:, i], expected, rtol=0, atol=1e-7 * size + 1e-12 / step, err_msg=NAMES[i]
        )


def test_every_parameter_moves_the_counts():
    """A parameter that moves nothing would have an error bar of nothing, and a misspelt one is such."""
    values = values_of(TEMPLATE)
    moved = np.abs(forward_jacobian(values, jnp.asarray(0.23), jnp.asarray(-0.26))).max(0)
    assert [name for name, size in zip(NAMES, moved, strict=True) if size < 1e-6] == []
