"""`walop-jax trace`: the light of one source, stage by stage, as a table."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from walop_jax.commands.command import Argument, Job, Option, Outcome, PathLike, UsageError, command
from walop_jax.commands.inputs import InstrumentLike, design_of
from walop_jax.commands.products import (
    FILTER,
    NOT_CARRIED_OVER,
    TEFF,
    Angles,
    Diagnosed,
    Effects,
    angles_of,
    calibration_of,
    left_out_sentences,
)

if TYPE_CHECKING:
    from walop_jax import Calibration, FitResult, Instrument, Run
    from walop_jax.model.trace import Traced

PRODUCT = Argument("An instrument as fitted; without it, as designed.", "[RUN/calibration.fits]", Path)


@command()
def trace(
    job: Job,
    calibration: Annotated[
        Calibration | FitResult | Diagnosed | Run | Instrument | PathLike | None, PRODUCT
    ] = None,
    *,
    instrument: InstrumentLike = None,
    effects: Effects = None,
    x: Annotated[float, Option("Field position X (deg).")] = 0.0,
    y: Annotated[float, Option("Field position Y (deg).")] = 0.0,
    q: Annotated[float, Option("Stokes q of the source, a fraction.")] = 0.0,
    u: Annotated[float, Option("Stokes u of the source, a fraction.")] = 0.0,
    angle: Annotated[float | None, Option("Polariser in, with its axis here (deg).", kind=float)] = None,
    at: Angles = None,
    teff: Annotated[float | None, TEFF] = None,
    filter: Annotated[str, FILTER] = "SDSS-r",
) -> Outcome[Traced]:
    """Follow the light of one source through the instrument.

    Every line is the light at one place: Stokes vectors averaged over the band, then the cameras. The
    last line holds the counts of a fit.

    In Python: the stages; `at` is a dict, {"CHWP": 45}. Raises ValueError, with the nearest names, for an unknown
    instrument, filter or moving element.

    >>> print(walop.trace(result, x=0.1, y=0.0, q=0.05))  # doctest: +SKIP
    """
    from walop_jax import Instrument, Settings
    from walop_jax.data.settings import builtin_filter
    from walop_jax.model.instrument import nominal_instrument
    from walop_jax.model.trace import Sightline, Traced
    from walop_jax.model.trace import trace as traced

    if isinstance(calibration, Instrument):
        calibration, instrument = None, calibration
    try:
        setting = Settings.default(1, filter).at(**angles_of(at))
        setting.teff[0] = math.nan if teff is None else teff
        polariser = math.nan if angle is None else angle
        line = Sightline(x=x, y=y, q=q, u=u, clp_angle=polariser, setting=setting)
        stages, lost, warnings = (), (), ()
        if calibration is None:
            design = design_of(instrument) or nominal_instrument()
            stages = traced(design, builtin_filter(filter), line)
    except ValueError as error:
        raise UsageError(str(error)) from None  # the options say all there is
    if calibration is not None:
        held = calibration_of(calibration, effects)
        lost = held.left_behind
        stages = traced(held.model.instrument(held.values), held.filter_curve(filter), line)
        warnings = (*held.warnings, *left_out_sentences(lost, held.path))
    return Outcome(
        Traced(stages),
        {
            "stages": [
                {
                    "stage": s.name,
                    "about": s.about,
                    "rows": s.rows,
                    "columns": s.columns,
                    "value": s.value.tolist(),
                }
                for s in stages
            ],
            NOT_CARRIED_OVER: list(lost),
        },
        repr(Traced(stages)),
        warnings=warnings,
    )
