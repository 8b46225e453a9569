"""Descriptions on all possible omissions of an instrument model: kind × place × dependence, from train and exposures.

A *group* of descriptions is one candidate of the score test: a linear retarder has two axes, a harmonic a cosine and a
sine, a gradient two directions.

    kinds         those of `model.effects`, in the groups of `optics.GROUPS`
    places        ahead of the polariser (without one: of the first element) and of each arm, behind the polariser and
                  every later element that acts on polarisation, in the common train and in the arms; of
                  the polariser, another moving element, a wave plate, a camera, an arm, a source
    dependence    those that `ChangeKind.grows` names of a kind at a place: patterns over the field, each with every
                  dependence on wavelength, time, temperature, hour angle, angles, exposures and counts
                  (`Combinations`), of those that the exposures can distinguish (`Dependences`)

The evidence of each description is reduced by the logarithm of their number. `beside_names` finds the groups that are
equivalent to an effect of the catalogue, or part of one.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.records import Exposures
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.hypotheses import (
    FEWEST_POINTS,
    Hypotheses,
    Probe,
    SmoothField,
    applicable,
    probes,
    texts_of,
)
from walop_jax.likelihood import limits
from walop_jax.model.effects import Context, Described, EffectKind
from walop_jax.model.effects.cameras import POWERS
from walop_jax.model.effects.change import AMPLITUDES, BAND, KINDS, OPPOSITE, SKY, Change, place_of_star
from walop_jax.model.effects.etalon import probed_gaps
from walop_jax.model.effects.factors import FIELD
from walop_jax.model.effects.in_models import effect_context
from walop_jax.model.effects.numbers import OF_QU
from walop_jax.model.effects.optics import ADDED, DISPLACEMENTS, GENERATORS, GROUPS
from walop_jax.model.elements.geometry import PupilMapping
from walop_jax.model.elements.wave_plate import WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.planning import hours_of
from walop_jax.model.slots import acts
from walop_jax.sky.nights import first_of_nights

ROUNDED = 1e-4  # hours, of times in descriptions


def descriptions(instrument: Instrument, exposures: Exposures, points: int) -> tuple[Probe, ...]:
    """All groups that an instrument and its exposures allow, short ones first; `points` counts the field points."""
    groups = dict.fromkeys(_groups(dataclasses.replace(instrument, effects=()), exposures, points))
    texts = ([description.text for description in group] for group in sorted(groups, key=len))
    context = effect_context(instrument, exposures)
    return tuple(
        Probe("; ".join(t), Described, tuple(Described.of(context, sentences=(text,)) for text in t), context)
        for t in texts
    )


def hypotheses(
    catalogue: Sequence[EffectKind], instrument: Instrument, exposures: Exposures, points: int
) -> Hypotheses:
    """The one list of candidates of a diagnosis, of the verdict on a fit, and of detection limits.

    Structural effects of `instrument` (a plate left out, the calibration plate in the beam) are part of it: there is no
    candidate that acts on an element that they remove.
    """
    instrument = instrument.as_put_together()
    context = effect_context(instrument, exposures)
    all_probes = descriptions(instrument, exposures, points)
    effects = applicable(catalogue, context, instrument)
    alone, partial = beside_names(all_probes, effects, context, instrument)
    smooth = smooth_fields(instrument, exposures, points)
    return Hypotheses(tuple(probes(effects, context)), alone, partial, effects, all_probes, smooth)


# ------------------------------------------------------------------------------------- names that are descriptions


def beside_names(
    all_probes: Sequence[Probe], catalogue: Sequence[EffectKind], context: Context, instrument: Instrument
) -> tuple[list[Probe], list[Probe]]:
    """The groups that are no effect of a catalogue by another name: those that none holds, and parts of effects.

    A part is a group that effects hold, none of them as a whole: one patch of all, the light in one camera.
    """
    # Shape by shape, where each description has an amplitude.
    shapes = [Probe(effect.name, effect, group) for effect in catalogue for group in effect.probes(context)]
    named = [(frozenset(shape.group[0].as_descriptions(instrument)), shape) for shape in shapes]
    named = [(texts, shape.effect) for texts, shape in named if len(texts) <= len(shape.parameters)]
    alone, partial = [], []
    for probe in all_probes:
        own = frozenset(texts_of(probe))
        holders = frozenset(effect for texts, effect in named if texts > own)
        if any(texts == own for texts, _ in named):
            continue
        if holders:
            partial.append(dataclasses.replace(probe, holders=holders))
        else:
            alone.append(probe)
    return alone, partial


def retimed(description: Change, exposures: Exposures, end: int) -> list[Change]:
    """The same with another start (`end` 0) or stop (1), at all times within the spacing of the first search.

    Empty for a description without start and stop between two exposures.
    """
    times = starts_of_steps(exposures)
    if [factor.form for factor in description.grows_with] != ["hours"]:
        return []
    hours = [float(text) for text in description.grows_with[0].given]
    at = int(np.argmin(np.abs(times - hours[end])))
    if abs(times[at] - hours[end]) > ROUNDED:
        return []
    reach = -(-len(times) // STEPS)
    near = times[max(at - reach, 0) : at + reach + 1]
    spans = [(time, hours[1]) if end == 0 else (hours[0], time) for time in near]
    return [
        dataclasses.replace(description, factors=(between(*span),)) for span in spans if span[0] < span[1]
    ]


# ------------------------------------------------------------------------------------------------------ all groups

Base = tuple[Change, ...]
Mask = Bool[np.ndarray, " e"]


class Subject(NamedTuple):
    """Changes with the same dependences, by the groups of a joint trial (`Combinations.among`).

    They may grow with the angles of elements of some `prefixes`, and are seen in exposures that are `inside` (None: in
    all of them).
    """

    bases: Mapping[str, Sequence[Base]]
    prefixes: tuple[str, ...] = ()
    inside: Mask | None = None

    @classmethod
    def of(cls, *bases: Base, inside: Mask | None = None, **among: Sequence[Base]) -> Subject:
        """Each alone, and all of several together."""
        together = [tuple(itertools.chain(*bases))][: len(bases) - 1]
        return cls({"alone": bases, "all": together, **among}, (), inside)


def _base(kinds: Iterable[str], where: str, place: str, origin: str = "") -> Base:
    return tuple(Change(kind, where, place, origin=origin) for kind in kinds)


def _groups(instrument: Instrument, exposures: Exposures, points: int) -> Iterator[Base]:
    """All groups of descriptions: the changes of each subject, with each pattern over the field and each law."""
    for bases, patterns, _, group, order in _with_laws(instrument, exposures, points):
        for pattern, base in itertools.product(filter(PATTERNS.get, patterns), bases):
            pairs = [
                tuple(filter(None, pair[::order])) for pair in itertools.product(group, PATTERNS[pattern])
            ]
            yield tuple(description.times(*pair) for description in base for pair in pairs)


def smooth_fields(instrument: Instrument, exposures: Exposures, points: int) -> tuple[SmoothField, ...]:
    """All changes that may vary over the field: each place and law once, of whichever patterns it is tried with.

    Changes that begin or end at some time are tried without a pattern, but for smooth fields. Where the counts of two
    cameras are known but for a common factor, a gain of one is a gain of the other, which is asked for alone. In the
    most frequent KIND gains and light of cameras alone are asked for: what it shows of optics would be told twice, once
    as a change that is always there.
    """
    found: dict[str, SmoothField] = {}
    bare = dataclasses.replace(instrument, effects=())
    references = {instrument.cameras.names[k] for k in instrument.cameras.ratio_references}
    over_field = points >= FEWEST_POINTS
    for bases, patterns, form, group, order in _with_laws(bare, exposures, points, every_kind=True):
        allowed = KINDS[bases[0][0].kind].grows(bare, bases[0][0]).allowed if bases else ()
        sudden = over_field and form in SUDDEN and FIELD in allowed
        if not sudden and all(PATTERNS[pattern] == ("",) for pattern in patterns if pattern != "rings"):
            continue
        for base in bases:
            changes = [description.times(*filter(None, (law,))) for description in base for law in group]
            if any(c.kind == "gain" and not c.factors and c.place in references for c in changes):
                continue
            # All amplitudes of one kind come together, as `Described` has them.
            changes.sort(key=lambda change: list(AMPLITUDES).index(change.parameter))
            field = SmoothField(tuple(changes), pattern_first=order < 0)
            found.setdefault(field.name, field)
    return tuple(found.values())


def _with_laws(
    instrument: Instrument, exposures: Exposures, points: int, *, every_kind: bool = False
) -> Iterator[tuple[list[Base], list[str], str, tuple[str, ...], int]]:
    """Changes that are tried together, the patterns over the field of each, a law of the exposures for each.

    Of the law its form and its factors. The last number is −1 where a pattern stands ahead of the law in a text, 1
    where it stands behind it.
    """
    over_field, everything = points >= FEWEST_POINTS, np.ones(len(exposures), bool)
    for bases, prefixes, inside in _subjects(instrument, exposures, over_field=over_field):
        seen = everything if inside is None else inside
        first = bases["alone"][0][0]
        of_light = first.of_camera and not first.factors
        shown = Dependences(exposures, over_field, prefixes, seen, every_kind and of_light)
        order = (
            -1 if first.relation in ("behind", "ahead of") else 1
        )  # between elements the pattern comes first
        for over, along, among in KINDS[first.kind].grows(instrument, first).tried:
            patterns = [name for name in over if over_field or name == "even"]
            alternatives = list(itertools.chain(*(bases.get(name, ()) for name in among)))
            for form in along:
                for group in shown.of(form):
                    yield alternatives, patterns, form, group, order


def _subjects(instrument: Instrument, exposures: Exposures, *, over_field: bool) -> Iterator[Subject]:
    """All changes that fit the instrument and are visible in the exposures."""
    ahead, sky = instrument.ahead_of_polariser, ~exposures.clp_in
    groups = [group for group in GROUPS if over_field or not group[0].endswith(("radial", "diagonal"))]
    for places in places_of(instrument, exposures):
        inside = sky if places == [ahead] else None
        anything = [_base(GENERATORS, *place) for place in places]
        for number, group in enumerate(groups):
            bases = (_base(group, *place) for place in places)
            yield Subject.of(*bases, inside=inside, anything=[] if number else anything)
    if ahead is not None and sky.any():
        yield Subject.of(_base(ADDED, *ahead), inside=sky)
    moving = {element.moves: element for element in instrument.train() if element.moves}
    turning = [prefix for prefix in moving if exposures.position(prefix).inside.any()]
    for prefix in turning:
        place = "of", moving[prefix].name
        for number, group in enumerate((*groups, ("turn",))):
            bases = {
                "alone": [_base(group, *place)],
                "anything": [] if number else [_base(GENERATORS, *place)],
            }
            yield Subject(bases, (prefix,), exposures.position(prefix).inside)
    yield from _of_plates(instrument, exposures)
    yield from _of_cameras(instrument, exposures, tuple(turning), over_field=over_field)
    yield Subject.of(_base(("shift",), "of", BAND))
    for element in instrument.train() if over_field else ():
        if isinstance(element, PupilMapping):
            yield Subject.of(_base(DISPLACEMENTS, "ahead of", element.name))
    for kinds in (OF_QU, ("polarisation",)) if exposures.direct("moon").any() else ():
        yield Subject.of(_base(kinds, "of", SKY))
    for name in instrument.standard.names:
        yield Subject.of(_base(OF_QU, "of", place_of_star(name)))


def places_of(instrument: Instrument, exposures: Exposures) -> Iterator[list[tuple[str, str]]]:
    """Places between elements that act on polarisation: preposition and element; equal names in all arms together."""
    train, polariser, arms = list(instrument.train()), instrument.polariser, instrument.arms
    behind = train[len(instrument.telescope()) + (polariser is not None) :]
    if polariser is not None:
        if (ahead := instrument.ahead_of_polariser) and not exposures.clp_in.all():
            yield [ahead]
        yield [("behind", polariser.name)]
    elif behind:
        yield [("ahead of", behind[0].name)]
    for element in behind:
        if acts(element) and (element.moves is None or exposures.position(element.moves).inside.any()):
            yield [("behind", element.name)]
    for arm in arms if len(arms) > 1 else ():
        yield [("ahead of", f"{arm.name}.{next(iter((*arm.train(), arm.analyser))).name}")]
    acting = {arm.name: [element.name for element in arm.train() if acts(element)] for arm in arms}
    for name in dict.fromkeys(itertools.chain(*acting.values())):
        yield [("behind", f"{arm}.{name}") for arm, names in acting.items() if name in names]


def _of_plates(instrument: Instrument, exposures: Exposures) -> Iterator[Subject]:
    plates = {place: instrument.element(place) for place in instrument.places(WavePlate)}
    inside = {place: exposures.position(plate.moves).inside for place, plate in plates.items() if plate.moves}
    plates = {place: plate for place, plate in plates.items() if place not in inside or inside[place].any()}
    if fixed := [place for place in plates if place not in inside]:
        yield Subject.of(*(_base(("axis",), "of", place) for place in fixed))
    for place in [place for place in plates if place in inside]:
        yield Subject.of(_base(("axis",), "of", place), inside=inside[place])
    for place, plate in plates.items():
        layers = [f"{place}.{layer.name}" for layer in plate.layers]  # pyright: ignore[reportAttributeAccessIssue]
        yield Subject.of(tuple(Change("thickness", "of", layer) for layer in layers))
        for kind, affected in (("axis", layers[1:]), ("cut", layers)):
            yield from (Subject.of(_base((kind,), "of", layer)) for layer in affected)
    if plates and varies(exposures.temp):
        yield Subject.of(tuple(Change("thermal", "of", place) for place in plates))
    for pair in probed_gaps(instrument.units) if plates else ():
        gaps = tuple(f"gap {gap:g}" for gap in pair)
        yield Subject.of(*(tuple(Change("fringes", "of", p, (gap,)) for gap in gaps) for p in plates))


def _of_cameras(
    instrument: Instrument, exposures: Exposures, turning: tuple[str, ...], *, over_field: bool
) -> Iterator[Subject]:
    cameras, arms = instrument.cameras.names, instrument.arms if len(instrument.arms) > 1 else ()
    gains = {name: _base(("gain",), "of", name) for name in (*cameras, *(arm.name for arm in arms))}
    pairs = [tuple(itertools.chain(*(gains[name] for name in arm.analyser.cameras))) for arm in arms]
    yield Subject.of(*(gains[name] for name in cameras), arm=pairs)._replace(prefixes=turning)
    if arms:
        yield Subject.of(*(gains[arm.name] for arm in arms))
    # How far a camera is from linear may depend on the exposure: on its length, on the temperature of an amplifier.
    curved = {name: (base[0].times("counts"),) for name, base in gains.items()}
    both = [tuple(itertools.chain(*(curved[name] for name in arm.analyser.cameras))) for arm in arms]
    yield Subject.of(*(curved[name] for name in cameras), arm=both)
    for origin in ("", OPPOSITE) if over_field else ():
        yield Subject.of(*(_base(("light",), "in", name, origin) for name in cameras))
    if varies(exposures.mjd):
        yield Subject.of(*(_base(("afterglow",), "in", name) for name in cameras))
    orthogonal = {name: cameras[j] for name, j in zip(cameras, instrument.cameras.orthogonal, strict=True)}
    if two := [pair for pair in orthogonal.items() if pair[0] != pair[1]]:
        yield Subject.of(*(_base(("light",), "in", *pair) for pair in two))
    together = instrument.cameras.together
    for (k, name), (j, origin) in itertools.permutations(enumerate(cameras), 2):
        # Between arms of unknown fluxes light would have to be counted in the flux of the arm that it comes from.
        if orthogonal[name] != origin and (together is None or together[k, j]):
            yield Subject.of(_base(("light",), "in", name, origin))


SUDDEN = ("step", "side", "night")  # laws of changes that begin or end at some time
STEPS, FEW = 16, 18  # times of a step in the first search; most times for which all spells are tried
AFTER = 0.5  # hours behind the last exposure that a step ends


def starts_of_steps(exposures: Exposures) -> Float[np.ndarray, " s"]:
    """Hours at which something may have changed: midway between exposures."""
    hours = np.unique(hours_of(exposures))
    return (hours[1:] + hours[:-1]) / 2.0


def evenly(times: Float[np.ndarray, " s"]) -> Float[np.ndarray, " t"]:
    """`STEPS` or fewer of the times, evenly spread over their list; `retimed` tries the times between."""
    at = np.unique(((np.arange(STEPS) + 0.5) / STEPS * len(times)).astype(int))
    return times[at[: len(times)]]


def between(start: float, stop: float) -> str:
    """The factor that is 1 from one time to another (hours; to 0.4 s)."""
    return f"hours {round(float(start), 4)} to {round(float(stop), 4)}"


def end_of(exposures: Exposures) -> float:
    """Hours at which a step ends: `AFTER` the last exposure."""
    return float(hours_of(exposures).max()) + AFTER


PATTERNS: Mapping[str, tuple[str, ...]] = {
    "even": ("",),
    "tilt": ("x", "y"),
    "r2": ("r2",),
    "astigmatic": ("x2-y2", "xy"),
    "focus": ("", "r2"),
    "smooth": ("", "x", "y", "r2"),
    "rings": tuple(f"ring {degree}" for degree in thresholds.RINGS),
    "any": (),
}
"""Patterns over the field (`Combinations.over`): factors that have an amplitude each; "any" is a smooth field alone
(`smooth_fields`)."""


@dataclasses.dataclass(frozen=True)
class Dependences:
    """Factors that exposures can tell apart: groups by form (`Combinations.along`), each factor with an amplitude.

    `over_field` is True with enough points for a pattern; factors may depend on the angles of the elements
    `prefixes`, and are limited to the exposures `inside`. With `every_kind` the most frequent KIND is a factor as well:
    parameters of the model hold what is the same in all KINDs, but not every pattern over the field.
    """

    exposures: Exposures
    over_field: bool
    prefixes: tuple[str, ...]
    inside: Bool[np.ndarray, " e"]
    every_kind: bool = False

    def of(self, form: str) -> Iterator[tuple[str, ...]]:
        """The groups of one form."""
        name, _, limit = form.partition(" to ")
        if name not in _SHOWS:
            yield from getattr(self, f"_{name}")(*map(int, limit.split()))
        elif _SHOWS[name](self):
            yield (name.removeprefix("steady"),)

    def _harmonics(self, most: int) -> Iterator[tuple[str, ...]]:
        """Cosine and sine of the harmonics that the angles of a moving element can show."""
        for prefix in self.prefixes:
            position = self.exposures.position(prefix)
            angles = np.unique(np.round(np.mod(position.angle[position.inside], 360.0), 3))
            for order in range(1, most + 1):
                if len(angles) >= 2 * order + 1:
                    yield f"cos {order} {prefix}", f"sin {order} {prefix}"

    def _shows_hour_angle(self) -> bool:
        """True where the hour angle is not degenerate with time."""
        angle, time = self.exposures.ha, self.exposures.mjd
        remainder = angle - angle.mean()
        if varies(time):
            time = time - time.mean()
            remainder = remainder - time * (time @ remainder) / (time @ time)
        return bool(np.isfinite(angle).all() and np.ptp(remainder) > 1e-3 * np.ptp(angle))

    def _shows_exptime(self) -> bool:
        """True where exposures of one KIND have several exposure times: else these are degenerate with the KIND."""
        seconds, kind = self.exposures.exptime[self.inside], self.exposures.kind[self.inside]
        known = np.isfinite(self.exposures.exptime).all() and self.exposures.exptime.min() > 0
        return bool(
            known and any(np.ptp(seconds[kind == name]) > 1e-3 * seconds.max() for name in np.unique(kind))
        )

    def _shows_order(self) -> bool:
        """True where the order of the exposures is not degenerate with time."""
        hours, order = hours_of(self.exposures), np.arange(len(self.exposures), dtype=float)
        timed = varies(self.exposures.mjd) and len(order) > 2
        return bool(timed and abs(np.corrcoef(hours, order)[0, 1]) < thresholds.SAME)

    def _side(self) -> Iterator[tuple[str, ...]]:
        """The side from which a moving element came, where it came from both."""
        for prefix in self.prefixes:
            angle, inside = (getattr(self.exposures.position(prefix), name) for name in ("angle", "inside"))
            turned = np.sin(np.deg2rad(np.diff(angle[inside])))
            if varies(self.exposures.mjd) and min(np.sum(turned > 1e-9), np.sum(turned < -1e-9)) > 1:
                yield (f"side {prefix}",)

    def _moments(self) -> Float[np.ndarray, " s"]:
        """Times (hours) at which something may have changed: ahead of each exposure that is `inside` but the first."""
        if not varies(self.exposures.mjd):
            return np.zeros(0)
        starts, hours = starts_of_steps(self.exposures), np.unique(hours_of(self.exposures)[self.inside])
        return starts[np.unique(np.searchsorted(starts, hours[1:]) - 1)]  # ahead of each but the first

    def _step(self) -> Iterator[tuple[str, ...]]:
        """From a time until the end; not so near to an end that all but one or two exposures are alike."""
        for time in evenly(self._moments()[1:-1]):
            yield (between(time, end_of(self.exposures)),)

    def _spell(self) -> Iterator[tuple[str, ...]]:
        """From a time until another: all of them, or of many exposures an eighth, a quarter or half of them."""
        times = self._moments()
        starts, lengths = evenly(times), (STEPS // 8, STEPS // 4, STEPS // 2)
        spells = itertools.chain(*(zip(starts, starts[length:], strict=False) for length in lengths))
        for spell in itertools.combinations(times, 2) if len(times) <= FEW else spells:
            yield (between(*spell),)

    def _night(self) -> Iterator[tuple[str, ...]]:
        """Every night, where there are several."""
        for start, stop in self._nights():
            yield (f"hours {max(start - 0.5, 0.0):.2f} to {stop + 0.5:.2f}",)

    def _nights(self) -> list[tuple[float, float]]:
        """Hours of the first and the last exposure of every night; empty unless there are several."""
        if not varies(self.exposures.mjd):
            return []
        hours = np.sort(hours_of(self.exposures))
        first = first_of_nights(hours / 24.0)
        nights = itertools.pairwise([*first, len(hours)]) if len(first) > 1 else ()
        return [(hours[start], hours[stop - 1]) for start, stop in nights]

    def _kind(self) -> Iterator[tuple[str, ...]]:
        """KINDs of the exposures `inside`; if these are all exposures, without the most frequent (but `every_kind`)."""
        names, counts = np.unique(self.exposures.kind[self.inside], return_counts=True)
        first = int(len(names) == 1 or (bool(self.inside.all()) and not self.every_kind))
        yield from ((f"kind {name}",) for name in names[np.argsort(-counts, kind="stable")][first:])

    def _exposure(self) -> Iterator[tuple[str, ...]]:
        """Every single exposure, of up to `limits.FREE_EXPOSURES`, where there are enough field points."""
        if self.over_field and len(self.exposures) <= limits.FREE_EXPOSURES:
            yield from ((f"exposure {number}",) for number in np.flatnonzero(self.inside))

    def _patch(self) -> Iterator[tuple[str, ...]]:
        """Every patch of the Moon sky, which is an exposure, and all of them."""
        patches = [f"exposure {number}" for number in np.flatnonzero(self.exposures.direct("moon"))]
        if 0 < len(patches) <= limits.FREE_EXPOSURES:
            yield from zip(patches)
            if len(patches) > 1:
                yield tuple(patches)


_SHOWS: Mapping[str, Callable[[Dependences], bool]] = {
    "steady": lambda of: True,
    "colour": lambda of: len(np.unique(of.exposures.filter)) > 1,
    "hours": lambda of: varies(of.exposures.mjd),
    "kelvin": lambda of: varies(of.exposures.temp),
    **dict.fromkeys(POWERS, lambda of: True),
    "hour angle": Dependences._shows_hour_angle,
    "per EXPTIME": Dependences._shows_exptime,
    "order": Dependences._shows_order,
    "night hours": lambda of: bool(of._nights()),
}
"""Forms of a single factor of that name, and whether exposures show it."""


def varies(values: np.ndarray) -> bool:
    """True if all numbers are known and not the same."""
    return bool(np.isfinite(values).all() and np.ptp(values) > 1e-9 * max(1.0, float(np.abs(values).max())))
