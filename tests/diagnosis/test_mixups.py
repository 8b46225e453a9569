"""Sets that were written down wrongly: each mix-up is told by its name, with the remedy, and nothing else is."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable

import numpy as np
import pytest
from changed_sets import block_of, with_block
from quick import quick
from small_run import SEED, SMALL

from walop_jax.data.inspection import inspect
from walop_jax.data.records import CalibrationSet, Position
from walop_jax.diagnosis.discrete import causes
from walop_jax.diagnosis.readings import _angles
from walop_jax.diagnosis.trust import examined
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult
from walop_jax.fit.refit import refit as plain_refit
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import Simulated, simulate, truth_values

PLAN = ObservingPlan(
    grid=5,
    standard_grid=2,
    polariser_angles=polariser_turn(9),
    moon_patches=4,
    standards=4,
    plate=(None, 22.5),
)


@pytest.fixture(scope="module")
def calset() -> CalibrationSet:
    return simulate(PLAN, seed=8).calset


@pytest.fixture(scope="module")
def without_plate() -> CalibrationSet:
    return simulate(SMALL, seed=SEED).calset


def with_data(
    calset: CalibrationSet, order: tuple[int, ...] = (0, 1, 2, 3), **points: np.ndarray
) -> CalibrationSet:
    where, block = dataclasses.replace(calset.points, **points), block_of(calset)
    counts, sigma = block.counts[..., list(order)], block.sigma[..., list(order)]
    return with_block(
        dataclasses.replace(calset, points=where), counts=counts, sigma=sigma, x=where.x, y=where.y
    )


def with_angle(calset: CalibrationSet, angle: np.ndarray, prefix: str = "CLP") -> CalibrationSet:
    return dataclasses.replace(calset, exposures=calset.exposures.placed(**{prefix: Position.at(angle)}))


def unpolarised(simulated: Simulated) -> CalibrationSet:
    """The polariser exposures as they would be without it, written down as if it had been there."""
    calset, truth = simulated
    e = calset.exposures
    out = with_angle(calset, np.full(len(e), np.nan))
    model, true = base_model(out), truth_values(truth)
    block = block_of(calset)
    _, left = Likelihood.of(out, model).residuals(np.array([true[p.name] for p in model.parameters]))
    expected = np.where(block.used[..., None], block.counts - left * block.sigma, 0.0)
    noise = np.random.default_rng(1).standard_normal(expected.shape) * block.sigma
    return with_block(calset, counts=np.where(e.clp_in[:, None], expected + noise, block.counts))


def with_standards(calset: CalibrationSet, **columns: np.ndarray) -> CalibrationSet:
    return dataclasses.replace(calset, sources=dataclasses.replace(calset.sources, **columns))


def with_intensities(
    calset: CalibrationSet, order: dict[int, int] | None = None, dead: tuple[int, slice] | None = None
) -> CalibrationSet:
    """Intensities of exposures exchanged; a camera that saw nothing but 700 electrons of bias in some of them."""
    block, here = block_of(calset), np.arange(len(calset.exposures))
    for one, other in (order or {}).items():
        here[one] = other
    counts, sigma = block.counts[:, here].copy(), block.sigma[:, here].copy()
    if dead is not None:
        camera, some = dead
        counts[:, some, camera] = 700.0 + 30.0 * np.random.default_rng(2).standard_normal(
            counts[:, some, camera].shape
        )
        sigma[:, some, camera] = 30.0
    return with_block(
        calset, counts=counts, sigma=sigma, used=block.used[:, here], source=block.source[:, here]
    )


Spoil = Callable[[CalibrationSet], CalibrationSet]
CASES: dict[str, tuple[Spoil, str]] = {
    "the arms exchanged": (lambda c: with_data(c, (2, 3, 0, 1)), "their order is O1, E1, O2, E2"),
    "the beams of an arm exchanged": (lambda c: with_data(c, (1, 0, 2, 3)), "in the order E1, O1, O2, E2"),
    "cameras in a ring": (lambda c: with_data(c, (1, 2, 3, 0)), "in the order E1, O2, E2, O1"),
    "the polariser runs backwards": (lambda c: with_angle(c, -c.exposures.clp_angle), "give −CLP_ANGLE"),
    "polariser + 90": (lambda c: with_angle(c, c.exposures.clp_angle + 90), r"give CLP_ANGLE \+ 90°"),
    "polariser + 45": (lambda c: with_angle(c, c.exposures.clp_angle + 45), r"give CLP_ANGLE \+ 135°"),
    "polariser in radians": (
        lambda c: with_angle(c, np.deg2rad(c.exposures.clp_angle)), "CLP_ANGLE is in radians",
    ),
    "plate backwards": (lambda c: with_angle(c, -c.exposures.position("CHWP").angle, "CHWP"), "give −CHWP_ANGLE"),
    "X mirrored": (lambda c: with_data(c, x=-c.points.x), "give −X"),
    "Y mirrored": (lambda c: with_data(c, y=-c.points.y), "give −Y"),
    "turned by 90 degrees": (lambda c: with_data(c, x=c.points.y, y=-c.points.x), "give −Y as X, and X as Y"),
    "arcminutes": (lambda c: with_data(c, x=60 * c.points.x, y=60 * c.points.y), "X and Y are in arcmin"),
    "Q of standards of the other sign": (lambda c: with_standards(c, q=-c.sources.q, u=c.sources.u), "give −Q"),
    "standards in per cent": (
        lambda c: with_standards(c, q=100 * c.sources.q, u=100 * c.sources.u), "Q and U of SOURCES are in per cent",
    ),
    "RA in hours": (lambda c: with_angle(c, ra=c.exposures.ra / 15), "RA is in hours"),
    "MJD = JD - 2400000": (lambda c: with_angle(c, mjd=c.exposures.mjd + 0.5), "MJD is 0.5 d too large"),
    "half a day early": (lambda c: with_angle(c, mjd=c.exposures.mjd - 0.5), "MJD is 0.5 d too small"),
    "DEC of the other sign": (lambda c: with_angle(c, dec=-c.exposures.dec), "give −DEC"),
    "two exposures exchanged": (
        lambda c: with_intensities(c, {1: 4, 4: 1}), "intensities of exposures 1 and 4 were exchanged",
    ),
    "two patches exchanged": (
        lambda c: with_intensities(c, {8: 9, 9: 8}), "intensities of exposures 8 and 9 were exchanged",
    ),
    "a camera dead for a while": (
        lambda c: with_intensities(c, dead=(1, slice(3, 6))), "exposures 3, 4, 5 were left out, in which camera E1",
    ),
    "South labelled North": (lambda c: dataclasses.replace(c, instrument="WALOP-NORTH"), "they came from WALOP-SOUTH"),
}  # fmt: skip

OF_THE_PLATE = {"plate backwards"}
TWO = {*OF_THE_PLATE, "Q of standards of the other sign"}  # the one polarised standard has hardly any u


def test_angles_are_rewritten_as_the_remedy_says(calset):
    """Without a fit: what is tried is what is recommended."""
    plate, found = calset.exposures.position("CHWP").angle, 0
    for one in _angles(calset):
        told = re.fullmatch(r"give (−?)(CLP|CHWP)_ANGLE(?: \+ (\d+)°)?", one.remedy)
        if told is None:
            continue
        sign, offset = -1.0 if told[1] else 1.0, float(told[3] or 0.0)
        before, changed = (c.exposures.position(told[2]).angle for c in (calset, one.change(calset)))
        np.testing.assert_allclose(changed, sign * before + offset, rtol=1e-12)
        found += 1
    assert np.isfinite(plate).any()
    assert found == 14


@pytest.mark.parametrize("name", quick(CASES, ["the polariser runs backwards", "two exposures exchanged"]))
def test_every_mix_up_is_told_with_its_remedy(request, name):
    spoil, said = CASES[name]
    bad = spoil(request.getfixturevalue("calset" if name in OF_THE_PLATE else "without_plate"))
    found = causes(bad, base_model(bad), left=1e5)
    # A plate at a single angle does not tell another sense from another zero.
    assert len(found) == (2 if name in TWO else 1)
    assert any(re.search(said, str(one)) for one in found)
    assert found[0].explained < 1.5


def test_the_other_sign_of_u_is_told():
    """Of standards with as much u as q, in the sky of the truth: a catalogue, or one star, has the other convention."""
    calset = simulate(PLAN, seed=8).calset
    sources = calset.sources
    assert np.abs(sources.u).max() > 0.02
    star = int(np.argmax(np.abs(sources.u)))
    single = np.where(np.arange(len(sources)) == star, -1, 1)
    for sign, what in (
        (-1, "U of SOURCES had the other sign"),
        (single, f"U of {sources.name[star]} in SOURCES had the other sign"),
    ):
        bad = with_standards(calset, u=sign * sources.u)
        best = causes(bad, base_model(bad), left=1e5)[0]
        assert best.what == what
        assert best.explained < 1.5


def test_a_camera_with_one_number_everywhere_is_refused(without_plate):
    """Its errors as large as those of light, a fit takes it for a camera of low throughput: χ²/dof 1."""
    counts = block_of(without_plate).counts.copy()
    counts[..., 2] = 500.0
    with pytest.raises(DataError, match="camera O2 has the same number everywhere"):
        examined(plain_refit(with_block(without_plate, counts=counts)))


@pytest.mark.long
def test_a_polariser_that_was_not_in_the_beam_is_told():
    bad = unpolarised(simulate(SMALL, seed=SEED))
    (found,) = causes(bad, base_model(bad), left=1e5)
    assert found.what == "the calibration polariser was not in the beam"
    assert found.explained < 1.5


@pytest.mark.long
def test_a_fit_of_mixed_up_data_is_refused(calset):
    bad = with_data(calset, x=-calset.points.x)
    with pytest.raises(DataError, match=r"does not fit .* would if X runs the other way .*: give −X"):
        examined(plain_refit(bad))


@pytest.mark.long
def test_right_data_and_effects_are_no_mix_up(calset):
    """However large: an encoder error of 2°, and half the light of a camera."""
    model = base_model(calset)
    assert causes(calset, model, left=1.0) == ()
    wobble = 2.0 * np.sin(np.deg2rad(calset.exposures.clp_angle))
    assert causes(with_angle(calset, calset.exposures.clp_angle + wobble), model, left=5e3) == ()
    counts = block_of(calset).counts * np.array([1.0, 0.5, 1.0, 1.0])
    assert causes(with_block(calset, counts=counts), model, left=1e3) == ()


@pytest.mark.long
def test_errors_that_are_far_too_small_are_told_from_a_wrong_model(calset):
    result: FitResult = examined(plain_refit(with_block(calset, sigma=block_of(calset).sigma / 100.0)))
    assert not result.trusted
    assert any(re.search(r"N_ERR is (9\d|10\d)(\.\d)? times too small", text) for text in result.warnings)


def test_cameras_in_different_units_are_seen_without_a_fit(calset):
    block, gain = block_of(calset), np.array([1.0, 1.0, 4.0, 1.0])
    other = with_block(calset, counts=block.counts / gain, sigma=block.sigma / gain)
    findings = [str(one) for one in inspect(other).findings]
    assert any("N2 0.25" in text and "electrons" in text for text in findings)
    assert not any("between the cameras" in str(one) for one in inspect(calset).findings)
