"""Changes of the optics: retardance, diattenuation, depolarisation, a turn; displacement of the field; fringes.

Equation    M → M_Δ M_R M_D M at one place of the train, with
            M_R = exp Σ r_i G_i (a retarder), M_D the diattenuator of vector d, M_Δ = diag(1, k, k, k)
Symbols     r, d sums of amplitude × factor along q, u, v; radial: x² − y² along q and 2xy along u (in units of 0.3°);
            diagonal: −2xy and x² − y²; k = 1 − the share that is lost; a turn by α is r_v = −2α
Source      Lu & Chipman 1996, JOSA A 13, 1106: every Mueller matrix near the identity is such a product
Limits      exact for one kind at a place; which of several acts first is a matter of second order
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model import mueller
from walop_jax.model.effects.change import AtPoint, Change, Kind, Scalar, Term, in_exposures
from walop_jax.model.effects.factors import PLAIN
from walop_jax.model.elements import AddedPolarisation, AirGap
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.elements.simple import Film
from walop_jax.model.instrument import Instrument, NoSuchPlaceError
from walop_jax.model.ray import Ray
from walop_jax.model.sources import ExposureArrays

SOURCE = "Lu & Chipman 1996, JOSA A 13, 1106"
LARGEST_GAP = 60.0  # µm of air


class Small(NamedTuple):
    """Retardance (rad) and diattenuation along q, u, v, and the share of the polarisation that is lost."""

    retardance: tuple[Any, ...] = (0.0, 0.0, 0.0)
    diattenuation: tuple[Any, ...] = (0.0, 0.0, 0.0)
    lost: Any = 0.0

    def plus(self, other: Small) -> Small:
        """Both of them."""
        first, second = (
            tuple(a + b for a, b in zip(*pair, strict=True)) for pair in zip(self[:2], other[:2], strict=True)
        )
        return Small(first, second, self.lost + other.lost)


class Optical(Kind):
    """A kind that is a Mueller matrix near the identity."""

    @classmethod
    def small(cls, change: Change, size: Any, x: Any, y: Any) -> Small:
        """A change of a size (amplitude × factor) at a field point (deg)."""
        raise NotImplementedError

    @classmethod
    def together(cls, change: Change) -> tuple[type[Kind], Hashable]:
        """All that acts at one place."""
        return Optical, (change.where, change.place)

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """One more element at the place; of an element that moves, or of the polariser: in the beam only when it is."""
        changes, amplitudes = (tuple(column) for column in zip(*terms, strict=True))
        where, place, polariser = changes[0].where, changes[0].place, instrument.polariser
        if where == "of" and polariser is not None and place == polariser.name:
            film = PolariserFilm(amplitudes, changes)
            return instrument.changed(place, films=lambda films: (*films, film))
        own = Terms(name="described", amplitudes=amplitudes, changes=changes)
        if where != "of":
            return instrument.inserted(
                own, **({"before": place} if where == "ahead of" else {"after": place})
            )
        own = dataclasses.replace(own, moves=element_at(instrument, place).moves)
        return instrument.inserted(own, after=place)


def along(axis: str, size: Any, x: Any, y: Any) -> tuple[Any, ...]:
    """The components along q, u and v of something with an axis: q, u, v, radial or diagonal."""
    if axis in ("q", "u", "v"):
        return tuple(size if axis == one else 0.0 for one in "quv")
    point = AtPoint(x, y)
    straight, across = PLAIN["x2-y2"].value(point), PLAIN["xy"].value(point)
    if axis == "diagonal":
        straight, across = -across, straight
    return size * straight, size * across, 0.0


class Retardance(Optical):
    """A retarder (rad)."""

    names: ClassVar[tuple[str, ...]] = tuple(f"retardance {a}" for a in ("q", "u", "v", "radial", "diagonal"))
    parameter: ClassVar[str] = "retardance"

    @classmethod
    def small(cls, change: Change, size: Any, x: Any, y: Any) -> Small:
        """Along its axis."""
        return Small(retardance=along(change.kind.split()[1], size, x, y))


class Diattenuation(Optical):
    """A diattenuator."""

    names: ClassVar[tuple[str, ...]] = tuple(
        f"diattenuation {a}" for a in ("q", "u", "v", "radial", "diagonal")
    )
    parameter: ClassVar[str] = "share"

    @classmethod
    def small(cls, change: Change, size: Any, x: Any, y: Any) -> Small:
        """Along its axis."""
        return Small(diattenuation=along(change.kind.split()[1], size, x, y))


class Depolarisation(Optical):
    """A share of the polarisation is lost."""

    names: ClassVar[tuple[str, ...]] = ("depolarisation",)
    parameter: ClassVar[str] = "share"

    @classmethod
    def small(cls, change: Change, size: Any, x: Any, y: Any) -> Small:
        """The share."""
        del change, x, y
        return Small(lost=size)


class Turn(Optical):
    """Light turned (deg): of the polariser, its axis minus its reading."""

    names: ClassVar[tuple[str, ...]] = ("turn",)
    parameter: ClassVar[str] = "angle"

    @classmethod
    def small(cls, change: Change, size: Any, x: Any, y: Any) -> Small:
        """A circular retarder."""
        del change, x, y
        return Small(retardance=(0.0, 0.0, -2.0 * jnp.deg2rad(size)))


KINDS_OF_OPTICS: tuple[type[Optical], ...] = (Retardance, Diattenuation, Depolarisation, Turn)
OPTICAL = tuple(name for kind in KINDS_OF_OPTICS[:3] for name in kind.names)


def matrix_of(terms: Sequence[tuple[Change, Any]], x: Any, y: Any) -> Mueller:
    """Mueller matrix of changes of given sizes (amplitude × factor; arrays) at a field point (deg)."""
    whole = Small()
    for change, size in terms:
        (kind,) = (one for one in KINDS_OF_OPTICS if change.kind in one.names)
        whole = whole.plus(kind.small(change, size, x, y))
    matrix, kinds = None, {next(k for k in KINDS_OF_OPTICS if c.kind in k.names) for c, _ in terms}
    if Diattenuation in kinds:
        matrix = mueller.general_diattenuator(*jnp.broadcast_arrays(*map(jnp.asarray, whole.diattenuation)))
    if kinds & {Retardance, Turn}:
        retarder = mueller.general_retarder(*jnp.broadcast_arrays(*map(jnp.asarray, whole.retardance)))
        matrix = retarder if matrix is None else retarder @ matrix
    if Depolarisation in kinds:
        kept = 1.0 - jnp.asarray(whole.lost)[..., None, None] * jnp.array([[0.0], [1.0], [1.0], [1.0]])
        matrix = kept * (jnp.eye(4) if matrix is None else matrix)
    assert matrix is not None
    return matrix


@dataclasses.dataclass(frozen=True)
class _InTrain:
    """Quantities of a ray; `axis` (deg) is where the element stands that moves."""

    ray: Ray
    axis: Any

    def __getattr__(self, name: str) -> Any:
        known = self.ray if name in ("x", "y", "wavelength") else self.ray.conditions
        return getattr(known, name)

    def angle(self, prefix: str) -> Any:
        """That of the element itself."""
        del prefix
        return jnp.deg2rad(self.axis)


class Terms(Element):
    """Changes at one place of the train."""

    amplitudes: tuple[Scalar, ...] = ()
    axis: Scalar | float = 0.0
    changes: tuple[Change, ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = "described"

    def mueller(self, ray: Ray) -> Mueller:
        """All of them."""
        at = _InTrain(ray, self.axis)
        terms = zip(self.changes, self.amplitudes, strict=True)
        return matrix_of([(change, size * change.factor(at)) for change, size in terms], ray.x, ray.y)


class PolariserFilm(Film):
    """Changes of the polariser: what the light behind it meets when it is in."""

    amplitudes: tuple[Scalar, ...]
    changes: tuple[Change, ...] = eqx.field(static=True)

    def through(
        self, light: Float[Array, "e 4"], exposures: ExposureArrays, x: Scalar, y: Scalar
    ) -> Float[Array, "e 4"]:
        """All of them."""
        terms = zip(self.changes, self.amplitudes, strict=True)
        sizes = [(change, size * in_exposures(change, exposures, x, y)) for change, size in terms]
        return jnp.einsum("est,et->es", matrix_of(sizes, x, y), light)


def element_at(instrument: Instrument, place: str) -> Element:
    """An element by the name that `inserted` takes. Raises `NoSuchPlaceError` where there is none."""
    arm, _, name = place.rpartition(".")
    trains = [one.train() for one in instrument.arms if one.name == arm] if arm else [instrument.train()]
    for element in (element for train in trains for element in train):
        if element.name == name:
            return element
    raise NoSuchPlaceError(f"the instrument has no element {place!r}")


# ------------------------------------------------------------------------------- other elements of the train


class Added(Kind):
    """(0, q, u, 0) per unit of light added, as mirrors of a telescope do to weakly polarised light."""

    names: ClassVar[tuple[str, ...]] = ("added polarisation q", "added polarisation u")
    parameter: ClassVar[str] = "share"

    @classmethod
    def together(cls, change: Change) -> tuple[type[Kind], Hashable]:
        """Both at one place."""
        return cls, (change.where, change.place)

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """One more element."""
        change, own = terms[0][0], {"q": jnp.zeros(()), "u": jnp.zeros(())}
        for one, size in terms:
            own[one.kind[-1]] = own[one.kind[-1]] + size
        side = "before" if change.where == "ahead of" else "after"
        return instrument.inserted(
            AddedPolarisation(name="described", q=own["q"], u=own["u"]), **{side: change.place}
        )


class Displaced(Element):
    """A change of where the optics behind see the field point."""

    amplitudes: tuple[Scalar, ...] = ()
    changes: tuple[Change, ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = "described"

    def ray(self, ray: Ray) -> Ray:
        """The ray from the place that the optics behind see."""
        x, y, at = ray.x, ray.y, _InTrain(ray, 0.0)
        for change, size in zip(self.changes, self.amplitudes, strict=True):
            by = size * change.factor(at)
            x, y = (x + by, y) if change.kind.endswith("x") else (x, y + by)
        return ray.moved(*jnp.broadcast_arrays(x, y))


class Displacement(Kind):
    """The field displaced (deg), as the optics behind a place see it."""

    names: ClassVar[tuple[str, ...]] = ("displacement x", "displacement y")
    parameter: ClassVar[str] = "displacement"
    test: ClassVar[str] = "the same angles at several hour angles, and a star at known pixels in each"

    @classmethod
    def together(cls, change: Change) -> tuple[type[Kind], Hashable]:
        """Both directions."""
        return cls, change.place

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """One more element."""
        changes, amplitudes = (tuple(column) for column in zip(*terms, strict=True))
        moved = Displaced(name="described", amplitudes=amplitudes, changes=changes)
        return instrument.inserted(moved, before=changes[0].place)


class Fringes(Kind):
    """Fringes of an air gap ahead of a wave plate: D = a cos(4π gap cos ϑ / λ) along its fast axis."""

    names: ClassVar[tuple[str, ...]] = ("fringes",)
    parameter: ClassVar[str] = "share"
    test: ClassVar[str] = "narrow bands a nanometre apart, or the same band at another temperature"

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """One more air gap ahead of the plate."""
        for change, size in terms:
            instrument = with_air_gap(instrument, change.place, size, jnp.asarray(change.gap))
        return instrument


def with_air_gap(instrument: Instrument, place: str, contrast: Scalar, gap: Scalar) -> Instrument:
    """The instrument with one more air gap (µm) ahead of a wave plate."""
    own = AirGap(contrast, gap, LARGEST_GAP)
    return instrument.changed(place, air_gaps=lambda gaps: (*gaps, own))
