"""A figure of a run by its name, written to a file."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from walop_jax.io.atomic import check_output
from walop_jax.io.errors import fail
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.reports.named import Source, draw
from walop_jax.reports.posterior_figures import save_figure

FORMATS = (".pdf", ".png", ".svg", ".eps", ".jpg")


def plot_figure(
    run: str | os.PathLike[str],
    name: str,
    output: str | os.PathLike[str],
    *,
    parameters: Sequence[str] = (),
    place: tuple[float, float] = (0.0, 0.0),
    overwrite: bool = False,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> Path:
    """Draw the figure `name` of the folder `run` and write it as `output`, whose name says the format.

    `parameters` are the coefficients of a corner or trace plot (default: those that the data constrain), `place` the
    field point (deg) of figures of single points, `catalogue` the effects that the model may have. `progress` is told
    what is being done. Raises `DataError`, with the nearest names, for a figure that does not exist, for what the run
    lacks, and if the file cannot be written.
    """
    path = Path(output)
    if path.suffix.lower() not in FORMATS:
        raise fail("is no picture that can be written", file=path, advice=f"use {', '.join(FORMATS)}")
    check_output(path, overwrite=overwrite)
    if not Path(run).is_dir():
        raise fail(
            "is not the folder of a run", file=run, advice="give the RUN of walop-jax refit or diagnose"
        )
    if progress is not None:
        progress(f"drawing {name}")
    figure = draw(name, Source(Path(run), tuple(catalogue), tuple(parameters), place))
    save_figure(path, figure, overwrite=overwrite)
    return path
