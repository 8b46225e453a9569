"""The model of a calibration set: the base model, changed by a model file, or like that of another set.

The scale of the throughput is a gauge unless a flux is known: the constant of camera N0 is held then. Of two cameras,
and where every arm has a flux of its own, the whole series of the first one is: only ratios can be known.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from walop_jax.data.kinds import POLARISER
from walop_jax.data.merge import parts_of
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.fit.model_file import GAUGE, Catalogue, ModelTable, header_of, known_to, parse, with_effects_of
from walop_jax.instruments.description import shipped
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import DataError
from walop_jax.model.effects import EFFECTS, Deviations
from walop_jax.model.instrument import Instrument, adapted, as_designed, nominal_instrument
from walop_jax.model.sources import MoonSky, Standards
from walop_jax.model.specification import THROUGHPUT, Model, effect_context, make_model, model_without
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
    """Level of the throughput: that of the first field points with a known flux, `LEVEL` where there are none.

    A camera gets half of the unpolarised light: N = T/2.
    """
    for subset, points, exposures in parts_of(calset):
        stated = calset.exposures.flux_known[exposures]
        for start in range(0, len(points) if stated.any() else 0, LEVEL_POINTS):
            block = subset.block(start, min(start + LEVEL_POINTS, len(points)))
            counts = block.counts[block.used & stated]
            if counts.size:
                return float(2.0 * counts.mean())
    return LEVEL


def gauges(model: Model, flux_known: bool) -> list[str]:
    """Parameters degenerate with fluxes: the scale of the throughput, or all terms common to the cameras of an arm."""
    cameras = model.template.cameras
    if flux_known and not cameras.split:
        return []
    units = tuple(f"throughput.n{camera}." for camera in cameras.units)
    return [name for name in model.names if name.startswith(units)] if units else [GAUGE]


def instrument_of(calset: CalibrationSet) -> Instrument:
    """The instrument of a set as designed, if it comes with the package; `DataError` with advice if not."""
    if calset.instrument not in shipped():
        what = f"INSTRUME is {calset.instrument!r}, which does not come with the package ({', '.join(shipped())})"
        raise DataError(
            f"{what}: give its description, --instrument FILE or instrument=Instrument.read(FILE)"
        )
    return nominal_instrument(calset.instrument)


def model_for(
    calset: CalibrationSet,
    text: str = "",
    instrument: Instrument | None = None,
    catalogue: Catalogue = EFFECTS,
) -> Model:
    """The base model of a calibration set, changed by a model file (TOML text); `instrument` as for `base_model`.

    `catalogue` are the effects that the file may name.
    Raises ValueError for anything in the text that does not exist or does not fit the data.
    """

    def build(header: ModelTable) -> Model:
        model = base_model(calset, instrument, **header.of_instrument())
        model = dataclasses.replace(model, catalogue=known_to(header, catalogue))
        return with_effects_of(model, header, effect_context(model.template, calset.exposures))

    return parse(text, build)


def model_like(calset: CalibrationSet, old: Model) -> Model:
    """The model `old` for another calibration set: its plates, effects, priors, ties and fixed parameters.

    Sky and standards are those of the new set. Deviations from descriptions, whose hundreds of parameters no fit of
    one set constrains, are left out. Raises ValueError for a set of another instrument.
    """
    if Deviations.name in old.effect_names:
        old = model_without(old, Deviations.name)
    header = header_of(old)
    model = base_model(calset, old.template, **header.of_instrument())
    own_kinds = dict.fromkeys((*(effect.kind for effect in old.template.effects), *old.catalogue))
    model = dataclasses.replace(model, catalogue=tuple(own_kinds))
    model = with_effects_of(model, header, effect_context(model.template, calset.exposures))
    unchanged = {p.name: p for p in old.parameters if p.name != GAUGE and p.part not in SKY_AND_STARS}
    parameters = []
    for p in model.parameters:
        if (like := unchanged.get(p.name)) is not None:
            start = p.start if like.free else like.start
            p = dataclasses.replace(p, start=start, free=like.free, prior=like.prior, tie=like.tie)
        parameters.append(p)
    return dataclasses.replace(model, parameters=tuple(parameters), laws=old.laws)


@dataclasses.dataclass(frozen=True, repr=False)
class ModelFile(Displayed):
    """A model, its TOML text, and the file that it was written to (None: to no file)."""

    model: Model
    text: str
    path: Path | None

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        keys, model = ("start", "unit", "prior", "free", "tie", "about"), self.model
        document = {"instrument": model.name, "effects": list(model.effect_names)}
        document |= {"output": None if self.path is None else str(self.path)}
        return document | {"parameters": {p.name: {k: getattr(p, k) for k in keys} for p in model.parameters}}

    def display(self) -> Display:
        """Its file and its size."""
        where = self.model.name if self.path is None else self.path
        parameters, free = len(self.model.parameters), len(self.model.free)
        return Display(f"{where}: {parameters} parameters, {free} of them free")
