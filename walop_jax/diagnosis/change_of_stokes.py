"""What it matters: the change of calibrated q and u when one fitted model takes the place of another.

m = m₀ + A s with s = (q, u), so a star that is calibrated with (m₀, A) while (m₀ + δm₀, A + δA) is true
comes out wrong by A⁻¹ (δm₀ + δA s), at most |A⁻¹ δm₀| + p ‖A⁻¹ δA‖.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.matrix import LARGEST_P, change_of_qu, sky_vectors
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.fit.refit import FitResult
from walop_jax.model import light
from walop_jax.model.instrument import Instrument
from walop_jax.model.planning import plan_for_settings


def first_setting(calset: CalibrationSet, instrument: Instrument) -> Settings:
    """Filter and positions of the first exposure of a set, all else as by default."""
    first = Settings.of(calset.exposures[:1], instrument.patched().moving())
    return Settings.default(1, str(first.filter[0])).at(**first.positions)


def instrument_matrices(result: FitResult) -> Float[np.ndarray, "p a 3"]:
    """Instrument matrix at the field points of a fit, in the filter and plate setting of its first exposure."""
    instrument, calset = result.model.instrument(result.values), result.calset
    plan = plan_for_settings(instrument, first_setting(calset, instrument), calset.filters)
    vectors = sky_vectors(instrument, plan, calset.points.x, calset.points.y)[:, 0]
    return light.instrument_matrix(vectors, instrument.cameras.pairs)


def largest_change(
    assumed: Float[np.ndarray, "p a 3"], true: Float[np.ndarray, "p a 3"], p: float = LARGEST_P
) -> float:
    """Largest of `change_of_qu` over the field; NaN when no point holds both q and u."""
    found = change_of_qu(assumed, true, p)
    return float(np.nanmax(found)) if np.isfinite(found).any() else float("nan")
