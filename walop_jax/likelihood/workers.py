"""Work of many tasks in processes of this machine or of a cluster, by any `concurrent.futures.Executor`."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import os
import pickle
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Executor
from typing import Any, TypeVar

from walop_jax.io.code import files_of_users, run_file
from walop_jax.io.errors import fail
from walop_jax.model.compiled import switch_on

Given = TypeVar("Given")
Done = TypeVar("Done")


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

    A worker has one task at a time. Tasks of a worker that is lost go to another one. Raises `DataError` where
    `distributed` is not installed, and where no scheduler answers.
    """
    if workers is None and (scheduler is None or isinstance(scheduler, Executor)):
        yield scheduler
        return
    if importlib.util.find_spec("distributed") is None:
        raise fail("Dask is not installed", advice="pip install 'walop-jax[cluster]'")
    dask, config = map(importlib.import_module, ("distributed", "dask.config"))
    with contextlib.ExitStack() as hold:
        # Every task travels with its function, some hundred kilobytes with a model in it, of which Dask would warn. And
        # Dask makes workers return memory at once, to ask for it again: these thresholds malloc(3) reaches by itself.
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
