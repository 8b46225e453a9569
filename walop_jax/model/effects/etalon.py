"""Fringes of the air gaps ahead of the half-wave plates.

Equation    diattenuator with D = contrast · cos(4π gap cos ϑ / λ) along the fast axis of each plate, ahead
            of it
Symbols     gap thickness of the air [µm]; ϑ angle of the ray in air at the plate; λ wavelength [µm]
Source      fringes of polarised light are "the chief bane" of precise
            polarimetry (Clarke 2005, A&A 434, 377), 1e-3 remains with coatings (Semel 2003, A&A 401, 1).
Neutral     contrast = 0, whatever the gap
Revealed by zero offsets that oscillate with wavelength (period λ²/2 gap) and in rings over the field; a
            broad band averages gaps beyond some tens of µm away.

Near a gap the fringe is a cosine and a sine: the probes are pairs λ₀/8 apart, a quarter of a fringe at the reference
wavelength of an instrument, on a grid fine enough for all fringes of its bands. The wavelength nodes follow
gaps up to `LARGEST_GAP`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np
from jaxtyping import Float

from walop_jax.model.conventions import REFERENCE_WAVELENGTH, Units
from walop_jax.model.effects.base import Context, Effect, Scalar
from walop_jax.model.effects.change import Change
from walop_jax.model.effects.optics import LARGEST_GAP, with_air_gap
from walop_jax.model.elements.wave_plate import WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import param

SOURCE = "Clarke 2005, A&A 434, 377; Semel 2003, A&A 401, 1"

STEP = 0.75  # between gaps, at the reference wavelength of WALOP


def probed_gaps(units: Units) -> tuple[tuple[float, float], ...]:
    """Initial pairs of gaps (µm) for fringes: a quarter of a fringe apart at the wavelength of the units."""
    step, quarter = STEP * (units.wavelength / REFERENCE_WAVELENGTH), units.wavelength / 8.0
    return tuple((gap, gap + quarter) for gap in np.arange(1.0, LARGEST_GAP, step).tolist())


class Etalon(Effect):
    """Fringes of an air gap ahead of each half-wave plate."""

    contrast: Scalar = param("", "diattenuation at a maximum", SOURCE, width=0.003, default=0.0)
    gap: Scalar = param("um", "thickness of the air gap", SOURCE, scale=0.05, loose=5.0, default=10.0)

    name: ClassVar[str] = "etalon"
    reference: ClassVar[str] = SOURCE
    shape: ClassVar[tuple[str, ...]] = ("gap",)
    revealed_by: ClassVar[str] = "unpolarised light or polariser exposures in narrow bands"
    separated_by: ClassVar[str] = (
        "narrow bands of different wavelength, or a change of temperature: throughput and lens polarisation "
        "do not oscillate"
    )

    @classmethod
    def probes(cls, context: Context) -> tuple[tuple[Self, ...], ...]:
        """Probes in pairs of gaps a quarter of a fringe apart."""
        return tuple(tuple(cls.of(context, gap=gap) for gap in pair) for pair in probed_gaps(context.units))

    @classmethod
    def combine(cls, group: Sequence[Any], amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Self:
        """Contrast and gap from cosine and sine at the pair's gap."""
        cosine, sine = amplitudes
        quarter = float(group[1].gap) - float(group[0].gap)
        shift = np.arctan2(sine, cosine) * quarter / (0.5 * np.pi)
        return dataclasses.replace(group[0], contrast=np.hypot(cosine, sine), gap=float(group[0].gap) + shift)

    def as_descriptions(self, instrument: Instrument) -> tuple[str, ...]:
        """Fringes of every plate, of the gap itself and of one a quarter of a fringe wider."""
        gaps = (float(self.gap), float(self.gap) + instrument.units.wavelength / 8.0)
        return tuple(f"fringes of {p} * gap {gap:g}" for p in instrument.places(WavePlate) for gap in gaps)

    def first_order(self, instrument: Instrument) -> tuple[tuple[tuple[float, Change], ...], ...]:
        """For the contrast, the fringes of all plates together."""
        gap = f"gap {float(self.gap)!r}"
        return (tuple((1.0, Change("fringes", "of", p, (gap,))) for p in instrument.places(WavePlate)),)

    def patch(self, instrument: Instrument) -> Instrument:
        """Put an air gap ahead of every wave plate."""
        for place in instrument.places(WavePlate):
            instrument = with_air_gap(instrument, place, self.contrast, self.gap)
        return instrument
