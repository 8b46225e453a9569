"""The instrument as a tree of components, in the order light meets them; parameters with unit and source.

Nothing here computes light: `light.py` does, with these values. Nominal values and widths are the contract's
(section 3); as-built values scatter around them.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model import legendre
from walop_jax.model.conventions import CAMERAS, EXTINCTION, FAST_AXES
from walop_jax.model.effects.base import Effect
from walop_jax.model.parameters import Component, param, unknown_name

CONTRACT = "calibration contract, section 3"
PAPER = "Maharana et al. 2022, Paper II"

Scalar = Float[Array, ""]


class MoonSky(Component):
    """Singly scattered moonlight: p = δ sin²γ / (1 + cos²γ), perpendicular to the scattering plane."""

    depolarisation: Scalar = param(
        unit="", about="δ, one for all patches and wavelengths", source=f"{PAPER}, eq. 8", scale=0.05
    )


class Standards(Component):
    """Catalogue Stokes parameters of the standard stars, in the equatorial frame."""

    names: tuple[str, ...] = eqx.field(static=True)
    q: Float[Array, " s"] = param(unit="", about="catalogue q", source="SOURCES table", scale=2e-4)
    u: Float[Array, " s"] = param(unit="", about="catalogue u", source="SOURCES table", scale=2e-4)

    def labels(self, field: str) -> Sequence[str]:
        """One name per star."""
        return tuple(f"{name}.{field}" for name in self.names)


class Polariser(Component):
    """Calibration polariser: a fixed extinction ratio, its axis is the encoder reading."""

    extinction: float = eqx.field(static=True, default=EXTINCTION)


class Collimator(Component):
    """Linear diattenuation of the lenses: (q, u) = c r² (cos 2φ, sin 2φ) + (c_q, c_u)."""

    diattenuation: Scalar = param(
        unit="deg-2", about="c, radial diattenuation of curved lenses", source=CONTRACT, width=0.003
    )
    q: Scalar = param(unit="", about="c_q, constant part", source=CONTRACT, width=0.0015)
    u: Scalar = param(unit="", about="c_u, constant part", source=CONTRACT, width=0.0015)


class HalfWavePlate(Component):
    """Quartz then MgF2 in contact, optic axes at the fast axis and at 90° from it."""

    quartz: Scalar = param(unit="um", about="quartz thickness", source=CONTRACT, width=1.0, optical=True)
    mgf2: Scalar = param(unit="um", about="MgF2 thickness", source=CONTRACT, width=1.0, optical=True)


class Pupil(Component):
    """Mapping from the field to the direction of the collimated beam."""

    magnification: Scalar = param(
        unit="", about="field-to-pupil magnification", source=CONTRACT, width=0.05, optical=True
    )
    distortion: Scalar = param(
        unit="deg-2", about="cubic distortion", source=CONTRACT, width=0.01, optical=True
    )


class Half(Component):
    """One half of the pupil: wedge, half-wave plate, Wollaston prism."""

    plate: HalfWavePlate
    wedge: Scalar = param(unit="rad", about="wedge angle", source=CONTRACT, width=0.001, optical=True)
    efficiency: Scalar = param(
        unit="", about="η of the analysers ½(1, ±η, 0, 0)", source=CONTRACT, width=0.0003
    )
    fast_axis: float = eqx.field(static=True, default=0.0)


class Throughput(Component):
    """Throughput of each camera as a Legendre series over the field (total degree `degree`)."""

    degree: int = eqx.field(static=True)
    coefficients: Float[Array, "4 t"] = param(
        unit="", about="Legendre coefficient P_i(x/0.3°) P_j(y/0.3°)", source=CONTRACT, scale=0.02, loose=0.5
    )

    def labels(self, field: str) -> Sequence[str]:
        """Camera and exponents: n0.p21 is camera N0, second degree in X, first in Y."""
        return tuple(f"{camera}.p{i}{j}" for camera in CAMERAS for i, j in legendre.terms(self.degree))


class Instrument(Component):
    """Everything that is fitted: light source, optics, cameras, and the effects that were added by name."""

    sky: MoonSky
    standard: Standards
    polariser: Polariser
    collimator: Collimator
    chwp: HalfWavePlate
    pupil: Pupil
    half1: Half
    half2: Half
    throughput: Throughput
    effects: tuple[Effect, ...] = ()
    plates: str = eqx.field(static=True, default="waves")

    @property
    def halves(self) -> tuple[Half, Half]:
        """Both halves of the pupil."""
        return self.half1, self.half2

    def effect(self, name: str) -> Effect:
        """The active effect of a name; ValueError when there is none."""
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise unknown_name("active effect", name, [effect.name for effect in self.effects])


PLATE_MODELS = ("waves", "fixed_axis")
INSTRUMENTS = ("WALOP-SOUTH", "WALOP-NORTH", "WALOP-LAB")

_QUARTZ, _MGF2 = 2407.0, 1930.0
# Paper II, section 4: 180° − δ = 0.321° (tilt/deg)² for all five tilts. Crossed quartz and MgF2 plates of zero
# order (δ = 180° at 0.62 µm) give its table of cross-talk in SDSS-r at this thickness, one free number: 474.2 µm
# fits best, to 0.6 points (`tests/model/test_lab.py`).
_LAB_MGF2 = 474.0


def zero_order_quartz(mgf2: float, wavelength: float = 0.62) -> float:
    """Quartz thickness (µm) that makes a half-wave plate of zero order with `mgf2` µm of MgF2."""
    from walop_jax.model import materials as m

    lam = jnp.asarray(wavelength)
    dn_mgf2 = float(m.MGF2_E.refractive_index(lam) - m.MGF2_O.refractive_index(lam))
    dn_quartz = float(m.QUARTZ_E.refractive_index(lam) - m.QUARTZ_O.refractive_index(lam))
    return (mgf2 * dn_mgf2 - 0.5 * wavelength) / dn_quartz


def nominal_instrument(
    name: str = "WALOP-SOUTH",
    *,
    standards: Sequence[tuple[str, float, float]] = (),
    effects: tuple[Effect, ...] = (),
    plates: str = "waves",
    throughput_degree: int = 4,
    throughput: float = 0.5,
) -> Instrument:
    """The instrument as designed.

    `standards` are (name, q, u) in the equatorial frame; `throughput` the level of all four cameras. Raises
    ValueError for an unknown instrument or plate model.
    """
    if name not in INSTRUMENTS:
        raise ValueError(f"unknown instrument {name!r}: choose one of {', '.join(INSTRUMENTS)}")
    if plates not in PLATE_MODELS:
        raise ValueError(f"unknown plate model {plates!r}: choose one of {', '.join(PLATE_MODELS)}")
    magnification = {"WALOP-SOUTH": 15.63, "WALOP-NORTH": 19.5, "WALOP-LAB": 1.0}[name]
    distortion = 0.0 if name == "WALOP-LAB" else 0.02
    wedge = 0.0 if name == "WALOP-LAB" else 0.230
    quartz, mgf2 = (_QUARTZ, _MGF2) if name != "WALOP-LAB" else (zero_order_quartz(_LAB_MGF2), _LAB_MGF2)
    coefficients = np.zeros((4, len(legendre.terms(throughput_degree))))
    coefficients[:, 0] = throughput
    names, q, u = zip(*standards, strict=True) if standards else ((), (), ())
    number = jnp.asarray
    plate = HalfWavePlate(quartz=number(quartz), mgf2=number(mgf2))
    halves = [
        Half(wedge=number(sign * wedge), plate=plate, efficiency=number(0.999), fast_axis=axis)
        for sign, axis in zip((-1.0, 1.0), FAST_AXES, strict=True)
    ]
    lens = 0.0 if name == "WALOP-LAB" else 0.012
    return Instrument(
        sky=MoonSky(depolarisation=number(0.8)),
        standard=Standards(names=tuple(names), q=number(np.array(q, float)), u=number(np.array(u, float))),
        polariser=Polariser(),
        collimator=Collimator(diattenuation=number(lens), q=number(0.0), u=number(0.0)),
        chwp=plate,
        pupil=Pupil(magnification=number(magnification), distortion=number(distortion)),
        half1=halves[0],
        half2=halves[1],
        throughput=Throughput(degree=throughput_degree, coefficients=number(coefficients)),
        effects=effects,
        plates=plates,
    )
