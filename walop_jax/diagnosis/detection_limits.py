"""What a calibration set can show before anything is found in it: the sizes at which effects are detected and named.

Everything is linear algebra on the columns of the score test (`score`), at a fit or at a plan without noise.

Detected    An effect of amplitude ε has the statistic T ~ χ'²_k(λ) with λ = ε² G (G the Gram element of its column
            behind the projection). The alarm is raised where the smallest p of all candidates undercuts p*, which noise
            does with probability `ALARM`; ε is that for which T does so with probability `PROBABILITY`.
Named       A rival that does its best to follow the effect stays √S ε from it (`score.separations`). The effect is
            named alone where the amplitude found, ε ± 1/√G, leaves every rival `SEPARATION` or more away with
            probability `PROBABILITY`: ε ≥ SEPARATION/√S + z/√G; below that it is told with those for which it may be
            taken.
Protection  A calibration without the effect takes up a part of it: δθ = (JᵀJ)⁻¹JᵀC ε. Stars are seen through
            m + ε ∂m/∂ε and calibrated with m + δθ ∂m/∂θ; the difference at the amplitude that is just detected is the
            largest error of q and u that the effect can make without being noticed.

Symbols     J, C derivatives of the whitened residuals with respect to parameters and amplitude; m instrument matrix;
            z the normal quantile of `PROBABILITY`.
Sources     Baarda 1968 (reliability: what a test finds, and what an error that it misses does to the result); Teunissen
            2018, J. Geod. 92, 59 (detection, identification, adaptation); Atkinson & Fedorov 1975, Biometrika 62, 57.
Limits      One effect at a time, to first order in its amplitude, for the shapes that the search starts from.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import optimize, stats

from walop_jax.calibration.matrix_slopes import effect_slopes, matrix_slopes
from walop_jax.diagnosis.change_of_stokes import change_of_qu, first_setting
from walop_jax.diagnosis.effect_columns import Probe, applicable
from walop_jax.diagnosis.effect_columns import probes as all_probes
from walop_jax.diagnosis.examination import ALARM, Examination, most_points
from walop_jax.diagnosis.naming import SEPARATION
from walop_jax.diagnosis.score import separations
from walop_jax.diagnosis.trust import sampled
from walop_jax.fit.refit import FitResult
from walop_jax.fit.stand_in import on_field_points
from walop_jax.io.display import Display, Displayed
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.rounding import two_digits, two_digits_range, with_minus_sign
from walop_jax.likelihood import limits
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.model.parameters import field_declarations
from walop_jax.model.specification import effect_context

PROBABILITY = 0.99
_ABSORBED = 1e-9  # share of the square of a column that a rival leaves below which the two are the same

Vector = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "_ _"]


@dataclasses.dataclass(frozen=True)
class DetectionLimit:
    """The amplitudes of one parameter of an effect that are detected and named, in its unit.

    `detected` holds the smallest and the largest over the shapes that the effect may have, `named` the largest
    (infinite where some rival does exactly the same). `taken_for` are the effects for which it may be taken when it is
    just detected, nearest first. `error_of_qu` is the error that q and u of a star polarised by up to 5 % have from it
    at the amplitude that is just detected: median and largest over the field; NaN where one exposure does not give
    both.
    """

    effect: str
    parameter: str
    unit: str
    detected: tuple[float, float]
    named: float
    taken_for: tuple[str, ...]
    error_of_qu: tuple[float, float]


@dataclasses.dataclass(frozen=True, repr=False)
class DetectionLimits(Displayed):
    """What a set can show of every effect, and what the effects that it cannot show may do.

    `separation` (row, column) is how far (σ) the effect of the column stays from that of the row when this is just
    detected. `protection` is, by field point (`x`, `y`, degrees), the largest error of q and u that a single effect
    can make without being detected, `caused_by` the effect. `untestable` effects leave no trace in these data.
    """

    limits: tuple[DetectionLimit, ...]
    effects: tuple[str, ...]
    separation: Matrix
    x: Vector
    y: Vector
    protection: Vector
    caused_by: tuple[str, ...]
    untestable: tuple[str, ...]

    def to_table(self) -> Any:
        """A row for each effect and parameter, the largest error of q and u first, as an astropy table."""
        rows, nothing = self.limits, ("", "")
        return astropy_table(
            {
                "EFFECT": (np.array([r.effect for r in rows], "U32"), *nothing),
                "PARAMETER": (np.array([r.parameter for r in rows], "U32"), *nothing),
                "UNIT": (np.array([r.unit for r in rows], "U16"), "", "of DETECTED and NAMED"),
                "DETECTED": (
                    np.array([r.detected for r in rows]).reshape(-1, 2),
                    "",
                    "over the shapes: least, most",
                ),
                "NAMED": (np.array([r.named for r in rows], float), "", "named alone with 99 % probability"),
                "QU_ERROR": (
                    np.array([r.error_of_qu for r in rows]).reshape(-1, 2),
                    "",
                    "median, largest over field",
                ),
                "TAKEN_FOR": (np.array([", ".join(r.taken_for) for r in rows], "U128"), *nothing),
            }
        )

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "probability": PROBABILITY,
            "alarm": ALARM,
            "limits": [dataclasses.asdict(entry) for entry in self.limits],
            "effects": list(self.effects),
            "separation": self.separation.tolist(),
            "protection": {
                "x": self.x.tolist(),
                "y": self.y.tolist(),
                "error_of_qu": self.protection.tolist(),
                "caused_by": list(self.caused_by),
            },
            "untestable": list(self.untestable),
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> DetectionLimits:
        """What `document` describes. Raises KeyError or TypeError for one that it has not made."""
        protection = document["protection"]
        return cls(
            limits=tuple(
                DetectionLimit(
                    effect=entry["effect"],
                    parameter=entry["parameter"],
                    unit=entry["unit"],
                    detected=(float(entry["detected"][0]), float(entry["detected"][1])),
                    named=np.inf if entry["named"] is None else float(entry["named"]),
                    taken_for=tuple(entry["taken_for"]),
                    error_of_qu=(_number(entry["error_of_qu"][0]), _number(entry["error_of_qu"][1])),
                )
                for entry in document["limits"]
            ),
            effects=tuple(document["effects"]),
            separation=np.array(document["separation"], float).reshape(2 * (len(document["effects"]),)),
            x=np.array(protection["x"], float),
            y=np.array(protection["y"], float),
            protection=np.array(protection["error_of_qu"], float),
            caused_by=tuple(protection["caused_by"]),
            untestable=tuple(document["untestable"]),
        )

    def display(self) -> Display:
        """The protection level in a sentence, and a row for each effect and parameter."""
        rows = tuple(
            (
                f"{entry.effect}.{entry.parameter}",
                two_digits_range(*entry.detected),
                two_digits(entry.named) if np.isfinite(entry.named) else "never",
                entry.unit,
                two_digits_range(*(100.0 * value for value in entry.error_of_qu)),
                ", ".join(entry.taken_for),
            )
            for entry in self.limits
        )
        notes = (f"cannot be seen in these data: {', '.join(self.untestable)}",) if self.untestable else ()
        return Display(
            title="What these data can show, with 99 % probability",
            facts=(("protection level", self.protection_in_words() or "one exposure does not give q and u"),),
            head=("amplitude", ">detected", ">named", "unit", ">error of q, u (%)", "may be taken for"),
            rows=rows,
            notes=notes,
        )

    def protection_in_words(self) -> str:
        """The largest error of q and u over the field that goes unnoticed; empty where none is known."""
        worst = self.worst
        if worst is None:
            return ""
        x, y = (with_minus_sign(f"{value:+.2f}°") for value in (self.x[worst], self.y[worst]))
        return (
            f"no single effect of the catalogue can make q or u of a star with p ≤ 5 % wrong by more than "
            f"{two_digits(100 * self.protection[worst])} % without being detected "
            f"({two_digits(100 * float(np.nanmedian(self.protection)))} % in the median of the field); "
            f"the largest would be {self.caused_by[worst]} at ({x}, {y})"
        )

    @property
    def worst(self) -> int | None:
        """The field point where most can go unnoticed; None if one exposure nowhere gives q and u."""
        return int(np.nanargmax(self.protection)) if np.isfinite(self.protection).any() else None


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)


def detection_limits(
    result: FitResult,
    *,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> DetectionLimits:
    """Amplitudes at which the data behind a fit show each effect of `catalogue`, and what they cannot show.

    The residuals of the fit are not used: a fit to noiseless counts of a plan serves as well. `seed` is that of the
    Monte Carlo threshold. Of a large set points spread over the field are looked at, as in `diagnose`.
    """
    tell = progress or (lambda text: None)
    template, calset = result.model.template, result.calset
    context = effect_context(template, calset.exposures)
    fitting = applicable(catalogue, context, template)
    wanted = list(all_probes(fitting, context))
    result = sampled(
        on_field_points(result), most_points(calset, template, sum(len(probe.widths) for probe in wanted))
    )
    tell("differentiating every effect")
    examination = Examination(result, wanted, np.random.default_rng(seed))
    noncentrality = _Noncentrality(examination.scorer.threshold(ALARM))
    tell("comparing the effects")
    columns = [c for probe in examination.probes for c in _columns(examination, probe, noncentrality)]
    tell("finding what goes unnoticed")
    return _collected(examination, columns, _errors(examination, columns), fitting)


class _Noncentrality:
    """λ for which χ'²_k(λ) undercuts a local p with `PROBABILITY`."""

    def __init__(self, log_p: float) -> None:
        self._p, self._known = float(np.exp(log_p)), dict[int, float]()

    def __call__(self, rank: int) -> float:
        if rank not in self._known:
            least = stats.chi2.isf(self._p, rank)
            found = optimize.root_scalar(
                lambda value: stats.ncx2.sf(least, rank, value) - PROBABILITY,
                bracket=(1e-6, 10.0 * least + 100.0),
            )
            self._known[rank] = float(found.root)
        return self._known[rank]


@dataclasses.dataclass(frozen=True)
class _Column:
    """One amplitude of one probe: where it is detected and named, and who stays how far from it then."""

    probe: Probe
    number: int
    parameter: str
    detected: float
    named: float
    rivals: Mapping[str, float]


def _columns(examination: Examination, probe: Probe, noncentrality: _Noncentrality) -> list[_Column]:
    space, full = examination.scorer.space, examination.space
    at, alive, rank = space.places()[probe.name], space.alive(), space.whitened[probe.name].shape[1]
    found = []
    for number, place in enumerate(range(at.start, at.stop)):
        if not alive[place]:
            continue
        detected = float(np.sqrt(noncentrality(rank) / space.gram[place, place]))
        square = float(full.gram[place, place])
        apart = examination.nearest(separations(full, full.gram[:, place], square))
        del apart[probe.effect.name]
        nearest = min(apart.values(), default=np.inf)
        named = detected
        if nearest <= np.sqrt(_ABSORBED * square):
            named = np.inf
        elif np.isfinite(nearest):
            named = max(detected, SEPARATION / nearest + stats.norm.ppf(PROBABILITY) / np.sqrt(square))
        rivals = {name: value * detected for name, value in apart.items()}
        found.append(_Column(probe, number, probe.parameters[number], detected, float(named), rivals))
    return found


def _errors(examination: Examination, columns: Sequence[_Column]) -> Float[np.ndarray, "c p"]:
    """Error of q and u at every field point from each column, at the amplitude that is just detected.

    Of an effect with many shapes that of the median amplitude stands for all; the others are NaN.
    """
    design, result = examination.design, examination.result
    instrument, calset = result.model.instrument(result.values), result.calset
    setting = first_setting(calset, instrument)
    x, y = calset.points.x, calset.points.y
    matrix, slopes = matrix_slopes(instrument, setting, calset.filters, x, y)
    slopes = slopes @ result.model.selection()
    chosen = _representative(columns)
    probes = [probe for probe in examination.probes if probe.name in chosen]
    members = tuple(member for probe in probes for member in probe.group)
    changes = effect_slopes(instrument, setting, calset.filters, x, y, members)
    starts = np.cumsum([0, *(len(probe.widths) for probe in probes)])
    place = {probe.name: int(start) for probe, start in zip(probes, starts, strict=False)}
    norm = np.linalg.norm(design.jacobian, axis=0)
    scaled = design.jacobian / np.where(norm > 0, norm, 1.0)
    inverse = np.linalg.pinv(scaled.T @ scaled, hermitian=True)
    found = np.full((len(columns), len(x)), np.nan)
    for i, column in enumerate(columns):
        if column.probe.name not in chosen:
            continue
        raw = examination.named[column.probe.name].columns[:, column.number] / result.noise_scale
        taken_up = inverse @ (scaled[: design.rows].T @ raw) / np.where(norm > 0, norm, 1.0)
        own = changes[..., place[column.probe.name] + column.number]
        found[i] = change_of_qu(matrix, matrix + column.detected * (own - slopes @ taken_up))
    return found


def _representative(columns: Sequence[_Column]) -> set[str]:
    """Names of the probes whose effect on the matrix is worked out."""
    by_effect: dict[type[Effect], dict[str, float]] = {}
    for column in columns:
        by_effect.setdefault(column.probe.effect, {}).setdefault(column.probe.name, column.detected)
    chosen: set[str] = set()
    for shapes in by_effect.values():
        names = sorted(shapes, key=shapes.__getitem__)
        chosen.update(names if len(names) <= limits.MANY_SHAPES else [names[len(names) // 2]])
    return chosen


def _collected(
    examination: Examination,
    columns: Sequence[_Column],
    errors: Float[np.ndarray, "c p"],
    catalogue: Sequence[type[Effect]],
) -> DetectionLimits:
    groups: dict[tuple[type[Effect], str], list[int]] = {}
    for i, column in enumerate(columns):
        groups.setdefault((column.probe.effect, column.parameter), []).append(i)
    entries = []
    for (effect, parameter), members in groups.items():
        mine = [columns[i] for i in members]
        near = _nearest(mine)
        entries.append(
            DetectionLimit(
                effect=effect.name,
                parameter=parameter,
                unit=field_declarations(effect)[parameter].unit,
                detected=(min(c.detected for c in mine), max(c.detected for c in mine)),
                named=max(c.named for c in mine),
                taken_for=tuple(
                    name for name in sorted(near, key=near.__getitem__) if near[name] < SEPARATION
                ),
                error_of_qu=_over_field(errors[members]),
            )
        )
    names = tuple(dict.fromkeys(effect.name for effect, _ in groups))
    separation = np.full((len(names), len(names)), np.nan)
    for row, name in enumerate(names):
        near = _nearest([c for c in columns if c.probe.effect.name == name])
        separation[row] = [near.get(other, np.nan) for other in names]
    points = examination.result.calset.points
    worst = np.where(np.isfinite(errors), errors, -1.0)
    largest = worst.argmax(axis=0) if len(columns) else np.zeros(len(points), int)
    protection = worst[largest, np.arange(len(points))] if len(columns) else np.full(len(points), np.nan)
    known = protection >= 0
    return DetectionLimits(
        limits=tuple(sorted(entries, key=lambda e: -np.nan_to_num(e.error_of_qu[1], nan=-1.0))),
        effects=names,
        separation=separation,
        x=points.x,
        y=points.y,
        protection=np.where(known, protection, np.nan),
        caused_by=tuple(
            columns[i].probe.effect.name if k else "" for i, k in zip(largest, known, strict=True)
        ),
        untestable=examination.untestable(catalogue),
    )


def _nearest(columns: Sequence[_Column]) -> dict[str, float]:
    """How far each rival stays from the amplitude and shape that it follows best."""
    found: dict[str, float] = {}
    for column in columns:
        for name, value in column.rivals.items():
            found[name] = min(value, found.get(name, np.inf))
    return found


def _over_field(errors: Float[np.ndarray, "c p"]) -> tuple[float, float]:
    """Median and largest over the field, of the worst shape."""
    known = errors[np.isfinite(errors).any(axis=1)]
    if not known.size:
        return float("nan"), float("nan")
    return float(np.nanmedian(known, axis=1).max()), float(np.nanmax(known))
