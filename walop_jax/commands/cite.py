"""`walop-jax cite`: where the physics of a model comes from."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.commands.command import Job, Option, Outcome, command
from walop_jax.commands.products import CalibrationLike, Effects, calibration_of
from walop_jax.io.names import POSTERIOR

if TYPE_CHECKING:
    from walop_jax.model.references import Reference


OPTIONS = {
    "run": Option(
        "Run, or its calibration.fits; default: the base model.", metavar="[RUN]", kind=Path, placed=True
    ),
    "bibtex": Option("As BibTeX entries."),
}


@command(options=OPTIONS)
def cite(
    job: Job, run: CalibrationLike | None = None, *, bibtex: bool = False, effects: Effects = None
) -> Outcome[tuple[Reference, ...]]:
    """List the sources of the physics in a fitted model, effects included.

    In Python: a tuple of `Reference`s, each with `what` it is the source of, and `source`, the works.

    >>> walop.cite(result)[1].what
    'polariser'
    """
    from walop_jax import __version__
    from walop_jax.data.settings import DEFAULT_FILTER
    from walop_jax.fit import minimise
    from walop_jax.fit.model_file import model_without_data
    from walop_jax.model.instrument import nominal_instrument
    from walop_jax.model.references import Reference, References, references
    from walop_jax.model.references import bibtex as entries

    folder = getattr(run, "folder", run)
    sampled = isinstance(folder, str | os.PathLike) and (Path(folder) / POSTERIOR).exists()
    if run is None:
        model, filters = model_without_data(nominal_instrument()), [DEFAULT_FILTER]
    else:
        calibration = calibration_of(run, effects)
        model, filters = calibration.model, calibration.exposures.filter.tolist()
    sources = References((*references(model, filters), Reference("fit", minimise.SOURCE)))
    listed = [{"what": entry.what, "source": entry.source} for entry in sources]
    text = entries(sources, __version__, sampled=sampled) if bibtex else repr(sources)
    return Outcome(sources, listed, text)
