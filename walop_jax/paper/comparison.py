"""Paper II's method beside the joint model: the same data, the same stars, on the grid points and between them.

Stars with p ≤ 5 % are seen through *reference* analysis vectors: those of the joint model, or of the true instrument
where a truth table comes with the set. Paper II's polynomial gets their (q_m, u_m), the joint model their four
intensities. Without a truth the error of the joint model is what its covariance promises.

Why there are Δq and Δu. With throughput imbalance α an ideal pair of cameras measures r = (α + q)/(1 + αq), whose
inverse is q = −α + r + α r² + …: squares are needed. But behind a polariser q² + u² = 1, so (q_m, u_m) runs round an
ellipse on which 1, q_m² and u_m² are nearly dependent: coefficients may move by λ (1, −1, −1) and the polarised states
hardly notice, while unpolarised light, near q_m = u_m = 0, is off by λ. Noise and the terms left out (q_m u_m, third
order) decide λ. Where cross-talk makes u_m follow q_m, two more directions go the same way. One unpolarised exposure
fixes what noise does not; intensities never have the question.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.accuracy import GOAL, LARGEST_P, SMALLEST_DETERMINANT, STARS, sample_stars
from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.kinds import CALIBRATION_PLATE
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import DEFAULT_FILTER, Settings
from walop_jax.io.display import Display, Drawn
from walop_jax.io.errors import DataError
from walop_jax.io.text import two_digits
from walop_jax.paper import polynomial
from walop_jax.paper.polynomial import PaperCalibration, fit_polynomials, measured_qu
from walop_jax.paper.wavelength import DEGREE, TEMPERATURES, colour_spread, efficiencies, spread_document
from walop_jax.science import star_errors
from walop_jax.science.star_errors import (
    MethodErrors,
    RowVectors,
    Truth,
    determinant,
    statistics,
    transmitted,
)

LINES = 81  # wavelengths across the filter


@dataclasses.dataclass(frozen=True)
class Offsets:
    """Where Δq and Δu of Paper II come from, point by point (p, 2).

    `found` are Δq, Δu as in the paper; `along` is what the departure of the coefficients along the weakest direction of
    the design matrix makes of unpolarised light, `along_three` along its three weakest; `noiseless` is Δ of a fit to
    noise-free polarised states; `anchored` is Δ when one unpolarised exposure is added to the exposures of the set.
    """

    found: Float[np.ndarray, "p 2"]
    along: Float[np.ndarray, "p 2"]
    along_three: Float[np.ndarray, "p 2"]
    noiseless: Float[np.ndarray, "p 2"]
    anchored: Float[np.ndarray, "p 2"]
    condition: Float[np.ndarray, " p"]

    def document(self) -> dict[str, Any]:
        """Sizes in per cent, and the fraction of the variance of Δ that the weakest direction explains."""

        def size(values: Float[np.ndarray, "p 2"]) -> dict[str, float]:
            sizes = np.append(np.sqrt(np.mean(values**2, axis=0)), np.abs(values).max(axis=0))
            return dict(zip(("rms_q", "rms_u", "max_q", "max_u"), (100 * sizes).tolist(), strict=True))

        def explained(values: Float[np.ndarray, "p 2"]) -> dict[str, float]:
            unexplained = np.sum((self.found - values) ** 2, axis=0) / np.sum(self.found**2, axis=0)
            return {"q": 1.0 - float(unexplained[0]), "u": 1.0 - float(unexplained[1])}

        return {
            "found": size(self.found),
            "noiseless": size(self.noiseless),
            "with_one_unpolarised_exposure": size(self.anchored),
            "explained_by_weakest_direction": explained(self.along),
            "explained_by_three_weakest_directions": explained(self.along_three),
            "condition_number": _summary(self.condition),
        }


def offsets(
    paper: PaperCalibration,
    measured: Float[np.ndarray, "p e 2"],
    states: Float[np.ndarray, "e 2"],
    reference: RowVectors,
    stars: Float[np.ndarray, "n 2"],
) -> Offsets:
    """The reason for Δ shown on data: `measured` are the polarised states, `reference` the instrument."""
    centre = measured_qu(reference[..., 0])  # (q_m, u_m) of unpolarised light
    light = np.concatenate([states, np.zeros((1, 2)), stars])
    exact, _ = fit_polynomials(measured_qu(transmitted(reference, light)), light)
    design = polynomial.polynomial_terms(measured)
    scale = np.linalg.norm(design, axis=1)
    directions = np.linalg.svd(design / scale[:, None], full_matrices=False)[2]
    departure = (paper.coefficients - exact) * scale[:, None]

    def along(count: int) -> Float[np.ndarray, "p 2"]:
        weak, terms = directions[:, -count:], polynomial.polynomial_terms(centre) / scale
        return np.einsum("pct,pnt,pnv,pv->pc", departure, weak, weak, terms, optimize=True)

    smooth, _ = fit_polynomials(measured_qu(transmitted(reference, states)), states)
    anchored, _ = fit_polynomials(
        np.concatenate([measured, centre[:, None]], axis=1), np.concatenate([states, np.zeros((1, 2))])
    )

    def delta(coefficients: Float[np.ndarray, "p 2 5"]) -> Float[np.ndarray, "p 2"]:
        return polynomial.with_test_stars(
            paper.x, paper.y, coefficients, paper.condition, reference, stars
        ).delta

    found, noiseless, with_one = (delta(values) for values in (paper.coefficients, smooth, anchored))
    return Offsets(found, along(1), along(3), noiseless, with_one, paper.condition)


@dataclasses.dataclass(frozen=True, repr=False)
class Comparison(Drawn):
    """Paper II's method and the joint model on one calibration set.

    `grid` has the errors at the points that the polynomials were made for, `between` the errors elsewhere; `truth` says
    whether the joint model was compared with a truth there (with its covariance otherwise).
    """

    _first_figure = "histogram"

    paper: PaperCalibration
    offsets: Offsets
    grid: MethodErrors
    between: MethodErrors
    truth: bool
    filter: str
    teff: float
    colours: Float[np.ndarray, "p 2"]
    lines: Float[np.ndarray, "w 7"]
    moon: dict[str, Any] | None

    def document(self) -> dict[str, Any]:
        """Everything as numbers in per cent; errors are rms over the stars, statistics over the field."""
        spread, largest = 100.0 * self.paper.spread, 100.0 * np.abs(self.paper.delta).max(axis=0)
        return {
            "filter": self.filter,
            "teff": self.teff,
            "stars": STARS,
            "largest_p": LARGEST_P,
            "goal_percent": 100.0 * GOAL,
            "joint_errors_from": "truth" if self.truth else "covariance",
            "as_published": {
                "sigma_q": _summary(spread[:, 0]),
                "sigma_u": _summary(spread[:, 1]),
                "share_sigma_u_below_goal": float(np.mean(spread[:, 1] < 100.0 * GOAL)),
                "delta_max": dict(zip("qu", largest.tolist(), strict=True)),
            },
            "on_grid": self.grid.document(),
            "between": self.between.document(),
            "offsets": self.offsets.document(),
            "colour": {"temperatures": list(TEMPERATURES), "degree": DEGREE} | spread_document(self.colours),
            "full_moon": self.moon,
        }

    def display(self) -> Display:
        """Errors of q, u and p by both methods, on the grid points and between them."""
        rows = []
        for where, errors in (("on the grid", self.grid.document()), ("between", self.between.document())):
            for quantity in star_errors.QUANTITIES:
                for method, name in (("paper", "Paper II"), ("joint", "joint model")):
                    s = errors[method]["all"][quantity]
                    sizes = (two_digits(s[key]) for key in ("median", "rms", "p95", "max"))
                    rows.append((where, quantity, name, *sizes, f"{100 * s['share_below_goal']:.1f} %"))
        source = f"errors from the {'truth' if self.truth else 'covariance'}"
        stars = f"p ≤ {100 * LARGEST_P:.0f} %, through {self.filter}"
        sizes = (f">{s} (%)" for s in ("median", "rms", "95 %", "max"))
        title = "Errors of stars over the field, Paper II beside the joint model"
        head = ("where", "of", "method", *sizes, ">below 0.1 %")
        return Display(title, (("stars", stars), ("joint model", source)), head, tuple(rows))

    def columns(self) -> dict[str, tuple[np.ndarray, str]]:
        """One row per point, the grid first: position, errors of both methods, the values of the paper."""
        count = len(self.between.x)

        def both(name: str) -> np.ndarray:
            return np.concatenate([getattr(errors, name) for errors in (self.grid, self.between)])

        columns = {
            "X": (both("x"), "[deg] field position"),
            "Y": (both("y"), "[deg] field position"),
            "GRID": (np.arange(len(both("x"))) < len(self.grid.x), "a point with a polynomial of its own"),
            "ZONE": (both("zone"), "one exposure carries almost no information on u"),
        }
        for k, quantity in enumerate(star_errors.QUANTITIES):
            for method in ("paper", "joint"):
                about = f"rms error of {quantity}, {method}"
                columns[f"{quantity}_{method}".upper()] = both(method)[:, k], about
        for name, values in (("DELTA", self.paper.delta), ("SIGMA", self.paper.spread)):
            padded = np.concatenate([values, np.full((count, 2), np.nan)])
            columns[f"{name}_Q"] = padded[:, 0], f"{name.lower()} of q as in Paper II"
            columns[f"{name}_U"] = padded[:, 1], f"{name.lower()} of u as in Paper II"
        return columns


def _summary(values: Float[np.ndarray, " p"]) -> dict[str, float]:
    return {"median": float(np.median(values)), "max": float(values.max())}


class Published(NamedTuple):
    """Paper II's method on a set, which needs no other calibration: at its grid points, and `between` them."""

    paper: PaperCalibration
    between: PaperCalibration
    stars: Float[np.ndarray, "n 2"]


def published_method(
    calset: CalibrationSet,
    truth: Truth | None = None,
    filter_name: str = DEFAULT_FILTER,
    seed: int = 0,
    count: int = 400,
) -> Published:
    """Run Paper II's method on a set, and interpolate it to the points of `truth`, or to `count` random ones.

    Raises `DataError` and ValueError as `fit_paper` and `PaperCalibration.between`: a set on which the method cannot be
    run is refused here, before anything else is fitted to it.
    """
    stars = sample_stars(seed=seed)
    paper = polynomial.fit_paper(calset, filter_name, stars)
    if truth is None:
        rng = np.random.default_rng([seed, 1])
        x, y = (rng.uniform(edge.min(), edge.max(), count) for edge in (paper.x, paper.y))
    else:
        x, y = truth.x, truth.y
    return Published(paper, paper.between(x, y), stars)


def compare(
    calset: CalibrationSet,
    calibration: Calibration,
    truth: Truth | None = None,
    filter_name: str = DEFAULT_FILTER,
    seed: int = 0,
    count: int = 400,
    *,
    published: Published | None = None,
) -> Comparison:
    """Judge Paper II's method on a set beside a calibration of the same set.

    The stars have the colour of the source behind the polariser. `published` is the result of `published_method` for
    the same set, truth, filter, seed and `count`, which is run here otherwise, and raises as it does.
    """
    paper, between, stars = published or published_method(calset, truth, filter_name, seed, count)
    exposures = polynomial.polariser_exposures(calset, filter_name)
    teff = float(np.median(calset.exposures.teff[exposures]))
    analysis, setting = AnalysisVectors(calibration), Settings.default(1, filter_name)

    def vectors(x: Float[np.ndarray, " p"], y: Float[np.ndarray, " p"]) -> RowVectors:
        return analysis.coloured(setting, x, y, np.full(len(x), teff))

    def errors_at(
        x: Float[np.ndarray, " p"],
        y: Float[np.ndarray, " p"],
        local: PaperCalibration,
        true: RowVectors | None,
    ) -> MethodErrors:
        joint = vectors(x, y)
        reference = joint if true is None else true
        of_paper = star_errors.star_errors(local.recover(measured_qu(transmitted(reference, stars))), stars)
        if true is None:
            of_joint = star_errors.promised_errors(analysis, setting, x, y, stars)
        else:
            of_joint = star_errors.joint_errors(joint, reference, stars)
        return MethodErrors(x, y, of_paper, of_joint, np.abs(determinant(reference)) < SMALLEST_DETERMINANT)

    x, y = between.x, between.y
    true = None if truth is None else star_errors.truth_vectors(vectors(x, y), truth.matrix)
    on_grid = vectors(paper.x, paper.y)
    block = calset.intensities.block(0, len(calset.points))
    complete = block.used[:, exposures].all(axis=1)
    measured = measured_qu(block.counts[complete][:, exposures])
    states = polynomial.polariser_states(calset.exposures.clp_angle[exposures])
    curve = calibration.filter_curve(filter_name)
    lit = curve.wavelength[curve.throughput > 0.05 * curve.throughput.max()]
    wavelength = np.linspace(lit[0], lit[-1], LINES)
    far = int(np.argmax(paper.x + paper.y))
    matrices = efficiencies(calibration, float(paper.x[far]), float(paper.y[far]), wavelength)
    return Comparison(
        paper=paper,
        offsets=offsets(paper, measured, states, on_grid, stars),
        grid=errors_at(paper.x, paper.y, paper, None),
        between=errors_at(x, y, between, true),
        truth=truth is not None,
        filter=filter_name,
        teff=teff,
        colours=colour_spread(calibration, paper.x, paper.y, filter_name=filter_name),
        lines=np.concatenate([wavelength[:, None], matrices.reshape(LINES, 6)], axis=1),
        moon=_moon(calset, calibration, paper, on_grid, stars),
    )


def _moon(
    calset: CalibrationSet,
    calibration: Calibration,
    paper: PaperCalibration,
    reference: RowVectors,
    stars: Float[np.ndarray, "n 2"],
) -> dict[str, Any] | None:
    """Verdicts on the Moon patches, and the errors that the full-Moon scheme leaves at the grid points."""
    e = calset.exposures
    if not np.any(e.direct("moon")):
        return None
    patches = polynomial.judge_patches(calset, calibration)
    document = patches.document(e.exposure)
    weight = patches.weight[~e.position(CALIBRATION_PLATE).inside[patches.exposure]]
    try:
        of_weights = {"equal_weights": None, "down_weighted": weight}
        schemes = {name: polynomial.full_moon_scheme(calset, paper, w) for name, w in of_weights.items()}
    except (DataError, ValueError) as error:
        return document | {"scheme": None, "why_not": str(error)}
    measured = measured_qu(transmitted(reference, stars))
    outside = np.abs(determinant(reference)) >= SMALLEST_DETERMINANT
    errors = {
        name: star_errors.star_errors(scheme.recover(measured), stars) for name, scheme in schemes.items()
    }
    return document | {"scheme_outside_zone": {name: statistics(v, outside) for name, v in errors.items()}}
