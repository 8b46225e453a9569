"""WALOP-North as described, against transmissions of its optical design (made by another program, not shipped).

The 49 linear states of a field point and wavelength are reduced to the analysis vector of each camera by least
squares; the description must give their ratios without a fit.
"""

import numpy as np
import pytest
from astropy.io import fits

from walop_jax.model.instrument import nominal_instrument

NAME = "walop_north_design.fits"
EVERY = 5  # field points


@pytest.fixture(scope="module")
def measured(shared_data):
    """x, y (deg), wavelengths (um) and analysis vectors (point, wavelength, camera, Stokes)."""
    path = shared_data / NAME
    if not path.is_file():
        pytest.skip(f"{NAME} is not there")
    with fits.open(path) as hdus:
        exposures, points, rows, filters = (hdus[i].data for i in (1, 2, 3, 4))
        names = [name.strip() for name in filters["FILTER"]]
        curve = dict(zip(names, (float(np.ravel(w)[0]) for w in filters["WAVELENGTH"]), strict=True))
        wavelength = np.array([curve[name.strip()] for name in exposures["FILTER"]])
        counts = np.zeros((len(exposures), len(points), 4))
        number = {int(e): i for i, e in enumerate(exposures["EXPOSURE"])}
        place = {int(p): i for i, p in enumerate(points["POINT"])}
        counts[[number[int(e)] for e in rows["EXPOSURE"]], [place[int(p)] for p in rows["POINT"]]] = rows["N"]
        colours = np.unique(wavelength)
        vectors = []
        for colour in colours:
            chosen = (wavelength == colour) & np.asarray(exposures["CLP_IN"], bool)
            twice = 2 * np.deg2rad(np.asarray(exposures["CLP_ANGLE"][chosen], float))
            states = np.stack([np.ones_like(twice), np.cos(twice), np.sin(twice)], axis=1)
            found = np.linalg.lstsq(states, counts[chosen].reshape(len(twice), -1), rcond=None)[0]
            vectors.append(found.reshape(3, len(points), 4).transpose(1, 2, 0))
        x, y = (np.array(points[name], float) for name in "XY")
    return x, y, colours, np.stack(vectors, axis=1)


def ratios(vectors):
    """m22, m23, m32, m33 of analysis vectors (…, camera, Stokes)."""
    halves = []
    for first, second in ((0, 1), (2, 3)):
        total = vectors[..., first, 0] + vectors[..., second, 0]
        difference = vectors[..., first, 1:] - vectors[..., second, 1:]
        halves.append(difference / total[..., None])
    return np.concatenate(halves, axis=-1)


def predicted(x, y, colours):
    """m22, m23, m32, m33 (point, wavelength, 4) of the description, with the calibration plate in at 0 deg."""
    import jax
    import jax.numpy as jnp

    from walop_jax.model.compiled import compiled
    from walop_jax.model.ray import Conditions, Ray

    north = nominal_instrument("WALOP-NORTH")

    def through(elements, ray, matrix):
        for element in elements:
            own = element.solved([(element, ray)])[0]
            matrix = matrix if own is None else own @ matrix
            ray = element.ray(ray)
        return matrix, ray

    def rows(x, y):
        ray = Ray.entering(x, y, (jnp.array(colours), Conditions(jnp.zeros(()), {})))
        common, ray = through(list(north.train())[1:], ray, jnp.eye(4))
        parts = []
        for arm in north.arms:
            matrix, _ = through(arm.train(), ray, common)
            seen = arm.analyser.seen(matrix)
            parts.append(arm.analyser.efficiency * seen[:, 1, 1:3] / seen[:, 0, :1])
        return jnp.concatenate(parts, axis=-1)

    return np.asarray(compiled(jax.vmap(rows))(jnp.array(x), jnp.array(y)))


def test_matrix_of_the_description_is_that_of_the_design(measured):
    x, y, colours, vectors = measured
    difference = predicted(x[::EVERY], y[::EVERY], colours) - ratios(vectors[::EVERY])
    rms = np.sqrt(np.mean(difference**2, axis=(0, 1)))
    assert np.sqrt(np.mean(difference**2)) < 0.001
    assert np.all(rms < [0.0003, 0.001, 0.0012, 0.0012])
