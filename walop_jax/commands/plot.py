"""`walop-jax plot`: a figure of a run by name."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Listing, Option, Outcome, PathLike, UsageError, command
from walop_jax.commands.products import Effects, catalogue_of
from walop_jax.io.atomic import check_output
from walop_jax.io.errors import fail

if TYPE_CHECKING:
    from walop_jax.reports.run import Drawable


PICTURES = (".pdf", ".png", ".svg", ".eps", ".jpg")


def check_picture(path: PathLike, *, overwrite: bool) -> None:
    """Refuse the name of a picture that cannot be written, as `check_output` does, and for its extension."""
    if Path(path).suffix.lower() not in PICTURES:
        raise fail("is no picture that can be written", file=path, advice=f"use {', '.join(PICTURES)}")
    check_output(path, overwrite=overwrite)


OPTIONS = {
    "run": Option("Folder of results; none: list the figures.", metavar="[RUN]", kind=Path, placed=True),
    "name": Option("The figure.", metavar="[NAME]", kind=str, placed=True),
    "output": Option(
        "File to write: .pdf, .png, .svg (default: NAME.png).", metavar="FILE", kind=Path, short="-o"
    ),
    "parameters": Option("Coefficients of a corner or trace plot, by name.", metavar="A,B,…", kind=str),
    "x": Option("Field point of transmission and modulation, X (deg).", kind=float),
    "y": Option("The same, Y (deg).", kind=float),
    "step": Option("Effect of a diagnosis (effect, signature); 0: starting and final model.", least=0),
    "width": Option(
        "Width in print, with type of 7 pt: column (89 mm), page (183 mm), or in mm.",
        metavar="column|page|MM",
        kind=str,
    ),
    "data": Option(
        "Calibration set of the fit, if it has moved; again for each.", metavar="CALSET", kind=list[Path]
    ),
}


@command(writes=(), options=OPTIONS)
def plot(
    job: Job,
    run: Drawable | PathLike | None = None,
    name: str | None = None,
    *,
    output: PathLike | None = None,
    parameters: str | Sequence[str] | None = None,
    x: Any = 0.0,
    y: Any = 0.0,
    step: int = 1,
    width: float | str | None = None,
    data: Sequence[PathLike] | None = None,
    effects: Effects = None,
    ax: Any = None,
    figsize: tuple[float, float] | None = None,
    reference: Mapping[str, float] | None = None,
) -> Outcome[Any]:
    """Draw a figure of a run, by name, as a file.

    Without a name the figures are listed: accuracy of p over the field, maps of the matrix and of the retardance of the
    half-wave plates, camera transmissions, corner plots, and others. The format follows the name of the file.

    In Python: the matplotlib figure, of a run or of a fit, calibration, diagnosis, posterior, comparison, survey or set
    (`modulation`, at any number of points) in memory, written if `output` is given; without a name, a line about each
    figure, by name. `figsize` (inches) is its size; with `ax` it is drawn there (one of several panels in a subfigure
    that takes the room of these axes). `width` is the width in print (mm, "column" or "page"), for which panels are
    arranged. `reference` holds values by name that a corner plot marks. Raises `DataError`, with the nearest names, for
    a figure that does not exist and for data that the run lacks.

    >>> walop.plot()["modulation"]
    'q_m and u_m against polariser angle'
    >>> figure = walop.plot(result, "modulation", x=0.1, y=0.0)
    """
    from walop_jax import Run
    from walop_jax.io.run_folder import OF_A_FIT
    from walop_jax.reports.named import FIGURES, draw, possible
    from walop_jax.reports.posterior_figures import save_figure
    from walop_jax.reports.run import FigureSource
    from walop_jax.reports.style import Canvas, texts

    catalogue = catalogue_of(effects)
    held = Run(Path(run), catalogue, tuple(data or ())) if isinstance(run, str | os.PathLike) else run
    if isinstance(held, Run) and not held.folder.is_dir():
        raise fail("is not the folder of a run", file=held.folder, advice=OF_A_FIT)
    if held is None or name is None:
        if output is not None:
            raise UsageError("give the name of the figure as well", "name")
        every = {key: texts("figures")[key] for key in FIGURES}
        listed = Listing(every if held is None else possible(FigureSource.of(held)))
        return Outcome(listed, listed, repr(listed))
    chosen = f"{name}.png" if output is None and job.typed else output
    path = None if chosen is None else Path(chosen)
    if path is not None:
        check_picture(path, overwrite=job.overwrite)
    if isinstance(parameters, str):
        parameters = [word.strip() for word in parameters.split(",") if word.strip()]
    job.tell(f"drawing {name}")
    options = {"parameters": tuple(parameters or ()), "place": (x, y), "step": step, "reference": reference}
    source = FigureSource.of(held, **options, canvas=Canvas(ax, figsize, _inches(width)))
    figure = draw(name, source)
    if path is not None:
        save_figure(path, figure, overwrite=job.overwrite, exact=width is not None)
    return Outcome(figure, {"figure": name, "output": str(path)}, str(path))


def _inches(width: float | str | None) -> float | None:
    """The width in inches of a width in mm, or of "column" or "page"."""
    from walop_jax.reports.style import WIDTHS

    if width is None:
        return None
    try:
        millimetres = WIDTHS[width] if width in WIDTHS else float(width)
    except ValueError:
        millimetres = 0.0
    if not 30.0 <= millimetres <= 1000.0:
        raise UsageError(f"{width!r} is no width; give {', '.join(WIDTHS)}, or 30 to 1000 mm", "width")
    return millimetres / 25.4
