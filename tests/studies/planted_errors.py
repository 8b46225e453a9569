"""Errors planted one at a time, to see whether the tests of the room notice.

    python tests/studies/planted_errors.py [--only WORD] [--cache FOLDER]

Each error is a line of the package and what it is replaced by: a sign, a factor, an index, a bound. The tree is copied
to a temporary folder, the error planted there, those tests named beside it that belong to the fast suite are run until
the first fails, and the line is put back. Printed are the errors that were caught and those that were missed; the exit
status is 1 if any was missed.
`test_planted_errors.py` sees to it that every line is still there.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("walop_jax", "tests", "fits_data", "pyproject.toml", "README.md", "CITATION.cff", "LICENSE")


class Planted(NamedTuple):
    """A file of the package, a text that occurs in it once, what replaces it, and the tests that should fail."""

    file: str
    old: str
    new: str
    tests: tuple[str, ...]


def planted(file: str, old: str, new: str, *tests: str) -> Planted:
    return Planted(file, old, new, tests)


_LIKELIHOOD = ("likelihood/test_engine.py", "likelihood/test_flux.py", "likelihood/test_priors.py")
_REPEATS, _CHAINS = "data/test_repeats.py", "posterior/test_chains.py"
ERRORS = (
    # io
    planted("io/text.py", "places = 1 - math.floor", "places = 2 - math.floor", "io/test_rounding.py"),
    planted("io/fits_reading.py", "_MOST = 999", "_MOST = 9999", "data/test_hostile_headers.py"),
    # data
    planted("data/repeats.py", "2 * np.bincount(row, again) > ", "4 * np.bincount(row, again) > ", _REPEATS),
    planted("data/repeats.py", "[block.x[at], block.y[at], *block", "[block.x[at], *block", _REPEATS),
    planted("data/checks.py", "refuse(np.abs(table[name]) > limit, f", "refuse(table[name] > limit, f",
            "data/test_bad_inputs.py"),
    planted("data/table_intensities.py", "isfinite(sigma) & (sigma <= 0)", "isfinite(sigma) & (sigma < 0)",
            "data/test_bad_input_table.py"),
    planted("data/table_intensities.py", "SPOILT = 0.2", "SPOILT = 0.5", "data/test_bad_input_table.py"),
    planted("data/table_intensities.py", "counts >= -NEGATIVE * sigma", "counts >= NEGATIVE * sigma",
            "data/test_bad_input_table.py"),
    planted("data/inspection.py", "sigma**2 / np.where(single, counts, 1.0)",
            "sigma / np.where(single, counts, 1.0)", "commands/test_commands.py"),
    # sky
    planted("sky/position_angles.py", "u * cos_2r - q * sin_2r", "u * cos_2r + q * sin_2r", "sky/test_moon.py"),
    planted("sky/moon.py", "weight = 1.0 / (1.0 + cos_gamma**2)", "weight = 1.0 / (1.0 - cos_gamma**2)",
            "sky/test_moon.py"),
    planted("sky/moon.py", "a = v_n - k_n / (1.0 + k_c) * v_c", "a = v_n + k_n / (1.0 + k_c) * v_c",
            "sky/test_moon.py"),
    planted("sky/moon.py", "x * cos_r - y * sin_r, x * sin_r + y * cos_r",
            "x * cos_r + y * sin_r, y * cos_r - x * sin_r", "sky/test_moon.py"),
    # model
    planted("model/mueller.py", "(zeros, c2 * s2 * (1 - cd), c2**2 * cd + s2**2, c2 * sd)",
            "(zeros, c2 * s2 * (1 - cd), c2**2 * cd + s2**2, -c2 * sd)", "model/test_mueller.py"),
    planted("model/mueller.py", "(zeros, -s2, c2, zeros),",
            "(zeros, s2, c2, zeros),", "model/test_mueller.py"),
    planted("model/mueller.py", "k, ones = 1.0 / (1.0 + root)", "k, ones = 1.0 / (2.0 + root)",
            "model/test_mueller.py"),
    planted("model/materials.py", "1.07044083", "1.07044038", "model/test_materials.py"),
    planted("model/materials.py", "QUARTZ_THERMAL = 1.23e-4", "QUARTZ_THERMAL = -1.23e-4",
            "model/test_materials.py", "model/test_optics.py", "model/effects/test_effects_of_plates.py"),
    planted("model/elements/simple.py", "self.diattenuation * 2.0 * ray.x", "self.diattenuation * ray.x",
            "model/test_field_diattenuator.py", "model/test_light.py", "oracle/test_oracle.py"),
    planted("model/mueller.py", "c * q * u + s * v, c * q * v - s * u", "c * q * u + s * v, c * q * v + s * u",
            "model/test_physical.py", "model/effects/test_effects_of_light.py"),
    planted("model/elements/simple.py", "jnp.stack([half, extra - along])", "jnp.stack([half, extra + along])",
            "model/test_light.py"),
    planted("model/elements/simple.py", "jnp.stack([kappa, -kappa])", "jnp.stack([kappa, kappa])",
            "model/test_spectral_element.py", "model/test_light.py", "model/effects/test_effects_of_plates.py"),
    planted("model/elements/wave_plate.py",
            "matrix = matrix @ mueller.diattenuator(d * jnp.cos(2.0 * axis), d * jnp.sin(2.0 * axis))",
            "matrix = mueller.diattenuator(d * jnp.cos(2.0 * axis), d * jnp.sin(2.0 * axis)) @ matrix",
            "model/effects/test_effects_of_plates.py"),
    planted("model/light_path.py", "else np.mod(readings, period)", "else readings", "model/test_readings.py"),
    planted("calibration/analysis_vectors.py", "patched.within_period(prefix, reading)", "reading",
            "model/test_readings.py"),
    planted("model/elements/base.py", 'own.get("period")', 'own.get("period", 360.0)', "model/test_readings.py"),
    planted("model/effects/factors.py", "(int(order) * angle)", "(2 * int(order) * angle)",
            "model/effects/test_effects_of_light.py"),
    planted("model/effects/optics.py", "else (x, y + by)", "else (x + by, y)",
            "model/effects/test_effects_of_light.py", "model/effects/test_effects_of_plates.py"),
    planted("model/elements/geometry.py", "mueller.rotation(-wedge", "mueller.rotation(wedge",
            "model/test_oblique.py"),
    planted("model/cameras.py", "partners[a], partners[b] = b, a", "partners[a], partners[b] = a, b",
            "model/effects/test_effects_of_cameras.py"),
    planted("model/effects/cameras.py", "lambda counts, _: counts**2 / REFERENCE_COUNTS",
            "lambda counts, _: -(counts**2) / REFERENCE_COUNTS", "model/effects/test_effects_of_cameras.py"),
    planted("model/effects/cameras.py", "lambda _, exposures: exposures.median", "lambda counts, _: counts",
            "model/effects/test_effects_of_cameras.py"),
    planted("model/effects/catalogue.toml", "per_unit = [1.0, -1.0]", "per_unit = [1.0, 1.0]",
            "model/effects/test_effects_of_light.py"),
    planted("model/effects/blemish.py", "(2.0 * spot.size**2)", "spot.size**2",
            "model/effects/test_effects_of_cameras.py"),
    planted("model/effects/cameras.py", "jnp.asarray(pattern, float)[..., None]",
            "jnp.asarray(pattern, float)[..., None] / 24.0", "model/effects/test_effects_of_cameras.py"),
    planted("model/effects/cameras.py", "else change.factor(AtPoint(x, y))", "else change.factor(AtPoint(y, x))",
            "model/effects/test_effects_of_cameras.py"),
    # likelihood, covariance, degrees of freedom, engine
    planted("likelihood/flux.py", "return flux, weighted_counts - flux * weighted_model",
            "return flux, weighted_counts - best * weighted_model", *_LIKELIHOOD),
    planted("likelihood/flux.py", "component = shared.summed(columns * along) / xp",
            "component = 0.999 * shared.summed(columns * along) / xp", *_LIKELIHOOD),
    planted("likelihood/engine.py", "jacobian @ r, jacobian @ jacobian.T", "jacobian @ r, 1.01 * jacobian @ jacobian.T",
            "likelihood/test_nodes.py"),
    planted("likelihood/engine.py", "cross = jnp.einsum(\"pimk,pmt->ikt\", by_site, basis)",
            "cross = -jnp.einsum(\"pimk,pmt->ikt\", by_site, basis)", "likelihood/test_nodes.py"),
    planted("likelihood/engine.py", "NEWTON_STEPS = 3", "NEWTON_STEPS = 0",
            "model/effects/test_effects_of_cameras.py"),
    planted("likelihood/likelihood.py", "int((self.priors.known & ~of_errors).sum())", "len(self.priors)",
            "likelihood/test_engine.py", "likelihood/test_priors.py"),
    planted("likelihood/likelihood.py", "- round(taken_up)", "- len(self.model.parameters)",
            "likelihood/test_engine.py", "likelihood/test_priors.py"),
    planted("likelihood/likelihood.py", "gradient[rows.index] += pull / rows.width",
            "gradient[rows.index] += pull", "likelihood/test_engine.py"),
    planted("likelihood/likelihood.py", "matrix = terms.matrix / noise_scale**2",
            "matrix = terms.matrix / noise_scale",
            "likelihood/test_engine.py", "likelihood/test_priors.py", "likelihood/test_large.py"),
    # noise
    planted("simulation/simulate.py", "np.maximum(counts, 0.0) + self.read_noise**2",
            "np.maximum(counts, 0.0) + self.read_noise", "simulation/test_noise.py"),
    # fit
    planted("fit/search.py", "start[place] += sign * one_wave",
            "start[place] += one_wave", "fit/test_search.py"),
    planted("fit/robust.py", "count / (count - 1) * gradients.T", "(count - 1) / count * gradients.T",
            "fit/test_robust.py"),
    planted("fit/robust.py", "spread = root @ axis", "spread = root @ axis.T", "fit/test_robust.py"),
    # calibration
    planted("calibration/calibration.py", "0.5 * (result.covariance + result.covariance.T)",
            "0.25 * (result.covariance + result.covariance.T)", "calibration/test_calibration.py"),
    planted("likelihood/field_table.py", "np.concatenate(leaves)[: len(columns[0])]",
            "np.concatenate(leaves)[-len(columns[0]) :]", "calibration/test_calibration.py"),
    planted("calibration/calibration.py", "flags[~(condition <= HIGH_CROSSTALK)]", "flags[condition <= HIGH_CROSSTALK]",
            "calibration/test_calibration.py"),
    # posterior
    planted("posterior/surrogate.py", "(self.scales(z) / (self.scale or 1.0)) ** -2",
            "(self.scales(z) / (self.scale or 1.0)) ** -1", "posterior/test_surrogate.py"),
    planted("posterior/surrogate.py", "self.centre + z[:, : self.along.shape[1]] @ self.along.T + s",
            "self.centre + z[:, : self.along.shape[1]] @ self.along.T - s", "posterior/test_surrogate.py"),
    planted("posterior/surrogate.py", "mean + np.sqrt(variance) * rng", "mean + variance * rng",
            "posterior/test_surrogate.py"),
    planted("posterior/result.py", "steps <= LENGTHS * history[2]", "steps <= history[2]", _CHAINS),
    planted("posterior/result.py", "if not np.max(rhat) < LARGEST_RHAT", "if np.max(rhat) < 0", _CHAINS),
    planted("posterior/result.py", "if not max(changes) < STABLE", "if max(changes) < 0", _CHAINS),
    # nights
    planted("nights/algebra.py", "border - gain @ done[-1].left", "border + gain @ done[-1].left",
            "nights/test_algebra.py"),
    # science
    planted("science/estimate.py", "np.where(used, sigma, 1.0) ** 2", "np.where(used, sigma, 1.0)",
            "science/test_estimate.py"),
    planted("science/estimate.py", "- used.any(axis=1), first) - 2", "- used.any(axis=1), first)",
            "science/test_estimate.py"),
    planted("science/estimate.py", "return -np.add.reduceat(gain @ change, first)",
            "return np.add.reduceat(gain @ change, first)", "science/test_estimate.py"),
    planted("science/star_search.py", "size=float(slope * error**2)", "size=float(-slope * error**2)",
            "science/test_catalogue_as_a_whole.py"),
    planted("science/polarisation.py", "sin**2 * qq - 2.0 * cos * sin * qu_", "sin**2 * qq + 2.0 * cos * sin * qu_",
            "science/test_polarisation.py"),
    planted("science/polarisation.py", "np.mod(np.rad2deg(0.5 * np.arctan2(u, q)), 180.0)",
            "np.mod(np.rad2deg(0.5 * np.arctan2(q, u)), 180.0)", "science/test_polarisation.py"),
    # diagnosis
    planted("diagnosis/design.py", "unit = self.model if sort == GAIN else", "unit = self.model if sort == LIGHT else",
            "diagnosis/test_gain_and_light.py"),
    planted("diagnosis/variance_components.py", "((GAIN, grouping.gains), (LIGHT, ", "((GAIN, grouping.gains), (GAIN, ",
            "diagnosis/test_variance_components.py"),
    planted("diagnosis/refits.py", "0.5 * (squares[0] - squares[1])", "0.5 * (squares[1] - squares[0])",
            "diagnosis/test_kinds_predict.py"),
    planted("diagnosis/score.py", "amplitudes=-w @ z", "amplitudes=w @ z", "diagnosis/test_score.py"),
    planted("diagnosis/score.py", "jacobian.shape[0] - jacobian.shape[1] - eliminated",
            "jacobian.shape[0] - jacobian.shape[1]", "diagnosis/test_score.py"),
    planted("diagnosis/score.py", "- np.log1p(value)", "+ np.log1p(value)", "diagnosis/test_score.py"),
    planted("diagnosis/score.py", "t * s[..., None, :] ** 2", "s[..., None, :] ** 2", "diagnosis/test_score.py"),
    planted("diagnosis/selection.py", "scores = self.scores - along @ taken", "scores = self.scores",
            "diagnosis/test_selection.py"),
    planted("diagnosis/selection.py", "(self._is_named, self._is_effect)", "(self._is_named,)",
            "diagnosis/test_selection.py"),
    planted("diagnosis/selection.py", "mean = -np.einsum", "mean = np.einsum", "diagnosis/test_selection.py"),
    planted("diagnosis/smooth_fields.py", "gram -= along", "gram += along", "diagnosis/test_smooth_fields.py"),
    planted("diagnosis/smooth_fields.py", "(scale * probe.widths) ** -2.0", "probe.widths**-2.0",
            "diagnosis/test_smooth_fields.py"),
    planted("diagnosis/smooth_fields.py", "legendre.basis(points.x, points.y,", "legendre.basis(points.y, points.x,",
            "diagnosis/test_smooth_fields.py"),
    planted("model/effects/factors.py", "+ 0.5) ** 2", "+ 0.5)",
            "diagnosis/test_smooth_fields.py"),
    planted("model/effects/change.py", "math.sqrt(2.0 * degree + 1.0)", "(2.0 * degree + 1.0)",
            "diagnosis/test_smooth_fields.py"),
    planted("diagnosis/search.py", "(trial.evidence - trial.expected)", "(trial.expected - trial.evidence)",
            "diagnosis/test_naming_search.py"),
    planted("diagnosis/search.py", "1.0 / needed - 1.0 / scale**2", "1.0 / scale**2 - 1.0 / scale**2",
            "diagnosis/test_naming_search.py"),
    planted("diagnosis/search.py", "elif names and not thing.is_pattern:", "elif not names and not thing.is_pattern:",
            "diagnosis/test_naming_search.py"),
    planted("diagnosis/refits.py", "folds(before, scheme), _laid_out(before), _laid_out(after)",
            "folds(before, scheme), _laid_out(after), _laid_out(before)", "diagnosis/test_workflow.py"),
    planted("diagnosis/class_members.py", 'if law.form in ("kind", "hours"):', 'if law.form in ("kind",):',
            "diagnosis/test_class_members.py"),
    planted("diagnosis/discrepancy.py", "LEFT_OUT * len(rest)", "LEFT_OUT * np.sum(factor**2) * len(rest)",
            "diagnosis/test_undetected.py"),
    planted("diagnosis/exact.py", "information - np.diag(width**-2.0)", "information", "diagnosis/test_judging.py"),
    planted("diagnosis/trust.py", "2.0 * min(above, 1.0 - above)", "min(above, 1.0)", "diagnosis/test_trust.py"),
    planted("diagnosis/trust.py", "variance = 2.0 * (squared_norms[0]",
            "variance = 4.0 * (squared_norms[0]", "diagnosis/test_trust.py"),
    planted("diagnosis/variance_components.py", "first = trace - np.trace(m)", "first = trace",
            "diagnosis/test_variance_components.py"),
    planted("fit/verdict.py", "return not any(doubt.blocking", "return any(doubt.blocking", "diagnosis/test_trust.py"),
    planted("diagnosis/readings.py", "sign * a + offset", "sign * a - offset", "diagnosis/test_mixups.py"),
    # paper
    planted("paper/polynomial.py", "- self.delta[:, None]", "+ self.delta[:, None]", "paper/test_polynomial.py"),
    planted("paper/polynomial.py", "((self.y, y), (self.x, x))", "((self.y, x), (self.x, y))",
            "paper/test_polynomial.py"),
    # plans
    planted("plans/optimal.py", "return self.here**2 / (self.known", "return self.here**2 / (0.0 * self.known",
            "plans/test_optimal.py"),
    planted("plans/separating.py", "= step[len(base) :]", "= 2.0 * step[len(base) :]", "plans/test_separating.py"),
    # commands
    planted("commands/refit.py", "    if result.converged:\n", "    if True:\n",
            "commands/test_refit_run.py"),
)  # fmt: skip


def caught(error: Planted, tree: Path, cache: Path) -> tuple[str | None, float]:
    """The test that failed with the error in the tree, or None; and the time that it took (s)."""
    began, file = time.perf_counter(), tree / "walop_jax" / error.file
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace(error.old, error.new), encoding="utf-8")
    try:
        found = subprocess.run(
            [sys.executable, "-m", "pytest", "-n", "0", "-x", "-q", "--fast", "-o", f"cache_dir={cache}",
             *(f"tests/{name}" for name in error.tests)],
            cwd=tree, capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": str(tree)},
        )  # fmt: skip
    finally:
        file.write_text(text, encoding="utf-8")
    failed = [
        line.split(" - ")[0] for line in found.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))
    ]
    if found.returncode not in (0, 1):
        failed = failed or [f"pytest ended with {found.returncode}"]
    return (failed[0] if failed else None), time.perf_counter() - began


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="errors whose file holds this word")
    parser.add_argument("--cache", type=Path, default=None, help="folder of compiled code")
    options = parser.parse_args()
    chosen = [error for error in ERRORS if options.only in error.file]
    missed = 0
    with tempfile.TemporaryDirectory() as name:
        tree = Path(name)
        for part in COPIED:
            source = ROOT / part
            copy = shutil.copytree if source.is_dir() else shutil.copy2
            copy(source, tree / part)
        for error in chosen:
            found, seconds = caught(error, tree, options.cache or tree / "cache")
            missed += found is None
            print(f"{found or 'MISSED'}  {error.file}: {error.old!r}  ({seconds:.0f} s)", flush=True)
    print(f"{len(chosen)} planted, {len(chosen) - missed} caught, {missed} missed")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
