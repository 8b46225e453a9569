"""Changes of the optics: retardance, diattenuation, depolarisation, a turn; displacement of the field; fringes.

Equation    M → M_Δ M_R M_D M at one place of the train, with
            M_R = exp Σ r_i G_i (a retarder), M_D the diattenuator of vector d, M_Δ = diag(1, k_q, k_u, k_v)
Symbols     r, d sums of amplitude × factor along q, u, v; radial: x² − y² along q, 2xy along u (in units of the field);
            diagonal: −2xy and x² − y²; k = 1 − its lost fraction; a turn by α is r_v = −2α
Source      Lu & Chipman 1996, JOSA A 13, 1106: every Mueller matrix near the identity is such a product
Limits      exact for one kind at a place; the order of several kinds matters at second order
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model import mueller
from walop_jax.model.effects.change import (
    KINDS,
    OF_RAY,
    SINGLE,
    SLOW,
    AtPoint,
    Change,
    ChangeKind,
    Combinations,
    Grows,
    InTrain,
    Scalar,
    SlotTerm,
    Term,
    in_exposures,
    itself,
    product,
    with_factors,
)
from walop_jax.model.effects.factors import EXPOSURE, FIELD, SHAPE, WAVELENGTH
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.elements.wave_plate import AirGap
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import Component
from walop_jax.model.ray import Ray
from walop_jax.model.sources import ExposureArrays

SOURCE = "Lu & Chipman 1996, JOSA A 13, 1106"
LARGEST_GAP = 60.0  # µm of air


AXES = ("q", "u", "v", "radial", "diagonal")
GENERATORS = tuple(
    f"{what} {axis}" for what in ("diattenuation", "retardance", "depolarisation") for axis in "quv"
)
"""Basic kinds: all others are sums of these."""
ADDED = ("added polarisation q", "added polarisation u")
DISPLACEMENTS = ("displacement x", "displacement y")
GROUPS = (
    *(tuple(f"{what} {axis}" for axis in "qu") for what in ("diattenuation", "retardance")),
    ("diattenuation v",),
    ("retardance v",),
    ("depolarisation",),
    *((f"{what} {axis}",) for what in ("diattenuation", "retardance") for axis in ("radial", "diagonal")),
)
"""Kinds in a diagnosis, grouped by phenomenon."""


def generators_of(kind: str) -> tuple[tuple[str, float, tuple[str, ...]], ...]:
    """The `GENERATORS` of a kind, with coefficients and factors."""
    what, _, axis = kind.partition(" ")
    if what == "turn":  # a circular retarder
        return (("retardance v", -2.0 * np.pi / 180.0, ()),)
    if kind == "depolarisation":
        return tuple((f"depolarisation {axis}", 1.0, ()) for axis in "quv")
    if axis == "radial":
        return (f"{what} q", 1.0, ("x2-y2",)), (f"{what} u", 1.0, ("xy",))
    if axis == "diagonal":
        return (f"{what} q", -1.0, ("xy",)), (f"{what} u", 1.0, ("x2-y2",))
    return ((kind, 1.0, ()),)


def matrix_of(terms: Sequence[tuple[Change, Any]], x: Any, y: Any) -> Mueller:
    """Mueller matrix of changes of given sizes (amplitude × factor; arrays) at a field point (deg).

    Polarisation that is `ADDED` is added to the light that has passed all other changes.
    """
    sums: dict[str, Any] = {}  # retardance (rad), diattenuation; the fraction that is lost
    added = list[tuple[str, Any]]()
    for change, size in terms:
        if change.kind in ADDED:
            added.append((change.kind, jnp.asarray(size)))
            continue
        for name, coefficient, factors in generators_of(change.kind):
            by = coefficient * product(factors, AtPoint(x, y), change.units)
            sums[name] = sums.get(name, 0.0) + by * size
    matrix = near_identity(sums) if sums else jnp.eye(4)
    for kind, size in added:
        matrix = matrix + size[..., None, None] * generator(kind) @ matrix
    return matrix


def near_identity(sums: Mapping[str, Any]) -> Mueller:
    """Mueller matrix of the sizes of some `GENERATORS`."""
    matrix = mueller.product(
        make(*(jnp.asarray(sums.get(f"{what} {axis}", jnp.zeros(()))) for axis in "quv"))
        for what, make in (("diattenuation", mueller.diattenuator), ("retardance", mueller.general_retarder))
        if any(name.startswith(what) for name in sums)
    )
    if any(name.startswith("depolarisation") for name in sums):
        lost = [jnp.asarray(sums.get(f"depolarisation {axis}", 0.0)) for axis in "quv"]
        remaining = 1.0 - jnp.stack(jnp.broadcast_arrays(jnp.zeros(()), *lost), axis=-1)[..., None]
        matrix = remaining * (jnp.eye(4) if matrix is None else matrix)
    assert matrix is not None
    return matrix


def generator(kind: str) -> Float[np.ndarray, "4 4"]:
    """∂M/∂size at the identity of one of `GENERATORS` or `ADDED`, in closed form."""
    what, _, axis = kind.rpartition(" ")
    slope, along = np.zeros((4, 4)), 1 + "quv".index(axis)
    if what == "diattenuation":
        slope[0, along] = slope[along, 0] = 1.0
    elif what == "retardance":  # the Stokes vector turned about the axis
        first, second = 1 + along % 3, 1 + (along + 1) % 3
        slope[first, second], slope[second, first] = 1.0, -1.0
    elif what == "depolarisation":
        slope[along, along] = -1.0
    else:
        slope[along, 0] = 1.0
    return slope


class Terms(Element):
    """Changes at one place of the train."""

    amplitudes: tuple[Scalar, ...] = ()
    axis: Scalar | float = 0.0
    changes: tuple[Change, ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = "described"

    def mueller(self, ray: Ray) -> Mueller:
        """Mueller matrices of all the changes together at the wavelengths of a ray."""
        terms = zip(self.changes, self.amplitudes, strict=True)
        return matrix_of(with_factors(terms, InTrain(ray, self.axis)), ray.x, ray.y)


class Film(Component):
    """Changes of light that vary from exposure to exposure, ahead of the polariser or behind it.

    Ahead of the polariser they act on light from the sky; behind it they act at the angle of the polariser, and only
    when it is in.
    """

    amplitudes: tuple[Scalar, ...]
    changes: tuple[Change, ...] = eqx.field(static=True)

    def through(
        self, light: Float[Array, "e 4"], exposures: ExposureArrays, x: Scalar, y: Scalar
    ) -> Float[Array, "e 4"]:
        """Stokes vectors (e, 4) behind the film at a field point, one for each exposure."""
        terms = zip(self.changes, self.amplitudes, strict=True)
        sizes = [(change, size * in_exposures(change, exposures, x, y)) for change, size in terms]
        return jnp.einsum("est,et->es", matrix_of(sizes, x, y), light)


@dataclasses.dataclass(frozen=True)
class Inside:
    """A factor: 1 while a moving element is in the beam, else 0."""

    prefix: str

    def __call__(self, at: Any) -> Any:
        """Its value (e), 0 or 1, in every exposure."""
        return np.isfinite(at.angle(self.prefix)) * 1.0


class Displaced(Element):
    """A displacement of the field point for the optics behind."""

    amplitudes: tuple[Scalar, ...] = ()
    changes: tuple[Change, ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = "described"

    def ray(self, ray: Ray) -> Ray:
        """The ray from the displaced field point."""
        x, y = ray.x, ray.y
        for change, size in zip(self.changes, self.amplitudes, strict=True):
            by = size * change.in_train(ray, 0.0)
            x, y = (x + by, y) if change.kind.endswith("x") else (x, y + by)
        return ray.moved(*jnp.broadcast_arrays(x, y))


def with_air_gap(instrument: Instrument, place: str, contrast: Scalar, gap: Scalar) -> Instrument:
    """The instrument with one more air gap (µm) ahead of a wave plate."""
    air_gap = AirGap(contrast, gap, LARGEST_GAP)
    return instrument.changed(place, air_gaps=lambda gaps: (*gaps, air_gap))


# ------------------------------------------------------------------------------------------------------- the kinds


def _at(change: Change) -> Hashable:
    return change.relation, change.place


def _columns(terms: Sequence[Term]) -> dict[str, Any]:
    changes, amplitudes = (tuple(column) for column in zip(*terms, strict=True))
    return {"changes": changes, "amplitudes": amplitudes}


def beside(instrument: Instrument, element: Element, relation: str, place: str) -> Instrument:
    """The instrument with `element` added "ahead of" or "behind" the element `place`; `relation` says which."""
    return instrument.inserted(element, **{"before" if relation == "ahead of" else "after": place})


_FIELD = ("even", "tilt", "r2", "astigmatic")
_NOT_IN_OTHER_KINDS = {"q": _FIELD[:3], "u": _FIELD[:3], "radial": _FIELD[:1], "diagonal": _FIELD[:1]}
_ANY = ("even", "any")
_ANYTHING = Combinations(_FIELD[:3], ("steady", "hours", "kelvin"), ("anything",))
# Exposures of one KIND show so few of nine kinds of polarisation that all of them would be two of them once more.
_ANYTHING_ELSE = Combinations(along=SINGLE, among=("anything",))
_TURN = (
    Combinations(_FIELD, ("steady", *SLOW)),
    Combinations(along=("harmonics to 6", *SINGLE, "side", "night", "step", "spell", "exposure")),
    Combinations(("tilt", "r2"), ("harmonics to 1",)),  # a beam that wanders over a non-uniform film
)


def _grows(instrument: Instrument, change: Change) -> Grows:
    """Optics: with the quantities of a ray and the angle of their element; the polariser: by exposure."""
    kind, polariser = change.kind, instrument.polariser
    over = _NOT_IN_OTHER_KINDS.get(kind.rpartition(" ")[2], _FIELD)
    always = Combinations(over, ("steady", *SLOW))
    if change.is_of_sky(instrument):
        single = Combinations(_ANY, SINGLE), Combinations(over[:3], ("kind",))
        return Grows((FIELD, EXPOSURE), None, (always, *single, _ANYTHING, _ANYTHING_ELSE))
    if change.relation != "of":
        further = (
            Combinations(over, ("colour",)),
            Combinations(_ANY, OF_RAY),
            Combinations(among=("all",)),
            _ANYTHING,
            _ANYTHING_ELSE._replace(along=("per EXPTIME",)),
        )
        return Grows((FIELD, WAVELENGTH, EXPOSURE), tried=(always, *further))
    if polariser is not None and change.place == polariser.name:
        waves, single = Combinations(over, ("harmonics to 2",)), Combinations(_ANY, (*SINGLE, "side"))
        film = always, waves, single, _ANYTHING, _ANYTHING_ELSE
        as_a_turn = {"turn": _TURN, "retardance v": ()}
        return Grows((FIELD, EXPOSURE), None, as_a_turn.get(kind, film))
    moves, waves = instrument.element(change.place).moves or "", Combinations(over, ("harmonics to 2",))
    tried = (Combinations(along=("step", "spell")),) if kind == "turn" else (waves, _ANYTHING)
    return Grows((FIELD, WAVELENGTH, EXPOSURE), moves, tried)


def _films_of_sky(instrument: Instrument, terms: Sequence[Term]) -> tuple[Instrument, list[Term]]:
    """The instrument with the terms ahead of the polariser that vary from exposure to exposure, and all other terms.

    Those act on the light of calibration exposures alone; the steady ones are in the light path of stars as well.
    """
    of_film, others = list[Term](), list[Term]()
    for term in terms:
        varies = any(item.depends_on == EXPOSURE for item in term[0].grows_with)
        (of_film if varies and term[0].is_of_sky(instrument) else others).append(term)
    if of_film:
        instrument = instrument.changed("", sky_films=lambda films: (*films, Film(**_columns(of_film))))
    return instrument, others


def _optics(instrument: Instrument, terms: Sequence[Term]) -> Instrument:
    """One more element at the place; in the beam together with a moving element or polariser of that place."""
    instrument, terms = _films_of_sky(instrument, terms)
    if not terms:
        return instrument
    change, polariser = terms[0][0], instrument.polariser
    if change.relation == "of" and polariser is not None and change.place == polariser.name:
        return instrument.changed(change.place, films=lambda films: (*films, Film(**_columns(terms))))
    moves = instrument.element(change.place).moves if change.relation == "of" else None
    element = Terms(name="described", moves=moves, **_columns(terms))
    return beside(instrument, element, change.relation, change.place)


def _slots(instrument: Instrument, change: Change) -> list[SlotTerm]:
    """Generators at a place of the train, also growing with the wavelength; at the polariser: of the light."""
    polariser, factors, stage, colour = instrument.polariser, change.factors, "light", ()
    if polariser is None or change.place != polariser.name or change.relation == "behind":
        stage, colour = "inserted", (factors.count("colour"),)
        factors = tuple(item for item in factors if item != "colour")
        moves = instrument.element(change.place).moves if change.relation == "of" else None
        factors = factors if moves is None else (*factors, Inside(moves))
    return [
        SlotTerm((stage, kind, change.relation, change.place, *colour), size, (*factors, *extra))
        for kind, size, extra in generators_of(change.kind)
    ]


def _added(instrument: Instrument, terms: Sequence[Term]) -> Instrument:
    """(0, q, u, 0) per unit of light added, as mirrors of a telescope do to weakly polarised light."""
    instrument, terms = _films_of_sky(instrument, terms)
    if not terms:
        return instrument
    change = terms[0][0]
    return beside(instrument, Terms(name="described", **_columns(terms)), change.relation, change.place)


def _grows_added(instrument: Instrument, change: Change) -> Grows:
    """All dependences for light from the sky, none behind the polariser."""
    tried = (
        Combinations(("tilt", "r2")),  # uniform over the field it is diattenuation
        Combinations(("even", "tilt", "r2"), SLOW),
        Combinations(along=(*SINGLE, "kind")),
        Combinations(("smooth",), ("kind",)),  # the sky beside the Moon differs from point to point
    )
    return Grows((FIELD, EXPOSURE), None, tried) if change.is_of_sky(instrument) else Grows()


def _displaced(instrument: Instrument, terms: Sequence[Term]) -> Instrument:
    return instrument.inserted(Displaced(name="described", **_columns(terms)), before=terms[0][0].place)


def _fringes(instrument: Instrument, terms: Sequence[Term]) -> Instrument:
    for change, size in terms:
        instrument = with_air_gap(instrument, change.place, size, jnp.asarray(change.gap))
    return instrument


def _slots_of_fringes(instrument: Instrument, change: Change) -> list[SlotTerm]:
    factors = tuple(item for item in change.factors if not str(item).startswith("gap "))
    return [SlotTerm(("fringes", change.place, change.gap), 1.0, factors)]


_OPTICAL = {f"retardance {axis}": "retardance" for axis in AXES} | {"turn": "angle"}
_OPTICAL |= {f"diattenuation {axis}": "share" for axis in AXES}
_OPTICAL |= {f"depolarisation{axis}": "share" for axis in ("", " q", " u", " v")}
KINDS |= {
    name: ChangeKind(amplitude, _optics, _at, grows=_grows, slots=_slots)
    for name, amplitude in _OPTICAL.items()
}
KINDS |= {name: ChangeKind("share", _added, _at, grows=_grows_added, slots=itself("light")) for name in ADDED}
_OF_FIELD = "the same angles at several hour angles, and a star at known pixels in each"
KINDS |= {
    name: ChangeKind(
        "displacement",
        _displaced,
        lambda change: change.place,
        _OF_FIELD,
        lambda *_: Grows((FIELD, EXPOSURE), tried=(Combinations(("even", "tilt", "r2"), ("steady", *SLOW)),)),
        slots=itself("whole"),
    )
    for name in DISPLACEMENTS
}
_OF_FRINGES = "narrow bands a nanometre apart, or the same band at another temperature"
KINDS["fringes"] = ChangeKind(
    "share",
    _fringes,
    test=_OF_FRINGES,
    grows=lambda *_: Grows((SHAPE,), tried=(Combinations(among=("alone", "all")),)),
    slots=_slots_of_fringes,
)
