"""Elements with a formula each: simple matrices, the calibration polariser, lenses, analysers.

Sources     retarder: Paper II of WALOP-South, appendix B; diattenuator: Lu & Chipman 1996, JOSA A 13, 1106, eq. 18;
            depolariser: ibid., eq. 32, diagonal.
Limits      all are the identity at their neutral numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model import mueller
from walop_jax.model.conventions import FIELD_SCALE, REFERENCE_WAVELENGTH
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.elements.spectral import Curve, Scalar, WithCurves
from walop_jax.model.parameters import number, row
from walop_jax.model.ray import Ray
from walop_jax.model.sources import ExposureArrays


class Retarder(Element):
    """A linear retarder, the same over the field, with a retardance that may go as 1/λ."""

    delta: Scalar = number("rad", "retardance")
    axis: Scalar = number("deg", "fast axis, from +X toward +Y")
    wavelength: Scalar | None = number(
        "um", "wavelength of that retardance, which goes as 1/λ; none: achromatic", default=None
    )

    kind: ClassVar[str] = "retarder"
    reference: ClassVar[str] = "Maharana et al. 2022, Paper II, appendix B"

    def mueller(self, ray: Ray) -> Mueller:
        """Mueller matrix (4, 4), or (n, 4, 4) at n wavelengths, of the retarder."""
        delta = self.delta if self.wavelength is None else self.delta * self.wavelength / ray.wavelength
        return mueller.retarder(delta, jnp.deg2rad(self.axis))

    def retardances(self, wavelength: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], ...]:
        """The retardance in waves at wavelengths (µm), net and in sum alike; empty if it is achromatic."""
        if self.wavelength is None:
            return ()
        waves = float(self.delta) / (2.0 * np.pi) * float(self.wavelength) / wavelength
        return waves, waves


class Rotator(Element):
    """Stokes parameters referred to turned axes: by a constant, and more for oblique rays.

    Equation: angle + skew · k_x k_y (rad), from +X toward +Y, k the direction in air. Ahead of an analyser it turns the
    analyser: beams of a crystal prism are polarised along n × k for an optic axis n. To second order that is skew
    = 1/(2 N²) for an optic axis along Y and −1/(2 N²) along X, in a medium of index N.
    """

    angle: Scalar = number("deg", "rotation, from +X toward +Y")
    skew: Scalar = number("", "rotation (rad) of oblique rays, per unit of k_x k_y")

    kind: ClassVar[str] = "rotator"
    reference: ClassVar[str] = "Chipman, Lam & Young 2018, Polarized Light and Optical Systems, ch. 17"

    def mueller(self, ray: Ray) -> Mueller:
        """Mueller matrix (4, 4) of the rotation for the direction of a ray."""
        return mueller.rotation(jnp.deg2rad(self.angle) + self.skew * ray.kx * ray.ky)


class Diattenuator(Element):
    """A linear diattenuator, the same over the field."""

    q: Scalar = number("", "diattenuation along +X")
    u: Scalar = number("", "diattenuation along +45°")
    axis: Scalar = number("deg", "angle by which its axes are turned, from +X toward +Y")

    kind: ClassVar[str] = "diattenuator"
    reference: ClassVar[str] = "Lu & Chipman 1996, JOSA A 13, 1106"

    def mueller(self, ray: Ray) -> Mueller:
        """Mueller matrix (4, 4) of the diattenuator."""
        twice = 2.0 * jnp.deg2rad(self.axis)
        cos, sin = jnp.cos(twice), jnp.sin(twice)
        return mueller.diattenuator(self.q * cos - self.u * sin, self.q * sin + self.u * cos)


class Depolariser(Element):
    """Depolarisation: a fraction of the polarisation is lost, of the linear and of the circular part."""

    linear: Scalar = number("", "fraction of q and u that is lost")
    circular: Scalar = number("", "fraction of v that is lost")

    kind: ClassVar[str] = "depolariser"
    reference: ClassVar[str] = "Lu & Chipman 1996, JOSA A 13, 1106"

    def mueller(self, ray: Ray) -> Mueller:
        """Mueller matrix (4, 4) of the depolariser, diagonal."""
        remaining = 1.0 - self.linear
        return jnp.diag(jnp.stack([jnp.ones_like(remaining), remaining, remaining, 1.0 - self.circular]))


class AddedPolarisation(Element):
    """(0, q, u, 0) per unit of light is added, as by mirrors of a telescope to weakly polarised light."""

    q: Scalar = number("", "polarisation added along +X")
    u: Scalar = number("", "polarisation added along +45°")

    kind: ClassVar[str] = "added_polarisation"
    reference: ClassVar[str] = "Patat & Taubenberger 2011, A&A 529, A57"

    def mueller(self, ray: Ray) -> Mueller:
        """[[1, 0], [(q, u, 0)ᵀ, 1]]: not a physical Mueller matrix beyond first order in q and u."""
        return jnp.eye(4).at[1, 0].add(self.q).at[2, 0].add(self.u)


FOLLOWING = ("cos1", "sin1", "cos2", "sin2")


class AnalysisVector(Element):
    """The response of a camera behind unknown optics: a free row of a Mueller matrix.

    Equation    M = [a, 0, 0, 0], a = (1, q, u, v) + Σ_m (c_m cos m φ + s_m sin m φ): the detected light is a · S
    Symbols     q, u, v response to fully polarised light over that to unpolarised light, its scale being throughput
                φ angle of a followed element (`moves`); c_m, s_m changes of the response to I, Q, U, V, as by an
                element that turns and deviates the beam, m = 1 to first order in the deviation, 2 to second order
    Source      analysis vector of a division-of-amplitude polarimeter: Azzam 1985, Opt. Acta 32, 1407
    Limits      q² + u² + v² = 1: an ideal elliptical analyser; 0: a detector insensitive to polarisation
    """

    q: Scalar = number("", "response to light polarised along +X")
    u: Scalar = number("", "response to light polarised along +45°")
    v: Scalar = number("", "response to circularly polarised light")
    cos1: Curve | None = row("", "change with cos φ of the response to I, Q, U, V")
    sin1: Curve | None = row("", "change with sin φ")
    cos2: Curve | None = row("", "change with cos 2φ")
    sin2: Curve | None = row("", "change with sin 2φ")
    axis: Scalar = number("deg", "added to the angle that it follows")

    kind: ClassVar[str] = "analysis_vector"
    reference: ClassVar[str] = "Azzam 1985, Opt. Acta 32, 1407"

    def mueller(self, ray: Ray) -> Mueller:
        """Mueller matrix (4, 4) with the analysis vector as its first row; the light behind it is unpolarised."""
        row, angle = jnp.stack([jnp.ones_like(self.q), self.q, self.u, self.v]), jnp.deg2rad(self.axis)
        for name in FOLLOWING:
            if (change := getattr(self, name)) is not None:
                row = row + getattr(jnp, name[:3])(int(name[3:]) * angle) * change
        return jnp.zeros((4, 4)).at[0].set(row)

    def __check_init__(self) -> None:
        for name in FOLLOWING:
            change = getattr(self, name)
            if change is not None and jnp.ndim(change) == 1 and len(change) != 4:
                raise ValueError(f"{name} has {len(change)} values; one each for I, Q, U and V is needed")

    def labels(self, field: str) -> Sequence[str]:
        """Elements of a row are called after their Stokes parameters: `camera1.cos1.q`."""
        return tuple(f"{field}.{component}" for component in "iquv") if field in FOLLOWING else (field,)


# -------------------------------------------------------------------------------------------- the calibration polariser


class Polariser(Element):
    """A polariser whose axis is read from an encoder: the light behind it is independent of the incoming polarisation.

    Equation    light behind it (1, c cos 2θ, c sin 2θ, v), c = (1 − ε)/(1 + ε), per unit of transmitted light
                θ = reading + zero
    Symbols     θ transmission axis in the instrument frame; ε extinction ratio, unwanted over wanted transmission;
                v circular polarisation behind it; reading: encoder [deg]
    Source      Malus' law for a polariser of finite extinction: Goldstein 2003, Polarized Light, ch. 9.
    Limits      ε = 0 is the ideal polariser. Its effect on the flux of polarised light is part of the unknown flux.
    """

    extinction: Scalar = number("", "ε, unwanted over wanted transmission")
    zero: Scalar | None = number("deg", "added to the encoder reading", default=None)
    ellipticity: Scalar | None = number("", "circular polarisation behind it", default=None)
    films: tuple[Any, ...] = ()  # layers behind it (`effects.optics.Film`)

    kind: ClassVar[str] = "polariser"
    reference: ClassVar[str] = "Goldstein 2003, Polarized Light, ch. 9"

    def light(self, exposures: ExposureArrays, x: Scalar, y: Scalar) -> Float[Array, "e 4"]:
        """Stokes vectors (e, 4) behind the polariser at a field point, per unit of transmitted light."""
        angle = exposures.clp_angle if self.zero is None else exposures.clp_angle + jnp.deg2rad(self.zero)
        behind = mueller.polarised(angle, self.extinction)
        if self.ellipticity is not None:
            behind = behind.at[:, 3].add(self.ellipticity)
        for film in self.films:
            behind = film.through(behind, exposures, x, y)
        return behind


# --------------------------------------------------------------------------------------------------------------- lenses

PAPER_II = "Maharana et al. 2022, Paper II"


class Collimator(Element):
    """Weak linear diattenuation: a radial part and a constant one.

    Equation    diattenuation (q, u) = c r² (cos 2φ, sin 2φ) + (c_q, c_u)
    Symbols     r, φ polar coordinates of the field point [deg]; c [deg⁻²]
    Source      Fresnel transmission of curved surfaces, ∝ r²: Paper II of WALOP-South (Maharana et al. 2022)
    Limits      nothing on the axis but (c_q, c_u)
    """

    diattenuation: Scalar = number("deg-2", "c, radial diattenuation of curved lenses")
    q: Scalar = number("", "c_q, constant part")
    u: Scalar = number("", "c_u, constant part")

    kind: ClassVar[str] = "collimator"
    reference: ClassVar[str] = PAPER_II

    def mueller(self, ray: Ray) -> Mueller:
        """Mueller matrix (4, 4) of the diattenuation at the field point of a ray."""
        q = self.diattenuation * (ray.x**2 - ray.y**2) + self.q
        u = self.diattenuation * 2.0 * ray.x * ray.y + self.u
        return mueller.diattenuator(q, u)


class RadialRetarder(Element):
    """Retardance with a radial fast axis, growing with the square of the field radius.

    Equation    Δ = 2π (delta + slope u + bend u²) (r/h)², fast axis radial, u = λ − 0.62 µm (coatings)
    Symbols     r, φ polar coordinates of the field point [deg]; delta in waves at h, 0.3° unless `scale` says
    Source      stress of mounted lenses, ∝ r²: Selbing 2010, arXiv:1010.4142; Patat & Romaniello 2006, PASP 118, 146.
    Limits      written with (1 − cos Δ)/Δ² and sin Δ/Δ, both smooth at the centre of the field, Δ(cos 2φ, sin 2φ) being
                k (x² − y², 2xy)
    """

    delta: Scalar = number("wave", "retardance at the radius `scale`, 0.3° unless given (and 0.62 µm)")
    slope: Scalar | None = number("wave/um", "change of it with wavelength", default=None)
    bend: Scalar | None = number("wave/um2", "the same, per square of λ − 0.62 µm", default=None)
    scale: float = eqx.field(static=True, default=FIELD_SCALE)  # h, degrees

    kind: ClassVar[str] = "radial_retarder"
    reference: ClassVar[str] = "Selbing 2010, arXiv:1010.4142; Patat & Romaniello 2006, PASP 118, 146"

    def mueller(self, ray: Ray) -> Mueller:
        """Mueller matrix (4, 4), or (n, 4, 4) where it depends on wavelength; smooth at the centre of the field."""
        x, y, delta = ray.x, ray.y, self.delta
        if self.slope is not None:
            delta = delta + self.slope * (ray.wavelength - REFERENCE_WAVELENGTH)
        if self.bend is not None:
            delta = delta + self.bend * (ray.wavelength - REFERENCE_WAVELENGTH) ** 2
        k = 2.0 * jnp.pi * delta / self.scale**2
        return mueller.general_retarder(k * (x**2 - y**2), k * 2.0 * x * y)


# ------------------------------------------------------------------------------------------------------------ analysers


class Analyser(WithCurves):
    """A polarising beam splitter: two beams, one for each of its cameras; with a single camera the first alone.

    Equation    beams of an arm ½ (1, ±η cos 2α, ±η sin 2α, 0), first camera +, with η ± ξ in the place of η
                with a dispersion κ the first camera sees the band at λ (1 + κ), the second at λ (1 − κ), to first
                order: M → M ± κ λ ∂M/∂λ, M the train ahead of the analyser
                with balance g and loss l, curves over wavelength taken at the mean wavelength of a band, the beams of
                η = 1 are ½ (1 ± g) (1, ±(1 − l) cos 2α, ±(1 − l) sin 2α, 0): differences from band to band
    Symbols     η efficiency, near 1, ξ half its difference between the beams; α axis of the first beam, from +X toward
                +Y; κ half the relative difference of the wavelengths of the two beams
    Source      Wollaston prism as a pair of crossed analysers: Goldstein 2003, Polarized Light, ch. 9.
    Limits      no balance, no loss: as if g = l = 0
                η = 1, α = 0 are ideal analysers along +X and +Y; κ = 0: both see the filter as it is.

    Two methods make the beams. `seen` takes the rows of the Mueller matrix ahead of the analyser that its beams are
    made of; they depend on wavelength and enter the band integral. `beam_weights` holds the coefficients with which
    each beam adds these rows; they do not depend on the light, and multiply afterwards.
    """

    efficiency: Scalar = number("", "η of the analysers ½(1, ±η, 0, 0)", default=1.0)
    contrast: Scalar | None = number("", "ξ, half the difference of the efficiencies", default=None)
    angle: Scalar | None = number("deg", "rotation of the analysers", default=None)
    dispersion: Scalar | None = number("", "κ, first beam at λ (1 + κ), second at λ (1 − κ)", default=None)
    balance: Curve | None = row("", "half the relative difference of the beams at `balance_at`")
    loss: Curve | None = row("", "fraction of the polarisation lost at `loss_at`")
    balance_at: tuple[float, ...] = eqx.field(static=True, default=())
    loss_at: tuple[float, ...] = eqx.field(static=True, default=())
    cameras: tuple[str, ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = "analyser"
    reference: ClassVar[str] = "Goldstein 2003, Polarized Light, ch. 9"

    rows: ClassVar[int] = 2

    def seen(self, mueller: Float[Array, "*n 4 4"]) -> Float[Array, "*n 2 4"]:
        """Rows of the Mueller matrix ahead of it that form the beams: S0 and the analysed component."""
        analysed = mueller[..., 1, :]
        if self.angle is not None:
            twice = 2.0 * jnp.deg2rad(self.angle)
            analysed = jnp.cos(twice) * mueller[..., 1, :] + jnp.sin(twice) * mueller[..., 2, :]
        return jnp.stack([mueller[..., 0, :], analysed], axis=-2)

    def in_band(self, rows: Float[Array, "b r 4"], wavelength: Float[Array, " b"]) -> Float[Array, "b r 4"]:
        """Band-integrated rows of `seen` (or of their slopes) with balance and loss, at mean wavelengths (µm)."""
        total, analysed = rows[:, 0], rows[:, 1]
        if self.loss is not None:
            analysed = (1.0 - self.curve("loss", wavelength))[:, None] * analysed
        if self.balance is not None:
            g = self.curve("balance", wavelength)[:, None]
            total, analysed = total + g * analysed, analysed + g * total
        return jnp.stack([total, analysed], axis=1)

    def beam_weights(self) -> Float[Array, "k 2"]:
        """Coefficients (k, 2) with which each beam adds the two rows of `seen`; a single camera has the first beam
        alone.
        """
        half = 0.5 * jnp.ones_like(self.efficiency)
        extra = jnp.zeros_like(half) if self.contrast is None else 0.5 * self.contrast
        along = 0.5 * self.efficiency
        beams = jnp.stack([jnp.stack([half, along + extra]), jnp.stack([half, extra - along])])
        return beams[: len(self.cameras)] if self.cameras else beams

    def beam_weights_of_slopes(self) -> Float[Array, "k 2"]:
        """Coefficients (k, 2) with which each beam adds λ ∂/∂λ of the two rows of `seen`; 0 without dispersion."""
        kappa = jnp.zeros_like(self.efficiency) if self.dispersion is None else self.dispersion
        weights = self.beam_weights()
        return weights * jnp.stack([kappa, -kappa])[: len(weights), None]
