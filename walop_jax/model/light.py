"""The light path, from Stokes vector to counts: read this file to know what the package computes.

    sky or polariser → collimator → calibration plate → wedge → half-wave plate → Wollaston prism → camera

Everything up to the cameras is linear, so the path is run backwards from the analysers: `plate_matrices`
solves the half-wave plates at every wavelength node, `band_rows` keeps the Mueller rows that the Wollaston
prisms see and integrates them over the bands (all the optics there is, once per field point),
`camera_vectors` adds analyser, collimator and throughput, and `counts` is a dot product per exposure.
`trace.py` runs the same functions forward, stage by stage. Effects of the detectors (`detected`) act on
electrons, when the flux is known.

Units       counts per unit of unpolarised light at unit throughput; angles rad; wavelengths µm; field deg.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from walop_jax.model import legendre, materials, mueller, optics
from walop_jax.model import plates as plate_models
from walop_jax.model.conventions import HALF_OF_CAMERA, SIGN_OF_CAMERA
from walop_jax.model.effects.base import ExposureArrays, overridden
from walop_jax.model.instrument import HalfWavePlate, Instrument
from walop_jax.model.plan import Plan
from walop_jax.model.plates import Plate

Scalar = Float[Array, ""]
Nodes = Float[Array, " n"]
FEW_BANDS = 3
_MUELLER = {"waves": plate_models.stack_mueller, "fixed_axis": plate_models.fixed_axis_mueller}


# ----------------------------------------------------------------------------------- the optics, per node


def node_wavelengths(instrument: Instrument, plan: Plan) -> Float[Array, " n"]:
    """Wavelengths (µm) of the nodes."""
    wavelength = plan.wavelength
    for effect in instrument.effects:
        wavelength = effect.wavelengths(wavelength, plan.conditions)
    return wavelength


def _pupil_direction(instrument: Instrument, plan: Plan, x: Scalar, y: Scalar) -> tuple[Nodes, Nodes, Nodes]:
    for effect in instrument.effects:
        x, y = effect.field(x, y, plan.conditions)
    pupil = instrument.pupil
    kx, ky, kz = optics.pupil_direction(x, y, pupil.magnification, pupil.distortion)
    nodes = plan.wavelength.shape
    return jnp.broadcast_to(kx, nodes), jnp.broadcast_to(ky, nodes), jnp.broadcast_to(kz, nodes)


def _stack(
    instrument: Instrument, plan: Plan, where: str, plate: HalfWavePlate, fast_axis: float, wavelength: Nodes
) -> tuple[Plate, ...]:
    axis = jnp.full_like(wavelength, jnp.deg2rad(fast_axis))
    stack: tuple[Plate, ...] = (
        Plate(
            plate.quartz,
            materials.QUARTZ_O.refractive_index(wavelength),
            materials.QUARTZ_E.refractive_index(wavelength),
            axis,
        ),
        Plate(
            plate.mgf2,
            materials.MGF2_O.refractive_index(wavelength),
            materials.MGF2_E.refractive_index(wavelength),
            axis + 0.5 * jnp.pi,
        ),
    )
    for effect in instrument.effects:
        stack = effect.plates(where, stack, plan.conditions)
    return stack


def _with_cuts(stack: tuple[Plate, ...]) -> tuple[Plate, ...]:
    return tuple(p._replace(cut=jnp.zeros_like(p.axis)) if p.cut is None else p for p in stack)


def calibration_angle(instrument: Instrument, angle: float | None) -> float | None:
    """Angle (deg) at which the calibration plate really stands, None when it is out."""
    for effect in instrument.effects:
        angle = effect.calibration_plate(angle)
    return angle


def plate_matrices(
    instrument: Instrument, plan: Plan, x: Scalar, y: Scalar
) -> dict[float | str, Float[Array, "n 4 4"]]:
    """Mueller matrices of all half-wave plates at every node of a field point.

    Keys: "half1" and "half2" behind their wedges, and each angle (deg) of the calibration plate. All of
    them are solved in one go, as rows of the same arrays: one piece of physics, compiled once.
    """
    wavelength = node_wavelengths(instrument, plan)
    direction = _pupil_direction(instrument, plan, x, y)
    glass = materials.BK7.refractive_index(wavelength)
    cases: dict[float | str, tuple[str, tuple[Nodes, Nodes], tuple[Plate, ...]]] = {}
    for where, half in zip(("half1", "half2"), instrument.halves, strict=True):
        behind = optics.behind_wedge(direction, half.wedge, glass)
        cases[where] = where, behind, _stack(instrument, plan, where, half.plate, half.fast_axis, wavelength)
    for setting, _, _ in plan.settings:
        angle = calibration_angle(instrument, setting)
        if angle is not None:
            stack = _stack(instrument, plan, "chwp", instrument.chwp, angle, wavelength)
            cases[angle] = "chwp", direction[:2], stack

    if any(plate.cut is not None for _, _, stack in cases.values() for plate in stack):
        cases = {key: (where, ray, _with_cuts(stack)) for key, (where, ray, stack) in cases.items()}

    def together(*values: Float[Array, "*n"]) -> Float[Array, "cases n"]:
        return jnp.stack([jnp.broadcast_to(value, wavelength.shape) for value in values])

    sx, sy = (together(*(case[1][i] for case in cases.values())) for i in (0, 1))
    plates = jax.tree.map(together, *(case[2] for case in cases.values()))
    matrices = _MUELLER[instrument.plates](sx, sy, plates, wavelength)
    result: dict[float | str, Float[Array, "n 4 4"]] = {}
    for i, (key, (where, (kx, ky), stack)) in enumerate(cases.items()):
        matrix = matrices[i]
        for effect in instrument.effects:
            matrix = effect.ahead_of_plates(where, matrix, kx, ky, wavelength, stack[0].axis)
        result[key] = matrix
    return result


# ------------------------------------------------------------------------------------ bands and cameras


def band_weights(instrument: Instrument, plan: Plan) -> Float[Array, "b n"]:
    """Weights of the nodes in every band: filter × photon spectrum, each band summing to 1.

    Photon spectrum λ⁻⁴ / (exp(14387.77/λT) − 1) (Planck; λ in µm, T in K), flat where T = 0 stands for
    "none".
    """
    wavelength = node_wavelengths(instrument, plan)
    hot = plan.teff > 0
    exponent = 14387.77 / (wavelength * jnp.where(hot, plan.teff, 5000.0)[:, None])
    spectrum = jnp.where(hot[:, None], wavelength**-4 / jnp.expm1(exponent), 1.0)
    weight = plan.node_weight * spectrum
    return weight / weight.sum(axis=1, keepdims=True)


def band_rows(instrument: Instrument, plan: Plan, x: Scalar, y: Scalar) -> Float[Array, "b 2 2 4"]:
    """Band-integrated Mueller rows (band, half, row, Stokes): all the optics there is at a field point.

    Row 0 is S0, row 1 what the Wollaston prism analyses (S1, turned by an effect if need be), behind
    calibration plate, wedge and half-wave plate.
    """
    matrices = plate_matrices(instrument, plan, x, y)
    turn: Scalar | float = 0.0
    for effect in instrument.effects:
        turn = effect.analyser_angle(turn)
    halves = jnp.stack([matrices["half1"], matrices["half2"]], axis=1)
    analysed = halves[:, :, 1]
    if not isinstance(turn, float):
        analysed = jnp.cos(2 * turn) * halves[:, :, 1] + jnp.sin(2 * turn) * halves[:, :, 2]
    rows = jnp.stack([halves[:, :, 0], analysed], axis=2)
    weights = band_weights(instrument, plan)
    bands = []
    for setting, first, last in plan.settings:
        angle = calibration_angle(instrument, setting)
        seen = rows if angle is None else jnp.einsum("nhrs,nst->nhrt", rows, matrices[angle])
        bands.append(jnp.einsum("bn,nhrs->bhrs", weights[first:last], seen))
    return jnp.concatenate(bands, axis=0)


def upstream(instrument: Instrument, x: Scalar, y: Scalar) -> Float[Array, "4 4"]:
    """Mueller matrix from the polariser to the calibration plate: the collimator (contract, item 3)."""
    lens = instrument.collimator
    q = lens.diattenuation * (x**2 - y**2) + lens.q
    u = lens.diattenuation * 2.0 * x * y + lens.u
    matrix = mueller.diattenuator(q, u)
    for effect in instrument.effects:
        matrix = effect.upstream(matrix, x, y)
    return matrix


def throughput_at(instrument: Instrument, x: Scalar, y: Scalar) -> Float[Array, 4]:
    """Throughput of the four cameras at a field point."""
    series = instrument.throughput
    return series.coefficients @ legendre.basis(x, y, series.degree)


def camera_vectors(
    instrument: Instrument, rows: Float[Array, "b 2 2 4"], throughput: Float[Array, 4], x: Scalar, y: Scalar
) -> Float[Array, "b 4 4"]:
    """Analysis vectors (band, camera, Stokes): counts = vector · Stokes for light of unit flux."""
    for effect in instrument.effects:
        throughput = effect.throughput(throughput, x, y)
    efficiency = jnp.stack([half.efficiency for half in instrument.halves])
    half = jnp.asarray(HALF_OF_CAMERA)
    sign = jnp.asarray(SIGN_OF_CAMERA) * efficiency[half]
    analysed = 0.5 * (rows[:, half, 0] + sign[:, None] * rows[:, half, 1])
    vectors = throughput[:, None] * (analysed @ upstream(instrument, x, y))
    for effect in instrument.effects:
        vectors = effect.cameras(vectors, x, y)
    return vectors


# ----------------------------------------------------------------------------------------- light and counts


def telescope(instrument: Instrument) -> Float[Array, "4 4"]:
    """Mueller matrix that light from the sky, and no other, meets first: 1 unless an effect acts."""
    matrix = jnp.eye(4)
    for effect in instrument.effects:
        matrix = effect.telescope(matrix)
    return matrix


def _catalogue(
    instrument: Instrument, rotator: Float[Array, " e"], source: Int[Array, " e"]
) -> Float[Array, "e 2"]:
    """(q, u) of the standard star of each exposure in the ICS, (q + iu) exp(−2i ROTATOR)."""
    all_q, all_u = instrument.standard.q, instrument.standard.u
    for effect in instrument.effects:
        all_q, all_u = effect.catalogue(all_q, all_u, instrument.standard.names)
    row = jnp.where(source >= 0, source, 0)
    return _turned(jnp.stack([all_q[row], all_u[row]], axis=-1), rotator)


def _turned(qu: Float[Array, "e 2"], angle: Float[Array, " e"]) -> Float[Array, "e 2"]:
    """(q, u) referred to axes turned by `angle` (rad): (q + iu) exp(−2i angle)."""
    cos, sin = jnp.cos(2 * angle), jnp.sin(2 * angle)
    return jnp.stack([qu[:, 0] * cos + qu[:, 1] * sin, qu[:, 1] * cos - qu[:, 0] * sin], axis=-1)


def stokes(
    instrument: Instrument, exposures: ExposureArrays, sky: Float[Array, "e 2"], source: Int[Array, " e"]
) -> Float[Array, "e 4"]:
    """Stokes vectors that enter the collimator, one per exposure, at a field point.

    `sky` is (q, u) of the Moon sky for δ = 1 in the ICS, `source` the row of the standard star or −1. Light
    through the polariser forgets its past; light of known flux does not come through the telescope.
    """
    rotator = exposures.rotator
    offset: Scalar | float = 0.0
    for effect in instrument.effects:
        offset = effect.rotator(offset)
    if not isinstance(offset, float):
        rotator, sky = rotator + offset, _turned(sky, jnp.broadcast_to(offset, rotator.shape))
    moon = instrument.sky.depolarisation * sky
    for effect in instrument.effects:
        moon = effect.moon(moon, sky)
    beam = jnp.where(exposures.moon[:, None], moon, 0.0)
    if instrument.standard.names:
        star = _catalogue(instrument, rotator, source)
        beam = jnp.where(((source >= 0) & ~exposures.moon)[:, None], star, beam)
    one = jnp.ones_like(exposures.clp_angle)
    light = jnp.stack([one, beam[:, 0], beam[:, 1], jnp.zeros_like(one)], axis=-1)
    if overridden(instrument.effects, "telescope"):
        light = jnp.where(exposures.flux_known[:, None], light, light @ telescope(instrument).T)
    angle, extinction = exposures.clp_angle, instrument.polariser.extinction
    for effect in instrument.effects:
        angle = effect.polariser_angle(angle, exposures)
        extinction = effect.extinction(extinction)
    behind = mueller.polarised(angle, extinction)
    for effect in instrument.effects:
        behind = effect.polarised(behind, exposures)
    return jnp.where(exposures.clp_in[:, None], behind, light)


def counts(
    instrument: Instrument,
    plan: Plan,
    rows: Float[Array, "b 2 2 4"],
    throughput: Float[Array, 4],
    x: Scalar,
    y: Scalar,
    sky: Float[Array, "e 2"],
    source: Int[Array, " e"],
    band: Int[Array, " e"],
) -> Float[Array, "e 4"]:
    """Counts of the four cameras in every exposure at a field point, for light of unit flux and no ghosts."""
    vectors = camera_vectors(instrument, rows, throughput, x, y)
    light = stokes(instrument, plan.exposures, sky, source)
    if (
        len(vectors) <= FEW_BANDS
    ):  # a product of matrices, where picking vectors would copy them for every exposure
        in_band = jax.nn.one_hot(band, len(vectors), dtype=light.dtype)
        result = jnp.einsum("bks,eb,es->ek", vectors, in_band, light)
    else:
        result = jnp.einsum("eks,es->ek", vectors[band], light)
    for effect in instrument.effects:
        result = effect.recorded(result, vectors[band, :, 0], plan.exposures, x, y)
    return result


def with_ghosts(
    instrument: Instrument,
    counts: Float[Array, "e 4"],
    opposite: Float[Array, "e 4"],
    source: Int[Array, " e"],
) -> Float[Array, "e 4"]:
    """Counts for light of unit flux with what the cameras see of the opposite field point, `opposite`."""
    for effect in instrument.effects:
        counts = effect.mirrored(counts, opposite, source < 0)
    return counts


def detected(
    instrument: Instrument, exposures: ExposureArrays, counts: Float[Array, "e 4"]
) -> Float[Array, "e 4"]:
    """What the detectors report for counts in electrons: the one stage that is not linear in the light."""
    for effect in instrument.effects:
        counts = effect.detector(counts, exposures)
    return counts


# --------------------------------------------------------------------------------------- what users ask for


def instrument_matrix(vectors: Float[Array, "... 4 4"]) -> Float[Array, "... 2 3"]:
    """Rows (m21, m22, m23) and (m31, m32, m33) of the instrument matrix from analysis vectors.

    Difference of the two cameras' response to 1, q, u, each over the sum of their response to unpolarised
    light. For light from the sky pass `vectors @ telescope(instrument)`, so that an active effect there is
    included.
    """
    first = (vectors[..., 0, :3] - vectors[..., 1, :3]) / (vectors[..., 0, :1] + vectors[..., 1, :1])
    second = (vectors[..., 2, :3] - vectors[..., 3, :3]) / (vectors[..., 2, :1] + vectors[..., 3, :1])
    return jnp.stack([first, second], axis=-2)
