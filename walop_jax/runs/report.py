"""One self-contained page about a run."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from walop_jax.calibration.calibration import Calibration
from walop_jax.io.atomic import atomic_path, check_output
from walop_jax.io.text import printable
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.reports.other_pages import kind_of_run, render_other
from walop_jax.reports.page import render
from walop_jax.reports.run import RunContents, read_run
from walop_jax.science.field_accuracy import FieldAccuracy, field_accuracy

PAGE = "report.html"
GENERATOR = '<meta name="generator" content="walop-jax'


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
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> Page:
    """Write an HTML page about the folder `run`, figures inside, as `output` (default: `run`/report.html).

    `run` is that of a refit, diagnose, sample, compare, epoch or limits. A page of this program is made anew; any other
    file is left alone unless `overwrite`. `catalogue` are the effects that the model may have. `progress` is told
    what is being done. Raises `DataError` as `read_run` does, and if the page cannot be written.
    """
    tell = progress or (lambda text: None)
    folder = Path(run)
    target = folder / PAGE if output is None else Path(output)
    tell("reading")
    kind = kind_of_run(folder)
    found = read_run(folder) if kind == "fit" else None
    overwrite = overwrite or _is_page(target)
    check_output(target, overwrite=overwrite)
    if found is None:
        tell("drawing")
        text, missing = render_other(folder, kind)
    else:
        tell("working out the accuracy of p")
        accuracy, lacking = _accuracy(found, catalogue)
        tell("drawing")
        missing = (*found.missing, *lacking)
        text = render(dataclasses.replace(found, missing=missing), accuracy)
    text = printable(text)
    with atomic_path(target, overwrite=overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return Page(target, len(text.encode()), missing)


def _is_page(path: Path) -> bool:
    """Whether a file is a page that this program has written: then it is made anew without asking."""
    try:
        with path.open(encoding="utf-8") as stream:
            return GENERATOR in stream.read(1000)
    except (OSError, UnicodeDecodeError):
        return False


def _accuracy(
    run: RunContents, catalogue: Sequence[type[Effect]]
) -> tuple[FieldAccuracy | None, tuple[str, ...]]:
    """The accuracy of p over the field, or in words why it is not known."""
    if run.product is None:
        return None, ()
    try:
        found = field_accuracy(Calibration.from_product(run.product, catalogue))
    except ValueError as error:
        return None, (f"The accuracy of p over the field is not known: {error}.",)
    lacking = ("The instrument has a single arm: the accuracy of p depends on how stars are observed.",)
    return found, () if found is not None else lacking
