"""Responses: what a small change of the light path, anywhere in it, does to the analysis vectors. All places at once.

To first order a change of the optics with the generator G at a place p of the train changes the rows that the analysers
see, of light behind the polariser, by

    δa = Σ_λ w(λ) φ(λ) B_p(λ) G F_p(λ)

F the train ahead of p, B the rows folded back to p: the fold has both. What an element does with a number θ of its own
is the same with ∂M/∂θ in the place of G, M its Mueller matrix. So one program gives the responses to

    inserted    every generator of `GENERATORS`, at every place between two elements, with φ = 1 and φ = λ/λ₀ − 1
    numbers     axis and thermal change of every wave plate; thickness, axis and cut of each of its layers
    globally    displacement of what the optics behind a mapping to the pupil see; wavelength of the bands
    throughput  that of each camera, relative to itself
    light       polarisation of sources, polariser, rotator: Stokes vectors behind the polariser

and a second one to fringes of air ahead of the plates, which take more wavelength nodes. What multiplies a change, over
the field or from exposure to exposure, multiplies its response.

Symbols     m moments φ, g generators, s slots, b bands, k cameras, r rows, c states of the moving elements, n nodes
Source      first-order perturbation of a product of matrices; generators: Lu & Chipman 1996, JOSA A 13, 1106
Limits      first order. Analysers, mixing and what the cameras add are those of the instrument, effects included.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model import fold, light
from walop_jax.model.compiled import array
from walop_jax.model.elements import Element, PupilMapping, WavePlate
from walop_jax.model.instrument import Instrument, Scalar
from walop_jax.model.materials import REFERENCE_TEMPERATURE
from walop_jax.model.parameters import shapes_of
from walop_jax.model.plan import Plan
from walop_jax.model.ray import CONDITIONS, Conditions, Ray
from walop_jax.model.sources import MoonPatches, MoonSky, Sight

LAYER_NUMBERS = ("thickness", "axis", "cut")


def _generators() -> dict[str, np.ndarray]:
    found = {}
    for number, axis in enumerate("quv", start=1):
        found[f"diattenuation {axis}"] = np.zeros((4, 4))
        found[f"diattenuation {axis}"][0, number] = found[f"diattenuation {axis}"][number, 0] = 1.0
    for number, axis in enumerate("quv", start=1):
        j, k = {1: (2, 3), 2: (3, 1), 3: (1, 2)}[number]
        found[f"retardance {axis}"] = np.zeros((4, 4))
        found[f"retardance {axis}"][j, k], found[f"retardance {axis}"][k, j] = 1.0, -1.0
    found["depolarisation"] = -np.diag([0.0, 1.0, 1.0, 1.0])
    return found


GENERATORS = _generators()
"""∂M/∂a at a = 0 of the matrices of `mueller`, per unit of diattenuation, of retardance (rad), of what is lost."""


# --------------------------------------------------------------------------------------------- places of the train


class TrainPlace(NamedTuple):
    """A place between two elements: in the common train (arm −1) or in an arm, behind so many of its elements.

    Counted from the polariser.
    """

    arm: int
    behind: int


def trains(instrument: Instrument) -> tuple[tuple[Element, ...], tuple[tuple[Element, ...], ...]]:
    """The elements behind the polariser, and those of the arms, of an instrument without effects (`patched`)."""
    return instrument.behind_polariser(), tuple(tuple(arm.train()) for arm in instrument.arms)


def places(instrument: Instrument) -> dict[TrainPlace, int]:
    """Every place of an instrument (`patched`) and the number of its responses: equal where nothing acts in between."""
    common, arms = trains(instrument)
    found, number = {TrainPlace(-1, 0): 0}, 0
    for i, element in enumerate(common, start=1):
        number += acts(element)
        found[TrainPlace(-1, i)] = number
    last = number
    for a, arm in enumerate(arms):
        last += len(arms) > 1
        found[TrainPlace(a, 0)] = last if len(arms) > 1 else number
        for i, element in enumerate(arm, start=1):
            last += acts(element)
            found[TrainPlace(a, i)] = last
    return found


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


def plates(instrument: Instrument) -> tuple[tuple[int, int], ...]:
    """Arm (−1: common train) and position of every wave plate behind the polariser, in the order of `numbers`."""
    common, arms = trains(instrument)
    return tuple(
        (a - 1, i)
        for a, train in enumerate((common, *arms))
        for i, element in enumerate(train)
        if isinstance(element, WavePlate) and element.layers
    )


def plate_numbers(instrument: Instrument) -> tuple[str, ...]:
    """Numbers of a plate, in the order of `numbers`; "0.cut" is the cut of its first layer."""
    common, arms = trains(instrument)
    most = max(
        (len(e.layers) for train in (common, *arms) for e in train if isinstance(e, WavePlate)), default=0
    )
    return ("axis", "thermal", *(f"{i}.{name}" for i in range(most) for name in LAYER_NUMBERS))


def global_slots(instrument: Instrument) -> tuple[str, ...]:
    """Slots that act on many elements, in the order of `globally`: "x pupil" displaces what that mapping sees."""
    pupils = [element.name for element in trains(instrument)[0] if isinstance(element, PupilMapping)]
    return (*(f"{axis} {name}" for name in pupils for axis in "xy"), "wavelength")


# ------------------------------------------------------------------------------------------------ what comes of it


class Responses(NamedTuple):
    """Responses at one field point; `vectors` (b k 4) are the analysis vectors of light behind the polariser.

    Slots in the order of `GENERATORS` and `places`, `plates` and `plate_numbers`, `global_slots`, the cameras.
    """

    vectors: Float[Array, "b k 4"]
    inserted: Float[Array, "h m g b k 4"]
    numbers: Float[Array, "w s b k 4"]
    globally: Float[Array, "s b k 4"]
    throughput: Float[Array, "j b k 4"]


def vector_responses(instrument: Instrument, plan: Plan, x: Scalar, y: Scalar) -> Responses:
    """Responses of the analysis vectors at a field point (deg)."""
    instrument = instrument.patched()
    wavelength = light.node_wavelengths(instrument, plan)
    weights, weight_slopes = jax.jvp(
        lambda at: light.weights_at(plan, at, plan.teff), (wavelength,), (jnp.ones_like(wavelength),)
    )

    def banded(wavelength: Float[Array, " n"]) -> tuple[Array, ...]:
        return _banded(instrument, plan, x, y, wavelength, weights, weight_slopes)

    found = banded(wavelength)
    if light.is_dispersed(instrument):
        _, slopes = jax.jvp(banded, (wavelength,), (wavelength,))
        # λ ∂/∂λ of a derivative with respect to λ, and that of the factor λ itself.
        slopes = (*slopes[:3], slopes[3].at[-1].add(found[3][-1]))
        found = tuple(jnp.concatenate(pair, axis=-2) for pair in zip(found, slopes, strict=True))
    rows, inserted, numbers, globally = found

    mean, mean_slope = weights @ wavelength, weight_slopes @ wavelength + weights.sum(axis=1)
    throughput = instrument.throughput.at(x, y)

    def cameras(
        rows: Float[Array, "b r 4"], mean: Float[Array, " b"], throughput: Float[Array, " k"]
    ) -> Float[Array, "b k 4"]:
        beams = light.beams(instrument, light.in_bands(instrument, rows, mean))
        return light.behind_throughput(instrument, beams, throughput, x, y)

    vectors, push = jax.linearize(cameras, rows, mean, throughput)
    still, none = jnp.zeros_like(mean), jnp.zeros_like(throughput)

    def each(change: Float[Array, "*s b r 4"]) -> Float[Array, "*s b k 4"]:
        flat = jax.vmap(lambda one: push(one, still, none))(change.reshape(-1, *rows.shape))
        return flat.reshape(*change.shape[:-3], *flat.shape[1:])

    return Responses(
        vectors=vectors,
        inserted=each(inserted),
        numbers=each(numbers),
        globally=jnp.concatenate([each(globally[:-1]), push(globally[-1], mean_slope, none)[None]]),
        throughput=jax.vmap(lambda one: push(jnp.zeros_like(rows), still, one))(jnp.diag(throughput)),
    )


class _Segment(NamedTuple):
    """A stretch of the train: elements, and at every place B and F; `rows` are those of the analysers behind it."""

    elements: tuple[Element, ...]
    folded: list[Float[Array, "c n r 4"]]
    ahead: list[Float[Array, "c n 4 4"]]
    rows: slice


def _banded(
    instrument: Instrument,
    plan: Plan,
    x: Scalar,
    y: Scalar,
    wavelength: Float[Array, " n"],
    weights: Float[Array, "b n"],
    weight_slopes: Float[Array, "b n"],
) -> tuple[Array, Array, Array, Array]:
    """Band-integrated rows, and their changes: by generators at places, by numbers of plates, and globally."""
    of_many, of_plates = global_slots(instrument)[:-1], plate_numbers(instrument)
    names, (common, arms) = (*of_many, *of_plates), trains(instrument)
    states = [state for state, _, _ in plan.settings]
    conditions = plan.conditions
    if "temperature" not in conditions.planned:  # the thermal change of one kelvin
        warm = jnp.full_like(wavelength, REFERENCE_TEMPERATURE + 1.0)
        conditions = Conditions(conditions.band_width, {**conditions.planned, "temperature": warm})
    keys: list[tuple[int, float | None]] = []

    def matrices(change: Float[Array, " t"], wavelength: Float[Array, " n"]) -> list[Array | None]:
        own = dict(zip(names, change, strict=True))
        ray = Ray.entering(x, y, (wavelength, conditions))
        stations, ray = _stations(common, ray, own)
        for arm in arms:
            stations += _stations(arm, ray, own)[0]
        solved = fold.solved(stations, plan.moving, states)
        keys[:] = solved
        return list(solved.values())

    nothing, still = jnp.zeros(len(names)), jnp.zeros_like(wavelength)
    base, push = jax.linearize(matrices, nothing, wavelength)
    slopes = jax.vmap(lambda one: push(one[:-1], one[-1] + still))(jnp.eye(len(names) + 1))
    stack = functools.partial(_stacked, plan=plan, keys=keys, nodes=len(wavelength))
    segments = _segments(instrument, functools.partial(stack, base, jnp.eye(4)), plan, len(wavelength))
    width = segments[0].folded[0].shape[2]

    def placed(change: Float[Array, "*s b r 4"], segment: _Segment) -> Float[Array, "*s b w 4"]:
        whole = jnp.zeros((*change.shape[:-2], width, 4))
        return whole.at[..., segment.rows, :].set(change)

    phi = jnp.stack([jnp.ones_like(wavelength), wavelength / instrument.units.wavelength - 1.0])
    moments = phi[:, None] * weights
    generators = jnp.asarray(np.stack(list(GENERATORS.values())))
    inserted, numbers = [], []
    globally = jnp.zeros((len(of_many) + 1, len(weights), width, 4))
    first = 0
    for segment in segments:
        for i, (folded, ahead) in enumerate(zip(segment.folded, segment.ahead, strict=True)):
            if (i == 0 and (segment is segments[0] or len(arms) > 1)) or (
                i and acts(segment.elements[i - 1])
            ):
                pairs = jnp.einsum("cnri,cnjk->cnrijk", folded, ahead)
                both = jnp.stack([_integrated(plan, one, pairs) for one in moments])
                inserted.append(placed(jnp.einsum("mbrijk,gij->mgbrk", both, generators), segment))
        for i, element in enumerate(segment.elements):
            own = stack(slopes, jnp.zeros((len(names) + 1, 4, 4)), number=first + i, element=element)
            plate = isinstance(element, WavePlate) and bool(element.layers)
            if own is None:  # never in the beam
                numbers += [jnp.zeros((len(of_plates), len(weights), width, 4))] * plate
                continue
            change = jnp.einsum("cnri,tcnij,cnjk->cntrk", segment.folded[i + 1], own, segment.ahead[i])
            done = placed(jnp.moveaxis(_integrated(plan, weights, change), 1, 0), segment)
            globally = globally + jnp.concatenate([done[: len(of_many)], done[-1:]])
            if plate:
                numbers.append(done[len(of_many) : -1])
        first += len(segment.elements)
    whole = segments[0].folded[0]
    rows = _integrated(plan, weights, whole)
    globally = globally.at[-1].add(_integrated(plan, weight_slopes, whole))
    none = jnp.zeros((0, len(of_plates), *rows.shape))
    return rows, jnp.stack(inserted), jnp.stack(numbers) if numbers else none, globally


def _stations(
    elements: Sequence[Element], ray: Ray, own: dict[str, Scalar]
) -> tuple[list[fold.Station], Ray]:
    """Elements with changed numbers and the rays that meet them; mappings to the pupil see displaced points."""
    found = []
    for element in elements:
        if f"x {element.name}" in own:
            by_x, by_y = own[f"x {element.name}"], own[f"y {element.name}"]
            ray = ray.moved(*jnp.broadcast_arrays(ray.x + by_x, ray.y + by_y))
        varied = _varied(element, own)
        found.append((varied, ray))
        ray = varied.ray(ray)
    return found, ray


def _varied(element: Element, own: dict[str, Scalar]) -> Element:
    """A wave plate with all its numbers changed; any other element as it is."""
    if not isinstance(element, WavePlate) or not element.layers:
        return element

    def added(part: Any, prefix: str, *names: str) -> Any:
        changes = {name: _sum(getattr(part, name), own[prefix + name]) for name in names}
        return dataclasses.replace(part, **changes)

    layers = tuple(added(layer, f"{i}.", *LAYER_NUMBERS) for i, layer in enumerate(element.layers))
    return dataclasses.replace(added(element, "", "axis", "thermal"), layers=layers)


def _sum(value: Scalar | None, change: Scalar) -> Scalar:
    return change if value is None else value + change


def _stacked(
    matrices: Sequence[Array | None],
    out: Array,
    *,
    number: int,
    element: Element,
    plan: Plan,
    keys: Sequence[tuple[int, float | None]],
    nodes: int,
) -> Float[Array, "*t c n 4 4"] | None:
    """Matrices of a station in every state, `out` where it is out; None where it never does anything."""
    states = [state for state, _, _ in plan.settings]
    by_key = dict(zip(keys, matrices, strict=True))
    shape = (*out.shape[:-2], nodes, 4, 4)
    gone = jnp.broadcast_to(out[..., None, :, :], shape)

    def one(angle: float | None) -> Array | None:
        found = by_key.get((number, angle)) if element.moves is None or angle is not None else None
        if found is None:
            return None
        alone = found.ndim == out.ndim  # the same at all wavelengths
        return jnp.broadcast_to(found[..., None, :, :] if alone else found, shape)

    each = [one(angle) for angle in fold.positions(element, plan.moving, states)]
    if all(matrix is None for matrix in each):
        return None
    return jnp.stack([gone if matrix is None else matrix for matrix in each], axis=len(shape) - 3)


def _segments(
    instrument: Instrument, matrix: Callable[..., Array | None], plan: Plan, nodes: int
) -> list[_Segment]:
    """The common train and the arms, with rows and matrices at every place; `matrix` gives that of a station."""
    common, arms = trains(instrument)
    shape = (len(plan.settings), nodes)

    def forward(elements: Sequence[Element], first: int, start: Array) -> list[Array]:
        found = [start]
        for i, element in enumerate(elements):
            own = matrix(number=first + i, element=element)
            found.append(found[-1] if own is None else own @ found[-1])
        return found

    def backward(elements: Sequence[Element], first: int, last: Array) -> list[Array]:
        found = [last]
        for i in reversed(range(len(elements))):
            own = matrix(number=first + i, element=elements[i])
            found.insert(0, found[0] if own is None else found[0] @ own)
        return found

    ahead = forward(common, 0, jnp.broadcast_to(jnp.eye(4), (*shape, 4, 4)))
    segments, first, row = [], len(common), 0
    for arm, elements in zip(instrument.arms, arms, strict=True):
        seen = arm.analyser.seen(jnp.eye(4))
        folded = backward(elements, first, jnp.broadcast_to(seen, (*shape, *seen.shape)))
        own = slice(row, row + len(seen))
        segments.append(_Segment(elements, folded, forward(elements, first, ahead[-1]), own))
        first, row = first + len(elements), row + len(seen)
    last = jnp.concatenate([segment.folded[0] for segment in segments], axis=2)
    return [_Segment(common, backward(common, 0, last), ahead, slice(0, row)), *segments]


def _integrated(
    plan: Plan, weights: Float[Array, "b n"], change: Float[Array, "c n ..."]
) -> Float[Array, "b ..."]:
    """Sums over the nodes of every band, each in its own state."""
    sizes = {last - first for _, first, last in plan.settings}
    if len(sizes) == 1:
        own = weights.reshape(len(plan.settings), *sizes, -1)
        flat = change.reshape(*change.shape[:2], -1)
        return (own @ flat).reshape(-1, *change.shape[2:])
    return jnp.concatenate(
        [jnp.tensordot(weights[first:last], change[i], 1) for i, (_, first, last) in enumerate(plan.settings)]
    )


# ------------------------------------------------------------------------------------------------- fringes


def fringe_responses(
    instrument: Instrument, plan: Plan, gaps: Float[Array, " g"], x: Scalar, y: Scalar
) -> Float[Array, "w g b k 4"]:
    """Responses to the contrast of fringes of air ahead of every plate, for some thicknesses of the air (µm)."""
    instrument = instrument.patched()
    wavelength = light.node_wavelengths(instrument, plan)
    weights = light.weights_at(plan, wavelength, plan.teff)
    mean, throughput = weights @ wavelength, instrument.throughput.at(x, y)

    def banded(wavelength: Float[Array, " n"]) -> tuple[Array, Array]:
        return _banded_fringes(instrument, plan, gaps, x, y, wavelength, weights)

    found = banded(wavelength)
    if light.is_dispersed(instrument):
        _, slopes = jax.jvp(banded, (wavelength,), (wavelength,))
        found = tuple(jnp.concatenate(pair, axis=-2) for pair in zip(found, slopes, strict=True))
    rows, changes = found

    def vectors(rows: Float[Array, "b r 4"]) -> Float[Array, "b k 4"]:
        beams = light.beams(instrument, light.in_bands(instrument, rows, mean))
        return light.behind_throughput(instrument, beams, throughput, x, y)

    _, push = jax.linearize(vectors, rows)
    flat = jax.vmap(push)(changes.reshape(-1, *rows.shape))
    return flat.reshape(*changes.shape[:2], *flat.shape[1:])


def _banded_fringes(
    instrument: Instrument,
    plan: Plan,
    gaps: Float[Array, " g"],
    x: Scalar,
    y: Scalar,
    wavelength: Float[Array, " n"],
    weights: Float[Array, "b n"],
) -> tuple[Array, Array]:
    """Band-integrated rows and what fringes ahead of every plate change of them."""
    common, arms = trains(instrument)
    states = [state for state, _, _ in plan.settings]
    stations, ray = fold.stations(common, Ray.entering(x, y, (wavelength, plan.conditions)))
    for arm in arms:
        stations += fold.stations(arm, ray)[0]
    solved = fold.solved(stations, plan.moving, states)
    matrix = functools.partial(
        _stacked, list(solved.values()), jnp.eye(4), plan=plan, keys=list(solved), nodes=len(wavelength)
    )
    segments = _segments(instrument, matrix, plan, len(wavelength))
    whole = segments[0].folded[0]
    found, number = [], 0
    for segment in segments:
        for i, element in enumerate(segment.elements):
            ray = stations[number][1]
            number += 1
            if not (isinstance(element, WavePlate) and element.layers):
                continue
            angles = fold.positions(element, plan.moving, states)
            inside = jnp.asarray([1.0 if element.moves is None or at is not None else 0.0 for at in angles])
            turned = jnp.asarray([0.0 if at is None else at for at in angles])
            twice = 2.0 * jnp.deg2rad(element.axis + turned + element.layers[0].axis)
            q, u = (jnp.asarray(GENERATORS[f"diattenuation {axis}"]) for axis in "qu")
            along = (inside * jnp.cos(twice))[:, None, None] * q + (inside * jnp.sin(twice))[
                :, None, None
            ] * u
            change = jnp.einsum("cnri,cij,cnjk->cnrk", segment.folded[i], along, segment.ahead[i])
            phase = 4.0 * jnp.pi * gaps[:, None] * ray.kz / wavelength
            each = jax.vmap(lambda wave, change=change: _integrated(plan, weights * wave, change))(
                jnp.cos(phase)
            )
            blank = jnp.zeros((*each.shape[:-2], whole.shape[2], 4))
            found.append(blank.at[..., segment.rows, :].set(each))
    return _integrated(plan, weights, whole), jnp.stack(found)


# ----------------------------------------------------------------------------------------------------- light

LIGHT = ("zero", "extinction", "ellipticity", "rotator", "sky", "sky q", "sky u", "star q", "star u")
"""Changes of the light behind the polariser: see `light_responses`."""


class LightResponses(NamedTuple):
    """Stokes vectors behind the place of the polariser, per exposure, and their changes in the order of `LIGHT`.

    `from_sky` is 1 for light that passes the telescope and not the polariser. Counts are the product of the analysis
    vectors with `taken`, what a camera takes of the light with everything that the cameras do in single exposures;
    `factor` is that for a change of the light.
    """

    stokes: Float[Array, "e 4"]
    slopes: Float[Array, "l e 4"]
    from_sky: Float[Array, " e"]
    taken: Float[Array, "e k 4"]
    factor: Float[Array, "e k"]


def light_responses(instrument: Instrument, sight: Sight) -> LightResponses:
    """Changes of the light at a field point by: zero of the polariser (deg), its extinction, its ellipticity, the
    rotator (deg), degree of polarisation of the sky, q and u of the sky and of stars."""
    instrument = instrument.patched()
    exposures, x, y = sight.exposures, sight.x, sight.y
    count = exposures.kind.shape[0]

    def stokes(change: Float[Array, " l"]) -> Float[Array, "e 4"]:
        own = dict(zip(LIGHT, change, strict=True))
        return light.stokes(_lit(instrument, own, count), sight)  # pyright: ignore[reportArgumentType]

    value, push = jax.linearize(stokes, jnp.zeros(len(LIGHT)))
    through = exposures.clp_in if instrument.polariser is not None else jnp.zeros(count, bool)
    factor, share = jnp.ones((count, len(instrument.cameras))), jnp.zeros((count, len(instrument.cameras)))
    for part in instrument.cameras.exposures:
        own = part.factors(exposures, x, y)
        factor, share = factor * own, share * own + part.share(exposures, x, y)
    taken = (factor[..., None] * value[:, None]).at[..., 0].add(share)
    return LightResponses(
        value,
        jax.vmap(push)(jnp.eye(len(LIGHT))),
        jnp.where(light.indoors(instrument, sight) | through, 0.0, 1.0),
        taken,
        factor,
    )


def _lit(instrument: Instrument, own: dict[str, Scalar], count: int) -> Instrument:
    def added(name: str) -> Callable[[Scalar | None], Scalar]:
        return lambda value: _sum(value, own[name])

    if instrument.polariser is not None:
        changes = {name: added(name) for name in ("zero", "extinction", "ellipticity")}
        instrument = instrument.changed(instrument.polariser.name, **changes)
    instrument = instrument.changed("", rotator_zero=added("rotator"))
    for source in instrument.sources:
        if isinstance(source, MoonSky):
            every = MoonPatches(
                jnp.full(count, own["sky q"]), jnp.full(count, own["sky u"]), positions=tuple(range(count))
            )
            instrument = instrument.changed(
                source.name,
                missing=lambda p: _sum(p, -own["sky"]),
                patches=lambda there, every=every: every if there is None else there.joined(every),
            )
    if instrument.standard.names:
        instrument = instrument.changed(
            "standard", q=lambda q: q + own["star q"], u=lambda u: u + own["star u"]
        )
    return instrument
