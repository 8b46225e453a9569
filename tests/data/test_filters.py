"""Built-in filters against published numbers."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.data import BUILTIN_FILTERS, DataError, builtin_filter


def test_sdss_r():
    """Doi et al. 2010: effective wavelength of r about 616.5 nm, half maxima near 559 and 675 nm."""
    curve = builtin_filter("SDSS-r")
    assert curve.name in BUILTIN_FILTERS
    assert curve.wavelength.dtype == np.float64
    assert np.all(np.diff(curve.wavelength) > 0)
    assert (curve.wavelength[0], curve.wavelength[-1]) == pytest.approx((0.5379, 0.7041))
    half = curve.wavelength[curve.throughput > curve.throughput.max() / 2]
    assert half[0] == pytest.approx(0.559, abs=0.003)
    assert half[-1] == pytest.approx(0.675, abs=0.003)
    weight = np.gradient(curve.wavelength) * curve.throughput
    assert np.average(curve.wavelength, weights=weight) == pytest.approx(0.6165, abs=0.003)


def test_unknown_filter():
    with pytest.raises(DataError, match=r"'sdss-r'; did you mean 'SDSS-r'\?"):
        builtin_filter("sdss-r")
    with pytest.raises(DataError, match="known: SDSS-r"):
        builtin_filter("Hα")
