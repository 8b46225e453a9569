"""A plan as an observer rehearses it: planned, simulated, fitted, and a go."""

from __future__ import annotations

from pathlib import Path

import walop_jax as walop
from walop_jax.data.write import write_calibration_set


def test_a_plan_that_is_followed_is_a_go(tmp_path: Path):
    """Without Moon and standards in it `check` found telescope_polarisation, 0.20 %, not measured: no go."""
    could = walop.ObservingPlan(grid=5, standard_grid=2, moon_patches=3, standards=3, unpolarised=1)
    planned = walop.plan(could, minutes=20.0, draws=1)
    assert planned.lacks == ()
    taken, _ = walop.simulate(planned.observing_plan, seed=3)
    write_calibration_set(tmp_path / "night.fits", taken)
    walop.refit(tmp_path / "night.fits", output=tmp_path / "RUN")
    answer = walop.check(tmp_path / "RUN")
    certificate = answer["commissioning"]
    assert answer.go
    assert certificate.failed == ()
    assert certificate.go
    assert {need.what for need in certificate.requirements} >= {"the model explains the data"}
    # Nothing of what `inspect` finds is left open either.
    assert not [need for need in certificate.requirements if need.what == "exposures and errors"]
