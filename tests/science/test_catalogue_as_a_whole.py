"""What all stars of a catalogue say together, and what structure and hidden mistakes add to their errors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from astropy.table import Table
from star_tables import SOUTH, read, setting, stars

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.data.user_tables import in_memory
from walop_jax.fit.verdict import Hidden, Quality, Structure, UndetectedError, Verdict
from walop_jax.science.apply import apply
from walop_jax.science.catalogue import read_catalogue
from walop_jax.science.catalogue_doubts import units_of_counts
from walop_jax.science.star_columns import PossibleChange
from walop_jax.science.star_light import LeftOverSky
from walop_jax.science.star_residuals import StarResiduals
from walop_jax.science.star_search import scored
from walop_jax.science.star_words import NOTHING_TO_SPARE, FoundChange
from walop_jax.science.stokes_columns import about_cameras

pytestmark = pytest.mark.usefixtures("tabulated_once")


def noisy(vectors, tmp_path, seed=5, count=600, **options):
    return stars(vectors, count, np.random.default_rng(seed), teff=5500.0, **options)


def pulls(found, qu):
    """Root mean square of q and u off, in stated errors."""
    return np.sqrt(np.mean((found.qu - qu) ** 2 / np.einsum("sii->si", found.covariance), axis=0))


def test_a_column_alone_beside_others_has_the_size_of_its_normal_equations():
    """By hand. Of 5x + 2z = 7, 2x + 4z = −6: 4x = 10. Beside y as well, of Q = [5 2 1; 2 4 0; 1 0 2], g = [7 −6 3]:
    x (5 − 1 − ½) = 7 + 3 − 3/2."""
    x, y = PossibleChange("O1", True), PossibleChange("E1", True)
    (alone,) = scored([x], np.array([[5.0, 2.0], [2.0, 4.0]]), np.array([7.0, -6.0]))
    assert (alone.size, alone.error, alone.sigma) == pytest.approx((2.5, 0.5, 5.0))
    matrix = np.array([[5.0, 1.0, 2.0], [1.0, 2.0, 0.0], [2.0, 0.0, 4.0]])  # of x, y, z
    both = scored([x, y], matrix, np.array([7.0, 3.0, -6.0]))
    assert [change.size for change in both] == pytest.approx([2.5, 1.5])
    assert [change.error for change in both] == pytest.approx([4.0**-0.5, 2.0**-0.5])
    beside = scored([x, y], matrix, np.array([7.0, 3.0, -6.0]), beside=[1])
    assert (beside[0].size, beside[0].error) == pytest.approx((8.5 / 3.5, 3.5**-0.5))
    assert beside[1] == y
    # What others describe as well has no size.
    (nothing,) = scored([x], np.array([[1.0, 2.0], [2.0, 4.0]]), np.array([1.0, 2.0]))
    assert nothing == x


def test_a_gain_moves_q_by_half_of_itself():
    """An unpolarised star behind ideal analysers: q = (N₀ − N₁)/(N₀ + N₁), so that one camera brighter by β is β/2."""
    root = np.full((1, 4), 1e3**-0.5)  # 1000 electrons a camera
    ends = np.array([[[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]]]) * 1e3 * root[:, None]
    zero, none = np.zeros(1), np.zeros((1, 4, 0))
    star = StarResiduals(
        np.zeros(1, int), 0.0 * root, 1e3 * root, ends, np.eye(2)[None] / 2e3, root, zero, zero, zero, none,
        np.zeros((1, 4, 4)), np.ones((1, 1)), np.zeros((1, 4, 2)),
    )  # fmt: skip
    for camera, moved in enumerate(([0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5])):
        change = 1e3 * root * (np.arange(4) == camera)
        np.testing.assert_allclose(star.shift(change), [moved], atol=1e-12)
    np.testing.assert_allclose(star.shift(1e3 * root), 0.0, atol=1e-12)  # all cameras are flux


def test_reasons_are_ranked_by_what_they_do_to_q_and_u():
    """Sizes typed by hand, found in another order: 2 %, sky of half the light of which 1 % is left, 3⁰·⁵ of 0.1 %."""
    changes = [
        PossibleChange(name, True, size=size, error=1e-4) for name, size in (("O1", 1e-3), ("E2", 0.04))
    ]
    found = dataclasses.replace(
        NOTHING_TO_SPARE,
        changes=tuple(FoundChange(c, (c,), off=0.5 * c.size) for c in changes),
        noise=4.0,
        noise_p=0.0,
        asked=20,
        photons=1e-3,
        sky=LeftOverSky(np.array([0.01, 0.0]), np.array([1e-4, 1e-4]), 500, 0.5),
    )
    reasons = Verdict().with_doubts(found.against).reasons
    words = ("E2 brighter by 4", "light of the sky", "N_ERR is 2 times too small", "O1 brighter by 0.1")
    assert [word in reason.sentence for word, reason in zip(words, reasons, strict=True)] == [True] * 4
    assert [reason.off for reason in reasons] == pytest.approx([0.02, 0.005, 3**0.5 * 1e-3, 5e-4])
    assert len({reason.cure for reason in reasons}) == 3  # one for each kind
    wide = dataclasses.replace(
        found, changes=tuple(FoundChange(c, (c,)) for c in [changes[0]._replace(size=0.3)])
    )
    first, *others = Verdict().with_doubts(wide.against).reasons
    assert first.off is None  # may do anything
    assert "contradict the calibration by more than an instrument changes" in first.sentence
    assert len(others) == 2
    large = dataclasses.replace(NOTHING_TO_SPARE, noise=1 / 9, noise_p=0.0, asked=20, photons=1e-3)
    (reason,) = large.against
    assert reason.off == 0.0  # q and u are right, their errors are not
    assert "q, u off" not in reason.words


@pytest.mark.parametrize(("factor", "words"), [(0.1, "times too small"), (5.0, "times too large")])
def test_errors_that_are_not_those_of_the_counts_are_said_and_mended(
    vectors, calibration, tmp_path, factor, words
):
    table, qu = noisy(vectors, tmp_path)
    table["N_ERR"] *= factor
    found = apply(calibration, read(table, tmp_path))
    assert any(
        f"N_ERR is {1 / factor if factor < 1 else factor:.2g}"[:8] in w and words in w
        for w in found.check.warnings()
    )
    np.testing.assert_allclose(pulls(found, qu), 1.0, atol=0.12)
    assert np.all(found.flag & Quality.CATALOGUE)


def test_quiet_catalogues_say_nothing(vectors, calibration, tmp_path):
    """Noise alone, bright stars with the error of the calibration, stars without TEFF, and thirty variable ones."""
    table, _ = noisy(vectors, tmp_path)
    quiet = apply(calibration, read(table, tmp_path))
    assert quiet.check.holds
    assert not np.any(quiet.flag & Quality.CATALOGUE)
    assert 2e-4 < quiet.check.smallest < 2e-3
    table["N"][:30, 0] *= 1.0 + 0.2 * np.random.default_rng(1).standard_normal(30)
    assert apply(calibration, read(table, tmp_path)).check.holds
    del table["TEFF"]
    assert apply(calibration, read(table, tmp_path)).check.holds
    values = calibration.values + np.linalg.cholesky(
        calibration.covariance + 1e-24 * np.eye(len(calibration.values))
    ) @ np.random.default_rng(3).standard_normal(len(calibration.values))
    truth = AnalysisVectors(dataclasses.replace(calibration, values=values))
    bright, _ = stars(truth, 400, np.random.default_rng(2), flux=4e8, plate=(None, 22.5))
    assert apply(calibration, read(bright, tmp_path)).check.holds


@pytest.mark.parametrize("camera", range(4))
@pytest.mark.parametrize("gain", [0.01, 0.003])
def test_a_camera_that_has_become_brighter_is_said(vectors, calibration, tmp_path, camera, gain):
    """With its size, among the cameras that such rows cannot tell apart; errors hold what it does to q and u."""
    table, qu = noisy(vectors, tmp_path, seed=camera)
    table["N"][:, camera] *= 1.0 + gain
    found = apply(calibration, read(table, tmp_path))
    (change,) = found.check.changes
    named = {entry.name: entry for entry in change.alike if entry.kind == "gain"}
    mine = named[vectors.instrument.cameras.names[camera]]
    assert mine.size == pytest.approx(gain, abs=4 * mine.error)
    assert np.all(pulls(found, qu) < 1.3)
    # Before, every q or u was off by nine (three) stated errors.
    assert np.any(pulls(dataclasses.replace(found, changed=0.0 * found.changed), qu) > 1.5)


@pytest.mark.parametrize(
    ("order", "words"),
    [((0, 1, 2, 3), "N of E1 were 1000 times as large"), ((2, 1, 0, 3), "in the order O2, E1, O1, E2")],
)
def test_counts_that_are_none_of_the_instrument_are_no_change_of_it(
    vectors, calibration, tmp_path, order, words
):
    """A camera in another unit, or two exchanged: that is said, and no size of a change, however well it fits."""
    flux = 10 ** np.random.default_rng(1).uniform(5.0, 7.0, (200, 1))
    table, _ = noisy(vectors, tmp_path, count=200, flux=flux)
    scale = np.array([1.0, 1e-3, 1.0, 1.0]) if order == (0, 1, 2, 3) else np.ones(4)
    for name in ("N", "N_ERR"):
        table[name] = table[name][:, list(order)] * scale
    (text,) = apply(calibration, read(table, tmp_path)).check.warnings()
    assert words in text
    assert "changed since the calibration" not in text


def test_counts_with_errors_that_no_photons_have_and_unused_cameras_are_remarked_on():
    counts = np.full((50, 4), 12.0)
    (sentence,) = units_of_counts(counts, np.full((50, 4), 0.01))
    assert "N_ERR is 3.5e+02 times smaller than the noise of photons" in sentence
    counts = np.full((50, 4), 1e5)
    assert list(units_of_counts(counts, counts**0.5 / 5)) == []  # mean of 25
    counts[:40, 1] = np.nan
    (sentence,) = about_cameras(counts, ("O1", "E1", "O2", "E2"))
    assert "E1 is used in 10 of 50 rows" in sentence


def test_two_settings_of_the_plate_name_the_camera(vectors, calibration, tmp_path):
    """And what it does to q and u is what these differ by from those without it."""
    table, _ = noisy(vectors, tmp_path, plate=(None, 22.5))
    sound = apply(calibration, read(table, tmp_path))
    table["N"][:, 1] *= 1.02
    found = apply(calibration, read(table, tmp_path))
    (change,) = found.check.changes
    moved = np.median(np.abs(found.qu - sound.qu).max(axis=1))
    assert change.off == pytest.approx(moved, rel=0.05)
    assert {entry.name for entry in change.alike} == {"E1"}
    assert "E1 brighter by 2.0" in change.words() or "E1 brighter by 1.9" in change.words()


def test_a_camera_by_a_smaller_aperture_is_told_once(vectors, calibration, tmp_path):
    """E2 fainter by 5 %: the sums of the arms and the q and u of the stars say it, each in its own way."""
    table, _ = noisy(vectors, tmp_path, count=1500)
    table["N"][:, 3] *= 0.95
    check = apply(calibration, read(table, tmp_path)).check
    (change,) = check.changes
    gains = {entry.name: entry for entry in change.alike if entry.kind == "gain"}
    assert gains["E2"].size == pytest.approx(-0.05, abs=0.004)  # first order
    assert not check.unbalanced
    (sentence,) = check.warnings()
    assert "E2 fainter by 5" in sentence
    # An exchange of light inside the arm leaves its sum: q and u alone say that.
    table, _ = noisy(vectors, tmp_path, count=1500)
    table["N"] = table["N"] * np.array([1.0, 1.0, 1.01, 0.99])
    (found,) = [c for c in apply(calibration, read(table, tmp_path)).check.unbalanced if c.cameras[0] == "O2"]
    assert found.size == pytest.approx(0.02, abs=4.0 * found.error)


def test_rows_that_are_there_four_times_are_said(vectors, calibration, tmp_path):
    """Extracted four times from one exposure, they share its noise; copies to the last digit count once."""
    table, qu = noisy(vectors, tmp_path)
    fourfold = Table({name: np.concatenate([table[name]] * 4) for name in table.colnames})
    copied = apply(calibration, read(fourfold, tmp_path))
    assert copied.check.holds
    np.testing.assert_allclose(
        copied.covariance, apply(calibration, read(table, tmp_path)).covariance, rtol=1e-9
    )
    assert np.all(copied.rows == 1)
    fourfold["N"] *= 1.0 + 1e-6 * np.random.default_rng(0).standard_normal(fourfold["N"].shape)
    found = apply(calibration, read(fourfold, tmp_path))
    (sentence,) = found.check.warnings()
    assert "the rows of a star agree more than independent rows do" in sentence
    np.testing.assert_allclose(pulls(found, qu), 1.0, atol=0.15)


def test_what_grows_with_time_along_the_field_or_with_light(vectors, calibration, tmp_path):
    table, _ = noisy(vectors, tmp_path, count=2000)
    time = np.random.default_rng(0).uniform(60000.0, 60010.0, len(table))
    clean = table["N"].copy()
    table["MJD"] = time
    for kind, factor in (
        ("time", 0.004 * (time - 60005.0) / 5.0),
        ("x", 0.004 * table["X"] / 0.28),
        ("flux", 0.006 * clean[:, 2] / 1e6),
    ):
        table["N"] = clean
        table["N"][:, 2] *= 1.0 + np.asarray(factor)
        (change,) = apply(calibration, read(table, tmp_path)).check.changes
        assert kind in {entry.kind for entry in change.alike}
    table["N"] = clean
    table["N"][:, 2] += 5000.0
    (change,) = apply(calibration, read(table, tmp_path)).check.changes
    assert "light" in {entry.kind for entry in change.alike}


def test_structure_and_hidden_mistakes_of_the_calibration_reach_the_stars(vectors, calibration, tmp_path):
    """Gains of field points, 2·10⁻³ in every camera: pulls of unit width. What could hide is what it does to a star."""
    rng = np.random.default_rng(4)
    table, qu = stars(vectors, 600, plate=(None, 22.5), flux=4e9)
    gains = np.tile(1.0 + 2e-3 * rng.standard_normal((600, 4)), (2, 1))
    table["N"] = np.asarray(table["N"]) * gains
    verdict = dataclasses.replace(calibration.verdict, structure=Structure(gain=2e-3))
    change = np.zeros((2, len(calibration.values)))
    index = calibration.model.index("half2.efficiency")
    change[1, index] = 1e-3
    hidden = Hidden(tuple(UndetectedError(name, 1.0, "") for name in ("nothing", "efficiency")), change)
    known = dataclasses.replace(calibration, verdict=verdict, hidden=hidden)
    found = apply(known, read(table, tmp_path))
    assert found.check.holds
    pull = (found.qu - qu) / np.sqrt(np.einsum("sii->si", found.covariance))
    assert np.mean(np.abs(pull) < 1.0) == pytest.approx(0.683, abs=0.04)
    assert np.mean(np.abs(pull) < 1.96) == pytest.approx(0.954, abs=0.02)
    values = calibration.values.copy()
    values[index] += 1e-3
    clean, _ = stars(vectors, 30)
    other = apply(dataclasses.replace(calibration, values=values), read(clean, tmp_path))
    plain = apply(known, read(clean, tmp_path))
    np.testing.assert_allclose(plain.hidden, np.abs(other.qu - plain.qu), rtol=0.02, atol=1e-6)
    assert np.isnan(apply(calibration, read(clean, tmp_path)).hidden).all()


@pytest.mark.parametrize("rotator", [(0.0, 90.0), (0.0, 0.0)])
def test_structure_is_another_at_another_place(vectors, calibration, rotator):
    """Gains of 2·10⁻³, drawn anew at the second place: turned by 90° q and u do not lose them, as at one place."""
    rng = np.random.default_rng(6)
    x, y = rng.uniform(-0.2, 0.2, (2, 1000))
    qu, rows = rng.normal(0.0, 0.01, (1000, 2)), []
    for k, angle in enumerate(rotator):
        cos, sin = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
        here = cos * x + sin * y + (0.05 if k and not angle else 0.0), cos * y - sin * x
        seen = qu @ [1, 1j] * np.exp(-2j * np.deg2rad(angle))
        s = np.stack([np.ones(1000), seen.real, seen.imag], axis=1)
        n = 4e6 * np.einsum("pks,ps->pk", vectors.exact(setting(), *here)[:, 0], s)
        n *= 1.0 + 2e-3 * rng.standard_normal(n.shape)
        columns = {"ID": np.arange(1000), "X": here[0], "Y": here[1], "ROTATOR": np.full(1000, angle)}
        rows.append(
            Table(columns | {"N": n + np.sqrt(n) * rng.standard_normal(n.shape), "N_ERR": np.sqrt(n)})
        )
    verdict = dataclasses.replace(calibration.verdict, structure=Structure(gain=2e-3))
    certain = np.zeros_like(calibration.covariance)  # what all stars have in common is no scatter
    known = dataclasses.replace(calibration, verdict=verdict, covariance=certain)
    table = Table({name: np.concatenate([r[name] for r in rows]) for name in rows[0].colnames})
    found = apply(known, read_catalogue(in_memory(table), SOUTH))
    np.testing.assert_allclose(pulls(found, qu), 1.0, atol=0.1)
    assert found.check.noise == pytest.approx(1.0, abs=0.1)
    assert found.check.holds


@pytest.mark.parametrize("seed", [1, 2])
def test_bright_stars_under_a_poor_calibration_say_nothing_of_their_errors(calibration, tmp_path, seed):
    """The true instrument lies within the errors of the calibration, far enough for their second order to show."""
    poor = dataclasses.replace(calibration, covariance=9.0**2 * calibration.covariance)
    root = np.linalg.cholesky(poor.covariance + 1e-24 * np.eye(len(poor.values)))
    values = poor.values + root @ np.random.default_rng(seed).standard_normal(len(poor.values))
    truth = AnalysisVectors(dataclasses.replace(poor, values=values))
    bright, qu = stars(truth, 400, np.random.default_rng(2), flux=4e8, teff=5500.0)
    found = apply(poor, read(bright, tmp_path))
    assert found.check.holds, found.check.warnings()
    assert np.all(pulls(found, qu) < 1.6)
    bright["N_ERR"] *= 0.2
    assert any("N_ERR is" in text for text in apply(poor, read(bright, tmp_path)).check.warnings())
