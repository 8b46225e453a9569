"""Calibration sets without what no model explains, from files to a file."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence

from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.write import write_calibration_set
from walop_jax.diagnosis.trust import examined
from walop_jax.fit.outliers import BEYOND, Clipped, clipped
from walop_jax.io.atomic import check_output
from walop_jax.io.errors import fail
from walop_jax.io.heartbeat import repeated
from walop_jax.io.text import read_text
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.runs.inputs import sets_and_model


def clip_sets(
    calsets: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    beyond: float = BEYOND,
    model: str | os.PathLike[str] | None = None,
    instrument: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> Clipped:
    """Write the sets as one, with FLAG 2 where an intensity lies `beyond` standard errors from a fit of the others.

    Arguments as for `refit_sets`. Raises `DataError` for files that cannot be read or written, for frames and for what
    was compressed, ValueError for a model file that does not fit and for `beyond` below `outliers.LEAST`, and what
    `fit` raises.
    """
    tell = progress or (lambda text: None)
    text = "" if model is None else read_text(model)
    check_output(output, overwrite=overwrite)
    tell("reading")
    calset, chosen = sets_and_model(calsets, text, model, instrument, catalogue)
    if not isinstance(calset.intensities, TableIntensities) or calset.compression is not None:
        raise fail(
            "cannot be clipped",
            file=calsets[0],
            advice="only tables of intensities can; of frames the reduction flags cosmic rays, in FLAG",
        )
    with repeated(tell) as say:
        say("fitting")
        found = clipped(calset, chosen, beyond)
        # Of too many rows the model lacks something: no need to ask what.
        result = found.result.judged() if found.too_many else examined(found.result, as_written=True)
        found = dataclasses.replace(found, result=result)
    tell("writing")
    write_calibration_set(output, found.calset, overwrite=overwrite)
    return found
