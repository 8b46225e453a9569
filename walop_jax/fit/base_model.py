"""The base model of a calibration set, which has no effects.

Unless a flux is known, the scale of the throughput cannot be determined: the constant of camera N0 is fixed then. Of
two cameras, and where every arm has a flux of its own, only ratios can be known: the whole series of the first camera
of each arm is fixed.
"""

from __future__ import annotations

from walop_jax.data.kinds import POLARISER
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.instruments.description import shipped
from walop_jax.io.errors import DataError
from walop_jax.model.instrument import Instrument, adapted, as_designed, nominal_instrument
from walop_jax.model.sources import MoonSky, Standards
from walop_jax.model.specification import GAUGE, THROUGHPUT, Model, make_model
from walop_jax.model.standards import half_range, standards_of

LEVEL = 0.5  # of a throughput whose scale is a gauge
LEVEL_POINTS = 256
"""Field points from which the start value of a throughput is taken: a start need not be exact."""

SKY_AND_STARS = (MoonSky.name, Standards.name)  # parts that are not the instrument's


def base_model(
    calset: CalibrationSet,
    instrument: Instrument | None = None,
    *,
    plates: str | None = None,
    throughput_degree: int | None = None,
) -> Model:
    """The base model (docs: model) for the instrument and standards of a calibration set.

    `instrument` is the one as designed, needed where its name is not one that comes with the package; `plates` and
    `throughput_degree` replace what it says. Raises `DataError` for an unknown instrument, and ValueError
    for one of another name than the set's, or without a moving element that the set has in the beam.

    >>> walop.base_model(calset)["pupil.magnification"].prior
    (15.63, 0.05)
    """
    sources, level = calset.sources, _level(calset)
    standards = standards_of(sources, calset.exposures, calset.filters)
    instrument = as_designed(instrument or instrument_of(calset))
    name, cameras = instrument.name, len(instrument.cameras)
    if name != calset.instrument:
        raise ValueError(f"the data come from {calset.instrument}, the instrument described is {name}")
    if cameras != calset.cameras:
        raise ValueError(f"{name} has {cameras} cameras, the data have {calset.cameras}")
    present = Settings.of(calset.exposures, [p for p in calset.exposures.positions if p != POLARISER])
    present.check_moving(instrument.patched().moving())
    choices = {"plates": plates, "throughput_degree": throughput_degree}
    instrument = adapted(instrument, standards=standards, throughput=level, **choices)
    priors = {}
    for i, name in enumerate(standards.names):
        priors[f"standard.{name}.q"] = (float(sources.q[i]), float(sources.q_err[i]))
        priors[f"standard.{name}.u"] = (float(sources.u[i]), float(sources.u_err[i]))
    for i in standards.unknown:
        wavelength, _ = standards.bands[i]
        width = half_range(sources, i, calset.exposures, calset.filters)
        priors[f"standard.{standards.names[i]}.wavelength"] = (wavelength, width)
    model = make_model(calset.instrument, instrument, priors=priors)
    for i in model.positions(THROUGHPUT):
        p = model.parameters[i]
        model = model.change(p.name, scale=p.scale * level / LEVEL, loose=level)
    for name in gauges(model, bool(calset.exposures.flux_known.any())):
        model = model.change(name, free=False)
    if not calset.exposures.direct("moon").any():
        model = model.change("sky.depolarisation", free=False)
    return model


def _level(calset: CalibrationSet) -> float:
    """Start value of the throughput: its level at the first field points with a known flux, `LEVEL` where there are
    none.

    A camera gets half of the unpolarised light: N = T/2.
    """
    stated, points = calset.exposures.flux_known, len(calset.points)
    for start in range(0, points if stated.any() else 0, LEVEL_POINTS):
        block = calset.intensities.block(start, min(start + LEVEL_POINTS, points))
        counts = block.counts[block.used & stated]
        if counts.size:
            return float(2.0 * counts.mean())
    return LEVEL


def gauges(model: Model, flux_known: bool) -> list[str]:
    """Names of the parameters that the unknown fluxes make undeterminable: the scale of the throughput, or whole series
    of it.
    """
    cameras = model.template.cameras
    if flux_known and not cameras.split:
        return []
    series = tuple(f"throughput.n{camera}." for camera in cameras.ratio_references)
    return [name for name in model.names if name.startswith(series)] if series else [GAUGE]


def instrument_of(calset: CalibrationSet) -> Instrument:
    """The instrument of a set as designed, if it comes with the package; `DataError` with advice if not."""
    if calset.instrument not in shipped():
        what = f"INSTRUME is {calset.instrument!r}, which does not come with the package ({', '.join(shipped())})"
        raise DataError(
            f"{what}: give its description, --instrument FILE or instrument=Instrument.read(FILE)"
        )
    return nominal_instrument(calset.instrument)
