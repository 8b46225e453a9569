"""A plan of calibration exposures as it is told: its lines, its accuracy, its proof, and what it lacks for a go."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.accuracy import GOAL, LARGEST_P
from walop_jax.io.display import Display, Displayed
from walop_jax.io.text import rounded as digits
from walop_jax.plans import criteria
from walop_jax.plans.criteria import Criterion
from walop_jax.plans.separating import DECIDED, Pair
from walop_jax.simulation.observing_plan import ObservingPlan


@dataclasses.dataclass(frozen=True)
class PlannedExposure:
    """One line of a plan: settings, number of exposures, the time (s) of all of them, and their gain.

    `number` is the number of the Moon patch or star, −1 through the polariser; `place` the place of a star in its
    raster (None: all places). `exptime` (s) is the time of one exposure, `change` (s) the time until the first can
    begin. `left_out` is the factor by which the criterion grows without this line, `one_more` the factor by which it
    falls with another exposure. `needed`: a go needs an exposure of this line, whatever its gain.
    """

    kind: str
    filter: str
    positions: Mapping[str, float | None]
    polariser_angle: float
    number: int
    times: int
    seconds: float
    left_out: float
    one_more: float
    exptime: float
    change: float
    place: int | None = None
    needed: bool = False

    def cells(self, reading_in_words: Callable[[str, float], str]) -> tuple[str, ...]:
        """The row of the table of a plan, with readings as `Instrument.reading_in_words` has them."""
        number = "" if self.number < 0 else f" {self.number}"
        readings = (
            f"{p} {'out' if a is None else reading_in_words(p, a)}" for p, a in self.positions.items()
        )
        angle = f"{self.polariser_angle:.1f}°" if np.isfinite(self.polariser_angle) else "out"
        exposures, time = f"{self.times} × {self.exptime:g} s", f"{self.seconds + self.change:.0f}"
        what = f"{self.kind}{number}" + ("" if self.place is None else f" at {self.place}")
        loss = f"{100 * (np.sqrt(self.left_out) - 1):+.2g} %{'; a go needs it' if self.needed else ''}"
        return (what, self.filter, ", ".join(readings), angle, exposures, time, loss)


@dataclasses.dataclass(frozen=True, repr=False)
class ExposurePlan(Displayed):
    """The exposures of a budget, the proof, and the error of p over the field before and after.

    `value` is the criterion of the exposures, `bound` the least value of any plan of the same time, both as `criteria`
    reports them (% for errors of p). `needed` are the minutes in which the best plan reaches `goal`, and those in which
    none can. `before` and `after` (draw, point) are errors of p (fraction) at `x`, `y` (deg), NaN where one exposure
    holds no u. `beside` are other plans of the same time: their criterion, told likewise; `notes` what had to be left
    out, and what these exposures cannot show. The bound holds on a fine grid of angles of the polariser, and for the
    angles of the calibration plate on its grid if `any_plate`; `bound_of_go` is the least value of plans that contain
    the lines that are `needed`. `lacks` is what a go needs and these exposures do not give, with the calibration to
    which they are added, if they are (`added`): if nothing, a go is to be expected. `pairs` are the members of a class
    that the plan separates, each as the truth beside each other.
    """

    minutes: float
    lines: tuple[PlannedExposure, ...]
    criterion: Criterion
    value: float
    bound: float
    weights_gap: float
    truncation: float
    goal: float | None
    needed: tuple[float, float] | None
    x: Float[np.ndarray, " p"]
    y: Float[np.ndarray, " p"]
    before: Float[np.ndarray, "r p"]
    after: Float[np.ndarray, "r p"]
    beside: Mapping[str, float]
    observing_plan: ObservingPlan
    notes: tuple[str, ...] = ()
    any_plate: bool = False
    bound_of_go: float = float("nan")
    lacks: tuple[str, ...] = ()
    added: bool = False
    pairs: tuple[Pair, ...] = ()

    @property
    def efficiency(self) -> float:
        """Fraction of the time in which the best plan of any exposures would be as good, but for prior knowledge."""
        return self.criterion.variance(self.bound) / self.criterion.variance(self.value)

    @property
    def gap(self) -> float:
        """Proven relative distance of the variance of the exposures from the best: distance in the criterion of
        `optimal`.
        """
        return self.criterion.variance(self.value) / self.criterion.variance(self.bound) - 1.0

    @property
    def share(self) -> float | None:
        """Fraction of the field points and colours, of those that hold u, at which the error of p is below 0.1 %."""
        errors = self.after[:, np.isfinite(self.after).all(axis=0)]
        return float(np.mean(errors < GOAL)) if errors.size else None

    @property
    def seconds(self) -> float:
        """Time of all exposures and changes."""
        return sum(line.seconds + line.change for line in self.lines)

    def document(self) -> dict[str, Any]:
        """The plan as plain data."""
        asked = self.criterion
        document: dict[str, Any] = {
            "minutes": self.minutes, "seconds": self.seconds,
            "exposures": [dataclasses.asdict(line) for line in self.lines],
            "criterion": asked.name, "what": asked.what, "unit": asked.unit, "value": self.value,
            "bound": self.bound, "gap": self.gap, "gap_of_weights": self.weights_gap,
            "any_plate": self.any_plate, "truncation": self.truncation, "goal": self.goal,
            "minutes_to_goal": self.needed and dict(zip(("best", "least"), self.needed, strict=True)),
            "draws": len(self.after), "share_below_goal": self.share, "beside": dict(self.beside),
            "bound_of_go": self.bound_of_go, "efficiency": self.efficiency, "lacks": list(self.lacks),
            "pairs": [pair._asdict() | {"separated": pair.after >= DECIDED} for pair in self.pairs],
            "notes": list(self.notes), "plan": self.observing_plan.document(),
        }  # fmt: skip
        if self.criterion.name == criteria.WORST:
            document |= {"p_error_worst": 0.01 * self.value, "p_error_bound": 0.01 * self.bound}
        if len(self.x):
            before, after = np.median(self.before, axis=0), np.median(self.after, axis=0)
            document["field"] = {
                "x": self.x.tolist(), "y": self.y.tolist(), "p_error": after.tolist(), "before": before.tolist()
            }  # fmt: skip
        return document

    def display(self) -> Display:
        """The exposures in order, and how good they are."""
        unit = f" {self.criterion.unit}" if self.criterion.unit else ""
        better = "above" if self.criterion.inverse else "below"
        exposures = f"{sum(line.times for line in self.lines)} exposures for {self.observing_plan.name}"
        of_a_go = [line for line in self.lines if line.needed]
        alone = "this plan beside the calibration" if self.added else "this plan alone"
        facts = {"plan": exposures} if self.lacks else {}
        facts |= {
            "time": f"{self.seconds / 60:.1f} of {self.minutes:g} min",
            self.criterion.what: f"{digits(self.value, '.3g')}{unit}",
            "proof": f"no plan of this time gets {better} {digits(self.bound, '.3g')}{unit}",
        }
        if of_a_go:
            facts["proof"] += (
                f", none with the {len(of_a_go)} that a go needs {digits(self.bound_of_go, '.3g')}{unit}"
            )
            facts["efficiency"] = (
                f"{100 * self.efficiency:.0f} % of the best plan of any exposures, go or no go"
            )
        if self.share is not None:
            seen = np.isfinite(self.after).all(axis=0)
            without, middle = (float(np.median(errors[:, seen])) for errors in (self.before, self.after))
            # An error as large as the largest p of stars says nothing on p.
            known = f"{100 * without:.3g} %" if without < LARGEST_P else "nothing known"
            facts["over the field"] = (
                f"error of p {100 * middle:.3g} % (median over the field; {known} without them), below 0.1 % "
                f"in {100 * self.share:.0f} % of the field where one exposure measures u"
            )
        if self.needed is not None:
            best, least = (f"{digits(minutes, '.3g')} min" for minutes in self.needed)
            takes = f"{best}, not counting changes; no plan needs less than {least}"
            facts[f"{digits(self.goal, '.3g')}{unit} takes"] = takes
        variance_of_plan = self.criterion.variance(self.value)
        for pair in self.pairs:
            facts[f"{pair.truth} or {pair.rival}"] = pair.in_words()
        for name, other_value in self.beside.items():
            factor = self.criterion.variance(other_value) / variance_of_plan
            variance = "equally good" if f"{factor:.2g}" == "1" else f"{factor:.2g} times the variance"
            facts[name] = f"{digits(other_value, '.3g')}{unit}; {variance}"
        return Display(
            title=f"No go with {alone}: {'; '.join(self.lacks)}" if self.lacks else f"Plan of {exposures}",
            facts=tuple(facts.items()),
            head=("KIND", "FILTER", "POSITIONS", ">POLARISER", ">EXPOSURES", ">TIME / s", ">LOSS IF OMITTED"),
            rows=tuple(line.cells(self.observing_plan.design.reading_in_words) for line in self.lines),
            notes=self.notes,
        )
