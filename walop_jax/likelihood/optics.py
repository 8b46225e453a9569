"""Band rows of a field point with one rule of differentiation: all the optics there is, and its slopes.

Some ten parameters enter before the band integral; all that follows is dot products. Hence one rule, for every
derivative that anyone takes: the rows R of a point come with their slopes in these parameters, computed once,

    dR = Σ_o (∂R/∂θ_o) dθ_o

whatever the number of directions dθ, exposures or cameras. Slopes are forward derivatives of `light.band_rows`, exact.
Parameters that change no row in common are differentiated together: a plate in one half of the pupil leaves the rows of
the other half as they are (the colouring of a sparse Jacobian; Curtis, Powell & Reid 1974, J. Inst. Maths Applics 13,
117). Which parameter reaches which rows is found by following it through the operations, not declared.

The terms of one change that grow with different patterns p_k of the field, such as the 28 of a smooth field, enter at a
point by their sum Σ a_k p_k(X, Y) alone: one direction, along p_k / Σ p_k², gives the slope s in that sum, and
∂R/∂a_k = p_k s.

Rows and slopes come from programs of their own (`known_optics`). They are the largest part of what has to be compiled
for a model, and serve all models that differ in effects on sources, on the polariser or on cameras alone.

Units       parameters in their units; field coordinates deg.
Limits      all but parameters (field position, wavelengths, other arrays of the instrument) is differentiated
            by JAX, without a rule.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from walop_jax.likelihood import limits
from walop_jax.model import light
from walop_jax.model.compiled import compiled, derivatives
from walop_jax.model.conventions import Units
from walop_jax.model.dependence import needs, optical_reach
from walop_jax.model.effects import Change, Described
from walop_jax.model.effects.change import AtPoint
from walop_jax.model.effects.factors import values_at
from walop_jax.model.effects.optics import Displaced
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import ParameterVector, Scalar, by_shapes, leaves, values_of, with_values
from walop_jax.model.plan import Plan, blank_plan, with_numbers
from walop_jax.model.specification import series_indices


@dataclasses.dataclass(frozen=True, eq=False)
class Directions:
    """Directions in parameter space along which the rows are differentiated.

    Parameter `index[o]` belongs to direction `colour[o]`, together with other parameters that change none of its rows;
    `reached[o]` is True for the rows that it changes. Parameters of one `family[o]` are the terms of one change, which
    differ in their `patterns[o]`, texts of factors over the field in `units`; a parameter alone has none.
    """

    index: Int[np.ndarray, " o"]
    colour: Int[np.ndarray, " o"]
    reached: Bool[np.ndarray, "o r"]
    family: Int[np.ndarray, " o"]
    patterns: tuple[tuple[str, ...], ...]
    units: Units

    @property
    def count(self) -> int:
        """Number of directions."""
        return int(self.colour.max(initial=-1)) + 1

    def sizes(self, x: Scalar, y: Scalar) -> Float[Any, " o"]:
        """The pattern of every parameter at a field position (deg); 1 for a parameter alone."""
        if not any(self.patterns):
            return np.ones(len(self.index))
        value = values_at(AtPoint(x, y))
        sizes = (math.prod(value(text, self.units) for text in texts) for texts in self.patterns)
        return jnp.stack([jnp.asarray(size, float) for size in sizes])

    def seeds(self, parameters: int, sizes: Float[Any, " o"]) -> Float[Any, "c n"]:
        """The directions (c, n) as changes of all parameters: p_k / Σ p_k² where patterns have `sizes` p, else 1."""
        if isinstance(sizes, np.ndarray):  # no patterns: the directions are known before anything is traced
            seeds = np.zeros((self.count, parameters))
            seeds[self.colour, self.index] = 1.0
            return seeds
        squares = jnp.zeros(len(sizes)).at[self.family].add(sizes**2)[self.family]
        along = jnp.where(squares > 0.0, sizes / jnp.where(squares > 0.0, squares, 1.0), 0.0)
        return jnp.zeros((self.count, parameters)).at[self.colour, self.index].set(along)


def directions(instrument: Instrument, plan: Plan) -> Directions:
    """The directions for an instrument and a plan, as few as a greedy choice gives.

    Parameters of one direction change no row in common, or are terms of one change over the field.
    """
    reach = optical_reach(instrument, plan)
    rows = np.repeat(reach, [arm.analyser.rows for arm in instrument.arms], axis=0).T
    if light.is_dispersed(instrument):
        rows = np.tile(rows, 2)
    changes = _described(instrument)
    of_cameras = [i for i, change in changes.items() if change.of_camera]
    rows[of_cameras] = False  # they share an array with changes of the optics, and change no row
    index = np.flatnonzero(rows.any(axis=1))
    families = dict[Any, list[int]]()
    for o, i in enumerate(index.tolist()):
        key = dataclasses.replace(changes[i], factors=changes[i].beside_field) if i in changes else i
        families.setdefault(key, []).append(o)
    family, colour, used = np.zeros(len(index), int), np.zeros(len(index), int), []
    patterns: list[tuple[str, ...]] = [()] * len(index)
    for number, members in enumerate(families.values()):
        reached = rows[index[members]].any(axis=0)
        k = next((k for k, rows_used in enumerate(used) if not (rows_used & reached).any()), len(used))
        if k == len(used):
            used.append(np.zeros(rows.shape[1], bool))
        used[k] = used[k] | reached
        colour[members], family[members] = k, number
        if len(members) > 1:
            for o in members:
                patterns[o] = changes[int(index[o])].over_field
    return Directions(index, colour, rows[index], family, tuple(patterns), instrument.units)


def _described(instrument: Instrument) -> dict[int, Change]:
    """The changes of a description by the positions of their amplitudes among the parameters.

    None where the field itself is displaced: the patterns of what comes behind are then those of another point.
    """
    texts = [
        text for effect in instrument.effects if isinstance(effect, Described) for text in effect.sentences
    ]
    changes = {f"{Described.name}.{change.label}": change for change in map(Change.parsed, texts)}
    if not changes or any(isinstance(element, Displaced) for element in instrument.patched().train()):
        return {}
    names = enumerate(parameter.name for parameter in leaves(instrument))
    return {i: changes[name] for i, name in names if name in changes}


def _slopes(
    values: ParameterVector, instrument: Instrument, plan: Plan, x: Scalar, y: Scalar
) -> tuple[Directions, Float[Any, "o r"], light.Rows, Float[Array, "c b r 4"]]:
    """Band rows and their derivatives along `directions`, of which every parameter has a share in every row."""
    along = directions(instrument, plan)
    sizes = along.sizes(x, y)

    def rows(values: ParameterVector) -> light.Rows:
        return light.band_rows(with_values(instrument)(values), plan, x, y)

    shares = sizes[:, None] * along.reached
    return along, shares, *derivatives(rows, (values,), (jnp.asarray(along.seeds(values.size, sizes)),))


@jax.custom_jvp
def band_rows(
    values: ParameterVector, instrument: Instrument, plan: Plan, x: Scalar, y: Scalar
) -> light.Rows:
    """Band rows (`light.band_rows`) at a field position (deg), of an instrument with these values of its parameters."""
    return light.band_rows(with_values(instrument)(values), plan, x, y)


def _rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    values, *inputs = primals
    along, shares, rows, slopes = _slopes(values, *inputs)
    change = jnp.zeros_like(rows)
    if not isinstance(tangents[0], SymbolicZero):
        # The part of every direction in the change of every row.
        part = jnp.zeros(slopes.shape[:1] + rows.shape[1:2])
        part = part.at[along.colour].add(tangents[0][along.index][:, None] * shares)
        change = jnp.einsum("cr,cbrs->brs", part, slopes)
    if not all(isinstance(leaf, SymbolicZero) for leaf in jax.tree.leaves(tangents[1:])):
        steps = jax.tree.map(_instantiated, tangents[1:], is_leaf=lambda leaf: isinstance(leaf, SymbolicZero))
        change = change + jax.jvp(lambda *o: band_rows.fun(values, *o), tuple(inputs), steps)[1]
    return rows, change


def _instantiated(tangent: Any) -> Any:
    if not isinstance(tangent, SymbolicZero):
        return tangent
    aval: Any = tangent.aval
    return np.zeros(aval.shape, aval.dtype)


band_rows.defjvp(_rule, symbolic_zeros=True)


def rows_and_slopes(
    instrument: Instrument, plan: Plan, x: Scalar, y: Scalar
) -> tuple[light.Rows, Float[Array, "o b r 4"]]:
    """Band rows at a field position (deg) and their exact derivatives in the parameters of `directions`."""
    along, shares, rows, slopes = _slopes(values_of(instrument), instrument, plan, x, y)
    return rows, slopes[along.colour] * shares[:, None, :, None]


class KnownOptics(NamedTuple):
    """Band rows of field points, and their derivatives in the parameters of `directions`; `rows` None: not known.

    Slopes without rows are held as they are while the rows remain exact: these take a tenth of the time without
    derivatives, and normal equations a third.
    """

    rows: Float[Any, "*p b r 4"] | None
    slopes: Float[Any, "*p o b r 4"]


def _optics_at(instrument: Instrument, plan: Plan, *columns: Float[Array, " p"]) -> KnownOptics:
    def one(x: Scalar, y: Scalar, *numbers: Scalar) -> KnownOptics:
        return KnownOptics(
            *rows_and_slopes(instrument, with_numbers(plan, *numbers) if numbers else plan, x, y)
        )

    return jax.vmap(one)(*columns)


_known_optics = compiled(_optics_at, optimised_above=limits.OFTEN_OPTIMISED_ABOVE, kept_as="optics")


def known_optics(instrument: Instrument, plan: Plan, *columns: Float[Any, " p"]) -> KnownOptics:
    """Band rows and their exact derivatives (`rows_and_slopes`) at field points, by a program of their own.

    `columns` are x and y (deg) and, if they are not those of the plan, colour temperature (K, 0: flat), temperature and
    hour angle.
    """
    return _known_optics(*_of_optics(instrument, plan), *columns)


def _of_optics(instrument: Instrument, plan: Plan) -> tuple[Instrument, Plan]:
    """What programs of the optics depend on: not the exposures, and no effect of which no parameter changes a row."""
    kept = itertools.compress(instrument.effects, _changes_rows(instrument) if instrument.effects else ())
    of_exposures = jax.tree.map(_emptied, (plan.exposures, plan.band_of))
    bare = eqx.tree_at(lambda p: (p.exposures, p.band_of), plan, of_exposures)
    return dataclasses.replace(instrument, effects=tuple(kept)), bare


def _emptied(leaf: Any) -> np.ndarray:
    return np.zeros((0,) * np.ndim(leaf), jnp.result_type(leaf))


@by_shapes
def _changes_rows(instrument: Instrument) -> tuple[bool, ...]:
    """For every effect, whether one of its parameters changes a row; of one without parameters it is assumed.

    An effect does nothing at neutral: where no parameter reaches the rows, they are those without it. All moving
    elements are in the beam for that, as they are in some exposure or other.
    """
    names = [leaf.name.partition(".")[0] for leaf in leaves(instrument)]
    plan = jax.eval_shape(lambda shapes: blank_plan(shapes, needs(shapes).conditions), instrument)
    reached = {names[i] for i in np.flatnonzero(optical_reach(instrument, plan).any(axis=0))}
    return tuple(effect.name in reached or effect.name not in names for effect in instrument.effects)


@jax.custom_jvp
def with_slopes(
    values: ParameterVector,
    rows: Float[Array, "*m b r 4"],
    slopes: Float[Array, "o *m b r 4"],
    index: Int[Array, " o"],
) -> Float[Array, "*m b r 4"]:
    """Rows that were computed before, at these values, as a function of the parameters `index`: with known slopes."""
    return rows


@with_slopes.defjvp
def _with_slopes_rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    _, rows, slopes, index = primals
    return rows, tangents[1] + jnp.tensordot(tangents[0][index], slopes, 1)


# ------------------------------------------------------------------------------------------- small Jacobians


class LocalDerivatives(NamedTuple):
    """A quantity of a field point and its derivatives: in the plain parameters, and in the throughputs there.

    Plain are all parameters but the coefficients of the throughput series; these enter through the throughputs at the
    point alone (`to_all`). Leading axes are the parameters, and the throughputs, flattened.
    """

    value: Float[Array, ...]
    plain: Float[Array, "o ..."]
    local: Float[Array, "l ..."]


def plain_positions(instrument: Instrument) -> Int[np.ndarray, " o"]:
    """Positions of all parameters but the coefficients of the throughput series."""
    return np.setdiff1d(np.arange(values_of(instrument).size), series_indices(instrument))


def linearised(
    instrument: Instrument, quantity: Callable[[Array, Array], Array], local: Float[Array, ...]
) -> LocalDerivatives:
    """A quantity of all parameters and the local throughputs, and its derivatives at those of an instrument."""
    values, plain = values_of(instrument), plain_positions(instrument)
    # One after the other, in one derivative.
    count, unit_steps = len(plain), np.eye(len(plain) + local.size)
    steps = np.zeros((len(unit_steps), values.size))
    steps[:count, plain] = np.eye(count)
    of_local = unit_steps[:, count:].reshape(-1, *local.shape)
    value, slopes = derivatives(quantity, (values, local), (jnp.asarray(steps), jnp.asarray(of_local)))
    return LocalDerivatives(value, slopes[:count], slopes[count:])


def through_series(local: Float[Any, "... m k"], basis: Float[Any, "... m t"]) -> Float[Any, "... kt"]:
    """Derivatives with respect to the coefficients of the series from those with respect to the throughputs.

    `basis` holds the values of the terms at the sites m; leading axes broadcast. Arrays of numpy stay so.
    """
    xp = jnp if isinstance(local, jax.Array) else np
    spread = xp.einsum("...mk,...mt->...kt", local, basis)
    return spread.reshape(*spread.shape[:-2], -1)


def to_all(
    instrument: Instrument,
    plain: Float[Array, "o ..."],
    local: Float[Array, "l ..."],
    basis: Float[Array, "m t"],
) -> Float[Array, "... n"]:
    """Derivatives with respect to all parameters, in their order; `basis` as in `through_series`."""
    cameras = len(instrument.cameras)
    by_site = jnp.moveaxis(local, 0, -1).reshape(*local.shape[1:], -1, cameras)
    full = jnp.zeros((*plain.shape[1:], values_of(instrument).size))
    full = full.at[..., plain_positions(instrument)].set(jnp.moveaxis(plain, 0, -1))
    return full.at[..., series_indices(instrument)].set(through_series(by_site, basis))
