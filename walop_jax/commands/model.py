"""`walop-jax model`: the model as a file to look at and to change."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.commands.command import (
    Job,
    Option,
    Outcome,
    PathLike,
    command,
    given,
    several,
    typed,
    write_text,
)
from walop_jax.commands.inputs import set_of
from walop_jax.commands.products import Effects, InstrumentLike, catalogue_of, design_of

if TYPE_CHECKING:
    from walop_jax import CalibrationSet
    from walop_jax.fit.model_of_set import ModelFile


OPTIONS = {
    "calsets": Option(
        "Calibration sets that the model is for: standards, gauges.",
        metavar="[CALSET...]",
        kind=list[Path],
        placed=True,
    ),
    "output": Option("File to write; default: stdout.", metavar="MODEL.toml", kind=Path, short="-o"),
    "effect": Option("Add an effect; may be repeated.", metavar="NAME", kind=list[str]),
}


@command(writes="file", options=OPTIONS)
def model(
    job: Job,
    calsets: CalibrationSet | PathLike | Sequence[PathLike] | None = None,
    *,
    output: PathLike | None = None,
    instrument: InstrumentLike = None,
    effect: Sequence[str] | None = None,
    effects: Effects = None,
) -> Outcome[ModelFile]:
    """Write the base model as a file: every parameter with unit, start, prior, free or not.

    With calibration sets, the model that `refit` would fit to them. Change the file and give it to `refit --model`.

    In Python: a `ModelFile`, whose `model` is the model and `text` the file. Raises ValueError, with the nearest names,
    for an unknown instrument or effect, and for an instrument that is not the sets'.

    >>> text = walop.model(instrument="WALOP-NORTH")  # doctest: +SKIP
    """
    from walop_jax.fit.model_file import effects_text, model_without_data, render
    from walop_jax.fit.model_of_set import ModelFile, model_for
    from walop_jax.model.instrument import nominal_instrument

    catalogue = catalogue_of(effects)
    changes = effects_text(effect or ())
    design = design_of(instrument)
    if calsets:
        base = model_for(set_of(calsets, design), changes, design, catalogue)
    else:
        base = model_without_data(design or nominal_instrument(), changes, catalogue=catalogue)
    text = render(base)
    if output is not None:
        write_text(output, text, overwrite=job.overwrite)
    options = given(instrument=instrument, effects=effects)
    refit = typed("refit", *several(calsets), *options, "--model", output, "-o", "RUN")
    model_file = ModelFile(base, text, None if output is None else Path(output))
    text = text if output is None else model_file.display().title
    return Outcome(model_file, text=text, next=(refit,) if calsets else ())
