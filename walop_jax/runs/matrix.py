"""The instrument matrix of a calibration at the field points of a table, from file to file."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from walop_jax.calibration.from_file import read_calibration
from walop_jax.calibration.matrix_table import matrix_columns, provenance
from walop_jax.data.field_points import field_points
from walop_jax.data.user_tables import read_input_table, table_format, write_output_table
from walop_jax.fit.verdict import Quality
from walop_jax.io.atomic import check_output
from walop_jax.io.errors import errors_naming
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.posterior import with_draws
from walop_jax.runs.left_out import left_out_cards, left_out_sentences
from walop_jax.runs.written_table import WrittenTable

BITS = (Quality.HIGH_CROSSTALK, Quality.BEYOND_FIELD, Quality.BEYOND_SETTINGS)
"""Bits of FLAG that a row of a table of matrices can have."""


def tabulate_matrix(
    product: str | os.PathLike[str],
    points: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    posterior: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> WrittenTable:
    """Add M21, M22, …, their errors and FLAG to the table `points`, and write it as `output`.

    `product` is a calibration product or the folder of a run; with `posterior` (a `posterior.nc`) values and errors
    are those of its draws. `catalogue` are the effects that a model may have. `progress` is told what is being
    done. Raises `DataError` for files that cannot be read or written, for columns and cells that cannot be meant,
    and for a filter that nobody knows.
    """
    table_format(output)
    check_output(output, overwrite=overwrite)
    held = read_calibration(product, catalogue)
    table = read_input_table(points)
    instrument = held.calibration.model.template.patched()
    wanted = field_points(table, instrument, held.calibration.always_in)
    if progress is not None:
        progress("working out the matrix")
    calibration = held.calibration if posterior is None else with_draws(held.calibration, posterior)
    with errors_naming(points):
        columns = matrix_columns(calibration, wanted.x, wanted.y, wanted.settings, wanted.outside)
    lost = calibration.left_behind
    content = held.product.content_hash()
    cards = provenance(content, calibration, drawn=posterior is not None) | left_out_cards(lost)
    write_output_table(output, table, columns, overwrite=overwrite, header=cards)

    flag = columns["FLAG"][0]
    counts = {bit: int((flag & bit > 0).sum()) for bit in BITS}
    warnings = [*held.warnings, *left_out_sentences(lost, held.path)]
    said = {
        Quality.BEYOND_FIELD: "point(s) beyond the calibrated field: extrapolated, or NaN",
        Quality.BEYOND_SETTINGS: "row(s) with a filter or temperature not in the calibration",
    }
    warnings += [
        f"{points}: {counts[bit]} {text} (FLAG {bit:d})" for bit, text in said.items() if counts[bit]
    ]
    return WrittenTable(
        path=Path(output),
        rows=table.rows,
        trusted=held.product.verdict.trusted,
        flags=counts,
        product=content,
        not_carried_over=lost,
        warnings=tuple(warnings),
    )
