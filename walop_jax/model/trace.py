"""Following the light: one source through the instrument, element by element, with the fold that a fit uses.

`light.py` folds the train backwards from the analysers, once for all sources. Here the Stokes vector goes forward,
averaged over the band from where the light depends on wavelength; both ends meet in the counts.

Units       Stokes vectors in units of the flux that arrives; counts per unit of flux, as in `light.counts`: ghosts of
            other field points and effects of the detectors, which act on electrons, come after.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.data.records import FilterCurve
from walop_jax.data.settings import Settings
from walop_jax.model import fold, light
from walop_jax.model.elements import Analyser, Element
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan
from walop_jax.model.planning import plan_for_settings
from walop_jax.model.ray import Ray
from walop_jax.model.sources import Sight, Standards

STOKES = ("I", "Q", "U", "V")


@dataclasses.dataclass(frozen=True)
class LightStage:
    """The light at one place: rows of `value` are one beam or the arms, columns Stokes or cameras."""

    name: str
    about: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    value: Float[np.ndarray, "r c"]


@dataclasses.dataclass(frozen=True)
class Sightline:
    """A source and the way through which it is looked at; angles and field coordinates in degrees.

    `q`, `u` are those of the source in the instrument frame (taken as catalogue values at ROTATOR 0); `clp_angle` is
    NaN where the polariser is out; `setting` is a single row: the colour of the source, and where the optics stand.
    Raises ValueError for light that is polarised by more than 1, and for several settings.
    """

    x: float = 0.0
    y: float = 0.0
    q: float = 0.0
    u: float = 0.0
    clp_angle: float = float("nan")
    setting: Settings = dataclasses.field(default_factory=lambda: Settings.default(1))

    def __post_init__(self) -> None:
        if not np.hypot(self.q, self.u) <= 1.0:
            raise ValueError(f"q = {self.q:g}, u = {self.u:g}: light cannot be polarised by more than 1")
        if len(self.setting) != 1:
            raise ValueError(f"a sightline has one setting, not {len(self.setting)}")


def trace(instrument: Instrument, curve: FilterCurve, sightline: Sightline) -> tuple[LightStage, ...]:
    """Every stage from the source to the counts of the cameras, through a filter of this curve."""
    instrument = _with_source(instrument.patched(), sightline)
    plan = plan_for_settings(instrument, sightline.setting, {str(sightline.setting.filter[0]): curve})
    through = np.isfinite(sightline.clp_angle)
    exposure = dataclasses.replace(
        plan.exposures,
        kind=jnp.array([instrument.kinds.index(Standards.kind)]),
        clp_in=jnp.array([through]),
        clp_angle=jnp.deg2rad(jnp.array([sightline.clp_angle if through else 0.0])),
        temperature=jnp.asarray(sightline.setting.temperature),
        hour_angle=jnp.asarray(sightline.setting.hour_angle),
    )
    x, y = jnp.asarray(sightline.x), jnp.asarray(sightline.y)
    source = jnp.asarray([len(instrument.standard.names) - 1])
    beam = light.stokes(instrument, Sight(exposure, jnp.zeros((1, 2)), source, x, y))[0]
    stages = [_one("source", "polariser" if through else "sky", beam)]

    # One Stokes vector per node, and its average over the band.
    wavelength, weight = light.node_wavelengths(instrument, plan), light.band_weights(instrument, plan)[0]

    def along(wavelength: Float[Array, " n"]) -> _Way:
        return _followed(instrument, plan, beam, Ray.entering(x, y, (wavelength, plan.conditions)))

    behind, ahead = along(wavelength)
    train = light.divided(instrument)
    for element, nodes in zip((*train.leading, *train.banded), behind, strict=True):
        if nodes is not None:
            stages.append(_one(element.name, _about(element, plan), weight @ nodes))
    # Where the beams of an analyser differ in wavelength, they see what λ ∂/∂λ of the light there adds as well.
    slopes: Sequence[Any] = [None] * len(ahead)
    if light.is_dispersed(instrument):
        slopes = jax.jvp(lambda w: along(w).ahead, (wavelength,), (wavelength,))[1]
    mean = weight @ wavelength
    beams = jnp.zeros(len(instrument.cameras))
    for arm, nodes, slope in zip(instrument.arms, ahead, slopes, strict=True):
        cameras = np.array([instrument.cameras.names.index(name) for name in arm.analyser.cameras])
        seen = arm.analyser.shares() @ _seen(arm.analyser, weight @ nodes, mean)
        if slope is not None:
            seen = seen + arm.analyser.shares_of_slopes() @ _seen(arm.analyser, weight @ slope, mean)
        beams = beams.at[cameras].set(seen)
    names = tuple(arm.name for arm in instrument.arms)
    stages.append(
        LightStage("arms", "ahead of the analysers", names, STOKES, np.asarray(weight @ jnp.stack(ahead)))
    )
    stages.append(_cameras(instrument, "analysers", "share of the light in each beam of its arm", beams))

    throughput = instrument.throughput.at(x, y)
    for part in instrument.cameras.transmission:
        throughput = throughput * part.factors(x, y)
    beams = throughput * beams
    about = "behind lenses, filter and detector of each camera"
    stages.append(_cameras(instrument, "cameras", about, beams))
    # Mixing is linear in the cameras whatever the Stokes parameter: the beams stand where I does.
    vectors = jnp.zeros((1, len(beams), 4)).at[0, :, 0].set(beams)
    for part in instrument.cameras.mixing:
        vectors = part.vectors(vectors, x, y)
    stages.append(_cameras(instrument, "counts", "electrons per electron of flux", vectors[0, :, 0]))
    return tuple(stages)


def _seen(analyser: Analyser, light: Float[Array, " 4"], wavelength: Float[Array, ""]) -> Float[Array, " 2"]:
    """The rows that the beams are made of, of a matrix whose columns are this light and nothing else."""
    seen = analyser.seen(jnp.zeros((4, 4)).at[:, 0].set(light))
    return analyser.in_band(seen[None], wavelength[None])[0, :, 0]


class _Way(NamedTuple):
    """The light at every node: behind each element of the common train (None: it does nothing), ahead of analysers."""

    behind: list[Float[Array, "n 4"] | None]
    ahead: list[Float[Array, "n 4"]]


def _followed(instrument: Instrument, plan: Plan, beam: Float[Array, " 4"], ray: Ray) -> _Way:
    train, (state, *_) = light.divided(instrument), plan.settings[0]
    common, ray = fold.stations((*train.leading, *train.banded), ray)
    arms = [fold.stations(tuple(arm.train()), ray)[0] for arm in instrument.arms]
    matrices = fold.solved([*common, *(one for arm in arms for one in arm)], plan.moving, [state])
    nodes, numbers = jnp.broadcast_to(beam, (len(plan.wavelength), 4)), itertools.count()

    def through(element: Element, nodes: Float[Array, "n 4"]) -> Float[Array, "n 4"] | None:
        own = fold.stacked(matrices, next(numbers), element, plan.moving, [state])
        if own is None:
            return nodes if element.moves else None
        return jnp.einsum("...st,...t->...s", own[0] if element.moves else own, nodes)

    behind, ahead = [], []
    for element, _ in common:
        behind.append(through(element, nodes))
        nodes = nodes if behind[-1] is None else behind[-1]
    for arm in arms:
        here = nodes
        for element, _ in arm:
            there = through(element, here)
            here = here if there is None else there
        ahead.append(here)
    return _Way(behind, ahead)


def _about(element: Element, plan: Plan) -> str:
    """Remark on an element: what it is, or where it stands."""
    if element.moves is None:
        return type(element).__doc__ or ""
    (angle,) = fold.positions(element, plan.moving, [plan.settings[0][0]])
    return "out of the beam" if angle is None else f"at {angle:g}°"


def _with_source(instrument: Instrument, sightline: Sightline) -> Instrument:
    """The instrument with one more standard star: the source that is followed."""
    stars = instrument.standard
    q, u = jnp.append(stars.q, sightline.q), jnp.append(stars.u, sightline.u)
    return instrument.with_source(Standards(q=q, u=u, names=(*stars.names, "traced")))


def _one(name: str, about: str, beam: Float[Array, " 4"]) -> LightStage:
    return LightStage(name, about.splitlines()[0].rstrip("."), ("",), STOKES, np.asarray(beam)[None])


def _cameras(instrument: Instrument, name: str, about: str, beams: Float[Array, " k"]) -> LightStage:
    return LightStage(name, about, ("",), instrument.cameras.names, np.asarray(beams)[None])


class Traced(tuple[LightStage, ...]):
    """The stages of a sightline; prints as a table, with column names where they change."""

    def __repr__(self) -> str:
        width = max(len(f"{stage.name} {row}") for stage in self for row in stage.rows)
        lines: list[str] = []
        columns: tuple[str, ...] = ()
        for stage in self:
            if stage.columns != columns:
                columns = stage.columns
                lines.append(" " * width + "".join(f"{column:>13}" for column in columns))
            for i, (row, values) in enumerate(zip(stage.rows, stage.value, strict=True)):
                name = f"{stage.name} {row}".strip()
                about = f"   {stage.about}" if i == 0 else ""
                lines.append(f"{name:<{width}}" + "".join(f"{value:13.6f}" for value in values) + about)
        return "\n".join(lines)
