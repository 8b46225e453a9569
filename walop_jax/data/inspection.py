"""Contents and faults of a calibration set: numbers and findings; nothing is printed here."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import numpy as np

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.kinds import CALIBRATION_PLATE
from walop_jax.data.plausible import like_radians
from walop_jax.data.records import CalibrationSet, DataFlag, Exposures, sampled
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.instruments.description import shipped
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import DataError, PathLike
from walop_jax.io.names import IN_MEMORY
from walop_jax.io.text import rounded

Severity = Literal["fault", "doubt", "note"]

_LOOKED_AT = 1024  # field points whose intensities are looked at; in evenly spaced blocks
FEW_ANGLES = 8
"""Angles of the polariser modulo 180° below which a set is in doubt."""
_FEWEST_SETTINGS = 3
_NARROW = 30.0  # degrees
_FEW_POINTS = 15
_NOISE = (0.8, 25.0)  # believable σ²/N
_UNEVEN = 1.5  # factor between the N_ERR²/N of cameras
_MUCH = 0.05


@dataclasses.dataclass(frozen=True)
class Finding:
    """Something about a set that its owner should know: a fault forbids a fit, a doubt may spoil it, a note does
    neither.
    """

    severity: Severity
    what: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.what}{'; ' + self.advice if self.advice else ''}"


@dataclasses.dataclass(frozen=True)
class Group:
    """Exposures with the same kind, filter, position of the calibration plate (text) and colour temperature (text).

    `teff` is "star" for standards, each of which has its own; `used` is the fraction of the field points with used
    data.
    """

    kind: str
    filter: str
    calibration_plate: str
    teff: str
    exposures: int
    angles: int
    used: float


@dataclasses.dataclass(frozen=True)
class ElementUse:
    """Use of a further moving element: exposures with it in the beam, and its distinct angles (deg)."""

    prefix: str
    exposures: int
    angles: tuple[float, ...]


@dataclasses.dataclass(frozen=True, repr=False)
class Inspection(Displayed):
    """A calibration set at a glance.

    `kinds` counts the exposures of each KIND. `angles` are the distinct polariser angles modulo 180° of exposures
    with data, `widest_gap` the largest distance between neighbours among them (degrees); `elements` are the moving
    elements beyond polariser and calibration plate. `noise_ratio` is the median of σ²/N: 1 for pure photon
    noise, more with read noise; NaN where KIND is `flux` throughout. `rows` counts used (exposure, point)
    pairs of those looked at (`looked_at` points).
    """

    instrument: str
    telescope: str
    origin: str
    files: tuple[str, ...]
    cameras: int
    kinds: dict[str, int]
    groups: tuple[Group, ...]
    points: int
    field: tuple[float, float, float, float]
    angles: tuple[float, ...]
    widest_gap: float
    elements: tuple[ElementUse, ...]
    looked_at: int
    rows: int
    possible: int
    flags: dict[str, int]
    median_counts: float
    noise_ratio: float
    sources: tuple[str, ...]
    filters: tuple[str, ...]
    findings: tuple[Finding, ...]

    @property
    def faults(self) -> tuple[str, ...]:
        """The findings that keep the set from a fit."""
        return tuple(str(finding) for finding in self.findings if finding.severity == "fault")

    def display(self) -> Display:
        """Contents of the set, and findings."""
        low_x, high_x, low_y, high_y = self.field
        counted = math.isfinite(self.median_counts)
        apart = "; standards are measured at places of their own" if self.sources else ""
        sampled_points = f" at {self.looked_at} points looked at" if self.looked_at < self.points else ""
        place = ", ".join(filter(None, (self.instrument, self.telescope)))
        noise = f"{self.noise_ratio**0.5:.4g} × the photon noise √N (median)"
        number = {use.prefix: f"{use.exposures} exposures, {len(use.angles)} angles" for use in self.elements}
        facts = {
            "instrument": f"{place} ({self.origin or 'origin not stated'})",
            "field points": f"{self.points}, X {low_x:+.3f} … {high_x:+.3f}°, Y {low_y:+.3f} … {high_y:+.3f}°",
            "cameras": str(self.cameras),
            "polariser angles": f"{len(self.angles)} modulo 180°, widest gap {self.widest_gap:.3g}°",
            **{f"element {prefix}": f"in {uses}" for prefix, uses in number.items()},
            "used": f"{self.rows} of {self.possible} (exposure, point) pairs{sampled_points}{apart}",
            "flagged": ", ".join(f"{count} {name}" for name, count in self.flags.items()) or "none",
            "median counts": f"{rounded(self.median_counts)} electrons" if counted else "none: all KIND flux",
            "errors": noise if counted else "as stated",
            "standards": ", ".join(self.sources) or "none",
            "filters": ", ".join(self.filters),
        }
        rows = ((*dataclasses.astuple(g)[:5], g.angles or "", f"{100 * g.used:.0f} %") for g in self.groups)
        return Display(
            title=", ".join(self.files) or IN_MEMORY,
            facts=tuple(facts.items()),
            head=("kind", "filter", "calibration plate", "source", ">exposures", ">angles", ">used"),
            rows=tuple(tuple(map(str, row)) for row in rows),
            notes=tuple(f"{finding.severity} {finding}" for finding in self.findings)
            or ("nothing is wrong",),
        )


@dataclasses.dataclass(frozen=True, repr=False)
class InspectedSets(Displayed):
    """The inspection of every file, or the error that reading it gave; the inspection of all as one set; faults in
    words.
    """

    sets: tuple[tuple[str, Inspection | DataError], ...]
    joint: Inspection | None
    faults: tuple[str, ...]

    @classmethod
    def of(cls, calset: CalibrationSet) -> InspectedSets:
        """The inspection of a set in memory."""
        inspection = inspect(calset)
        return cls(((", ".join(inspection.files) or IN_MEMORY, inspection),), None, inspection.faults)

    @property
    def inspections(self) -> tuple[Inspection, ...]:
        """The inspections that could be made, the inspection of all sets together last."""
        readable = [inspection for _, inspection in self.sets if not isinstance(inspection, DataError)]
        return (*readable, *(() if self.joint is None else (self.joint,)))

    def document(self) -> dict[str, Any]:
        """The inspections as plain data, for `--json`."""
        sets = [
            {"files": [path], "error": str(of)} if isinstance(of, DataError) else dataclasses.asdict(of)
            for path, of in self.sets
        ]
        return {"sets": sets, "joint": None if self.joint is None else dataclasses.asdict(self.joint)}

    def display(self) -> Display:
        """The first of the inspections."""
        return self.inspections[0].display() if self.inspections else Display("nothing that can be read")


def inspect_files(
    paths: Sequence[PathLike], tell: Callable[[str], None] = lambda text: None
) -> InspectedSets:
    """Every file by itself; all as one set if none has a fault. That they cannot be one is a fault as well."""
    sets: list[tuple[str, Inspection | DataError]] = []
    faults: list[str] = []
    for path in paths:
        tell(f"reading {path}")
        try:
            inspection = inspect(read_calibration_set(path))
        except DataError as error:
            faults.append(str(error))
            sets.append((str(path), error))
            continue
        faults += [f"{path}: {fault}" for fault in inspection.faults]
        sets.append((str(path), inspection))
    joint = None
    if len(paths) > 1 and not faults:
        try:
            joint = inspect(read_calibration_set(*paths))
        except DataError as error:
            faults.append(f"these files cannot be fitted as one set: {error}")
    return InspectedSets(tuple(sets), joint, tuple(faults))


def inspect(calset: CalibrationSet) -> Inspection:
    """Look at a calibration set that has been read; of many field points only at some, evenly spaced."""
    e, points = calset.exposures, calset.points
    _, block = sampled(calset.intensities, len(points), _LOOKED_AT)
    used = block.used
    share = used.mean(axis=0)
    live, measured = share > 0, used & ~e.flux_known
    counts, sigma = block.counts[measured], block.sigma[measured]
    # Errors of cells of whole frames are those of many pixels.
    single = (counts > 0) & (calset.fine is None)
    ratio = np.where(single, sigma**2 / np.where(single, counts, 1.0), np.nan)
    by_camera = np.array([_median(of_camera) for of_camera in ratio.T])
    angles = _distinct(np.mod(e.clp_angle[e.clp_in & live], 180.0))
    inspection = Inspection(
        instrument=calset.instrument,
        telescope=calset.site.telescope,
        origin=calset.origin,
        files=tuple(str(entry.path) for entry in calset.inputs),
        cameras=calset.cameras,
        kinds=dict(Counter(e.kind.tolist())),
        groups=_groups(calset, share),
        points=len(points),
        field=(float(points.x.min()), float(points.x.max()), float(points.y.min()), float(points.y.max())),
        angles=angles,
        widest_gap=_widest_gap(np.array(angles), 180.0),
        elements=tuple(
            ElementUse(prefix, int(at.inside.sum()), _distinct(at.angle[at.inside]))
            for prefix, at in e[live].further.items()
        ),
        looked_at=len(used),
        rows=int(used.sum()),
        possible=int(used.size),
        flags=_flags(calset),
        median_counts=_median(counts),
        noise_ratio=_median(ratio),
        sources=tuple(str(name) for name in calset.sources.name),
        filters=tuple(calset.filters),
        findings=(),
    )
    taken = e[np.flatnonzero(live)]
    settings = _about_settings([taken], " with usable data")
    findings = (*_findings(calset, inspection), *_about_cameras(by_camera), *settings)
    notes = (Finding("note", remark) for remark in calset.remarks)
    return dataclasses.replace(inspection, findings=(*findings, *notes))


def _distinct(angles: np.ndarray) -> tuple[float, ...]:
    """Different angles (deg), in ascending order."""
    return tuple(np.unique(np.round(angles, 3)).tolist())


def _widest_gap(angles: np.ndarray, turn: float) -> float:
    """The largest distance between neighbours among angles (deg) that are the same again after a `turn`."""
    ordered = np.sort(np.mod(angles, turn))
    return float(np.diff(np.append(ordered, ordered[:1] + turn)).max(initial=0.0)) if len(ordered) else turn


def _median(values: np.ndarray) -> float:
    """The median of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")


def _groups(calset: CalibrationSet, share: np.ndarray) -> tuple[Group, ...]:
    e = calset.exposures
    plate = e.position(CALIBRATION_PLATE)
    plates = [f"{a:g} deg" if i else "out" for a, i in zip(plate.angle, plate.inside, strict=True)]
    teff = np.where(e.kind == "standard", "star", [f"{t:g} K" if np.isfinite(t) else "flat" for t in e.teff])
    keys = list(zip(map(str, e.kind), map(str, e.filter), plates, teff.tolist(), strict=True))
    groups = []
    for key in dict.fromkeys(keys):
        rows = np.array([n for n, group in enumerate(keys) if group == key])
        angles = _distinct(e.clp_angle[rows][e.clp_in[rows]])
        groups.append(Group(*key, len(rows), len(angles), float(share[rows].mean())))
    return tuple(groups)


def _flags(calset: CalibrationSet) -> dict[str, int]:
    """Flagged rows by meaning, of tables."""
    if not isinstance(calset.intensities, TableIntensities):
        return {}
    flag = calset.intensities.flag
    counts = Counter({bit.meaning: int(np.count_nonzero(flag & bit)) for bit in DataFlag})
    counts["other"] = int(np.count_nonzero(flag & ~sum(DataFlag)))
    return {name: number for name, number in counts.items() if number}


def _findings(calset: CalibrationSet, made: Inspection) -> Iterator[Finding]:
    if not calset.exposures.further:
        yield from _about_angles(made.angles, " with usable data")
    if made.points < 2:
        # The needs of other instruments are in their descriptions.
        severity = "fault" if calset.instrument in shipped() else "note"
        advice = "the throughput over the field needs several, unless degree = 0 under [throughput] of the"
        yield Finding(severity, "a single field point", f"{advice} instrument file")
    elif made.points < _FEW_POINTS:
        advice = "the throughput of each camera over the field has 15 terms"
        yield Finding("doubt", f"only {made.points} field points", advice)
    if np.isfinite(made.noise_ratio) and not _NOISE[0] <= made.noise_ratio <= _NOISE[1]:
        what = f"the errors are {np.sqrt(made.noise_ratio):.3g} times the photon noise sqrt(N)"
        yield Finding("doubt", what, "are N and N_ERR in electrons, or in counts (multiply by the gain)?")
    yield from _about_light(calset.exposures)
    everywhere = made.points * len(calset.exposures)  # flags are those of all points, not of those looked at
    if (saturated := made.flags.get(DataFlag.SATURATED.meaning, 0)) > _MUCH * everywhere:
        yield Finding("doubt", f"{saturated} rows are saturated", "expose for a shorter time")
    if unknown := made.flags.get("other", 0):
        yield Finding("note", f"{unknown} rows have FLAG bits without a meaning", "they are not used")


def _about_cameras(noise_ratio: np.ndarray) -> Iterator[Finding]:
    """N_ERR²/N is the same in all cameras whose light is mostly counted in the same unit."""
    finite = noise_ratio[np.isfinite(noise_ratio)]
    if finite.size and finite.max() > _UNEVEN * finite.min():
        listed = ", ".join(f"N{k} {value:.3g}" for k, value in enumerate(noise_ratio))
        advice = "are all of them in electrons, or some in counts (multiply by the gain)?"
        yield Finding("doubt", f"N_ERR²/N differs between the cameras: {listed}", advice)


def about_exposures(*taken: Exposures) -> Iterator[Finding]:
    """Findings on what lists of exposures, taken or planned, cannot show together, whatever their counts are."""
    if not any(e.further for e in taken):
        yield from _about_angles(
            _distinct(np.mod(np.concatenate([e.clp_angle[e.clp_in] for e in taken]), 180.0))
        )
    yield from _about_light(*taken)
    yield from _about_settings(taken)


def _about_angles(angles: tuple[float, ...], of_what: str = "") -> Iterator[Finding]:
    """Findings on the distinct angles of the polariser (deg, modulo 180)."""
    number, span = len(angles), 180.0 - _widest_gap(np.array(angles), 180.0)
    if number < 3:
        what = f"{number} distinct polariser angle(s) modulo 180°{of_what}"
        yield Finding("fault", what, "a fit needs at least 3, better 15 spread over 360°")
    elif span < _NARROW:
        yield Finding("doubt", f"all polariser angles lie within {span:.3g}°", "spread them over 180°")
    elif number < FEW_ANGLES:
        advice = f"with fewer than {FEW_ANGLES}, polariser errors cannot be separated from instrument errors"
        yield Finding("doubt", f"only {number} polariser angles modulo 180°", advice)


def _about_light(*taken: Exposures) -> Iterator[Finding]:
    """Notes on the turn of the polariser, and on light that does not pass it."""
    angles = np.concatenate([e.clp_angle[e.clp_in] for e in taken])
    if len(angles) and not any(e.further for e in taken) and _widest_gap(angles, 360.0) > 180.0:
        advice = "a full turn is needed to separate an encoder wobble from the instrument"
        yield Finding("note", "the polariser turns through half a turn only", advice)
    if not sees_the_sky(*taken):
        what = "the only light of known polarisation is that through the polariser (neither moonlit sky nor standards)"
        advice = "without these, neither the zero of the polariser nor telescope polarisation can be measured"
        yield Finding("note", what, advice)


def sees_the_sky(*taken: Exposures) -> bool:
    """True where light of a known polarisation comes from the sky: exposures of the Moon, or of standards."""
    return any(bool(np.any(e.direct("moon", "standard"))) for e in taken)


def _about_settings(taken: Sequence[Exposures], of_what: str = "") -> Iterator[Finding]:
    """Findings where further elements move: which of them does the polariser's work is not known here."""
    if not any(e.further for e in taken):
        return
    distinct = set[tuple[str, ...]]()
    for used in taken:
        angles = [position.angle.astype(str) for position in used.positions.values()]
        distinct |= set(zip(*angles, strict=True))
    if len(distinct) < _FEWEST_SETTINGS:
        what = f"{len(distinct)} distinct setting(s) of the moving elements{of_what}"
        yield Finding("fault", what, f"a fit needs at least {_FEWEST_SETTINGS}")
    for prefix, position in (pair for used in taken for pair in used.positions.items()):
        if like_radians(position.angle[position.inside]):
            what = f"the angles of {prefix} look like radians"
            yield Finding("doubt", what, f"{prefix}_ANGLE is in degrees")
