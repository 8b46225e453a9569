"""What the commands share: options, the one line that an error is, output to terminals, switching on JAX."""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from walop_jax.cli import INTERRUPTED
from walop_jax.io.text import json_text

if TYPE_CHECKING:
    from walop_jax.likelihood.processes import Processes

CACHE_VARIABLE = "WALOP_JAX_CACHE"
DEBUG_VARIABLE = "WALOP_JAX_DEBUG"
LINE_EVERY = 10.0  # s, of progress that is no terminal's

CalsetFiles = Annotated[
    list[Path], typer.Argument(metavar="CALSET...", help="Calibration sets (FITS), fitted as one.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Machine-readable result to stdout, nothing else.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but warnings and errors.")]
OutputSet = Annotated[
    Path, typer.Option("--output", "-o", metavar="SET.fits", help="Calibration set to write (FITS).")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace outputs that exist.")]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Seed of random numbers (default: 0).")]
ModelOption = Annotated[
    Path | None,
    typer.Option("--model", metavar="MODEL.toml", help="Model file: what is free, tied, known, added."),
]
InstrumentOption = Annotated[
    str | None,
    typer.Option(
        "--instrument",
        metavar="NAME|FILE.toml",
        help="An instrument that comes with the package, or a description file; see walop-jax instrument.",
    ),
]
EffectsOption = Annotated[
    Path | None,
    typer.Option(
        "--effects",
        metavar="FILE.py",
        help="Effects of your own beside those of the catalogue; see walop-jax docs adding-an-effect.",
    ),
]
ProcessesOption = Annotated[
    str | None,
    typer.Option(
        "--processes",
        metavar="INDEX/COUNT@HOST:PORT",
        help="Share a large set with other processes that run the same command; auto: as Slurm or Open MPI say.",
    ),
]
MemoryOption = Annotated[
    float, typer.Option("--memory", metavar="GB", min=0.1, help="Memory for the data, in GB.")
]

RunFolder = Annotated[Path, typer.Option("--output", "-o", metavar="RUN", help="Folder of the results.")]
Product = Annotated[
    Path, typer.Argument(metavar="RUN/calibration.fits", help="Calibration product, or the folder of a run.")
]
PosteriorOption = Annotated[
    Path | None,
    typer.Option(
        "--posterior", metavar="posterior.nc", help="Use draws of walop-jax sample, not the covariance."
    ),
]
OutputTable = Annotated[
    Path, typer.Option("--output", "-o", metavar="OUT", help="Table to write (.fits, .csv, .ecsv).")
]


_UNUSED_SEED = Annotated[int | None, typer.Option("--seed", hidden=True)]


def accepting_seed(command: Callable[..., None]) -> Callable[..., None]:
    """The command with `--seed`, which every command takes: not shown, and without effect, where nothing is random."""
    signature = inspect.signature(command, eval_str=True)
    if "seed" in signature.parameters:
        return command

    @functools.wraps(command)
    def run(*args: Any, seed: int | None = None, **kwargs: Any) -> None:
        del seed
        command(*args, **kwargs)

    seed = inspect.Parameter("seed", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=_UNUSED_SEED)
    run.__signature__ = signature.replace(parameters=[*signature.parameters.values(), seed])  # type: ignore[attr-defined]
    run.__annotations__ = {name: p.annotation for name, p in run.__signature__.parameters.items()}  # type: ignore[attr-defined]
    return run


UNTRUSTED = 3
"""Exit code of a command that has written a result which is not to be trusted."""


class CommandError(Exception):
    """A command failed for a reason that its one line of message states."""


def guarded(command: Callable[..., None]) -> Callable[..., None]:
    """The command with every error turned into one line on stderr and exit code 1.

    With the environment variable WALOP_JAX_DEBUG set, errors keep their traceback.
    """

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
            sys.stdout.flush()
        except BrokenPipeError:
            # The reader of stdout has gone (`| head`): not an error, and Python must not complain at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            complain("interrupted; nothing was left half-written")
            raise typer.Exit(INTERRUPTED) from None
        except MemoryError:
            complain("out of memory: use fewer field points, or a machine with more")
            raise typer.Exit(1) from None
        except Exception as error:
            if _is_interrupt(error):  # that came while a compiled library was imported
                complain("interrupted; nothing was left half-written")
                raise typer.Exit(INTERRUPTED) from None
            if os.environ.get(DEBUG_VARIABLE) or type(error).__module__.split(".")[0] in ("typer", "click"):
                raise
            expected = isinstance(error, CommandError | ValueError | OSError)
            hint = "" if expected else f" (unexpected {type(error).__name__}; {DEBUG_VARIABLE}=1 shows where)"
            complain(f"{error}{hint}")
            raise typer.Exit(1) from None

    return run


def _is_interrupt(error: BaseException) -> bool:
    """Whether an error was made of an interrupt by whoever caught it first."""
    before: BaseException | None = error
    for _ in range(20):
        if before is None or isinstance(before, KeyboardInterrupt):
            break
        before = before.__cause__ or before.__context__
    return isinstance(before, KeyboardInterrupt)


def complain(message: str) -> None:
    """Print an error as one line on stderr."""
    typer.echo(f"walop-jax: error: {' '.join(message.split())}", err=True)


def warn(message: str) -> None:
    """Print a warning as one line on stderr."""
    typer.echo(f"walop-jax: warning: {' '.join(message.split())}", err=True)


def print_json(value: Any) -> None:
    """Print a value as JSON on stdout."""
    typer.echo(json_text(value), nl=False)


@contextlib.contextmanager
def progress(quiet: bool, stages: Sequence[str] = ()) -> Iterator[Callable[[str], None]]:
    """Give a function that shows on stderr what is being done and for how long: on a terminal in a line that goes.

    Elsewhere a line is printed when there has been none for `LINE_EVERY` seconds. `stages` are the beginnings of the
    messages that open a new step; they are numbered.
    """
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    if quiet:
        yield lambda message: None
        return
    numbered = step_counter(stages)
    if not console.is_terminal:
        began = told = time.monotonic()

        def line(message: str) -> None:
            nonlocal told
            now, text = time.monotonic(), numbered(message)
            if now - told >= LINE_EVERY:
                told = now
                typer.echo(f"{now - began:.0f} s: {text}", err=True)

        yield line
        return
    columns = (SpinnerColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=console, transient=True) as shown:
        task = shown.add_task("", total=None)
        yield lambda message: shown.update(task, description=numbered(message))


def step_counter(stages: Sequence[str]) -> Callable[[str], str]:
    """Give a function that puts "step n of m" ahead of messages, n being that of the last stage that has begun."""
    reached = 0

    def numbered(message: str) -> str:
        nonlocal reached
        for number, stage in enumerate(stages, start=1):
            if message.startswith(stage):
                reached = max(reached, number)
        return f"step {reached} of {len(stages)}: {message}" if reached else message

    return numbered


def cache_folder() -> Path | None:
    """Where compiled code is kept between runs; None when that is switched off or impossible.

    WALOP_JAX_CACHE names the folder ("off": none), otherwise it is walop-jax/xla in the user's cache folder.
    """
    chosen = os.environ.get(CACHE_VARIABLE, "")
    if chosen.lower() in ("off", "0", "none"):
        return None
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(chosen) if chosen else Path(base) / "walop-jax" / "xla"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None


def switch_on_jax() -> None:
    """Import JAX with float64 and with the cache of compiled code, which makes later runs start fast."""
    import jax

    from walop_jax.model import kept_programs

    jax.config.update("jax_enable_x64", True)
    folder = cache_folder()
    if folder is not None:
        with contextlib.suppress(OSError):
            (folder / kept_programs.FOLDER).mkdir(exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
        jax.config.update("jax_raise_persistent_cache_errors", False)


@contextlib.contextmanager
def _standard_output_to_error() -> Iterator[None]:
    """What a library prints by itself must not end up in the machine-readable result."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


@contextlib.contextmanager
def shared(place: str | None) -> Iterator[Processes]:
    """Join the other processes of a computation, if `place` says where they are; gives which one this is.

    When one fails it ends at once, with its line of error: the others notice that it has gone.
    """
    from walop_jax.likelihood.processes import Processes, join, leave_at_once

    if place is None:
        yield Processes()
        return

    with _standard_output_to_error():
        crew = join(place)
    try:
        yield crew
    except BaseException as error:
        complain(f"process {crew.index} of {crew.count}: {error or type(error).__name__}")
        sys.stderr.flush()
        leave_at_once(1)
