"""Dependences of a light path, from a run on shapes alone instead of declarations by hand.

`needs` runs the path until it asks for no further quantity of a plan. `optical_reach` follows every
parameter through the operations of `light.band_rows`: those that reach the result enter before the band integral.

Not all of an instrument is valid for exposures other than the fitted ones. The instrument matrix and the analysis of a
catalogue use the optics and the cameras. Light of the opposite field point, changes of single exposures, optics that
change with the time since the first exposure and detectors that depend on their exposure do not carry over; the
response of a detector to its own counts, which may differ over the field, is inverted. Patching shows the effects
concerned; they are not declared.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Set
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from walop_jax.io.code import blank
from walop_jax.model import light
from walop_jax.model.cameras import DetectorPart
from walop_jax.model.effects.base import Effect
from walop_jax.model.elements.base import Element
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import by_shapes, parameter_places
from walop_jax.model.plan import Plan, blank_plan
from walop_jax.model.ray import SMOOTH, NotPlannedError, Ray
from walop_jax.model.sources import ExposureArrays, PointIllumination

AT = 0.11, 0.07
"""A field point off the axis and at an odd place: no dependence may vanish by symmetry."""


class Needs(NamedTuple):
    """Requirements on a plan: conditions of the optics, median counts, fringes that nodes must follow."""

    conditions: frozenset[str]
    smooth: frozenset[str]  # those on which the optics depend smoothly
    median: bool
    path_difference: float  # µm


@by_shapes
def needs(instrument: Instrument) -> Needs:
    """Requirements of the light path of an instrument, effects included, from a run on shapes alone."""

    def run(quantities: Set[str], instrument: Instrument) -> tuple[Instrument, Array]:
        patched = instrument.patched()
        plan = blank_plan(instrument, quantities - {"median"}, "median" in quantities)
        x, y = map(jnp.asarray, AT)
        rows = light.band_rows(patched, plan, x, y)
        zeros = jnp.zeros_like(plan.exposures.kind)
        illumination = PointIllumination(plan.exposures, jnp.zeros((*zeros.shape, 2)), zeros - 1, x, y)
        counts = light.counts(patched, rows, patched.throughput.at(x, y), illumination, zeros)
        return patched, light.detected(patched, plan.exposures, counts, x, y)

    (patched, _), quantities = _asking(run, instrument)
    longest = max((element.path_difference for element in patched.by_place().values()), default=0.0)
    conditions = frozenset(name.removeprefix(SMOOTH) for name in quantities - {"median"})
    return Needs(conditions, conditions - quantities, "median" in quantities, longest)


def _asking(run: Callable[[Set[str], Any], Any], of: Any) -> tuple[Any, frozenset[str]]:
    """The shapes of the result of a computation, and the names of all quantities that it asks for on the way."""
    quantities: frozenset[str] = frozenset()
    while True:
        try:
            return jax.eval_shape(functools.partial(run, quantities), of), quantities
        except NotPlannedError as missing:
            if missing.asked in quantities:
                raise
            quantities |= {missing.asked}


def optical_indices(instrument: Instrument) -> Int[np.ndarray, " o"]:
    """Positions of the parameters inside the band integral."""
    plan = blank_plan(instrument, needs(instrument).conditions)
    return np.flatnonzero(optical_reach(instrument, plan).any(axis=0))


def optical_reach(instrument: Instrument, plan: Plan) -> Bool[np.ndarray, "a n"]:
    """True where a parameter (columns) reaches the band rows of an arm (rows) in the settings of a plan."""
    reached = np.array(_reach(instrument, plan), bool)
    places = [place for place, count in parameter_places(instrument) for _ in range(count)]
    return reached[:, places]


@by_shapes
def _reach(instrument: Instrument, plan: Plan) -> tuple[tuple[bool, ...], ...]:
    """For every arm the arrays of instrument and plan that reach its rows; inner programs use all their arguments."""
    shapes, structure = jax.tree.flatten((instrument, plan))

    def reaching(number: int) -> tuple[bool, ...]:
        def run(*arrays: Array) -> Array:
            instrument, plan = jax.tree_util.tree_unflatten(structure, arrays)
            patched = instrument.patched()
            one_arm = dataclasses.replace(patched, arms=patched.arms[number : number + 1])
            return light.band_rows(one_arm, plan, *map(jnp.asarray, AT))

        program = jax.make_jaxpr(run)(*shapes).jaxpr
        needed = {id(program.outvars[0])}
        for equation in reversed(program.eqns):
            if any(id(v) in needed for v in equation.outvars):
                needed |= {id(v) for v in equation.invars}
        return tuple(id(v) in needed for v in program.invars)

    return tuple(map(reaching, range(len(instrument.arms))))


@by_shapes
def conditions_of_effect(bare: Instrument, effect: Effect) -> frozenset[str]:
    """Conditions of the elements that an effect inserts or changes, by names in `ray.CONDITIONS`."""

    def changed(bare: Instrument, effect: Effect) -> list[Element]:
        before = {id(element) for element in _behind_polariser(bare)}
        return [element for element in _behind_polariser(effect.patch(bare)) if id(element) not in before]

    asked = map(_conditions_asked, jax.eval_shape(changed, bare, effect))
    return frozenset(name.removeprefix(SMOOTH) for name in itertools.chain.from_iterable(asked))


def _behind_polariser(instrument: Instrument) -> Iterator[Element]:
    yield from instrument.behind_polariser()
    for arm in instrument.arms:
        yield from (*arm.train(), arm.analyser)


@by_shapes
def _conditions_asked(element: Element) -> frozenset[str]:
    def run(quantities: Set[str], element: Element) -> tuple[Any, Any]:
        ray = Ray.on_trial(quantities)
        return element.ray(ray), element.mueller(ray)

    return _asking(run, element)[1]


# --------------------------------------------------------------------------------------- validity for other exposures

KNOWN = frozenset({"temperature", "hour_angle"})
"""Conditions of the optics with columns in a table of points or a catalogue."""


class _Unknown(ExposureArrays):
    """Exposures without any known quantity: every request is an error."""

    def __getattr__(self, name: str) -> Any:
        raise NotPlannedError(name)


def is_undone(part: DetectorPart, cameras: int) -> bool:
    """True for a detector that depends only on its own counts and the field point, so that catalogues can be corrected
    for it.
    """
    counts, at = jnp.ones((1, cameras)), tuple(map(jnp.asarray, AT))
    try:
        jax.eval_shape(lambda p: p.reported(counts, blank(_Unknown), *at), part)
    except NotPlannedError:
        return False
    return True


def left_behind(instrument: Instrument) -> tuple[str, ...]:
    """Names of the effects that do not fully carry over to other exposures."""
    bare = dataclasses.replace(instrument, effects=())
    names = []
    for effect in instrument.effects:
        patched = effect.patch(bare)
        cameras = patched.cameras
        undone = all(is_undone(detector, len(cameras)) for detector in cameras.detectors)
        unknown = conditions_of_effect(bare, effect) - KNOWN
        if cameras.ghosts or cameras.exposures or patched.sky_films or not undone or unknown:
            names.append(effect.name)
    return tuple(names)


def reported(
    instrument: Instrument, counts: Float[Array, "n k"], x: Float[Array, " n"], y: Float[Array, " n"]
) -> Float[Array, "n k"]:
    """Reported counts for counts (electrons) at field points (deg), by the detectors with an inverse."""
    for detector in instrument.patched().cameras.detectors:
        if is_undone(detector, len(instrument.cameras)):
            counts = detector.reported(counts, blank(_Unknown), x, y)
    return counts
