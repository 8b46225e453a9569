"""Few values of a condition serve for all exposures where the optics follow it smoothly; else each is followed."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import builders
import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.io.errors import DataError
from walop_jax.model import light, mueller
from walop_jax.model.effects import Described, Effect
from walop_jax.model.effects.base import Scalar
from walop_jax.model.elements.base import Element
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.parameters import number, param
from walop_jax.model.planning import SMOOTH_NODES, nodes_for, plan_for, weights_of_points

CURVE = {"band": builders.curve([0.59, 0.62, 0.65], [1.0, 1.0, 1.0])}
DEVICE = nominal_instrument()
X, Y = jnp.asarray(0.21), jnp.asarray(-0.17)
RNG = np.random.default_rng(3)
ROWS = [
    {"kind": "moon", "mjd": 61044.0 + hour / 24.0, "temp": temp, "ha": hour - 3.0}
    for hour, temp in zip(np.sort(RNG.uniform(0.0, 8.0, 25)), RNG.uniform(8.5, 11.5, 25), strict=True)
]


def with_descriptions(*texts: str) -> Instrument:
    return dataclasses.replace(DEVICE, effects=(Described.saying(list(texts), np.full(len(texts), 0.01)),))


def rows_of(device: Instrument, rows: list[dict]) -> np.ndarray:
    """Band rows of every exposure of a list."""
    plan = plan_for(device, builders.exposures(*rows), CURVE)
    return np.asarray(light.band_rows(device, plan, X, Y))[plan.band_of[:, 0]]


def solved(device: Instrument) -> int:
    """Number of wavelengths and conditions at which the optics are solved, in units of one exposure."""
    plans = [plan_for(device, builders.exposures(*rows), CURVE) for rows in (ROWS, ROWS[:1])]
    return len(plans[0].wavelength) // len(plans[1].wavelength)


@pytest.mark.parametrize(
    ("texts", "count"),
    [
        (("retardance q behind half2.plate * hours",), SMOOTH_NODES),
        (
            ("diattenuation u behind collimator * hour angle", "retardance v behind half1.plate * hour angle"),
            SMOOTH_NODES,
        ),
        (("depolarisation behind collimator * kelvin * x",), SMOOTH_NODES),
        (("retardance q behind half2.plate * hours 2 to 5.5",), 2),
        (("retardance q behind half2.plate * hours * hours 2 to 5.5",), None),
        (("retardance q behind half2.plate * hours", "retardance u behind half2.plate * kelvin"), len(ROWS)),
    ],
    ids=["hours", "hour angle", "kelvin", "interval", "hours of an interval", "two conditions"],
)  # fmt: skip
def test_every_exposure_is_as_if_it_were_alone(texts, count):
    """A single exposure is solved at its own conditions; the first of the list goes with it, for the hours."""
    device = with_descriptions(*texts)
    together = rows_of(device, ROWS)
    for place in (1, 7, 24):
        alone = rows_of(device, [ROWS[0], ROWS[place]])
        np.testing.assert_allclose(together[place], alone[1], rtol=0.0, atol=1e-12)
    if count is not None:
        assert solved(device) == count


class StepGlass(Element):
    """A window that jumps at 10 °C, of its own kind."""

    rate: Scalar = number(unit="rad", about="retardance above 10 °C")

    def mueller(self, ray):
        return mueller.retarder(self.rate * (ray.conditions.temperature > 10.0), jnp.deg2rad(30.0))


class Jump(Effect):
    """Its window behind the collimator."""

    rate: Scalar = param(
        unit="rad", about="retardance above 10 °C", source="this test", width=0.1, default=0.0
    )
    name: ClassVar[str] = "jump"

    def patch(self, instrument: Instrument) -> Instrument:
        return instrument.inserted(StepGlass(name="window", rate=self.rate), before="pupil")


def test_an_element_that_asks_for_a_condition_itself_gets_every_value():
    device = dataclasses.replace(DEVICE, effects=(Jump(rate=jnp.asarray(0.3)),))
    assert solved(device) == len(ROWS)
    together = rows_of(device, ROWS)
    warm = np.array([row["temp"] > 10.0 for row in ROWS])
    np.testing.assert_allclose(
        together[warm], np.broadcast_to(together[warm][:1], together[warm].shape), atol=1e-14
    )
    assert np.abs(together[warm][0] - together[~warm][0]).max() > 0.01


def test_shares_are_those_of_polynomials():
    """Any polynomial of seventh degree in one condition, times any function of three values of another, is exact."""
    hours = RNG.uniform(-3.0, 9.0, 100)
    moments = [(float(t), float(k)) for t in hours for k in (1.0, 2.0, 5.0)]
    shares = weights_of_points(moments, [SMOOTH_NODES, SMOOTH_NODES])
    assert len(set().union(*shares.values())) == 3 * SMOOTH_NODES
    coefficients = RNG.standard_normal(SMOOTH_NODES)
    for (t, k), of_points in list(shares.items())[::17]:
        value = sum(
            part * np.polyval(coefficients, point / 9.0) * np.exp(other)
            for (point, other), part in of_points.items()
        )
        assert value == pytest.approx(np.polyval(coefficients, t / 9.0) * np.exp(k), rel=1e-11)
        assert {other for (_, other), part in of_points.items() if part} == {k}


@pytest.mark.parametrize("moments", [[()], [(1.0,), (4.0,)], [(float(t),) for t in range(SMOOTH_NODES)]])
def test_few_moments_are_followed_one_by_one(moments):
    alone = {moment: {moment: 1.0} for moment in moments}
    assert weights_of_points(moments, [SMOOTH_NODES] * len(moments[0])) == alone


def test_a_moment_without_a_value_leaves_the_others_as_they_are():
    """A missing TEMP is no reason for interpolation with what is not a number."""
    moments = [(float(t),) for t in range(20)] + [(np.nan,)]
    assert all(len(of_points) == 1 for of_points in weights_of_points(moments, [SMOOTH_NODES]).values())


@pytest.mark.parametrize("swing", [0.05, 0.4, 3.0, 40.0])
def test_a_phase_that_changes_by_much_has_more_values(swing):
    """The factor exp(i a t) at 500 values of t in (−1, 1), from those at the points."""
    moments = [(float(t),) for t in np.linspace(-1.0, 1.0, 500)]
    shares = weights_of_points(moments, [nodes_for(swing)])
    error = [
        abs(
            sum(part * np.exp(1j * swing * t) for (t,), part in shares[moment].items())
            - np.exp(1j * swing * moment[0])
        )
        for moment in moments
    ]
    assert max(error) < 1e-9
    assert (nodes_for(swing) == SMOOTH_NODES) == (swing < 0.3)


def test_thick_plates_of_another_temperature_are_followed():
    """Quartz of 30 mm has 430 waves, which change by 0.05 waves per kelvin."""
    thick = DEVICE.changed(
        "half1.plate", layers=lambda layers: (dataclasses.replace(layers[0], thickness=jnp.asarray(3e4)),)
    )
    warmer = Described.saying(["thermal of half1.plate"], np.array([1.0]))
    device = dataclasses.replace(thick, effects=(warmer,))
    rows = [row | {"temp": temp} for row, temp in zip(ROWS, np.linspace(-20.0, 20.0, 25), strict=True)]
    together = rows_of(device, rows)
    alone = rows_of(device, [rows[0], rows[9]])
    np.testing.assert_allclose(together[9], alone[1], rtol=0.0, atol=1e-9)


def test_plates_that_cannot_be_meant_are_refused():
    """Quartz of 2407 µm that is entered in picometres has 3·10⁷ waves: no rule for the band holds its fringes."""
    wrong = DEVICE.changed(
        "half1.plate",
        layers=lambda layers: (dataclasses.replace(layers[0], thickness=jnp.asarray(2.407e9)),),
    )
    with pytest.raises(DataError, match=r"filter band: .*waves.*thicknesses of its plates, which are in µm"):
        plan_for(wrong, builders.exposures(ROWS[0]), CURVE)
