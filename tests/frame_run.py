"""Runs whose points are those of whole frames: tests share the exposures, and with them what is compiled."""

from __future__ import annotations

from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn


def frame_run(side: int) -> ObservingPlan:
    """Polariser and Moon at side × side points, all in one setting of the instrument."""
    return ObservingPlan(
        grid=side, standard_grid=1, standards=0, unpolarised=0, moon_patches=3,
        polariser_angles=polariser_turn(8, full_turn=True), throughput_degree=2,
    )  # fmt: skip
