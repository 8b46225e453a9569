"""Where the physics of a fitted model comes from, from the file of its calibration."""

from __future__ import annotations

import os
from collections.abc import Sequence

from walop_jax.calibration.calibration import model_of_product
from walop_jax.calibration.from_file import product_path
from walop_jax.calibration.product import read_product
from walop_jax.fit import solver
from walop_jax.fit.model_builder import model_without_data
from walop_jax.io.errors import errors_naming
from walop_jax.model.build import nominal_instrument
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.model.references import Reference, references


def cite_run(
    run: str | os.PathLike[str] | None = None, catalogue: Sequence[type[Effect]] = EFFECTS
) -> tuple[Reference, ...]:
    """The sources of the physics in the model of a calibration (None: the base model), and of the fit.

    `run` is a calibration product or the folder of a run. Raises `DataError` for a file that cannot be read.
    """
    if run is None:
        model = model_without_data(nominal_instrument())
    else:
        path = product_path(run)
        with errors_naming(path):
            model = model_of_product(read_product(path), catalogue)
    return (*references(model), Reference("fit", solver.SOURCE))
