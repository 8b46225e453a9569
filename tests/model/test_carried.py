"""What is put into counts reaches the product of a calibration at the same size, or is named as left behind."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import builders
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import quick

from walop_jax.calibration.matrix import matrices, sky_vectors
from walop_jax.data.records import Sources
from walop_jax.data.settings import Settings
from walop_jax.likelihood import engine
from walop_jax.model import dependence, light, mueller
from walop_jax.model.cameras import DetectorPart
from walop_jax.model.effects import EFFECTS, FreeForm, effect_by_name
from walop_jax.model.effects.base import Context, Effect, Scalar
from walop_jax.model.elements.base import Element
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.parameters import number, param, values_of
from walop_jax.model.plan import with_median
from walop_jax.model.planning import plan_for, plan_for_settings
from walop_jax.model.ray import Ray

# Stars of known (q, u), from which the linear coefficients of each camera follow exactly.
STARS = (("none", 0.0, 0.0), ("q", 0.5, 0.0), ("u", 0.0, 0.5))
CONTEXT = Context(exposures=6, moon=(0,), moon_ids=(0,), sources=tuple(s[0] for s in STARS))
BUILT = builders.south(np.random.default_rng(5))
BASE = BUILT.with_source(nominal_instrument(standards=STARS).standard)
CURVE = builders.curve([0.59, 0.62, 0.65], [1.0, 1.0, 1.0])
TEMP, HA = 4.0, -2.0
X, Y = np.array([0.21, -0.13]), np.array([-0.17, 0.08])
FLUX = 6e5
PLATE = 22.5  # deg: angle of the calibration plate in the second half of the exposures
SOURCE = np.array([0, 1, 2, 0, 1, 2])

# ------------------------------------------------------------------------------------------ both sides of it


def instrument(*effects: Effect) -> Instrument:
    return dataclasses.replace(BASE, effects=effects)


def star_counts(*effects: Effect) -> np.ndarray:
    """Simulated counts (point, exposure, camera) of the stars, plate out and in, hours after the first exposure."""
    device = instrument(*effects)
    common = {"kind": "standard", "rotator": 0.0, "temp": TEMP, "ha": HA}
    rows = [common, common, common, *(common | {"chwp_angle": PLATE, "mjd": 61044.0} for _ in range(3))]
    nan = np.full(3, np.nan)
    stars = Sources(np.arange(3), np.array([s[0] for s in STARS]), nan, nan, nan, nan, nan)
    plan = plan_for(device, builders.exposures(*rows), {"band": CURVE}, stars)
    plan = with_median(plan, np.full((6, 4), 2e5) * np.array([1.0, 1.1, 0.9, 1.2]))
    n, e = len(X), len(rows)
    sky = jnp.zeros((n, e, 2))
    data = engine.PointData(
        x=jnp.asarray(X), y=jnp.asarray(Y), counts=jnp.zeros((n, e, 4)), weight=jnp.ones((n, e, 4)), sky=sky,
        source=jnp.asarray(np.broadcast_to(SOURCE, (n, e))),
        band=jnp.asarray(np.broadcast_to(plan.band_of[np.arange(e), SOURCE + 1], (n, e))), opposite_sky=sky,
    )  # fmt: skip
    return np.asarray(
        engine.detected(device, plan.exposures, FLUX * engine.prediction(device, plan, data), data.x, data.y)
    )


def matrix_of_counts(counts: np.ndarray) -> np.ndarray:
    """(point, plate, 6): difference over sum of each pair, linear coefficients from the three stars."""
    none, q, u = np.moveaxis(counts.reshape(len(X), 2, 3, 4), 2, 0)
    response = np.stack([none, (q - none) / 0.5, (u - none) / 0.5], axis=-1)  # (point, plate, camera, 3)
    rows = [
        (response[..., a, :] - response[..., b, :]) / (response[..., a, :1] + response[..., b, :1])
        for a, b in ((0, 1), (2, 3))
    ]
    return np.concatenate(rows, axis=-1)


def settings(plate: np.ndarray) -> Settings:
    n = len(plate)
    return Settings(
        filter=np.full(n, "band"), teff=np.full(n, np.nan), temperature=np.full(n, TEMP),
        hour_angle=np.full(n, HA), positions={"CHWP": plate},
    )  # fmt: skip


def product(*effects: Effect) -> np.ndarray:
    """(point, plate, 6): what a calibration with these effects says of the instrument."""
    device = instrument(*effects)
    plan = plan_for_settings(device, settings(np.array([np.nan, PLATE])), {"band": CURVE})
    vectors = sky_vectors(device, plan, X, Y)[:, np.asarray(plan.band_of)[:, 0]]
    found = light.instrument_matrix(jnp.asarray(vectors), device.cameras.pairs)
    return np.asarray(found).reshape(len(X), 2, -1)


def with_errors(*effects: Effect) -> np.ndarray:
    """The same by the way that gives errors as well, whose derivatives take long to compile."""
    device = instrument(*effects)
    nothing = np.zeros((values_of(device).size,) * 2)
    plates = settings(np.tile([np.nan, PLATE], len(X)))
    found = matrices(device, plates, {"band": CURVE}, np.repeat(X, 2), np.repeat(Y, 2), nothing)[0]
    return found.reshape(len(X), 2, -1)


def make(name: str, **values) -> Effect:
    return effect_by_name(name).of(CONTEXT, **values)


# ----------------------------------------------------------------------------------------- every effect once

# Effects in company: the others of a group are there at neutral, so that one compilation serves all of it.
IN_THE_PRODUCT = (
    {
        "telescope_polarisation": {"q": 0.004, "u": -0.003},
        "lens_birefringence": {"delta": 0.02},
        "upstream_retarder": {"delta": 0.05, "axis": 20.0},
        "chwp_axis": {"angle": 0.5},
        "chwp_thickness": {"mgf2": 3.0, "quartz": -2.0},
        "flexure": {"rate_x": 0.01, "rate_y": -0.005},
        "filter_shift": {"wavelength": 0.004},
    },
    {
        "etalon": {"contrast": 0.01, "gap": 8.0},
        "hwp_temperature": {"coefficient": 1.0},
        "hwp1_axis": {"angle": 0.5},
        "hwp2_axis": {"angle": 0.5},
        "hwp1_crossing": {"angle": 0.5},
        "hwp2_crossing": {"angle": 0.5},
        "hwp1_axis_cut": {"angle": 0.5},
        "hwp2_axis_cut": {"angle": 0.5},
    },
    {
        "wollaston_axis": {"angle": 0.5},
        "blemish": {"camera": 2, "x": 0.2, "y": -0.15, "size": 0.06, "depth": 0.03},
        "camera_leakage": {"share": 0.01},
    },
    {"chwp_in_beam": {}},
)
OF_THE_SOURCE = {  # and of the polariser: no part of what is said of the instrument
    "moon_multiple_scattering": {"p": 0.02},
    "moon_patch": {"q": 0.01, "u": 0.01},
    "rotator_zero": {"angle": 2.0},
    "standard_outlier": {"source": "q", "q": 0.02},
    "standard_values": {"q": [0.02, -0.01, 0.01], "u": [0.01, 0.03, 0.0]},
    "standard_colour": {"source": "q", "q": 0.02},
    "standard_drift": {"source": "q", "q": 0.02},
    "standard_angles": {"angle": 1.0},
    "standard_degrees": {"share": 0.05},
    "clp_zero": {"angle": 1.0},
    "clp_wobble": {"amplitude": 0.3, "phase": 0.4},
    "clp_extinction": {"ratio": 0.01},
    "clp_ellipticity": {"v": 0.05},
}
DETECTORS = {
    "nonlinearity": {"coefficient": [0.03, -0.02, 0.01, 0.05]},
    "ghost": {"share": 0.02},
    "pedestal": {"level": [0.01, 0.02, -0.005, 0.0]},
    "camera_gain_drift": {"camera": 1, "rate": 0.01},
}
UNDONE, LEFT_BEHIND = ("nonlinearity",), ("ghost", "pedestal", "camera_gain_drift")
GROUP = {name: group for group in (*IN_THE_PRODUCT, OF_THE_SOURCE, DETECTORS) for name in group}


def among(name: str, *, neutral: bool = False) -> tuple[Effect, ...]:
    """The effects of a group, all at neutral but one (or all)."""
    effects = []
    for other, values in GROUP[name].items():
        effect = make(other, **values)
        effects.append(effect if other == name and not neutral else effect.at_neutral(CONTEXT))
    return tuple(effects)


def alone(name: str) -> Instrument:
    return instrument(make(name, **GROUP[name][name]))


def test_every_effect_is_one_of_these():
    known = {kind.name for kind in EFFECTS}
    assert known - {*GROUP} == set(), f"add {sorted(known - {*GROUP})} to a group in {__file__}"
    assert {*GROUP} - known == set(), f"no effect has these names: take them out in {__file__}"
    assert set(DETECTORS) == {*UNDONE, *LEFT_BEHIND}


def test_without_effects():
    assert product() == pytest.approx(matrix_of_counts(star_counts()), abs=1e-12)
    assert with_errors() == pytest.approx(product(), abs=1e-12)


@pytest.mark.long
@pytest.mark.parametrize(
    "group", [*IN_THE_PRODUCT, OF_THE_SOURCE, DETECTORS], ids=lambda group: next(iter(group))
)
def test_errors_change_no_matrix(group):
    effects = tuple(make(name, **values) for name, values in group.items())
    np.testing.assert_allclose(with_errors(*effects), product(*effects), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "name", quick([name for group in IN_THE_PRODUCT for name in group], IN_THE_PRODUCT[1])
)
def test_what_the_counts_show_the_product_says(name):
    assert dependence.left_behind(alone(name)) == ()
    shown, said = matrix_of_counts(star_counts(*among(name))), product(*among(name))
    assert np.abs(shown - matrix_of_counts(star_counts())).max() > 1e-4
    np.testing.assert_allclose(said, shown, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", OF_THE_SOURCE)
def test_what_belongs_to_the_source_stays_with_it(name):
    assert dependence.left_behind(alone(name)) == ()
    np.testing.assert_array_equal(product(*among(name)), product(*among(name, neutral=True)))
    np.testing.assert_allclose(product(*among(name)), product(), rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", DETECTORS)
def test_what_acts_on_counts_is_no_part_of_the_product(name):
    np.testing.assert_array_equal(product(*among(name)), product(*among(name, neutral=True)))
    np.testing.assert_allclose(product(*among(name)), product(), rtol=0, atol=1e-14)
    if name != "ghost":  # which stars do not have
        assert np.abs(star_counts(*among(name)) / star_counts() - 1).max() > 1e-3


@pytest.mark.parametrize("name", UNDONE)
def test_what_a_detector_does_to_its_own_counts_is_undone(name):
    assert dependence.left_behind(alone(name)) == ()
    shown, linear = star_counts(*among(name)), star_counts()
    at = (jnp.asarray(np.repeat(places, linear.shape[1])) for places in (X, Y))
    again = np.asarray(dependence.reported(alone(name), jnp.asarray(linear.reshape(-1, 4)), *at))
    np.testing.assert_allclose(again.reshape(linear.shape), shown, rtol=1e-12)


@pytest.mark.parametrize("name", LEFT_BEHIND)
def test_what_is_left_behind_is_named(name):
    both = instrument(make("hwp1_axis", angle=0.5), make(name, **DETECTORS[name]))
    assert dependence.left_behind(both) == (name,)


# ------------------------------------------------------------------------------------------- the free form


def free(block: str, size: float = 0.01) -> FreeForm:
    """One block of the free-form term at that size throughout, of a sign that alternates from camera to camera too."""
    empty = FreeForm.of(CONTEXT, blocks=(block,))
    shape = getattr(empty, block).shape
    values = size * (-1.0) ** np.indices(shape).sum(axis=0)
    return dataclasses.replace(empty, **{block: jnp.asarray(values)})


@pytest.mark.parametrize("block", quick(["fine", "fine_gains", "vectors"], ["fine_gains", "vectors"]))
def test_patterns_over_the_field_reach_the_product(block):
    """Fine structure changes the counts of a fit by a quarter, and m21 and m31 with them."""
    effect = free(block, 0.02)
    assert dependence.left_behind(instrument(effect)) == ()
    assert np.abs(star_counts(effect) / star_counts() - 1).max() > (1e-3 if block == "vectors" else 0.03)
    shown = matrix_of_counts(star_counts(effect))
    assert np.abs(shown - matrix_of_counts(star_counts())).max() > 1e-3
    np.testing.assert_allclose(product(effect), shown, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "block", quick(["harmonics", "exposures", "exposure_gains"], ["harmonics", "exposure_gains"])
)
def test_patterns_of_single_exposures_are_left_behind(block):
    effect = free(block)
    assert dependence.left_behind(instrument(effect)) == ("free_form",)
    np.testing.assert_allclose(product(effect), product(), rtol=0, atol=1e-13)


# ------------------------------------------------------------------ effects that the package has never heard of


class AgeingGlass(Element):
    """A retarder that grows with the time since the first exposure."""

    rate: Scalar = number(unit="rad/h", about="retardance per hour")

    def mueller(self, ray: Ray) -> jax.Array:
        return mueller.retarder(self.rate * ray.conditions.hours, jnp.deg2rad(30.0))


class Ageing(Effect):
    """Which no table of points or catalogue can say: nobody knows when its exposures began."""

    rate: Scalar = param(
        unit="rad/h", about="retardance per hour", source="this test", width=0.01, default=0.01
    )
    name: ClassVar[str] = "ageing"

    def patch(self, instrument: Instrument) -> Instrument:
        return instrument.inserted(AgeingGlass(name="glass", rate=self.rate), before="pupil")


class Offset(DetectorPart):
    """A constant under the counts of all cameras."""

    level: Scalar

    def reported(self, counts, exposures, x, y):
        return counts + self.level


class Bias(Effect):
    level: Scalar = param(
        unit="electron", about="under all counts", source="this test", width=10.0, default=50.0
    )
    name: ClassVar[str] = "bias"

    def patch(self, instrument: Instrument) -> Instrument:
        return instrument.with_part("detectors", Offset(self.level))


def test_optics_that_change_with_time_are_left_behind():
    shown = star_counts(Ageing())
    assert np.abs(shown[:, 3:] / star_counts()[:, 3:] - 1).max() > 1e-3
    assert dependence.left_behind(instrument(Ageing(), make("hwp1_axis", angle=0.5))) == ("ageing",)


def test_a_detector_that_nobody_knows_is_undone():
    assert dependence.left_behind(instrument(Bias())) == ()
    counts = jnp.asarray([[1e5, 2e5, 3e5, 4e5]])
    shown = dependence.reported(instrument(Bias()), counts, jnp.array([0.1]), jnp.array([0.2]))
    np.testing.assert_allclose(shown, counts + 50.0, rtol=1e-15)
