"""Slots: places of possible changes of the light path, and the derivatives of the light in these changes.

A slot is a change without factors (`effects.change`), or a term of one; the kind of a change holds its slots
(`ChangeKind.slots`). The factors of a change, over the field or from exposure to exposure, multiply its slots.
Elements, fold, band integral and patches are those of the forward model, differentiated at the unchanged instrument.

    inserted    generators (`optics.GENERATORS`) at every place between two elements, by themselves and × (λ/λ₀ − 1)
    number      axis and thermal change of every wave plate; thickness, axis and cut of each of its layers
    whole       displacement of the field for the optics behind a mapping to the pupil; shift of the bands
    throughput  of a camera, relative to itself; mixed: light of one camera in another
    fringes     of air ahead of a wave plate, which need more wavelength nodes than all others
    light       of sources, ahead of the polariser and of it: Stokes vectors behind it

Method      The rows of the analysers are linear in the matrix M of every element: δrows = (rows behind it) δM
            (matrix ahead of it), and δM of all elements in the same numbers come from one derivative.
Symbols     s slots, g generators, t changes of numbers, b bands, k cameras, r rows, c settings, n nodes
Limits      first order.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model import fold, light
from walop_jax.model.compiled import derivatives
from walop_jax.model.effects.change import BAND, SKY, Change, patched
from walop_jax.model.effects.numbers import OF_POLARISER, OF_QU, OF_SOURCES
from walop_jax.model.effects.optics import ADDED, DISPLACEMENTS, GENERATORS, generator, with_air_gap
from walop_jax.model.elements.base import Element
from walop_jax.model.elements.geometry import PupilMapping
from walop_jax.model.elements.wave_plate import WavePlate, fringe
from walop_jax.model.instrument import Instrument
from walop_jax.model.light_path import Scalar
from walop_jax.model.materials import REFERENCE_TEMPERATURE
from walop_jax.model.parameters import by_shapes
from walop_jax.model.plan import Plan
from walop_jax.model.ray import Conditions, NotPlannedError, Ray
from walop_jax.model.sources import MoonPatches, MoonSky, PointIllumination, Standards

Slot = tuple[Any, ...]
Moved = Callable[[Float[Array, " t"]], Instrument]
FieldPoint = tuple[Scalar, Scalar]  # in the field (deg)
Gaps = Float[Array, " g"]  # thicknesses of air (µm)
OF_PLATE, OF_LAYER = ("axis", "thermal"), ("thickness", "axis", "cut")


# --------------------------------------------------------------------------------------------- names of the slots


def trains(instrument: Instrument) -> dict[str, tuple[Element, ...]]:
    """The elements behind the polariser and those of the arms of an instrument (`patched`), by beginnings of names."""
    in_arms = {f"{arm.name}.": tuple(arm.train()) for arm in instrument.arms}
    return {"": instrument.behind_polariser()} | in_arms


@by_shapes
def acts(element: Element) -> bool:
    """True if an element has a Mueller matrix."""
    if _is_plate(element):
        return True  # as its waves say, which would be traced for nothing else
    try:
        return jax.eval_shape(lambda e: e.mueller(Ray.on_trial(())), element) is not None
    except NotPlannedError:  # a matrix that depends on conditions
        return True


def _places(instrument: Instrument) -> list[list[int]]:
    """Numbers of the places between the elements of each train, equal on both sides of an inactive element."""
    number, places = -1, []
    for train, elements in enumerate(trains(instrument).values()):
        number += train == 0 or len(instrument.arms) > 1
        places.append([number, *(number := number + acts(element) for element in elements)])
    return places


def _is_plate(element: Element) -> bool:
    return isinstance(element, WavePlate) and bool(element.layers)


def _numbers(instrument: Instrument) -> list[list[Slot]]:
    """The numbers of every wave plate behind the polariser."""
    numbers = []
    for train, elements in trains(instrument).items():
        for plate in filter(_is_plate, elements):
            place, layers = f"{train}{plate.name}", plate.layers  # pyright: ignore[reportAttributeAccessIssue]
            entries = [(kind, place) for kind in OF_PLATE]
            entries += [(kind, f"{place}.{layer.name}") for layer in layers for kind in OF_LAYER]
            numbers.append([("number", kind, "of", at) for kind, at in entries])
    return numbers


def _whole(instrument: Instrument) -> list[Slot]:
    pupils = [element.name for element in trains(instrument)[""] if isinstance(element, PupilMapping)]
    shift = ("whole", "shift", "of", BAND)
    return [*(("whole", kind, "ahead of", name) for name in pupils for kind in DISPLACEMENTS), shift]


def fringe_places(instrument: Instrument) -> tuple[str, ...]:
    """Places of the plates of an instrument (`patched`) with a possible air gap ahead of them."""
    return tuple(numbers[0][-1] for numbers in _numbers(instrument))


def vector_slots(instrument: Instrument) -> dict[Slot, int]:
    """Positions of the slots of the analysis vectors of an instrument (`patched`) in `VectorSlopes.slopes`."""
    polariser, places = instrument.polariser, _places(instrument)
    names = {} if polariser is None else {("behind", polariser.name): 0}
    for (train, elements), numbers in zip(trains(instrument).items(), places, strict=True):
        for element, (ahead, behind) in zip(elements, itertools.pairwise(numbers), strict=True):
            where = {"ahead of": ahead, "behind": behind, "of": behind}
            names |= {(side, f"{train}{element.name}"): number for side, number in where.items()}
    for arm, numbers in zip(instrument.arms, places[1:], strict=True):
        names["ahead of", f"{arm.name}.{arm.analyser.name}"] = numbers[-1]
    positions: dict[Slot, int] = {}
    kinds = list(itertools.product((0, 1), GENERATORS))
    count = 1 + places[-1][-1]
    for i, (colour, kind) in enumerate(kinds):
        positions |= {("inserted", kind, *name, colour): i * count + number for name, number in names.items()}
    first, numbers = len(kinds) * count, _numbers(instrument)
    for plate in numbers:
        positions |= {slot: first + t for t, slot in enumerate(plate)}
        first += max(map(len, numbers))
    cameras = range(len(instrument.cameras))
    mixed = [("mixed", *pair) for pair in itertools.product(cameras, cameras)]
    further = [*_whole(instrument), *(("throughput", camera) for camera in cameras), *mixed]
    return positions | {slot: first + i for i, slot in enumerate(further)}


# ------------------------------------------------------------------------------------------------ analysis vectors


class VectorSlopes(NamedTuple):
    """Analysis vectors of light behind the polariser at a field point, and their slopes in `vector_slots`."""

    vectors: light.Vectors
    slopes: Float[Array, "s b k 4"]


class _Banded(NamedTuple):
    """Band sums of the rows of the analysers, and slopes: of generators at places, of plates, all together."""

    rows: light.Rows
    inserted: Float[Array, "m g h b r 4"]
    plates: Float[Array, "w g t b r 4"]
    whole: Float[Array, "u b r 4"]


def vector_slopes(instrument: Instrument, plan: Plan, x: Scalar, y: Scalar) -> VectorSlopes:
    """Slopes of the analysis vectors at a field point (deg)."""
    instrument = instrument.patched()
    numbers, overall = _numbers(instrument), _whole(instrument)
    longest = max(map(len, numbers), default=0)

    def moved(sizes: Float[Array, " t"]) -> Instrument:
        indexed = [*(pair for plate in numbers for pair in enumerate(plate)), *enumerate(overall, longest)]
        return patched(instrument, [(Change(*slot[1:]), sizes[t]) for t, slot in indexed])

    def mean(shift: Scalar) -> Float[Array, " b"]:
        return light.mean_wavelengths(patched(instrument, [(Change(*overall[-1][1:]), shift)]), plan)

    banded = _banded(plan, (x, y), moved, (longest, len(overall)), jnp.zeros(1))
    rows = jnp.concatenate([block.reshape(-1, *banded.rows.shape) for block in banded[1:]])
    shifted = jax.jacfwd(mean)(jnp.zeros(()))
    means = jnp.zeros((len(rows), len(shifted))).at[-1].set(shifted)
    neutral = _neutral(instrument, plan, x, y)
    # Of all in one derivative: of rows and mean wavelengths, then of the throughput, then of the shares.
    blocks = (rows, means), (jnp.diag(neutral[1]),), (jnp.eye(len(neutral[2])),)
    counts = [len(block[0]) for block in blocks]
    steps = [
        jnp.zeros((sum(counts), *block.shape[1:])).at[first : first + count].set(block)
        for first, count, blocks_at in zip(
            itertools.accumulate(counts, initial=0), counts, blocks, strict=False
        )
        for block in blocks_at
    ]
    vectors = functools.partial(_vectors, instrument, (x, y))
    return VectorSlopes(*derivatives(vectors, (banded.rows, *neutral), tuple(steps)))


def fringe_slopes(
    instrument: Instrument, plan: Plan, gaps: Gaps, x: Scalar, y: Scalar
) -> Float[Array, "w g b k 4"]:
    """Slopes in the contrast of fringes of air ahead of every plate of `fringe_places`, by its thickness (µm)."""
    instrument = instrument.patched()

    def moved(sizes: Float[Array, " t"]) -> Instrument:
        """Air without thickness: no fringes, but all its other effects."""
        changed = instrument
        for place in fringe_places(instrument):
            changed = with_air_gap(changed, place, sizes[0], jnp.zeros(()))
        return changed

    def vectors(rows: light.Rows) -> light.Vectors:
        return _vectors(instrument, (x, y), rows, *_neutral(instrument, plan, x, y))

    banded = _banded(plan, (x, y), moved, (1, 0), gaps)
    steps = banded.plates[:, :, 0]
    slopes = derivatives(vectors, (banded.rows,), (steps.reshape(-1, *banded.rows.shape),))[1]
    return slopes.reshape(*steps.shape[:2], *slopes.shape[1:])


def _neutral(instrument: Instrument, plan: Plan, x: Scalar, y: Scalar) -> tuple[Array, Array, Array]:
    """Mean wavelengths, throughput, no shares."""
    mean, throughput = light.mean_wavelengths(instrument, plan), instrument.throughput.at(x, y)
    return mean, throughput, jnp.zeros(len(throughput) ** 2)


def _vectors(
    instrument: Instrument, at: FieldPoint, rows: Array, mean: Array, throughput: Array, shares: Array
) -> light.Vectors:
    """Analysis vectors with fractions of every camera in every other."""
    beams = light.beams(instrument, light.in_bands(instrument, rows, mean))
    vectors = light.behind_throughput(instrument, beams, throughput, *at)
    return vectors + jnp.einsum("ko,bos->bks", shares.reshape(len(throughput), -1), vectors)


def _banded(plan: Plan, at: FieldPoint, moved: Moved, sizes: tuple[int, int], gaps: Gaps) -> _Banded:
    """Band sums at a field point, and slopes in the sizes of `moved`: of single plates, then of all together.

    Those of plates are multiplied by fringes of air of some thicknesses (µm).
    """
    neutral = moved(jnp.zeros(sum(sizes)))
    summed = functools.partial(_summed, plan, at, moved, sizes, gaps)
    return light.with_dispersion(neutral, summed, jnp.ones(()))


def _summed(
    plan: Plan, at: FieldPoint, moved: Moved, sizes: tuple[int, int], gaps: Gaps, stretch: Scalar
) -> _Banded:
    """The same at wavelengths times a factor, without the differences between beams."""
    conditions = plan.conditions
    if not conditions.holds("temperature"):  # the thermal change of one kelvin
        warm = jnp.full_like(plan.wavelength, REFERENCE_TEMPERATURE + 1.0)
        conditions = Conditions(conditions.band_width, {**conditions.planned, "temperature": warm})

    def path_of(instrument: Instrument) -> fold.Fold:
        ray = Ray.entering(*at, (stretch * light.node_wavelengths(instrument, plan), conditions))
        return fold.Fold.of(instrument.behind_polariser(), instrument.arms, ray, plan.moving, plan.positions)

    def solved(sizes: Float[Array, " t"]) -> tuple[fold.Solved, Float[Array, "b n"]]:
        changed = moved(sizes)
        return path_of(changed).solved(), light.band_weights(changed, plan)

    single, together = sizes
    nothing = jnp.zeros(single + together)
    (matrices, weights), (slopes, weight_slopes) = derivatives(solved, (nothing,), (jnp.eye(len(nothing)),))
    path = path_of(neutral := moved(nothing))
    folded = path.around(matrices, len(plan.wavelength))
    sides = [
        (behind, ahead)
        for folded_train in folded
        for (_, ahead), (behind, _) in itertools.pairwise(folded_train)
    ]
    rows, sums = folded[0][0][0], functools.partial(light.integrated, plan)

    def pushed(number: int, selection: slice) -> Float[Array, "t c n r 4"]:
        """Rows for some changes of the matrix of a station."""
        of_station = {k: slope for k, slope in slopes.items() if k[0] == number and slope is not None}
        tangents = {key: slope[selection] for key, slope in of_station.items()}
        if not tangents:
            return jnp.zeros((len(nothing[selection]), *rows.shape))
        behind, ahead = sides[number]

        def change(tangents: fold.Solved) -> Float[Array, "c n r 4"]:
            matrix = path.stacked(tangents, number, out=jnp.zeros((4, 4)))
            assert matrix is not None
            return behind @ matrix @ ahead

        return jax.vmap(change)(tangents)

    wavelength = stretch * light.node_wavelengths(neutral, plan)
    moments = weights, weights * (wavelength / neutral.units.wavelength - 1.0)
    inserted = _inserted(plan, moments, _places(neutral), folded)
    plates = [jnp.zeros((0, len(gaps), single, *sums(weights, rows).shape))]
    for number, (element, ray) in enumerate(path.stations):
        if _is_plate(element):
            change = pushed(number, slice(single))
            waves = jax.vmap(fringe, (0, None))(gaps, ray)
            plates.append(jax.vmap(lambda wave, change=change: sums(wave * weights, change))(waves)[None])
    overall = sum(
        (pushed(number, slice(single, None)) for number in range(len(path.stations))),
        jnp.zeros((together, *rows.shape)),
    )
    shifted = jax.vmap(lambda slope: sums(slope, rows))(weight_slopes[single:])
    return _Banded(sums(weights, rows), inserted, jnp.concatenate(plates), sums(weights, overall) + shifted)


def _inserted(
    plan: Plan,
    moments: tuple[Float[Array, "b n"], ...],
    places: list[list[int]],
    folded: list[list[tuple[Float[Array, "c n r 4"], Float[Array, "c n 4 4"]]]],
) -> Float[Array, "m g h b r 4"]:
    """Slopes in generators at every place, for some weights of the nodes."""
    sides = dict(reversed([*zip(itertools.chain(*places), itertools.chain(*folded), strict=True)]))
    behind, ahead = (jnp.stack([sides[place][side] for place in sorted(sides)]) for side in (0, 1))
    pairs = jnp.einsum("hcnri,hcnjk->hijcnrk", behind, ahead)
    products = jnp.stack([light.integrated(plan, weights, pairs) for weights in moments])
    generators = jnp.asarray(np.stack([generator(kind) for kind in GENERATORS], axis=-1))
    return jnp.einsum("ijg,mhijbrk->mghbrk", generators, products)


# ----------------------------------------------------------------------------------------------------- light


class LightSlopes(NamedTuple):
    """Stokes vectors behind the place of the polariser, per exposure, and their slopes in `light_slots`.

    Counts are the product of the analysis vectors with `taken`, the light in a camera with all responses of the cameras
    in single exposures; `factor` is the response to a change of the light.
    """

    stokes: Float[Array, "e 4"]
    slopes: Float[Array, "l e 4"]
    taken: Float[Array, "e k 4"]
    factor: Float[Array, "e k"]


def light_slots(instrument: Instrument) -> dict[Slot, int]:
    """Positions of the slots of the light of an instrument (`patched`); of a single star it is that of all."""
    polariser, slots = instrument.polariser, _light_numbers(instrument)
    if polariser is not None:
        slots += [(kind, "of", polariser.name) for kind in GENERATORS]
        slots += [(kind, "ahead of", polariser.name) for kind in (*GENERATORS, *ADDED)]
    return {("light", *slot): i for i, slot in enumerate(slots)}


def _light_numbers(instrument: Instrument) -> list[Slot]:
    """The slots that are numbers of the sources and of the polariser."""
    polariser = instrument.polariser
    slots: list[Slot] = [("rotator", "of", SKY)]
    if any(isinstance(source, MoonSky) for source in instrument.sources):
        slots += [(kind, "of", SKY) for kind in OF_SOURCES]
    if instrument.standard.names:
        slots += [(kind, "of", Standards.name) for kind in (*OF_QU, "rotator", "degree")]
    if polariser is not None:
        slots += [(kind, "of", polariser.name) for kind in OF_POLARISER]
    return slots


def light_slopes(instrument: Instrument, illumination: PointIllumination) -> LightSlopes:
    """Slopes of the light at a field point.

    Those of generators are closed: a matrix 1 + s G at a place adds G S to the light S there.
    """
    instrument = instrument.patched()
    exposures, x, y = illumination.exposures, illumination.x, illumination.y
    count, numbers = exposures.kind.shape[0], _light_numbers(instrument)

    def stokes(sizes: Float[Array, " l"]) -> Float[Array, "e 4"]:
        return light.stokes(_lit(instrument, dict(zip(numbers, sizes, strict=True)), count), illumination)

    value, slopes = derivatives(stokes, (jnp.zeros(len(numbers)),), (jnp.eye(len(numbers)),))
    if instrument.polariser is not None:
        inside = exposures.clp_in[:, None]
        of_polariser = jnp.where(inside, _generated(GENERATORS, value), 0.0)
        bypassing = light.bypasses_telescope(instrument, illumination)[:, None]
        made = _generated((*GENERATORS, *ADDED), light.behind_telescope(instrument, illumination))
        made = jnp.where(bypassing | inside, 0.0, made)
        ahead = jax.vmap(lambda one: light.through_sky_films(instrument, illumination, one))(made)
        slopes = jnp.concatenate([slopes, of_polariser, ahead])
    factor, share = jnp.ones((count, len(instrument.cameras))), jnp.zeros((count, len(instrument.cameras)))
    for gain in instrument.cameras.exposures:
        factors = gain.factors(exposures, x, y)
        factor, share = factor * factors, share * factors + gain.share(exposures, x, y)
    response = (factor[..., None] * value[:, None]).at[..., 0].add(share)
    return LightSlopes(value, slopes, response, factor)


def _generated(kinds: Sequence[str], stokes: Float[Array, "e 4"]) -> Float[Array, "g e 4"]:
    """G S of the light S for each generator."""
    return jnp.einsum("gij,ej->gei", np.stack([generator(kind) for kind in kinds]), stokes)


def _lit(instrument: Instrument, sizes: dict[Slot, Scalar], count: int) -> Instrument:
    """The instrument with changes of the light; q and u of the sky are those of all exposures, of stars of all."""
    sources: dict[str, list[Scalar]] = {SKY: [], Standards.name: []}
    terms = []
    for slot, size in sizes.items():
        if slot[0] in OF_QU:
            sources[slot[-1]].append(size)
        else:
            terms.append((Change(*slot), size))
    instrument = patched(instrument, terms)
    if sources[SKY]:
        patches = MoonPatches(
            *(jnp.full(count, component) for component in sources[SKY]), positions=tuple(range(count))
        )
        instrument = instrument.changed(
            SKY, patches=lambda old: patches if old is None else old.joined(patches)
        )
    if sources[Standards.name]:
        q, u = sources[Standards.name]
        instrument = instrument.changed(Standards.name, q=lambda old: old + q, u=lambda old: old + u)
    return instrument
