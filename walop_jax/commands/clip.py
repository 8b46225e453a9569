"""`walop-jax clip`: a calibration set with its outliers flagged."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from walop_jax.commands.command import Job, Outcome, PathLike, command, given, several, typed
from walop_jax.commands.inputs import ModelLike, Sets, set_and_model
from walop_jax.commands.products import Effects, InstrumentLike
from walop_jax.io.errors import fail
from walop_jax.io.names import IN_MEMORY
from walop_jax.io.progress import Stage, repeated

if TYPE_CHECKING:
    from walop_jax.fit.outliers import Clipped


@command(stages=("reading", "fitting", "writing"), writes="file", random=True)
def clip(
    job: Job,
    data: Sets,
    *,
    output: PathLike | None = None,
    sigma: float = 5.0,
    model: ModelLike = None,
    instrument: InstrumentLike = None,
    effects: Effects = None,
) -> Outcome[Clipped]:
    """Flag single intensities that lie far from a fit of all others: cosmic rays, stars in a patch of sky.

    SET.fits holds the same rows, with FLAG 2 where a camera lies more than N standard errors off; flagged rows are not
    used by any command. The set is fitted anew until nothing lies off any more.

    Gaps of the model lie off as well, but in many rows: if these are more than 5 %, or the fit of the remaining rows is
    not to be trusted, the set is written with a warning, exit code 3. Look for the cause with walop-jax diagnose then,
    on the set as it was.

    In Python: the set (`calset`), the fit (`result`) and the number of `rows` that were flagged. Raises `DataError` for
    frames and for compressed sets, ValueError for `sigma` below 3.

    >>> flagged = walop.clip("night.fits")  # doctest: +SKIP
    """
    from walop_jax.data.table_intensities import TableIntensities
    from walop_jax.data.write import write_calibration_set
    from walop_jax.diagnosis.trust import examined
    from walop_jax.fit.outliers import clipped

    job.begin("reading")
    calset, chosen = set_and_model(data, model, instrument, effects)
    if not isinstance(calset.intensities, TableIntensities) or calset.compression is not None:
        where = calset.inputs[0].path if calset.inputs else IN_MEMORY
        advice = "only tables of intensities can; of frames the reduction flags cosmic rays, in FLAG"
        raise fail("cannot be clipped", file=where, advice=advice)
    with repeated(job.progress) as say:
        say(Stage("fitting", "fitting"))
        flagged = clipped(calset, chosen, sigma)
        # Of too many rows the model lacks something: no need to ask what.
        remaining = flagged.result
        result = remaining.judged() if flagged.too_many else examined(remaining, job.seed, as_written=True)
    job.begin("writing")
    if output is not None:
        write_calibration_set(output, flagged.calset, overwrite=job.overwrite)
    share = f"{100 * flagged.share:.2g} %"
    warnings = [f"the fit of the clipped set: {sentence}" for sentence in result.warnings]
    if flagged.too_many:
        text = f"{share} of the rows are outliers: too many to be isolated; the model lacks something"
        warnings.insert(0, f"{text}; walop-jax diagnose looks for it")
    ratio = result.chi2 / max(result.dof, 1)
    trusted = result.trusted and not flagged.too_many
    options = given(model=model, instrument=instrument, effects=effects, elements=job.elements)
    use, ask = ("refit", output), ("diagnose", *several(data))
    return Outcome(
        dataclasses.replace(flagged, result=result),
        {"output": str(output), "sigma": sigma, "clipped": flagged.rows, "used": flagged.used},
        f"{flagged.rows} of {flagged.used} rows flagged ({share}), χ²/dof {ratio:.4f}: {output}",
        warnings=warnings,
        trusted=trusted,
        next=(typed(*(use if trusted else ask), *options, "-o", "RUN"),),
    )
