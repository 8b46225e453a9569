"""One file for each command: the Python function, what it shows, and what makes it a command of the program.

Nothing heavy is imported here, nor at the head of the files of commands, so that help appears at once.
"""

from __future__ import annotations

import os
import sys

COMMANDS = (
    "inspect",
    "simulate",
    "refit",
    "compress",
    "clip",
    "diagnose",
    "limits",
    "plan",
    "sample",
    "report",
    "plot",
    "matrix",
    "apply",
    "compare",
    "certify",
    "epoch",
    "watch",
    "model",
    "instrument",
    "import-zemax",
    "trace",
    "cite",
    "conformance",
    "docs",
)
"""In the order of the help; `import-zemax` is the function `import_zemax` of `import_zemax.py`, and so on."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


def main() -> None:
    """Run the program: the entry point. An interrupt ends it with one line, from the first import on."""
    # Before numpy is imported. Its matrices have a hundred rows here: threads cost more than they give
    # (a refit of 169 points took 8.9 s with them, 6.1 s without, on two cores). JAX has its own threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A path may hold bytes that are no text.
    sys.stdout.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue]
    try:
        from walop_jax.commands.program import app

        app()
    except KeyboardInterrupt:
        sys.stderr.write("walop-jax: error: interrupted; nothing was left half-written\n")
        raise SystemExit(INTERRUPTED) from None
