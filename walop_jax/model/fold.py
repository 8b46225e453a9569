"""The fold of the train: Mueller matrices of all elements at all their positions, multiplied into the analysers' rows.

A *station* is an element with its incident ray; a *state* holds the positions of the moving elements in one
optical setting (an angle in degrees, None when out), in the order of their columns. Settings that agree in the
elements nearest to the analysers share the products of these, so every product is made once. `Fold.solved` hands all
elements of one class over together: the half-wave plates are one computation, compiled once.

Turning     An element in uniform rotation from a to b during an exposure acts by its mean matrix ∫ M(θ) dθ / (b − a),
            since light adds up and no other element turns then: whole turns by the trapezoidal rule, which is exact for
            the harmonics of a turn resolved by `WHOLE` nodes, the remainder by that of Gauss and Legendre.
Limits      b − a = 0: M(a). Of an ideal retarder cos 2θ, cos 4θ become cos(n (a + b)/2) sinc(n (b − a)/2).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.elements.simple import Analyser
from walop_jax.model.light_path import Arm
from walop_jax.model.mueller import product
from walop_jax.model.ray import Ray

Station = tuple[Element, Ray]
WHOLE = 64  # angles of a whole turn
FEWEST, PER_RADIAN = 8, 12.0  # angles of a partial turn: the minimum, and more for each radian


class Turning(NamedTuple):
    """Position of an element that turns by `turn` (deg) during an exposure, about the angle `middle` (deg)."""

    middle: float
    turn: float

    def angles(self, period: float | None = 360.0) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Angles (deg) of the mean, and their weights; `period` is that of the element, None where nothing repeats."""
        remainder = self.turn if period is None else self.turn % period
        full_turns = self.turn - remainder
        start = self.middle - self.turn / 2.0
        at = start + period / WHOLE * np.arange(WHOLE) if period and full_turns else np.zeros(0)
        weight = np.full(len(at), full_turns / self.turn / WHOLE)
        if remainder:
            nodes, shares = np.polynomial.legendre.leggauss(FEWEST + int(PER_RADIAN * np.deg2rad(remainder)))
            at = np.append(at, start + remainder / 2.0 * (1.0 + nodes))
            weight = np.append(weight, shares * remainder / self.turn / 2.0)
        return at, weight


Angle = float | Turning
ElementPositions = tuple[Angle | None, ...]
Solved = dict[tuple[int, Angle | None], Mueller | None]
"""Mueller matrices by number of the station and angle of its element (None: not moving)."""


def stations(elements: Sequence[Element], ray: Ray) -> tuple[list[Station], Ray]:
    """Elements with their rays, and the ray behind the last."""
    result = []
    for element in elements:
        result.append((element, ray))
        ray = element.ray(ray)
    return result, ray


def positions(
    element: Element, moving: Sequence[str], states: Sequence[ElementPositions]
) -> list[Angle | None]:
    """Angles (deg) of an element, state by state; None where it is out, or not moving (see `Solved`)."""
    if element.moves is None:
        return [None] * len(states)
    places = [state[moving.index(element.moves)] for state in states]
    return [at if isinstance(at, Turning) else element.position(at) for at in places]


class Fold(NamedTuple):
    """Stations of the common train and of every arm, and the states of the elements that move.

    `moving` are the prefixes of the columns of these; stations are numbered in the order of `stations`.
    """

    common: list[Station]
    arms: list[list[Station]]
    analysers: list[Analyser]
    moving: Sequence[str]
    states: Sequence[ElementPositions]

    @classmethod
    def of(
        cls,
        common: Sequence[Element],
        arms: Sequence[Arm],
        ray: Ray,
        moving: Sequence[str],
        states: Sequence[ElementPositions],
    ) -> Fold:
        """Elements ahead of the arms, and the arms behind them, for an entering ray."""
        first, ray = stations(common, ray)
        behind = [stations(tuple(arm.train()), ray)[0] for arm in arms]
        return cls(first, behind, [arm.analyser for arm in arms], moving, states)

    @property
    def stations(self) -> list[Station]:
        """Those of the common train, then of every arm."""
        return [*self.common, *itertools.chain(*self.arms)]

    def solved(self) -> Solved:
        """Mueller matrices of all stations at all their positions."""
        cases: list[tuple[tuple[int, float | None], Element, Ray]] = []
        means: list[tuple[int, float | None, Turning]] = []
        for number, (element, ray) in enumerate(self.stations):
            if element.moves is None:
                cases.append(((number, None), element, ray))
                continue
            places = positions(element, self.moving, self.states)
            occurring = dict.fromkeys(angle for angle in places if angle is not None)
            turning = [at for at in occurring if isinstance(at, Turning)]
            means += [(number, element.period, at) for at in turning]
            angles = {at for at in occurring if not isinstance(at, Turning)}.union(
                *(at.angles(element.period)[0].tolist() for at in turning)
            )
            cases += [((number, angle), element.turned(angle), ray) for angle in sorted(angles)]
        result: Solved = {}
        for kind in dict.fromkeys(type(element) for _, element, _ in cases):
            members = [case for case in cases if type(case[1]) is kind]
            matrices = kind.solved([(element, ray) for _, element, ray in members])
            result.update({key: matrix for (key, _, _), matrix in zip(members, matrices, strict=True)})
        for number, period, at in means:
            angles, weights = at.angles(period)
            acting = [matrix for angle in angles.tolist() if (matrix := result[number, angle]) is not None]
            result[number, at] = jnp.tensordot(jnp.asarray(weights), jnp.stack(acting), 1) if acting else None
        return result

    def in_first_state(self) -> list[list[Mueller | None]]:
        """Matrices of all stations in the first state, of the common train, then of every arm; None: the identity."""
        matrices, number = self.solved(), itertools.count()

        def of(element: Element) -> Mueller | None:
            (angle,) = positions(element, self.moving, self.states[:1])
            key = next(number), angle
            return None if element.moves and angle is None else matrices[key]

        return [[of(element) for element, _ in train] for train in (self.common, *self.arms)]

    def backward(self, matrices: Solved, nodes: int) -> Float[Array, "c n r 4"]:
        """Rows of the analysers in every state, for light ahead of the common train."""
        in_arms = [element.moves for arm in self.arms for element, _ in arm if element.moves is not None]
        columns = {self.moving.index(prefix) for prefix in in_arms}
        keys = list(dict.fromkeys(_restricted(state, columns) for state in self.states))
        number, blocks = len(self.common), []
        for arm, analyser in zip(self.arms, self.analysers, strict=True):
            matrix = product(self.stacked(matrices, number + i, keys) for i in range(len(arm)))
            number += len(arm)
            analysed = analyser.seen(jnp.eye(4) if matrix is None else matrix)
            blocks.append(jnp.broadcast_to(analysed, (len(keys), nodes, *analysed.shape[-2:])))
        rows = jnp.concatenate(blocks, axis=2)
        for number in reversed(range(len(self.common))):
            prefix = self.common[number][0].moves
            if prefix is not None:
                # The rows once for every position of one more moving element.
                extended = columns | {self.moving.index(prefix)}
                parents = {_restricted(state, extended): _restricted(state, columns) for state in self.states}
                rows = _ordered(rows, [keys.index(parent) for parent in parents.values()])
                keys, columns = list(parents), extended
            rows = self._multiplied(rows, matrices, number, keys)
        return _ordered(rows, [keys.index(_restricted(state, columns)) for state in self.states])

    def around(
        self, matrices: Solved, nodes: int
    ) -> list[list[tuple[Float[Array, "c n r 4"], Float[Array, "c n 4 4"]]]]:
        """For every place of the common train and of the arms: rows of the analysers for light there, in every state,
        and the matrix of all elements ahead of it.

        A change of the matrix of a station changes the rows by (rows behind it) × change × (matrix ahead of it).
        """
        stack = [self.stacked(matrices, number) for number in range(len(self.stations))]
        start = jnp.broadcast_to(jnp.eye(4), (len(self.states), nodes, 4, 4))
        analysed_rows = [analyser.seen(jnp.eye(4)) for analyser in self.analysers]
        blank = jnp.zeros((len(self.states), nodes, sum(map(len, analysed_rows)), 4))
        arm_places, row, first, count = [], 0, len(self.common), len(self.common)
        for arm, analysed in zip(self.arms, analysed_rows, strict=True):
            path = [*stack[:count], *stack[first : first + len(arm)]]
            last = blank.at[:, :, row : row + len(analysed)].set(analysed)
            row, first = row + len(analysed), first + len(arm)
            ahead = itertools.accumulate(
                path, lambda matrix, m: matrix if m is None else m @ matrix, initial=start
            )
            rows = itertools.accumulate(
                reversed(path), lambda rows, m: rows if m is None else rows @ m, initial=last
            )
            places = [*zip([*rows][::-1], ahead, strict=True)]
            arm_places.append((places[: count + 1], places[count:]))
        # Of the common train, as each of the arms sees it.
        same = zip(*(shared for shared, _ in arm_places), strict=True)
        common_places = [
            (functools.reduce(jnp.add, [rows for rows, _ in views]), views[0][1]) for views in same
        ]
        return [common_places, *(arm for _, arm in arm_places)]

    def stacked(
        self,
        matrices: Solved,
        number: int,
        states: Sequence[ElementPositions] | None = None,
        out: Mueller | None = None,
    ) -> Mueller | None:
        """Matrices of a station in states (all), `out` (the identity) where it is out; None: always the identity."""
        element = self.stations[number][0]
        if element.moves is None:
            return matrices[number, None]
        angles = positions(element, self.moving, self.states if states is None else states)
        distinct = list(dict.fromkeys(angles))
        at_angles = [None if at is None else matrices[number, at] for at in distinct]
        inside = [matrix for matrix in at_angles if matrix is not None]
        if not inside:
            return None
        shape = np.broadcast_shapes(*(matrix.shape for matrix in inside))
        gone = jnp.broadcast_to(jnp.eye(4) if out is None else out, shape)
        stack = jnp.stack([gone if m is None else jnp.broadcast_to(m, shape) for m in at_angles])
        if len(distinct) < len(angles):
            stack = stack[np.array([distinct.index(at) for at in angles])]
        return stack if len(shape) == 3 else stack[:, None]

    def _multiplied(
        self, rows: Float[Array, "c n r 4"], matrices: Solved, number: int, keys: Sequence[ElementPositions]
    ) -> Float[Array, "c n r 4"]:
        """Rows of the light ahead of a station; unchanged in states without it."""
        element = self.common[number][0]
        inside = [
            i
            for i, at in enumerate(positions(element, self.moving, keys))
            if not element.moves or at is not None
        ]
        matrix = self.stacked(matrices, number, [keys[i] for i in inside]) if inside else None
        if matrix is None:
            return rows
        if len(inside) == len(keys):
            return rows @ matrix
        return rows.at[np.array(inside)].set(rows[np.array(inside)] @ matrix)


def _restricted(state: ElementPositions, columns: set[int]) -> ElementPositions:
    return tuple(position if i in columns else None for i, position in enumerate(state))


def _ordered(rows: Float[Array, "c n r 4"], order: list[int]) -> Float[Array, "d n r 4"]:
    return rows if order == list(range(len(rows))) else rows[np.array(order)]
