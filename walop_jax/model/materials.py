"""Refractive indices of the glasses and crystals in the light path.

Equations   Sellmeier formula 1, n² = 1 + Σ B λ²/(λ² − C²) (Dodge, Radhakrishnan; Li with a constant), and formula 2,
            n² = A + Σ B λ²/(λ² − C) (Schott, Ghosh). Mixing the two up is the classic error; `_formula_1` marks
            the first.
Symbols     λ vacuum wavelength [µm]; n refractive index; A, B dimensionless; C [µm] in formula 1, [µm²] in 2.
Sources     beside the numbers; the curves as transcribed in the refractiveindex.info database. They were measured at
            20 °C (N-BK7), 19 °C (MgF2), 18 °C (quartz_1951) and 20 °C (mgf2_1980), over the `measured` wavelengths.
Limits      up to `EXTRAPOLATED` times beyond the measured wavelengths a fit adds a remark; farther away, toward the
            poles of the formulae, light paths are refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float


class Sellmeier(NamedTuple):
    """Coefficients of one dispersion curve: n² = constant + Σ strength λ²/(λ² − pole), pole in µm²."""

    constant: float
    strength: tuple[float, ...]
    pole: tuple[float, ...]

    def refractive_index(self, wavelength: Float[Any, ...]) -> Float[Any, ...]:
        """Refractive index at `wavelength` (µm); an array of numpy stays so."""
        square = wavelength**2
        strength, pole = (np.reshape(v, (-1, *(1,) * np.ndim(square))) for v in (self.strength, self.pole))
        terms = strength * square / (square - pole)  # one division: XLA compiles each by itself
        return (jnp if isinstance(wavelength, jax.Array) else np).sqrt(self.constant + terms.sum(axis=0))


def _formula_1(strength: tuple[float, ...], root_of_pole: tuple[float, ...]) -> Sellmeier:
    return Sellmeier(1.0, strength, tuple(c**2 for c in root_of_pole))


BK7 = Sellmeier(1.0, (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653))
QUARTZ_O = Sellmeier(1.28604141, (1.07044083, 1.10202242), (0.0100585997, 100.0))
QUARTZ_E = Sellmeier(1.28851804, (1.09509924, 1.15662475), (0.0102101864, 100.0))
MGF2_O = _formula_1((0.48755108, 0.39875031, 2.3120353), (0.04338408, 0.09461442, 23.793604))
MGF2_E = _formula_1((0.41344023, 0.50497499, 2.4904862), (0.03684262, 0.09076162, 23.771995))

# Other measurements of the same crystals: they differ by some 10⁻³ of the birefringence, and more in its slope.
QUARTZ_O_1951 = _formula_1(
    (0.663044, 0.517852, 0.175912, 0.565380, 1.675299), (0.060, 0.106, 0.119, 8.844, 20.742)
)
QUARTZ_E_1951 = _formula_1(
    (0.665721, 0.503511, 0.214792, 0.539173, 1.807613), (0.060, 0.106, 0.119, 8.792, 19.70)
)
MGF2_O_1980 = Sellmeier(1.27620, (0.60967, 0.0080, 2.14973), (0.08636**2, 18.0**2, 25.0**2))
MGF2_E_1980 = Sellmeier(1.25385, (0.66405, 1.0899, 0.1816, 2.1227), (0.08504**2, 22.2**2, 24.4**2, 40.6**2))

# Relative change of birefringence per kelvin, −(1/Δn) dΔn/dT.
QUARTZ_THERMAL = 1.23e-4
MGF2_THERMAL = 5.37e-5
REFERENCE_TEMPERATURE = 10.0  # Celsius


EXTRAPOLATED = 1.25  # times beyond the measured wavelengths up to which an index is used, with a remark


class Crystal(NamedTuple):
    """A uniaxial crystal: both dispersion curves, and the relative change of its birefringence per kelvin.

    `measured` is the range of wavelengths (µm) to which the curves were fitted.
    """

    ordinary: Sellmeier
    extraordinary: Sellmeier
    thermal: float
    measured: tuple[float, float]
    source: str

    def birefringence(self, wavelength: Float[Any, ...]) -> Float[Any, ...]:
        """n_e − n_o at `wavelength` (µm)."""
        return self.extraordinary.refractive_index(wavelength) - self.ordinary.refractive_index(wavelength)


class Glass(NamedTuple):
    """An isotropic material; `measured` is the range of wavelengths (µm) to which its curve was fitted."""

    dispersion: Sellmeier
    measured: tuple[float, float]
    source: str


_ETZEL = "Etzel, Rose & Wang 2000, Appl. Opt. 39, 5796 (temperature)"
CRYSTALS = {
    "quartz": Crystal(
        QUARTZ_O, QUARTZ_E, QUARTZ_THERMAL, (0.198, 2.05), f"Ghosh 1999, Opt. Commun. 163, 95; {_ETZEL}"
    ),
    "mgf2": Crystal(MGF2_O, MGF2_E, MGF2_THERMAL, (0.2, 7.0), f"Dodge 1984, Appl. Opt. 23, 1980; {_ETZEL}"),
    "quartz_1951": Crystal(
        QUARTZ_O_1951,
        QUARTZ_E_1951,
        QUARTZ_THERMAL,
        (0.18, 3.0),
        f"Radhakrishnan 1951, Proc. Indian Acad. Sci. 31, 22; {_ETZEL}",
    ),
    "mgf2_1980": Crystal(
        MGF2_O_1980,
        MGF2_E_1980,
        MGF2_THERMAL,
        (0.14, 7.5),
        f"Li 1980, J. Phys. Chem. Ref. Data 9, 161; {_ETZEL}",
    ),
}
OTHER_CURVES = {"quartz": {"quartz_1951": "Radhakrishnan 1951"}, "mgf2": {"mgf2_1980": "Li 1980"}}
"""Crystals under the same everyday name with another published dispersion: possible meanings of a description."""
GLASSES = {"BK7": Glass(BK7, (0.3, 2.5), "Schott 2017, data sheet of N-BK7")}
MATERIALS: Mapping[str, Crystal | Glass] = CRYSTALS | GLASSES
"""Materials of description files."""
