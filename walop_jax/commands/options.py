"""Parameters that several commands share: what may be given in Python, and how the command line spells it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from walop_jax.commands.command import Argument, Option

if TYPE_CHECKING:
    from walop_jax.calibration.calibration import Calibration
    from walop_jax.commands.reading import Run
    from walop_jax.data.records import CalibrationSet
    from walop_jax.fit.refit import FitResult
    from walop_jax.model.effects import Effect
    from walop_jax.model.instrument import Instrument
    from walop_jax.model.specification import Model

PathLike = str | os.PathLike[str]

SETS = Argument("Calibration sets (FITS), fitted as one.", metavar="CALSET...", kind=list[Path])
EFFECTS = Option(
    "Effects of your own beside those of the catalogue; see walop-jax docs adding-an-effect.", "FILE.py", Path
)

Sets = Annotated["CalibrationSet | PathLike | Sequence[PathLike]", SETS]
ModelLike = Annotated[
    "Model | PathLike | None", Option("Model file: what is free, tied, known, added.", "MODEL.toml", Path)
]
InstrumentLike = Annotated[
    "Instrument | PathLike | None",
    Option(
        "An instrument that comes with the package, or a description file; see walop-jax instrument.",
        "NAME|FILE.toml",
        str,
    ),
]
Effects = Annotated["PathLike | Sequence[type[Effect]] | None", EFFECTS]
Product = Annotated[
    "Calibration | FitResult | Run | PathLike",
    Argument("Calibration product, or the folder of a run.", "RUN/calibration.fits", Path),
]
Posterior = Annotated[
    "PathLike | None",
    Option("Use draws of walop-jax sample, not the covariance.", "posterior.nc", Path),
]
Memory = Annotated["float | None", Option("Memory for the data, in GB.", "GB", float, least=0.1)]

Folder = Annotated["PathLike | None", Option("Folder of the results.", "RUN", Path, "-o", required=True)]
SetFile = Annotated[
    "PathLike | None", Option("Calibration set to write (FITS).", "SET.fits", Path, "-o", required=True)
]
TableFile = Annotated[
    "PathLike | None", Option("Table to write (.fits, .csv, .ecsv).", "OUT", Path, "-o", required=True)
]
