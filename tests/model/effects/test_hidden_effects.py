"""Sets of an independent simulator with effects that are known: fitted, they come out."""

from __future__ import annotations

import pytest

from walop_jax.data.calset import read_calibration_set
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, refit
from walop_jax.model.effects import Context, effect_by_name
from walop_jax.model.effects.in_models import effect_context, with_effects


def fit(path, *names: str, start=()) -> FitResult:
    calset = read_calibration_set(path)
    model = base_model(calset)
    model = with_effects(model, names, effect_context(model.template, calset.exposures))
    for name, value in start:
        model = model.change(name, start=value)
    return refit(calset, model)


@pytest.mark.long
def test_clp_wobble(either_south_set):
    start = (("clp_wobble.amplitude", 0.05), ("clp_wobble.phase", 0.8))
    found = fit(either_south_set("c").path, "clp_wobble", start=start)
    assert abs(found.excess) < 3
    (amplitude, amplitude_error), (phase, phase_error) = (
        found.value(f"clp_wobble.{n}") for n in ("amplitude", "phase")
    )
    effect = effect_by_name("clp_wobble").of(Context(), amplitude=amplitude, phase=phase).standard_form()
    assert abs(float(effect.amplitude) - 0.06) < 3 * amplitude_error
    assert abs(float(effect.phase) - 1.1) < 3 * phase_error


def test_camera_leakage_and_hwp2_axis(either_south_set):
    found = fit(either_south_set("d").path, "camera_leakage", "hwp2_axis")
    assert abs(found.excess) < 3
    for name, truth in (("camera_leakage.share", 0.003), ("hwp2_axis.angle", -0.15)):
        value, sigma = found.value(name)
        assert abs(value - truth) < 3 * sigma, (name, value, sigma)
