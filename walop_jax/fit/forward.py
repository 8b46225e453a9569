"""The forward model of a calibration set, or of an observing plan, for programs of one's own."""

from __future__ import annotations

from walop_jax.data.records import CalibrationSet
from walop_jax.fit.base_model import base_model
from walop_jax.likelihood.forward import WHAT, Forward
from walop_jax.model.compiled import need_float64
from walop_jax.model.specification import Model
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import as_planned


def forward(calset: CalibrationSet | ObservingPlan, model: Model | None = None) -> Forward:
    """Counts, residuals and posterior density of a calibration set as differentiable functions of the parameters.

    Each function is compiled at its first call (seconds) and runs in milliseconds from the second call on; it composes
    with `jax.jit`, `grad` and `vmap`. Values are in float64, others are refused.

    `model` is the base model of the set where it is None. A plan stands for the set that the instrument as designed
    would give, without noise and with the errors that its counts would have. Raises as `base_model` does, and
    RuntimeError when float64 is switched off.

    >>> forward = walop.forward(calset)
    >>> bool(forward.log_density(forward.start) < forward.log_density(result.values))
    True
    """
    need_float64(WHAT)
    if isinstance(calset, ObservingPlan):
        calset = as_planned(calset)
    return Forward.of(calset, base_model(calset) if model is None else model)
