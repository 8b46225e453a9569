"""What a light path depends on is found, not declared: a fit has the derivatives of its model, whatever is added."""

from __future__ import annotations

from typing import ClassVar

import effect_scenes as scenes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.likelihood import engine
from walop_jax.model import light, mueller
from walop_jax.model.compiled import compiled
from walop_jax.model.dependence import needs, optical_indices
from walop_jax.model.effects import EFFECTS, EffectKind, FreeForm, effect_by_name
from walop_jax.model.effects.base import Effect, Scalar
from walop_jax.model.elements.base import Element
from walop_jax.model.elements.simple import Retarder
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import leaves, number, param, values_of, with_values
from walop_jax.model.ray import NotPlannedError, Ray

# ------------------------------------------------------------------- effects that the package has never heard of


class TiltedPlate(Effect):
    """Turns a plate: its parameter enters the optics, and nothing says so."""

    angle: Scalar = param(unit="deg", about="a turn", source="this test", width=0.3, default=0.0)
    name: ClassVar[str] = "tilted_plate"

    def patch(self, instrument: Instrument) -> Instrument:
        return instrument.changed("half1.plate", axis=lambda axis: axis + self.angle)


class WarmGlass(Element):
    """A retarder that grows with temperature: asks the ray for it, and nothing says so."""

    rate: Scalar = number(unit="rad", about="retardance per kelvin")

    def mueller(self, ray: Ray) -> jax.Array:
        return mueller.retarder(self.rate * (ray.conditions.temperature - 10.0), jnp.deg2rad(30.0))


class WarmWindow(Effect):
    """A window behind the collimator that is birefringent away from 10 °C, at 30°."""

    rate: Scalar = param(
        unit="rad", about="retardance per kelvin", source="this test", width=0.01, default=0.0
    )
    name: ClassVar[str] = "warm_window"

    def patch(self, instrument: Instrument) -> Instrument:
        return instrument.inserted(WarmGlass(name="window", rate=self.rate), before="pupil")


# -------------------------------------------------------------- derivatives of a fit against those of its formula


def away_from_neutral(kind: EffectKind, rng: np.random.Generator) -> Effect:
    """An effect whose every parameter matters: amplitudes of some prior widths, shapes as in its first probe."""
    neutral = kind.neutral(scenes.CONTEXT)
    probe = next((group[0] for group in kind.probes(scenes.CONTEXT)), neutral)
    values = {}
    for name, declaration in kind.numbers().items():
        value = np.asarray(getattr(probe, name))
        size = declaration.width or declaration.scale or 0.0
        values[name] = jnp.asarray(value + size * rng.uniform(0.5, 1.5, value.shape))
    return probe.replaced(**values)


def measured(*effects: Effect) -> tuple[Instrument, object, engine.PointData]:
    """Counts of an instrument at unknown fluxes, off its model by a hundredth: no residual is zero."""
    device, layout = scenes.instrument(*effects), scenes.plan(effects)
    data, rng = scenes.points(layout), np.random.default_rng(2)
    flux = rng.uniform(2e5, 6e5, (2, 9, 1))
    flux[:, 8] = 1.0
    counts = np.asarray(
        engine.detected(
            device, layout.exposures, flux * engine.prediction(device, layout, data), data.x, data.y
        )
    )
    counts = counts * (1.0 + 0.01 * rng.standard_normal(counts.shape))
    weight = 1.0 / np.sqrt(counts + 900.0)
    weight[1, 3] = 0.0  # a row that is not used
    return device, layout, data._replace(counts=jnp.asarray(counts), weight=jnp.asarray(weight))


def formula(template: Instrument, values, flux, layout, data):
    """Counts (point, exposure, camera) from parameters and fluxes, as they are defined."""
    device = with_values(template)(values)
    electrons = flux[..., None] * jax.vmap(engine.point_prediction, (None, None, 0))(device, layout, data)
    return jax.vmap(light.detected, (None, None, 0, 0, 0))(
        device, layout.exposures, electrons, data.x, data.y
    )


@compiled
def by_flux(template, values, flux, layout, data):
    """Counts, and their derivative with respect to the flux of each exposure."""
    return jax.jvp(lambda f: formula(template, values, f, layout, data), (flux,), (jnp.ones_like(flux),))


@compiled
def by_parameters(template, values, flux, layout, data):
    """Derivative of the counts with respect to all parameters at fixed flux, forwards."""
    return jax.jacfwd(lambda v: formula(template, v, flux, layout, data))(values)


def expected_jacobian(device: Instrument, layout, data: engine.PointData) -> np.ndarray:
    """−(1 − â âᵀ) dN σ⁻¹ at the best flux, â along ∂N/∂F: flux found and eliminated here, in numpy."""
    values, measured, weight = values_of(device), np.asarray(data.counts), np.asarray(data.weight)
    known = np.asarray(layout.exposures.flux_known)
    flux = np.ones(measured.shape[:2])
    for _ in range(30):
        counts, along = (np.asarray(v) for v in by_flux(device, values, jnp.asarray(flux), layout, data))
        y, a = (measured - counts) * weight, along * weight
        power = np.sum(a**2, axis=-1)
        step = np.sum(y * a, axis=-1) / np.where(power > 0, power, 1.0)
        flux = np.where(known, 1.0, flux + step)
    d = np.asarray(by_parameters(device, values, jnp.asarray(flux), layout, data)) * weight[..., None]
    out = np.zeros_like(d)
    for p, e in np.ndindex(flux.shape):
        row = a[p, e]
        out[p, e] = -d[p, e]
        if not known[e] and row.any():
            out[p, e] += np.outer(row, row @ d[p, e]) / (row @ row)
    return out.reshape(len(flux), -1, len(values))


def check_jacobian(*effects: Effect) -> tuple[list[str], np.ndarray]:
    """All columns of the derivative that a fit uses, each to 1e-9 of its largest element; names and sizes."""
    device, layout, data = measured(*effects)
    expected = expected_jacobian(device, layout, data)
    found = np.asarray(engine.linearised_residuals(device, layout, data)[1])
    size = np.abs(expected).max(axis=(0, 1))
    off = np.abs(found - expected).max(axis=(0, 1))
    names = [leaf.name for leaf in leaves(device)]
    wrong = [f"{name}: {o / s:.1e}" for name, o, s in zip(names, off, size, strict=True) if o > 1e-9 * s]
    assert wrong == []
    return names, size


# Effects are looked at in company: what one of them asks for must not hide what another one needs.
GROUPS = {
    "sky and polariser": (
        "moon_multiple_scattering", "moon_patch", "rotator_zero", "standard_outlier", "standard_values",
        "standard_colour", "standard_drift", "standard_angles", "standard_degrees", "telescope_polarisation",
        "clp_zero", "clp_wobble", "clp_extinction", "clp_ellipticity",
    ),
    "lenses and calibration plate": (
        "lens_birefringence", "upstream_retarder", "chwp_in_beam", "chwp_axis", "chwp_thickness",
    ),
    "field and band": ("flexure", "filter_shift", "wollaston_axis"),
    "plates": ("etalon", "hwp1_axis", "hwp2_axis", "hwp1_crossing", "hwp2_crossing"),
    "temperature and cuts": ("hwp_temperature", "hwp1_axis_cut", "hwp2_axis_cut"),
    "cameras": ("blemish", "camera_leakage", "ghost"),
    "detectors": ("pedestal", "nonlinearity", "camera_gain_drift"),
    "no name": ("free_form",),
}  # fmt: skip


def test_every_effect_is_in_a_group():
    known, listed = (
        {kind.name for kind in (*EFFECTS, FreeForm)},
        {name for group in GROUPS.values() for name in group},
    )
    assert known - listed == set(), f"add {sorted(known - listed)} to a group of GROUPS in {__file__}"
    assert listed - known == set(), f"no effect has these names: take them out of GROUPS in {__file__}"


@pytest.mark.long
@pytest.mark.parametrize("group", GROUPS)
def test_a_fit_has_the_derivatives_of_its_formula(group):
    """Every parameter of the base model and of every effect; none of them is without influence, but two."""
    rng = np.random.default_rng(3)
    names, size = check_jacobian(*(away_from_neutral(effect_by_name(n), rng) for n in GROUPS[group]))
    without = {name.partition(".")[0] for name, s in zip(names, size, strict=True) if not s > 0}
    # The standards of the scene are seen once each, in one filter: tests/model/test_standards.py has what changes them.
    assert without <= {"standard_colour", "standard_drift"}


@pytest.mark.long
def test_an_effect_that_declares_nothing_has_derivatives_and_is_fitted():
    """A turn of 0.05° in the counts is found where it is, though nobody said that it enters the optics."""
    names, _ = check_jacobian(TiltedPlate(angle=jnp.asarray(0.2)))
    truth = scenes.instrument(TiltedPlate(angle=jnp.asarray(0.05)))
    start = scenes.instrument(TiltedPlate(angle=jnp.asarray(0.0)))
    layout = scenes.plan(start.effects)
    data = scenes.points(layout)
    flux = np.where(np.asarray(layout.exposures.flux_known), 1.0, scenes.FLUX)[:, None]
    counts = flux * np.asarray(engine.prediction(truth, layout, data))
    data = data._replace(counts=jnp.asarray(counts), weight=jnp.asarray(1.0 / np.sqrt(counts)))
    column = np.asarray(engine.linearised_residuals(start, layout, data)[1])[
        ..., names.index("tilted_plate.angle")
    ]
    residual = np.asarray(engine.residuals(start, layout, data)[1]).reshape(column.shape)
    # Everything else is held: one step of Gauss and Newton, exact to second order in 0.05°.
    assert -np.sum(column * residual) / np.sum(column**2) == pytest.approx(0.05, rel=2e-3)


# ----------------------------------------------------------------------------- what the optics ask for


def test_optics_that_ask_for_the_temperature_get_it():
    """4 °C in the first exposure, 10 °C in all others: a window of −6 rate there, and none elsewhere."""
    window = WarmWindow(rate=jnp.asarray(0.01))
    assert needs(scenes.instrument(window)).conditions == {"temperature"}
    plain, found = scenes.observe(), scenes.observe(window)

    class Fixed(WarmWindow):
        def patch(self, instrument: Instrument) -> Instrument:
            element = Retarder(name="window", delta=jnp.asarray(-0.06), axis=jnp.asarray(30.0))
            return instrument.inserted(element, before="pupil")

    with_window = scenes.observe(Fixed(rate=jnp.asarray(0.0)))
    assert np.abs(with_window[:, 0] - plain[:, 0]).max() > 1e-3 * scenes.FLUX
    np.testing.assert_allclose(found[:, 0], with_window[:, 0], rtol=1e-11)
    np.testing.assert_allclose(found[:, 1:], plain[:, 1:], rtol=1e-11)


def test_what_the_optics_ask_for_has_derivatives():
    names, size = check_jacobian(WarmWindow(rate=jnp.asarray(0.01)))
    assert size[names.index("warm_window.rate")] > 0


@pytest.mark.parametrize(
    ("effect", "quantity"),
    [
        (WarmWindow(rate=jnp.asarray(0.01)), "temperature"),
        (effect_by_name("flexure").neutral(scenes.CONTEXT), "hour_angle"),
    ],
    ids=["temperature", "hour angle"],
)
def test_a_plan_for_another_instrument_is_refused_with_advice(effect, quantity):
    layout = scenes.plan()
    with pytest.raises(NotPlannedError, match=f"'{quantity}'.*make the plan with `plan_for`") as caught:
        scenes.counts(scenes.instrument(effect), layout, scenes.points(layout))
    assert caught.value.quantity == quantity


ASKED = {"flexure": {"hour_angle"}, "hwp_temperature": {"temperature"}}
MEDIAN = {"pedestal"}
FRINGES = {"etalon": 120.0}  # µm: there and back through the largest gap, 60 µm


@pytest.mark.parametrize("kind", [*EFFECTS, FreeForm], ids=lambda kind: kind.name)
def test_what_an_effect_asks_for(kind):
    found = needs(scenes.instrument(kind.neutral(scenes.CONTEXT)))
    assert found.conditions == ASKED.get(kind.name, set())
    assert found.median == (kind.name in MEDIAN)
    assert found.path_difference == FRINGES.get(kind.name, 0.0)


# ------------------------------------------------------------------------ which parameters enter the optics

BASE = [
    "pupil.magnification", "pupil.distortion", "chwp.quartz", "chwp.mgf2",
    *(f"half{h}.{n}" for h in (1, 2) for n in ("plate.quartz", "plate.mgf2", "wedge")),
]  # fmt: skip
OPTICAL = {
    "chwp_axis": ["angle"],
    "chwp_thickness": ["mgf2", "quartz"],
    "flexure": ["rate_x", "rate_y"],
    "filter_shift": ["wavelength"],
    "etalon": ["contrast", "gap"],
    "hwp_temperature": ["coefficient"],
    **{f"hwp{h}_{what}": ["angle"] for h in (1, 2) for what in ("axis", "crossing", "axis_cut")},
    "wollaston_axis": ["angle"],
}


def optical_names(instrument: Instrument) -> list[str]:
    every = leaves(instrument)
    return [every[i].name for i in optical_indices(instrument)]


@pytest.mark.parametrize("kind", [*EFFECTS, FreeForm], ids=lambda kind: kind.name)
def test_no_more_enters_the_optics_than_has_to(kind):
    """What acts behind the polariser but ahead of the pupil, and in the cameras, costs no optics."""
    found = optical_names(scenes.instrument(kind.neutral(scenes.CONTEXT)))
    own = [f"{kind.name}.{name}" for name in OPTICAL.get(kind.name, [])]
    assert set(found) - {*BASE, *own} == set(), (
        f"is that needed? then add these numbers to OPTICAL in {__file__}"
    )
    assert {*BASE, *own} - set(found) == set(), (
        f"these enter no optics: take them out of OPTICAL in {__file__}"
    )
    assert len(found) == len(set(found))


def test_effects_that_nobody_knows_enter_the_optics():
    found = optical_names(scenes.instrument(TiltedPlate(), WarmWindow()))
    # A window that asks for the temperature stands in the band integral, and with it all that stands behind it.
    assert {"tilted_plate.angle", "warm_window.rate"} <= set(found)
