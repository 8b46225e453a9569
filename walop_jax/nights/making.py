"""Nights made of data: linearised near their own minimum first, at a common solution later; here or on other machines.

A `Maker` needs nothing but its tasks, so that any `concurrent.futures.Executor` runs it: one of processes, or that of
a Dask cluster (`distributed.Client.get_executor`). Nights depend neither on the process nor on their order. The file
of a night appears in `folder`, whole or not at all; a night with a file is not made again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import importlib.util
import os
import pickle
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.records import CalibrationSet
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.base_model import model_like
from walop_jax.io.code import files_of_users, run_file
from walop_jax.io.errors import DataError, fail
from walop_jax.model.compiled import switch_on
from walop_jax.model.specification import Model
from walop_jax.nights.equations import (
    Candidates,
    Night,
    candidates_of,
    model_hash,
    night_equations,
    source_of,
    with_candidates_of,
)
from walop_jax.nights.night_file import read_nights, write_nights
from walop_jax.posterior.run import Run

Given = TypeVar("Given")
Done = TypeVar("Done")

SKETCH = 512  # measurements by which sets are compared
COPIED = 0.02  # their share that no two sets have in common by chance


class Data(NamedTuple):
    """Data that nights can be made of at any values: a set, its file or a RUN; hash; model (None: that of `like`)."""

    source: CalibrationSet | Path | Run
    sha256: str
    model: Model | None = None

    def read(self) -> CalibrationSet:
        """The set."""
        if isinstance(self.source, CalibrationSet):
            return self.source
        return self.source.calset if isinstance(self.source, Run) else read_calibration_set(self.source)


class Task(NamedTuple):
    """Nights to be made of `data`: those near their own minimum, or `night` once more, at `values`."""

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
    _candidates: dict[tuple[str, ...], Candidates] = dataclasses.field(default_factory=dict)
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

    def _candidates_of(self, model: Model, calset: CalibrationSet) -> Candidates:
        # They depend on cameras, standards and the effects of the model alone: listing them takes a while.
        key = (*model.names, *model.effect_names)
        if key not in self._candidates:
            self._candidates[key] = candidates_of(model, calset.exposures, model.catalogue)
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


def mapped(
    function: Callable[[Given], Done], tasks: Sequence[Given], executor: Executor | None
) -> Iterable[Done]:
    """`function` of every task in their order, here or by an executor, in whose processes files of users are run."""
    if executor is None:
        return map(function, tasks)
    if not tasks:
        return ()
    common = (os.getpid(), files_of_users()), pickle.dumps(function)
    return executor.map(_there, [common] * len(tasks), list(map(pickle.dumps, tasks)))


def _there(common: tuple[tuple[int, tuple[str, ...]], bytes], task: bytes) -> Any:
    start, function = common
    _prepare(*start)
    return _loaded(function)(pickle.loads(task))


@functools.lru_cache(maxsize=1)
def _loaded(function: bytes) -> Callable[[Any], Any]:
    """A function in a worker process, with what its object has read and listed there."""
    return pickle.loads(function)


@functools.lru_cache(maxsize=1)
def _prepare(parent: int, code: tuple[str, ...]) -> None:
    """Set a process up: as a command does, unless it is the session that asks, and with the code of users."""
    if os.getpid() != parent:
        switch_on()
    for path in code:
        run_file(path, "start the workers where this file can be read")


@contextlib.contextmanager
def executor_of(
    workers: int | None = None, scheduler: str | Executor | None = None
) -> Generator[Executor | None, None, None]:
    """Executor of the workers of a Dask scheduler (or as given), or of new processes of this machine; None without.

    A worker makes one night at a time. Tasks of a worker that is lost go to another one. Raises `DataError` where
    `distributed` is not installed, and where no scheduler answers.
    """
    if workers is None and (scheduler is None or isinstance(scheduler, Executor)):
        yield scheduler
        return
    if importlib.util.find_spec("distributed") is None:
        raise fail("Dask is not installed", advice="pip install 'walop-jax[cluster]'")
    dask, config = map(importlib.import_module, ("distributed", "dask.config"))
    with contextlib.ExitStack() as hold:
        # Every night travels with the model, some hundred kilobytes, of which Dask would warn. And Dask makes workers
        # return memory at once, to ask for it again: these thresholds malloc(3) reaches by itself.
        of_worker = "distributed.nanny.pre-spawn-environ.MALLOC_{}_THRESHOLD_"
        settings = {of_worker.format("TRIM"): 1 << 26, of_worker.format("MMAP"): 1 << 25}
        hold.enter_context(config.set({"distributed.admin.large-graph-warning-threshold": "1GB"} | settings))
        if scheduler is None:
            options = {"n_workers": workers, "threads_per_worker": 1, "dashboard_address": None}
            address = hold.enter_context(dask.LocalCluster(**options))
        else:
            address = scheduler
        try:
            client = hold.enter_context(dask.Client(address, timeout="20s"))
        except OSError as error:
            what = f"no Dask scheduler answers at {scheduler}: {error}"
            raise fail(what, advice="start dask scheduler") from None
        yield hold.enter_context(client.get_executor(pure=False, retries=3))


def sketch(calset: CalibrationSet, table: TableIntensities) -> frozenset[int]:
    """Sketch of the measurements of a set, whatever their times: the same ones have the same hashes (MinHash).

    The smallest of the hashes of (X, Y, counts); the share that two sketches have in common is that of the sets
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
