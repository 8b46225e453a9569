"""Columns of the score test for sentences: derivatives taken once for every kind and place.

What depends on field or exposure by a factor is that derivative times the factor, the flux held; then the flux takes up
its part.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from walop_jax.diagnosis.effect_columns import Probe, effect_candidates, showable, swept
from walop_jax.diagnosis.freeform import numpy_sharing
from walop_jax.diagnosis.grammar import said_by
from walop_jax.diagnosis.score import Candidate
from walop_jax.likelihood import limits
from walop_jax.likelihood.flux import project_flux
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Context, Described
from walop_jax.model.effects.etalon import Etalon, with_air_gap
from walop_jax.model.effects.sentence import (
    DISPLACEMENTS,
    NUMBERS,
    OPPOSITE,
    POLARISATION,
    REFERENCE_TEMPERATURE,
    Sentence,
)
from walop_jax.model.instrument import Instrument
from walop_jax.model.specification import Model

INNER = ("colour", "counts")  # factors that are not known for point and exposure alone


def _core(sentence: Sentence) -> Sentence:
    """The sentence without what multiplies its derivative point by point and exposure by exposure."""
    if sentence.kind in POLARISATION:
        return sentence
    return dataclasses.replace(sentence, factors=tuple(f for f in sentence.factors if f in INNER))


def _outer(sentence: Sentence) -> Sentence:
    """The factors that `_core` leaves out; thermal changes are taken at one kelvin."""
    factors = tuple(f for f in sentence.factors if f not in _core(sentence).factors)
    return dataclasses.replace(
        sentence, factors=(*factors, "kelvin") if sentence.kind == "thermal" else factors
    )


def _batch(sentence: Sentence) -> str:
    """Sentences whose derivatives cost alike: of crystals, of crystals cut askew, ghosts, of everything else."""
    if sentence.origin == OPPOSITE:
        return OPPOSITE
    plates = sentence.kind in (*NUMBERS, *DISPLACEMENTS, "shift")
    return sentence.kind if sentence.kind in ("cut", "thermal") else str(plates)


class _Fringes(Etalon):
    """Fringes of the air ahead of one plate."""

    where: str = eqx.field(static=True, default="")

    def patch(self, instrument: Instrument) -> Instrument:
        """Put the air gap there."""
        return with_air_gap(instrument, self.where, self.contrast, self.gap)


def _fringes(
    likelihood: Likelihood, model: Model, values: Float[np.ndarray, " n"], every: Mapping[str, Sentence]
) -> dict[str, Float[np.ndarray, " d"]]:
    """Columns of fringes by their texts, swept over the gaps of a plate; without those that the bands blur away."""
    wanted = []
    for sentence in (s for s in every.values() if s.kind == "fringes"):
        effect = _Fringes.of(Context(), gap=sentence.gap, where=sentence.place)
        wanted.append(Probe(sentence.text, _Fringes, (effect,)))
    found = swept(likelihood.calset, model, values, wanted) if wanted else {}
    return {name: candidate.columns[:, 0] for name, candidate in found.items()}


@dataclasses.dataclass(frozen=True)
class _Laid:
    """Points along the first axis, exposures along the second."""

    likelihood: Likelihood

    def __getattr__(self, name: str) -> Any:
        points, e = self.likelihood.calset.points, self.likelihood.plan.exposures
        if name in ("x", "y"):
            return getattr(points, name)[:, None]
        if name == "number":
            return np.arange(len(e.hours))[None]
        return np.asarray(getattr(e, name))[None]

    def angle(self, prefix: str) -> Any:
        """Angle of a moving element, NaN where it is out."""
        position = self.likelihood.calset.exposures.position(prefix)
        return np.deg2rad(np.where(position.inside, position.angle, np.nan))[None]


def sentence_candidates(
    likelihood: Likelihood, model: Model, values: Float[np.ndarray, " n"], probes: Sequence[Probe]
) -> dict[str, Candidate]:
    """Columns of the groups at the fit `values` of a model, by name; without fringes that the bands blur away."""
    return said_candidates(probes, sentence_columns(likelihood, model, values, said_in(probes)))


def all_candidates(
    likelihood: Likelihood,
    model: Model,
    values: Float[np.ndarray, " n"],
    effects: Sequence[Probe],
    sentences: Sequence[Probe],
) -> tuple[dict[str, Candidate], dict[str, Candidate]]:
    """Columns of effects and of sentences by name; those of an effect that is a plain sum of sentences serve twice.

    Loading, compiling and computing them keep one core busy: of a small set a second one works beside it. (Of a large
    one a batch takes gigabytes.)
    """
    calset = likelihood.calset
    sums = {probe.name: _sums(probe, model.template) for probe in showable(calset, model.template, effects)}
    texts = [text for one in sums.values() for each in one for text in each]
    others = [probe for probe in effects if not sums.get(probe.name)]
    said = _parsed([*said_in(sentences), *texts])
    with ThreadPoolExecutor(1) as beside:
        fringes = beside.submit(_fringes, likelihood, model, values, said)
        direct = beside.submit(effect_candidates, calset, model, values, others)
        if likelihood.pairs > limits.SIDE_BY_SIDE:
            direct.result()
        columns = _without_fringes(likelihood, model, values, said) | fringes.result()
        named = direct.result()
    named |= {
        probe.name: Candidate(
            probe.name,
            np.column_stack([np.sum([columns[t] for t in each], axis=0) for each in sums[probe.name]]),
            probe.widths,
        )
        for probe in effects
        if sums.get(probe.name) and all(t in columns for each in sums[probe.name] for t in each)
    }
    ordered = {probe.name: named[probe.name] for probe in effects if probe.name in named}
    return ordered, said_candidates(sentences, columns)


def _sums(probe: Probe, instrument: Instrument) -> list[tuple[str, ...]]:
    """The sentences of each amplitude of a probe, member by member; none where they are no plain sums."""
    return [each for member in probe.group for each in member.sums(instrument)]


def said_in(probes: Sequence[Probe]) -> list[str]:
    """All sentences of some groups."""
    return [text for probe in probes for text in said_by(probe)]


def said_candidates(probes: Sequence[Probe], columns: Mapping[str, np.ndarray]) -> dict[str, Candidate]:
    """The groups all of whose sentences have columns."""
    return {
        p.name: Candidate(p.name, np.column_stack([columns[t] for t in said_by(p)]), p.widths)
        for p in probes
        if all(text in columns for text in said_by(p))
    }


def sentence_columns(
    likelihood: Likelihood, model: Model, values: Float[np.ndarray, " n"], texts: Sequence[str]
) -> dict[str, Float[np.ndarray, " d"]]:
    """Columns of sentences at the fit `values` of a model; without fringes that the bands blur away."""
    said = _parsed(texts)
    return _fringes(likelihood, model, values, said) | _without_fringes(likelihood, model, values, said)


def _parsed(texts: Iterable[str]) -> dict[str, Sentence]:
    return {text: Sentence.parsed(text) for text in texts}


def _without_fringes(
    likelihood: Likelihood, model: Model, values: Float[np.ndarray, " n"], every: Mapping[str, Sentence]
) -> dict[str, Float[np.ndarray, " d"]]:
    """Columns of all sentences that are not of fringes."""
    said = {text: sentence for text, sentence in every.items() if sentence.kind != "fringes"}
    batches: dict[str, dict[str, None]] = {}
    for sentence in said.values():
        batches.setdefault(_batch(sentence), {})[_core(sentence).text] = None
    change: dict[str, np.ndarray] = {}
    along = np.zeros(0)
    warm = np.full(len(likelihood.calset.exposures), REFERENCE_TEMPERATURE + 1.0)
    for batch, cores in batches.items():
        effect, calset = Described.of(Context(), sentences=tuple(cores)), likelihood.calset
        if batch == "thermal":
            calset = dataclasses.replace(calset, exposures=dataclasses.replace(calset.exposures, temp=warm))
        own = Likelihood.of(calset, model, (effect,))
        found, along = own.effect_changes(values, (effect,))
        order = [
            text for f in Described.amplitudes() for text in cores if Sentence.parsed(text).parameter == f
        ]
        change |= {text: found[:, i] for i, text in enumerate(order)}
    used, known = likelihood.used, likelihood.flux_known
    shared, at = numpy_sharing(likelihood), _Laid(likelihood)

    def column(sentence: Sentence) -> np.ndarray:
        pattern = np.nan_to_num(np.asarray(_outer(sentence).factor(at)))
        raw = change[_core(sentence).text] * np.broadcast_to(pattern, used.shape)[..., None]
        return -project_flux(raw, along, known, shared)[used].reshape(-1)

    return {text: column(sentence) for text, sentence in said.items()}
