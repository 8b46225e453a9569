"""Calibrations and instruments as arguments of commands.

A calibration may be given in memory, by its file or by the folder of a run. What is given in place of one of them is a
TypeError that names its type and the types wanted.
"""

from __future__ import annotations

import dataclasses
import os
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from walop_jax.commands.command import PathLike, UsageError
from walop_jax.fit.parameter_table import Fitted
from walop_jax.io.names import IN_MEMORY
from walop_jax.io.text import in_ascii

if TYPE_CHECKING:
    from walop_jax import Calibration, FitResult, Instrument, Run
    from walop_jax.diagnosis.findings import Diagnosis
    from walop_jax.model.effects import EffectKind
    from walop_jax.posterior.result import PosteriorSample


NOT_CARRIED_OVER = "not_carried_over"
"""Key under which results in JSON list the effects of a model that had to be left out."""

Effects: TypeAlias = "PathLike | Sequence[EffectKind] | None"
FitLike: TypeAlias = "FitResult | Diagnosis | Run | PathLike"
CalibrationLike: TypeAlias = "Calibration | FitResult | Diagnosis | Run | PathLike"
Posterior: TypeAlias = "PosteriorSample | Any | PathLike | None"
InstrumentLike: TypeAlias = "Instrument | PathLike | None"
Angles: TypeAlias = "Mapping[str, float] | Sequence[str] | None"


def catalogue_of(effects: Effects) -> tuple[EffectKind, ...]:
    """The effects that a model may have: those of the package, of the package and a file, or those given."""
    from walop_jax.model.effects.catalogue import catalogue_with

    if effects is None or isinstance(effects, str | os.PathLike):
        return catalogue_with(effects)
    return tuple(effects)


def path_of(given: Any, what: str, advice: str) -> Path:
    """A path. Raises TypeError for anything else, naming the argument `what`, with `advice`."""
    if not isinstance(given, str | os.PathLike):
        raise TypeError(f"{reprlib.repr(given)} is not {what}; give {advice}")
    return Path(given)


def fit_of(given: Any) -> Any:
    """The last fit of a diagnosis; anything else as it is.

    The calibration of that fit is the calibration of the diagnosis.
    """
    after = getattr(given, "after", None)
    return after if isinstance(after, Fitted) else given


def calibration_of(given: CalibrationLike, effects: Effects = None) -> Calibration:
    """A calibration as given, of a fit or a diagnosis, or read from a product or run (`DataError` if it cannot be)."""
    from walop_jax.calibration.calibration import Calibration
    from walop_jax.calibration.product import read_calibration

    source: Any = fit_of(given)
    if hasattr(source, "folder") or not isinstance(fit_of(given), Fitted):  # also the product of a Run
        return read_calibration(folder_of(source), catalogue_of(effects))
    calibration = source if isinstance(source, Calibration) else Calibration.from_fit(source)
    in_memory = calibration.path is None
    return dataclasses.replace(calibration, path=Path(IN_MEMORY)) if in_memory else calibration


def folder_of(run: Run | PathLike) -> Path:
    """The folder of a run, or whatever else a path names."""
    advice = "a fit, a Run, or the path of a folder or a product"
    return path_of(getattr(run, "folder", run), "a run or a calibration", advice)


def is_product(path: PathLike) -> bool:
    """True for the folder of a run, and for a file that can be a calibration by its name."""
    return Path(path).is_dir() or Path(path).suffix == ".fits"


def design_of(instrument: InstrumentLike) -> Instrument | None:
    """The instrument as designed: as given, or read, also from a run or a product; None if nothing was given."""
    from walop_jax import Instrument
    from walop_jax.model.elements.registry import defined_elements

    if instrument is None or isinstance(instrument, Instrument):
        return instrument
    path = path_of(instrument, "an instrument", "its name, its description file, or an Instrument")
    if is_product(path):
        return calibration_of(path).design
    return Instrument.read(instrument, elements=defined_elements())


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


def left_out_sentences(names: Sequence[str], source: PathLike | None = None) -> tuple[str, ...]:
    """A sentence for every effect that cannot be carried over; `source` is the file that the model comes from."""
    where = "" if source is None else f"{os.fspath(source)}: "
    why = "acts on single exposures of the calibration, which cannot be carried over; it is left out"
    return tuple(f"{where}{name} {why}" for name in names)


def left_out_cards(names: Sequence[str]) -> dict[str, str]:
    """The card NOTCARR of a table, which lists the effects that cannot be carried over; none where all are in it."""
    return {"NOTCARR": in_ascii(", ".join(names))} if names else {}
