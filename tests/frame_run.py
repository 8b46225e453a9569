"""Runs whose points are those of whole frames: tests share the exposures, and with them what is compiled."""

from __future__ import annotations

from walop_jax.data.grid import Grid
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn


def frame_run(side: int) -> ObservingPlan:
    """Polariser and Moon at side × side points, all in one setting of the instrument."""
    return ObservingPlan(
        grid=side, standard_grid=1, standards=0, unpolarised=0, moon_patches=3,
        polariser_angles=polariser_turn(8, full_turn=True), throughput_degree=2,
    )  # fmt: skip


def raster(plan: ObservingPlan, side: int) -> Grid:
    """The pixels of a square detector over the whole field: the points of a plan whose `grid` is `side`."""
    field = plan.field
    step = 2.0 * field / (side - 1)
    return Grid(side, side, (1.0, 1.0), (-field, -field), ((step, 0.0), (0.0, step)))
