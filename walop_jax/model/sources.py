"""Sources of light, one class for each KIND of exposures; `SOURCES` lists those of every instrument.

Moon sky    (q, u) = δ (q₁, u₁) − p (q₁, u₁)/|(q₁, u₁)| + (q_e, u_e), (q₁, u₁) single Rayleigh scattering:
            p₁ = sin²γ / (1 + cos²γ), perpendicular to the scattering plane; γ angle from the Moon; δ depolarisation,
            one for all patches and wavelengths; p degree lost by multiple scattering; q_e, u_e excess of a patch
Standards   (q + iu) in the instrument frame = (Q + iU) exp(−2i ROTATOR), catalogue values in the equatorial frame.
            The polarisation of a star with a colour in a band b is that in the band a of its value, times
            ⟨p⟩_b/⟨p⟩_a exp(2i turn (λ_b − λ_a)), p(λ) = exp(−K ln²(λmax/λ)), K = 1.66 λmax + 0.01, ⟨ ⟩ the mean over
            the photons of a band, λ (µm) their mean wavelength; inside a band it changes by its slope there
Sources     Maharana et al. 2022, Paper II, eq. 8; multiple scattering: Berry, Dennis & Lee 2004, New J. Phys. 6, 162;
            law of Serkowski, Mathewson & Ford 1975, ApJ 196, 261, with K of Whittet et al. 1992, ApJ 386, 562
Limits      λmax 0.4 to 0.8 µm, bands from 0.35 to 2 µm; bands are summed by three nodes, exact for p of fifth degree
            over a band with the shape of a Gaussian
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from walop_jax.data.kinds import KINDS, ExposureKind
from walop_jax.model.conventions import REFERENCE_WAVELENGTH
from walop_jax.model.parameters import Component, Scalar, number, param
from walop_jax.model.ray import NotPlannedError, within

PAPER_II = "Maharana et al. 2022, Paper II"
COLOUR_OF_STANDARDS = "Serkowski, Mathewson & Ford 1975, ApJ 196, 261; Whittet et al. 1992, ApJ 386, 562"
WHITTET = "Whittet et al. 1992, ApJ 386, 562: 0.55 µm, most stars within 0.1 µm"
TURN_SOURCE = "rms between V and R of the standards of Schmidt, Elston & Lupie 1992, AJ 104, 1563"
LMAX = 0.55  # µm
SHORTEST = 0.2  # µm: no λmax below


class ExposureArrays(eqx.Module):
    """Exposures as arrays of the light path, one element for each exposure (e).

    `kind` is the position of the KIND in `kinds`. Angles are in radians: `clp_angle` is 0 when the polariser is out,
    `rotator` is 0 where it has no meaning, and `moving` holds the angles of elements that move behind the polariser
    (NaN: out). `hours` count from the first exposure; temperature is in Celsius, the hour angle in h, the exposure time
    in s. `shared[e, s]` is 1 if exposure e belongs to flux group s; None if there are no such groups. `median_counts`
    are there only where a detector needs them. Where standards have a colour, `colour[e, s]` holds mean wavelength and
    rms width (µm) of the photons of standard s behind the filter of exposure e, and `slope_band` the band that is
    weighted with the distance from its mean wavelength (`Plan.slope`).
    """

    kind: Int[Array, " e"]
    clp_in: Bool[Array, " e"]
    clp_angle: Float[Array, " e"]
    flux_known: Bool[Array, " e"]
    rotator: Float[Array, " e"]
    hours: Float[Array, " e"]
    temperature: Float[Array, " e"]
    hour_angle: Float[Array, " e"]
    exptime: Float[Array, " e"]
    median_counts: Float[Array, "e k"] | None = None
    shared: Float[Array, "e s"] | None = None
    moving: Mapping[str, Float[Array, " e"]] = dataclasses.field(default_factory=dict)
    colour: Float[Array, "e s 2"] | None = None
    slope_band: Int[Array, " e"] | None = None
    kinds: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def wavelength(self) -> Any:
        """Mean wavelengths (µm, e) of the filters for the first star; the reference wavelength without colours."""
        return REFERENCE_WAVELENGTH if self.colour is None else self.colour[:, 0, 0]

    @property
    def median(self) -> Float[Array, "e k"]:
        """Median counts over the field in every exposure and camera (e, k). Raises `NotPlannedError` where they are
        missing.
        """
        if self.median_counts is None:
            raise NotPlannedError("median")
        return self.median_counts

    def between(self, start: str, stop: str) -> Bool[Array | np.ndarray, " e"]:
        """True in exposures of an interval of hours after the first one."""
        return within(self.hours, start, stop)

    def of_kind(self, name: str) -> Bool[Array | np.ndarray, " e"]:
        """True in exposures of a KIND."""
        return self.kind == (self.kinds.index(name) if name in self.kinds else -1)


class PointIllumination(NamedTuple):
    """The light that one field point sees, exposure by exposure.

    `sky` is (q, u) of singly scattered moonlight in the instrument frame, before depolarisation (δ = 1); `source` is
    the row of the standard star in SOURCES, −1 without one; `x`, `y` are field coordinates in degrees.
    """

    exposures: ExposureArrays
    sky: Float[Array, "e 2"]
    source: Int[Array, " e"]
    x: Scalar
    y: Scalar


class Source(Component):
    """Light of one KIND of exposures: its polarisation ahead of the instrument, per unit of flux.

    `kind` is the KIND in EXPOSURES, `facts` are the properties that all its exposures have, `reference` says where its
    assumptions are from. `MoonSky` is the source of the KIND `moon`.
    """

    name: ClassVar[str] = ""
    kind: ClassVar[str] = ""
    facts: ClassVar[ExposureKind] = ExposureKind()
    reference: ClassVar[str] = ""

    def shines(self, illumination: PointIllumination) -> Bool[Array, " e"]:
        """True (e) in the exposures of this source."""
        return jnp.asarray(illumination.exposures.of_kind(self.kind))

    def polarisation(self, illumination: PointIllumination) -> Float[Array, "e 2"]:
        """(q, u) of the light in the instrument frame (e, 2); unpolarised unless a source says otherwise."""
        return jnp.zeros((illumination.exposures.kind.shape[0], 2))


def turned(qu: Float[Array, "e 2"], angle: Float[Array, " e"]) -> Float[Array, "e 2"]:
    """(q, u) referred to axes turned by `angle` (rad): (q + iu) exp(−2i angle)."""
    cos, sin = jnp.cos(2 * angle), jnp.sin(2 * angle)
    return jnp.stack([qu[:, 0] * cos + qu[:, 1] * sin, qu[:, 1] * cos - qu[:, 0] * sin], axis=-1)


class MoonPatches(Component):
    """Polarisation of single Moon exposures beyond single scattering: q, u (m) added at `positions` in the list of
    exposures.
    """

    q: Float[Array, " m"]
    u: Float[Array, " m"]
    positions: tuple[int, ...] = eqx.field(static=True, default=())

    def joined(self, other: MoonPatches) -> MoonPatches:
        """The patches of both; where both have an exposure their q, u add up."""
        q, u = jnp.concatenate([self.q, other.q]), jnp.concatenate([self.u, other.u])
        return MoonPatches(q, u, (*self.positions, *other.positions))


class MoonSky(Source):
    """The moonlit sky: singly scattered moonlight, depolarised."""

    depolarisation: Scalar = param(
        "", "δ, one for all patches and wavelengths", f"{PAPER_II}, eq. 8", scale=0.05, default=0.8
    )
    missing: Scalar | None = number("", "degree taken away by multiple scattering", default=None)
    patches: MoonPatches | None = None

    name: ClassVar[str] = "sky"
    kind: ClassVar[str] = "moon"
    reference: ClassVar[str] = f"{PAPER_II}, eq. 8"

    def shines(self, illumination: PointIllumination) -> Bool[Array, " e"]:
        """True (e) in Moon exposures without the polariser."""
        return super().shines(illumination) & ~illumination.exposures.clp_in

    def polarisation(self, illumination: PointIllumination) -> Float[Array, "e 2"]:
        """(q, u) of the patch of sky at the field point (e, 2), in the instrument frame."""
        sky = illumination.sky
        qu = self.depolarisation * sky
        if self.missing is not None:
            power = jnp.sum(sky**2, axis=-1, keepdims=True)
            qu = qu - self.missing * sky / jnp.sqrt(jnp.where(power > 0, power, 1.0))
        if self.patches is not None:
            extra = jnp.stack([self.patches.q, self.patches.u], axis=-1)
            qu = qu.at[np.asarray(self.patches.positions, int)].add(extra)
        return qu


class Standards(Source):
    """Catalogue Stokes parameters of the standard stars, in the equatorial frame.

    A *value* is one (q, u) of a star in a band; there is one for each of `names`. `stars` holds for each value the
    number of the first value of its star, `bands` mean wavelength and rms width (µm) of its band; both are empty
    without colours, and a value then holds for any light. `unknown` are values whose band is unknown among those in
    which the star was observed. `changes` are added to the values in single exposures. HD_14069 known in V and R has
    two values, both with the same entry in `stars`.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    q: Float[Array, " s"] = param("", "catalogue q", "SOURCES table", scale=2e-4)
    u: Float[Array, " s"] = param("", "catalogue u", "SOURCES table", scale=2e-4)
    lmax: Float[Array, " c"] = param(
        "um", "wavelength of largest polarisation", WHITTET, width=0.1, default=()
    )
    turn: Float[Array, " c"] = param(
        "deg/um", "slope of the angle with wavelength", TURN_SOURCE, width=3.0, default=()
    )
    wavelength: Float[Array, " n"] = param(
        "um", "wavelength at which the catalogue value holds", "FILTER of EXPOSURES", default=()
    )
    bands: tuple[tuple[float, float], ...] = eqx.field(static=True, default=())
    stars: tuple[int, ...] = eqx.field(static=True, default=())
    unknown: tuple[int, ...] = eqx.field(static=True, default=())
    angle: Scalar | None = number("deg", "added to all position angles", default=None)
    share: Scalar | None = number(
        "", "fraction by which all degrees of polarisation are larger", default=None
    )
    changes: tuple[Any, ...] = ()  # `effects.numbers.GrownStandard`

    name: ClassVar[str] = "standard"
    kind: ClassVar[str] = "standard"

    @classmethod
    def coloured(
        cls,
        names: Sequence[str],
        qu: Float[np.ndarray, "2 s"],
        bands: Sequence[tuple[float, float]],
        stars: Sequence[int],
        unknown: Sequence[int] = (),
        lmax: float = LMAX,
    ) -> Standards:
        """Standards that follow the law of interstellar polarisation from band to band."""
        count = len(set(stars))
        numbers: dict[str, Any] = {
            "q": qu[0],
            "u": qu[1],
            "lmax": np.full(count, lmax),
            "turn": np.zeros(count),
            "wavelength": [bands[i][0] for i in unknown],
        }
        return cls(
            names=tuple(names), bands=tuple(bands), stars=tuple(stars), unknown=tuple(unknown), **numbers
        )

    @property
    def star_names(self) -> tuple[str, ...]:
        """One name for each star: that of its first value, without the band."""
        firsts = sorted(set(self.stars or range(len(self.names))))
        return tuple(self.names[i].partition(".")[0] for i in firsts)

    def labels(self, field: str) -> Sequence[str]:
        """One name for each value (q, u), or for each star (lmax, turn)."""
        if field in ("lmax", "turn"):
            return tuple(f"{name}.{field}" for name in self.star_names) if self.bands else ()
        names = [self.names[i] for i in self.unknown] if field == "wavelength" else self.names
        return tuple(f"{name}.{field}" for name in names)

    def shines(self, illumination: PointIllumination) -> Bool[Array, " e"]:
        """True (e) in exposures of a star that is in the list."""
        has_star = illumination.source >= 0
        return has_star if self.names else jnp.zeros_like(has_star)

    def values(self, source: Int[Any, "*p e"], colour: Float[Any, "e s 2"] | None) -> Int[Any, "*p e"]:
        """Number of the value used in each exposure: of the values of its star the one with the nearest band; −1 for
        none.
        """
        if colour is None or len(set(self.stars)) == len(self.names):
            return source
        observed = colour[jnp.arange(source.shape[-1]), source, 0]
        distance = jnp.abs(observed[..., None] - jnp.array([wavelength for wavelength, _ in self.bands]))
        nearest = jnp.argmin(
            jnp.where(jnp.array(self.stars) == source[..., None], distance, jnp.inf), axis=-1
        )
        return jnp.where(source >= 0, nearest, -1)

    def polarisation(self, illumination: PointIllumination) -> Float[Array, "e 2"]:
        """(q, u) of the star of each exposure (e, 2) in the instrument frame, the mean over the band."""
        if not self.names:
            return super().polarisation(illumination)
        return self._seen(illumination)[0]

    def slope(self, illumination: PointIllumination) -> Float[Array, "e 2"]:
        """Change of (q, u) with wavelength (e, 2; per µm) at the mean wavelength of the band; 0 without a star."""
        return jnp.where(illumination.source[:, None] >= 0, self._seen(illumination)[1], 0.0)

    def _seen(self, illumination: PointIllumination) -> tuple[Float[Array, "e 2"], Float[Array, "e 2"]]:
        """(q, u) in the instrument frame, and its slope."""
        colour = illumination.exposures.colour
        row = jnp.maximum(self.values(illumination.source, colour), 0)
        qu, rotator = jnp.stack([self.q[row], self.u[row]], axis=-1), illumination.exposures.rotator
        for change in self.changes:
            qu = qu.at[:, change.axis].add(
                jnp.where(row == change.value, change.size * change.factor(illumination.exposures), 0.0)
            )
        if self.share is not None:
            qu = (1.0 + self.share) * qu
        if self.angle is not None:
            rotator = rotator - jnp.deg2rad(self.angle)
        if colour is None or not self.bands:
            return turned(qu, rotator), jnp.zeros_like(qu)
        first, number = np.unique(self.stars, return_inverse=True)
        band = colour[jnp.arange(len(row)), jnp.asarray(first[number])[row]]
        catalogue_band = jnp.array(self.bands).at[np.array(self.unknown, int), 0].set(self.wavelength)[row]
        star = jnp.asarray(number)[row]
        lmax, turn = jnp.maximum(self.lmax[star], SHORTEST), jnp.deg2rad(self.turn[star])
        degree = mean_over_band(lmax, band) / mean_over_band(lmax, catalogue_band)
        observed = turned(degree[:, None] * qu, rotator - turn * (band[:, 0] - catalogue_band[:, 0]))
        # d/dλ of p exp(2i angle), relative to it
        rising = 2.0 * width_of_law(lmax) * jnp.log(lmax / band[:, 0]) / band[:, 0]
        across = jnp.stack([-observed[:, 1], observed[:, 0]], axis=-1)
        return observed, rising[:, None] * observed + 2.0 * turn[:, None] * across


def width_of_law(lmax: Array) -> Array:
    """K of Serkowski's law (Whittet et al. 1992), λmax in µm."""
    return 1.66 * lmax + 0.01


def mean_over_band(lmax: Array, band: Float[Array, "*e 2"]) -> Array:
    """Mean of exp(−K ln²(λmax/λ)) over bands of some mean wavelengths and rms widths (µm)."""
    total = 0.0
    for step, weight in ((-(3.0**0.5), 1 / 6), (0.0, 2 / 3), (3.0**0.5, 1 / 6)):
        wavelength = band[..., 0] + step * band[..., 1]
        total = total + weight * jnp.exp(-width_of_law(lmax) * jnp.log(lmax / wavelength) ** 2)
    return jnp.asarray(total)


class ThroughPolariser(Source):
    """Any source through the calibration polariser."""

    name: ClassVar[str] = "clp"
    kind: ClassVar[str] = "clp"


class Lamp(Source):
    """Light of unknown flux and polarisation near zero that enters behind the telescope."""

    name: ClassVar[str] = "lamp"
    kind: ClassVar[str] = "lamp"
    facts: ClassVar[ExposureKind] = KINDS[kind]


class KnownFlux(Source):
    """Unpolarised light of unit flux that enters behind the telescope, e.g. from an optical design program."""

    name: ClassVar[str] = "flux"
    kind: ClassVar[str] = "flux"
    facts: ClassVar[ExposureKind] = KINDS[kind]


class Steady(Source):
    """Unpolarised light behind the telescope, its flux unknown but the same in all exposures of a filter."""

    name: ClassVar[str] = "steady"
    kind: ClassVar[str] = "steady"
    facts: ClassVar[ExposureKind] = KINDS[kind]


SOURCES: tuple[type[Source], ...] = (MoonSky, Standards, ThroughPolariser, Lamp, KnownFlux, Steady)
