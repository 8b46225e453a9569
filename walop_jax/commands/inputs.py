"""What was given as what: sets, models, calibrations and tables, in memory or in files."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.io.errors import errors_naming
from walop_jax.io.text import read_text

if TYPE_CHECKING:
    from walop_jax.calibration import Calibration
    from walop_jax.commands.options import Effects, InstrumentLike, ModelLike, PathLike, Product, Sets
    from walop_jax.data.records import CalibrationSet
    from walop_jax.data.user_tables import InputTable
    from walop_jax.model.effects import Effect
    from walop_jax.model.instrument import Instrument
    from walop_jax.model.specification import Model

GIGABYTE = 1e9
IN_MEMORY = "in memory"
"""In place of the path of a file."""

NOT_CARRIED_OVER = "not_carried_over"
"""Where results in JSON list the effects of a model that had to be left out."""


def catalogue_of(effects: Effects) -> tuple[type[Effect], ...]:
    """The effects that a model may have: those of the package, of the package and a file, or those given."""
    from walop_jax.model.effects.own import catalogue_with

    if effects is None or isinstance(effects, str | os.PathLike):
        return catalogue_with(effects)
    return tuple(effects)


def design_of(instrument: InstrumentLike) -> Instrument | None:
    """The instrument as designed: as given, or read; None if nothing was given."""
    from walop_jax.model.instrument import Instrument

    return Instrument.read(instrument) if isinstance(instrument, str | os.PathLike) else instrument


def paths_of(data: Sets) -> tuple[PathLike, ...]:
    """The files of calibration sets; ValueError for a set that comes from none."""
    from walop_jax.data.records import CalibrationSet

    if isinstance(data, CalibrationSet):
        paths = tuple(entry.path for entry in data.inputs)
        if not paths:
            raise ValueError("a run is made from files: write the set first, walop_jax.write_calibration_set")
        return paths
    return (data,) if isinstance(data, str | os.PathLike) else tuple(data)


def set_of(data: Sets, instrument: Instrument | None = None) -> CalibrationSet:
    """A checked set: files are checked as they are read, tables in memory here."""
    from walop_jax.data import read_calibration_set
    from walop_jax.data.from_arrays import checked
    from walop_jax.data.records import KINDS, CalibrationSet
    from walop_jax.data.table_intensities import TableIntensities

    if not isinstance(data, CalibrationSet):
        return read_calibration_set(*paths_of(data), kinds=() if instrument is None else instrument.kinds)
    if data.inputs or not isinstance(data.intensities, TableIntensities):
        return data
    return checked(data, set(data.exposures.kind.tolist()) - set(KINDS))


def set_and_model(
    data: Sets,
    model: ModelLike,
    instrument: InstrumentLike,
    catalogue: Sequence[type[Effect]],
    *,
    output: PathLike | None = None,
) -> tuple[CalibrationSet, Model]:
    """Calibration sets as one, and the model to fit to them.

    `model` is one, or a model file (None: the base model); `instrument` as designed, or its name or description file
    (None: what the sets say); `catalogue` are the effects that a model file may name. With `output` the folder of a
    run is written: it is made from files, so that it can be made again.

    Raises `DataError` for files that cannot be read, ValueError, naming the file, for a model that does not fit.
    """
    from walop_jax.fit.model_file import model_for
    from walop_jax.model.instrument import Instrument
    from walop_jax.model.specification import Model

    text = read_text(model) if isinstance(model, str | os.PathLike) else ""
    if output is not None:
        if isinstance(model, Model) or isinstance(instrument, Instrument):
            raise ValueError(
                "with output, give model and instrument as files, so that the run can be made again"
            )
        paths_of(data)
    design = design_of(instrument)
    calset = set_of(data, design)
    if isinstance(model, Model):
        return calset, model
    with errors_naming(model):
        return calset, model_for(calset, text, design, catalogue)


def calibration_of(given: Product, catalogue: Sequence[type[Effect]]) -> Calibration:
    """A calibration: as given, that of a fit, or that of a product or run, with what its file says.

    Raises `DataError` for a file that cannot be read.
    """
    from walop_jax.calibration import Calibration, read_calibration
    from walop_jax.commands.reading import Run
    from walop_jax.fit.refit import FitResult

    if isinstance(given, Calibration | FitResult):
        there = given if isinstance(given, Calibration) else Calibration.from_fit(given)
        return there if there.path is not None else dataclasses.replace(there, path=Path(IN_MEMORY))
    return read_calibration(given.folder if isinstance(given, Run) else given, catalogue)


def table_of(given: Any, columns: dict[str, Any]) -> InputTable:
    """A table: a file of one, an astropy table, or columns by name; with `columns` added."""
    from walop_jax.data.user_tables import in_memory, read_input_table

    if isinstance(given, str | os.PathLike):
        return read_input_table(given)
    if columns:
        given = {str(k): given[k] for k in getattr(given, "colnames", given)}
        given |= {name.upper(): values for name, values in columns.items()}
    return in_memory(given)


def in_bytes(memory: float | None) -> float | None:
    """Memory in bytes, of what is given in GB; numbers from a million on are bytes already."""
    return memory if memory is None or memory >= 1e6 else memory * GIGABYTE


def left_out_sentences(names: Sequence[str], source: PathLike | None = None) -> tuple[str, ...]:
    """A sentence for every effect that cannot be carried over; `source` is the file that the model comes from."""
    where = "" if source is None else f"{os.fspath(source)}: "
    return tuple(
        f"{where}{name} acts on single exposures of the calibration, which cannot be carried over; it is left out"
        for name in names
    )


def left_out_cards(names: Sequence[str]) -> dict[str, str]:
    """The card NOTCARR of a table, which lists the effects that cannot be carried over; none where all are in it."""
    from walop_jax.io.text import in_ascii

    return {"NOTCARR": in_ascii(", ".join(names))} if names else {}
