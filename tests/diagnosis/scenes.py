"""The observation that tests of this room simulate: what is compiled for one of them serves all."""

from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn

PLAN = ObservingPlan(
    grid=6, standard_grid=2, polariser_angles=polariser_turn(12), moon_patches=4, standards=4
)
