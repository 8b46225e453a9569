"""Does an old calibration still fit new data, and what has moved?

The new set is fitted with the old model: plates, effects, priors and what is held. What both fits have in common, the
instrument's parameters, is compared: Δ = new − old with the covariance V.

    V = C_old + C_new − C_old P C_new − C_new P C_old
    T = Δᵀ V⁻¹ Δ                        everything at once: χ² for an instrument that has not changed
    z = Δ_i/√V_ii                       one parameter, whatever the others did
    a = (V⁻¹Δ)_i/√(V⁻¹)_ii              one parameter, if it alone has changed

T of seventy directions hides one that has changed by five standard errors. So the largest |z| or |a| is asked as well,
corrected for as many as there are (Šidák 1967, JASA 62, 626); the verdict is that of the smaller p, taken twice. What
could have been missed is said for the matrix: five standard errors of its change, √(J V Jᵀ).

P is the inverse covariance of the priors: both fits lean on the same ones, which makes them more alike than two
independent measurements; where neither has measured anything V vanishes, and such directions are left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import SMALLEST_DETERMINANT, sample_stars
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.fit.model_file import SKY_AND_STARS, model_like
from walop_jax.fit.refit import FitResult, fit, with_honest_errors
from walop_jax.io.display import Display, Displayed
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.text import probability, two_digits, value_and_error, with_minus_sign
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.conventions import matrix_elements
from walop_jax.model.specification import Model
from walop_jax.science.star_errors import determinant, joint_errors, statistics

Vector = Float[np.ndarray, " k"]
Matrix = Float[np.ndarray, "k k"]

CHANCE = 0.01
COPIES = 1e-12  # chance of so small a χ² from which two sets are taken for one
_SHOWN = 8  # parameters
SURE = 5.0  # standard errors
_KNOWN = 1e-7  # share of the largest eigenvalue below which a direction was measured by neither
_LEANS = (
    1e-4  # of the variances of both fits, below which both lean on the prior and rounding is all that differs
)


@dataclasses.dataclass(frozen=True)
class MovedParameter:
    """A parameter before and after; `z` its change in standard errors of the change."""

    name: str
    unit: str
    old: float
    new: float
    error: float
    z: float


@dataclasses.dataclass(frozen=True)
class LargestChange:
    """The parameter whose change stands out most, `z` standard errors of it, of so many changes that were `asked` for.

    `alone` says that the change is that of this parameter with all others as they were. `p_value` is corrected for the
    number of changes.
    """

    name: str
    z: float
    alone: bool
    asked: int
    p_value: float


@dataclasses.dataclass(frozen=True, repr=False)
class Epoch(Displayed):
    """The verdict: `fits` unless the change is one that chance makes in less than 1 % of cases.

    `largest` is the change that stands out most by itself, `p_value` the chance of it and of the sum taken together.
    `visible` is the smallest change of each element of the matrix (per cent, median over the field) that would have
    been seen with certainty, five standard errors of it. `moved` sorts parameters by |z|; `chi2_old` is of the new data
    with the old instrument; `star_errors` are statistics (per cent) of what stars would be off, outside the zone
    without u, if the old calibration were used and the new one true. `new_trusted` and `warnings` are what the fit of
    the new set is worth: where it is not to be trusted, neither are the parameters that seem to have moved.
    """

    fits: bool
    p_value: float
    test: float
    directions: int
    largest: LargestChange
    visible: dict[str, float]
    chi2_old: float
    chi2_new: float
    dof: int
    moved: tuple[MovedParameter, ...]
    star_errors: dict[str, dict[str, float]]
    new_trusted: bool
    warnings: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """True if the old calibration may be used on: nothing has moved, and a fit to be trusted says so."""
        return self.fits and self.new_trusted

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return dataclasses.asdict(self)

    def to_table(self) -> Any:
        """The parameters, farthest moved first, as an astropy table."""
        columns = {"NAME": "name", "OLD": "old", "NEW": "new", "ERROR": "error", "Z": "z", "UNIT": "unit"}
        about = dict.fromkeys(columns, "") | {"ERROR": "standard error of the change", "Z": "change / error"}
        return astropy_table(
            {k: (np.array([getattr(m, v) for m in self.moved]), "", about[k]) for k, v in columns.items()}
        )

    def display(self) -> Display:
        """The verdict, and the parameters that have moved farthest."""
        rows = []
        for entry in self.moved[:_SHOWN]:
            error = max(entry.error, 1e-6 * abs(entry.new))  # of the same data it is rounding alone
            old, new = (value_and_error(value, error)[0] for value in (entry.old, entry.new))
            rows.append((entry.name, old, new, with_minus_sign(f"{entry.z:+.1f}"), entry.unit))
        errors = self.star_errors["p"]
        return Display(
            title="The old calibration still fits" if self.fits else "The instrument HAS CHANGED",
            facts=(
                (
                    "chance",
                    f"p {probability(self.p_value)} (χ² = {self.test:.1f} in {self.directions} directions, and the "
                    "largest change)",
                ),
                (
                    "largest change",
                    f"{self.largest.name} by {with_minus_sign(f'{self.largest.z:+.1f}')} standard errors"
                    f"{' if it alone has changed' if self.largest.alone else ''}: "
                    f"p {probability(self.largest.p_value)} for the largest of {self.largest.asked}",
                ),
                (
                    "would be seen",
                    f"a change of {', '.join(f'{n} {two_digits(v)} %' for n, v in self.visible.items())} "
                    "(5 standard errors, median over the field)",
                ),
                (
                    "stars with the old one",
                    f"off by {two_digits(errors['median'])} % in p (median), {two_digits(errors['max'])} % at most",
                ),
            ),
            head=("parameter", ">old", ">new", ">change / σ", "unit"),
            rows=tuple(rows),
            notes=(f"{len(self.moved) - _SHOWN} more in to_table()",) if len(self.moved) > _SHOWN else (),
        )


def fit_like(old: Calibration, calset: CalibrationSet) -> FitResult:
    """Fit a new set with the model of an old calibration.

    Raises ValueError for a set of another instrument and RuntimeError if the fit does not converge.
    """
    if calset.instrument != old.model.name:
        raise ValueError(f"the new set is of {calset.instrument}, the calibration of {old.model.name}")
    result = with_honest_errors(fit(Likelihood.of(calset, model_like(calset, old.model))))
    if not result.converged:
        raise RuntimeError(f"the fit of the new set did not converge: {result.minimum.message}")
    return result


def epoch(old: Calibration, result: FitResult) -> Epoch:
    """Compare an old calibration with the fit of a new set (`fit_like`, examined)."""
    new, model = Calibration.from_fit(result), result.model
    names = shared_parameters(old.model, model)
    a = np.array([old.model.index(name) for name in names])
    b = np.array([model.index(name) for name in names])
    change = new.values[b] - old.values[a]
    before, after = old.covariance[np.ix_(a, a)], new.covariance[np.ix_(b, b)]
    width = np.array([(model[name].prior or (0.0, np.inf))[1] for name in names])
    both = before @ (after / width[:, None] ** 2)
    covariance = before + after - both - both.T
    sigma = np.sqrt(np.diag(before + after))
    measured = MeasuredChange.of(names, change, covariance, sigma)
    test, directions, largest = measured.chi2, measured.directions, measured.largest()
    values = new.values.copy()
    values[b] = old.values[a]
    error = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    moved = [
        MovedParameter(n, model[n].unit, float(old.values[i]), float(new.values[j]), float(s), float(d / s))
        for n, i, j, d, s in zip(names, a, b, change, error, strict=True)
        if s > 0
    ]
    p_value = min(1.0, 2.0 * min(float(special.chdtrc(directions, test)), largest.p_value))
    of_all = np.zeros_like(new.covariance)
    of_all[np.ix_(b, b)] = covariance
    return Epoch(
        fits=p_value > CHANCE,
        p_value=p_value,
        test=test,
        directions=directions,
        largest=largest,
        visible=_visible(dataclasses.replace(new, covariance=of_all)),
        chi2_old=result.likelihood.expand(values, near=result.posterior).chi2,
        chi2_new=result.chi2,
        dof=result.dof,
        moved=tuple(sorted(moved, key=lambda entry: -abs(entry.z))),
        star_errors=_star_errors(old, new),
        new_trusted=result.trusted,
        warnings=(*result.warnings, *_too_alike(test, directions)),
    )


def _too_alike(test: float, directions: int) -> Iterator[str]:
    """A sentence where two sets agree better than independent ones ever do."""
    if special.chdtr(directions, test) < COPIES:
        yield (
            f"old and new agree better than independent data do (χ² = {test:.2g} in {directions} directions): are they "
            "the same measurements, at other times?"
        )


def shared_parameters(old: Model, new: Model) -> list[str]:
    """Names of the instrument's parameters that are free in both models."""
    free = [{m.parameters[i].name for i in m.free} for m in (old, new)]
    return [name for name in new.names if name in free[0] & free[1] and new[name].part not in SKY_AND_STARS]


class MeasuredChange(NamedTuple):
    """A change in units of `sigma`, for the parameters that were known at all, and V⁻¹ over what was measured of it.

    `directions` is the number of those that were measured.
    """

    names: tuple[str, ...]
    change: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"]
    inverse: Float[np.ndarray, "k k"]
    directions: int

    @classmethod
    def of(cls, names: Sequence[str], change: Vector, covariance: Matrix, sigma: Vector) -> MeasuredChange:
        """The change of parameters, each in units of its `sigma`; those with none are not known."""
        known = np.flatnonzero(sigma > 0)
        unit = sigma[known]
        scaled = covariance[np.ix_(known, known)] / np.outer(unit, unit)
        value, vector = np.linalg.eigh(scaled)
        good = value > _KNOWN * value[-1]
        inverse = (vector[:, good] / value[good]) @ vector[:, good].T
        return cls(
            tuple(names[k] for k in known.tolist()), change[known] / unit, scaled, inverse, int(good.sum())
        )

    @property
    def chi2(self) -> float:
        """Δᵀ V⁻¹ Δ over the directions that were measured."""
        return float(self.change @ self.inverse @ self.change)

    def largest(self) -> LargestChange:
        """The largest of the changes of single parameters, each by itself and as if nothing else had changed."""
        each, alone = np.diag(self.covariance), np.diag(self.inverse)
        width = np.sqrt(np.stack([np.where(each > _LEANS, each, np.inf), np.where(alone > 0, alone, np.inf)]))
        z = np.stack([self.change, self.inverse @ self.change]) / width
        way, i = np.unravel_index(np.abs(z).argmax(), z.shape)
        asked = int(np.isfinite(width).sum())
        p = float(special.chdtrc(1, z[way, i] ** 2))
        corrected = float(-np.expm1(asked * np.log1p(-p))) if p < 1.0 else 1.0
        return LargestChange(self.names[int(i)], float(z[way, i]), bool(way), asked, corrected)


def _visible(changed: Calibration) -> dict[str, float]:
    """`SURE` errors of each matrix element, median over the field, per cent; the covariance is that of the change."""
    x, y = changed.raster(4)
    name = str(np.unique(changed.exposures.filter)[-1])
    _, covariance = changed.matrix(x, y, changed.usual_settings(1, name))
    error = np.sqrt(np.clip(np.diagonal(covariance, axis1=1, axis2=2), 0.0, None))
    elements = matrix_elements(len(changed.model.template.cameras.pairs))
    return dict(zip(elements, (100.0 * SURE * np.median(error, axis=0)).tolist(), strict=True))


def _star_errors(old: Calibration, new: Calibration) -> dict[str, dict[str, float]]:
    x, y = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 200))
    low_x, high_x, low_y, high_y = new.field
    x, y = 0.5 * ((low_x + high_x) + (high_x - low_x) * x), 0.5 * ((low_y + high_y) + (high_y - low_y) * y)
    settings, pairs = _seen_through(new), new.model.template.cameras.pairs
    vectors = []
    for calibration in (old, new):
        analysis = AnalysisVectors(calibration)
        vectors.append(np.stack([analysis.exact(setting, x, y)[:, 0] for setting in settings], axis=1))
    errors = joint_errors(vectors[0], vectors[1], sample_stars())
    return statistics(errors, determinant(vectors[1], pairs) >= SMALLEST_DETERMINANT)


def _seen_through(calibration: Calibration) -> list[Settings]:
    """The settings in which a star is seen: one exposure, or, with a single arm, one at each position of the set."""
    name = str(np.unique(calibration.exposures.filter)[-1])
    usual = calibration.usual_settings(filter_name=name)
    if len(calibration.model.template.arms) > 1:
        return [usual]
    seen = Settings.of(calibration.exposures, calibration.model.template.patched().moving())
    return [setting for setting, _ in usual[np.zeros(len(seen), int)].at(**seen.positions).layouts()]
