"""Sets of an independent simulator with effects that are known: fitted, they come out."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.data.calset import read_calibration_set
from walop_jax.fit.base_model import base_model
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Context, Effect, effect_by_name
from walop_jax.model.specification import effect_context, with_effects


def fit(path, *names: str, start=()):
    """Gauss–Newton by hand: values and errors by name, χ², degrees of freedom."""
    calset = read_calibration_set(path)
    model = base_model(calset)
    context = effect_context(model.template, calset.exposures)
    effects: list[Effect] = [effect_by_name(name).of(context) for name in names]
    model = with_effects(model, effects, context)
    for name, value in start:
        model = model.change(name, start=value)
    likelihood, values, free = Likelihood.of(calset, model), model.start, model.free
    scale = np.array([model.parameters[i].scale for i in free])
    for _ in range(8):
        here = likelihood.expand(values)
        step = scale * np.linalg.solve(here.matrix * scale * scale[:, None], here.gradient * scale)
        values = model.full(values[free] - step)
    here = likelihood.expand(values)
    sigma = np.zeros(len(values))
    sigma[free] = np.sqrt(np.diag(np.linalg.inv(here.matrix)))
    found = {name: (values[i], sigma[i]) for i, name in enumerate(model.names)}
    return found, here.chi2, here.dof


@pytest.mark.long
def test_clp_wobble(either_south_set):
    start = (("clp_wobble.amplitude", 0.05), ("clp_wobble.phase", 0.8))
    found, chi2, dof = fit(either_south_set("c").path, "clp_wobble", start=start)
    assert chi2 == pytest.approx(dof, abs=3 * np.sqrt(2 * dof))
    (amplitude, amplitude_error), (phase, phase_error) = (
        found[f"clp_wobble.{n}"] for n in ("amplitude", "phase")
    )
    effect = effect_by_name("clp_wobble").of(Context(), amplitude=amplitude, phase=phase).standard_form()
    assert abs(float(effect.amplitude) - 0.06) < 3 * amplitude_error
    assert abs(float(effect.phase) - 1.1) < 3 * phase_error


def test_camera_leakage_and_hwp2_axis(either_south_set):
    found, chi2, dof = fit(either_south_set("d").path, "camera_leakage", "hwp2_axis")
    assert chi2 == pytest.approx(dof, abs=3 * np.sqrt(2 * dof))
    for name, truth in (("camera_leakage.share", 0.003), ("hwp2_axis.angle", -0.15)):
        value, sigma = found[name]
        assert abs(value - truth) < 3 * sigma, (name, value, sigma)
