"""Targets of a plan: linear functions of the parameters, by name, that are to be known well.

Error of p   of stars behind the calibration alone: δ(q, u) = −M⁻¹ (δm₁ + δM (q, u)), hence δp = −e · M⁻¹ δm s, linear
             in the six elements of δm and so in the parameters (`science.field_accuracy`). Mean square over stars with
             p ≤ 5 %, at points of the field, through every filter, for stars of some colours. Where |det M| is below
             `SMALLEST_DETERMINANT` one exposure holds no u, and no plan of calibrations brings it back.
Parameter    its variance, e.g. `collimator.curvature`.
Stars        the error of p of the stars of a table.
Apart        effects, whichever is there separated from every other. Truth i of a known size, rival j with sizes and
             shapes of its own, and the calibration are fitted together; the rival that does its best stays Δχ² = 1 / φ
             away, φ the variance of the size of i in its units. The least √Δχ² of all pairs is made largest.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.calibration.accuracy import measures_u, p_forms, sample_stars
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import matrix_slopes
from walop_jax.data.schema import Column
from walop_jax.data.settings import Settings
from walop_jax.data.user_tables import InputTable, numeric_column
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.findings import Diagnosis, document
from walop_jax.io.errors import fail
from walop_jax.io.names import DIAGNOSIS
from walop_jax.io.run_folder import RunFolder
from walop_jax.likelihood.inverses import root_of, square_root
from walop_jax.model.effects import effect_by_name
from walop_jax.model.effects.in_models import known_effects
from walop_jax.model.parameters import check_names
from walop_jax.plans.exposures import Candidates

LONGEST = 1440.0
"""Minutes of a plan at most. It is one of a night, in which the sky stands still and the instrument does not change."""
WORST, MEAN, APART = "worst", "mean", "apart"
_SURE = 1.645  # standard deviations above which 95 % of a normal distribution lie, below zero
NAMED = _SURE + float(np.sqrt(_SURE**2 + 2.0 * thresholds.IMPROBABLE))
"""Distance d (σ) from a rival of as many numbers at which a diagnosis names an effect in 95 of 100 sets: 5.7.

The evidence beside the rival has mean d²/2 and scatter d, and must exceed `thresholds.IMPROBABLE`."""
COLOURS = (float("nan"), 4000.0, 8000.0)
"""Colour temperatures (K; NaN: flat photon spectrum) at which p is to be known."""
TARGET_GRID = 9  # field points along each axis at which the error of p is asked


@dataclasses.dataclass(frozen=True)
class Criterion:
    """Linear functions of the parameters, `targets` (draw, target, parameter, column), and what their variance says.

    `unit` is the unit of the root of the largest variance; `what` describes it. With `inverse` its reciprocal is given,
    in standard deviations. `blocks` (pair, parameter, own) lead from the parameters of each pair to the parameters of
    the candidates; targets then stand one after the other for the pairs of each draw. The criterion `worst`, for
    instance, is the largest error of p over the field, in %.
    """

    name: str
    what: str
    unit: str
    targets: Float[np.ndarray, "r k n q"]
    inverse: bool = False
    blocks: Float[np.ndarray, "b f n"] | None = None

    def reported(self, variance: float) -> float:
        """The number that is given for a value of the criterion."""
        root = float(np.sqrt(variance))
        return 1.0 / root if self.inverse else root

    def variance(self, reported: float) -> float:
        """The value of the criterion for a number that is given."""
        return float((1.0 / reported if self.inverse else reported) ** 2)


@dataclasses.dataclass(frozen=True)
class FieldErrors:
    """Points of the field, filters and colours at which p is to be known, and how it depends on the parameters.

    `slopes` (draw, point, element, parameter) are the derivatives of the matrix, `forms` (draw, point, 6, 6) the
    quadratic form that makes the mean square error of p of them, 0 where one exposure holds no u.
    """

    x: Float[np.ndarray, " p"]
    y: Float[np.ndarray, " p"]
    slopes: Float[np.ndarray, "r p 6 f"]
    forms: Float[np.ndarray, "r p 6 6"]

    @property
    def seen(self) -> Bool[np.ndarray, " p"]:
        """True where one exposure holds u in all draws."""
        return np.asarray(self.forms.any(axis=(2, 3)).all(axis=0))

    def targets(self) -> Float[np.ndarray, "r k f 6"]:
        """Linear functions of the parameters whose summed variance is the mean square error of p, in %²."""
        return 100.0 * np.einsum("rpif,rpij->rpfj", self.slopes, square_root(self.forms))[:, self.seen]

    def error(self, covariance: Float[np.ndarray, "r f f"]) -> Float[np.ndarray, "r p"]:
        """Error of p (fraction) for covariances of the parameters; NaN where there is no u."""
        c = np.einsum("rpif,rfg,rpjg->rpij", self.slopes, covariance, self.slopes, optimize=True)
        square = np.einsum("rpij,rpij->rp", self.forms, c)
        return np.sqrt(np.where(self.forms.any(axis=(2, 3)), square, np.nan))


def check_wishes(minutes: float, goal: float | None = None, draws: int = 1) -> None:
    """Raise ValueError for a time, a goal or a number of draws that no plan can have."""
    if not minutes > 0:
        raise ValueError(f"{minutes:g} minutes: nothing can be observed in no time; give --minutes")
    if not minutes <= LONGEST:
        what = f"a plan is one of a night, of {LONGEST:g} minutes at most"
        advice = "for a longer time plan a night, and add to its calibration with --after RUN"
        raise ValueError(f"{minutes:g} minutes: {what}; {advice}")
    if goal is not None and not 0 < goal < np.inf:
        raise ValueError(f"goal = {goal:g}: no time reaches it; give a value above 0, in % for errors of p")
    if draws < 1:
        raise ValueError(f"draws = {draws}: give 1 or more")


def field_errors(
    found: Candidates,
    *,
    colours: Sequence[float] = COLOURS,
    points: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]] | None = None,
    stars: Float[np.ndarray, "*b m 2"] | None = None,
) -> FieldErrors:
    """Dependence of p on the parameters, at a grid of points (or those given, deg).

    `stars` (q, u) are those over which the square is averaged, at all points or at each: those with p ≤ 5 %.
    """
    model, plan, draws = found.model, found.available.plan, len(found.values)
    edge = np.linspace(-plan.field, plan.field, TARGET_GRID)
    x, y = (np.tile(edge, TARGET_GRID), np.repeat(edge, TARGET_GRID)) if points is None else points
    light = sample_stars() if stars is None else stars
    slopes, forms, select = [], [], model.selection()
    for values, name, teff in itertools.product(found.values, plan.filter_names, colours):
        setting = dataclasses.replace(Settings.default(1, name), teff=np.array([teff]))
        m, slope = matrix_slopes(model.instrument(values), setting, plan.curves(), x, y)
        if m.shape[1] != 2:
            raise ValueError(
                f"{plan.name} does not measure q and u in one exposure: the error of p depends on how stars are "
                f"observed; plan for a parameter instead, such as --criterion {found.names[0]}"
            )
        form = p_forms(m.reshape(len(x), 6), light)
        square = np.einsum("pni,pnj->pij", form, form) / form.shape[1]
        forms.append(np.where(measures_u(m)[:, None, None], square, 0.0))
        slopes.append(slope.reshape(len(x), 6, -1) @ select)
    repeated = len(slopes) // draws  # filters and colours
    by_draw = (np.stack(arrays).reshape(draws, -1, *arrays[0].shape[1:]) for arrays in (slopes, forms))
    return FieldErrors(np.tile(x, repeated), np.tile(y, repeated), *by_draw)


def criterion_by_name(found: Candidates, field: FieldErrors | None, criterion: str | InputTable) -> Criterion:
    """A criterion by its name: `WORST`, `MEAN`, a parameter; or a table of stars (X, Y, Q, U; TEFF).

    Raises ValueError for a name that is none of these, and where no star can be seen.
    """
    if isinstance(criterion, InputTable):
        return _of_stars(found, criterion)
    if criterion in (WORST, MEAN):
        assert field is not None
        targets = field.targets()
        if criterion == WORST:
            return Criterion(WORST, "error of p at the worst point and colour", "%", targets)
        mean_square = np.einsum("rkfi,rkgi->rfg", targets, targets, optimize=True) / targets.shape[1]
        return Criterion(MEAN, "error of p, rms over the field", "%", root_of(mean_square)[:, None])
    if criterion == APART:
        return _apart(found)
    check_names("criterion or parameter", [criterion], (WORST, MEAN, APART, *found.names))
    unit = found.model.parameters[found.model.index(criterion)].unit
    unit_vector = np.zeros((len(found.values), 1, len(found.names), 1))
    unit_vector[:, 0, found.names.index(criterion)] = 1.0
    return Criterion(criterion, f"error of {criterion}", unit, unit_vector)


def _of_stars(found: Candidates, table: InputTable) -> Criterion:
    units = {"X": "deg", "Y": "deg", "Q": "", "U": ""}
    x, y, q, u = (numeric_column(table, name, Column("float", unit)) for name, unit in units.items())
    teff = numeric_column(table, "TEFF", Column("float", "K", missing=np.nan))
    if np.any(np.hypot(q, u) == 0):
        advice = "leave it out, or state its expected values"
        raise ValueError(f"{table.path}: a star with Q = U = 0 has no p; {advice}")
    targets_by_colour = []
    for colour in np.unique(teff):
        members = np.flatnonzero((teff == colour) | (np.isnan(teff) & np.isnan(colour)))
        stars = np.stack([q[members], u[members]], axis=1)[:, None]
        at = field_errors(found, colours=(float(colour),), points=(x[members], y[members]), stars=stars)
        targets_by_colour.append(at.targets())
    targets = np.concatenate(targets_by_colour, axis=1)
    if not targets.shape[1]:
        raise ValueError(
            f"{table.path}: no star lies where one exposure measures u; observe them at several angles of the rotator"
        )
    return Criterion("stars", f"error of p of the worst of {targets.shape[1]} stars", "%", targets)


def _apart(found: Candidates) -> Criterion:
    effects, of = found.effects, amplitudes_of(found, found.effects)
    if len(effects) < 2 or not any(effects.values()):
        raise ValueError("give two or more effects to be distinguished, and the size of one: NAME=VALUE")
    size = {effect: stated_size(found, effect) for effect in effects if effects[effect]}
    return apart(found, of, size)


def amplitudes_of(found: Candidates, effects: Iterable[str]) -> dict[str, list[int]]:
    """The positions of the numbers of each effect among the parameters of the candidates."""
    names = np.array(found.names)
    return {e: np.flatnonzero(np.char.startswith(names, f"{e}.")).tolist() for e in effects}


def stated_size(found: Candidates, effect: str) -> Float[np.ndarray, " f"]:
    """How far an effect is from none, in the parameters of the candidates; its shape is no size."""
    shape, size = effect_by_name(effect, known_effects(found.model)).shape, np.zeros(len(found.names))
    for i in amplitudes_of(found, [effect])[effect]:
        p = found.model.parameters[found.model.index(found.names[i])]
        if found.names[i].split(".")[1] not in shape:
            size[i] = p.start - (0.0 if p.prior is None or not p.start else p.prior[0])
    return size


def apart(
    found: Candidates, of: Mapping[str, Sequence[int]], size: Mapping[str, Float[np.ndarray, " f"]]
) -> Criterion:
    """The least distance over all pairs of effects; `of` holds the positions of their numbers, effects with a `size`
    may be true.
    """
    base = np.setdiff1d(np.arange(len(found.names)), np.concatenate([list(i) for i in of.values()]))
    widest, blocks = max(map(len, of.values())), []
    for truth, rival in itertools.permutations(of, 2):
        if truth not in size:
            continue
        block = np.zeros((len(found.names), len(base) + 1 + widest))
        block[base, np.arange(len(base))] = 1.0
        block[:, len(base)] = size[truth]
        block[list(of[rival]), len(base) + 1 + np.arange(len(of[rival]))] = 1.0
        blocks.append(block)
    targets = np.zeros((len(blocks) * len(found.values), 1, blocks[0].shape[1], 1))
    targets[:, 0, len(base)] = 1.0
    what = f"least distance of {', '.join(of)}"
    return Criterion(APART, what, "σ", targets, inverse=True, blocks=np.stack(blocks))


def effects_alike(after: Any, prior: Calibration) -> tuple[Any, ...]:
    """The effects that a diagnosis could not tell apart: the effect that it found, as it is, then its rivals by name.

    `after` is the diagnosis or its folder, `prior` its calibration. Raises `DataError` where there are none.
    """
    diagnosis, path = document(after) if isinstance(after, Diagnosis) else None, None
    if isinstance(after, RunFolder | str | os.PathLike):
        folder = after if isinstance(after, RunFolder) else RunFolder(Path(after))
        diagnosis, path = folder.documents.get("diagnosis"), folder.folder / DIAGNOSIS
    if diagnosis is None:
        advice = "run diagnose first, or name the effects with --apart (apart= in Python)"
        raise fail("no diagnosis", file=path, advice=advice)
    effects_of_model = {effect.name: effect for effect in prior.model.instrument(prior.values).effects}
    for step in diagnosis["steps"]:
        if step["equivalent"] and step["effect"] in effects_of_model:
            return (effects_of_model[step["effect"]], *step["equivalent"])
    advice = "name the effects to be separated with --apart"
    raise fail("the diagnosis left no effects that look alike", file=path, advice=advice)
