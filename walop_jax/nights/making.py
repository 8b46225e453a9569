"""Nights made of data: linearised near their own minimum first, at a common solution later; here or on other machines.

A `Maker` needs nothing but its tasks, so that any `concurrent.futures.Executor` runs it: one of processes, or that of
a Dask cluster (`distributed.Client.get_executor`). Nights depend neither on the process nor on their order. The file
of a night appears in `folder`, whole or not at all; a night with a file is not made again.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.records import CalibrationSet
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.model_of_set import model_like
from walop_jax.io.errors import DataError, fail
from walop_jax.likelihood.workers import mapped
from walop_jax.model.effects.in_models import known_effects
from walop_jax.model.specification import Model
from walop_jax.nights.equations import (
    CandidateTable,
    candidates_of,
    model_hash,
    night_equations,
    with_candidates_of,
)
from walop_jax.nights.night_file import read_nights, write_nights
from walop_jax.nights.together import Night, source_of
from walop_jax.posterior.run import Run

SKETCH = 512  # measurements by which sets are compared
COPIED = 0.02  # their fraction that no two sets have in common by chance


class Data(NamedTuple):
    """Data of which nights can be made at any values of the parameters.

    `source` is a set, the path of one or a RUN; `sha256` its hash; `model` None stands for the model of `like`.
    """

    source: CalibrationSet | Path | Run
    sha256: str
    model: Model | None = None

    def read(self) -> CalibrationSet:
        """The calibration set, read if it is a file."""
        if isinstance(self.source, CalibrationSet):
            return self.source
        return self.source.calset if isinstance(self.source, Run) else read_calibration_set(self.source)


class Task(NamedTuple):
    """Nights to be made of `data`, each near its own minimum; or one `night` made again, at `values`."""

    data: Data
    night: Night | None = None
    values: Mapping[str, float] = {}
    candidates: frozenset[str] = frozenset()
    """Candidates of `night` that are linearised at `values` as well."""


class Made(NamedTuple):
    """The nights of a task, with the source and a sketch of their measurements (empty: not computed)."""

    nights: list[Night]
    source: str = ""
    sketch: frozenset[int] = frozenset()
    error: DataError | None = None
    """Why there are no nights of data that have been read: copies of other data first."""


@dataclasses.dataclass
class Maker:
    """Makes nights of data, with the model and about the values of `like`."""

    like: Calibration | None
    folder: Path | None
    count: int = 1
    """Number of sets: programs for many are optimised."""
    _candidates: dict[tuple[str, ...], CandidateTable] = dataclasses.field(default_factory=dict)
    _sets: dict[str, tuple[CalibrationSet, Model]] = dataclasses.field(default_factory=dict)

    def make(self, task: Task) -> Made:
        """The nights of a task. Raises `DataError` as `read_calibration_set` and `night_equations` do."""
        return self._first(task.data) if task.night is None else self._again(task.night, task)

    def _first(self, data: Data) -> Made:
        if self.like is None:
            what = "is a set, and there are no values at which to linearise it"
            advice = "give --like RUN, a fit of the same model (like= in Python)"
            raise fail(f"{source_of(data.read())} {what}", advice=advice)
        place = None
        if self.folder is not None:
            named = f"{data.sha256} {model_hash(data.model or self.like.model)}"
            place = self.folder / f"night-{hashlib.sha256(named.encode()).hexdigest()[:16]}.fits"
            if place.exists():
                return Made(read_nights(place))
        calset, model = self._set_and_model(data)
        values = dict(zip(self.like.model.names, self.like.values.tolist(), strict=True))
        candidates = self._candidates_of(model, calset)
        table = calset.intensities
        measured = sketch(calset, table) if isinstance(table, TableIntensities) else frozenset[int]()
        try:
            nights = night_equations(calset, model, values, candidates, own=True, sets=self.count)
        except DataError as error:
            return Made([], source_of(calset), measured, error)
        if place is not None:
            place.parent.mkdir(parents=True, exist_ok=True)
            write_nights(place, nights, overwrite=True)
        return Made(nights, source_of(calset), measured)

    def _again(self, night: Night, task: Task) -> Made:
        """The night linearised at other values, with some candidates; the others follow (`with_candidates_of`)."""
        calset, model = self._set_and_model(task.data)
        candidates = {}
        if task.candidates:
            every = self._candidates_of(model, calset)
            candidates = {name: every[name] for name in every if name in task.candidates}
        cut = len(night.names) - night.candidates
        held = zip(night.names[cut:], night.reference[cut:].tolist(), strict=True)
        # A gauge stays where its column was made.
        values = dict(task.values) | {name: value for name, value in held if name not in candidates}
        (anew,) = night_equations(calset, model, values, candidates, number=night.number, sets=self.count)
        return Made([with_candidates_of(anew, night)])

    def _set_and_model(self, data: Data) -> tuple[CalibrationSet, Model]:
        assert self.like is not None
        if (cached := self._sets.get(data.sha256)) is not None:
            return cached
        calset = data.read()
        read = calset, data.model or model_like(calset, self.like.model)
        if isinstance(calset.intensities, TableIntensities):
            self._sets[data.sha256] = read
        return read

    def _candidates_of(self, model: Model, calset: CalibrationSet) -> CandidateTable:
        # They depend on cameras, standards and the effects of the model alone: listing them takes a while.
        key = (*model.names, *model.effect_names)
        if key not in self._candidates:
            self._candidates[key] = candidates_of(model, calset.exposures, known_effects(model))
        return self._candidates[key]


def made(maker: Maker, executor: Executor | None, tasks: Sequence[Task]) -> Iterator[list[Night]]:
    """The nights of each task, in their order, made here or by an executor.

    Raises `DataError` as `Maker.make` does, and for measurements that are in the data of an earlier task as well.
    """
    seen: dict[int, str] = {}
    for result in mapped(maker.make, tasks, executor):
        shared = Counter(seen[number] for number in result.sketch if number in seen)
        if shared and (closest := shared.most_common(1)[0])[1] > COPIED * len(result.sketch):
            what = f"{100 * closest[1] / len(result.sketch):.0f} % of its measurements are in {closest[0]} as well"
            raise fail(
                what, file=result.source, advice="leave one out: repeated data would shrink the errors"
            )
        seen |= dict.fromkeys(result.sketch, result.source)
        if result.error is not None:
            raise result.error
        yield result.nights


def sketch(calset: CalibrationSet, table: TableIntensities) -> frozenset[int]:
    """Sketch of the measurements of a set, whatever their times: the same ones have the same hashes (MinHash).

    The smallest of the hashes of (X, Y, counts); the fraction that two sketches have in common is that of the sets
    (Broder 1997).
    """
    rows = table.used & ~calset.exposures.flux_known[table.exposure]
    point = table.point[rows]
    places = np.column_stack([calset.points.x[point], calset.points.y[point], table.counts[rows]])
    hashes = np.zeros(len(places), np.uint64)
    for bits in np.ascontiguousarray(places).view(np.uint64).T:
        hashes = (hashes ^ bits) * np.uint64(0x9E3779B97F4A7C15)
        hashes ^= hashes >> np.uint64(29)
    return frozenset(np.unique(hashes)[:SKETCH].tolist())
