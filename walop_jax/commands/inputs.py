"""Arguments that several commands take, on the command line and in Python, and their readers.

Sets, models, calibrations and tables may be given in memory or as files; `read` reads whatever the program has written.
Anything else is a TypeError with advice.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, TypeAlias

from walop_jax.commands.command import PathLike, UsageError, several
from walop_jax.commands.products import Effects, InstrumentLike, catalogue_of, design_of, path_of
from walop_jax.io.errors import DataError, errors_naming, fail
from walop_jax.io.folder import output_folder
from walop_jax.io.names import CLIPPED, DOCUMENTS, FAILED, PRODUCT, SUMMARY
from walop_jax.io.text import json_text, read_text

if TYPE_CHECKING:
    from walop_jax import Calibration, CalibrationSet, FitResult, Instrument, Model, Run
    from walop_jax.io.display import Display
    from walop_jax.science.field_accuracy import FieldAccuracy

Sets: TypeAlias = "CalibrationSet | PathLike | Sequence[PathLike]"
ModelLike: TypeAlias = "Model | PathLike | None"


def read(
    *paths: PathLike,
    kinds: Collection[str] = (),
    cells: int | None = None,
    effects: Effects = None,
    elements: PathLike | Sequence[type] | None = None,
) -> CalibrationSet | Calibration | Run:
    """Read calibration sets (several become one), a calibration product, or the folder of a run.

    Whole frames become field points, `cells` along their longer side (default: 80), which `write_calibration_set`
    writes as a set of their own. `kinds` are kinds of exposures beyond those of the format, `effects` and `elements`
    effects and kinds of elements of your own that a fitted model may have, or the file that defines them.

    Raises `DataError`, naming file, extension, column and row, for what cannot be read or trusted.

    >>> walop.read("night.fits").instrument
    'WALOP-SOUTH'
    """
    from walop_jax import Run
    from walop_jax.calibration.product import read_calibration
    from walop_jax.data.calset import read_calibration_set
    from walop_jax.io.fits_reading import primary_keywords
    from walop_jax.model.elements.registry import load_elements

    if elements is not None:
        load_elements(elements)
    if not paths:
        raise fail("no file was given", advice="name a calibration set, a calibration product or a run")
    first = path_of(paths[0], "a file", "the path of a set, a product or a run")
    if len(paths) == 1 and first.is_dir():
        if not any((first / name).exists() for name in (*DOCUMENTS.values(), PRODUCT)):
            what = f"holds no results{', its fit did not converge' if (first / FAILED).exists() else ''}"
            raise fail(what, file=first, advice="give the RUN of a command, or a FITS file")
        return Run(first, catalogue_of(effects))
    if len(paths) == 1 and "PRODVERS" in primary_keywords(first):
        return read_calibration(first, catalogue_of(effects))
    return read_calibration_set(*paths, kinds=kinds, cells=cells)


def paths_of(data: Sets) -> tuple[PathLike, ...]:
    """The files of calibration sets; ValueError for a set that comes from none."""
    from walop_jax import CalibrationSet

    if isinstance(data, CalibrationSet):
        paths = tuple(entry.path for entry in data.inputs)
        if not paths:
            raise ValueError("a run is made from files: write the set first, walop_jax.write_calibration_set")
        return paths
    paths = several(data)
    for path in paths:
        path_of(path, "a calibration set", "a set, the path of one (FITS), or several paths in a list")
    return tuple(paths)


def set_of(data: Sets, instrument: Instrument | None = None, cells: int | None = None) -> CalibrationSet:
    """A checked set: files are checked as they are read, tables in memory here; `cells` as for `read`."""
    from walop_jax import CalibrationSet
    from walop_jax.data.calset import checked, read_calibration_set
    from walop_jax.data.kinds import KINDS
    from walop_jax.data.table_intensities import TableIntensities

    if not isinstance(data, CalibrationSet):
        kinds = () if instrument is None else instrument.kinds
        return read_calibration_set(*paths_of(data), kinds=kinds, cells=cells)
    if data.inputs or not isinstance(data.intensities, TableIntensities):
        return data
    return checked(data, set(data.exposures.kind.tolist()) - set(KINDS))


def set_and_model(
    data: Sets,
    model: ModelLike,
    instrument: InstrumentLike,
    effects: Effects = None,
    *,
    output: PathLike | None = None,
    cells: int | None = None,
) -> tuple[CalibrationSet, Model]:
    """Calibration sets joined into one, and the model to fit to it.

    `model` is a model, or a model file (None: the base model); `instrument` the instrument as designed, or its name or
    description file (None: the instrument of the sets); `effects` are those that a model file may name; `cells` as for
    `read`. With `output` the folder of a run is written: it must then be made from files, so that it can be made again.

    Raises `DataError` for files that cannot be read, ValueError, naming the file, for a model that does not fit.
    """
    from walop_jax import Instrument, Model
    from walop_jax.fit.model_of_set import model_for

    text = ""
    if model is not None and not isinstance(model, Model):
        text = read_text(path_of(model, "a model", "base_model(calset), or the path of a model file"))
    if output is not None:
        if isinstance(model, Model) or isinstance(instrument, Instrument):
            raise ValueError("with output, give model and instrument as files: then it can be made again")
        paths_of(data)
    design = design_of(instrument)
    calset = set_of(data, design, cells)
    if output is not None and design is not None and not design.cameras.pairs:
        what = f"{design.name}: no arm has two cameras, so there is no instrument matrix and no calibration to write"
        raise DataError(f"{what}; fit it in Python, without output")
    if isinstance(model, Model):
        catalogue = model.catalogue if effects is None else catalogue_of(effects)
        return calset, dataclasses.replace(model, catalogue=catalogue)
    with errors_naming(model):  # a path, or None
        return calset, model_for(calset, text, design, catalogue_of(effects))


def save(
    result: FitResult | Calibration | Run, folder: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write a fit as the folder of a run, a calibration as its file alone. Raises `DataError` where they exist."""
    from walop_jax import Calibration, FitResult, Run
    from walop_jax.calibration.product import write_calibration
    from walop_jax.calibration.summary import summary
    from walop_jax.science.field_accuracy import accuracy_of_fit

    held = result.calibration if isinstance(result, Run) else result
    if held is None:
        raise fail("holds no calibration", file=getattr(result, "folder", ""), advice="give a fit")
    product = Calibration.from_fit(held) if isinstance(held, FitResult) else held
    names = (PRODUCT, SUMMARY) if isinstance(held, FitResult) else (PRODUCT,)
    rows = held.clipped if isinstance(held, FitResult) else None
    names += (CLIPPED,) if rows is not None else ()
    drop = () if rows is not None else (CLIPPED,)
    with (
        output_folder(folder, names, overwrite=overwrite) as out,
        out.filled(names, drop) as temporary,
    ):
        write_calibration(temporary / PRODUCT, product)
        if isinstance(held, FitResult):
            accuracy = accuracy_of_fit(held)
            content = summary(held, seconds=held.seconds, accuracy=accuracy_document(accuracy))
            content["shown"] = shown_with_accuracy(held, accuracy).document()
            (temporary / SUMMARY).write_text(json_text(content), encoding="utf-8")
            if rows is not None:
                rows.write(temporary / CLIPPED, held.calset, held.model.template.cameras.names)


def shown_with_accuracy(result: FitResult, accuracy: FieldAccuracy | None) -> Display:
    """What is shown of a fit, headed by the verdict on it for stars and by how well stars are known with it."""
    from walop_jax.science.field_accuracy import verdict_of_fit

    shown = result.display()
    if result.verdict is None:
        return shown
    verdict = verdict_of_fit(result, accuracy)
    if accuracy is None:
        return verdict.on_top_of(shown)
    # The accuracy names the systematic errors that could hide, with their effect on stars.
    hidden = "" if result.hidden is None else result.hidden.in_words()
    notes = tuple(note for note in shown.notes if note != hidden)
    shown = dataclasses.replace(
        shown.without(["p of a star"]), facts=(*accuracy.facts(), *shown.facts), notes=notes
    )
    return verdict.on_top_of(shown)


def accuracy_document(accuracy: FieldAccuracy | None) -> dict[str, object] | None:
    """How well stars are known, as plain data; None where that is not known."""
    return None if accuracy is None else accuracy.document()


def goal_of(percent: float | None) -> float | None:
    """A goal as a fraction. Raises `UsageError` for one that no calibration can have."""
    if percent is not None and not 0.0 < percent <= 100.0:
        raise UsageError(f"{percent:g} % is no error of p; give a number above 0, in per cent", "goal")
    return None if percent is None else percent / 100.0
