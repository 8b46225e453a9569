"""Exposures that the plan of a night contains for a go, whatever its criterion: the rest of the time is optimised.

The error of p is least with a few angles of the polariser alone. A go asks for more (`data.inspection`,
`calibration.certify`): polariser angles in many directions and over a full turn, and light from the sky, which alone
shows what acts ahead of the polariser. What a calibration has already, to which the plan adds, counts.

Directions   Those that the best plan uses most; where they are too few, the middles of the widest gaps between them.
Sky          An unpolarised and a polarised standard, or patches around the Moon; what takes less time, where those that
             the best plan has anyway take none.
Full turn    Light behind the polariser is the same half a turn later: every second direction is taken there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from walop_jax.data.inspection import FEW_ANGLES, about_exposures, sees_the_sky
from walop_jax.data.records import Exposures
from walop_jax.plans.available import CandidateExposure
from walop_jax.plans.exposures import Candidates
from walop_jax.plans.optimal import Weights

Required = Weights
"""Numbers of exposures by choice and number in it (`available.CandidateExposure`)."""

_DIRECTION = 180.0  # deg after which light behind the polariser is the same
_APART = 3.0  # deg: directions that are nearer are one
_PATCHES = 2  # around the Moon: the sky turns between them, the telescope does not


def met(*taken: Exposures) -> bool:
    """True where lists of exposures, taken or planned, leave nothing open together."""
    return not any(about_exposures(*taken))


def required(found: Candidates, planned: Required, had: Sequence[Exposures]) -> Iterator[Required]:
    """Exposures that a plan must contain, of candidates whose plates stand: all of them, then fewer for a short time.

    `planned` is the best plan without them. First what a go cannot do without (`calibration.certify.lacks`) and the
    directions, then the former alone.
    """
    sky, directions = _of_the_sky(found, planned, had), _directions(found, planned, had)
    for wanted in ({**sky, **directions}, sky):
        if wanted:
            yield wanted


def _of_the_sky(found: Candidates, planned: Required, had: Sequence[Exposures]) -> Required:
    """One exposure each of an unpolarised and a polarised standard, or of patches around the Moon; nothing if seen.

    Those that are planned anyway cost nothing.
    """
    if sees_the_sky(*had):
        return {}
    plan, costs = found.available.plan, found.available.costs
    options: list[tuple[float, Required]] = []
    for number, choice in enumerate(found.choices):
        # Those that are planned first.
        order = sorted(range(len(choice.stops)), key=lambda i, number=number: (number, i) not in planned)
        chosen = []
        if choice.kind == "moon":
            chosen = order[:_PATCHES]
        if choice.kind == "standard":
            stars = [choice.stops[i].number for i in order]
            # A field of zero polarisation follows the standards.
            unpolarised = [k < plan.unpolarised or k >= plan.standards for k in stars]
            if len(set(unpolarised)) == 2:
                chosen = [order[unpolarised.index(kind)] for kind in (True, False)]
        if chosen:
            each, wanted = choice.seconds + costs.of(choice.kind), {(number, i): 1.0 for i in chosen}
            options.append((each * sum(key not in planned for key in wanted), wanted))
    return min(options, key=lambda option: option[0], default=(0.0, {}))[1]


def _directions(found: Candidates, planned: Required, had: Sequence[Exposures]) -> Required:
    """Exposures through the polariser in so many directions that a go misses none, one in each."""
    choices_of_clp = {i: choice for i, choice in enumerate(found.choices) if choice.kind == "clp"}
    if not choices_of_clp or found.available.plan.moving or any(e.further for e in had):
        return {}  # which element does the work of the polariser is not known here
    angles = [float(angle) for e in had for angle in e.clp_angle[e.clp_in]]
    wanted: dict[tuple[int, int], float] = {}
    for key in sorted(planned, key=lambda key: -planned[key]):
        angle = choices_of_clp[key[0]].stops[key[1]].polariser_angle if key[0] in choices_of_clp else None
        if angle is not None and len(_distinct(angles)) < FEW_ANGLES and _is_new(angle, angles):
            angles.append(angle)
            wanted[key] = 1.0
    plain = choices_of_clp[
        number := min(
            choices_of_clp, key=lambda i: (*_plates(choices_of_clp[i]), choices_of_clp[i].seconds, i)
        )
    ]

    def on_the_grid(angle: float) -> tuple[int, float]:
        stop = plain.number(angle)
        return stop, float(plain.stops[stop].polariser_angle or 0.0)

    while len(_distinct(angles)) < FEW_ANGLES:
        begin, gap = _widest(angles, _DIRECTION)
        middle = (begin + 0.5 * gap) % _DIRECTION
        # Where half a turn later is another exposure the one that is farther from all others spreads them over a turn.
        both = (on_the_grid(middle), on_the_grid(middle + plain.turn - _DIRECTION))
        stop, angle = max(both, key=lambda found: _farthest(found[1], angles))
        angles.append(angle)
        wanted[number, stop] = 1.0
    begin, gap = _widest(angles, 360.0)
    if gap > _DIRECTION and plain.turn > _DIRECTION:
        wanted[number, on_the_grid(begin + 0.5 * gap)[0]] = 1.0
    return wanted


def _farthest(angle: float, among: Sequence[float]) -> float:
    """Distance (deg) from the nearest of some angles in a whole turn."""
    return min((abs((angle - other + 180.0) % 360.0 - 180.0) for other in among), default=360.0)


def _plates(choice: CandidateExposure) -> tuple[bool, ...]:
    """Which moving elements are in the beam."""
    return tuple(angle is not None for angle in choice.positions.values())


def _distinct(angles: Sequence[float]) -> list[float]:
    """Directions (deg) that are far enough from each other, in the order of the angles."""
    kept: list[float] = []
    for angle in angles:
        kept += [angle] if _is_new(angle, kept) else []
    return kept


def _is_new(angle: float, among: Sequence[float]) -> bool:
    """True for a direction far from all others."""
    half = 0.5 * _DIRECTION
    return all(abs((angle - other + half) % _DIRECTION - half) >= _APART for other in among)


def _widest(angles: Sequence[float], turn: float) -> tuple[float, float]:
    """Beginning and width (deg) of the widest gap between angles that repeat themselves after a turn."""
    if not angles:
        return -0.5 * turn, turn
    ordered = np.sort(np.mod(angles, turn))
    gaps = np.diff(np.append(ordered, ordered[0] + turn))
    return float(ordered[np.argmax(gaps)]), float(gaps.max())


def half_a_turn_later(found: Candidates, planned: Required) -> set[tuple[int, int]]:
    """Every second direction of the polariser: taken half a turn later the directions lie over a full turn."""
    angles = {}
    for number, stop in planned:
        choice = found.choices[number]
        if choice.kind == "clp" and choice.turn == _DIRECTION:
            angles[number, stop] = choice.stops[stop].polariser_angle or 0.0
    return set(sorted(angles, key=lambda key: (angles[key], key))[1::2])
