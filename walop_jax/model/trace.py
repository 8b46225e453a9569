"""Following the light: one source through the instrument, stage by stage, with the functions that a fit uses.

    source → collimator → calibration plate → half-wave plates → Wollaston prisms → cameras → counts

`light.py` runs this path backwards from the cameras, once for all sources. Here the Stokes vector goes
forward, averaged over the band where the plates make it depend on wavelength; both ends meet in the counts.

Units       Stokes vectors in units of the flux that arrives; counts per unit of flux, as in `light.counts`:
            ghosts of other field points and effects of the detectors, which act on electrons, come after.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.data.records import Exposures, FilterCurve
from walop_jax.model import light
from walop_jax.model.conventions import CAMERA_NAMES, HALF_OF_CAMERA, SIGN_OF_CAMERA
from walop_jax.model.instrument import Instrument, Standards
from walop_jax.model.materials import REFERENCE_TEMPERATURE
from walop_jax.model.plan import Plan, plan_for

STOKES = ("I", "Q", "U", "V")


@dataclasses.dataclass(frozen=True)
class Stage:
    """The light at one place: rows of `value` are one beam or two halves, columns Stokes or cameras."""

    name: str
    about: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    value: Float[np.ndarray, "r c"]


@dataclasses.dataclass(frozen=True)
class Ray:
    """A source and the way through which it is looked at; angles and field coordinates in degrees.

    `q`, `u` are those of the source in the instrument frame (taken as catalogue values at ROTATOR 0);
    `clp_angle`, `chwp_angle` are NaN where polariser and calibration plate are out; `teff` in K, NaN: flat.
    """

    x: float = 0.0
    y: float = 0.0
    q: float = 0.0
    u: float = 0.0
    clp_angle: float = float("nan")
    chwp_angle: float = float("nan")
    teff: float = float("nan")
    temperature: float = REFERENCE_TEMPERATURE
    hour_angle: float = 0.0

    def __post_init__(self) -> None:
        if not np.hypot(self.q, self.u) <= 1.0:
            raise ValueError(f"q = {self.q:g}, u = {self.u:g}: light cannot be polarised by more than 1")

    def exposure(self, filter_name: str) -> Exposures:
        """The one exposure that looks at it."""

        def one(value: float) -> Float[np.ndarray, " 1"]:
            return np.array([value], float)

        return Exposures(
            exposure=np.zeros(1, int), kind=np.array(["standard"]), mjd=one(0.0), exptime=one(0.0),
            filter=np.array([filter_name]), clp_in=np.isfinite(one(self.clp_angle)),
            clp_angle=one(self.clp_angle), chwp_in=np.isfinite(one(self.chwp_angle)),
            chwp_angle=one(self.chwp_angle), temp=one(self.temperature), ha=one(self.hour_angle),
            ra=one(np.nan), dec=one(np.nan), rotator=one(0.0), teff=one(self.teff),
        )  # fmt: skip


def trace(instrument: Instrument, curve: FilterCurve, ray: Ray) -> tuple[Stage, ...]:
    """Every stage from the source to the counts of the four cameras."""
    instrument = _with_source(instrument, ray)
    plan = plan_for(instrument.effects, ray.exposure(curve.name), {curve.name: curve})
    x, y = jnp.asarray(ray.x), jnp.asarray(ray.y)
    source = jnp.asarray([len(instrument.standard.names) - 1])
    beam = light.stokes(instrument, plan.exposures, jnp.zeros((1, 2)), source)[0]
    stages = [_one("source", "polariser" if np.isfinite(ray.clp_angle) else "sky", beam)]

    beam = light.upstream(instrument, x, y) @ beam
    stages.append(_one("collimator", "lenses of the collimator, ahead of the calibration plate", beam))

    # From here on light depends on wavelength: one Stokes vector per node, and its average over the band.
    weight = light.band_weights(instrument, plan)[0]
    matrices = light.plate_matrices(instrument, plan, x, y)
    nodes = jnp.broadcast_to(beam, (len(weight), 4))
    angle = light.calibration_angle(instrument, plan.settings[0][0])
    if angle is not None:
        nodes = jnp.einsum("nst,nt->ns", matrices[angle], nodes)
    about = "out of the beam" if angle is None else f"at {angle:g}°"
    stages.append(_one("calibration plate", about, weight @ nodes))

    halves = jnp.stack([matrices["half1"] @ nodes[:, :, None], matrices["half2"] @ nodes[:, :, None]])[..., 0]
    ahead = jnp.einsum("n,hns->hs", weight, halves)
    stages.append(
        Stage("half-wave plates", "ahead of the prisms", ("half 1", "half 2"), STOKES, np.asarray(ahead))
    )

    turn = jnp.asarray(0.0)
    for effect in instrument.effects:
        turn = jnp.asarray(effect.analyser_angle(turn))
    analysed = jnp.cos(2 * turn) * ahead[:, 1] + jnp.sin(2 * turn) * ahead[:, 2]
    half = jnp.asarray(HALF_OF_CAMERA)
    efficiency = jnp.stack([h.efficiency for h in instrument.halves])
    beams = 0.5 * (ahead[half, 0] + jnp.asarray(SIGN_OF_CAMERA) * efficiency[half] * analysed[half])
    stages.append(_cameras("Wollaston prisms", "share of the light in each beam of its half", beams))

    throughput = light.throughput_at(instrument, x, y)
    for effect in instrument.effects:
        throughput = effect.throughput(throughput, x, y)
    beams = throughput * beams
    stages.append(_cameras("cameras", "behind lenses, filter and detector of each camera", beams))
    stages.append(
        _cameras("counts", "electrons per electron of flux", _between_cameras(instrument, plan, beams, x, y))
    )
    return tuple(stages)


def _with_source(instrument: Instrument, ray: Ray) -> Instrument:
    """The instrument with one more standard star: the source that is followed."""
    stars = instrument.standard
    standard = Standards(
        q=jnp.append(stars.q, ray.q), u=jnp.append(stars.u, ray.u), names=(*stars.names, "traced")
    )
    return dataclasses.replace(instrument, standard=standard)


def _between_cameras(
    instrument: Instrument, plan: Plan, beams: Float[Array, " 4"], x: Float[Array, ""], y: Float[Array, ""]
) -> Float[Array, " 4"]:
    # These effects are linear in the cameras whatever the Stokes parameter: put the beams where I stands.
    vectors = jnp.zeros((plan.bands, 4, 4)).at[0, :, 0].set(beams)
    for effect in instrument.effects:
        vectors = effect.cameras(vectors, x, y)
    return vectors[0, :, 0]


def _one(name: str, about: str, beam: Float[Array, " 4"]) -> Stage:
    return Stage(name, about, ("",), STOKES, np.asarray(beam)[None])


def _cameras(name: str, about: str, beams: Float[Array, " 4"]) -> Stage:
    return Stage(name, about, ("",), CAMERA_NAMES, np.asarray(beams)[None])
