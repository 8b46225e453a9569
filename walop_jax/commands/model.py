"""`walop-jax model`: the model as a file to look at and to change."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Outcome, PathLike, command, given, several, typed, write_text
from walop_jax.commands.inputs import set_of
from walop_jax.commands.products import Effects, InstrumentLike, catalogue_of, design_of
from walop_jax.io.display import Display, Displayed

if TYPE_CHECKING:
    from walop_jax import CalibrationSet, Model


@dataclasses.dataclass(frozen=True, repr=False)
class ModelFile(Displayed):
    """A model, its TOML text, and the file that it was written to (None: to no file)."""

    model: Model
    text: str
    path: Path | None

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        keys, model = ("start", "unit", "prior", "free", "tie", "about"), self.model
        document = {"instrument": model.name, "effects": list(model.effect_names)}
        document |= {"output": None if self.path is None else str(self.path)}
        return document | {"parameters": {p.name: {k: getattr(p, k) for k in keys} for p in model.parameters}}

    def display(self) -> Display:
        """Its file and its size."""
        where = self.model.name if self.path is None else self.path
        parameters, free = len(self.model.parameters), len(self.model.free)
        return Display(f"{where}: {parameters} parameters, {free} of them free")


@command(writes="file")
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
    from walop_jax.fit.base_model import model_for
    from walop_jax.fit.model_file import effects_text, model_without_data, render
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
    options = given(instrument=instrument, effects=effects, elements=job.elements)
    refit = typed("refit", *several(calsets), *options, "--model", output, "-o", "RUN")
    model_file = ModelFile(base, text, None if output is None else Path(output))
    return Outcome(model_file, text=text if output is None else None, next=(refit,) if calsets else ())
