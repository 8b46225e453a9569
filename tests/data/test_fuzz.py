"""Damage a byte of a valid file: a typed error or the same answer, never another answer.

One byte, because that is what FITS checksums promise: two changes that cancel in a sum of 32-bit words (the
same bit of two words, once up and once down) are beyond any reader of such files.
"""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from walop_jax.data.calset import read_calibration_set
from walop_jax.io.errors import DataError


def same(one, other):
    for part in ("exposures", "points", "sources"):
        a, b = (
            entry.exposures.columns() if part == "exposures" else dataclasses.asdict(getattr(entry, part))
            for entry in (one, other)
        )
        assert a.keys() == b.keys()
        for name in a:
            assert a[name].dtype.kind == b[name].dtype.kind
            np.testing.assert_array_equal(a[name], b[name])
    assert (one.instrument, one.site, one.origin) == (other.instrument, other.site, other.origin)
    assert one.filters.keys() == other.filters.keys()
    for name, curve in one.filters.items():
        np.testing.assert_array_equal(curve.throughput, other.filters[name].throughput)
    a, b = (dataclasses.asdict(entry.intensities.block(0, len(entry.points))) for entry in (one, other))
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])


@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_damaged_byte(handmade, data):
    path = handmade.write()
    good = read_calibration_set(path)
    content = bytearray(path.read_bytes())
    # Half of the flips go to the headers' letters, where a file keeps its meaning.
    places = st.one_of(
        st.integers(0, len(content) - 1),
        st.sampled_from([n for n, byte in enumerate(content) if 32 < byte < 127]),
    )
    change = st.one_of(st.sampled_from([1 << bit for bit in range(8)]), st.integers(1, 255))
    content[data.draw(places, label="place")] ^= data.draw(change, label="change")
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            damaged = read_calibration_set(path)
        except DataError:
            return
    same(good, damaged)
