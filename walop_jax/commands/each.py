"""A command for each of many files, in this process or by the workers of an executor (`nights.making.executor_of`).

An output appears whole or not at all, and one that is there is not made again, so that an interrupted command goes on
when it is typed again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple

from walop_jax.commands.command import Job, Option, Outcome, PathLike, UsageError, command_of
from walop_jax.io.errors import DataError

EACH = Option("Each CATALOGUE by itself: OUT is a folder of tables with their names.")
WORKERS = Option("With --each: in so many processes of this machine, by Dask.", "N", int, least=1)
SCHEDULER = Option("With --each: on the workers of a Dask cluster that share the files.", "ADDRESS", str)


class Ended(NamedTuple):
    """The end of one of the commands: its document, warnings, text, and why there is no output."""

    document: Any = None
    text: str = ""
    warnings: Sequence[str] = ()
    error: str = ""


def for_each(
    job: Job,
    command: Callable[..., Any],
    files: Sequence[PathLike],
    output: PathLike | None,
    arguments: Mapping[str, Any],
    workers: int | None = None,
    scheduler: str | Executor | None = None,
) -> Outcome[list[Path]]:
    """`command(catalogue=file, output=…, **arguments)` for each file, into a folder: the paths of all outputs.

    What fails for one file is a failure of the whole that names it, after all others are made.
    """
    from walop_jax.nights.making import executor_of, mapped

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
    calls = [
        {**arguments, "catalogue": file, "output": place}
        for file, place in zip(files, places, strict=True)
        if job.overwrite or not place.exists()
    ]
    ended = []
    with executor_of(workers, scheduler) as executor:
        tasks = [(command.__name__, job.overwrite, end) for end in calls]
        for number, end in enumerate(mapped(_run, tasks, executor), start=1):
            job.tell(f"{number} of {len(calls)} catalogues")
            ended.append(end)
    failed = [end.error for end in ended if end.error]
    existing = len(files) - len(calls)
    remark = (
        f"{existing} of {len(files)} tables were there already, and are left; --overwrite makes them again"
    )
    return Outcome(
        places,
        {
            "outputs": [str(place) for place in places],
            "made": len(ended) - len(failed),
            "left": existing,
            "failed": failed,
            "catalogues": [end.document for end in ended if not end.error],
        },
        "\n".join(end.text for end in ended if end.text) or f"{output}: nothing was left to do",
        warnings=list(
            dict.fromkeys([*(w for end in ended for w in end.warnings), *([remark] if existing else [])])
        ),
        failure="; ".join(failed),
    )


def _run(task: tuple[str, bool, dict[str, Any]]) -> Ended:
    """A command of this package by its name, in any process."""
    import walop_jax
    from walop_jax.model.compiled import float64

    name, overwrite, arguments = task
    command = command_of(getattr(walop_jax, name))
    try:
        with float64():
            outcome = command.run(Job(overwrite=overwrite), dict(arguments))
    except (DataError, UsageError) as error:
        return Ended(error=str(error))
    return Ended(outcome.content, outcome.printed(), tuple(outcome.warnings), outcome.failure)
