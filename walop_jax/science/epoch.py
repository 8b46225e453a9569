"""Does an old calibration still fit new data, and what has moved?

The new set is fitted with the old model: plates, effects, priors and what is held. What both fits have in common, the
instrument's parameters, is compared: Δ = new − old with the covariance V, z = Δ/√V_ii, and over all directions
T = Δᵀ V⁻¹ Δ, which is χ² for an instrument that has not changed.

    V = C_old + C_new − C_old P C_new − C_new P C_old

P is the inverse covariance of the priors: both fits lean on the same ones, which makes them more alike than two
independent measurements; where neither has measured anything V vanishes, and such directions are left out.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import special

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.maps import SMALLEST_DETERMINANT
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.fit.model_builder import SKY_AND_STARS, model_like
from walop_jax.fit.refit import FitResult, fit, with_honest_errors
from walop_jax.io.display import Display, Displayed
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.rounding import probability, two_digits, value_and_error, with_minus_sign
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.specification import Model
from walop_jax.science.star_errors import determinant, joint_errors, sample_stars, statistics

CHANCE = 0.01
_SHOWN = 8  # parameters
_KNOWN = 1e-7  # share of the largest eigenvalue below which a direction was measured by neither


@dataclasses.dataclass(frozen=True)
class MovedParameter:
    """A parameter before and after; `z` its change in standard errors of the change."""

    name: str
    unit: str
    old: float
    new: float
    error: float
    z: float


@dataclasses.dataclass(frozen=True, repr=False)
class Epoch(Displayed):
    """The verdict: `fits` unless the change is one that chance makes in less than 1 % of cases.

    `moved` sorts parameters by |z|; `chi2_old` is of the new data with the old instrument; `star_errors` are
    statistics (per cent) of what stars would be off, outside the zone without u, if the old calibration
    were used and the new one true. `new_trusted` and `warnings` are what the fit of the new set is worth: where it is
    not to be trusted, neither are the parameters that seem to have moved.
    """

    fits: bool
    p_value: float
    test: float
    directions: int
    chi2_old: float
    chi2_new: float
    dof: int
    moved: tuple[MovedParameter, ...]
    star_errors: dict[str, dict[str, float]]
    new_trusted: bool
    warnings: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether the old calibration may be used on: nothing has moved, and a fit to be trusted says so."""
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
            old, new = (value_and_error(value, entry.error)[0] for value in (entry.old, entry.new))
            rows.append((entry.name, old, new, with_minus_sign(f"{entry.z:+.1f}"), entry.unit))
        errors = self.star_errors["p"]
        return Display(
            title="The old calibration still fits" if self.fits else "The instrument HAS CHANGED",
            facts=(
                (
                    "chance",
                    f"p {probability(self.p_value)} (χ² = {self.test:.1f} in {self.directions} directions)",
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
    test, directions = chi2_of_change(change, covariance, np.sqrt(np.diag(before + after)))
    values = new.values.copy()
    values[b] = old.values[a]
    error = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    moved = [
        MovedParameter(n, model[n].unit, float(old.values[i]), float(new.values[j]), float(s), float(d / s))
        for n, i, j, d, s in zip(names, a, b, change, error, strict=True)
        if s > 0
    ]
    p_value = float(special.chdtrc(directions, test))
    return Epoch(
        fits=p_value > CHANCE,
        p_value=p_value,
        test=test,
        directions=directions,
        chi2_old=result.likelihood.expand(values, near=result.posterior).chi2,
        chi2_new=result.chi2,
        dof=result.dof,
        moved=tuple(sorted(moved, key=lambda entry: -abs(entry.z))),
        star_errors=_star_errors(old, new),
        new_trusted=result.trusted,
        warnings=result.warnings,
    )


def shared_parameters(old: Model, new: Model) -> list[str]:
    """Names of the instrument's parameters that are free in both models."""
    free = [{m.parameters[i].name for i in m.free} for m in (old, new)]
    return [name for name in new.names if name in free[0] & free[1] and not name.startswith(SKY_AND_STARS)]


def chi2_of_change(
    change: Float[np.ndarray, " k"], covariance: Float[np.ndarray, "k k"], sigma: Float[np.ndarray, " k"]
) -> tuple[float, int]:
    """Δᵀ V⁻¹ Δ over the directions that were measured, and their number; `sigma` sets the scale of each parameter."""
    known = sigma > 0
    scaled = covariance[np.ix_(known, known)] / np.outer(sigma[known], sigma[known])
    value, vector = np.linalg.eigh(scaled)
    good = value > _KNOWN * value[-1]
    along = vector[:, good].T @ (change[known] / sigma[known])
    return float(np.sum(along**2 / value[good])), int(good.sum())


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
