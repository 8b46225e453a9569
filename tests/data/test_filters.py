"""Built-in filters against published numbers."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.data.settings import BUILTIN_FILTERS, builtin_filter
from walop_jax.io.errors import DataError

# Doi et al. 2010, AJ 139, 1628, Table 4: wavelength (Å), r without atmosphere, atmospheric transmission.
TABLE_4 = np.array(
    [
        (5380, 0.0002, 0.8557), (5400, 0.0018, 0.8567), (5480, 0.0452, 0.8585), (5500, 0.0751, 0.8589),
        (5600, 0.2979, 0.8611), (5700, 0.4531, 0.8634), (5800, 0.5019, 0.8656), (5900, 0.5212, 0.8736),
        (6000, 0.5323, 0.8815), (6100, 0.5361, 0.8942), (6160, 0.5333, 0.8998), (6180, 0.5333, 0.9017),
        (6200, 0.5358, 0.9036), (6300, 0.5462, 0.9095), (6380, 0.5488, 0.9133), (6400, 0.5480, 0.9142),
        (6500, 0.5450, 0.9190), (6600, 0.5394, 0.9210), (6700, 0.4230, 0.9228), (6800, 0.1212, 0.9246),
        (6860, 0.0370, 0.8804), (6880, 0.0273, 0.8581), (6900, 0.0201, 0.8722), (7000, 0.0036, 0.9298),
        (7040, 0.0003, 0.9305),
    ]
)  # fmt: skip


def test_sdss_r_is_the_published_table():
    """r times the atmosphere, to six significant digits; every 20 Å, zero 1 Å beyond the ends."""
    curve = builtin_filter("SDSS-r")
    assert curve.name in BUILTIN_FILTERS
    assert curve.wavelength.dtype == curve.throughput.dtype == np.float64
    every_20 = np.array([5379, *range(5380, 7041, 20), 7041])
    np.testing.assert_array_equal(curve.wavelength, every_20 * 1e-4)  # Å to µm, to the last bit
    assert curve.throughput[0] == curve.throughput[-1] == 0.0
    published = {int(w): float(f"{r * atmosphere:.6g}") for w, r, atmosphere in TABLE_4}
    assert published == {w: t for w, t in zip(every_20, curve.throughput, strict=True) if w in published}


def test_unknown_filter():
    with pytest.raises(DataError, match=r"'sdss-r'; .*; did you mean 'SDSS-r'\?"):
        builtin_filter("sdss-r")
    with pytest.raises(DataError, match="known: MONO-6500, SDSS-r"):
        builtin_filter("Hα")
