"""The fold of the train: Mueller matrices of all elements at all their positions, multiplied into the analysers' rows.

A *station* is an element with the ray that arrives at it. A *setting* of the moving elements is a tuple of their
positions, in the order of their columns: an angle in degrees, or None for an element out of the beam. Two moving
elements A and B in three exposures have the settings (0, None), (45, None), (45, 0), for instance. Settings that agree
in the elements nearest to the analysers share the products of these, so that every product is made once. `Fold.solved`
hands all elements of one class over together: the half-wave plates are one computation, compiled once.

Turning     An element in uniform rotation from a to b during an exposure acts by its mean matrix ∫ M(θ) dθ / (b − a),
            since light adds up and no other element turns then: whole turns by the trapezoidal rule, which is exact
            for the harmonics of a turn resolved by `WHOLE` nodes, the remainder by the rule of Gauss and Legendre.
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
        """Angles (deg) at which the element is solved, and their weights in the mean over the turn.

        `period` is the period of the element, None for readings that never repeat themselves.
        """
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
    """Every element with the ray that arrives at it, in the order of the light; and the ray behind the last element."""
    result = []
    for element in elements:
        result.append((element, ray))
        ray = element.ray(ray)
    return result, ray


def angles_of(
    element: Element, moving: Sequence[str], positions: Sequence[ElementPositions]
) -> list[Angle | None]:
    """The angle (deg) of one element in each setting; None where it is out of the beam, or if it does not move."""
    if element.moves is None:
        return [None] * len(positions)
    places = [setting[moving.index(element.moves)] for setting in positions]
    return [at if isinstance(at, Turning) else element.position(at) for at in places]


class Fold(NamedTuple):
    """The stations of the common train and of every arm, and the settings of the elements that move.

    `moving` are the prefixes of the columns of the moving elements (CHWP), `positions` holds one position for each of
    them in each setting. Stations are numbered in the order of `stations`.
    """

    common: list[Station]
    arms: list[list[Station]]
    analysers: list[Analyser]
    moving: Sequence[str]
    positions: Sequence[ElementPositions]

    @classmethod
    def of(
        cls,
        common: Sequence[Element],
        arms: Sequence[Arm],
        ray: Ray,
        moving: Sequence[str],
        positions: Sequence[ElementPositions],
    ) -> Fold:
        """The fold for a ray that enters `common`, the elements ahead of the arms, and then each of the arms."""
        first, ray = stations(common, ray)
        behind = [stations(tuple(arm.train()), ray)[0] for arm in arms]
        return cls(first, behind, [arm.analyser for arm in arms], moving, positions)

    @property
    def stations(self) -> list[Station]:
        """All stations: those of the common train, then those of every arm."""
        return [*self.common, *itertools.chain(*self.arms)]

    def solved(self) -> Solved:
        """Mueller matrices of all stations at all positions of their elements, by (number of the station, angle)."""
        cases: list[tuple[tuple[int, float | None], Element, Ray]] = []
        means: list[tuple[int, float | None, Turning]] = []
        for number, (element, ray) in enumerate(self.stations):
            if element.moves is None:
                cases.append(((number, None), element, ray))
                continue
            places = angles_of(element, self.moving, self.positions)
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

    def in_first_setting(self) -> list[list[Mueller | None]]:
        """Matrices of all stations in the first setting: common train, then every arm; None is the identity."""
        matrices, number = self.solved(), itertools.count()

        def of(element: Element) -> Mueller | None:
            (angle,) = angles_of(element, self.moving, self.positions[:1])
            key = next(number), angle
            return None if element.moves and angle is None else matrices[key]

        return [[of(element) for element, _ in train] for train in (self.common, *self.arms)]

    def backward(self, matrices: Solved, nodes: int) -> Float[Array, "c n r 4"]:
        """Rows (setting, node, row, 4) of the analysers for light ahead of the common train.

        Elements are multiplied in from the analysers towards the source. `columns` are the moving elements met so far:
        rows are kept once for each of their positions (`keys`), and repeated for the positions of the next moving
        element (`parents` says of which shorter key each longer key is an extension).
        """
        in_arms = [element.moves for arm in self.arms for element, _ in arm if element.moves is not None]
        columns = {self.moving.index(prefix) for prefix in in_arms}
        keys = list(dict.fromkeys(_restricted(setting, columns) for setting in self.positions))
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
                # Repeat the rows for each position of the next moving element towards the source.
                extended = columns | {self.moving.index(prefix)}
                parents = {
                    _restricted(setting, extended): _restricted(setting, columns)
                    for setting in self.positions
                }
                rows = _ordered(rows, [keys.index(parent) for parent in parents.values()])
                keys, columns = list(parents), extended
            rows = self._multiplied(rows, matrices, number, keys)
        return _ordered(rows, [keys.index(_restricted(setting, columns)) for setting in self.positions])

    def around(
        self, matrices: Solved, nodes: int
    ) -> list[list[tuple[Float[Array, "c n r 4"], Float[Array, "c n 4 4"]]]]:
        """For every place between elements, of the common train and of the arms: rows of the analysers for light there,
        in every setting, and the matrix of all elements ahead of the place.

        A change of the matrix of a station changes the rows by (rows behind it) × change × (matrix ahead of it).
        """
        stack = [self.stacked(matrices, number) for number in range(len(self.stations))]
        start = jnp.broadcast_to(jnp.eye(4), (len(self.positions), nodes, 4, 4))
        analysed_rows = [analyser.seen(jnp.eye(4)) for analyser in self.analysers]
        blank = jnp.zeros((len(self.positions), nodes, sum(map(len, analysed_rows)), 4))
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
        positions: Sequence[ElementPositions] | None = None,
        out: Mueller | None = None,
    ) -> Mueller | None:
        """Matrices (setting, node, 4, 4) of a station in some settings (default: all); `out`, the identity by default,
        where its element is out of the beam.

        None comes back if the element is the identity in all of them.
        """
        element = self.stations[number][0]
        if element.moves is None:
            return matrices[number, None]
        angles = angles_of(element, self.moving, self.positions if positions is None else positions)
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
        """The rows for light ahead of a station, from those for light behind it; unchanged in settings in which it is
        out.
        """
        element = self.common[number][0]
        inside = [
            i
            for i, at in enumerate(angles_of(element, self.moving, keys))
            if not element.moves or at is not None
        ]
        matrix = self.stacked(matrices, number, [keys[i] for i in inside]) if inside else None
        if matrix is None:
            return rows
        if len(inside) == len(keys):
            return rows @ matrix
        return rows.at[np.array(inside)].set(rows[np.array(inside)] @ matrix)


def _restricted(setting: ElementPositions, columns: set[int]) -> ElementPositions:
    return tuple(position if i in columns else None for i, position in enumerate(setting))


def _ordered(rows: Float[Array, "c n r 4"], order: list[int]) -> Float[Array, "d n r 4"]:
    return rows if order == list(range(len(rows))) else rows[np.array(order)]
