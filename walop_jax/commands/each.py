"""A command for each of many files, in this process or by the workers of an executor (`nights.making.executor_of`).

An output appears whole or not at all, and one that is there is not made again, so that an interrupted command goes on
when it is typed again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from walop_jax.commands.command import Job, Outcome, PathLike, UsageError, command_of, several
from walop_jax.io.errors import DataError


def for_each(
    job: Job,
    command: Callable[..., Any],
    files: Any,
    output: PathLike | None,
    arguments: Mapping[str, Any],
    workers: int | None = None,
    scheduler: str | Executor | None = None,
) -> Outcome[list[Path]]:
    """`command(catalogue=file, output=…, **arguments)` for each file, into a folder: the paths of all outputs.

    What fails for one file is a failure of the whole that names it, after all others are made.
    """
    from walop_jax.nights.making import executor_of, mapped

    files = several(files)
    if output is None:
        raise UsageError("a folder for the tables is wanted", "output")
    if not all(isinstance(file, str | os.PathLike) for file in files):
        raise UsageError("tables in memory are reduced one by one; give the paths of files", "each")
    places = [Path(output) / Path(file).name for file in files]
    if len({place.name for place in places}) < len(places):
        raise UsageError("two catalogues have the same name, and so would their tables", "each")
    if any(place.resolve() == Path(file).resolve() for place, file in zip(places, files, strict=True)):
        raise UsageError("the tables would replace the catalogues: give another folder", "output")
    Path(output).mkdir(parents=True, exist_ok=True)
    pairs = [p for p in zip(files, places, strict=True) if job.overwrite or not p[1].exists()]
    calls = [{**arguments, "catalogue": file, "output": place} for file, place in pairs]
    ended, warnings = [], []
    with executor_of(workers, scheduler) as executor:
        tasks = [(command.__name__, job.overwrite, call) for call in calls]
        for number, outcome in enumerate(mapped(_run, tasks, executor), start=1):
            job.tell(f"{number} of {len(calls)} catalogues")
            ended.append(outcome)
            warnings += outcome.warnings
    failed = [outcome.failure for outcome in ended if outcome.failure]
    if existing := len(files) - len(calls):
        what = f"{existing} of {len(files)} tables were there already"
        warnings.append(f"{what}, and are left; --overwrite makes them again")
    return Outcome(
        places,
        {
            "outputs": [str(place) for place in places],
            "made": len(ended) - len(failed),
            "left": existing,
            "failed": failed,
            "catalogues": [outcome.content for outcome in ended if not outcome.failure],
        },
        "\n".join(outcome.text for outcome in ended if outcome.text) or f"{output}: nothing was left to do",
        warnings=list(dict.fromkeys(warnings)),
        failure="; ".join(failed),
    )


def _run(task: tuple[str, bool, dict[str, Any]]) -> Outcome[None]:
    """The outcome of a command of this package by its name, in any process; without the value."""
    import walop_jax
    from walop_jax.model.compiled import float64

    name, overwrite, arguments = task
    command = command_of(getattr(walop_jax, name))
    try:
        with float64():
            outcome = command.run(Job(overwrite=overwrite), dict(arguments))
    except (DataError, UsageError) as error:
        return Outcome(None, {}, "", failure=str(error))
    said = {"warnings": outcome.warnings, "failure": outcome.failure}
    return Outcome(None, outcome.content, outcome.printed(), **said)
