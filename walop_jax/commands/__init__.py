"""One file for each command: the Python function, its output, and its options as a command of the program.

The list of commands is all that help needs: the file of a command is read when it is asked for. Nothing heavy is
imported at its head, so that its options appear at once.
"""

from __future__ import annotations

import gc
import itertools
import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

GROUPS: Mapping[str, Sequence[str]] = {
    "Begin": ("demo", "docs"),
    "Calibrate": ("exposures", "inspect", "refit", "diagnose", "sample", "report", "plot"),
    "Correct stars": ("matrix", "gather", "apply"),
    "Is it good for my stars?": ("check", "limits", "compare"),
    "Many nights": ("stack",),
    "Plan and rehearse": ("plan", "simulate"),
    "Describe an instrument": ("model", "instrument", "trace", "standards"),
    "Credits": ("cite",),
}
"""The commands in the groups of the help."""

COMMANDS = tuple(itertools.chain(*GROUPS.values()))  # every command in the order of the help

INTERRUPTED = 130  # exit code after Ctrl-C, as shells have it


def line_of(name: str) -> str:
    """The line of a command in the help: its docstring until the first colon or full stop, read from the source."""
    word = name.replace("-", "_")
    source = Path(__file__).with_name(f"{word}.py").read_text(encoding="utf-8")
    (first,) = re.findall(rf'^def {word}\(.*?"""(.+?)[:.]\s', source, re.DOTALL | re.MULTILINE)
    return f"{' '.join(first.split())}."


def main() -> None:
    """Run the program: the entry point. An interrupt ends it with one line, from the first import on."""
    # Before numpy is imported. Its matrices have a hundred rows here: threads cost more than they give
    # (a refit of 169 points took 8.9 s with them, 6.1 s without, on two cores). JAX has its own threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # What modules define is not garbage: looking through it again and again takes a tenth of a start.
    gc.set_threshold(50_000, 20, 20)
    # That of a notebook may not be there, and commands only write files.
    os.environ["MPLBACKEND"] = "agg"
    _open_streams()
    # A path may hold bytes that are no text.
    sys.stdout.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue]
    try:
        from walop_jax.commands.program import app

        app()
    except (KeyboardInterrupt, Exception) as error:
        if not is_interrupt(error):
            raise
        sys.stderr.write("walop-jax: error: interrupted; nothing was left half-written\n")
        raise SystemExit(INTERRUPTED) from None


def is_interrupt(error: BaseException | None) -> bool:
    """True if an error goes back to an interrupt that was caught on the way."""
    for _ in range(20):  # a chain of errors may be a ring
        if error is None or isinstance(error, KeyboardInterrupt):
            break
        error = error.__cause__ or error.__context__
    return isinstance(error, KeyboardInterrupt)


def _open_streams() -> None:
    """Open closed streams (`>&-`, daemons) to nowhere: the next file would take their number, and the printed text."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
