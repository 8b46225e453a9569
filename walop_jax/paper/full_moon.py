"""The full-Moon scheme of Paper II's on-sky section: boxes, standards at their centres, Moon patches for the rest.

Scheme      The field is divided into 5 × 5 boxes. In each, standard stars at the centre give Δq, Δu of the
            polynomials there; with them the polarisation of every Moon patch is measured at the centre, and
            taken as that of the whole box; the patches, with their polarisation so known, give Δq, Δu of every
            other point of the box.

Checks      A patch need not be what single Rayleigh scattering says (neutral points, aerosol, cloud). Seen
            with the joint model, (q, u) of exposure m at point i is compared with s_m R_mi + c_m, R the
            Rayleigh sky for δ = 1:
              flat       χ² of what is left per degree of freedom: structure that no smooth sky has;
              Rayleigh   departure D_m of the patch's mean from δ R, δ the median of all patches' s_m.
            Weight of a patch: 1 / (1 + (D/D₀)²) / max(1, χ²/dof), D₀ = 0.05 %.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import Block, CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.diagnosis.trust import examined
from walop_jax.fit.refit import refit
from walop_jax.io.errors import DataError
from walop_jax.model.specification import Model
from walop_jax.paper.polynomial import PaperCalibration, measured_qu, polynomial_terms
from walop_jax.science.estimate import estimate
from walop_jax.sky.moon import moon_sky

BOXES_ALONG, BOX_WIDTH = 5, 0.116  # boxes along a side; deg (7 arcmin)
TOLERANCE = 5e-4
DOUBTED_BELOW = 0.5  # weight below which a patch is pointed out


@dataclasses.dataclass(frozen=True)
class Patches:
    """Moon patches judged one by one.

    `exposure` is their row in the set; `scale` s_m and `offset` c_m of the fit, `flatness` χ²/dof, `departure` D_m
    and `weight` as above; `depolarisation` the δ that the patches agree on.
    """

    exposure: Int[np.ndarray, " m"]
    scale: Float[np.ndarray, " m"]
    offset: Float[np.ndarray, "m 2"]
    flatness: Float[np.ndarray, " m"]
    departure: Float[np.ndarray, " m"]
    weight: Float[np.ndarray, " m"]
    depolarisation: float

    @property
    def doubted(self) -> Bool[np.ndarray, " m"]:
        """Patches that are not to be trusted."""
        return self.weight < DOUBTED_BELOW

    def document(self, numbers: Int[np.ndarray, " e"]) -> dict[str, Any]:
        """The verdicts as plain data; `numbers` are the EXPOSURE numbers of the set."""
        rows = zip(
            numbers[self.exposure].tolist(),
            self.scale.tolist(),
            self.flatness.tolist(),
            (100.0 * self.departure).tolist(),
            self.weight.tolist(),
            strict=True,
        )
        names = ("exposure", "scale", "chi2_per_dof", "departure_percent", "weight")
        return {
            "depolarisation": self.depolarisation,
            "patches": [dict(zip(names, row, strict=True)) for row in rows],
            "doubted": numbers[self.exposure[self.doubted]].tolist(),
        }


def judge_patches(calset: CalibrationSet, calibration: Calibration) -> Patches:
    """Judge every Moon exposure of a set (calibration plate out or in) with a calibration.

    Raises `DataError` if there is none.
    """
    e = calset.exposures
    moon = np.flatnonzero((e.kind == "moon") & ~e.clp_in)
    if moon.size == 0:
        raise DataError("EXPOSURES: there is no full-Moon exposure (KIND moon, polariser out)")
    block = calset.intensities.block(0, len(calset.points))
    q, u = moon_sky(e.mjd[moon], e.ra[moon], e.dec[moon], e.rotator[moon], calset.site, block.x, block.y)
    sky = np.stack([q, u], axis=-1)  # point, exposure, (q, u)
    analysis = AnalysisVectors(calibration)
    settings = analysis.reduced(Settings.of(e, analysis.instrument.patched().moving()))
    rows = []
    for k, m in enumerate(moon):
        there = np.flatnonzero(block.used[:, m])
        vectors = analysis.coloured(
            settings[m : m + 1], block.x[there], block.y[there], np.full(len(there), float(e.teff[m]))
        )
        found = estimate(vectors, block.counts[there, m], block.sigma[there, m], np.arange(len(there)))
        rows.append(_smooth_fit(found.qu, found.photon, sky[there, k]))
    scale, offset, flatness, mean = (np.array(part) for part in zip(*rows, strict=True))
    depolarisation = float(np.median(scale))
    # Mean over the patch of (q, u) − δ R = (s − δ) <R> + c.
    departure = np.hypot(*((scale - depolarisation)[:, None] * mean + offset).T)
    weight = 1.0 / (1.0 + (departure / TOLERANCE) ** 2) / np.maximum(1.0, flatness)
    return Patches(moon, scale, offset, flatness, departure, weight, depolarisation)


def _smooth_fit(
    qu: Float[np.ndarray, "p 2"], covariance: Float[np.ndarray, "p 2 2"], sky: Float[np.ndarray, "p 2"]
) -> tuple[float, Float[np.ndarray, " 2"], float, Float[np.ndarray, " 2"]]:
    """Weighted fit of s R + c: s, c, χ²/dof and the mean of R.

    The gradient of R over 35′ is small beside its mean, so s and c are told apart only weakly; a pull of s to
    what the means say, |<q, u>| / |<R>| ± 1, keeps it in bounds.
    """
    good = np.isfinite(qu).all(axis=1)
    qu, covariance, sky = qu[good], covariance[good], sky[good]
    white = np.linalg.cholesky(np.linalg.inv(covariance)).swapaxes(1, 2)
    one = np.broadcast_to(np.eye(2), (len(qu), 2, 2))
    design = (white @ np.concatenate([sky[..., None], one], axis=2)).reshape(-1, 3)
    data = (white @ qu[..., None]).reshape(-1)
    along = (white @ sky[..., None]).reshape(-1)
    only = float(along @ data / (along @ along))
    pull = np.array([[1.0, 0.0, 0.0]])
    solution = np.linalg.lstsq(np.concatenate([design, pull]), np.append(data, only), rcond=None)[0]
    left = data - design @ solution
    return (
        only,
        solution[1:] + (solution[0] - only) * sky.mean(axis=0),
        float(left @ left / max(len(left) - 3, 1)),
        sky.mean(axis=0),
    )


def down_weighted(calset: CalibrationSet, patches: Patches) -> CalibrationSet:
    """The set with the errors of every Moon exposure divided by the square root of its weight."""
    block = calset.intensities.block(0, len(calset.points))
    sigma = block.sigma.copy()
    sigma[:, patches.exposure] /= np.sqrt(patches.weight)[:, None]
    changed = Block(block.x, block.y, block.counts, sigma, block.used, block.source)
    return dataclasses.replace(calset, intensities=TableIntensities.dense(calset.points, changed))


def reweighted_calibration(
    calset: CalibrationSet, model: Model, rounds: int = 6
) -> tuple[Calibration, Patches]:
    """Fit, judge the patches, weigh them down, fit again, until the weights settle (iterative reweighting).

    A bad patch spoils the calibration that it is judged with, and with it the look of good ones; a few rounds
    tell them apart. Weights are always of the errors as given.
    """
    current, weight = calset, np.ones(0)
    while True:
        calibration = Calibration.from_fit(examined(refit(current, model)))
        patches = judge_patches(calset, calibration)
        rounds -= 1
        if rounds < 1 or (weight.size and np.allclose(patches.weight, weight, rtol=0.05)):
            return calibration, patches
        weight = patches.weight
        current = down_weighted(calset, patches)


# ----------------------------------------------------------------------------------- the scheme of the paper


def box_number(x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]) -> Int[np.ndarray, " p"]:
    """Number of the box of every field point, row by row from the lower left; the outer boxes reach the edge."""
    column, row = (
        np.clip(np.floor(v / BOX_WIDTH + 0.5 * BOXES_ALONG), 0, BOXES_ALONG - 1).astype(int) for v in (x, y)
    )
    return row * BOXES_ALONG + column


def box_centres() -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
    """Centres of the boxes in degrees, in the order of `box_number`."""
    edge = (np.arange(BOXES_ALONG) - 0.5 * (BOXES_ALONG - 1)) * BOX_WIDTH
    y, x = np.meshgrid(edge, edge, indexing="ij")
    return x.ravel(), y.ravel()


def full_moon_scheme(
    calset: CalibrationSet, paper: PaperCalibration, weight: Float[np.ndarray, " m"] | None = None
) -> PaperCalibration:
    """Paper II's polynomials with Δq, Δu from standards and Moon patches instead of test stars.

    `weight` are those of the Moon exposures with the calibration plate out, in their order (default: equal). Raises
    `DataError` if there are no standards at the centres of the boxes, or no Moon exposures.
    """
    e = calset.exposures
    block = calset.intensities.block(0, len(calset.points))
    moon = np.flatnonzero((e.kind == "moon") & ~e.clp_in & ~e.chwp_in)
    standard = np.flatnonzero((e.kind == "standard") & ~e.clp_in & ~e.chwp_in)
    centre_x, centre_y = box_centres()
    grid = _positions(block, paper.x, paper.y)
    middle = _positions(block, centre_x, centre_y)
    if (
        moon.size == 0
        or standard.size == 0
        or np.any(middle < 0)
        or not block.used[middle][:, standard].any()
    ):
        raise DataError(
            "POINTS: the full-Moon scheme needs Moon exposures, and standards at the centres of 5 × 5 boxes of 7'"
        )
    weight = np.ones(len(moon)) if weight is None else weight

    # Standards: Δ at the centres, where the polynomials are interpolated.
    local = paper.between(centre_x, centre_y).coefficients
    true = _catalogue(calset, block, standard)
    found = _polynomial(local, measured_qu(block.counts[middle][:, standard]))
    known = block.used[middle][:, standard]
    delta_centre = _mean(found - true[middle], known[..., None], axis=1)

    # Moon: the patch is measured where the polynomials are closest to a centre, and is the same in all the box.
    seen = _polynomial(paper.coefficients, measured_qu(block.counts[grid][:, moon]))
    box = box_number(paper.x, paper.y)
    delta = np.empty_like(paper.delta)
    for b in range(BOXES_ALONG * BOXES_ALONG):
        inside = np.flatnonzero(box == b)
        if inside.size == 0:
            continue
        away = np.hypot(paper.x[inside] - centre_x[b], paper.y[inside] - centre_y[b])
        near = inside[away <= away.min() + 0.25 * BOX_WIDTH]
        patch = seen[near].mean(axis=0) - delta_centre[b]
        delta[inside] = np.average(seen[inside] - patch, axis=1, weights=weight)
    return dataclasses.replace(paper, delta=delta)


def _positions(block: Block, x: Float[np.ndarray, " k"], y: Float[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """The point of a set at each position, −1 where there is none within a thousandth of a degree."""
    distance = np.hypot(block.x[:, None] - x, block.y[:, None] - y)
    nearest = distance.argmin(axis=0)
    return np.where(distance[nearest, np.arange(len(x))] < 1e-3, nearest, -1)


def _polynomial(
    coefficients: Float[np.ndarray, "p 2 5"], measured: Float[np.ndarray, "p e 2"]
) -> Float[np.ndarray, "p e 2"]:
    return np.einsum("pet,pct->pec", polynomial_terms(measured), coefficients)


def _catalogue(
    calset: CalibrationSet, block: Block, standard: Int[np.ndarray, " e"]
) -> Float[np.ndarray, "p e 2"]:
    """(q, u) of the standards in the instrument frame: (q + iu) exp(−2i ROTATOR)."""
    sources = calset.sources
    light = (sources.q + 1j * sources.u)[block.source[:, standard]]
    seen = light * np.exp(-2j * np.deg2rad(calset.exposures.rotator[standard]))
    return np.stack([seen.real, seen.imag], axis=-1)


def _mean(values: np.ndarray, used: np.ndarray, axis: int) -> np.ndarray:
    """Mean over the used values, 0 where there are none."""
    values, used = np.broadcast_arrays(np.nan_to_num(values), used)
    return np.sum(values * used, axis=axis) / np.maximum(used.sum(axis=axis), 1)
