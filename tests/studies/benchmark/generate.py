"""Write the scenes of the benchmark as plain files (README.md beside this file says how to read them).

    python tests/studies/benchmark/generate.py FOLDER [--seed 1] [--draws 5] [--nulls 200]     (a minute or two)

A simulated run of WALOP-South is fitted with the base model. What is hidden in a scene is added to the residuals to
first order, with Gaussian noise; fluxes and parameters of the base take up of both what they can. Three angles of
the polariser and 16 points between those of the grid take no part in the fit: there a method says what it expects.

The same seed gives the same bits with the same versions of numpy, scipy and jax on the same kind of processor; the
hashes of seed 1 are in `published.json`, and a folder that differs is refused by `--check`.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
import numpy as np

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
sys.path[:0] = [str(HERE), str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "diagnosis")]

from blind import Blind, outside  # noqa: E402
from new_shapes import new_shapes  # noqa: E402

from walop_jax.data.records import Block, CalibrationSet, Points  # noqa: E402
from walop_jax.data.table_intensities import TableIntensities  # noqa: E402
from walop_jax.diagnosis.design import Measured, strata  # noqa: E402
from walop_jax.diagnosis.examination import Examination, examine  # noqa: E402
from walop_jax.diagnosis.hypotheses import Hypotheses, all_candidates, texts_of  # noqa: E402
from walop_jax.diagnosis.score import ABSORBED, FAINTEST  # noqa: E402
from walop_jax.fit.refit import FitResult  # noqa: E402
from walop_jax.likelihood.columns import Columns  # noqa: E402
from walop_jax.likelihood.flux import project_flux  # noqa: E402
from walop_jax.likelihood.likelihood import Likelihood  # noqa: E402
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn  # noqa: E402
from walop_jax.simulation.simulate import simulate  # noqa: E402

PLAN = ObservingPlan(
    grid=15, standard_grid=3, polariser_angles=polariser_turn(15), moon_patches=6, standards=6
)
ANGLES_KEPT_BACK = (2, 7, 12)  # exposures
FAINT = 1e-3  # of its length, left of a shape behind the base
STEP = 1e-3  # of a standard error: residuals are stored in this unit


def measured_set(seed: int) -> tuple[CalibrationSet, CalibrationSet]:
    """The set that is fitted, and the one with the angles and the points between those of the grid as well."""
    whole = simulate(PLAN, seed=seed).calset
    n, places = PLAN.grid, len(whole.points)
    row, column = (np.arange(n * n) // n, np.arange(n * n) % n)
    grid = np.flatnonzero((row % 2 == 0) & (column % 2 == 0))
    between = np.flatnonzero((row % 4 == 1) & (column % 4 == 1))
    block = whole.intensities.block(0, places)
    order = np.concatenate([grid, between, np.arange(n * n, places)])
    points = Points(np.arange(len(order)), whole.points.x[order], whole.points.y[order])
    used, fitted = block.used[order], block.used[order]
    fitted[:, ANGLES_KEPT_BACK] = False
    fitted[len(grid) : len(grid) + len(between)] = False
    used[len(grid) : len(grid) + len(between), ANGLES_KEPT_BACK] = False

    def with_rows(rows: np.ndarray) -> CalibrationSet:
        some = Block(points.x, points.y, block.counts[order], block.sigma[order], rows, block.source[order])
        return dataclasses.replace(whole, points=points, intensities=TableIntensities.dense(points, some))

    return with_rows(fitted), with_rows(used)


class Layout:
    """The fitted set laid out in rows, and what would be seen in the rows that were kept back."""

    def __init__(self, seed: int) -> None:
        fitted, whole = measured_set(seed)
        self.columns: dict[str, np.ndarray] = {}  # of effects and sentences in all rows, by candidate

        def examined(result: FitResult, hypotheses: Hypotheses, rng: np.random.Generator) -> Examination:
            """With the columns of all exposures that were taken: the one before may be kept back."""
            columns = Columns(Likelihood.of(whole, result.model), result.values)
            asked = all_candidates(columns, [*hypotheses.names, *hypotheses.descriptions])
            self.columns = {name: one.columns for name, one in asked.items()}
            inside = {
                n: dataclasses.replace(one, columns=one.columns[self.inside]) for n, one in asked.items()
            }
            return examine(result, hypotheses, rng, computed=inside, synonyms_apart=True)

        used = (one.intensities.block(0, len(one.points)).used for one in (fitted, whole))
        inside, every = used
        self.inside = np.repeat(inside[every], whole.cameras)
        self.blind = Blind(fitted, seed, examined)
        self.design = design = self.blind.evidence.design
        values = design.fit.values
        likelihood = Likelihood.of(whole, design.fit.model)
        self.whole = Measured(likelihood, values)
        slope = likelihood.jacobian(values) / design.fit.noise_scale
        self.norm = np.linalg.norm(design.jacobian, axis=0)
        basis, upper = np.linalg.qr(design.jacobian / self.norm)
        self.basis = basis
        # What the base takes up of a row kept back when it takes up `basis` of the others.
        self.beyond = np.linalg.solve(upper.T, (slope[~self.inside] / self.norm).T).T
        self.likelihood = likelihood
        self.exposure_kept_back = np.repeat(np.nonzero(self.whole.used)[1], whole.cameras)[~self.inside]

    def projected(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns of all data rows behind the base: those that were fitted (then priors), those kept back."""
        rows = self.design.stacked([columns[self.inside]])
        along = self.basis.T @ rows
        return rows - self.basis @ along, columns[~self.inside] / self.design.fit.noise_scale - (
            self.beyond @ along
        )

    def noise(self, rng: np.random.Generator) -> np.ndarray:
        """Residuals of a set in which nothing is missing."""
        measured, likelihood = self.design.measured, self.design.fit.likelihood
        data = project_flux(
            rng.standard_normal((int(measured.used.sum()), measured.cameras)), measured.unit_model
        )
        known = np.asarray(likelihood.priors.known, bool)
        rows = np.concatenate([data.ravel(), rng.standard_normal(len(known)) * known])
        return rows - self.basis @ (self.basis.T @ rows)


@dataclasses.dataclass
class Hidden:
    """What a scene hides; `said` are the names and sentences that are right, none where there are none."""

    kind: str
    name: str
    ratio: float
    said: tuple[str, ...]
    without: str
    rows: np.ndarray
    beyond: np.ndarray


def hidden(
    layout: Layout, seed: int, draws: int, nulls: int, ratios: Sequence[float], *, new: bool = False
) -> Iterator[Hidden]:
    """All scenes in a fixed order; each is judged without one entry of the catalogue, that which it hides or any."""
    blind, named, rng = layout.blind, layout.columns, np.random.default_rng([seed, 32])
    blind.rng = np.random.default_rng([seed, 33])
    single = {
        text: column
        for probe in blind.descriptions
        for text, column in zip(texts_of(probe), named[probe.name].T, strict=True)
    }
    nothing = np.zeros(len(layout.design.residual)), np.zeros(int((~layout.inside).sum()))
    for _ in range(nulls):
        yield Hidden("null", "", 0.0, (), str(rng.choice(blind.visible)), *nothing)
    for name, said, column in _shapes(layout, single, seed, new=new):
        rows, beyond = (part[:, 0] for part in layout.projected(column[:, None]))
        if np.linalg.norm(rows) < FAINT * np.linalg.norm(column):  # the base takes it up
            continue
        for ratio in ratios:
            for _ in range(draws):
                size = rng.choice([-1.0, 1.0]) * ratio / np.linalg.norm(rows)
                without = str(rng.choice(blind.visible))
                yield Hidden("outside", name, ratio, said, without, size * rows, size * beyond)
    for name in blind.visible:
        for ratio in ratios:
            drawn = blind.hidden(name, ratio, (name,), "removed")
            if drawn is None:
                continue
            rows, beyond = layout.projected(-named[drawn.probe] @ drawn.amplitudes[:, None])
            size = ratio / np.linalg.norm(rows)
            said = tuple(sorted(blind.as_descriptions[drawn.probe]))
            yield Hidden("left out", name, ratio, said, name, size * rows[:, 0], size * beyond[:, 0])


def _shapes(
    layout: Layout, single: dict[str, np.ndarray], seed: int, *, new: bool
) -> Iterator[tuple[str, tuple[str, ...], np.ndarray]]:
    """Shapes outside the catalogue: name, descriptions that it is, change of the data rows."""
    if new:
        yield from new_shapes(layout.whole, single, seed)
        return
    for name, column in outside(layout.whole, single):
        yield name, tuple(sorted(layout.blind.as_descriptions[name])), column


def grammar(layout: Layout) -> dict[str, np.ndarray]:
    """The columns of everything that can be said, behind the base, candidate by candidate."""
    measured, blind, named = layout.whole, layout.blind, layout.columns
    groups = [(p.name, p.effect.name, named[p.name], p.widths, "effect") for p in blind.probes]
    groups += [(p.name, "", named[p.name], p.widths, "sentence") for p in blind.descriptions]
    for stratum in strata(measured):
        pattern = measured.candidate(stratum)
        groups.append((pattern.name, "", pattern.columns, pattern.widths, "pattern"))
    whole = np.concatenate([columns for _, _, columns, _, _ in groups], axis=1)
    rows, beyond = layout.projected(whole)
    before, widths = np.sum(whole[layout.inside] ** 2, axis=0), np.concatenate([g[3] for g in groups])
    after = np.sum(rows**2, axis=0)
    return {
        "columns": rows.astype(np.float32),
        "columns_kept_back": beyond.astype(np.float32),
        "group": np.repeat(np.arange(len(groups)), [len(g[3]) for g in groups]),
        "widths": widths,
        "alive": (after > ABSORBED * before) & (np.sqrt(after) * widths > FAINTEST),
        "names": np.array([g[0] for g in groups]),
        "effects": np.array([g[1] for g in groups]),
        "kinds": np.array([g[4] for g in groups]),
    }


def context(layout: Layout) -> dict[str, np.ndarray]:
    """Where every row was measured, and what fluxes and base took up."""
    measured, e = layout.whole, layout.likelihood.calset.exposures
    points, priors = layout.likelihood.calset.points, len(layout.design.residual) - layout.design.rows
    point, exposure = (np.repeat(at, measured.cameras) for at in np.nonzero(measured.used))
    camera = np.tile(np.arange(measured.cameras), int(measured.used.sum()))
    found = {"x": points.x, "y": points.y, "clp_in": e.clp_in, "mjd": e.mjd, "temp": e.temp}
    found |= {"clp_angle": e.clp_angle, "kind": e.kind.astype(str)}
    for name, value in {"point": point, "exposure": exposure, "camera": camera}.items():
        found[name] = np.append(value[layout.inside], np.full(priors, -1))
        found[f"{name}_kept_back"] = value[~layout.inside]
    light = (measured.flux[..., None] * measured.level[:, None, :] * measured.weight)[measured.used].ravel()
    found["unpolarised_over_error"] = light[layout.inside]
    found["unpolarised_over_error_kept_back"] = light[~layout.inside]
    beyond = ~layout.inside.reshape(-1, measured.cameras)[:, 0]
    found["flux_direction_kept_back"] = measured.unit_model[beyond]
    found["flux_direction"] = layout.design.measured.unit_model
    found["prior_is_known"] = np.asarray(layout.design.fit.likelihood.priors.known, bool)
    return found | {"base": layout.basis, "base_kept_back": layout.beyond}


def stored(residual: np.ndarray) -> np.ndarray:
    """Residuals as they are written: whole numbers of `STEP`."""
    steps = np.round(residual / STEP)
    if np.abs(steps).max() > np.iinfo(np.int16).max:
        raise ValueError(
            f"a residual of {np.abs(residual).max():.1f} standard errors is too large to be written"
        )
    return steps.astype(np.int16)


def generate(
    folder: Path, seed: int, draws: int, nulls: int, ratios: Sequence[float], *, new: bool = False
) -> dict[str, str]:
    """Write all files; returns their hashes."""
    folder.mkdir(parents=True, exist_ok=True)
    layout = Layout(seed)
    noise = np.random.default_rng([seed, 34])
    scenes = list(hidden(layout, seed, draws, nulls, ratios, new=new))
    order = np.random.default_rng([seed, 35]).permutation(len(scenes))
    scenes = [scenes[i] for i in order]
    residuals = np.stack([stored(one.rows + layout.noise(noise)) for one in scenes])
    np.savez(folder / "context.npz", **context(layout))  # pyright: ignore[reportArgumentType]
    np.savez(folder / "grammar.npz", **grammar(layout))  # pyright: ignore[reportArgumentType]
    np.savez(folder / "scenes.npz", residuals=residuals, without=np.array([one.without for one in scenes]))
    labels = [{"kind": s.kind, "name": s.name, "ratio": s.ratio, "said": s.said} for s in scenes]
    np.savez(
        folder / "truth.npz",
        labels=np.array(json.dumps(labels)),
        signature=np.stack([one.rows for one in scenes]).astype(np.float32),
        kept_back=np.stack([one.beyond for one in scenes]).astype(np.float32),
        between=~np.isin(layout.exposure_kept_back, ANGLES_KEPT_BACK),
    )
    hashes = {
        f"{name}.npz": hashlib.sha256((folder / f"{name}.npz").read_bytes()).hexdigest()
        for name in ("context", "grammar", "scenes", "truth")
    }
    (folder / "SHA256SUMS").write_text("".join(f"{h}  {name}\n" for name, h in hashes.items()))
    return hashes


def main() -> None:
    """Write the benchmark, and compare it with the published one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--nulls", type=int, default=200)
    parser.add_argument("--ratios", type=float, nargs="+", default=(10.0, 30.0), help="signal to noise")
    parser.add_argument("--new", action="store_true", help="shapes that are in no published scene")
    parser.add_argument("--check", action="store_true", help="fail unless the hashes are the published ones")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    hashes = generate(
        options.folder, options.seed, options.draws, options.nulls, options.ratios, new=options.new
    )
    print(json.dumps(hashes, indent=1))
    if options.check and hashes != json.loads((HERE / "published.json").read_text())["sha256"]:
        raise SystemExit("these are not the published files: other options, versions or processor")


if __name__ == "__main__":
    main()
