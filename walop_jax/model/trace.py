"""Following the light: one source through the instrument, element by element, with the fold that a fit uses.

`light.py` folds the train backwards from the analysers, once for all sources. Here the Stokes vector goes forward to
the analysers, averaged over the band once the light depends on wavelength; the cameras use the fold.

Units       Stokes vectors in units of the arriving flux; counts per unit of flux, as in `light.counts`: ghosts of
            other field points and effects of the detectors, which act on electrons, come after.
"""

from __future__ import annotations

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.data.records import FilterCurve
from walop_jax.data.settings import Settings
from walop_jax.model import fold, light
from walop_jax.model.instrument import Instrument
from walop_jax.model.planning import plan_for_settings
from walop_jax.model.ray import Ray
from walop_jax.model.sources import PointIllumination, Standards

STOKES = ("I", "Q", "U", "V")


@dataclasses.dataclass(frozen=True)
class LightStage:
    """The light at one place of its path: rows of `value` are one beam or the arms, columns Stokes parameters or
    cameras.
    """

    name: str
    about: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    value: Float[np.ndarray, "r c"]


@dataclasses.dataclass(frozen=True)
class Sightline:
    """A source and its path through the instrument; angles and field coordinates in degrees.

    `q`, `u` are the Stokes parameters of the source in the instrument frame (taken as catalogue values at ROTATOR 0);
    `clp_angle` is NaN where the polariser is out; `setting` is a single row: the colour of the source, and the
    positions of the optics. Raises ValueError for a degree of polarisation above 1, and for several settings.
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
    """Every stage from the source to the counts of the cameras, through a filter of this curve.

    The source is one more standard star.
    """
    instrument = instrument.patched()
    stars = instrument.standard
    q, u = jnp.append(stars.q, sightline.q), jnp.append(stars.u, sightline.u)
    instrument = instrument.with_source(Standards(q=q, u=u, names=(*stars.names, "traced")))
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
    beam = light.stokes(instrument, PointIllumination(exposure, jnp.zeros((1, 2)), source, x, y))[0]
    stages = [_one("source", "polariser" if through else "sky", beam)]

    # One Stokes vector per node, and its average over the band.
    wavelength, weight = light.node_wavelengths(instrument, plan), light.band_weights(instrument, plan)[0]
    ray = Ray.entering(x, y, (wavelength, plan.conditions))
    path = fold.Fold.of(instrument.behind_polariser(), instrument.arms, ray, plan.moving, plan.positions)
    ahead, *inside = path.in_first_setting()
    nodes = jnp.broadcast_to(beam, (len(wavelength), 4))
    for (element, _), matrix in zip(path.common, ahead, strict=True):
        nodes = _through(matrix, nodes)
        if matrix is not None or element.moves:
            about = element.__doc__ or ""
            if element.moves is not None:
                (angle,) = fold.angles_of(element, plan.moving, plan.positions[:1])
                about = (
                    "out of the beam" if angle is None else f"at {element.reading_in_words(_middle(angle))}"
                )
            stages.append(_one(element.name, about, weight @ nodes))
    of_arms = [
        weight @ functools.reduce(lambda vector, matrix: _through(matrix, vector), arm, nodes)
        for arm in inside
    ]
    names = tuple(arm.name for arm in instrument.arms)
    stages.append(LightStage("arms", "ahead of the analysers", names, STOKES, np.asarray(of_arms)))

    # From there as in every fit: the rows of the analysers, times the light.
    rows, throughput = light.band_rows(instrument, plan, x, y), instrument.throughput.at(x, y)
    unmixed = dataclasses.replace(instrument, cameras=dataclasses.replace(instrument.cameras, mixing=()))
    for name, about, vectors in (
        ("analysers", "fraction of the light in each beam of its arm",
         light.beams(instrument, rows) @ light.upstream(instrument, x, y)),
        ("cameras", "behind lenses, filter and detector of each camera",
         light.camera_vectors(unmixed, rows, throughput, x, y)),
        ("counts", "electrons per electron of flux", light.camera_vectors(instrument, rows, throughput, x, y)),
    ):  # fmt: skip
        stages.append(LightStage(name, about, ("",), instrument.cameras.names, np.asarray(vectors @ beam)))
    return tuple(stages)


def _middle(angle: fold.Angle) -> float:
    return angle.middle if isinstance(angle, fold.Turning) else angle


def _through(matrix: Float[Array, "... 4 4"] | None, nodes: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    return nodes if matrix is None else jnp.einsum("...st,...t->...s", matrix, nodes)


def _one(name: str, about: str, beam: Float[Array, " 4"]) -> LightStage:
    return LightStage(name, about.splitlines()[0].rstrip("."), ("",), STOKES, np.asarray(beam)[None])


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
