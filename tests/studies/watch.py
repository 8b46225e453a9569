"""Do the stars of many nights see a camera that changes, and nothing where nothing has changed?

    python tests/studies/watch.py [--quiet 500] [--each 100] [--overlaps 200]

Every catalogue is of ten nights, each of its stars seen with the calibration plate out and at 22.5°, 10⁶ electrons a
camera give or take a factor of three, through an instrument that differs from the calibration by errors drawn from its
covariance. Printed are: false alarms in quiet catalogues; for 100, 600 and 5000 stars and steps of one camera from
0.01 to 1 %, how many are found, how many at the right night, and how many name the camera (a wrong one apart); the
same at the size that the bound promises for 99 %; what is said of a camera that drifts and of a plate that turns; and
how many spots of the field, in which a camera has lost light, are found, with their size.
Before these: false alarms of the comparison of stars at two places of the field.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from small_run import small_fit_with_plate  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.calibration.analysis_vectors import AnalysisVectors  # noqa: E402
from walop_jax.calibration.calibration import Calibration  # noqa: E402
from walop_jax.data.settings import Settings  # noqa: E402
from walop_jax.data.user_tables import in_memory  # noqa: E402
from walop_jax.science import apply as application  # noqa: E402
from walop_jax.science.apply import residuals_of  # noqa: E402
from walop_jax.science.catalogue import read_catalogue  # noqa: E402
from walop_jax.science.overlaps import Overlap, overlap  # noqa: E402
from walop_jax.science.star_history import Watching  # noqa: E402
from walop_jax.science.star_residuals import StarResiduals  # noqa: E402
from walop_jax.science.star_words import Watch  # noqa: E402
from walop_jax.science.watch import with_rivals  # noqa: E402

NIGHTS, START = 10, 6
PLATES = (None, 22.5)
SIZES = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
STARS = (100, 600, 5000)
SPOTS = ((0.1, 0.07), (0.01, 0.05), (0.005, 0.1))
"""Light that camera O2 has lost in a disc, and its radius (deg)."""
DATED = 1.8
"""Times the bound: from there on a step is dated to one night, and told from a drift, as often as it is found there."""
Gains = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Change of the four cameras (star, camera) in nights, and at X and Y (deg)."""


@functools.cache
def vectors() -> AnalysisVectors:
    """Those of a small run, with the optics that may have changed beside its parameters."""
    return AnalysisVectors(with_rivals(Calibration.from_fit(small_fit_with_plate())))


def _true_vectors(x: np.ndarray, y: np.ndarray, plate: float | None, change: np.ndarray) -> np.ndarray:
    """Analysis vectors of an instrument whose parameters differ by `change` from those of the calibration."""
    v, teff = vectors(), np.full(len(x), 5500.0)
    setting = v.reduced(Settings.default(1).at(CHWP=plate))
    local = v.derivatives(setting, x, y, teff)
    series = np.einsum("pkst,pm->pkstm", local.throughput, v.basis(x, y))
    slopes = np.concatenate([local.plain, series.reshape(*series.shape[:3], -1)], axis=-1)
    return v.coloured(setting, x, y, teff) + slopes @ change


def watching(
    stars: int,
    seed: int,
    gains: Gains | None = None,
    turned: tuple[str, float] | None = None,
    plates: tuple[float | None, ...] = PLATES,
    scatter: float = 1.0,
) -> Watching:
    """One catalogue, ready to be asked: `gains` of the cameras by night, or a parameter `turned` from `START` on.

    `scatter` is the noise over what N_ERR says.
    """
    rng, v = np.random.default_rng([stars, seed]), vectors()
    off = v.root @ rng.standard_normal(v.root.shape[1])
    rows: list[dict[str, np.ndarray]] = []
    night = np.sort(rng.integers(0, NIGHTS, stars))
    x, y = rng.uniform(-0.28, 0.28, (2, stars))
    p, angle = rng.uniform(0.0, 0.05, stars), rng.uniform(0.0, np.pi, stars)
    s = np.stack([np.ones(stars), p * np.cos(2 * angle), p * np.sin(2 * angle)], axis=1)
    for plate in plates:
        a = _true_vectors(x, y, plate, off)
        if turned is not None:
            moved = off.copy()
            moved[[name for name, _ in v.named].index(turned[0])] += turned[1]
            a = np.where((night >= START)[:, None, None], _true_vectors(x, y, plate, moved), a)
        counts = 4e6 * 10 ** rng.uniform(-0.5, 0.5, stars)[:, None] * np.einsum("pks,ps->pk", a, s)
        if gains is not None:
            counts *= 1.0 + gains(night, x, y)
        error = np.sqrt(counts + 100.0)
        there = {
            "ID": np.arange(stars),
            "X": x,
            "Y": y,
            "N": counts + scatter * error * rng.standard_normal(counts.shape),
        }
        there |= {"N_ERR": error, "TEFF": np.full(stars, 5500.0), "MJD": 60000.0 + night}
        there["CHWP_ANGLE"] = np.full(stars, np.nan if plate is None else plate)
        rows.append(there)
    table = in_memory({name: np.concatenate([r[name] for r in rows]) for name in rows[0]})
    calibration = v.calibration
    catalogue = read_catalogue(table, calibration.model.template.patched(), always_in=calibration.always_in)
    left = StarResiduals.joined(residuals_of(v, catalogue, 10**9))
    return Watching(left, v)


@functools.wraps(watching)
def watched(*given: Any, **options: Any) -> Watch:
    """The watch of one catalogue."""
    return watching(*given, **options).watch()


def overlapping(stars: int, seed: int) -> Overlap | None:
    """The comparison of sound stars that are seen in two fields 0.2 deg apart."""
    rng, v = np.random.default_rng([stars, seed, 2]), vectors()
    off = v.root @ rng.standard_normal(v.root.shape[1])
    x, y = rng.uniform(-0.28, 0.08, stars), rng.uniform(-0.28, 0.28, stars)
    s = np.column_stack([np.ones(stars), rng.normal(0.0, 0.02, (stars, 2))])
    flux, rows = 4e6 * 10 ** rng.uniform(-0.5, 0.5, stars)[:, None], []
    for field, shift in enumerate((0.0, 0.2)):
        counts = flux * np.einsum("pks,ps->pk", _true_vectors(x + shift, y, None, off), s)
        error = np.sqrt(counts + 100.0)
        there = {"RA": 50.0 + np.arange(stars) / 100, "DEC": np.zeros(stars), "X": x + shift, "Y": y}
        there |= {"N": counts + error * rng.standard_normal(counts.shape), "N_ERR": error}
        there |= {"ROTATOR": np.zeros(stars), "TEFF": np.full(stars, 5500.0)}
        rows.append(there | {"MJD": np.full(stars, 60000.0 + field)})
    table = in_memory({name: np.concatenate([r[name] for r in rows]) for name in rows[0]})
    calibration = v.calibration
    catalogue = read_catalogue(table, calibration.model.template.patched(), always_in=calibration.always_in)
    return overlap(calibration, catalogue)


def _of(cameras: int | tuple[int, ...], change: np.ndarray) -> np.ndarray:
    return change[:, None] * np.isin(np.arange(4), cameras)


def step(size: float, camera: int | tuple[int, ...] = 0) -> Gains:
    """Cameras brighter from `START` on."""
    return lambda night, x, y: _of(camera, size * (night >= START))


def drift(size: float, camera: int = 0) -> Gains:
    """One camera brighter by `size` in the last night, evenly since the first."""
    return lambda night, x, y: _of(camera, size * night / (NIGHTS - 1))


def gradient(size: float, camera: int | tuple[int, ...], angle: float) -> Gains:
    """Cameras brighter from `START` on by `size` at 0.28 degrees from the middle, at an angle (deg) from X to Y."""
    way = np.deg2rad(angle)
    return lambda night, x, y: _of(
        camera, size * (night >= START) * (x * np.cos(way) + y * np.sin(way)) / 0.28
    )


def spot(size: float, camera: int | tuple[int, ...], x0: float, y0: float, radius: float) -> Gains:
    """Cameras brighter from `START` on within a disc of the field (deg)."""
    return lambda night, x, y: _of(camera, size * (night >= START) * (np.hypot(x - x0, y - y0) < radius))


@dataclasses.dataclass
class Tally:
    """Of catalogues with a step of camera O1: found, at the right night, named rightly, named as another camera.

    `between`: the night lies in the interval that is told.
    """

    asked: int = 0
    found: int = 0
    dated: int = 0
    within: int = 0
    between: int = 0
    named: int = 0
    wrong: int = 0

    def add(self, watch: Watch, name: str) -> None:
        """Judge one catalogue."""
        self.asked += 1
        if watch.holds:
            return
        self.found += 1
        change = watch.changes[0]
        groups = abs(change.time - 60000.0 - START)
        self.dated += groups == 0
        self.within += groups <= 1
        self.between += change.between[0] <= 60000.0 + START <= change.between[1]
        self.named += change.camera == name
        self.wrong += change.camera not in (None, name)

    def __str__(self) -> str:
        return (
            f"{self.found} of {self.asked} found, {self.dated} at the night ({self.within} within one, "
            f"{self.between} in the interval told), {self.named} named, {self.wrong} another camera named"
        )


def spots(depth: float, radius: float, count: int) -> str:
    """Spots at random places that are found, at their place, with the camera among those named, and with their loss."""
    found = there = named = sized = 0
    for seed in range(count):
        x, y = np.random.default_rng(seed).uniform(-0.2, 0.2, 2)
        changes = watched(600, 4000 + seed, spot(-depth, 2, x, y, radius)).changes
        alike = [entry for change in changes for entry in change.alike if entry.kind == "spot"]
        near = [e for e in alike if np.hypot(e.place[0] - x, e.place[1] - y) < 0.5 * radius]
        found += bool(changes)
        there += bool(near)
        named += any(e.name == "O2" for e in near)
        sized += any(abs(abs(e.size) - depth) < 0.2 * depth for e in near)
    return f"{found} of {count} found, {there} there, {named} with O2 named, {sized} of that size to a fifth"


def main() -> None:
    """Print the study."""
    given = options_of(__doc__, quiet=500, each=100, overlaps=200).parse_args()
    application.AnalysisVectors = lambda calibration: vectors()  # those of the one calibration, made once
    for stars in STARS[:2]:
        seen = [overlapping(stars, seed) for seed in range(given.overlaps // 2)]
        ratio = [one.chi2 / one.dof for one in seen if one is not None]
        alarms = sum(one is not None and one.differs for one in seen)
        print(
            f"overlaps, {stars} stars at two places: {alarms} false alarms in {len(seen)}; χ²/dof "
            f"{np.mean(ratio):.3f} on average, {max(ratio):.3f} at most", flush=True,
        )  # fmt: skip
    share = {100: 0.6, 600: 0.3, 5000: 0.1}
    for stars in STARS:
        count = round(given.quiet * share[stars])
        false = [s for s in range(count) if not watched(stars, s).holds]
        print(f"quiet, {stars} stars: {len(false)} false alarms in {count}", flush=True)
    for stars in STARS:
        each = max(given.each * 600 // max(stars, 600), 5)
        bound = float(watched(stars, 10**6).smallest[START, 0])
        for size in (*SIZES, bound, DATED * bound):
            tally = Tally()
            for seed in range(each):
                tally.add(watched(stars, 1000 + seed, step(size)), "O1")
            at = {bound: " (the bound: 99 %)", DATED * bound: " (dated)"}.get(size, "")
            print(f"{stars} stars, step {100 * size:.3f} %{at}: {tally}", flush=True)
    for stars in (600, 5000):
        kinds: dict[str, int] = {}
        cameras: dict[str, int] = {}
        for seed in range(max(given.each // 5, 3)):
            for change in watched(stars, 2000 + seed, drift(0.01)).changes[:1]:
                kinds[change.best.history.kind] = kinds.get(change.best.history.kind, 0) + 1
                cameras[str(change.camera)] = cameras.get(str(change.camera), 0) + 1
        print(f"{stars} stars, O1 drifts by 1 %: {kinds}, named {cameras}", flush=True)
    for name, size in (("hwp1_axis.angle", 0.3), ("hwp2_axis.angle", 0.3), ("chwp_axis.angle", 0.3)):
        best: dict[str, int] = {}
        as_camera = found = 0
        for seed in range(max(given.each // 5, 3)):
            changes = watched(600, 3000 + seed, turned=(name, size)).changes
            found += bool(changes)
            as_camera += any(change.camera for change in changes)
            for change in changes[:1]:
                best[change.best.name] = best.get(change.best.name, 0) + 1
        print(
            f"600 stars, {name} {size}: found {found}, named as a camera {as_camera}; best {best}", flush=True
        )

    for depth, radius in SPOTS:
        print(
            f"600 stars, {100 * depth:g} % within {radius:g} deg: {spots(depth, radius, max(given.each // 5, 3))}"
        )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
