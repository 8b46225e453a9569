"""Findings of `detection_limits` as a table, as plain data and in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.could_hide import CouldHide
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.examination import Matrix, Vector
from walop_jax.fit.verdict import DATA, EFFECT
from walop_jax.io.display import Display, Displayed
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.text import two_digits, two_digits_range

NO_LEVEL = "q and u cannot both be measured with one exposure"
HEAD = ("amplitude", ">detected", ">named", "unit", ">error of q, u (%)", "can be mistaken for")


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


@dataclasses.dataclass(frozen=True)
class ConditionLimit:
    """Detection limit for the error of a number that a set states.

    `detected` in `unit`, infinite where no residual shows it; `error_of_qu` as that of `DetectionLimit`, at `size`:
    the detection limit, or the largest plausible size where it is not detectable.
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
    can make without being detected, with a tenth on top for what is not of first order, `caused_by` the effect.
    `untestable` effects leave no trace in these data. `conditions` are those stated in the set: its field, its
    filters, the colours of its light. `could_hide` are the undetectable mistakes, as in every command.
    """

    limits: tuple[DetectionLimit, ...]
    effects: tuple[str, ...]
    separation: Matrix
    x: Vector
    y: Vector
    protection: Vector
    caused_by: tuple[str, ...]
    untestable: tuple[str, ...]
    conditions: tuple[ConditionLimit, ...] = ()
    could_hide: tuple[CouldHide, ...] = ()

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
            "probability": thresholds.PROBABILITY,
            "alarm": thresholds.ALARM,
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
            "conditions": [dataclasses.asdict(entry) for entry in self.conditions],
            "could_hide": [mistake._asdict() for mistake in self.could_hide],
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> DetectionLimits:
        """Inverse of `document`. Raises KeyError or TypeError for an invalid one."""
        protection = document["protection"]
        return cls(
            limits=_records(DetectionLimit, document["limits"], "named"),
            effects=tuple(document["effects"]),
            separation=np.array(document["separation"], float).reshape(2 * (len(document["effects"]),)),
            x=np.array(protection["x"], float),
            y=np.array(protection["y"], float),
            protection=np.array(protection["error_of_qu"], float),
            caused_by=tuple(protection["caused_by"]),
            untestable=tuple(document["untestable"]),
            conditions=_records(ConditionLimit, document.get("conditions", ()), "detected"),
            could_hide=tuple(
                CouldHide(**{**entry, "error": tuple(entry["error"])})
                for entry in document.get("could_hide", ())
            ),
        )

    @property
    def mistakes(self) -> tuple[CouldHide, ...]:
        """All mistakes in order of their undetected error of q and u, the largest first.

        Errors are those of `could_hide`, for all others those of their own limits.
        """
        names = {m.name for m in self.could_hide}
        effects = (
            CouldHide(
                f"{e.effect}.{e.parameter}", EFFECT, e.detected[1], e.unit, "", True, False, e.error_of_qu
            )
            for e in self.limits
            if e.effect not in thresholds.ASKED_BY_CAMERA
        )
        data = (
            CouldHide(e.what, DATA, e.size, e.unit, "", True, False, e.error_of_qu) for e in self.conditions
        )
        further = [m for m in (*effects, *data) if m.name not in names and np.isfinite(m.error[0])]
        return tuple(sorted((*self.could_hide, *further), key=lambda m: (-m.error[0], -m.error[1])))

    def display(self) -> Display:
        """The worst that could hide in a sentence; a row for each effect and parameter, and each number of the set."""
        effects = {f"{entry.effect}.{entry.parameter}": entry for entry in self.limits}
        conditions = {entry.what: entry for entry in self.conditions}
        rows: list[tuple[str, ...]] = []
        for kind, title in ((EFFECT, "EFFECTS"), (DATA, "ERRORS IN THE DATA")):
            mistakes = [m for m in self.mistakes if m.kind == kind]
            names = {m.name: m for m in mistakes} | dict.fromkeys(
                name
                for name in (effects if kind == EFFECT else conditions)
                if name not in {m.name for m in mistakes}
            )
            if names:
                rows.append((title, *("",) * (len(HEAD) - 1)))
            rows += [self._row(name, m, effects.get(name), conditions.get(name)) for name, m in names.items()]
        notes = (
            (f"cannot be detected in these data: {', '.join(self.untestable)}",) if self.untestable else ()
        )
        return Display(
            title="What these data can show, with 99 % probability",
            facts=(("undetectable", self.protection_in_words() or NO_LEVEL),),
            head=HEAD,
            rows=tuple(rows),
            notes=notes,
        )

    def _row(
        self,
        name: str,
        hidden: CouldHide | None,
        limit: DetectionLimit | None,
        condition: ConditionLimit | None,
    ) -> tuple[str, ...]:
        error = "" if hidden is None else two_digits_range(*(100.0 * value for value in hidden.error))
        remark = (
            "" if hidden is None or hidden.measured else f"error at {two_digits(hidden.size)}, the usual size"
        )
        if limit is not None:
            named = two_digits(limit.named) if np.isfinite(limit.named) else "never"
            taken_for = ", ".join(limit.taken_for)
            return name, two_digits_range(*limit.detected), named, limit.unit, error, taken_for
        if condition is not None and not np.isfinite(condition.detected):
            remark = f"error at {two_digits(condition.size)} {condition.unit}".rstrip()
        detected = np.inf if remark else hidden.size if hidden is not None else np.nan
        unit = condition.unit if condition is not None else hidden.unit if hidden is not None else ""
        return name, two_digits(detected) if np.isfinite(detected) else "never", "", unit, error, remark

    def protection_in_words(self) -> str:
        """The largest error of q and u over the field that goes unnoticed; empty where none is known."""
        if not self.mistakes:
            return ""
        worst = self.mistakes[0]
        return (
            "a systematic error too small to be detected could still bias q or u by "
            f"{two_digits(100 * worst.error[0])} % (median over the field, stars with p ≤ 5 %; "
            f"{two_digits(100 * worst.error[1])} % at worst): "
            f"{worst.in_words}"
        )

    @property
    def worst(self) -> int | None:
        """The field point with the largest undetected error; None if one exposure nowhere gives q and u."""
        return int(np.nanargmax(self.protection)) if np.isfinite(self.protection).any() else None


def _records(kind: Any, entries: Any, endless: str) -> tuple[Any, ...]:
    """Records from plain data, where numbers that are not finite are null: ∞ in the field `endless`, NaN in others."""

    def value(name: str, entry: Any) -> Any:
        if isinstance(entry, list):
            return tuple(value(name, element) for element in entry)
        return (np.inf if name == endless else np.nan) if entry is None else entry

    names = [field.name for field in dataclasses.fields(kind)]
    return tuple(kind(**{name: value(name, entry[name]) for name in names}) for entry in entries)


def over_field(errors: Float[np.ndarray, "c p"]) -> tuple[float, float]:
    """Median and largest over the field, of the worst shape."""
    finite = errors[np.isfinite(errors).any(axis=1)]
    if not finite.size:
        return float("nan"), float("nan")
    return float(np.nanmedian(finite, axis=1).max()), float(np.nanmax(finite))
