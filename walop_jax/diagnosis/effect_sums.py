"""What the effects of the catalogue are to first order: sums of sentences, for every amplitude.

`likelihood.columns` knows what sentences do. Beside those of the grammar there are sentences that no user types: zero,
extinction and ellipticity of the polariser, the rotator, polarisation that is added, a gain of counts as reported.
Effects of a user's own are none of this; their columns are derivatives of the light path itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from walop_jax.likelihood.columns import Change
from walop_jax.model.effects import Described, Effect
from walop_jax.model.effects.blemish import Blemish
from walop_jax.model.effects.camera_gain_drift import CameraGainDrift
from walop_jax.model.effects.camera_leakage import CameraLeakage
from walop_jax.model.effects.chwp_thickness import ChwpThickness
from walop_jax.model.effects.clp_ellipticity import ClpEllipticity
from walop_jax.model.effects.clp_extinction import ClpExtinction
from walop_jax.model.effects.clp_wobble import ClpWobble
from walop_jax.model.effects.clp_zero import ClpZero
from walop_jax.model.effects.etalon import Etalon
from walop_jax.model.effects.filter_shift import FilterShift
from walop_jax.model.effects.flexure import Flexure
from walop_jax.model.effects.ghost import Ghost
from walop_jax.model.effects.hwp_temperature import HwpTemperature
from walop_jax.model.effects.lens_birefringence import LensBirefringence
from walop_jax.model.effects.moon_multiple_scattering import MoonMultipleScattering
from walop_jax.model.effects.moon_patch import MoonPatch
from walop_jax.model.effects.nonlinearity import Nonlinearity
from walop_jax.model.effects.pedestal import Pedestal
from walop_jax.model.effects.plate_axis import PlateAxis
from walop_jax.model.effects.plate_crossing import PlateCrossing
from walop_jax.model.effects.plate_cut import PlateCut
from walop_jax.model.effects.rotator_zero import RotatorZero
from walop_jax.model.effects.sentence import OPPOSITE, Sentence
from walop_jax.model.effects.standard_outlier import StandardOutlier
from walop_jax.model.effects.telescope_polarisation import TelescopePolarisation
from walop_jax.model.effects.upstream_retarder import UpstreamRetarder
from walop_jax.model.effects.wollaston_axis import WollastonAxis
from walop_jax.model.elements import WavePlate
from walop_jax.model.instrument import Instrument

Sums = Iterator[Change]


def sums(effect: Effect, instrument: Instrument) -> list[Change] | None:
    """For each amplitude of a neutral effect what it is to first order; None for an effect of a user's own."""
    known = _SUMS.get(type(effect).patch)
    return None if known is None else list(known(effect, instrument))


def _said(text: str, size: float = 1.0) -> Change:
    return ((size, Sentence.parsed(text)),)


def _number(kind: str, *factors: Any, size: float = 1.0) -> Change:
    return ((size, Sentence(kind, "of", "", factors)),)


def _described(effect: Any, instrument: Instrument) -> Sums:
    del instrument
    sentences = [Sentence.parsed(text) for text in effect.sentences]
    for field in effect.amplitudes():
        yield from (((1.0, one),) for one in sentences if one.parameter == field)


def _in_sentences(effect: Effect, instrument: Instrument) -> Sums:
    yield from (_said(text) for text in effect.in_sentences(instrument))


def _together(effect: Effect, instrument: Instrument) -> Sums:
    yield tuple((1.0, Sentence.parsed(text)) for text in effect.in_sentences(instrument))


def _blemish(effect: Any, instrument: Instrument) -> Sums:
    x, y, size = float(effect.x), float(effect.y), float(effect.size)

    def spot(at: Any) -> np.ndarray:
        return -np.exp(-((at.x - x) ** 2 + (at.y - y) ** 2) / (2.0 * size**2))

    yield ((1.0, Sentence("shade", "of", instrument.cameras.names[effect.camera], (spot,))),)  # type: ignore[arg-type]


def _drift(effect: Any, instrument: Instrument) -> Sums:
    yield ((1.0, Sentence("reported gain", "of", instrument.cameras.names[effect.camera], ("hours",))),)


def _wobble(effect: Any, instrument: Instrument) -> Sums:
    del instrument
    phase = float(effect.phase)

    def error(at: Any) -> np.ndarray:
        return np.sin(np.where(at.clp_in, at.clp_angle, 0.0) - phase)

    yield _number("zero", error)


def _etalon(effect: Any, instrument: Instrument) -> Sums:
    gap = f"gap {float(effect.gap)!r}"
    places = instrument.places(WavePlate)
    yield tuple((1.0, Sentence("fringes", "of", place, (gap,))) for place in places)


def _ghost(effect: Any, instrument: Instrument) -> Sums:
    del effect
    yield tuple((1.0, Sentence("light", "in", name, origin=OPPOSITE)) for name in instrument.cameras.names)


def _lens(effect: Any, instrument: Instrument) -> Sums:
    del effect, instrument
    yield ((2.0 * np.pi, Sentence("retardance radial", "ahead of", "pupil")),)


def _upstream(effect: Any, instrument: Instrument) -> Sums:
    del instrument
    twice = 2.0 * np.deg2rad(float(effect.axis))
    parts = zip("qu", (np.cos(twice), np.sin(twice)), strict=True)
    yield tuple((size, Sentence(f"retardance {axis}", "ahead of", "pupil")) for axis, size in parts)


def _patches(effect: Any, instrument: Instrument) -> Sums:
    del instrument
    for axis in "qu":
        yield from (_said(f"polarisation {axis} of sky * exposure {n}") for n in effect.positions)


def _thickness(effect: Effect, instrument: Instrument) -> Sums:
    del instrument
    yield from (_said(f"thickness of chwp.{name}") for name in effect.amplitudes())


def _telescope(effect: Effect, instrument: Instrument) -> Sums:
    del instrument
    for axis in effect.amplitudes():
        yield ((1.0, Sentence(f"added polarisation {axis}", "ahead of", "polariser")),)


def _wollaston(effect: Effect, instrument: Instrument) -> Sums:
    del effect
    yield tuple(
        (2.0 * np.pi / 180.0, Sentence("retardance v", "ahead of", f"{arm.name}.{arm.path[-1]}"))
        for arm in instrument.arms
    )


def _scattering(effect: Effect, instrument: Instrument) -> Sums:
    del effect, instrument
    yield _said("polarisation of sky", -1.0)


_SUMS: dict[Any, Callable[[Any, Instrument], Sums]] = {
    Described.patch: _described,
    Blemish.patch: _blemish,
    CameraGainDrift.patch: _drift,
    CameraLeakage.patch: _together,
    ChwpThickness.patch: _thickness,
    ClpEllipticity.patch: lambda effect, instrument: iter((_number("ellipticity"),)),
    ClpExtinction.patch: lambda effect, instrument: iter((_number("extinction"),)),
    ClpWobble.patch: _wobble,
    ClpZero.patch: lambda effect, instrument: iter((_number("zero"),)),
    Etalon.patch: _etalon,
    FilterShift.patch: _in_sentences,
    Flexure.patch: _in_sentences,
    Ghost.patch: _ghost,
    HwpTemperature.patch: _together,
    LensBirefringence.patch: _lens,
    MoonMultipleScattering.patch: _scattering,
    MoonPatch.patch: _patches,
    Nonlinearity.patch: _in_sentences,
    Pedestal.patch: _in_sentences,
    PlateAxis.patch: _in_sentences,
    PlateCrossing.patch: _in_sentences,
    PlateCut.patch: _in_sentences,
    RotatorZero.patch: lambda effect, instrument: iter((_number("rotator"),)),
    StandardOutlier.patch: _in_sentences,
    TelescopePolarisation.patch: _telescope,
    UpstreamRetarder.patch: _upstream,
    WollastonAxis.patch: _wollaston,
}
