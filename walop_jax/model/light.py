"""The light path, from Stokes vector to counts: the forward model of the package.

    source → telescope → polariser → train of elements → arms → analysers → cameras → detectors

Everything up to the detectors is linear, so the train is folded backwards, from the analysers to the polariser:
each element multiplies the rows of the analysers by its Mueller matrix. Elements directly behind the polariser that
depend neither on wavelength nor on the exposure are outside the band integral (`leading`) and are multiplied
afterwards. `band_rows` is all of the optics, once per field point; `camera_vectors` adds analysers
and throughput, `counts` is a dot product per exposure. `trace.py` folds the same elements forwards. No effect has a
name here: effects patch the instrument, and the patched instrument is folded.

Units       counts per unit of unpolarised light at unit throughput; angles rad; wavelengths µm; field deg.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from walop_jax.model import fold, mueller
from walop_jax.model.elements.base import Element
from walop_jax.model.elements.simple import Analyser
from walop_jax.model.light_path import LightPath, Scalar, is_achromatic
from walop_jax.model.plan import Plan
from walop_jax.model.ray import Ray
from walop_jax.model.sources import ExposureArrays, PointIllumination, Source, turned

Rows = Float[Array, "b r 4"]  # band, row of an analyser, Stokes
Vectors = Float[Array, "b k 4"]  # band, camera, Stokes
Counts = Float[Array, "e k"]  # exposure, camera
CameraFactors = Float[Array, " k"]  # camera
FEW_BANDS = 3
FEW_SETTINGS = 4  # up to this number band integrals are computed one by one
BROAD = 0.05  # µm: equivalent width from which a filter is displaced by `LightPath.filter_shift`


# ------------------------------------------------------------------------------------------- the train


def divided(instrument: LightPath) -> tuple[tuple[Element, ...], tuple[Element, ...]]:
    """The common train behind the polariser in two parts: its leading elements, and those in the band integral.

    Leading are all elements ahead of the first one that moves or that depends on the wavelength or on another quantity
    of the exposures; which ones do is found by running them on shapes.
    """
    behind = instrument.behind_polariser()
    leading = tuple(itertools.takewhile(lambda e: not e.moves and is_achromatic(e), behind))
    return leading, behind[len(leading) :]


def _achromatic(elements: tuple[Element, ...], x: Scalar, y: Scalar) -> Float[Array, "4 4"]:
    """Mueller matrix of elements independent of wavelength."""
    stations, _ = fold.stations(elements, Ray.entering(x, y))
    matrix = mueller.product(element.mueller(ray) for element, ray in stations)
    return jnp.eye(4) if matrix is None else matrix


def telescope(instrument: LightPath, x: Scalar, y: Scalar) -> Float[Array, "4 4"]:
    """Mueller matrix of the elements ahead of the polariser, for light from the sky alone."""
    return _achromatic(instrument.patched().telescope(), x, y)


def upstream(instrument: LightPath, x: Scalar, y: Scalar) -> Float[Array, "4 4"]:
    """Mueller matrix of the leading elements at a field point (see `divided`)."""
    return _achromatic(divided(instrument.patched())[0], x, y)


# ------------------------------------------------------------------------------------ bands and cameras


def node_wavelengths(instrument: LightPath, plan: Plan) -> Float[Array, " n"]:
    """Wavelengths (µm) of the nodes."""
    shift = instrument.patched().filter_shift
    if shift is None:
        return plan.wavelength
    return plan.wavelength + jnp.where(plan.conditions.band_width > BROAD, shift, 0.0)


def band_weights(instrument: LightPath, plan: Plan) -> Float[Array, "b n"]:
    """Weights of the nodes in every band: filter × photon spectrum, each band summing to 1, its slope to 0.

    Photon spectrum λ⁻⁴ / (exp(14387.77/λT) − 1) (Planck; λ in µm, T in K), flat where T = 0 stands for
    "none".
    """
    wavelength = node_wavelengths(instrument, plan)
    weight = weights_at(plan, wavelength, plan.teff)
    if plan.slope is None:
        return weight
    distance = wavelength - (weight @ wavelength)[:, None]
    return jnp.where(plan.slope[:, None] > 0, distance, 1.0) * weight


def weights_at(plan: Plan, wavelength: Float[Array, " n"], teff: Float[Array, " b"]) -> Float[Array, "b n"]:
    """The same as `band_weights`, at other wavelengths of the nodes and colour temperatures of the bands, without
    slopes.
    """
    hot = teff > 0
    exponent = 14387.77 / (wavelength * jnp.where(hot, teff, 5000.0)[:, None])
    spectrum = jnp.where(hot[:, None], wavelength**-4 / jnp.expm1(exponent), 1.0)
    weight = plan.node_weight * spectrum
    return weight / weight.sum(axis=1, keepdims=True)


def mean_wavelengths(instrument: LightPath, plan: Plan) -> Float[Array, " b"]:
    """Mean wavelengths (µm) of the bands."""
    wavelength = node_wavelengths(instrument, plan)
    return weights_at(plan, wavelength, plan.teff) @ wavelength


def band_rows(instrument: LightPath, plan: Plan, x: Scalar, y: Scalar) -> Rows:
    """Band-integrated Mueller rows (band, row, Stokes): all of the optics at a field point.

    Rows are those of the analysers, arm by arm: S0, then the analysed component; where the beams of an analyser differ
    in wavelength, followed by λ ∂/∂λ of all of these. Columns are the light behind the leading elements.
    """
    instrument = instrument.patched()
    wavelength = node_wavelengths(instrument, plan)

    def at(wavelength: Float[Array, " n"]) -> Float[Array, "c n r 4"]:
        """Rows of the analysers at every node, in every setting."""
        ray = Ray.entering(x, y, (wavelength, plan.conditions))
        leading, banded = divided(instrument)
        for element in leading:
            ray = element.ray(ray)
        path = fold.Fold.of(banded, instrument.arms, ray, plan.moving, plan.positions)
        return path.backward(path.solved(), len(plan.wavelength))

    rows = with_dispersion(instrument, at, wavelength)
    weights = band_weights(instrument, plan)
    return in_bands(instrument, integrated(plan, weights, rows), mean_wavelengths(instrument, plan))


def integrated(
    plan: Plan, weights: Float[Array, "b n"], rows: Float[Array, "*s c n r 4"]
) -> Float[Array, "*s b r 4"]:
    """Sums over the nodes of every band, each in its own setting."""
    sizes = {last - first for _, first, last in plan.settings}
    if len(sizes) == 1 and len(plan.settings) > FEW_SETTINGS:
        grouped = weights.reshape(len(plan.settings), *sizes, -1)
        bands = jnp.einsum("cbn,...cnrs->...cbrs", grouped, rows)
        return bands.reshape(*rows.shape[:-4], len(weights), *rows.shape[-2:])
    sums = [
        jnp.einsum("bn,...nrs->...brs", weights[first:last], rows[..., i, :, :, :])
        for i, (_, first, last) in enumerate(plan.settings)
    ]
    return jnp.concatenate(sums, axis=-3)


def in_bands(instrument: LightPath, bands: Rows, mean: Float[Array, " b"]) -> Rows:
    """Band-integrated rows with balance and loss of the analysers, at mean wavelengths (µm)."""
    analysers = [arm.analyser for arm in instrument.arms]
    if all(analyser.balance is None and analyser.loss is None for analyser in analysers):
        return bands
    blocks = jnp.split(bands, bands.shape[1] // Analyser.rows, axis=1)
    return jnp.concatenate(
        [analysers[i % len(analysers)].in_band(block, mean) for i, block in enumerate(blocks)], axis=1
    )


def with_dispersion(instrument: LightPath, rows: Callable[[Array], Any], wavelength: Array) -> Any:
    """Rows at wavelengths, or trees of them, followed by λ ∂/∂λ where the beams of an analyser differ in wavelength."""
    if not is_dispersed(instrument):
        return rows(wavelength)
    pair = jax.jvp(rows, (wavelength,), (wavelength,))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=-2), *pair)


def is_dispersed(instrument: LightPath) -> bool:
    """True if the beams of an analyser differ in wavelength."""
    return any(arm.analyser.dispersion is not None for arm in instrument.arms)


def camera_vectors(
    instrument: LightPath, rows: Rows, throughput: CameraFactors, x: Scalar, y: Scalar
) -> Vectors:
    """Analysis vectors (band, camera, Stokes): counts = vector · Stokes for light of unit flux."""
    instrument = instrument.patched()
    beam_vectors = beams(instrument, rows) @ upstream(instrument, x, y)
    return behind_throughput(instrument, beam_vectors, throughput, x, y)


def beams(instrument: LightPath, rows: Rows) -> Vectors:
    """Rows (band, camera, 4) of the cameras: each beam adds the rows of its analyser with its weights."""
    index, weights = _beams(instrument)
    contributions = (weights[:, j, None] * rows[:, index[:, j]] for j in range(index.shape[1]))
    return functools.reduce(jnp.add, contributions)


def behind_throughput(
    instrument: LightPath, beams: Vectors, throughput: CameraFactors, x: Scalar, y: Scalar
) -> Vectors:
    """Analysis vectors from the beams of an instrument without effects (`patched`): throughput, and mixing."""
    for component in instrument.cameras.transmission:
        throughput = throughput * component.factors(x, y)
    vectors = throughput[:, None] * beams
    for component in instrument.cameras.mixing:
        vectors = component.vectors(vectors, x, y)
    return vectors


def _beams(instrument: LightPath) -> tuple[Int[np.ndarray, "k j"], Float[Array, "k j"]]:
    """For each camera the rows that its beam is made of, and the weight of each."""
    analysers = [arm.analyser for arm in instrument.arms]
    names = [name for analyser in analysers for name in analyser.cameras]
    order = np.array([names.index(name) for name in instrument.cameras.names])
    first = np.cumsum([0, *(analyser.rows for analyser in analysers)])
    index = np.concatenate(
        [
            np.tile(start + np.arange(a.rows), (len(a.cameras), 1))
            for start, a in zip(first, analysers, strict=False)
        ]
    )
    weights = jnp.concatenate([analyser.beam_weights() for analyser in analysers])
    if is_dispersed(instrument):
        slopes = jnp.concatenate([analyser.beam_weights_of_slopes() for analyser in analysers])
        index, weights = np.concatenate([index, first[-1] + index], 1), jnp.concatenate([weights, slopes], 1)
    return index[order], weights if (order == np.arange(len(order))).all() else weights[order]


# ----------------------------------------------------------------------------------------- light and counts


def stokes(instrument: LightPath, illumination: PointIllumination) -> Float[Array, "e 4"]:
    """Stokes vectors (e, 4) of the light behind the place of the polariser, one for each exposure, at a field point.

    Light behind the polariser is independent of its source; only light from the sky passes the telescope.
    """
    instrument = instrument.patched()
    light = through_sky_films(instrument, illumination, behind_telescope(instrument, illumination))
    polariser, exposures = instrument.polariser, illumination.exposures
    if polariser is None:
        return light
    at_polariser = polariser.light(exposures, illumination.x, illumination.y)
    return jnp.where(exposures.clp_in[:, None], at_polariser, light)


def behind_telescope(instrument: LightPath, illumination: PointIllumination) -> Float[Array, "e 4"]:
    """Stokes vectors (e, 4) of the light of the sources behind the telescope, of an instrument without effects."""
    illumination = _turned(instrument, illumination)
    exposures = illumination.exposures
    assigned = jnp.zeros(exposures.kind.shape, bool)
    qu = jnp.zeros((*assigned.shape, 2))
    for source in instrument.sources:
        if type(source).polarisation is not Source.polarisation:
            shining = source.shines(illumination) & ~assigned
            qu, assigned = (
                jnp.where(shining[:, None], source.polarisation(illumination), qu),
                assigned | shining,
            )
    return _through_telescope(instrument, illumination, jnp.ones_like(exposures.clp_angle), qu)


def stokes_slopes(instrument: LightPath, illumination: PointIllumination) -> Float[Array, "e 4"]:
    """Change of the Stokes vectors with wavelength (per µm) inside a band, for the colours of standards."""
    instrument = instrument.patched()
    exposures, illumination = illumination.exposures, _turned(instrument, illumination)
    dark = jnp.zeros_like(exposures.clp_angle)
    slope = instrument.standard.slope(illumination)
    light = _through_telescope(instrument, illumination, dark, slope)
    light = through_sky_films(instrument, illumination, light)
    return jnp.where(exposures.clp_in[:, None], 0.0, light)


def _through_telescope(
    instrument: LightPath,
    illumination: PointIllumination,
    intensity: Float[Array, " e"],
    qu: Float[Array, "e 2"],
) -> Float[Array, "e 4"]:
    """Stokes vectors (e, 4) behind the telescope, of light of given intensity and polarisation."""
    light = jnp.stack([intensity, qu[:, 0], qu[:, 1], jnp.zeros_like(intensity)], axis=-1)
    if not instrument.telescope():
        return light
    behind = light @ telescope(instrument, illumination.x, illumination.y).T
    return jnp.where(bypasses_telescope(instrument, illumination)[:, None], light, behind)


def through_sky_films(
    instrument: LightPath, illumination: PointIllumination, light: Float[Array, "e 4"]
) -> Float[Array, "e 4"]:
    """Stokes vectors (e, 4) ahead of the polariser, of light behind the telescope: what changes light from the sky in
    single exposures stands between the two, in an instrument without effects (`LightPath.sky_films`).
    """
    for film in instrument.sky_films:
        behind = film.through(light, illumination.exposures, illumination.x, illumination.y)
        light = jnp.where(bypasses_telescope(instrument, illumination)[:, None], light, behind)
    return light


def bypasses_telescope(instrument: LightPath, illumination: PointIllumination) -> Bool[Array, " e"]:
    """True (e) in exposures whose light enters behind the telescope: lamps, the light of an optical design program."""
    sources = (source.shines(illumination) for source in instrument.sources if not source.facts.from_sky)
    return functools.reduce(jnp.logical_or, sources, jnp.zeros(illumination.source.shape, bool))


def _turned(instrument: LightPath, illumination: PointIllumination) -> PointIllumination:
    """The illumination with ROTATOR and sky turned by `rotator_zero`: the true position angle of the instrument."""
    if instrument.rotator_zero is None:
        return illumination
    offset = jnp.deg2rad(instrument.rotator_zero)
    exposures = eqx.tree_at(
        lambda e: e.rotator, illumination.exposures, illumination.exposures.rotator + offset
    )
    sky = turned(illumination.sky, jnp.broadcast_to(offset, exposures.rotator.shape))
    return illumination._replace(exposures=exposures, sky=sky)


def counts(
    instrument: LightPath,
    rows: Rows,
    throughput: CameraFactors,
    illumination: PointIllumination,
    band: Int[Array, " e"],
) -> Counts:
    """Counts (e, k) of the cameras in every exposure at a field point, for light of unit flux, without ghosts."""
    instrument = instrument.patched()
    exposures, x, y = illumination.exposures, illumination.x, illumination.y
    vectors = camera_vectors(instrument, rows, throughput, x, y)
    light = stokes(instrument, illumination)
    if len(vectors) <= FEW_BANDS:  # a matrix product: indexing would copy the vectors for every exposure
        in_band = jax.nn.one_hot(band, len(vectors), dtype=light.dtype)
        result = jnp.einsum("bks,eb,es->ek", vectors, in_band, light)
    else:
        result = jnp.einsum("eks,es->ek", vectors[band], light)
    if exposures.slope_band is not None:
        slopes = stokes_slopes(instrument, illumination)
        result = result + jnp.einsum("eks,es->ek", vectors[exposures.slope_band], slopes)
    for gain in instrument.cameras.exposures:
        result = result * gain.factors(exposures, x, y)
        result = result + vectors[band, :, 0] * gain.share(exposures, x, y)
    return result


def has_ghosts(instrument: LightPath) -> bool:
    """True if counts depend on the light of the opposite field point."""
    return bool(instrument.patched().cameras.ghosts)


def with_ghosts(instrument: LightPath, counts: Counts, opposite: Counts, source: Int[Array, " e"]) -> Counts:
    """Counts (e, k) for light of unit flux, with the ghosts of the counts at the opposite field point (`opposite`)."""
    for ghost in instrument.patched().cameras.ghosts:
        counts = counts + ghost.seen(source < 0, opposite)
    return counts


def is_linear(instrument: LightPath) -> bool:
    """True if the detectors report the electrons as they are."""
    return not instrument.patched().cameras.detectors


def detected(
    instrument: LightPath, exposures: ExposureArrays, counts: Counts, x: Scalar, y: Scalar
) -> Counts:
    """Counts (e, k) reported by the detectors for counts in electrons: the only stage that may be not linear in the
    light, or mix cameras in single exposures.
    """
    for detector in instrument.patched().cameras.detectors:
        counts = detector.reported(counts, exposures, x, y)
    return counts


# --------------------------------------------------------------------------------------- the instrument matrix


def instrument_matrix(
    vectors: Float[Any, "... k s"], pairs: tuple[tuple[int, int], ...]
) -> Float[Any, "... a 3"]:
    """Rows (m21, m22, m23), (m31, m32, m33), … of the instrument matrix (arm, 3) from analysis vectors (camera, s).

    The two cameras of an arm (`pairs`) respond to 1, q and u: each element is the difference of their responses over
    the sum of their responses to unpolarised light. For light from the sky pass `vectors @ telescope(instrument, x,
    y)`. Arrays of numpy stay arrays of numpy.
    """
    first, second = (vectors[..., np.array([pair[i] for pair in pairs], int), :] for i in (0, 1))
    return (first[..., :3] - second[..., :3]) / (first[..., :1] + second[..., :1])
