"""What must not matter does not: the order of rows, points and exposures, how a row is left out, the unit of light."""

from __future__ import annotations

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from walop_jax.data.calset import read_calibration_set
from walop_jax.science.estimate import estimate

QUICK = settings(
    max_examples=15,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
FEW = settings(QUICK, max_examples=4)  # files are written and read
FIELDS = ("counts", "sigma", "used", "source")


def by_identifier(calset):
    """The content of a set by identifiers of exposures and points, in their order."""
    block = calset.intensities.block(0, len(calset.points))
    p, e = np.argsort(calset.points.point), np.argsort(calset.exposures.exposure)
    found = {name: getattr(block, name)[p][:, e] for name in FIELDS}
    found |= {"x": block.x[p], "y": block.y[p]}
    return found | {name: values[e] for name, values in calset.exposures.columns().items()}


def equal(one, other):
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)


@FEW
@given(data=st.data())
def test_the_order_of_rows_changes_nothing(handmade, data):
    plain = by_identifier(read_calibration_set(handmade.write()))
    shuffled = handmade.copy()
    for name in ("EXPOSURES", "POINTS", "INTENSITIES"):
        rows = len(next(iter(shuffled[name].values()))[2])
        order = np.array(data.draw(st.permutations(range(rows)), label=name))
        for entry in shuffled[name].values():
            entry[2] = entry[2][order]
    equal(plain, by_identifier(read_calibration_set(shuffled.write("shuffled.fits"))))


@FEW
@given(rows=st.sets(st.integers(0, 23), max_size=12), bit=st.sampled_from([1, 2, 4, 8, 16]))
def test_a_row_that_is_flagged_is_as_good_as_removed(handmade, rows, bit):
    chosen = np.array(sorted(rows), int)
    flagged, removed = handmade.copy(), handmade.copy()
    flagged.values("INTENSITIES", "FLAG")[chosen] = bit
    flagged.values("INTENSITIES", "N")[chosen] = -7.0  # whatever stands there
    for entry in removed["INTENSITIES"].values():
        entry[2] = np.delete(entry[2], chosen, axis=0)
    one = by_identifier(read_calibration_set(flagged.write("flagged.fits")))
    equal(one, by_identifier(read_calibration_set(removed.write("removed.fits"))))


ANALYSERS = np.array([[1.0, 0.96, 0.05], [1.1, -1.02, -0.03], [0.9, 0.02, 0.85], [1.05, -0.04, -0.99]])


def rows_of_a_star(seed, number):
    draw = np.random.default_rng(seed)
    q, u = draw.uniform(-0.1, 0.1, 2)
    flux = draw.uniform(1e5, 1e6, number)
    turned = ANALYSERS * draw.uniform(0.97, 1.03, (number, 4, 3))
    return (q, u), turned, flux[:, None] * (turned @ [1.0, q, u]), draw


@QUICK
@given(seed=st.integers(0, 1000), number=st.integers(1, 6), factor=st.floats(1e-3, 1e6))
def test_counts_and_errors_in_another_unit_change_the_flux_alone(seed, number, factor):
    _, vectors, counts, draw = rows_of_a_star(seed, number)
    sigma, star = np.sqrt(counts), np.zeros(number, int)
    counts = counts + sigma * draw.standard_normal(counts.shape)
    one = estimate(vectors, counts, sigma, star)
    other = estimate(vectors, factor * counts, factor * sigma, star)
    np.testing.assert_allclose(other.qu, one.qu, rtol=0, atol=1e-11)
    np.testing.assert_allclose(other.photon, one.photon, rtol=1e-9)
    np.testing.assert_allclose(other.flux, factor * one.flux, rtol=1e-9)
    np.testing.assert_allclose(other.chi2, one.chi2, rtol=1e-7)


@QUICK
@given(seed=st.integers(0, 1000), number=st.integers(1, 6), data=st.data())
def test_the_order_of_rows_and_cameras_of_a_star_changes_nothing_and_noiseless_data_give_the_truth(
    seed, number, data
):
    truth, vectors, counts, _ = rows_of_a_star(seed, number)
    rows = list(data.draw(st.permutations(range(number)), label="rows"))
    cameras = list(data.draw(st.permutations(range(4)), label="cameras"))
    sigma, star = np.sqrt(counts), np.zeros(number, int)
    one = estimate(vectors, counts, sigma, star)
    pick = np.ix_(rows, cameras)
    other = estimate(vectors[pick], counts[pick], sigma[pick], star)
    np.testing.assert_allclose(one.qu[0], truth, rtol=0, atol=1e-12)
    np.testing.assert_allclose(other.qu, one.qu, rtol=0, atol=1e-12)
    np.testing.assert_allclose(other.photon, one.photon, rtol=1e-10)
