"""Slots: places of the light path at which it may be otherwise, and what a little of it there does to the light.

A slot is a change without factors (`effects.change`), or a part of one; what a change is in slots, its kind says
(`Kind.slots`). What multiplies a change, over the field or from exposure to exposure, multiplies its slot. At the point
at which nothing is changed the light path is differentiated in all slots at once: elements, fold, band integral and
patches are those that light takes.

    inserted    generators (`optics.GENERATORS`) at every place between two elements, by themselves and × (λ/λ₀ − 1)
    number      axis and thermal change of every wave plate; thickness, axis and cut of each of its layers
    whole       displacement of what the optics behind a mapping to the pupil see; shift of the bands
    throughput  of a camera, relative to itself; mixed: light of one camera in another
    fringes     of air ahead of a wave plate, which take more wavelength nodes than all others
    light       of sources, ahead of the polariser and of it: Stokes vectors behind it

Method      The rows that the analysers see are linear in the matrix of every station, so a change of that one is pushed
            through the fold alone; slots of different stations share the derivatives of their matrices.
Symbols     s slots, g generators, t changes of matrices, b bands, k cameras, r rows, c states, n nodes
Limits      first order.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model import fold, light
from walop_jax.model.compiled import array
from walop_jax.model.effects.cameras import CrossTalk
from walop_jax.model.effects.change import BAND, SKY, Change, patched
from walop_jax.model.effects.numbers import OF_POLARISER, OF_SOURCES
from walop_jax.model.effects.optics import ADDED, DISPLACEMENTS, GENERATORS, matrix_of, with_air_gap
from walop_jax.model.elements import Element, PupilMapping, WavePlate
from walop_jax.model.elements.base import Mueller
from walop_jax.model.elements.wave_plate import fringe
from walop_jax.model.instrument import Instrument, Scalar
from walop_jax.model.materials import REFERENCE_TEMPERATURE
from walop_jax.model.parameters import shapes_of
from walop_jax.model.plan import Plan
from walop_jax.model.ray import CONDITIONS, Conditions, Ray
from walop_jax.model.sources import MoonPatches, MoonSky, Sight, Standards

Slot = tuple[Any, ...]
OF_PLATE, OF_LAYER = ("axis", "thermal"), ("thickness", "axis", "cut")


class _Place(Element):
    """A place of a train at which there is nothing."""

    @classmethod
    def solved(cls, cases: Sequence[tuple[Any, Ray]]) -> list[Mueller | None]:
        return [None] * len(cases)


# ------------------------------------------------------------------------------------------------- places and names


def trains(instrument: Instrument) -> tuple[tuple[Element, ...], tuple[tuple[Element, ...], ...]]:
    """The elements behind the polariser, and those of the arms, of an instrument without effects (`patched`)."""
    return instrument.behind_polariser(), tuple(tuple(arm.train()) for arm in instrument.arms)


def _with_places(instrument: Instrument) -> tuple[tuple[Element, ...], tuple[tuple[Element, ...], ...]]:
    """The same with every place that differs in what acts behind it: of an only arm the first does not."""

    def each(elements: Iterable[Element], first: bool) -> Iterator[Element]:
        yield from [_Place()] * first
        for element in elements:
            yield from (element, _Place()) if acts(element) else (element,)

    common, arms = trains(instrument)
    return tuple(each(common, True)), tuple(tuple(each(arm, len(arms) > 1)) for arm in arms)


def acts(element: Element) -> bool:
    """True if an element does anything to polarisation."""
    return _acts(*shapes_of(element))


@functools.lru_cache(maxsize=1024)
def _acts(structure: Any, shapes: Any) -> bool:
    one, zero = array(np.ones(1)), array(np.zeros(()))

    def run(*arrays: Array) -> Any:
        element = jax.tree_util.tree_unflatten(structure, arrays)
        conditions = Conditions(band_width=0.1 * one, planned=dict.fromkeys(CONDITIONS, one))
        return element.mueller(Ray.entering(zero, zero, (0.62 * one, conditions)))

    return jax.eval_shape(run, *(jax.ShapeDtypeStruct(s, d) for s, d in shapes)) is not None


def _places(instrument: Instrument) -> dict[tuple[str, str], int]:
    """Number of the place ahead of, behind and at every element."""
    polariser, (common, arms) = instrument.polariser, _with_places(instrument)
    found = {} if polariser is None else {("behind", polariser.name): 0}
    numbers = itertools.count()

    def follow(elements: Iterable[Element], prefix: str, at: int) -> int:
        name = ""
        for element in elements:
            if isinstance(element, _Place):
                at = next(numbers)
            else:
                name = prefix + element.name
                found["ahead of", name] = at
            if name:
                found["behind", name] = found["of", name] = at
        return at

    behind = follow(common, "", 0)
    for arm, elements in zip(instrument.arms, arms, strict=True):
        last = follow(elements, f"{arm.name}.", behind)
        found["ahead of", f"{arm.name}.{arm.analyser.name}"] = last
    return found


def _is_plate(element: Element) -> bool:
    return isinstance(element, WavePlate) and bool(element.layers)


def _plates(instrument: Instrument) -> dict[str, WavePlate]:
    """The wave plates behind the polariser by their places, in the order in which light meets them, arm by arm."""
    common, arms = trains(instrument)
    every = [("", common), *((f"{arm.name}.", one) for arm, one in zip(instrument.arms, arms, strict=True))]
    return {f"{prefix}{e.name}": e for prefix, elements in every for e in elements if _is_plate(e)}  # pyright: ignore


def _numbers(instrument: Instrument) -> dict[Slot, tuple[int, int]]:
    """The numbers of wave plates: of which plate, and which one."""
    found: dict[Slot, tuple[int, int]] = {}
    for w, (place, plate) in enumerate(_plates(instrument).items()):
        each = [(kind, place) for kind in OF_PLATE]
        each += [(kind, f"{place}.{layer.name}") for layer in plate.layers for kind in OF_LAYER]
        found |= {("number", kind, "of", at): (w, t) for t, (kind, at) in enumerate(each)}
    return found


def _most(numbers: dict[Slot, tuple[int, int]]) -> int:
    """The largest count of numbers of a plate."""
    return 1 + max((t for _, t in numbers.values()), default=-1)


def _whole(instrument: Instrument) -> tuple[Slot, ...]:
    pupils = [element.name for element in trains(instrument)[0] if isinstance(element, PupilMapping)]
    return (
        *(("whole", kind, "ahead of", name) for name in pupils for kind in DISPLACEMENTS),
        ("whole", "shift", "of", BAND),
    )


def vector_slots(instrument: Instrument) -> dict[Slot, int]:
    """Positions of the slots of the analysis vectors of an instrument (`patched`) in `VectorSlopes.slopes`."""
    places, numbers, cameras = _places(instrument), _numbers(instrument), range(len(instrument.cameras))
    most, first = _most(numbers), 0
    found: dict[Slot, int] = {}
    for colour in (0, 1):
        for kind in GENERATORS:
            found |= {("inserted", kind, *where, colour): first + h for where, h in places.items()}
            first += 1 + max(places.values())
    found |= {slot: first + w * most + t for slot, (w, t) in numbers.items()}
    first += most * len(_plates(instrument))
    pairs = [(one, other) for one in cameras for other in cameras]
    rest = [*_whole(instrument), *(("throughput", k) for k in cameras), *(("mixed", *pair) for pair in pairs)]
    return found | {slot: first + i for i, slot in enumerate(rest)}


# ------------------------------------------------------------------------------------------------ analysis vectors


class VectorSlopes(NamedTuple):
    """Analysis vectors of light behind the polariser at a field point, and their slopes in `vector_slots`."""

    vectors: Float[Array, "b k 4"]
    slopes: Float[Array, "s b k 4"]


class _Banded(NamedTuple):
    """Band sums of the rows that the analysers see, and slopes: of generators at places, of plates, all together."""

    rows: Float[Array, "b r 4"]
    inserted: Float[Array, "m g h b r 4"]
    plates: Float[Array, "w g t b r 4"]
    whole: Float[Array, "u b r 4"]


def vector_slopes(instrument: Instrument, plan: Plan, x: Scalar, y: Scalar) -> VectorSlopes:
    """Slopes of the analysis vectors at a field point (deg)."""
    instrument = instrument.patched()
    numbers, whole, cameras = _numbers(instrument), _whole(instrument), len(instrument.cameras)
    most = _most(numbers)

    def moved(sizes: Float[Array, " t"]) -> Instrument:
        terms = [(Change(*slot[1:]), sizes[t]) for slot, (_, t) in numbers.items()]
        terms += [(Change(*slot[1:]), size) for slot, size in zip(whole, sizes[most:], strict=True)]
        return patched(instrument, terms)

    def mean(shift: Scalar) -> Float[Array, " b"]:
        own = patched(instrument, [(Change(*whole[-1][1:]), shift)])
        return light.band_weights(own, plan) @ light.node_wavelengths(own, plan)

    found = _banded(plan, (x, y), moved, (most, len(whole)), jnp.zeros(1))
    rows = [part.reshape(-1, *found.rows.shape) for part in found[1:]]
    throughput, pairs = instrument.throughput.at(x, y), tuple(np.ndindex(cameras, cameras))
    wavelength, shifted = jax.jvp(mean, (jnp.zeros(()),), (jnp.ones(()),))
    means = jnp.zeros((sum(map(len, rows)), len(wavelength))).at[-1].set(shifted)

    def vectors(rows: Array, mean: Array, throughput: Array, shares: Array) -> Float[Array, "b k 4"]:
        beams = light.beams(instrument, light.in_bands(instrument, rows, mean))
        own = light.behind_throughput(instrument, beams, throughput, x, y)
        return CrossTalk(tuple(shares), pairs).vectors(own, x, y)

    neutral = found.rows, wavelength, throughput, jnp.zeros(len(pairs))
    value, push = jax.linearize(vectors, *neutral)
    none = [jnp.zeros_like(one) for one in neutral]
    slopes = (
        jax.vmap(lambda one, mean: push(one, mean, *none[2:]))(jnp.concatenate(rows), means),
        jax.vmap(lambda one: push(*none[:2], one, none[3]))(jnp.diag(throughput)),
        jax.vmap(lambda one: push(*none[:3], one))(jnp.eye(len(pairs))),
    )
    return VectorSlopes(value, jnp.concatenate(slopes))


def fringe_slopes(
    instrument: Instrument, plan: Plan, gaps: Float[Array, " g"], x: Scalar, y: Scalar
) -> Float[Array, "w g b k 4"]:
    """Slopes in the contrast of fringes of air ahead of every plate of `fringe_places`, by its thickness (µm)."""
    instrument = instrument.patched()

    def moved(sizes: Float[Array, " t"]) -> Instrument:
        def with_air(own: Instrument, place: str) -> Instrument:
            return with_air_gap(own, place, sizes[0], jnp.zeros(()))

        return functools.reduce(with_air, fringe_places(instrument), instrument)

    def vectors(rows: Float[Array, "b r 4"]) -> Float[Array, "b k 4"]:
        beams = light.beams(instrument, light.in_bands(instrument, rows, mean))
        return light.behind_throughput(instrument, beams, instrument.throughput.at(x, y), x, y)

    mean = light.band_weights(instrument, plan) @ light.node_wavelengths(instrument, plan)
    found = _banded(plan, (x, y), moved, (1, 0), gaps)
    return jax.vmap(jax.vmap(jax.linearize(vectors, found.rows)[1]))(found.plates[:, :, 0])


def fringe_places(instrument: Instrument) -> tuple[str, ...]:
    """Places of the plates of an instrument (`patched`) ahead of which there may be air."""
    return tuple(_plates(instrument))


def _banded(
    plan: Plan,
    at: tuple[Scalar, Scalar],
    moved: Callable[[Float[Array, " t"]], Instrument],
    sizes: tuple[int, int],
    gaps: Float[Array, " g"],
) -> _Banded:
    """Band sums at a field point, and their slopes in the sizes of `moved`: of single plates, then of the whole train.

    Those of plates are multiplied by fringes of air of some thicknesses (µm).
    """

    def stretched(stretch: Scalar) -> _Banded:
        return _summed(plan, (*at, stretch), moved, sizes, gaps)

    one = jnp.ones(())
    if not light.is_dispersed(moved(jnp.zeros(sum(sizes)))):
        return stretched(one)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-2), *jax.jvp(stretched, (one,), (one,)))


def _summed(
    plan: Plan,
    at: tuple[Scalar, Scalar, Scalar],
    moved: Callable[[Float[Array, " t"]], Instrument],
    sizes: tuple[int, int],
    gaps: Float[Array, " g"],
) -> _Banded:
    """The same at wavelengths times a factor, the last of `at`."""
    x, y, stretch = at
    states, conditions = [state for state, _, _ in plan.settings], plan.conditions
    if "temperature" not in conditions.planned:  # the thermal change of one kelvin
        warm = jnp.full_like(plan.wavelength, REFERENCE_TEMPERATURE + 1.0)
        conditions = Conditions(conditions.band_width, {**conditions.planned, "temperature": warm})

    def stations(own: Instrument) -> tuple[list[fold.Station], list[list[fold.Station]]]:
        common, arms = _with_places(own)
        spectrum = stretch * light.node_wavelengths(own, plan), conditions
        first, ray = fold.stations(common, Ray.entering(x, y, spectrum))
        return first, [fold.stations(arm, ray)[0] for arm in arms]

    def solved(sizes: Float[Array, " t"]) -> tuple[fold.Solved, Float[Array, "b n"]]:
        common, arms = stations(own := moved(sizes))
        every = [*common, *itertools.chain(*arms)]
        return fold.solved(every, plan.moving, states), light.band_weights(own, plan)

    single, together = sizes
    nothing = jnp.zeros(single + together)
    neutral, ((matrices, weights), push) = moved(nothing), jax.linearize(solved, nothing)
    slopes, weight_slopes = jax.vmap(push)(jnp.eye(len(nothing)))
    (common, arms), analysers = stations(neutral), [arm.analyser for arm in neutral.arms]
    around = fold.around(common, arms, analysers, matrices, plan.moving, states, len(plan.wavelength))
    rows, generators, sums = around[0][0], _generators(), functools.partial(light.integrated, plan)
    wavelength = stretch * light.node_wavelengths(neutral, plan)
    moments = weights, weights * (wavelength / neutral.units.wavelength - 1.0)
    inserted, plates, whole = [], [], jnp.zeros((together, *rows.shape))
    for number, (element, ray) in enumerate([*common, *itertools.chain(*arms)]):
        behind, ahead = around[number]
        if isinstance(element, _Place):
            pairs = jnp.einsum("cnri,cnjk->ijcnrk", behind, ahead)
            both = jnp.stack([sums(own, pairs) for own in moments])
            inserted.append(jnp.einsum("gij,mijbrk->mgbrk", generators, both))
            continue
        first = 0 if _is_plate(element) else single
        own = {key: some[first:] for key, some in slopes.items() if key[0] == number and some is not None}

        def pushed(some: fold.Solved, at: Any = (number, element), around: Any = (behind, ahead)) -> Array:
            matrix = fold.stacked(some, *at, plan.moving, states, out=jnp.zeros((4, 4)))
            return around[0] @ matrix @ around[1]

        count = len(nothing) - first
        change = jax.vmap(pushed)(own) if own and count else jnp.zeros((count, *rows.shape))
        whole = whole + change[single - first :]
        if _is_plate(element):
            fringes = jax.vmap(lambda gap, ray=ray: fringe(gap, ray))(gaps)
            plates.append(jax.vmap(lambda wave, some=change[:single]: sums(wave * weights, some))(fringes))
    none = jnp.zeros((0, len(gaps), single, *sums(weights, rows).shape))
    shifted = jax.vmap(lambda own: sums(own, rows))(weight_slopes[single:])
    return _Banded(
        sums(weights, rows),
        jnp.stack(inserted, 2),
        jnp.stack(plates) if plates else none,
        sums(weights, whole) + shifted,
    )


def _generators() -> Float[Array, "g 4 4"]:
    """Slopes of the Mueller matrix in each of `GENERATORS`, at neutral."""
    changes, zero = [Change(kind, "of", "") for kind in GENERATORS], jnp.zeros(())

    def matrix(sizes: Float[Array, " g"]) -> Float[Array, "4 4"]:
        return matrix_of(list(zip(changes, sizes, strict=True)), zero, zero)

    return jnp.moveaxis(jax.jacfwd(matrix)(jnp.zeros(len(changes))), -1, 0)


# ----------------------------------------------------------------------------------------------------- light


class LightSlopes(NamedTuple):
    """Stokes vectors behind the place of the polariser, per exposure, and their slopes in `light_slots`.

    Counts are the product of the analysis vectors with `taken`, what a camera takes of the light with everything that
    the cameras do in single exposures; `factor` is that for a change of the light.
    """

    stokes: Float[Array, "e 4"]
    slopes: Float[Array, "l e 4"]
    taken: Float[Array, "e k 4"]
    factor: Float[Array, "e k"]


def light_slots(instrument: Instrument) -> dict[Slot, int]:
    """Positions of the slots of the light of an instrument (`patched`); of a single star it is that of all."""
    polariser = instrument.polariser
    found: list[Slot] = [("rotator", "of", SKY)]
    if any(isinstance(source, MoonSky) for source in instrument.sources):
        found += [(kind, "of", SKY) for kind in OF_SOURCES]
    if instrument.standard.names:
        found += [(kind, "of", Standards.name) for kind in OF_SOURCES[:2]]
    if polariser is not None:
        found += [(kind, "of", polariser.name) for kind in (*OF_POLARISER, *GENERATORS)]
        found += [(kind, "ahead of", polariser.name) for kind in (*GENERATORS, *ADDED)]
    return {("light", *slot): i for i, slot in enumerate(found)}


def light_slopes(instrument: Instrument, sight: Sight) -> LightSlopes:
    """Slopes of the light at a field point."""
    instrument = instrument.patched()
    exposures, x, y, slots = sight.exposures, sight.x, sight.y, light_slots(instrument)
    count = exposures.kind.shape[0]

    def stokes(sizes: Float[Array, " l"]) -> Float[Array, "e 4"]:
        return light.stokes(_lit(instrument, dict(zip(slots, sizes, strict=True)), count), sight)

    value, push = jax.linearize(stokes, jnp.zeros(len(slots)))
    factor, share = jnp.ones((count, len(instrument.cameras))), jnp.zeros((count, len(instrument.cameras)))
    for part in instrument.cameras.exposures:
        own = part.factors(exposures, x, y)
        factor, share = factor * own, share * own + part.share(exposures, x, y)
    taken = (factor[..., None] * value[:, None]).at[..., 0].add(share)
    return LightSlopes(value, jax.vmap(push)(jnp.eye(len(slots))), taken, factor)


def _lit(instrument: Instrument, sizes: dict[Slot, Scalar], count: int) -> Instrument:
    """The instrument with changes of the light; q and u of the sky in all exposures, of all stars."""
    of_sky, of_stars = (
        [sizes.pop(("light", kind, "of", place), None) for kind in OF_SOURCES[:2]]
        for place in (SKY, Standards.name)
    )
    instrument = patched(instrument, [(Change(*slot[1:]), size) for slot, size in sizes.items()])
    if of_sky[0] is not None:
        every = MoonPatches(*(jnp.full(count, one) for one in of_sky), positions=tuple(range(count)))
        instrument = instrument.changed(
            SKY, patches=lambda there: every if there is None else there.joined(every)
        )
    if of_stars[0] is not None:
        q, u = of_stars
        instrument = instrument.changed(Standards.name, q=lambda there: there + q, u=lambda there: there + u)
    return instrument


def generator_ahead(instrument: Instrument, slot: Slot) -> Float[np.ndarray, "4 4"]:
    """Slope of the Mueller matrix of a slot of the light ahead of the polariser of an instrument (`patched`)."""
    zero = jnp.zeros(())

    def matrix(size: Scalar) -> Array | None:
        return (
            patched(instrument, [(Change(*slot[1:]), size)]).telescope()[-1].mueller(Ray.entering(zero, zero))
        )

    return np.asarray(jax.jacfwd(matrix)(zero))
