"""Names of standard stars in the names of parameters: each its own, whatever the catalogue calls them."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.data.records import Sources
from walop_jax.model.standards import standard_names


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["HD 1", "HD 2"], ("HD_1", "HD_2")),
        (["A", "A"], ("A", "A_1")),
        (["A_2", "A", "A"], ("A_2", "A", "A_2_2")),
        (["A", "A", "A_1", "A_1_1"], ("A", "A_1_1_1", "A_1", "A_1_1")),
        (["", " "], ("source0", "source1")),
        (["A+1", "A-1", "A 1"], ("A_1", "A_1_1", "A_1_2")),
    ],
)
def test_every_star_has_a_name_of_its_own(given, expected):
    none = np.zeros(len(given))
    names = standard_names(Sources(np.arange(len(given)), np.array(given), none, none, none, none, none))
    assert names == expected
    assert len(set(names)) == len(given)
