"""`walop-jax inspect`: what is in calibration sets, and what is wrong with them."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Annotated, Any

from walop_jax.commands.command import Argument, Job, Outcome, command
from walop_jax.commands.inputs import IN_MEMORY, SETS, Sets, paths_of
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import DataError
from walop_jax.io.text import rounded

if TYPE_CHECKING:
    from walop_jax.data.inspection import Inspection


@dataclasses.dataclass(frozen=True, repr=False)
class InspectedSets(Displayed):
    """An inspection of every file, or the error that it gave; one of all as one set; faults in words."""

    sets: tuple[tuple[str, Inspection | DataError], ...]
    joint: Inspection | None
    faults: tuple[str, ...]

    @property
    def inspections(self) -> tuple[Inspection, ...]:
        """Those that could be made, that of all sets together the last."""
        found = [one for _, one in self.sets if not isinstance(one, DataError)]
        return (*found, *(() if self.joint is None else (self.joint,)))

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "sets": [
                {"files": [path], "error": str(found)}
                if isinstance(found, DataError)
                else dataclasses.asdict(found)
                for path, found in self.sets
            ],
            "joint": None if self.joint is None else dataclasses.asdict(self.joint),
        }

    def display(self) -> Display:
        """The first of the inspections; `displays` are all."""
        return self.displays()[0] if self.inspections else Display("nothing that can be read")

    def displays(self) -> list[Display]:
        """Every inspection."""
        return [_display(one) for one in self.inspections]


def _display(found: Inspection) -> Display:
    low_x, high_x, low_y, high_y = found.field
    counted = math.isfinite(found.median_counts)
    apart = "; standards are measured at places of their own" if found.sources else ""
    some = f" at {found.looked_at} points looked at" if found.looked_at < found.points else ""
    place = (found.instrument, found.telescope)
    noise = f"{found.noise_ratio**0.5:.4g} × the photon noise √N (median)"
    return Display(
        title=", ".join(found.files) or IN_MEMORY,
        facts=(
            ("instrument", f"{', '.join(filter(None, place))} ({found.origin or 'origin not stated'})"),
            (
                "field points",
                f"{found.points}, X {low_x:+.3f} … {high_x:+.3f}°, Y {low_y:+.3f} … {high_y:+.3f}°",
            ),
            ("cameras", str(found.cameras)),
            ("polariser angles", f"{len(found.angles)} modulo 180°, widest gap {found.widest_gap:.3g}°"),
            *(
                (f"element {use.prefix}", f"in {use.exposures} exposures, {len(use.angles)} angles")
                for use in found.elements
            ),
            (
                "used",
                f"{found.rows} of {found.possible} (exposure, point) pairs{some}{apart}",
            ),
            ("flagged", ", ".join(f"{count} {name}" for name, count in found.flags.items()) or "none"),
            (
                "median counts",
                f"{rounded(found.median_counts)} electrons" if counted else "none: all KIND flux",
            ),
            ("errors", noise if counted else "as stated"),
            ("standards", ", ".join(found.sources) or "none"),
            ("filters", ", ".join(found.filters)),
        ),
        head=("kind", "filter", "calibration plate", "source", ">exposures", ">angles", ">used"),
        rows=tuple(
            (
                group.kind,
                group.filter,
                group.calibration_plate,
                group.teff,
                str(group.exposures),
                str(group.angles) if group.angles else "",
                f"{100 * group.used:.0f} %",
            )
            for group in found.groups
        ),
        notes=tuple(f"{finding.severity} {finding}" for finding in found.findings) or ("nothing is wrong",),
    )


@command(jax=False)
def inspect(
    job: Job,
    data: Annotated[Sets, Argument(SETS.help.partition(",")[0] + ".", SETS.metavar, SETS.kind)],
) -> Outcome[InspectedSets]:
    """Say what is in calibration sets and what is wrong with them.

    Each file by itself; then whether they can be fitted as one. Exit code 1 if any cannot be read or fitted.

    In Python: an `InspectedSets`. Raises `DataError` only if the sets cannot be one: what is wrong with a single file
    is among its faults.

    >>> walop.inspect("night.fits").faults
    ()
    """
    from walop_jax import CalibrationSet
    from walop_jax.data.calset import read_calibration_set
    from walop_jax.data.inspection import inspect as inspection_of
    from walop_jax.instruments.description import shipped

    if isinstance(data, CalibrationSet):
        one = inspection_of(data)
        bad = tuple(str(entry) for entry in one.findings if entry.severity == "fault")
        made = InspectedSets(((", ".join(one.files) or IN_MEMORY, one),), None, bad)
        return Outcome(made, failure="; ".join(bad))
    sets: list[tuple[str, Inspection | DataError]] = []
    faults: list[str] = []
    paths = paths_of(data)
    for path in paths:
        job.tell(f"reading {path}")
        try:
            one = inspection_of(read_calibration_set(path))
        except DataError as error:
            faults.append(str(error))
            sets.append((str(path), error))
            continue
        faults += [f"{path}: {entry}" for entry in one.findings if entry.severity == "fault"]
        sets.append((str(path), one))
    strange = [one for _, one in sets if not isinstance(one, DataError) and one.instrument not in shipped()]
    joint = inspection_of(read_calibration_set(*paths)) if len(paths) > 1 and not faults else None
    found = InspectedSets(tuple(sets), joint, tuple(faults))
    return Outcome(
        found,
        found.document,
        lambda: "\n".join(one.text() for one in found.displays()),
        failure="; ".join(faults),
        next=("walop-jax refit CALSET --instrument FILE.toml -o RUN",) if strange else (),
    )
