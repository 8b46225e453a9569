"""The program `walop-jax`: options parsed, one function called for each command, its outcome printed."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from walop_jax.commands import COMMANDS, GROUPS, INTERRUPTED, is_interrupt, line_of
from walop_jax.commands.command import COMMON, Command, Job, Option, UsageError, command_of
from walop_jax.io.code import versions_of
from walop_jax.io.progress import interrupts_answered
from walop_jax.io.text import json_text

STARTED = time.perf_counter()
DEBUG_VARIABLE = "WALOP_JAX_DEBUG"
LINE_EVERY = 10.0  # s, of progress that is no terminal's
WIDEST = 120  # columns: longer lines are hard to read
UNTRUSTED = 3  # exit code of a command that has written a result which is not to be trusted

HELP = {"help_option_names": ["-h", "--help"], "max_content_width": 100}
EXIT_CODES = (
    "Exit codes: 0 done; 1 not done, with one line on stderr; 2 wrong usage; 3 done, but no go: "
    "the result is not to be used; 130 interrupted."
)
PRINTED = "prints its result and takes no output: keep it with > FILE, with --json for programs"
KEYWORD_ONLY = inspect.Parameter.KEYWORD_ONLY
INTO_ARGUMENT = "writes into the folder that it is given: leave -o out"


class _Commands(TyperGroup):
    """All commands: their list is a table, the file of one is read when it is asked for."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands: dict[str, Any] = dict.fromkeys(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command, with its options."""
        if cmd_name in self.commands and self.commands[cmd_name] is None:
            self.commands[cmd_name] = _command(cmd_name)
        return self.commands.get(cmd_name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """The list, group by group."""
        width = max(map(len, COMMANDS))
        for title, names in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(f"{name:<{width}}", line_of(name)) for name in names])


class _OneCommand(TyperCommand):
    """A command: where it takes no output, its complaint about -o states what becomes of the result."""

    advice = ""  # none where there is an output

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """The arguments, parsed by typer."""
        try:
            return super().parse_args(ctx, args)
        except Exception as error:
            if self.advice and str(getattr(error, "option_name", "")).startswith(("-o", "--out")):
                complaint = f"{ctx.info_name} {self.advice}"
                raise typer.BadParameter(complaint, ctx, param_hint="--output") from None
            raise


app = typer.Typer(
    name="walop-jax",
    cls=_Commands,
    help="Calibrate the WALOP imaging polarimeters with one differentiable model of the instrument.\n\n"
    "To begin: walop-jax refit CALSET -o RUN, then walop-jax report RUN.",
    no_args_is_help=True,
    context_settings=HELP,
    epilog=EXIT_CODES,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _show_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(versions_of(["walop-jax"])["walop-jax"])
        raise typer.Exit
    return wanted


@app.callback()
def _program(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


# ------------------------------------------------------------------------------------- a command as typer sees it


def _paragraphs(function: Callable[..., Any]) -> str:
    """The docstring of a command without its line ends: the terminal wraps paragraphs, not the source."""
    text = inspect.cleandoc(function.__doc__ or "").partition("\n\nIn Python:")[0]
    paragraphs = (paragraph for paragraph in text.split("\n\n") if not paragraph.startswith(">>>"))
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


def _parameter(name: str, option: Option, default: Any, hidden: bool = False) -> inspect.Parameter:
    """A parameter of the function that typer is given."""
    kind = option.kind or type(default)
    needed = default is inspect.Parameter.empty or option.required
    if default is None and not option.required:
        kind = kind | None
    shown: Any = {"help": option.help, "metavar": option.metavar, "hidden": hidden, "min": option.least}
    words = filter(None, (option.spelled(name), option.short))
    note = typer.Argument(**shown) if option.placed else typer.Option(*words, **shown)
    given = inspect.Parameter.empty if needed else default
    return inspect.Parameter(name, KEYWORD_ONLY, default=given, annotation=Annotated[kind, note])


def _default(parameter: inspect.Parameter) -> Any:
    """The default of a parameter; None for arguments of any number, of which there may be none."""
    return None if parameter.kind is inspect.Parameter.VAR_POSITIONAL else parameter.default


def _command(name: str) -> Any:
    """A command as typer makes it, of a function whose signature is made of the options."""
    word = name.replace("-", "_")
    command: Command[Any] = command_of(getattr(importlib.import_module(f"walop_jax.commands.{word}"), word))
    options = command.described
    parameters = [
        _parameter(key, options[key], _default(p), hidden=key == "seed" and not command.random)
        for key, p in command.signature.parameters.items()
        if key in options
    ]
    parameters += [_parameter(key, options[key], False) for key in ("quiet", "json")]

    def run(**given: Any) -> None:
        _guarded(command, given)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    alone = typer.Typer(add_completion=False, rich_markup_mode=None)
    alone.command(name, cls=_OneCommand, context_settings=HELP, help=_paragraphs(command.body))(run)
    made: Any = typer.main.get_command(alone)
    if "output" not in command.options:
        made.advice = PRINTED if command.writes is None else INTO_ARGUMENT
    return made


def _guarded(command: Command[Any], given: dict[str, Any]) -> None:
    """Run a command; errors become a line on stderr and an exit code (with WALOP_JAX_DEBUG set: their traceback)."""
    try:
        with interrupts_answered(_interrupted):
            _run(command, given)
            sys.stdout.flush()
    except BrokenPipeError:
        raise  # the reader of stdout has gone (`| head`): typer ends the program without a word
    except UsageError as error:
        option = error.option and command.options.get(error.option, Option("")).spelled(error.option)
        raise typer.BadParameter(str(error), param_hint=option) from None
    except (KeyboardInterrupt, Exception) as error:
        if is_interrupt(error):
            raise typer.Exit(_interrupted()) from None
        if os.environ.get(DEBUG_VARIABLE) or type(error).__module__.split(".")[0] in ("typer", "click"):
            raise
        if isinstance(error, MemoryError):
            complain("out of memory: use fewer field points, or a machine with more")
        elif isinstance(error, ValueError | OSError):
            complain(str(error))
        else:
            complain(f"{error} (unexpected {type(error).__name__}; {DEBUG_VARIABLE}=1 shows where)")
        raise typer.Exit(1) from None


def _interrupted() -> int:
    """Say that the command was interrupted; gives its exit code."""
    complain("interrupted; nothing was left half-written")
    return INTERRUPTED


def _run(command: Command[Any], given: dict[str, Any]) -> None:
    """Run a command and print its outcome; a failure, or a result that is not to be trusted, ends the program."""
    quiet, json = given.pop("quiet"), given.pop("json")
    common = {name: given.pop(name) for name in COMMON if name in given}
    if command.jax:
        from walop_jax.model.compiled import switch_on

        switch_on()
    with progress(quiet or json, command.stages) as tell:
        outcome = command.run(Job(progress=tell, typed=True, **common), given)
    text = "" if quiet or json else outcome.printed()
    if json:
        typer.echo(json_text(outcome.content), nl=False)
    elif text:
        _print(text, outcome.markdown)
    for sentence in outcome.warnings:
        complain(sentence, "warning")
    steps = " or ".join(filter(None, outcome.next))
    if text and steps and not outcome.failure:
        # On stderr: stdout may be redirected into a file.
        typer.echo(f"Done in {seconds_since_start():.0f} s. Next: {steps}", err=True)
    if outcome.failure:
        sys.stdout.flush()
        complain(outcome.failure)
        raise typer.Exit(1)
    if not outcome.trusted:
        raise typer.Exit(UNTRUSTED)


def seconds_since_start() -> float:
    """Seconds since the process was started, its imports among them, as `time` of a shell counts them."""
    try:
        # The 22nd field of Linux; the name of the program, in brackets, may hold blanks.
        ticks = float(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):
        return time.perf_counter() - STARTED


def _print(text: str, markdown: bool) -> None:
    """Text as it is; Markdown is laid out on a terminal."""
    if markdown:
        from rich.console import Console
        from rich.markdown import Markdown

        console = Console()
        if console.is_terminal:
            Console(width=min(console.width, WIDEST)).print(Markdown(text, hyperlinks=False))
            return
    typer.echo(text.removesuffix("\n"))


# ----------------------------------------------------------------------------------------------------- the terminal


def complain(message: str, kind: str = "error") -> None:
    """Print an error, or a warning, as one line on stderr."""
    typer.echo(f"walop-jax: {kind}: {' '.join(message.split())}", err=True)


@contextlib.contextmanager
def progress(quiet: bool, stages: Sequence[str] = ()) -> Iterator[Callable[[str], None]]:
    """Give a function that shows progress and time on stderr: on a terminal in a line that goes.

    Elsewhere a line is printed when there has been none for `LINE_EVERY` seconds. `stages` are those of the work, in
    their order: they are counted.
    """
    if quiet:
        yield lambda message: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    numbered = step_counter(stages)
    if not console.is_terminal:
        last_line = time.monotonic()

        def line(message: str) -> None:
            nonlocal last_line
            moment, text = time.monotonic(), numbered(message)
            if moment - last_line >= LINE_EVERY:
                last_line = moment
                typer.echo(f"{seconds_since_start():.0f} s: {text}", err=True)

        yield line
        return
    columns = (SpinnerColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=console, transient=True) as shown:
        task = shown.add_task("", total=None)
        shown.tasks[0].start_time = shown.get_time() - seconds_since_start()
        yield lambda message: shown.update(task, description=numbered(message))


def step_counter(stages: Sequence[str]) -> Callable[[str], str]:
    """Give a function that puts "step n of m" ahead of messages, n being that of the last stage that has begun."""
    reached = 0

    def numbered(message: str) -> str:
        nonlocal reached
        stage = getattr(message, "stage", None)
        if stage in stages:
            reached = max(reached, stages.index(stage) + 1)
        return f"step {reached} of {len(stages)}: {message}" if reached else message

    return numbered
