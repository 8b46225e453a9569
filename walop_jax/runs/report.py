"""One self-contained page about a run."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from walop_jax.io.atomic import atomic_path, check_output
from walop_jax.reports.page import render
from walop_jax.reports.run import read_run

PAGE = "report.html"


@dataclasses.dataclass(frozen=True)
class Page:
    """A page that was written: where, its length in bytes, and in words what the run lacked for it."""

    path: Path
    length: int
    missing: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {"page": str(self.path), "bytes": self.length, "missing": list(self.missing)}


def write_report(
    run: str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    *,
    overwrite: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Page:
    """Write an HTML page about the folder `run`, figures inside, as `output` (default: `run`/report.html).

    `progress` is told what is being done. Raises `DataError` as `read_run` does, and if the page cannot be written.
    """
    tell = progress or (lambda text: None)
    target = Path(run) / PAGE if output is None else Path(output)
    tell("reading")
    found = read_run(Path(run))
    check_output(target, overwrite=overwrite)
    tell("drawing")
    text = render(found)
    with atomic_path(target, overwrite=overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return Page(target, len(text.encode()), found.missing)
