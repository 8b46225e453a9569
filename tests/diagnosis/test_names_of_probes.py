"""Names of the probes of an effect: what a reader can look at, no number of a list."""

from __future__ import annotations

import re

import effect_scenes as scenes

from walop_jax.diagnosis.hypotheses import probes
from walop_jax.model.effects import EFFECTS


def test_a_probe_is_called_by_its_place_and_choice():
    """Camera and centre of a spot, the gap of an etalon, the star of an outlier; typed by hand."""
    names = [probe.name for probe in probes(EFFECTS, scenes.CONTEXT)]
    assert len(set(names)) == len(names)
    assert not [name for name in names if re.search(r"#|number \d", name)]
    for name in (
        "hwp1_axis",
        "blemish (camera O1, x −0.25 deg, y 0.05 deg)",
        "blemish (camera E2, x 0.25 deg, y 0.25 deg)",
        "etalon (gap 1.75 um)",
        "camera_gain_drift (camera O1)",
        "hwp1_axis_cut (crystal mgf2)",
        "standard_outlier (source blue_star)",
    ):
        assert name in names
