"""The light followed forward ends in the counts that a fit works with, and every stage is what it says."""

from __future__ import annotations

import dataclasses

import builders
import jax.numpy as jnp
import numpy as np
import pytest
from quick import quick

from walop_jax.data.settings import Settings, builtin_filter
from walop_jax.model import light
from walop_jax.model.effects import FreeForm, effect_by_name
from walop_jax.model.effects.base import Context
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.planning import plan_for
from walop_jax.model.sources import PointIllumination
from walop_jax.model.trace import STOKES, LightStage, Sightline, trace


def setting(plate: float | None, teff: float = np.nan) -> Settings:
    return dataclasses.replace(Settings.default(1, "band").at(CHWP=plate), teff=np.array([teff]))


SIGHTLINES = {
    "unpolarised star on axis": Sightline(),
    "star": Sightline(x=0.2, y=-0.13, q=0.031, u=-0.02, setting=setting(None, 5772.0)),
    "star, plate in": Sightline(x=-0.25, y=0.11, q=0.031, u=-0.02, setting=setting(45.0, 9000.0)),
    "polariser": Sightline(x=0.1, y=0.28, clp_angle=33.0),
    "polariser, plate in": Sightline(x=0.1, y=0.28, clp_angle=123.0, setting=setting(0.0, 3000.0)),
}
CONTEXT = Context(exposures=1, sources=("STD00",))


def built(*effects):
    return builders.south(np.random.default_rng(5), effects, standards=[("STD00", 0.0, 0.0)])


def counts_of(instrument, sightline: Sightline) -> np.ndarray:
    """The same counts from the backward path of a fit, the source given as a catalogue star of its own."""
    standard = dataclasses.replace(
        instrument.standard,
        q=jnp.append(instrument.standard.q, sightline.q),
        u=jnp.append(instrument.standard.u, sightline.u),
        names=(*instrument.standard.names, "it"),
    )
    instrument = instrument.with_source(standard)
    band = builders.broad_band()
    row = {"kind": "standard", "rotator": 0.0, "teff": float(sightline.setting.teff[0])}
    if np.isfinite(sightline.clp_angle):
        row["clp_angle"] = sightline.clp_angle
    if np.isfinite(plate := sightline.setting.position("CHWP")[0]):
        row["chwp_angle"] = float(plate)
    plan = plan_for(instrument, builders.exposures(row), {band.name: band})
    x, y = jnp.asarray(sightline.x), jnp.asarray(sightline.y)
    rows = light.band_rows(instrument, plan, x, y)
    illumination = PointIllumination(plan.exposures, jnp.zeros((1, 2)), jnp.asarray([1]), x, y)
    throughput = instrument.throughput.at(x, y)
    return np.asarray(light.counts(instrument, rows, throughput, illumination, jnp.asarray([0]))[0])


def named(stages: tuple[LightStage, ...], name: str) -> np.ndarray:
    return next(stage.value for stage in stages if stage.name == name)


@pytest.mark.parametrize("sightline", SIGHTLINES.values(), ids=SIGHTLINES)
def test_the_last_stage_is_what_a_fit_computes(sightline: Sightline):
    instrument = built()
    stages = trace(instrument, builders.broad_band(), sightline)
    assert stages[-1].name == "counts"
    np.testing.assert_allclose(stages[-1].value[0], counts_of(instrument, sightline), rtol=0, atol=1e-14)
    both_ends_meet(instrument, stages)


def both_ends_meet(instrument: Instrument, stages: tuple[LightStage, ...]) -> None:
    """The light that has come forward to the analysers is what the fold from behind says that they share out."""
    for arm, beam in zip(instrument.patched().arms, named(stages, "arms"), strict=True):
        cameras = [instrument.cameras.names.index(name) for name in arm.analyser.cameras]
        seen = arm.analyser.seen(jnp.zeros((4, 4)).at[:, 0].set(beam))[:, 0]
        np.testing.assert_allclose(
            named(stages, "analysers")[0, cameras], arm.analyser.beam_weights() @ seen, rtol=0, atol=1e-14
        )


# One effect for every stage at which the path can be changed.
STAGES = (
    "telescope_polarisation", "clp_ellipticity", "upstream_retarder", "chwp_in_beam", "filter_shift",
    "etalon", "hwp2_axis_cut", "wollaston_axis", "blemish", "camera_leakage",
)  # fmt: skip


@pytest.mark.parametrize("name", quick(STAGES, STAGES[::3]))
def test_effects_are_followed(name: str):
    kind = effect_by_name(name)
    effect = kind.neutral(CONTEXT)
    names = kind.amplitudes()
    changed = {name: jnp.full(np.shape(getattr(effect, name)), 0.01) for name in names}
    instrument = built(effect.replaced(**changed))
    sightline = SIGHTLINES["polariser, plate in" if name == "clp_ellipticity" else "star"]
    stages = trace(instrument, builders.broad_band(), sightline)
    np.testing.assert_allclose(stages[-1].value[0], counts_of(instrument, sightline), rtol=0, atol=1e-14)
    both_ends_meet(instrument, stages)


def test_patterns_of_the_analysis_vectors_are_followed():
    """They add to what a camera makes of q, so the sum over the beams is not all that there is."""
    free = FreeForm.of(CONTEXT, blocks=("vectors",))
    instrument = built(dataclasses.replace(free, vectors=0.01 + free.vectors))
    sightline = SIGHTLINES["polariser"]
    last = trace(instrument, builders.broad_band(), sightline)[-1].value[0]
    np.testing.assert_allclose(last, counts_of(instrument, sightline), rtol=1e-13)


def test_beams_that_differ_in_wavelength_are_followed():
    instrument = built()
    for arm in instrument.arms:
        instrument = instrument.changed(f"{arm.name}.analyser", dispersion=jnp.asarray(0.004))
    sightline = SIGHTLINES["polariser"]
    stages = trace(instrument, builders.broad_band(), sightline)
    plain = trace(built(), builders.broad_band(), sightline)[-1].value[0]
    found = stages[-1].value[0]
    assert np.max(np.abs(found - plain)) > 1e-4
    np.testing.assert_allclose(found, counts_of(instrument, sightline), rtol=1e-12)


def test_unpolarised_light_is_shared_equally_by_the_nominal_instrument():
    stages = trace(nominal_instrument(), builtin_filter("SDSS-r"), Sightline())
    np.testing.assert_allclose(named(stages, "source"), [[1, 0, 0, 0]])
    # Three faces reflect: ((n − 1) / (n + 1))² at 1.54 and at 1.38, next to nothing between the plates.
    passed = (1 - (0.54 / 2.54) ** 2) * (1 - (0.38 / 2.38) ** 2)
    np.testing.assert_allclose(named(stages, "analysers"), np.full((1, 4), 0.5 * passed), rtol=0.01)
    # The level of the nominal throughput is 0.5, so the cameras see a quarter of what the plates let through.
    np.testing.assert_allclose(named(stages, "counts"), 0.25 * passed, rtol=0.01)


def test_half_wave_plate_at_45_degrees_turns_x_into_y():
    # On axis the retardance is 2π (2407 µm Δn(quartz) − 1930 µm Δn(MgF2)) / λ, of Q its cosine is left.
    # Δn at 0.62 µm: 0.00906 and 0.01179 (handbook values; the plates are 35 and 37 waves thick).
    stages = trace(
        nominal_instrument(), builders.monochromatic(0.62), Sightline(clp_angle=0.0, setting=setting(45.0))
    )
    np.testing.assert_allclose(named(stages, "source")[0], [1, 1, 0, 0], atol=5e-5)
    behind = named(stages, "chwp")[0]
    retardance = 2 * np.pi * (2407.0 * 0.00906 - 1930.0 * 0.01179) / 0.62
    assert behind[1] / behind[0] == pytest.approx(np.cos(retardance), abs=0.02)


def test_light_never_gains():
    for sightline in SIGHTLINES.values():
        stages = trace(built(), builders.broad_band(), sightline)
        beams = [stage for stage in stages if stage.columns == STOKES]
        assert [stage.name for stage in beams] == ["source", "collimator", "chwp", "arms"]
        for stage in beams:
            intensity, polarised = stage.value[:, 0], np.linalg.norm(stage.value[:, 1:], axis=1)
            assert np.all(polarised <= intensity * (1 + 1e-12)), stage.name
        assert named(stages, "arms")[:, 0].max() <= named(stages, "source")[0, 0] * 1.01


def test_impossible_light_is_refused():
    with pytest.raises(ValueError, match="polarised by more than 1"):
        Sightline(q=0.9, u=0.9)
