"""Tables of results that did not start as a table of the user.

Columns with unit and description, FITS or ECSV.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping

import numpy as np
from astropy.table import Column as AstropyColumn
from astropy.table import Table

from walop_jax.data.atomic import atomic_path
from walop_jax.data.errors import fail
from walop_jax.data.tables import table_format


def write_columns(
    path: str | os.PathLike[str],
    columns: Mapping[str, tuple[np.ndarray, str, str]],
    notes: Mapping[str, str | int | float | bool] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write columns given as (values, unit, description), with notes in the header; whole or not at all.

    The format follows the name. Raises `DataError` as `atomic_path` does, and for an unknown extension.
    """
    kind = table_format(path)
    table = Table(
        [
            AstropyColumn(values, name=name, unit=unit or None, description=about)
            for name, (values, unit, about) in columns.items()
        ],
        meta=dict(notes or {}),
    )
    with atomic_path(path, overwrite=overwrite) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            table.write(temporary, format=kind, overwrite=True)
        except ValueError as error:
            raise fail(f"cannot be written: {error}", file=path, advice="try .ecsv") from error
