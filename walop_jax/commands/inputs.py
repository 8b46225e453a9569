"""Arguments that several commands take, on the command line and in Python, and their readers.

Sets, models, calibrations and tables may be given in memory or as files; `read` reads whatever the program has written.
Anything else is a TypeError with advice.
"""

from __future__ import annotations

import dataclasses
import os
import reprlib
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

from walop_jax.commands.command import Argument, Job, Option, Outcome, PathLike, UsageError
from walop_jax.io.errors import DataError, errors_naming, fail
from walop_jax.io.text import in_ascii, read_text

if TYPE_CHECKING:
    from walop_jax import Calibration, CalibrationSet, FitResult, Instrument, Model, Run
    from walop_jax.data.user_tables import InputTable
    from walop_jax.fit.verdict import Quality
    from walop_jax.model.effects import EffectKind
    from walop_jax.posterior.result import PosteriorSample


class Diagnosed(Protocol):
    """A result with a last fit: a diagnosis."""

    @property
    def after(self) -> FitResult:
        """That fit, of which the calibration is that of the diagnosis."""
        ...


GIGABYTE = 1e9
IN_MEMORY = "in memory"
"""In place of the path of a file."""

NOT_CARRIED_OVER = "not_carried_over"
"""Key under which results in JSON list the effects of a model that had to be left out."""

# --------------------------------------------------------------------------------------------------- options

TEFF = Option("Colour temperature (K); without it, a flat spectrum.", kind=float)
FILTER = Option("Filter of the calibration, or SDSS-r.", kind=str)
SETS = Argument("Calibration sets (FITS), fitted as one.", metavar="CALSET...", kind=list[Path])
EFFECTS = Option(
    "Effects of your own beside those of the catalogue; see walop-jax docs adding-an-effect.",
    "FILE.toml|.py",
    Path,
)

Sets = Annotated["CalibrationSet | PathLike | Sequence[PathLike]", SETS]
ModelLike = Annotated[
    "Model | PathLike | None",
    Option("Model file: parameters free, tied, held; effects added.", "MODEL.toml", Path),
]
InstrumentLike = Annotated[
    "Instrument | PathLike | None",
    Option(
        "An instrument that comes with the package, or a description file; see walop-jax instrument.",
        "NAME|FILE.toml",
        str,
    ),
]
Effects = Annotated["PathLike | Sequence[EffectKind] | None", EFFECTS]
Product = Annotated[
    "Calibration | FitResult | Diagnosed | Run | PathLike",
    Argument("Calibration product, or the folder of a run.", "RUN/calibration.fits", Path),
]
OptionalProduct = Annotated["Calibration | FitResult | Diagnosed | Run | PathLike | None", None]
"""Of commands that do without one; each adds its own option."""
DataOf = Annotated[
    "Sequence[PathLike] | None",
    Option("Calibration set of the fit, if it has moved; again for each.", "CALSET", list[Path]),
]
Posterior = Annotated[
    "PosteriorSample | Any | PathLike | None",
    Option("Use draws of walop-jax sample, not the covariance.", "posterior.nc", Path),
]
Angles = Annotated[
    "Mapping[str, float] | Sequence[str] | None",
    Option(
        "Angle (deg) of a moving element in the beam, named like its columns: CHWP=45. May be repeated.",
        "P=ANGLE",
        list[str],
    ),
]
Goal = Annotated[
    "float | None",
    Option("Error of p of a star that is wanted, in per cent (default: 0.1).", "PERCENT", float, least=0.0),
]
Memory = Annotated["float | None", Option("Memory for the data, in GB.", "GB", float, least=0.1)]

Folder = Annotated["PathLike | None", Option("Folder of the results.", "RUN", Path, "-o", required=True)]
SetFile = Annotated[
    "PathLike | None", Option("Calibration set to write (FITS).", "SET.fits", Path, "-o", required=True)
]
TableFile = Annotated[
    "PathLike | None", Option("Table to write (.fits, .csv, .ecsv).", "OUT", Path, "-o", required=True)
]


# ---------------------------------------------------------------------------------------------------- reading


def read(
    *paths: PathLike,
    kinds: Collection[str] = (),
    effects: Effects = None,
    elements: PathLike | Sequence[type] | None = None,
) -> CalibrationSet | Calibration | Run:
    """Read calibration sets (several become one), a calibration product, or the folder of a run.

    `kinds` are kinds of exposures beyond those of the format, `effects` and `elements` effects and kinds of elements of
    your own that a fitted model may have, or the file that defines them.
    Raises `DataError`, naming file, extension, column and row, for what cannot be read or trusted.

    >>> walop.read("night.fits").instrument
    'WALOP-SOUTH'
    """
    from walop_jax import Run
    from walop_jax.calibration.product import read_calibration
    from walop_jax.data.calset import read_calibration_set
    from walop_jax.io.fits_reading import primary_keywords
    from walop_jax.io.names import DOCUMENTS, FAILED, PRODUCT
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
    return read_calibration_set(*paths, kinds=kinds)


def catalogue_of(effects: Effects) -> tuple[EffectKind, ...]:
    """The effects that a model may have: those of the package, of the package and a file, or those given."""
    from walop_jax.model.effects.catalogue import catalogue_with

    if effects is None or isinstance(effects, str | os.PathLike):
        return catalogue_with(effects)
    return tuple(effects)


def path_of(given: Any, what: str, advice: str) -> Path:
    """A path. Raises TypeError, with `advice`, for anything else in place of `what`."""
    if not isinstance(given, str | os.PathLike):
        raise TypeError(f"{reprlib.repr(given)} is not {what}; give {advice}")
    return Path(given)


def design_of(instrument: InstrumentLike) -> Instrument | None:
    """The instrument as designed: as given, or read, also from a run or a product; None if nothing was given."""
    from walop_jax import Instrument
    from walop_jax.model.elements.registry import defined_elements

    if instrument is None or isinstance(instrument, Instrument):
        return instrument
    path = path_of(instrument, "an instrument", "its name, its description file, or an Instrument")
    if path.is_dir() or path.suffix == ".fits":
        return calibration_of(path).design
    return Instrument.read(instrument, elements=defined_elements())


def paths_of(data: Sets) -> tuple[PathLike, ...]:
    """The files of calibration sets; ValueError for a set that comes from none."""
    from walop_jax import CalibrationSet

    if isinstance(data, CalibrationSet):
        paths = tuple(entry.path for entry in data.inputs)
        if not paths:
            raise ValueError("a run is made from files: write the set first, walop_jax.write_calibration_set")
        return paths
    candidates: Any = data if isinstance(data, list | tuple) else (data,)
    advice = "a set, the path of one (FITS), or several paths in a list"
    for candidate in candidates:
        path_of(candidate, "a calibration set", advice)
    return tuple(candidates)


def set_of(data: Sets, instrument: Instrument | None = None) -> CalibrationSet:
    """A checked set: files are checked as they are read, tables in memory here."""
    from walop_jax import CalibrationSet
    from walop_jax.data.calset import checked, read_calibration_set
    from walop_jax.data.kinds import KINDS
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
    effects: Effects = None,
    *,
    output: PathLike | None = None,
) -> tuple[CalibrationSet, Model]:
    """Calibration sets as one, and the model to fit to them.

    `model` is one, or a model file (None: the base model); `instrument` as designed, or its name or description file
    (None: that of the sets); `effects` are those that a model file may name. With `output` the folder of a
    run is written: it is made from files, so that it can be made again.

    Raises `DataError` for files that cannot be read, ValueError, naming the file, for a model that does not fit.
    """
    from walop_jax import Instrument, Model
    from walop_jax.fit.model_file import model_for

    text = ""
    if model is not None and not isinstance(model, Model):
        text = read_text(path_of(model, "a model", "base_model(calset), or the path of a model file"))
    if output is not None:
        if isinstance(model, Model) or isinstance(instrument, Instrument):
            raise ValueError(
                "with output, give model and instrument as files, so that the run can be made again"
            )
        paths_of(data)
    design = design_of(instrument)
    calset = set_of(data, design)
    if output is not None and design is not None and not design.cameras.pairs:
        raise DataError(
            f"{design.name}: no arm has two cameras, so there is no instrument matrix and no calibration to write; "
            "fit it in Python, without output"
        )
    if isinstance(model, Model):
        catalogue = model.catalogue if effects is None else catalogue_of(effects)
        return calset, dataclasses.replace(model, catalogue=catalogue)
    with errors_naming(model):  # a path, or None
        return calset, model_for(calset, text, design, catalogue_of(effects))


def fit_of(given: Any) -> Any:
    """The last fit of a diagnosis, whose calibration is that of the diagnosis; anything else as it is."""
    from walop_jax import FitResult

    after = getattr(given, "after", None)
    return after if isinstance(after, FitResult) else given


def calibration_of(given: Product, effects: Effects = None) -> Calibration:
    """A calibration: as given, that of a fit or a diagnosis, or that of a product or run, with what its file says.

    Raises `DataError` for a file that cannot be read.
    """
    from walop_jax import Calibration, FitResult
    from walop_jax.calibration.product import read_calibration

    held: Any = fit_of(given)
    if isinstance(held, Calibration | FitResult):
        result = held if isinstance(held, Calibration) else Calibration.from_fit(held)
        return result if result.path is not None else dataclasses.replace(result, path=Path(IN_MEMORY))
    return read_calibration(folder_of(held), catalogue_of(effects))


def save(
    result: FitResult | Calibration | Run, folder: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write a fit as the folder of a run: calibration.fits and summary.json; of a calibration the first alone.

    Raises `DataError` where they exist already and `overwrite` is False.
    """
    from walop_jax import Calibration, FitResult, Run
    from walop_jax.calibration.product import write_calibration
    from walop_jax.calibration.summary import summary
    from walop_jax.io.errors import fail
    from walop_jax.io.folder import output_folder
    from walop_jax.io.names import PRODUCT, SUMMARY
    from walop_jax.io.text import json_text

    held = result.calibration if isinstance(result, Run) else result
    if held is None:
        raise fail("holds no calibration", file=getattr(result, "folder", ""), advice="give a fit")
    product = Calibration.from_fit(held) if isinstance(held, FitResult) else held
    names = (PRODUCT, SUMMARY) if isinstance(held, FitResult) else (PRODUCT,)
    with output_folder(folder, names, overwrite=overwrite) as out, out.filled() as temporary:
        write_calibration(temporary / PRODUCT, product)
        if isinstance(held, FitResult):
            content = summary(held, seconds=held.seconds) | {"shown": held.display().document()}
            (temporary / SUMMARY).write_text(json_text(content), encoding="utf-8")


def folder_of(run: Run | PathLike) -> Path:
    """The folder of a run, or whatever else a path names."""
    from walop_jax import Run

    if isinstance(run, Run):
        return run.folder
    return path_of(run, "a run or a calibration", "a fit, a Run, or the path of a folder or a product")


def angles_of(at: Mapping[str, float] | Sequence[str] | None) -> dict[str, float]:
    """Angles (deg) by column prefix, also of texts such as CHWP=45."""
    if isinstance(at, Mapping):
        return {name.upper(): value for name, value in at.items()}
    angles = {}
    for text in at or ():
        prefix, _, angle = text.partition("=")
        try:
            angles[prefix.strip().upper()] = float(angle)
        except ValueError:
            raise UsageError(f"{text!r} is no P=ANGLE, such as CHWP=45", "at") from None
    return angles


def goal_of(percent: float | None) -> float | None:
    """A goal as a fraction. Raises `UsageError` for one that no calibration can have."""
    if percent is not None and not 0.0 < percent <= 100.0:
        raise UsageError(f"{percent:g} % is no error of p; give a number above 0, in per cent", "goal")
    return None if percent is None else percent / 100.0


def table_of(given: Any, columns: Mapping[str, Any]) -> InputTable:
    """A table: a file of one, an astropy table, or columns by name; `columns` are added, or stand in place of its."""
    from walop_jax.data.user_tables import in_memory, read_input_table

    named = {name.upper(): values for name, values in columns.items()}
    if isinstance(given, Mapping):
        return in_memory({key: given[key] for key in given if str(key).upper() not in named} | named)
    read = read_input_table(given) if isinstance(given, str | os.PathLike) else in_memory(given)
    if not named:
        return read
    remaining = {key: read.table[key] for key in read.table.colnames if str(key).upper() not in named}
    table = in_memory(remaining | named, str(read.path))
    table.table.meta.update(read.table.meta)
    table.remarks.extend(read.remarks)
    return table


def several(given: Any) -> list[Any]:
    """Items that were given one by one or in a list."""
    return list(given) if isinstance(given, list | tuple) else [given]


def named_tables(given: Any) -> list[tuple[str, InputTable]]:
    """Tables, of files or in memory, with the names by which messages call them."""
    if not several(given):
        raise UsageError("give at least one table", "catalogues")
    return [
        (str(entry) if isinstance(entry, str | os.PathLike) else f"catalogue {number}", table_of(entry, {}))
        for number, entry in enumerate(several(given), start=1)
    ]


def left_out_sentences(names: Sequence[str], source: PathLike | None = None) -> tuple[str, ...]:
    """A sentence for every effect that cannot be carried over; `source` is the file that the model comes from."""
    where = "" if source is None else f"{os.fspath(source)}: "
    return tuple(
        f"{where}{name} acts on single exposures of the calibration, which cannot be carried over; it is left out"
        for name in names
    )


def left_out_cards(names: Sequence[str]) -> dict[str, str]:
    """The card NOTCARR of a table, which lists the effects that cannot be carried over; none where all are in it."""
    return {"NOTCARR": in_ascii(", ".join(names))} if names else {}


def table_outcome(
    job: Job,
    held: Calibration,
    table: InputTable,
    columns: Mapping[str, tuple[Any, ...]],
    cards: Mapping[str, Any],
    output: PathLike | None,
    *,
    counted: Mapping[Quality, str],
    warnings: Sequence[str] = (),
    extra: Mapping[str, Any] | None = None,
    remade: Callable[[Any], tuple[Any, Sequence[str]]] | None = None,
) -> Outcome[Any]:
    """A table with the columns of a calibration, written if it has an output.

    The bits of FLAG that are `counted` have a warning each, unless it is empty; `extra` goes into the document. Columns
    of the table that are not used or are replaced are named. `remade` makes another table of that, with remarks.
    """
    from walop_jax.data.user_tables import extended
    from walop_jax.io.plain_tables import write_table

    lost = held.left_behind
    result = extended(table, columns, {**cards, **left_out_cards(lost)})
    result, result_remarks = (result, ()) if remade is None else remade(result)
    if output is not None:
        write_table(output, result, overwrite=job.overwrite)
    counts = {bit: int((columns["FLAG"][0] & bit > 0).sum()) for bit in sorted(counted)}
    remarks = table.about(columns)
    document = {
        "output": output,
        "rows": table.rows,
        "trusted": held.verdict.trusted,
        "flags": {str(int(bit)): count for bit, count in counts.items()},
        "product": held.content_hash(),
        NOT_CARRIED_OVER: list(lost),
        "remarks": list(remarks),
        **(extra or {}),
    }
    about = (f"{counts[bit]} {sentence}" for bit, sentence in counted.items() if sentence and counts[bit])
    return Outcome(
        result,
        document,
        warnings=(
            *held.warnings,
            *left_out_sentences(lost, held.path),
            *(f"{table.path}: {sentence}" for sentence in (*remarks, *result_remarks, *warnings, *about)),
        ),
    )
