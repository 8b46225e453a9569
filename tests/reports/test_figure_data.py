"""The arrays behind the figures, from cubes of residuals made by hand; and their file."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from unittest.mock import Mock

import handmade_run
import numpy as np
import pytest
from astropy.io import fits
from builders import exposures

from walop_jax.diagnosis.figure_data import (
    _ladder,
    best_combination,
    compare_residuals,
    read_figure_data,
    write_figure_data,
)
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.io.errors import DataError

ANGLES = 22.5 * np.arange(16)
SEQUENCE = exposures(
    *({"clp_angle": a, "mjd": 61043.0 + 0.01 * i} for i, a in enumerate(ANGLES)),
    *({"kind": "moon", "mjd": 61044.0 + 0.01 * i} for i in range(4)),
)
USED = np.ones((25, 20), bool)
FIELD = np.linspace(-1.0, 1.0, 25)
CAMERAS = np.array([1.0, -1.0, 0.5, 0.0])
FREE = SimpleNamespace(free=True, tie=None, prior=None)


def cube(along: np.ndarray) -> np.ndarray:
    return FIELD[:, None, None] * along[:, None] * CAMERAS


def test_a_harmonic_is_recognised_with_its_phase():
    wave = np.append(np.cos(3 * np.deg2rad(ANGLES) - 1.0), np.zeros(4))
    best = best_combination(cube(wave), USED, SEQUENCE)
    assert (best.harmonic, best.words) == (3, "cos(3 theta - 57 deg), theta the polariser angle")
    # 16 angles over a full turn: the norm of the wave is √8, which is what the combined residual must be.
    np.testing.assert_allclose(best.of(cube(wave), USED), FIELD[:, None] * CAMERAS * np.sqrt(8.0), atol=1e-12)


@pytest.mark.parametrize(
    ("along", "words"),
    [
        (np.append(np.zeros(16), np.ones(4)), "mean of the moon exposures"),
        (SEQUENCE.mjd - SEQUENCE.mjd.mean(), "trend with time"),
        (np.append(np.zeros(16), [1.0, -1.0, 1.0, -1.0]), "the combination of all exposures that shows it best"),
    ],
)  # fmt: skip
def test_other_combinations_are_put_into_words(along, words):
    best = best_combination(cube(along), USED, SEQUENCE)
    assert (best.harmonic, best.words) == (-1, words)


def test_a_pattern_that_changes_sign_over_the_field_does_not_average_out():
    rng = np.random.default_rng(3)
    wave = np.append(np.cos(3 * np.deg2rad(ANGLES)), np.zeros(4))
    noise = rng.standard_normal((25, 20, 4))
    one = compare_residuals("x", 5.0 * cube(wave) + noise, noise, USED, SEQUENCE)
    rms = np.sqrt(np.mean(FIELD**2))
    # Camera by camera the weights have rms 1 and the sign of the pattern: the mean of 5 · FIELD is 5 · rms.
    expected = 5.0 * rms * wave[:, None] * np.abs(CAMERAS[:3])
    np.testing.assert_allclose(np.abs(one.curves["EXPLAINED"][:, :3]), np.abs(expected), atol=1e-9)
    assert np.median(one.curves["ERROR"]) == pytest.approx(1 / 5, rel=0.2)  # 25 points of unit noise
    np.testing.assert_allclose(one.field["RMS_AFTER"], np.sqrt((noise**2).mean(axis=1)))


def test_points_without_the_exposures_are_not_shown():
    used = USED.copy()
    used[3, :16] = False
    wave = np.append(np.cos(2 * np.deg2rad(ANGLES)), np.zeros(4))
    before = np.where(used[..., None], cube(wave), 0.0)
    one = compare_residuals("", before, 0.0 * before, used, SEQUENCE)
    assert np.flatnonzero(np.isnan(one.field["BEFORE"]).any(axis=1)).tolist() == [3]
    assert np.isfinite(one.field["MEAN_BEFORE"]).all()


def test_the_ladder_has_the_degrees_of_freedom_of_every_fit():
    """Those of its fit, not as many as it has parameters without a prior: ghost takes 2, lens 8."""
    steps = [
        SimpleNamespace(effect="ghost", chi2_after=900.0, dof_after=898),
        SimpleNamespace(effect="lens", chi2_after=800.0, dof_after=890),
    ]
    model = SimpleNamespace(effect_names=("ghost", "lens"), positions=lambda name: [0], parameters=[FREE])
    before = SimpleNamespace(chi2=2000.0, dof=900, model=SimpleNamespace(effect_names=()))
    after = SimpleNamespace(chi2=800.0, dof=890, model=model)
    ladder = _ladder(Mock(Diagnosis, before=before, after=after, steps=steps))
    assert list(ladder["MODEL"]) == ["starting model", "ghost", "lens"]
    assert ladder["DOF"].tolist() == [900, 898, 890]


def test_they_come_back_from_their_file(tmp_path):
    made = handmade_run.figure_data(("clp_wobble", "ghost"))
    write_figure_data(tmp_path / "diagnosis.fits", made)
    back = read_figure_data(tmp_path / "diagnosis.fits")

    def same(one, other):
        for field in dataclasses.fields(one):
            a, b = getattr(one, field.name), getattr(other, field.name)
            if dataclasses.is_dataclass(a):
                same(a, b)
            elif isinstance(a, dict):
                for name in a:
                    np.testing.assert_array_equal(a[name], b[name])
            elif isinstance(a, tuple):
                for first, second in zip(a, b, strict=True):
                    same(first, second)
            else:
                np.testing.assert_array_equal(a, b)

    same(made, back)
    with fits.open(tmp_path / "diagnosis.fits") as hdus:
        header = hdus["FIELD"].header
        columns = hdus["FIELD"].columns
        assert columns["X"].unit == "deg"
        assert "standard deviations" in header[f"TCOMM{columns.names.index('BEFORE') + 1}"]


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "other.fits"
    fits.PrimaryHDU().writeto(path)
    with pytest.raises(DataError, match="DIAGVERS: is missing; run walop-jax diagnose again"):
        read_figure_data(path)
    with fits.open(path, mode="update") as hdus:
        hdus[0].header["DIAGVERS"] = 7
    with pytest.raises(DataError, match="is 7, this program reads 1"):
        read_figure_data(path)
    with fits.open(path, mode="update") as hdus:
        hdus[0].header["DIAGVERS"] = 1
    with pytest.raises(DataError, match="cannot be read"):
        read_figure_data(path)
