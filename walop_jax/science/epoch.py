"""Does an old calibration still fit new data, and which parameters have moved?

The new set is fitted with the old model: plates, effects, priors and held values. The common parameters of
both fits, those of the instrument, are compared: Δ = new − old with the covariance V.

    V = C_old + C_new − C_old P C_new − C_new P C_old
    T = Δᵀ V⁻¹ Δ                        everything at once: χ² for an instrument that has not changed
    z = Δ_i/√V_ii                       one parameter, whatever the others did
    a = (V⁻¹Δ)_i/√(V⁻¹)_ii              one parameter, if it alone has changed

T of seventy directions hides one that has changed by five standard errors. So the largest |z| or |a| is asked as well,
corrected for as many as there are (Šidák 1967, JASA 62, 626), and the smaller of both p again as one of two. What
could have been missed is said for the matrix: five standard errors of its change, √(J V Jᵀ).

Where the old model explains the new data no longer, the errors of its fit are those of the residuals that the change
itself has left, and Δ is nothing beside them. Then the comparison is with the fit of the model that does explain the
new data (`diagnosis`): the amplitudes of effects that it has and the old one lacks have changed from zero, which the
old calibration holds them at. Without such a model there is nothing to compare with.

P is the inverse covariance of the priors, those of standards included that have the same catalogue value in both: both
fits lean on the same ones, which makes them more alike than two independent measurements; where neither has measured
anything V vanishes, and such directions are left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import special

from walop_jax.calibration.accuracy import SMALLEST_DETERMINANT, sample_stars
from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.fit.base_model import SKY_AND_STARS
from walop_jax.fit.model_of_set import model_like
from walop_jax.fit.refit import FitResult, fit, with_empirical_covariance
from walop_jax.fit.verdict import NO_STRUCTURE, Doubt, Quality
from walop_jax.io.display import Display, Displayed
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.text import probability, two_digits, value_and_error, with_minus_sign
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.conventions import matrix_elements
from walop_jax.model.effects.in_models import known_effects
from walop_jax.model.sources import Standards
from walop_jax.model.specification import Model
from walop_jax.science.star_errors import determinant, joint_errors, statistics
from walop_jax.sky.position_angles import sky_to_instrument

CommonVector = Float[np.ndarray, " k"]
CommonMatrix = Float[np.ndarray, "k k"]

CHANCE = 0.01
COPIES = 1e-12  # chance of so small a χ² from which two sets are taken for one
SAME_DATA = "these are the data from which the old calibration was made"
TOO_ALIKE = "the two data sets agree too well to be independent"
UNEXPLAINED = (
    "walop-jax diagnose NEW.fits looks for what is missing; until then reduce no stars of that night"
)
STACK = "walop-jax stack RUN NEW.fits -o SURVEY dates the change and gives one calibration for all nights"
_SHOWN = 8  # parameters
SURE = 5.0  # standard errors
_KNOWN = 1e-7  # fraction of the largest eigenvalue below which a direction was measured by neither
_LEANS = 1e-4  # of the variances of both fits, below which both are the prior, and rounding differs


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
    """The parameter whose change stands out most, by `z` standard errors, among the `asked` changes that were asked
    for.

    `alone` says that `size` is the change of this parameter with all others as they were. `p_value` is corrected for
    the number of changes.
    """

    name: str
    size: float
    error: float
    unit: str
    z: float
    alone: bool
    asked: int
    p_value: float

    @property
    def words(self) -> str:
        """The change, its significance and how it was corrected, in words."""
        size = " ± ".join(value_and_error(self.size, max(self.error, 1e-12)))
        significance = with_minus_sign(f"{self.z:+.1f}")
        alone = " if no other parameter has changed" if self.alone else ""
        return (
            f"{self.name} by {size} {self.unit}".rstrip() + f", {significance} standard errors{alone} (p "
            f"{probability(self.p_value)} after allowing for {self.asked} trials)"
        )


@dataclasses.dataclass(frozen=True, repr=False)
class Epoch(Displayed):
    """The verdict: `fits` unless the change is one that chance makes in less than 1 % of cases.

    `largest` is the change that stands out most by itself, `p_value` the chance of it and of the sum (`test`, χ² in
    `directions`) taken together. `visible` is the smallest change of each element of the matrix (per cent, median over
    the field) that would have been seen with certainty, five standard errors of it. `moved` sorts parameters by |z|;
    `chi2_old` is of the new data with the old instrument; `star_errors` are statistics (per cent) of what stars would
    be off, outside the zone without u, if the old calibration were used and the new one true. `added` are the effects
    without which the new data are not explained, `same` says that old and new data are the same files. `new_trusted`
    and `warnings` are the verdict on the new fit.

    `fits` and all numbers of a comparison are None, and its lists empty, where the model of the old calibration
    explained its own data and not the new ones, and no other model is known to.
    """

    fits: bool | None
    new_trusted: bool
    warnings: tuple[str, ...]
    added: tuple[str, ...] = ()
    same: bool = False
    p_value: float | None = None
    test: float | None = None
    directions: int | None = None
    largest: LargestChange | None = None
    visible: dict[str, float] | None = None
    chi2_old: float | None = None
    chi2_new: float | None = None
    dof: int | None = None
    moved: tuple[MovedParameter, ...] = ()
    star_errors: dict[str, dict[str, float]] | None = None

    @property
    def holds(self) -> bool:
        """True if the old calibration may be used on: nothing has moved, and a fit to be trusted says so."""
        return bool(self.fits and self.new_trusted)

    @property
    def verdict(self) -> str:
        """The answer in words: unchanged, changed, or not known."""
        if self.fits is None:
            return "The new data are not explained"
        return "The old calibration still fits" if self.fits else "The instrument has changed"

    @property
    def against(self) -> tuple[Doubt, ...]:
        """The reasons against using the old calibration on, each with its effect on stars and its remedy."""
        doubts = []
        if self.fits is None:
            what = "the model of the calibration, which explained its own data, does not explain the new ones"
            doubts.append(Doubt(Quality.UNEXPLAINED, what, remedy=UNEXPLAINED))
        elif not self.fits and self.largest is not None and self.star_errors is not None:
            off = max(self.star_errors[name]["median"] for name in "qu") / 100.0
            what = f"the instrument has changed: {self.largest.words}"
            doubts.append(Doubt(Quality.DOUBTED, what, off=off, remedy=STACK))
        if self.fits is not None and not self.new_trusted:
            why = f": {self.warnings[0]}" if self.warnings else ""
            doubts.append(Doubt(Quality.DOUBTED, f"the fit of the new data is not trusted{why}"))
        copies = (text for text in self.warnings if text.startswith((SAME_DATA, TOO_ALIKE)))
        other = "give a calibration set of another night"
        return (*doubts, *(Doubt(Quality(0), text, blocking=False, remedy=other) for text in copies))

    @property
    def stars_in_words(self) -> str:
        """What becomes of p of stars if the old calibration is used on, in words; empty where that is not known."""
        if self.star_errors is None or self.same:
            return ""
        errors = self.star_errors["p"]
        most = two_digits(errors["max"])
        return f"off by {two_digits(errors['median'])} % (median; {most} % at most) if the new data are right"

    def document(self) -> dict[str, Any]:
        """The comparison as plain data, the part `epoch` of check.json."""
        return {"verdict": self.verdict} | dataclasses.asdict(self)

    def to_table(self) -> Any:
        """The parameters, farthest moved first, as an astropy table."""
        columns = {"NAME": "name", "OLD": "old", "NEW": "new", "ERROR": "error", "Z": "z", "UNIT": "unit"}
        about = dict.fromkeys(columns, "") | {"ERROR": "standard error of the change", "Z": "change / error"}
        return astropy_table(
            {k: (np.array([getattr(m, v) for m in self.moved]), "", about[k]) for k, v in columns.items()}
        )

    def display(self) -> Display:
        """The verdict, and the parameters that have moved farthest."""
        title, largest = self.verdict.replace("has changed", "HAS CHANGED"), self.largest
        if largest is None or self.star_errors is None or self.visible is None or self.p_value is None:
            words = "not compared: the old model, fitted to the new data, is not to be trusted"
            return Display(title, (("old and new", words),))
        if self.same:
            return Display(title, (("old and new", "the same data: nothing can have changed"),))
        rows = []
        for entry in sorted(self.moved, key=lambda entry: entry.name != largest.name)[:_SHOWN]:
            error = max(entry.error, 1e-6 * abs(entry.new))  # of the same data it is rounding alone
            old, new = (value_and_error(value, error)[0] for value in (entry.old, entry.new))
            rows.append((entry.name, old, new, with_minus_sign(f"{entry.z:+.1f}"), entry.unit))
        errors = self.star_errors["p"]
        facts = {
            "largest change": largest.words,
            "bias of stars": f"{two_digits(errors['median'])} % of p with the old calibration (median), "
            f"{two_digits(errors['max'])} % at most",
            "chance": f"p {probability(self.p_value)} (χ² = {self.test:.1f} in {self.directions} directions, and "
            "the largest change)",
            "sensitivity": f"a change of {', '.join(f'{n} {two_digits(v)} %' for n, v in self.visible.items())} "
            "would be detected (5 standard errors, median over the field)",
        }
        if self.added:
            facts = {"not in the old model": ", ".join(self.added)} | facts
        head, remaining = ("parameter", ">old", ">new", ">change / σ", "unit"), len(self.moved) - _SHOWN
        notes = (f"{remaining} more in to_table()",) if remaining > 0 else ()
        return Display(title, tuple(facts.items()), head, tuple(rows), notes)


def fit_like(old: Calibration, calset: CalibrationSet) -> FitResult:
    """Fit a new set with the model of an old calibration, from its values: similar effects have several minima.

    Raises ValueError for a set of another instrument and RuntimeError if the fit does not converge.
    """
    if calset.instrument != old.model.name:
        raise ValueError(f"the new set is of {calset.instrument}, the calibration of {old.model.name}")
    model = model_like(calset, old.model)
    start = model.start.copy()
    for name in shared_parameters(old.model, model):
        start[model.index(name)] = old.values[old.model.index(name)]
    result = with_empirical_covariance(fit(Likelihood.of(calset, model), start=start))
    if not result.converged:
        raise RuntimeError(f"the fit of the new set did not converge: {result.minimum.message}")
    return result


def epoch(old: Calibration, result: FitResult) -> Epoch:
    """Compare an old calibration with an examined fit of a new set, by its own model (`fit_like`) or a larger one."""
    added = tuple(name for name in result.model.effect_names if name not in old.model.effect_names)
    files, before = ({entry.sha256 for entry in entries} for entries in (result.calset.inputs, old.inputs))
    same = bool(files) and files == before
    if old.verdict.trusted and not result.trusted:
        return Epoch(None, False, result.warnings, added, same)
    new = Calibration.from_fit(result)
    model = new.model
    shared, beyond = shared_parameters(old.model, model), added_amplitudes(old.model, model)
    names, stars = [*shared, *beyond], same_standards(old.model, model)
    a = np.array([old.model.index(name) for name in shared])
    b = np.array([model.index(name) for name in names])
    was = np.append(old.values[a], np.zeros(len(beyond)))
    change = new.values[b] - was
    # What both fits lean on: the priors of the instrument and of standards.
    leaning = [*shared, *stars]
    i, j = (np.array([m.index(name) for name in leaning]) for m in (old.model, model))
    width = np.array([(model[name].prior or (0.0, np.inf))[1] for name in leaning])
    before, after = np.zeros((len(b), len(b))), new.covariance[np.ix_(b, b)]
    before[: len(a), : len(a)] = old.covariance[np.ix_(a, a)]
    product = np.zeros_like(before)
    product[: len(a)] = old.covariance[np.ix_(a, i)] @ (new.covariance[np.ix_(j, b)] / width[:, None] ** 2)
    covariance = before + after - product - product.T
    sigma = np.sqrt(np.diag(before + after))
    units = [model[name].unit for name in names]
    chi2, directions, largest = compared(names, change, covariance, sigma, units)
    values = new.values.copy()
    values[b] = was
    fitted = [model.index(name) for name in result.model.names]
    error = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    moved = [
        MovedParameter(n, unit, float(w), float(new.values[j]), float(s), float(d / s))
        for n, unit, w, j, d, s in zip(names, units, was, b, change, error, strict=True)
        if s > 0
    ]
    p_value = _of_several(min(float(special.chdtrc(directions, chi2)), largest.p_value), 2)
    of_all = np.zeros_like(new.covariance)
    of_all[np.ix_(b, b)] = covariance
    doubts = [f"{SAME_DATA}: nothing can have moved"] * same
    if not same and special.chdtr(directions, chi2) < COPIES:
        what = f"{TOO_ALIKE} (χ² = {chi2:.2g} in {directions} directions)"
        doubts = [f"{what}: is one a copy of the other?"]
    return Epoch(
        fits=p_value > CHANCE,
        new_trusted=result.trusted,
        warnings=(*result.warnings, *doubts),
        added=added,
        same=same,
        p_value=p_value,
        test=chi2,
        directions=directions,
        largest=largest,
        visible=_visible(dataclasses.replace(new, covariance=of_all)),
        chi2_old=result.likelihood.expand(values[fitted], near=result.expansion).chi2,
        chi2_new=result.chi2,
        dof=result.dof,
        moved=tuple(sorted(moved, key=lambda entry: -abs(entry.z))),
        star_errors=_star_errors(old, new),
    )


def _of_several(p: float, number: int) -> float:
    """Chance that the smallest of several p-values is as small (Šidák)."""
    return float(-np.expm1(number * np.log1p(-p))) if p < 1.0 else 1.0


def shared_parameters(old: Model, new: Model) -> list[str]:
    """Names of the instrument's parameters that are free in both models."""
    free = [{m.parameters[i].name for i in m.free} for m in (old, new)]
    return [name for name in new.names if name in free[0] & free[1] and new[name].part not in SKY_AND_STARS]


def same_standards(old: Model, new: Model) -> list[str]:
    """Names of the numbers of standards that both models take, free, from the same catalogue value."""
    both = [p for p in new.parameters if p.part == Standards.name and p.name in old.names]
    return [p.name for p in both if p.free and old[p.name].free and p.prior and p.prior == old[p.name].prior]


def added_amplitudes(old: Model, new: Model) -> list[str]:
    """Names of free parameters in which effects of the new model that the old one lacks are linear at zero."""
    effects = set(new.effect_names) - set(old.effect_names)
    shapes = {kind.name: kind.shape for kind in known_effects(new)}
    free = [new.parameters[i] for i in new.free]
    leaf = {p.name: p.name.removeprefix(f"{p.part}.").split(".")[0] for p in free}
    return [p.name for p in free if p.part in effects and leaf[p.name] not in shapes.get(p.part, ())]


def compared(
    names: Sequence[str],
    change: CommonVector,
    covariance: CommonMatrix,
    sigma: CommonVector,
    units: Sequence[str],
) -> tuple[float, int, LargestChange]:
    """Δᵀ V⁻¹ Δ, the number of directions that were measured, and the largest change of a single parameter.

    Every parameter is asked by itself and as if nothing else had changed; parameters with `sigma` 0 are not known.
    """
    measured = np.flatnonzero(sigma > 0)
    unit = sigma[measured]
    change, scaled = change[measured] / unit, covariance[np.ix_(measured, measured)] / np.outer(unit, unit)
    value, vector = np.linalg.eigh(scaled)
    good = value > _KNOWN * value[-1]
    inverse = (vector[:, good] / value[good]) @ vector[:, good].T
    variances, alone = np.diag(scaled), np.diag(inverse)
    widths = np.where(variances > _LEANS, variances, np.inf), np.where(alone > 0, alone, np.inf)
    width = np.sqrt(np.stack(widths))
    z = np.stack([change, inverse @ change]) / width
    way, i = np.unravel_index(np.abs(z).argmax(), z.shape)
    questions = int(np.isfinite(width).sum())
    p = _of_several(float(special.chdtrc(1, z[way, i] ** 2)), questions)
    # Of one alone: a/√(V⁻¹)_ii, with the error 1/√(V⁻¹)_ii.
    error = float(unit[i] * (width[0, i] if way == 0 else 1.0 / width[1, i]))
    at, size = int(measured[i]), float(z[way, i] * error)
    largest = LargestChange(names[at], size, error, units[at], float(z[way, i]), bool(way), questions, p)
    return float(change @ inverse @ change), int(good.sum()), largest


def _visible(changed: Calibration) -> dict[str, float]:
    """`SURE` errors of each matrix element, median over the field, per cent; the covariance is that of the change."""
    x, y = changed.raster(4)
    # Field points differ by no less than before: it is the parameters that are compared.
    verdict = dataclasses.replace(changed.verdict, structure=NO_STRUCTURE)
    changed = dataclasses.replace(changed, verdict=verdict)
    name = str(np.unique(changed.exposures.filter)[-1])
    _, covariance = changed.matrix(x, y, changed.usual_settings(1, name))
    error = np.sqrt(np.clip(np.diagonal(covariance, axis1=1, axis2=2), 0.0, None))
    elements = matrix_elements(len(changed.model.template.cameras.pairs))
    return dict(zip(elements, (100.0 * SURE * np.median(error, axis=0)).tolist(), strict=True))


def _star_errors(old: Calibration, new: Calibration) -> dict[str, dict[str, float]]:
    low, high = np.reshape(new.field, (2, 2)).T[..., None]
    x, y = np.random.default_rng(0).uniform(low, high, (2, 200))
    settings, pairs = _seen_through(new), new.model.template.cameras.pairs
    vectors = []
    for calibration in (old, new):
        analysis = AnalysisVectors(calibration)
        a = np.stack([analysis.exact(setting, x, y)[:, 0] for setting in settings], axis=1)
        # Stars are on the sky, against which each calibration turns the instrument by its own zero of the rotator.
        zero = analysis.instrument.patched().rotator_zero
        axes = sky_to_instrument(a[..., 1], a[..., 2], np.array(0.0 if zero is None else -float(zero)))
        vectors.append(np.stack([a[..., 0], *axes], axis=-1))
    errors = joint_errors(vectors[0], vectors[1], sample_stars())
    return statistics(errors, determinant(vectors[1], pairs) >= SMALLEST_DETERMINANT)


def _seen_through(calibration: Calibration) -> list[Settings]:
    """The settings in which a star is seen: one exposure, or, with a single arm, one at each position of the set."""
    name = str(np.unique(calibration.exposures.filter)[-1])
    usual = calibration.usual_settings(filter_name=name)
    if len(calibration.model.template.arms) > 1:
        return [usual]
    settings = Settings.of(calibration.exposures, calibration.model.template.patched().moving())
    return [setting for setting, _ in usual[np.zeros(len(settings), int)].at(**settings.positions).layouts()]
