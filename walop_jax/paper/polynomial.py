"""The calibration method of Paper II (Maharana et al. 2022), as it is written: a polynomial at every grid point.

    q_i = a₁ + b₁ q_m + c₁ u_m + d₁ q_m² + e₁ u_m²      u_i = a₂ + b₂ q_m + c₂ u_m + d₂ q_m² + e₂ u_m²
    q_m = (N0 − N1)/(N0 + N1)                            u_m = (N2 − N3)/(N2 + N3)

Step 1      Unweighted least squares on the states behind the calibration polariser, point by point.
Step 2      A transmission model T_k = s₁ + s₂ q + s₃ u (+ s₄ q² + s₅ u²) per camera predicts 100 stars with
            p ≤ 5 %; the mean differences Δq, Δu between the result of the polynomial and the truth
            are taken off; μ and σ of what remains characterise the point.

The squares of T_k: light is linear, so s₄ = s₅ = 0; behind a polariser q² + u² is constant and they cannot be told
from s₁. They are left out. The flux of an exposure is unknown (transparency 0.7 to 1) and eliminated.

Full Moon   The field is divided into 5 × 5 boxes. In each, standard stars at the centre give Δq, Δu of the polynomials
            there; with them the polarisation of every Moon patch is measured at the centre, and taken as that of the
            whole box; the patches, with their polarisation so known, give Δq, Δu of every other point of the box.
Checks      A patch need not be what single Rayleigh scattering says (neutral points, aerosol, cloud). Seen with the
            joint model, (q, u) of exposure m at point i is compared with s_m R_mi + c_m, R the Rayleigh sky for δ = 1:
              flat       χ² of the residuals per degree of freedom: structure that no smooth sky has;
              Rayleigh   departure D_m of the patch's mean from δ R, δ the median of all patches' s_m.
            Weight of a patch: 1 / (1 + (D/D₀)²) / max(1, χ²/dof), D₀ = 0.05 %.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import RegularGridInterpolator

from walop_jax.calibration.accuracy import sample_stars
from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.kinds import CALIBRATION_PLATE
from walop_jax.data.records import Block, CalibrationSet
from walop_jax.data.settings import DEFAULT_FILTER, Settings
from walop_jax.io.errors import DataError
from walop_jax.model.conventions import EXTINCTION
from walop_jax.science.estimate import estimate
from walop_jax.science.star_errors import QuPairs, transmitted
from walop_jax.sky.moon import moon_sky
from walop_jax.sky.position_angles import sky_to_instrument

TERMS = ("1", "qm", "um", "qm^2", "um^2")
_ROUNDS = 300  # of alternating least squares for transmissions and fluxes; 40 are enough


def measured_qu(counts: Float[np.ndarray, "... 4"]) -> Float[np.ndarray, "... 2"]:
    """Measured (q_m, u_m) of four intensities."""
    n0, n1, n2, n3 = np.moveaxis(counts, -1, 0)
    return np.stack([(n0 - n1) / (n0 + n1), (n2 - n3) / (n2 + n3)], axis=-1)


def polynomial_terms(measured: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "... 5"]:
    """The terms of the polynomial (`TERMS`) at measured (q_m, u_m)."""
    q, u = measured[..., 0], measured[..., 1]
    return np.stack([np.ones_like(q), q, u, q**2, u**2], axis=-1)


def polynomial(
    coefficients: Float[np.ndarray, "p 2 5"], measured: Float[np.ndarray, "p n 2"]
) -> Float[np.ndarray, "p n 2"]:
    """(q_i, u_i) of measurements at points with their coefficients."""
    return np.einsum("pnt,pct->pnc", polynomial_terms(measured), coefficients)


@dataclasses.dataclass(frozen=True)
class PaperCalibration:
    """Paper II's calibration at grid points `x`, `y` (deg), for one filter with the calibration plate out.

    `coefficients` (point, q or u, term); `transmission` (point, camera, 1 q u) with mean 1 at unpolarised light;
    `delta` (Δq, Δu) as found with the transmissions; `spread` σ_q, σ_u of the test stars after it;
    `condition` of the design matrix with columns scaled to unit length.
    """

    x: Float[np.ndarray, " p"]
    y: Float[np.ndarray, " p"]
    coefficients: Float[np.ndarray, "p 2 5"]
    transmission: Float[np.ndarray, "p 4 3"]
    delta: Float[np.ndarray, "p 2"]
    spread: Float[np.ndarray, "p 2"]
    condition: Float[np.ndarray, " p"]

    def recover(self, measured: Float[np.ndarray, "p n 2"]) -> Float[np.ndarray, "p n 2"]:
        """(q_i, u_i) − (Δq, Δu) of measurements at the grid points."""
        return polynomial(self.coefficients, measured) - self.delta[:, None]

    def between(self, x: Float[np.ndarray, " m"], y: Float[np.ndarray, " m"]) -> PaperCalibration:
        """Coefficients and Δ interpolated bilinearly to other positions, which the paper excludes.

        Between points on a line of constant X or Y linearly along it. Raises ValueError where the points are no regular
        grid, and for positions beside such a line.
        """
        axes = [(np.unique(have), asked) for have, asked in ((self.y, y), (self.x, x))]
        along = [axis for axis in axes if len(axis[0]) > 1]
        beside = [axis for axis in axes if len(axis[0]) == 1 and not np.allclose(*axis, rtol=0.0, atol=1e-9)]
        if len(axes[0][0]) * len(axes[1][0]) != len(self.x) or not along or beside:
            raise ValueError("the points with polariser exposures are no regular grid: nothing between them")
        order = np.lexsort((self.x, self.y)).reshape([len(values) for values, _ in along])
        grid, places = tuple(values for values, _ in along), np.stack([asked for _, asked in along], axis=1)

        def mixed(values: np.ndarray) -> np.ndarray:
            beyond: Any = {"bounds_error": False, "fill_value": None}  # linear there as well
            return RegularGridInterpolator(grid, values[order], **beyond)(places)

        fields = ("coefficients", "transmission", "delta", "spread", "condition")
        return PaperCalibration(x, y, *(mixed(getattr(self, name)) for name in fields))


def polariser_exposures(calset: CalibrationSet, filter_name: str = DEFAULT_FILTER) -> Int[np.ndarray, " e"]:
    """Exposures through the polariser in a filter with the calibration plate out.

    Raises `DataError` if there are fewer than five: the polynomial has five coefficients.
    """
    e = calset.exposures
    rows = np.flatnonzero(e.clp_in & ~e.position(CALIBRATION_PLATE).inside & (e.filter == filter_name))
    angles = len(np.unique(np.round(np.mod(e.clp_angle[rows], 180.0), 6)))
    if angles < len(TERMS):
        raise DataError(
            f"EXPOSURES: {angles} polariser angles (modulo 180°) in {filter_name} with the calibration plate out; "
            f"the polynomial of Paper II needs {len(TERMS)}: observe more angles, or name another --filter"
        )
    return rows


def fit_paper(
    calset: CalibrationSet, filter_name: str = DEFAULT_FILTER, stars: QuPairs | None = None
) -> PaperCalibration:
    """Steps 1 and 2 of Paper II at all points that have all polariser exposures.

    Raises `DataError` if there are too few angles, or no such point.
    """
    rows = polariser_exposures(calset, filter_name)
    block = calset.intensities.block(0, len(calset.points))
    complete = np.flatnonzero(block.used[:, rows].all(axis=1))
    if complete.size == 0:
        raise DataError("INTENSITIES: no point has been measured at all polariser angles")
    counts = block.counts[complete][:, rows]
    states = polariser_states(calset.exposures.clp_angle[rows])
    coefficients, condition = fit_polynomials(measured_qu(counts), states)
    transmission = fit_transmissions(counts, states)
    return with_test_stars(block.x[complete], block.y[complete], coefficients, condition, transmission, stars)


def with_test_stars(
    x: Float[np.ndarray, " p"],
    y: Float[np.ndarray, " p"],
    coefficients: Float[np.ndarray, "p 2 5"],
    condition: Float[np.ndarray, " p"],
    transmission: Float[np.ndarray, "p 4 3"],
    stars: QuPairs | None = None,
) -> PaperCalibration:
    """Step 2: Δ and σ of the test stars (default: `sample_stars()`) seen through the transmissions."""
    stars = sample_stars() if stars is None else stars
    error = polynomial(coefficients, measured_qu(transmitted(transmission, stars))) - stars
    return PaperCalibration(
        x, y, coefficients, transmission, error.mean(axis=1), error.std(axis=1, ddof=1), condition
    )


def polariser_states(angle: Float[np.ndarray, " e"]) -> QuPairs:
    """(q, u) behind the polariser at `angle` (deg)."""
    c = (1.0 - EXTINCTION) / (1.0 + EXTINCTION)
    two = 2.0 * np.deg2rad(angle)
    return c * np.stack([np.cos(two), np.sin(two)], axis=1)


def fit_polynomials(
    measured: Float[np.ndarray, "p e 2"], states: QuPairs
) -> tuple[Float[np.ndarray, "p 2 5"], Float[np.ndarray, " p"]]:
    """Coefficients at every point by least squares, and the condition number of the scaled design matrix."""
    design = polynomial_terms(measured)
    scale = np.linalg.norm(design, axis=1)
    u, size, vt = np.linalg.svd(design / scale[:, None], full_matrices=False)
    solution = np.einsum("pst,ps,pes,ec->pct", vt, 1.0 / size, u, states, optimize=True)
    return solution / scale[:, None], size[:, 0] / size[:, -1]


def fit_transmissions(counts: Float[np.ndarray, "p e 4"], states: QuPairs) -> Float[np.ndarray, "p 4 3"]:
    """T_k at every point, with the flux of every exposure free: alternating least squares.

    Given the fluxes the transmissions are linear, and the other way round. Photon noise weighs 1/N; the mean of
    the four T_k of unpolarised light is 1.
    """
    s = np.concatenate([np.ones((len(states), 1)), states], axis=1)
    weight = 1.0 / np.maximum(counts, 0.01 * counts.mean(axis=(1, 2), keepdims=True))
    flux = counts.sum(axis=2)
    vectors = np.zeros((len(counts), 4, 3))
    for _ in range(_ROUNDS):
        normal = np.einsum("pek,pe,ei,ej->pkij", weight, flux**2, s, s, optimize=True)
        right = np.einsum("pek,pe,pek,ei->pki", weight, flux, counts, s, optimize=True)
        vectors = np.linalg.solve(normal, right[..., None])[..., 0]
        vectors /= vectors[..., 0].mean(axis=1)[:, None, None]
        model = np.einsum("pki,ei->pek", vectors, s)
        flux = np.sum(weight * model * counts, axis=2) / np.sum(weight * model**2, axis=2)
    return vectors


BOXES_ALONG, BOX_WIDTH = 5, 0.116  # boxes along a side; deg (7 arcmin)
TOLERANCE = 5e-4
DOUBTED_BELOW = 0.5  # weight below which a patch is pointed out


@dataclasses.dataclass(frozen=True)
class Patches:
    """Moon patches, each judged by itself.

    `exposure` is the row of each in EXPOSURES; `scale` s_m and `offset` c_m of the fit, `flatness` χ²/dof, `departure`
    D_m and `weight` as in the head of this file; `depolarisation` is the δ that the patches agree on.
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
        names = "exposure", "scale", "chi2_per_dof", "departure_percent", "weight"
        columns = numbers[self.exposure], self.scale, self.flatness, 100.0 * self.departure, self.weight
        rows = zip(*(values.tolist() for values in columns), strict=True)
        patches = [dict(zip(names, row, strict=True)) for row in rows]
        doubted = numbers[self.exposure[self.doubted]].tolist()
        return {"depolarisation": self.depolarisation, "patches": patches, "doubted": doubted}


def judge_patches(calset: CalibrationSet, calibration: Calibration) -> Patches:
    """Judge every Moon exposure of a set (calibration plate out or in) with a calibration.

    Raises `DataError` if there is none.
    """
    e = calset.exposures
    moon = np.flatnonzero(e.direct("moon"))
    if moon.size == 0:
        raise DataError("EXPOSURES: there is no full-Moon exposure (KIND moon, polariser out)")
    block = calset.intensities.block(0, len(calset.points))
    q, u = moon_sky(e.mjd[moon], e.ra[moon], e.dec[moon], e.rotator[moon], calset.site, block.x, block.y)
    sky = np.stack([q, u], axis=-1)  # point, exposure, (q, u)
    analysis = AnalysisVectors(calibration)
    settings = analysis.reduced(Settings.of(e, analysis.instrument.patched().moving()))
    rows = []
    for k, m in enumerate(moon):
        measured = np.flatnonzero(block.used[:, m])
        x, y, teff = block.x[measured], block.y[measured], np.full(len(measured), float(e.teff[m]))
        vectors = analysis.coloured(settings[m : m + 1], x, y, teff)
        counts, sigma = block.counts[measured, m], block.sigma[measured, m]
        estimates = estimate(vectors, counts, sigma, np.arange(len(measured)))
        rows.append(_smooth_fit(estimates.qu, estimates.photon, sky[measured, k]))
    scale, offset, flatness, mean = (np.array(column) for column in zip(*rows, strict=True))
    depolarisation = float(np.median(scale))
    # Mean over the patch of (q, u) − δ R = (s − δ) <R> + c.
    departure = np.hypot(*((scale - depolarisation)[:, None] * mean + offset).T)
    weight = 1.0 / (1.0 + (departure / TOLERANCE) ** 2) / np.maximum(1.0, flatness)
    return Patches(moon, scale, offset, flatness, departure, weight, depolarisation)


def _smooth_fit(
    qu: Float[np.ndarray, "p 2"], covariance: Float[np.ndarray, "p 2 2"], sky: Float[np.ndarray, "p 2"]
) -> tuple[float, Float[np.ndarray, " 2"], float, Float[np.ndarray, " 2"]]:
    """Weighted fit of s R + c: s, c, χ²/dof and the mean of R.

    The gradient of R over 35′ is small beside its mean, so s and c are separated only weakly; a pull of s to
    the value of the means, |<q, u>| / |<R>| ± 1, keeps it in bounds.
    """
    good = np.isfinite(qu).all(axis=1)
    qu, covariance, sky = qu[good], covariance[good], sky[good]
    white = np.linalg.cholesky(np.linalg.inv(covariance)).swapaxes(1, 2)
    weights = np.broadcast_to(np.eye(2), (len(qu), 2, 2))
    design = (white @ np.concatenate([sky[..., None], weights], axis=2)).reshape(-1, 3)
    data = (white @ qu[..., None]).reshape(-1)
    along = (white @ sky[..., None]).reshape(-1)
    only = float(along @ data / (along @ along))
    pull = np.array([[1.0, 0.0, 0.0]])
    solution = np.linalg.lstsq(np.concatenate([design, pull]), np.append(data, only), rcond=None)[0]
    residual = data - design @ solution
    mean, flatness = sky.mean(axis=0), float(residual @ residual / max(len(residual) - 3, 1))
    return only, solution[1:] + (solution[0] - only) * mean, flatness, mean


# ----------------------------------------------------------------------------------- the scheme of the paper


def box_number(x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]) -> Int[np.ndarray, " p"]:
    """Number of the box of every field point, row by row from the lower left; the outer boxes reach the edge."""
    places = np.floor(np.stack([x, y]) / BOX_WIDTH + 0.5 * BOXES_ALONG)
    column, row = np.clip(places, 0, BOXES_ALONG - 1).astype(int)
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

    `weight` are the weights of the Moon exposures with the calibration plate out, in their order (default: equal).
    Raises `DataError` if there are no standards at the centres of the boxes, or no Moon exposures.
    """
    e = calset.exposures
    block = calset.intensities.block(0, len(calset.points))
    moon = np.flatnonzero(e.direct("moon") & ~e.position(CALIBRATION_PLATE).inside)
    standard = np.flatnonzero(e.direct("standard") & ~e.position(CALIBRATION_PLATE).inside)
    centre_x, centre_y = box_centres()
    grid = _positions(block, paper.x, paper.y)
    middle = _positions(block, centre_x, centre_y)
    seen = block.used[middle][:, standard]
    if not moon.size or not seen.any() or np.any(middle < 0):
        raise DataError(
            "POINTS: the full-Moon scheme needs Moon exposures, and standards at the centres of 5 × 5 boxes of 7'"
        )
    weight = np.ones(len(moon)) if weight is None else weight

    # Standards: Δ at the centres, where the polynomials are interpolated.
    local = paper.between(centre_x, centre_y).coefficients
    star, sources = block.source[middle][:, standard], calset.sources
    true = np.stack(sky_to_instrument(sources.q[star], sources.u[star], e.rotator[standard]), axis=-1)
    corrected = polynomial(local, measured_qu(block.counts[middle][:, standard]))
    used = seen[..., None]
    delta_centre = np.sum(np.nan_to_num(corrected - true) * used, axis=1) / np.maximum(used.sum(axis=1), 1)

    # Moon: the patch is measured where the polynomials are closest to a centre, and is the same in all the box.
    moon_qu = polynomial(paper.coefficients, measured_qu(block.counts[grid][:, moon]))
    box = box_number(paper.x, paper.y)
    delta = np.empty_like(paper.delta)
    for b in range(BOXES_ALONG * BOXES_ALONG):
        inside = np.flatnonzero(box == b)
        if inside.size == 0:
            continue
        away = np.hypot(paper.x[inside] - centre_x[b], paper.y[inside] - centre_y[b])
        near = inside[away <= away.min() + 0.25 * BOX_WIDTH]
        patch = moon_qu[near].mean(axis=0) - delta_centre[b]
        delta[inside] = np.average(moon_qu[inside] - patch, axis=1, weights=weight)
    return dataclasses.replace(paper, delta=delta)


def _positions(block: Block, x: Float[np.ndarray, " k"], y: Float[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """The point of a set at each position, −1 where there is none within a thousandth of a degree."""
    distance = np.hypot(block.x[:, None] - x, block.y[:, None] - y)
    nearest = distance.argmin(axis=0)
    return np.where(distance[nearest, np.arange(len(x))] < 1e-3, nearest, -1)
