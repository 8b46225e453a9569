"""Possibly missing effects, group by group, and the derivatives of the residuals with respect to each.

The columns of the score test come from the responses of the light path (`likelihood.columns`), but those of
user-defined effects by direct differentiation. Structural effects have no amplitude and are fitted instead
(`exact.try_effect`). Effects without a name are those of `grammar`.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis.score import Candidate, Score
from walop_jax.io.shapes import AnyVector
from walop_jax.io.text import rounded
from walop_jax.likelihood.columns import Columns, SumOfChanges, own_columns
from walop_jax.model import legendre
from walop_jax.model.dependence import conditions_of_effect
from walop_jax.model.effects import Context, Described, Effect, EffectKind
from walop_jax.model.effects.catalogue import applies
from walop_jax.model.effects.change import Change
from walop_jax.model.effects.factors import FINEST_DEGREE, SMOOTH_DEGREE
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import leaves
from walop_jax.model.ray import CONDITIONS

FEWEST_POINTS = 9  # in which a pattern over the field is looked for, or what refers to their median


@dataclasses.dataclass(frozen=True)
class Probe:
    """One group of probes of an effect: the place in its shape space from which a linear step is taken.

    `context` are the data that its prior widths are for, `holders` effects of which a group of descriptions is a part.
    The effect `etalon` has a probe for each gap of air that is tried; its group holds two members, a quarter of a
    fringe apart, whose amplitudes are those of a cosine and a sine.
    """

    name: str
    effect: EffectKind
    group: tuple[Effect, ...]
    context: Context = dataclasses.field(default_factory=Context)
    holders: frozenset[EffectKind] = frozenset()

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters that the amplitudes belong to, one for each, member by member."""
        pairs = itertools.product(self.group, self.effect.amplitudes())
        return tuple(name for member, name in pairs for _ in range(np.size(getattr(member, name))))

    @functools.cached_property
    def widths(self) -> AnyVector:
        """Prior widths of the amplitudes, member by member."""
        return np.array([w for member in self.group for w in member.prior_widths(self.context).values()])

    @property
    def one_sided(self) -> Bool[np.ndarray, " _"]:
        """True for amplitudes that physics keeps above neutral, member by member."""
        return np.array([name in self.effect.one_sided for name in self.parameters], bool)


@dataclasses.dataclass(frozen=True)
class Ranked:
    """An effect or a description with its best probe, and its evidence; `others` are shapes that may be as good.

    `scale` is the factor on the prior widths of its amplitudes with which it is fitted: 1, but for smooth fields.
    """

    probe: Probe
    score: Score
    log_bayes: float
    others: tuple[tuple[Probe, Score], ...] = ()
    scale: float = 1.0

    @property
    def effect(self) -> EffectKind:
        """The effect of its probe."""
        return self.probe.effect

    @property
    def name(self) -> str:
        """Its name; without one, its descriptions."""
        return self.probe.name if self.effect is Described else self.effect.name


class SmoothField(NamedTuple):
    """Changes at a place, under a law, that vary over the field in any smooth way: one candidate with many amplitudes.

    Each of the `changes` has no pattern over the field; in the candidate it is multiplied by every term of a smooth
    field (factors `field I J`). Example: "retardance q behind collimator * smooth * hours; retardance u behind …".
    `pattern_first` says whether its pattern stands ahead of the law in a text.
    """

    changes: tuple[Change, ...]
    pattern_first: bool

    @property
    def name(self) -> str:
        """The names of its changes, with `smooth` as the pattern over the field."""
        return "; ".join(dict.fromkeys(self._with(change, "field 0 0").candidate for change in self.changes))

    @property
    def terms(self) -> Sequence[tuple[int, int]]:
        """Degrees along X and Y of its terms: fewer of optics, of which a field of all nine kinds is one candidate."""
        return legendre.terms(FINEST_DEGREE if self.changes[0].of_camera else SMOOTH_DEGREE)

    @property
    def even(self) -> str:
        """The name of the description that has no pattern over the field."""
        return "; ".join(change.text for change in self.changes)

    @property
    def gradient(self) -> str:
        """The name of the description that has a gradient over the field in the place of the smooth field."""
        return "; ".join(self._with(change, along).text for change in self.changes for along in ("x", "y"))

    def _with(self, change: Change, pattern: str) -> Change:
        factors = (pattern, *change.factors) if self.pattern_first else (*change.factors, pattern)
        return dataclasses.replace(change, factors=factors)

    def probe(self, context: Context) -> Probe:
        """The candidate, its amplitudes change by change, and term by term of each."""
        patterns = [f"field {i} {j}" for i, j in self.terms]
        texts = tuple(self._with(change, pattern).text for change in self.changes for pattern in patterns)
        return Probe(self.name, Described, (Described.of(context, sentences=texts),), context)


class Hypotheses(NamedTuple):
    """All possible omissions of a model: probes of effects with a name, and descriptions.

    `descriptions` are those that no effect holds, `parts` those that are part of effects. `effects` are those that
    fit the instrument, `every` all descriptions, those that are an effect by another name as well. `smooth` are changes
    that may vary over the field in any smooth way, which no list of simple patterns holds.
    """

    names: Sequence[Probe] = ()
    descriptions: Sequence[Probe] = ()
    parts: Sequence[Probe] = ()
    effects: tuple[EffectKind, ...] = ()
    every: Sequence[Probe] = ()
    smooth: Sequence[SmoothField] = ()

    def beside(self, effects: Collection[str]) -> tuple[Probe, ...]:
        """All candidates beside the effects that a model has."""
        absent = (probe for probe in self.names if probe.effect.name not in effects)
        return (*absent, *self.descriptions, *self.parts)

    @property
    def amplitudes(self) -> int:
        """Number of all amplitudes."""
        return sum(len(probe.widths) for probe in (*self.names, *self.every))


def applicable(
    catalogue: Sequence[EffectKind], context: Context, instrument: Instrument
) -> tuple[EffectKind, ...]:
    """The effects of a catalogue that apply to an instrument; ValueError as `applies`."""
    return tuple(kind for kind in catalogue if applies(kind.neutral(context), instrument))


def probes(catalogue: Sequence[EffectKind], context: Context) -> Iterator[Probe]:
    """Every group of probes of every effect that has an amplitude in this context."""
    for effect in catalogue:
        if effect.is_structural():
            continue
        groups = effect.probes(context)
        for name, group in zip(_names(effect, groups, context), groups, strict=True):
            probe = Probe(name, effect, group, context)
            if len(probe.widths):
                yield probe


def _names(effect: EffectKind, groups: Sequence[Sequence[Effect]], context: Context) -> list[str]:
    """Names of the groups of probes of an effect: its own and, of several groups, what distinguishes one from another.

    For example `blemish (camera E2, x −0.25 deg, y 0.05 deg)`, with the numbers of the first probe of a group.
    """
    if len(groups) == 1:
        return [effect.name]
    stated = [_shape_of(group[0], effect, context) for group in groups]
    differing = [key for key in stated[0] if len({shape.get(key) for shape in stated}) > 1]
    names = [f"{effect.name} ({', '.join(f'{key} {shape[key]}' for key in differing)})" for shape in stated]
    twice = {name for name in names if names.count(name) > 1}
    return [f"{name}, number {n}" if name in twice else name for n, name in enumerate(names)]


def _shape_of(probe: Effect, effect: EffectKind, context: Context) -> dict[str, str]:
    """Choices of a probe and the numbers of its shape, with their units, as texts by name."""
    cameras = dict(enumerate(context.cameras))
    texts = {
        name: str(cameras.get(chosen, chosen) if name == "camera" else chosen)
        for name, chosen in probe.choices().items()
    }
    units = {leaf.name: leaf.unit for leaf in leaves(probe)}
    for name in effect.shape:
        if np.ndim(value := getattr(probe, name)) == 0:
            texts[name] = f"{rounded(float(value))} {units.get(name, '')}".strip()
    return texts


def showable(calset: CalibrationSet, instrument: Instrument, wanted: Sequence[Probe]) -> list[Probe]:
    """The probes of effects that a set is sensitive to: enough field points, and the conditions of their elements.

    All shapes of one effect have the same requirements.
    """
    few = len(calset.points) < FEWEST_POINTS
    columns = {name: getattr(calset.exposures, column.lower()) for name, column in CONDITIONS.items()}
    unstated = {name for name, values in columns.items() if not np.isfinite(values).any()}
    bare = dataclasses.replace(instrument, effects=())
    first = {probe.effect: probe.group[0] for probe in reversed(wanted)}
    hidden = {
        kind
        for kind, effect in first.items()
        if (few and kind.over_field) or (unstated and unstated & conditions_of_effect(bare, effect))
    }
    return [probe for probe in wanted if probe.effect not in hidden]


def all_candidates(columns: Columns, wanted: Sequence[Probe]) -> dict[str, Candidate]:
    """Columns of effects and, in single precision, of descriptions, by name.

    Without effects that the set cannot show, and without fringes that the bands blur away.
    """
    return next(candidates_by_points(columns, wanted, max(1, len(columns.likelihood.used))))


def candidates_by_points(
    columns: Columns, wanted: Sequence[Probe], points: int
) -> Iterator[dict[str, Candidate]]:
    """The same, for so many points at a time: whole blocks of `limits.RESPONSES_TOGETHER`."""
    likelihood, template = columns.likelihood, columns.likelihood.model.template.as_put_together()
    effects = showable(likelihood.calset, template, [p for p in wanted if p.effect is not Described])
    shown = [*effects, *(p for p in wanted if p.effect is Described)]
    linear: dict[str, list[SumOfChanges]] = {}
    for probe in shown:
        members = [member.first_order(template) for member in probe.group]
        if all(terms and all(map(columns.has, terms)) for terms in members):
            linear[probe.name] = list(itertools.chain(*members))
    # Fringes need more wavelength nodes than all other descriptions.
    gaps = {
        name: [
            description.gap for change in sums for _, description in change if description.kind == "fringes"
        ]
        for name, sums in linear.items()
    }
    survives = columns.survives(list(itertools.chain(*gaps.values())))
    shown = [probe for probe in shown if all(survives[gap] for gap in gaps.get(probe.name, ()))]
    linear = {probe.name: linear[probe.name] for probe in shown if probe.name in linear}
    exact = sum(len(linear.get(probe.name, ())) for probe in effects)
    own = {p.name: own_columns(likelihood, columns.values, p.group) for p in shown if p.name not in linear}
    first = 0
    for blocks in columns.in_pieces(list(itertools.chain(*linear.values())), exact, points):
        used, candidates, rows = [0, 0], {}, slice(first, first + len(blocks[0]))
        for probe in shown:
            if probe.name in linear:
                single = int(probe.effect is Described)
                begin, used[single] = used[single], used[single] + len(linear[probe.name])
                block = blocks[single][:, begin : used[single]]
            else:
                block = own[probe.name][rows]
            candidates[probe.name] = Candidate(probe.name, block, probe.widths)
        first += len(blocks[0])
        yield candidates


def texts_of(probe: Probe) -> tuple[str, ...]:
    """The descriptions of a group."""
    return tuple(text for member in probe.group for text in member.sentences)  # type: ignore[attr-defined]
