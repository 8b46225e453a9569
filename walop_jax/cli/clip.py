"""`walop-jax clip`: a calibration set with its outliers flagged."""

from __future__ import annotations

from typing import Annotated

import typer

from walop_jax.cli.common import (
    UNTRUSTED,
    CalsetFiles,
    EffectsOption,
    InstrumentOption,
    JsonOption,
    ModelOption,
    OutputSet,
    OverwriteOption,
    QuietOption,
    print_json,
    progress,
    switch_on_jax,
    warn,
)

STAGES = ("reading", "fitting", "writing")


def clip(
    calsets: CalsetFiles,
    output: OutputSet,
    sigma: Annotated[
        float,
        typer.Option(
            "--sigma", metavar="N", help="Standard errors beyond which a row is flagged, at least 3."
        ),
    ] = 5.0,
    model: ModelOption = None,
    instrument: InstrumentOption = None,
    effects: EffectsOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Flag single intensities that lie far from a fit of all others: cosmic rays, stars in a patch of sky.

    SET.fits holds the same rows, with FLAG 2 where a camera lies more than N standard errors off; flagged rows are not
    used by any command. The set is fitted anew until nothing lies off any more.

    What the model lacks lies off as well, but in many rows: if these are more than 5 %, or the fit of what is left is
    not to be trusted, the set is written with a warning, exit code 3. Look for the cause with walop-jax diagnose then,
    on the set as it was.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.clip import clip_sets

    with progress(quiet or json, STAGES) as tell:
        found = clip_sets(
            calsets,
            output,
            beyond=sigma,
            model=model,
            instrument=instrument,
            overwrite=overwrite,
            catalogue=catalogue_with(effects),
            progress=tell,
        )
    if json:
        print_json({"output": str(output), "sigma": sigma, "clipped": found.rows, "used": found.used})
    elif not quiet:
        ratio = found.result.chi2 / max(found.result.dof, 1)
        typer.echo(
            f"{found.rows} of {found.used} rows flagged ({100 * found.share:.2g} %), χ²/dof {ratio:.4f}: {output}"
        )
    if found.too_many:
        warn(
            f"{100 * found.share:.2g} % of the rows lie off: that is not single intensities but something that the "
            "model lacks; walop-jax diagnose looks for it"
        )
    for sentence in found.result.warnings:
        warn(f"the fit of what is left: {sentence}")
    if found.too_many or not found.result.trusted:
        raise typer.Exit(UNTRUSTED)
