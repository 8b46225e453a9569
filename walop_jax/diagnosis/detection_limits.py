"""Power of a calibration set, ahead of any diagnosis: sizes at which effects are detected and identified.

Everything is linear algebra on the columns of the score test (`score`), at a fit or at a plan without noise.

Detected    An effect of amplitude ε has the statistic T ~ χ'²_k(λ) with λ = ε² G (G the Gram element of its column
            behind the projection). The alarm is raised where the smallest p of all candidates undercuts p*, which noise
            does with probability `thresholds.ALARM`; ε is that for which T does so with `thresholds.PROBABILITY`.
Named       A rival that does its best to follow the effect stays √S ε from it (`score.separations`). The effect is
            named alone where the amplitude found, ε ± 1/√G, leaves every rival `thresholds.SEPARATION` or more away
            with `thresholds.PROBABILITY`: ε ≥ d/√S + z/√G with d that separation; below it is reported with those for
            which it may be taken.
Protection  A calibration without the effect takes up a part of it: δθ = (JᵀJ)⁻¹JᵀC ε. Stars are seen through
            m + ε ∂m/∂ε and calibrated with m + δθ ∂m/∂θ; the difference at the amplitude that is just detected, or
            at its prior width where this is smaller, is the largest error of q and u that the effect can make without
            being noticed. On the map each effect has a tenth on top (`SECOND_ORDER`): scattered light that is just
            detected does up to 8 % more than this. What could hide, in a sentence and in the table, is that of
            `calibration.could_hide`, as for any calibration.

Conditions  A number c that the set states of itself and that is wrong by h is found where h² G reaches the
            noncentrality of the test of `stated_conditions`. Stars are calibrated with a matrix that is off by
            δθ ∂m/∂θ − h ∂m/∂c; the second term is there only where they are seen under the same condition (a filter).

Symbols     J, C derivatives of the whitened residuals with respect to parameters and amplitude; m instrument matrix;
            z the normal quantile of `thresholds.PROBABILITY`.
Sources     Baarda 1968 (reliability: what a test finds, and what an error that it misses does to the result); Teunissen
            2018, J. Geod. 92, 59 (detection, identification, adaptation); Atkinson & Fedorov 1975, Biometrika 62, 57.
Limits      One effect at a time, to first order in its amplitude, for the shapes that the search starts from.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.could_hide import CouldHide, could_hide, hidden_errors
from walop_jax.calibration.matrix import first_setting
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.examination import Examination, examine, most_points, smallest
from walop_jax.diagnosis.grammar import hypotheses
from walop_jax.diagnosis.hypotheses import Probe
from walop_jax.diagnosis.score import ScoreSpace, local_p, noncentrality, separations
from walop_jax.diagnosis.stated_conditions import Singles
from walop_jax.diagnosis.trust import sampled
from walop_jax.diagnosis.undetected_errors import Starlight, undetected_errors
from walop_jax.fit.refit import FitResult
from walop_jax.fit.verdict import DATA, EFFECT
from walop_jax.io.display import Display, Displayed
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.progress import Stage
from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.io.text import per_cent, per_cent_range, two_digits, two_digits_range
from walop_jax.model.effects import EffectKind
from walop_jax.model.effects.in_models import known_effects

MANY_SHAPES = 8
"""Shapes of an effect above which one of them, of the median size, stands for all in what it does to the matrix."""

SECOND_ORDER = 1.1

NO_LEVEL = "q and u cannot both be measured with one exposure"
HEAD = ("amplitude", ">detected", ">named", "unit", ">error of q, u (%)", "can be mistaken for")


class DetectionLimit(NamedTuple):
    """The amplitudes of one parameter of an effect that are detected and named, in its unit.

    `detected` holds the smallest and the largest over the shapes that the effect may have, `named` the largest
    (infinite where some rival does exactly the same). `taken_for` are the effects for which it may be taken when it is
    just detected, nearest first. `error_of_qu` is the error that q and u of a star polarised by up to 5 % have from it
    at the amplitude that is just detected, or at its prior width if this is smaller: median and largest over the field;
    NaN where one exposure does not give both.
    """

    effect: str
    parameter: str
    unit: str
    detected: tuple[float, float]
    named: float
    taken_for: tuple[str, ...]
    error_of_qu: tuple[float, float]

    @property
    def name(self) -> str:
        """The amplitude as it is spelled in tables."""
        return f"{self.effect}.{self.parameter}"


class ConditionLimit(NamedTuple):
    """Detection limit for the error of a number that a set states.

    `detected` in `unit`, infinite where no residual shows it; `error_of_qu` as that of `DetectionLimit`, at `size`:
    the detection limit, or the standard error of the number (`records.StatedErrors`) where that is smaller.
    """

    what: str
    unit: str
    detected: float
    size: float
    error_of_qu: tuple[float, float]


@dataclasses.dataclass(frozen=True, repr=False)
class DetectionLimits(Displayed):
    """Sizes at which a set shows every effect, and the harm that smaller ones may do.

    `separation` (row, column) is how far (σ) the effect of the column stays from that of the row when this is just
    detected. `protection` is, by field point (`x`, `y`, degrees), the largest error of q and u that a single effect
    can make without being detected, with a margin of a tenth for higher orders, `caused_by` the effect.
    `untestable` effects leave no trace in these data. `conditions` are those stated in the set: its field, its
    filters, the colours of its light. `could_hide` are the undetectable mistakes, as in every command. Of an observing
    plan all of it is over `instruments` as they may be built (`planned_limits`).
    """

    limits: tuple[DetectionLimit, ...]
    effects: tuple[str, ...]
    separation: AnyMatrix
    x: AnyVector
    y: AnyVector
    protection: AnyVector
    caused_by: tuple[str, ...]
    untestable: tuple[str, ...]
    conditions: tuple[ConditionLimit, ...] = ()
    could_hide: tuple[CouldHide, ...] = ()
    instruments: int = 1

    def to_table(self) -> Any:
        """A row for each effect and parameter, the largest error of q and u first, as an astropy table."""

        def column(name: str, kind: str, about: str = "") -> tuple[np.ndarray, str, str]:
            values = [getattr(row, name) for row in self.limits]
            shape = (-1, 2) if name in ("detected", "error_of_qu") else -1
            return np.array(values, kind).reshape(shape), "", about

        taken_for = np.array([", ".join(row.taken_for) for row in self.limits], "U128")
        return astropy_table(
            {
                "EFFECT": column("effect", "U32"),
                "PARAMETER": column("parameter", "U32"),
                "UNIT": column("unit", "U16", "of DETECTED and NAMED"),
                "DETECTED": column("detected", "f8", "over the shapes: least, most"),
                "NAMED": column("named", "f8", "named alone with 99 % probability"),
                "QU_ERROR": column("error_of_qu", "f8", "median, largest over field"),
                "TAKEN_FOR": (taken_for, "", ""),
            }
        )

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        field = {"x": self.x, "y": self.y, "error_of_qu": self.protection}
        return {
            "probability": thresholds.PROBABILITY,
            "alarm": thresholds.ALARM,
            "limits": [entry._asdict() for entry in self.limits],
            "effects": list(self.effects),
            "separation": self.separation.tolist(),
            "protection": {name: values.tolist() for name, values in field.items()}
            | {"caused_by": list(self.caused_by)},
            "untestable": list(self.untestable),
            "conditions": [entry._asdict() for entry in self.conditions],
            "could_hide": [mistake._asdict() for mistake in self.could_hide],
            "instruments": self.instruments,
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> DetectionLimits:
        """Inverse of `document`. Raises KeyError or TypeError for an invalid one."""
        protection, effects = document["protection"], tuple(document["effects"])
        return cls(
            limits=_records(DetectionLimit, document["limits"], "named"),
            effects=effects,
            separation=np.array(document["separation"], float).reshape(len(effects), len(effects)),
            x=np.array(protection["x"], float),
            y=np.array(protection["y"], float),
            protection=np.array(protection["error_of_qu"], float),
            caused_by=tuple(protection["caused_by"]),
            untestable=tuple(document["untestable"]),
            conditions=_records(ConditionLimit, document.get("conditions", ()), "detected"),
            could_hide=_records(CouldHide, document.get("could_hide", ()), ""),
            instruments=int(document.get("instruments", 1)),
        )

    @property
    def mistakes(self) -> tuple[CouldHide, ...]:
        """All mistakes in order of their undetected error of q and u, the largest first.

        Errors are those of `could_hide`, for all others those of their own limits.
        """
        names = {m.name for m in self.could_hide}
        limits = [limit for limit in self.limits if limit.effect not in thresholds.ASKED_BY_CAMERA]
        others = [(e.name, EFFECT, e.detected[1], e.unit, e.error_of_qu) for e in limits]
        others += [(c.what, DATA, c.size, c.unit, c.error_of_qu) for c in self.conditions]
        further = [
            CouldHide(name, kind, size, unit, "", True, False, error)
            for name, kind, size, unit, error in others
            if name not in names and np.isfinite(error[0])
        ]
        return tuple(sorted((*self.could_hide, *further), key=lambda m: (-m.error[0], -m.error[1])))

    def display(self) -> Display:
        """The worst that could hide in a sentence; a row for each effect and parameter, and each number of the set."""
        limits = {
            EFFECT: {limit.name: limit for limit in self.limits},
            DATA: {limit.what: limit for limit in self.conditions},
        }
        rows: list[tuple[str, ...]] = []
        for kind, title in ((EFFECT, "EFFECTS"), (DATA, "ERRORS IN THE DATA")):
            mistakes = {m.name: m for m in self.mistakes if m.kind == kind}
            names = dict.fromkeys((*mistakes, *limits[kind]))
            if names:
                rows.append((title, *("",) * (len(HEAD) - 1)))
            rows += [_row(name, mistakes.get(name), limits[kind].get(name)) for name in names]
        notes = [f"cannot be detected in these data: {', '.join(self.untestable)}"] if self.untestable else []
        if self.instruments > 1:
            what = f"of {self.instruments} instruments as they may be built, drawn from the priors"
            notes.append(
                f"{what}: detected with the best of them and with the worst, all else with the worst"
            )
        return Display(
            title="What these data can show, with 99 % probability",
            facts=(("undetectable", self.protection_in_words() or NO_LEVEL),),
            head=HEAD,
            rows=tuple(rows),
            notes=tuple(notes),
        )

    def protection_in_words(self) -> str:
        """The largest error of q and u over the field that goes unnoticed; empty where none is known."""
        if not self.mistakes:
            return ""
        worst = self.mistakes[0]
        return (
            "a systematic error too small to be detected could still bias q or u by "
            f"{per_cent(worst.error[0])} % (median over the field, stars with p ≤ 5 %; "
            f"{per_cent(worst.error[1])} % at worst): "
            f"{worst.in_words}"
        )

    @property
    def worst(self) -> int | None:
        """The field point with the largest undetected error; None if one exposure nowhere gives q and u."""
        return int(np.nanargmax(self.protection)) if np.isfinite(self.protection).any() else None


def _row(
    name: str, hidden: CouldHide | None, limit: DetectionLimit | ConditionLimit | None
) -> tuple[str, ...]:
    """A row of the table: a mistake as it could hide, or a limit of which no error is known."""
    error = "" if hidden is None else per_cent_range(*hidden.error)
    if hidden is not None and not any(hidden.error):
        error = "none"
    if isinstance(limit, DetectionLimit):
        named = two_digits(limit.named) if np.isfinite(limit.named) else "never"
        detected = two_digits_range(*limit.detected)
        return name, detected, named, limit.unit, error, ", ".join(limit.taken_for)
    if limit is not None:
        detected = two_digits(limit.detected) if np.isfinite(limit.detected) else "never"
        smaller = limit.size < limit.detected
        remark = f"error at {two_digits(limit.size)} {limit.unit}".rstrip() if smaller else ""
        return name, detected, "", limit.unit, error, remark
    if hidden is None:
        return name, "never", "", "", error, ""
    if not hidden.measured:
        return name, "never", "", hidden.unit, error, f"error at {two_digits(hidden.size)}, the usual size"
    return name, two_digits(hidden.size), "", hidden.unit, error, ""


def _records(kind: Any, entries: Iterable[Mapping[str, Any]], endless: str) -> tuple[Any, ...]:
    """Records from plain data, where numbers that are not finite are null: ∞ in the field `endless`, NaN in others."""

    def value(name: str, entry: Any) -> Any:
        if isinstance(entry, list):
            return tuple(value(name, element) for element in entry)
        return (np.inf if name == endless else np.nan) if entry is None else entry

    return tuple(kind(**{name: value(name, entry[name]) for name in kind._fields}) for entry in entries)


def over_field(errors: Float[np.ndarray, "c p"]) -> tuple[float, float]:
    """Median and largest over the field, of the worst shape."""
    finite = errors[np.isfinite(errors).any(axis=1)]
    if not finite.size:
        return float("nan"), float("nan")
    return float(np.nanmedian(finite, axis=1).max()), float(np.nanmax(finite))


# ---------------------------------------------------------------------------------------------------------- effects


def detection_limits(
    result: FitResult,
    *,
    catalogue: Sequence[EffectKind] | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> DetectionLimits:
    """Detection limits of the data behind a fit for each effect of `catalogue`, and undetectable effects.

    The residuals of the fit are not used: a fit to noiseless counts of a plan serves as well. `seed` is that of the
    Monte Carlo threshold. Of a large set points spread over the field are looked at, or joined cells, as in `diagnose`.
    """
    tell = progress or (lambda text: None)
    template, calset = result.model.template, result.calset
    catalogue = known_effects(result.model) if catalogue is None else catalogue
    listed = hypotheses(catalogue, template, calset.exposures, len(calset.points))
    result = sampled(result, most_points(calset, template, listed.amplitudes))
    tell(Stage("differentiating every effect", "differentiating"))
    rng = np.random.default_rng(seed)
    examination = examine(result, listed, rng)
    p = local_p(thresholds.ALARM, examination.table.trials)
    tell(Stage("comparing the effects", "comparing"))
    rivals = examination.bare.subset([probe.name for probe in examination.probes])
    columns = [c for probe in examination.probes for c in _columns(examination, rivals, probe, p)]
    tell(Stage("finding what goes unnoticed", "unnoticed"))
    errors = _errors(examination, columns)
    design = examination.design
    singles = Singles.of(design)
    if (hidden := result.hidden) is None:
        hidden = undetected_errors(design, singles)
    examined = result if result.verdict is not None else result.with_verdict()
    calibration = Calibration.from_fit(dataclasses.replace(examined, hidden=hidden))
    limits = _collected(examination, columns, errors, listed.effects, calibration)
    return dataclasses.replace(
        limits, conditions=condition_limits(design, singles), could_hide=could_hide(calibration)
    )


@dataclasses.dataclass(frozen=True)
class _Column:
    """One amplitude of one probe: its detection and identification limits, and the distances of its rivals there."""

    probe: Probe
    number: int
    parameter: str
    detected: float
    named: float
    rivals: Mapping[str, float]


def _columns(examination: Examination, rivals: ScoreSpace, probe: Probe, p: float) -> list[_Column]:
    """Amplitudes of a probe; `rivals` is the space of all effects, without the nuisance of single exposures."""
    space = examination.space
    at, alive, rank = space.places()[probe.name], space.alive, space.whitened[probe.name].shape[1]
    first, limits = rivals.places()[probe.name].start, []
    for number, place in enumerate(range(at.start, at.stop)):
        if not alive[place]:
            continue
        detected = float(np.sqrt(noncentrality(p, rank, thresholds.PROBABILITY) / space.gram[place, place]))
        products = rivals.gram[:, first + number]
        square = float(products[first + number])
        apart = examination.nearest(separations(rivals, products, square))
        del apart[probe.effect.name]
        nearest = min(apart.values(), default=np.inf)
        named = detected
        if nearest <= np.sqrt(thresholds.ROUNDING * square):
            named = np.inf
        elif np.isfinite(nearest):
            surely = special.ndtri(thresholds.PROBABILITY) / np.sqrt(square)
            named = max(detected, thresholds.SEPARATION / nearest + surely)
        distances = {name: value * detected for name, value in apart.items()}
        limits.append(_Column(probe, number, probe.parameters[number], detected, float(named), distances))
    return limits


def _errors(examination: Examination, columns: Sequence[_Column]) -> Float[np.ndarray, "c p"]:
    """Error of q and u at every field point from each column, at the amplitude that is just detected.

    That amplitude is at most its prior width: the plausible size where the detection limit is larger.
    Of an effect with many shapes that of the median amplitude stands for all; the others are NaN.
    """
    design, calset, chosen = examination.design, examination.result.calset, _representative(columns)
    errors = np.full((len(columns), len(calset.points)), np.nan)
    looked_at = [i for i, column in enumerate(columns) if column.probe.name in chosen]
    if not looked_at:
        return errors
    of = [columns[i] for i in looked_at]
    raw = [examination.candidates[c.probe.name].columns[:, c.number, None] for c in of]
    taken_up = design.projector.taken_up(design.products(raw, design.projector.basis).T)
    moved = examination.result.model.selection() @ taken_up
    probes = {column.probe.name: column.probe for column in of}
    stars = Starlight.everywhere(design, list(probes.values()))
    sizes = np.array([min(c.detected, float(c.probe.widths[c.number])) for c in of])
    changes = [stars.change(c.probe, c.number, size)[0] for c, size in zip(of, sizes.tolist(), strict=True)]
    errors[looked_at] = stars.errors(changes, sizes[:, None] * moved.T)
    return errors


def _representative(columns: Sequence[_Column]) -> set[str]:
    """Names of the probes whose effect on the matrix is computed."""
    by_effect: dict[EffectKind, dict[str, float]] = {}
    for column in columns:
        by_effect.setdefault(column.probe.effect, {}).setdefault(column.probe.name, column.detected)
    chosen: set[str] = set()
    for shapes in by_effect.values():
        names = sorted(shapes, key=shapes.__getitem__)
        chosen.update(names if len(names) <= MANY_SHAPES else [names[len(names) // 2]])
    return chosen


def _collected(
    examination: Examination,
    columns: Sequence[_Column],
    errors: Float[np.ndarray, "c p"],
    catalogue: Sequence[EffectKind],
    calibration: Calibration,
) -> DetectionLimits:
    groups: dict[tuple[EffectKind, str], list[int]] = {}
    for i, column in enumerate(columns):
        groups.setdefault((column.probe.effect, column.parameter), []).append(i)
    entries = []
    for (effect, parameter), members in groups.items():
        mine = [columns[i] for i in members]
        near = smallest(pair for c in mine for pair in c.rivals.items())
        taken_for = [
            name for name in sorted(near, key=near.__getitem__) if near[name] < thresholds.SEPARATION
        ]
        detected = [c.detected for c in mine]
        entries.append(
            DetectionLimit(
                effect=effect.name,
                parameter=parameter,
                unit=effect.numbers()[parameter].unit,
                detected=(min(detected), max(detected)),
                named=max(c.named for c in mine),
                taken_for=tuple(taken_for),
                error_of_qu=over_field(errors[members]),
            )
        )
    names = tuple(dict.fromkeys(effect.name for effect, _ in groups))
    separation = np.full((len(names), len(names)), np.nan)
    for row, name in enumerate(names):
        near = smallest(p for c in columns if c.probe.effect.name == name for p in c.rivals.items())
        separation[row] = [near.get(rival, np.nan) for rival in names]
    points, result = examination.result.calset.points, examination.result
    setting = first_setting(result.calset, result.model.instrument(result.values))
    hidden = hidden_errors(calibration, points.x, points.y, setting)
    assert calibration.hidden is not None
    all_errors = np.vstack([SECOND_ORDER * errors, hidden, np.full((1, len(points)), np.nan)])
    names_of = (*(c.probe.effect.name for c in columns), *(m.name for m in calibration.hidden.errors), "")
    worst = np.where(np.isfinite(all_errors), all_errors, -1.0)
    largest = worst.argmax(axis=0)
    protection = worst[largest, np.arange(len(points))]
    measurable = protection >= 0
    return DetectionLimits(
        limits=tuple(sorted(entries, key=lambda e: -np.nan_to_num(e.error_of_qu[1], nan=-1.0))),
        effects=names,
        separation=separation,
        x=points.x,
        y=points.y,
        protection=np.where(measurable, protection, np.nan),
        caused_by=tuple(names_of[i] if k else "" for i, k in zip(largest, measurable, strict=True)),
        untestable=examination.untestable(catalogue),
    )


# --------------------------------------------------------------------------------------------------- stated conditions


def condition_limits(design: Design, singles: Singles) -> tuple[ConditionLimit, ...]:
    """A limit for every number that the set behind a fit states, of all `singles` that its verdict asks.

    A number is found where it is significant among all of them, as in the verdict.
    """
    tried, scored = len(singles.testable), [one for one in singles.items if one.single.stated is not None]
    if not scored:
        return ()
    columns = np.column_stack([item.single.candidate.columns[:, 0] for item in scored])
    taken_up = design.projector.taken_up(design.projector.basis.T @ columns)
    moved = design.fit.model.selection() @ taken_up
    stars = Starlight.everywhere(design, ())
    least = noncentrality(local_p(thresholds.ALARM, tried), 1, thresholds.PROBABILITY)
    # In errors of the fit, not in the scatter of its residuals: a plan has none.
    detected = [
        float(np.sqrt(least / float(item.rest[0]))) if item.score.testable else np.inf for item in scored
    ]
    every = [item.stated for item in scored]
    sizes = np.array([min(found, stated.error) for found, stated in zip(detected, every, strict=True)])
    changes = [
        size * stars.slope_by_number(stated) if stated.seen_by_stars else 0.0
        for size, stated in zip(sizes.tolist(), every, strict=True)
    ]
    errors = stars.errors(changes, sizes[:, None] * moved.T)
    return tuple(
        ConditionLimit(stated.what, stated.unit, found, size, over_field(error[None]))
        for stated, found, size, error in zip(every, detected, sizes.tolist(), errors, strict=True)
    )
