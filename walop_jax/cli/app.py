"""The program `walop-jax` and the list of its commands: one file each, named like the command."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import re
from collections.abc import Callable
from typing import Annotated, Any

import typer

from walop_jax.cli.common import guarded

_UNUSED_SEED = Annotated[int | None, typer.Option("--seed", hidden=True)]

COMMANDS = (
    "inspect",
    "simulate",
    "refit",
    "compress",
    "clip",
    "diagnose",
    "limits",
    "sample",
    "report",
    "plot",
    "matrix",
    "apply",
    "compare",
    "certify",
    "epoch",
    "model",
    "instrument",
    "import-zemax",
    "trace",
    "cite",
    "conformance",
    "docs",
)
"""In the order of the help; `import-zemax` is the function `import_zemax` of `import_zemax.py`, and so on."""

HELP = {"help_option_names": ["-h", "--help"], "max_content_width": 100}
EXIT_CODES = (
    "Exit codes: 0 done; 1 not done, or a check that does not hold, with one line on stderr; 2 wrong usage; 3 done, "
    "but the result is not to be trusted; 130 interrupted."
)

app = typer.Typer(
    name="walop-jax",
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
        from importlib.metadata import PackageNotFoundError, version

        try:
            typer.echo(version("walop-jax"))
        except PackageNotFoundError:
            typer.echo("unknown")
        raise typer.Exit
    return wanted


@app.callback()
def _program(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def _paragraphs(function: Callable[..., None]) -> str:
    """The docstring of a command without its line ends: the terminal wraps paragraphs, not the source."""
    text = inspect.cleandoc(function.__doc__ or "")
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))


def _in_short(function: Callable[..., None]) -> str:
    """The first sentence of a command's docstring, up to a colon or semicolon: its line in the list."""
    return re.split(r"[:;.](?:\s|$)", _paragraphs(function))[0] + "."


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


def _register() -> None:
    for name in COMMANDS:
        identifier = name.replace("-", "_")
        path = f"walop_jax.cli.{identifier}"
        if importlib.util.find_spec(path) is not None:
            function = getattr(importlib.import_module(path), identifier)
            app.command(
                name, context_settings=HELP, help=_paragraphs(function), short_help=_in_short(function)
            )(guarded(accepting_seed(function)))


_register()
