"""One file for each command: the Python function, its output, and its options as a command of the program.

The list of commands is all that help needs: the file of a command is read when it is asked for. Nothing heavy is
imported at its head, so that its options appear at once.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Mapping

GROUPS: Mapping[str, Mapping[str, str]] = {
    "Begin": {
        "demo": "Fit the small calibration set that comes with the package, write its page, and correct stars.",
        "docs": "Print a reference page, or the list of pages.",
    },
    "Calibrate": {
        "exposures": "Make the table EXPOSURES of a calibration set from the records of an observatory.",
        "inspect": "List the contents and the faults of calibration sets.",
        "refit": "Fit all field points of calibration sets jointly.",
        "clip": "Flag single intensities that lie far from a fit of all others.",
        "diagnose": "Find the effects that the model lacks, add them, and fit again.",
        "sample": "Sample the posterior.",
        "report": "Write one HTML page about a run, figures inside.",
        "plot": "Draw a figure of a run, by name, as a file.",
    },
    "Correct stars": {
        "matrix": "Give the instrument matrix at a field point, or at every point of a table.",
        "gather": "Make one catalogue, a row a star, of those of the cameras.",
        "apply": "Turn the intensities of stars into Stokes parameters.",
    },
    "Check a calibration": {
        "certify": "Check a calibration from its checksums to its physics and its accuracy.",
        "limits": "Compute the size at which every effect would be detected and named in calibration sets.",
        "compare": "Compare the method of Paper II, as it is published, with the joint fit.",
    },
    "Many nights": {
        "epoch": "Fit new calibration sets and compare with an old calibration.",
        "watch": "Find when a calibration became invalid, from the stars of many nights.",
        "affected": "List the catalogues that a new calibration changes, and by how much.",
        "quality": "Add a row of quality numbers for each night to a table, and list those outside their limits.",
        "stack": "Fit many nights at once, each parameter under a law of its change with time.",
    },
    "Plan and rehearse": {
        "plan": "Plan the calibration exposures of a night.",
        "simulate": "Make a calibration set of an instrument whose as-built values are drawn from their priors.",
    },
    "Describe an instrument": {
        "model": "Write the base model as a file.",
        "instrument": "Print and check an instrument.",
        "trace": "Follow the light of one source through the instrument.",
        "standards": "List standard stars with band, errors, variability and source.",
        "import-zemax": "Make a calibration set (KIND flux) of the transmissions that an optical design program gives.",
    },
    "Credits and conformance": {
        "cite": "List the sources of the physics in a fitted model, effects included.",
        "conformance": "Put another program to the test.",
    },
}
"""The commands in the groups of the help, each with its line there: the first sentence of its docstring."""

COMMANDS = {name: line for commands in GROUPS.values() for name, line in commands.items()}
"""Every command in the order of the help, with its line there.

`import-zemax` is the function `import_zemax` of `import_zemax.py`, and so on.
"""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


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
    except KeyboardInterrupt:
        sys.stderr.write("walop-jax: error: interrupted; nothing was left half-written\n")
        raise SystemExit(INTERRUPTED) from None


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
