"""Contents of a page about a run: read, checked against each other, and what is missing said in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from walop_jax.calibration import PRODUCT, SUMMARY, Calibration, read_calibration
from walop_jax.data.user_tables import read_input_table
from walop_jax.diagnosis.figure_data import FIGURE_DATA, UNNAMED, DiagnosisFigureData, read_figure_data
from walop_jax.diagnosis.limits_found import DetectionLimits
from walop_jax.io.errors import DataError, fail
from walop_jax.io.text import read_json
from walop_jax.posterior import files
from walop_jax.posterior.files import DIAGNOSIS, Run

SUMMARY_KEYS = ("chi2", "dof", "n_data", "parameters", "converged", "message", "versions", "inputs")
DIAGNOSIS_KEYS = ("verdict", "steps", "candidates", "unexplained")
DEFAULTS: dict[str, Any] = {"warnings": [], "remarks": [], "misfit": None}  # what a summary may lack
SAME_CHI2 = 1e-6  # relative difference of χ²/dof of one and the same fit, read from two files

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class RunContents:
    """The contents of a run; None for what is not there. `missing` says what that means for a page.

    `summary`, `diagnosis` and `sample` are the contents of the JSON files; `intervals` are rows of the table of
    posterior intervals; `corner` are the bytes of a PNG; `limits` is what `limits` has found for the same data,
    `data` are the sets of the fit if they are not where they were, `commissioning` is a go or no-go with its reasons.
    """

    folder: Path
    summary: dict[str, Any]
    product: Calibration | None
    diagnosis: dict[str, Any] | None
    figure_data: DiagnosisFigureData | None
    sample: dict[str, Any] | None
    intervals: tuple[dict[str, Any], ...]
    corner: bytes | None
    limits: DetectionLimits | None
    missing: tuple[str, ...]
    data: tuple[Path, ...] = ()
    commissioning: dict[str, Any] | None = None


def read_run(run: Run | Path) -> RunContents:
    """Read the folder of a `refit` or `diagnose`, with what `sample` may have added.

    Raises `DataError`, with advice, if it is no such folder or if its summary or diagnosis cannot be read; other
    files that are absent or damaged are left out and listed in `missing`.
    """
    run = Run(run) if isinstance(run, Path) else run
    folder = run.folder
    run.wanted(SUMMARY, "give the RUN of walop-jax refit or diagnose")
    missing: list[str] = []

    def optional(name: str, read: Callable[[Path], T], lost: str, wanted: bool = True) -> T | None:
        if name not in run:
            if wanted:
                missing.append(f"{name} is not there: {lost}.")
            return None
        try:
            return read(folder / name)
        except (DataError, OSError) as error:
            missing.append(f"{name} cannot be used ({error}): {lost}.")
            return None

    summary = DEFAULTS | _document(folder / SUMMARY, SUMMARY_KEYS)
    lost = "no maps of the matrix, no pulls from the priors"
    product = optional(PRODUCT, lambda path: read_calibration(path, rebuild=False), lost)
    diagnosis = _document(folder / DIAGNOSIS, DIAGNOSIS_KEYS) if DIAGNOSIS in run else None
    figure_data = None
    if diagnosis is not None:
        figure_data = optional(
            FIGURE_DATA, read_figure_data, "no maps of the residuals, no curves, no ladder of χ²"
        )
        names = [step["effect"] for step in diagnosis["steps"]]
        drawn = [] if figure_data is None else [one.effect for one in figure_data.comparisons[1:]]
        if figure_data is not None and drawn not in (names, [*names, UNNAMED]):
            missing.append(
                f"{FIGURE_DATA} is of another diagnosis than {DIAGNOSIS}: its pictures are left out."
            )
            figure_data = None
        if _another_fit(summary, diagnosis):
            missing.append(
                f"{DIAGNOSIS} is of another fit than {SUMMARY}: this folder was written to again since."
            )
    sampled = files.POSTERIOR in run
    rest = {
        "sample": optional(
            files.SAMPLE, lambda path: _document(path, ()), "no verdict on the sampling", sampled
        ),
        "intervals": optional(files.INTERVALS, _intervals, "no table of the posterior", sampled) or (),
        "corner": optional(files.CORNER, Path.read_bytes, "no corner plot", sampled),
        "limits": optional(files.LIMITS, lambda path: _limits(path, summary), "no protection level", False),
        "commissioning": optional(
            files.COMMISSIONING, lambda path: _document(path, ("go", "requirements")), "no go or no-go", False
        ),
    }
    if product is not None and diagnosis is None:
        try:
            run.calset  # noqa: B018
        except (ValueError, OSError) as error:
            missing.append(f"Residuals are not drawn: {error}.")
    data = tuple(map(Path, run.data))
    return RunContents(
        folder, summary, product, diagnosis, figure_data, missing=tuple(missing), data=data, **rest
    )


def _document(path: Path, keys: tuple[str, ...]) -> dict[str, Any]:
    content = read_json(path)
    lacking = [key for key in keys if not isinstance(content, dict) or key not in content]
    if lacking or not isinstance(content, dict):
        what = f"has no {lacking[0]!r}" if lacking else "is not a summary"
        raise fail(what, file=path, advice="run the command that made it again")
    return content


def read_limits(path: Path) -> DetectionLimits:
    """The content of a `limits.json`. Raises `DataError` if it is none."""
    try:
        return DetectionLimits.from_document(_document(path, ("limits", "effects", "protection")))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise fail(
            f"is not what walop-jax limits writes: {error}", file=path, advice="run it again"
        ) from error


def _limits(path: Path, summary: dict[str, Any]) -> DetectionLimits:
    """The limits of the data behind a summary; those of other data are refused."""
    of, wanted = (
        {entry["sha256"] for entry in document["inputs"]}
        for document in (_document(path, ("inputs",)), summary)
    )
    if of != wanted:
        raise fail("is of other data", file=path, advice="run walop-jax limits on the sets of this run")
    return read_limits(path)


def _another_fit(summary: dict[str, Any], diagnosis: dict[str, Any]) -> bool:
    said = diagnosis.get("chi2_per_dof_after")
    ratio = summary["chi2"] / max(summary["dof"], 1)
    return said is not None and abs(said - ratio) > SAME_CHI2 * ratio


def _intervals(path: Path) -> tuple[dict[str, Any], ...]:
    """Rows of the sampled coefficients: those that have an effective sample size."""
    table = read_input_table(path).table
    names = ("NAME", "UNIT", "MEDIAN", "LOW68", "HIGH68", "LOW95", "HIGH95", "ESS")
    lacking = [name for name in names if name not in table.colnames]
    if lacking:
        raise fail("the column is missing", file=path, column=lacking[0])
    # An empty text comes back masked.
    columns = {
        name: np.ma.filled(np.ma.asarray(table[name]), "" if name in names[:2] else np.nan) for name in names
    }
    rows = [{name: column[i] for name, column in columns.items()} for i in range(len(table))]
    return tuple(row for row in rows if np.isfinite(float(row["ESS"])))
