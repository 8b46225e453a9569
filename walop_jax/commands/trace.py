"""`walop-jax trace`: the light of one source, stage by stage, as a table."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.commands import products
from walop_jax.commands.command import Job, Option, Outcome, UsageError, command
from walop_jax.commands.products import Angles, CalibrationLike, Effects, InstrumentLike, design_of

if TYPE_CHECKING:
    from walop_jax import Instrument
    from walop_jax.model.trace import Traced


OPTIONS = {
    "calibration": Option(
        "An instrument as fitted; without it, as designed.",
        metavar="[RUN/calibration.fits]",
        kind=Path,
        placed=True,
    ),
    "x": Option("Field position X (deg)."),
    "y": Option("Field position Y (deg)."),
    "q": Option("Stokes q of the source, a fraction."),
    "u": Option("Stokes u of the source, a fraction."),
    "angle": Option("Polariser in, with its axis here (deg).", kind=float),
    "teff": Option("Colour temperature (K); without it, a flat spectrum.", kind=float),
    "filter": Option("Filter of the calibration, or SDSS-r.", kind=str),
}


@command(options=OPTIONS)
def trace(
    job: Job,
    calibration: CalibrationLike | Instrument | None = None,
    *,
    instrument: InstrumentLike = None,
    effects: Effects = None,
    x: float = 0.0,
    y: float = 0.0,
    q: float = 0.0,
    u: float = 0.0,
    angle: float | None = None,
    at: Angles = None,
    teff: float | None = None,
    filter: str = "SDSS-r",
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
    elif calibration is not None and instrument is not None:
        raise UsageError(
            "light is followed through one of them: the calibration or an instrument", "instrument"
        )
    try:
        setting = Settings.default(1, filter).at(**products.angles_of(at))
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
        held = products.calibration_of(calibration, effects)
        lost = held.left_behind
        stages = traced(held.model.instrument(held.values), held.filter_curve(filter), line)
        warnings = (*held.warnings, *products.left_out_sentences(lost, held.path))
    listed = [
        {"stage": s.name, "about": s.about, "rows": s.rows, "columns": s.columns, "value": s.value.tolist()}
        for s in stages
    ]
    document = {"stages": listed, products.NOT_CARRIED_OVER: list(lost)}
    return Outcome(Traced(stages), document, repr(Traced(stages)), warnings=warnings)
