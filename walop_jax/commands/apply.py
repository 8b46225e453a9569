"""`walop-jax apply`: a science catalogue of intensities in, Stokes parameters with errors out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

from walop_jax.commands.command import Argument, Job, Option, Outcome, UsageError, command
from walop_jax.commands.inputs import (
    NOT_CARRIED_OVER,
    calibration_of,
    catalogue_of,
    left_out_cards,
    left_out_sentences,
    table_of,
)
from walop_jax.commands.options import Effects, Posterior, Product, TableFile
from walop_jax.io.errors import errors_naming

CATALOGUE = Argument("FITS, CSV or ECSV with X, Y, N, N_ERR.", "CATALOGUE", Path)
DEBIAS = Option("Estimator of P_DEBIASED: Plaszczynski et al. 2014, or Wardle and Kronberg 1974.", "MAS|WK")
SATURATION = Option("Counts from here on are not used (FLAG 256).", "ELECTRONS", float)
FORCE = Option("Also stars whose filter or temperature it does not cover (FLAG 2048).")


@command(stages=("reading", "tabulating", "writing"), writes="file")
def apply(
    job: Job,
    calibration: Product,
    catalogue: Annotated[Any, CATALOGUE],
    *,
    output: TableFile = None,
    debias: Annotated[str, DEBIAS] = "MAS",
    saturation: Annotated[float | None, SATURATION] = None,
    posterior: Posterior = None,
    effects: Effects = None,
    force: Annotated[bool, FORCE] = False,
) -> Outcome[Any]:
    """Turn the intensities of stars into Stokes parameters: Q, U, P, EVPA and their errors.

    X and Y in degrees, N and N_ERR (one value per camera) in electrons; optional ID, TEFF, ROTATOR, N_FLAG,
    FILTER, TEMP, HA, and CHWP_ANGLE, CHWP_IN or those of any other moving element. Rows of one ID (and filter)
    are one star: they are combined, wherever the moving elements stand, and all hold the same result. With
    ROTATOR the results are on the sky. Two cameras see one combination of q and u: a star needs several settings.

    Errors hold photon noise and calibration; Q_COLOUR and U_COLOUR say what ignoring TEFF does. FLAG: 16 a
    direction of (q, u) is hardly measured, 32 beyond the calibrated field (no result a quarter beyond), 64
    filter, temperature or colour that the calibration has not seen, 128 a camera is missing, 256 flagged or
    saturated counts, 2048 used with --force, 16384 no result, 131072 intensities that disagree with the
    calibration by more than noise and half a per cent; bits of the calibration itself are added to all rows.

    In Python: an astropy table; `catalogue` is a path, an astropy table, or columns by name.
    """
    from walop_jax.data.catalogue import read_catalogue
    from walop_jax.data.user_tables import extended, table_format, write_output_table
    from walop_jax.fit.verdict import Quality
    from walop_jax.posterior import with_moments
    from walop_jax.science.apply import apply as apply_to_rows
    from walop_jax.science.polarisation import ESTIMATORS
    from walop_jax.science.stokes_columns import header, stokes_columns

    if debias not in ESTIMATORS:
        raise UsageError(f"{debias!r} is neither {' nor '.join(ESTIMATORS)}", "debias")
    if saturation is not None and not saturation > 0:
        raise UsageError(f"{saturation} must be above 0 electrons", "saturation")
    if output is not None:
        table_format(output)
    job.tell("reading", "reading")
    held = calibration_of(calibration, catalogue_of(effects))
    table = table_of(catalogue, {})
    instrument = held.model.template.patched()
    limit = math.inf if saturation is None else saturation
    rows = read_catalogue(table, instrument, limit, always_in=held.always_in)

    job.tell("tabulating the analysis vectors", "tabulating")
    used = held if posterior is None else with_moments(held, posterior)
    with errors_naming(table.path):
        stars = apply_to_rows(
            used, rows, lambda done, total: job.tell(f"{done} of {total} rows"), force=force
        )
    job.tell("writing", "writing")
    columns = stokes_columns(stars, rows.star, debias)
    lost, content = used.left_behind, held.content_hash()
    on_the_sky = sum(map(math.isfinite, rows.rotator)) / max(len(rows.rotator), 1)
    cards = header(content, debias, on_the_sky, stars.check) | left_out_cards(lost)
    if output is not None:
        write_output_table(output, table, columns, overwrite=job.overwrite, header=cards)

    bits = (
        Quality.HIGH_CROSSTALK,
        Quality.BEYOND_FIELD,
        Quality.BEYOND_SETTINGS,
        Quality.CAMERA_MISSING,
        Quality.SATURATED,
        Quality.VALIDITY_FORCED,
        Quality.NO_STOKES,
        Quality.DISAGREES,
        Quality.UNKNOWN_COLOUR,
    )
    counts = {bit: int((stars.flag & bit > 0).sum()) for bit in bits}
    said = {
        Quality.NO_STOKES: "star(s) without a result (FLAG 16384)",
        Quality.BEYOND_FIELD: "star(s) beyond the calibrated field: extrapolated, or NaN (FLAG 32)",
        Quality.BEYOND_SETTINGS: "star(s) with a filter, temperature or TEFF beyond the calibration",
        Quality.DISAGREES: "star(s) whose intensities disagree with the calibration (FLAG 131072, CHI2): is "
        "the background subtracted, are the cameras in order?",
    }
    seconds = job.seconds
    return Outcome(
        extended(table, columns, cards),
        lambda: {
            "output": None if output is None else str(output),
            "rows": table.rows,
            "trusted": held.verdict.trusted,
            "flags": {str(int(bit)): count for bit, count in counts.items()},
            "product": content,
            NOT_CARRIED_OVER: list(lost),
            "stars": len(stars.qu),
            "seconds": seconds,
            "estimator": debias,
            "catalogue": stars.check.document(),
        },
        lambda: f"{output}: {table.rows} rows, {len(stars.qu)} stars, {seconds:.1f} s",
        warnings=(
            *held.warnings,
            *left_out_sentences(lost, held.path),
            *(f"{table.path}: {text} (FLAG {Quality.CATALOGUE:d})" for text in stars.check.warnings()),
            *(f"{table.path}: {counts[bit]} {text}" for bit, text in said.items() if counts[bit]),
        ),
    )
