"""The method of Paper II beside the joint model on the same calibration sets: from files to a folder of results."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from walop_jax.calibration.calibration import Calibration
from walop_jax.data import DEFAULT_FILTER
from walop_jax.data.field_points import true_matrices
from walop_jax.data.user_tables import new_table, write_output_table
from walop_jax.diagnosis.trust import examined
from walop_jax.fit.refit import refit
from walop_jax.io.folder import output_folder
from walop_jax.io.text import json_text, read_text
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.paper.comparison import Comparison, compare
from walop_jax.reports import comparison_figures
from walop_jax.reports.run import COMPARISON
from walop_jax.runs.inputs import sets_and_model
from walop_jax.runs.left_out import KEY, left_out_cards, left_out_sentences
from walop_jax.science.star_errors import Truth

DOCUMENT, TABLE = COMPARISON, "comparison.fits"
FIGURES: Mapping[str, Callable[[Comparison], Any]] = {
    "comparison_histogram.png": comparison_figures.histogram_figure,
    "comparison_map.png": comparison_figures.map_figure,
    "comparison_offset.png": comparison_figures.offset_figure,
    "comparison_spectral.png": comparison_figures.spectral_figure,
}
OUTPUTS = (DOCUMENT, TABLE, *FIGURES)
"""In the order in which they are looked for."""


@dataclasses.dataclass(frozen=True)
class ComparedRun:
    """A comparison, the content of `comparison.json`, and sentences to bear in mind."""

    comparison: Comparison
    document: dict[str, Any]
    warnings: tuple[str, ...]


def compare_methods(
    calsets: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    truth: str | os.PathLike[str] | None = None,
    filter_name: str = DEFAULT_FILTER,
    model: str | os.PathLike[str] | None = None,
    instrument: str | os.PathLike[str] | None = None,
    seed: int | None = None,
    overwrite: bool = False,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> ComparedRun:
    """Calibrate with a polynomial per point and with the joint model, judge both, and write the folder `output`.

    `truth` is a table of true X, Y, M21 … M33; without it the reference is the joint model. `instrument` is a
    shipped one by name or a description file (default: what the sets say), `model` a TOML file (default: the base
    model); `seed` (None: 0) is that of the stars. `catalogue` are the effects that a model may have. `progress` is
    told what is being done.

    Raises `DataError` for files that cannot be read or written, ValueError for a model file that does not fit, if
    the joint fit does not converge, and as `compare` does.
    """
    tell = progress or (lambda text: None)
    text = "" if model is None else read_text(model)
    with output_folder(output, OUTPUTS, overwrite=overwrite) as out:
        tell("reading")
        calset, chosen = sets_and_model(calsets, text, model, instrument, catalogue)
        known = None if truth is None else Truth(*true_matrices(truth, chosen.template.patched()))
        tell("fitting the joint model")
        result = examined(refit(calset, chosen, progress=tell))
        if not result.converged:
            raise ValueError(f"the joint fit did not converge ({result.minimum.message})")
        tell("fitting and judging the polynomials")
        calibration = Calibration.from_fit(result)
        found = compare(calset, calibration, known, filter_name, seed or 0)
        lost = calibration.left_behind
        document = found.document() | {"trusted": result.trusted, KEY: list(lost)}
        with out.filled() as folder:
            (folder / DOCUMENT).write_text(json_text(document), encoding="utf-8")
            write_output_table(folder / TABLE, new_table(found.columns()), {}, header=left_out_cards(lost))
            for name, figure in FIGURES.items():
                figure(found).savefig(folder / name, dpi=130)
    warnings = () if result.trusted else tuple(f"the joint fit: {text}" for text in result.warnings)
    return ComparedRun(found, document, (*warnings, *left_out_sentences(lost)))
