"""What each named effect would do to the residuals: the columns of the score test, from the catalogue itself.

Effects that need the same kind of computation are differentiated together; those with many shapes (the gap of an
etalon, the place of a blemish) are swept over their shapes in one compiled loop. Structural effects have no
amplitude: they cannot be differentiated, only tried (`naming.py`).
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis.score import Candidate
from walop_jax.likelihood import limits
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model import light
from walop_jax.model.dependence import changed_elements, conditions_asked_by
from walop_jax.model.effects import Context, Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import field_declarations
from walop_jax.model.ray import CONDITIONS
from walop_jax.model.specification import Model

LEAST_SURVIVING = 1e-3  # a contrast of 1 % that the band reduces by this factor is 0.001 %: of no consequence
DEFAULT_WIDTH = 1.0
FEWEST_POINTS = 9  # in which a pattern over the field is looked for, or what refers to their median

Vector = Float[np.ndarray, " _"]


@dataclasses.dataclass(frozen=True)
class Probe:
    """One group of probes of an effect: the place in its shape space from which a linear step is taken."""

    name: str
    effect: type[Effect]
    group: tuple[Effect, ...]

    def _fields(self) -> Iterator[str]:
        """The parameter that each amplitude belongs to, member by member."""
        for member in self.group:
            for name in self.effect.amplitudes():
                yield from [name] * np.size(getattr(member, name))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters that the amplitudes belong to, one for each."""
        return tuple(self._fields())

    @property
    def widths(self) -> Vector:
        """Prior widths of the amplitudes, member by member."""
        declared = field_declarations(self.effect)
        return np.array([declared[name].width or DEFAULT_WIDTH for name in self._fields()])

    @property
    def one_sided(self) -> Bool[np.ndarray, " _"]:
        """Which amplitudes physics keeps above neutral, member by member."""
        return np.array([name in self.effect.one_sided for name in self._fields()], bool)


def applicable(
    catalogue: Sequence[type[Effect]], context: Context, instrument: Instrument
) -> tuple[type[Effect], ...]:
    """The effects of a catalogue that have what they act on in an instrument."""
    return tuple(kind for kind in catalogue if kind.neutral(context).fits(instrument))


def probes(catalogue: Sequence[type[Effect]], context: Context) -> Iterator[Probe]:
    """Every group of probes of every effect that has an amplitude in this context."""
    for effect in catalogue:
        if effect.is_structural():
            continue
        groups = effect.probes(context)
        for number, group in enumerate(groups):
            probe = Probe(effect.name if len(groups) == 1 else f"{effect.name}#{number}", effect, group)
            if len(probe.widths):
                yield probe


def _kind_of_computation(instrument: Instrument, effect: Effect) -> tuple[object, ...]:
    """What makes a computation costly: derivatives of the optics, optics for every exposure, many nodes, ghosts.

    It only sorts effects into batches, so it asks the elements that the effect changes, not the whole path.
    """
    bare = dataclasses.replace(instrument, effects=())
    patched, changed = effect.patch(bare), changed_elements(bare, effect)
    asked = frozenset(name for element in changed for name in conditions_asked_by(element))
    longest = max((element.path_difference for element in changed), default=0.0)
    optics = bool(changed) or patched.filter_shift is not bare.filter_shift
    return optics, asked, longest, bool(patched.cameras.ghosts)


def _can_show(calset: CalibrationSet, instrument: Instrument, effect: Effect) -> bool:
    """Whether a set has what an effect acts on: several field points, or the conditions that its elements ask for."""
    if effect.over_field and len(calset.points) < FEWEST_POINTS:
        return False
    bare = dataclasses.replace(instrument, effects=())
    changed = changed_elements(bare, effect)
    asked = frozenset(name for element in changed for name in conditions_asked_by(element))
    stated = {name: getattr(calset.exposures, column.lower()) for name, column in CONDITIONS.items()}
    return all(np.isfinite(stated[name]).any() for name in asked if name in stated)


def showable(calset: CalibrationSet, instrument: Instrument, wanted: Sequence[Probe]) -> list[Probe]:
    """The probes of effects that a set can show; shapes of one effect need the same."""
    shown: dict[type[Effect], bool] = {}
    for probe in wanted:
        if probe.effect not in shown:
            shown[probe.effect] = _can_show(calset, instrument, probe.group[0])
    return [probe for probe in wanted if shown[probe.effect]]


def effect_candidates(
    calset: CalibrationSet, model: Model, values: Vector, wanted: Sequence[Probe]
) -> dict[str, Candidate]:
    """Columns of all probes at the fit `values` of `model`, by probe name; without those that the bands blur away."""
    wanted = showable(calset, model.template, wanted)
    number = Counter(p.effect for p in wanted)
    several = {effect for effect, count in number.items() if count > limits.MANY_SHAPES}
    result: dict[str, Candidate] = {}
    kinds: dict[type[Effect], tuple[object, ...]] = {}
    together: dict[tuple[object, ...], list[Probe]] = {}
    for probe in wanted:
        if probe.effect not in several:
            if probe.effect not in kinds:
                kinds[probe.effect] = _kind_of_computation(model.template, probe.group[0])
            together.setdefault(kinds[probe.effect], []).append(probe)
    for batch in together.values():
        members = tuple(member for probe in batch for member in probe.group)
        columns = Likelihood.of(calset, model, members).effect_columns(values, members)
        start = 0
        for probe in batch:
            stop = start + len(probe.widths)
            result[probe.name] = Candidate(probe.name, columns[:, start:stop], probe.widths)
            start = stop
    for effect in several:
        mine = [probe for probe in wanted if probe.effect is effect]
        result |= swept(calset, model, values, mine)
    return {probe.name: result[probe.name] for probe in wanted if probe.name in result}


def swept(
    calset: CalibrationSet, model: Model, values: Vector, mine: Sequence[Probe]
) -> dict[str, Candidate]:
    """Columns of one effect at many shapes: one compiled sweep for each of its discrete choices."""
    likelihood = Likelihood.of(calset, model, (mine[0].group[0],))
    instrument = model.instrument(values)
    nodes = np.asarray(light.node_wavelengths(instrument, likelihood.plan))
    weight = np.asarray(light.band_weights(instrument, likelihood.plan))
    mine = [probe for probe in mine if probe.group[0].survives(nodes, weight) > LEAST_SURVIVING]
    members = [(i, j) for i, probe in enumerate(mine) for j in range(len(probe.group))]
    by_choice: dict[tuple[tuple[str, object], ...], list[tuple[int, int]]] = {}
    for i, j in members:
        by_choice.setdefault(tuple(sorted(mine[i].group[j].choices().items())), []).append((i, j))
    found: dict[tuple[int, int], np.ndarray] = {}
    for group in by_choice.values():
        columns = likelihood.effect_columns_over_shapes(values, [mine[i].group[j] for i, j in group])
        found |= dict(zip(group, columns, strict=True))
    return {
        probe.name: Candidate(
            probe.name, np.column_stack([found[i, j] for j in range(len(probe.group))]), probe.widths
        )
        for i, probe in enumerate(mine)
    }
