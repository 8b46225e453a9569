"""Whatever the program has written, or reads, back in memory: one door for sets, calibrations and runs."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.from_file import read_calibration
from walop_jax.calibration.summary import FAILED, PRODUCT, SUMMARY
from walop_jax.data import CalibrationSet, read_calibration_set
from walop_jax.diagnosis.findings import DIAGNOSIS
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import fail
from walop_jax.io.fits_reading import primary_keywords
from walop_jax.io.text import read_json
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.reports.run import COMPARISON, EPOCH, LIMITS, POSTERIOR, SAMPLE

DOCUMENTS = {
    "summary": SUMMARY,
    "diagnosis": DIAGNOSIS,
    "sample": SAMPLE,
    "comparison": COMPARISON,
    "epoch": EPOCH,
    "limits": LIMITS,
}
"""The documents that a run may hold, and their files."""


@dataclasses.dataclass(frozen=True, repr=False)
class Run(Displayed):
    """The folder of a run; everything in it is read when it is asked for. None stands for what is not there."""

    folder: Path
    catalogue: Sequence[type[Effect]] = EFFECTS

    @functools.cached_property
    def calibration(self) -> Calibration | None:
        """The calibration."""
        there = (self.folder / PRODUCT).exists()
        return read_calibration(self.folder, self.catalogue).calibration if there else None

    @functools.cached_property
    def documents(self) -> dict[str, dict[str, Any]]:
        """The JSON documents of the run by name: summary, diagnosis, sample, comparison, epoch, limits."""
        found = {}
        for name, file in DOCUMENTS.items():
            path = self.folder / file
            if path.exists():
                found[name] = read_json(path)
        return found

    @functools.cached_property
    def posterior(self) -> Any:
        """The draws as ArviZ InferenceData."""
        path = self.folder / POSTERIOR
        if not path.exists():
            return None
        from walop_jax.posterior import read_inference_data

        return read_inference_data(path)

    def display(self) -> Display:
        """The files, and the calibration if there is one."""
        found = self.documents
        files = {"calibration": PRODUCT, "posterior": POSTERIOR}
        held = [name for name, file in files.items() if (self.folder / file).exists()]
        facts = [("holds", ", ".join([*held, *found]) or "nothing")]
        if "diagnosis" in found:
            facts.append(("verdict", str(found["diagnosis"].get("verdict"))))
        inner = Display("") if self.calibration is None else self.calibration.display()
        return dataclasses.replace(
            inner, title=f"Run {self.folder}. {inner.title}".removesuffix(". "), facts=(*facts, *inner.facts)
        )


def read(
    *paths: str | os.PathLike[str], kinds: Collection[str] = (), catalogue: Sequence[type[Effect]] = EFFECTS
) -> CalibrationSet | Calibration | Run:
    """Read calibration sets (several become one), a calibration product, or the folder of a run.

    `kinds` are kinds of exposures beyond those of the format, `catalogue` the effects that a fitted model may have.
    Raises `DataError`, naming file, extension, column and row, for what cannot be read or trusted.
    """
    if not paths:
        raise fail("no file was given", advice="name a calibration set, a calibration product or a run")
    first = Path(paths[0])
    if len(paths) == 1 and first.is_dir():
        if not any((first / name).exists() for name in (*DOCUMENTS.values(), PRODUCT)):
            what = f"holds no results{', its fit did not converge' if (first / FAILED).exists() else ''}"
            raise fail(what, file=first, advice="give the RUN of a command, or a FITS file")
        return Run(first, tuple(catalogue))
    if len(paths) == 1 and "PRODVERS" in primary_keywords(first):
        return read_calibration(first, catalogue).calibration
    return read_calibration_set(*paths, kinds=kinds)
