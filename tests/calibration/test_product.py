"""The calibration product: what is written comes back, and what is not as written is refused."""

from __future__ import annotations

import dataclasses
import shutil

import numpy as np
import pytest
from astropy.io import fits
from calibration_in_words import changed, contents, in_words
from effect_scenes import EVERY_CHANGE, STARS
from handmade_run import parameters
from same_record import assert_same

import walop_jax.calibration.product
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import MatrixMaps
from walop_jax.calibration.product import content_of, read_calibration, write_calibration
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.grid import Grid
from walop_jax.fit.model_file import model_without_data, render
from walop_jax.fit.verdict import Verdict
from walop_jax.io.errors import DataError
from walop_jax.io.text import in_ascii
from walop_jax.model.effects import Context, Described
from walop_jax.model.effects.in_models import with_effects

NAN = float("nan")


@pytest.fixture
def product(handmade) -> Calibration:
    calset = read_calibration_set(handmade.write())
    rng = np.random.default_rng(5)
    root = rng.standard_normal((3, 3)) * 1e-3
    covariance = root @ root.T
    grid = Grid(4, 3, (2.5, 2.0), (0.0, 0.0), ((0.1, 0.0), (0.0, 0.2)))
    three = parameters(
        ("pupil.magnification", "", 15.63, (15.63, 0.05), True),
        ("collimator.q", "deg-2", 0.0, (0.0, 0.0015), True),
        ("throughput.n0.p00", "um", 0.5, None, False),
    )
    maps = MatrixMaps(grid, "SDSS-r", rng.random((6, 3, 4)), rng.random((6, 3, 4)))
    lines = ("[model]", 'instrument = "WALOP-SOUTH"', "# a comment")
    return in_words(
        instrument=calset.instrument,
        parameters=three,
        maps=maps,
        model_lines=lines,
        values=np.array([15.63, 1.0 / 3.0, 0.5]),
        site=calset.site,
        origin=calset.origin,
        date="2026-11-21T10:00:00",
        verdict=Verdict.recorded(
            chi2=1.0 / 3.0 * 1e5,
            dof=33000,
            n_data=44000,
            noise_scale=1.0,
            converged=True,
            trusted=False,
            quality=8192,
            warnings=("chi2/dof = 1.5", "look at it"),
        ),
        covariance=covariance,
        field=(-0.29, 0.29, -1.0 / 3.0, 0.25),
        exposures=calset.exposures,
        filters=calset.filters,
        sources=calset.sources,
        inputs=calset.inputs,
        versions={"python": "3.11.7", "walop-jax": "0.1.0", "speclite": "0.20"},  # of a library long gone
    )


@pytest.fixture
def path(product, tmp_path):
    path = tmp_path / "calibration.fits"
    write_calibration(path, product)
    return path


def test_parameters_of_every_description_come_back(product, tmp_path):
    """Every kind at a place and every factor, as a diagnosis names them: in the product and in its model."""
    effect = Described.saying(EVERY_CHANGE, np.arange(len(EVERY_CHANGE)) / 7e3)
    model = with_effects(model_without_data("WALOP-SOUTH", standards=STARS), [effect], Context())
    names = [name for name in model.names if name.startswith("described.")]
    assert len(set(names)) == len(EVERY_CHANGE)
    n = len(names)
    path, lines = tmp_path / "found.fits", tuple(map(in_ascii, render(model).splitlines()))
    found = changed(
        product,
        parameters=tuple(model[name] for name in names),
        model_lines=lines,
        values=np.arange(n) / 7.0,
        covariance=np.eye(n),
    )
    write_calibration(path, found)
    again = read_calibration(path, any_model=True)
    assert list(again.names) == names
    carried = model_without_data("WALOP-SOUTH", "\n".join(again.model_lines), standards=STARS)
    assert carried.names == model.names
    assert carried.start == pytest.approx(model.start)


def test_a_name_that_could_not_be_read_is_refused(product):
    first, second, third = product.parameters
    named = first, dataclasses.replace(second, name="collimator q"), third
    with pytest.raises(ValueError, match="'collimator q': a name has letters"):
        changed(product, parameters=named)


def assert_equal(one, other):
    """Products are equal, arrays bit for bit, all but the place that one of them was read from."""
    kept = ({**contents(calibration), "path": None} for calibration in (one, other))
    assert_same(*kept, "product")


def test_round_trip_is_exact(product, path):
    back = read_calibration(path, any_model=True)
    assert_equal(product, back)
    assert back.content_hash() == product.content_hash()


def test_is_ordinary_fits(path):
    with fits.open(path, checksum=True) as hdus:
        head = hdus[0].header
        assert (head["PRODVERS"], head["TRUSTED"], head["CONVERGD"], head["QUALITY"]) == (
            1,
            False,
            True,
            8192,
        )
        assert head["SOFT2"] == "walop-jax 0.1.0"
        assert hdus["PARAMETERS"].data["NAME"][1] == "collimator.q"
        image = hdus["M22_ERR"].header
        assert (image["CTYPE1"], image["CUNIT2"], image["CD2_2"]) == ("X", "deg", 0.2)
        assert hdus["WARNINGS"].data["TEXT"].tolist() == ["chi2/dof = 1.5", "look at it"]


def test_no_sources_no_warnings_no_inputs(product, tmp_path):
    bits = tuple(doubt for doubt in product.verdict.doubts if not doubt.sentence)
    verdict = dataclasses.replace(product.verdict, doubts=bits)
    bare = changed(product, verdict=verdict, inputs=())
    write_calibration(tmp_path / "bare.fits", bare)
    assert_equal(bare, read_calibration(tmp_path / "bare.fits", any_model=True))


def test_signs_are_spelt_out():
    assert in_ascii("χ²/dof = 1.2 × 3\n at  40°") == "chi2/dof = 1.2 x 3 at 40 deg"
    assert in_ascii("Gál") == "G\\xe1l"


NOT_WRITTEN = "not what was written"


def rewrite(path, change, message):
    """Change a product with astropy, checksums and all; with its hash as well, unless that is what tells."""
    with fits.open(path) as hdus:
        loaded = fits.HDUList([hdu.copy() for hdu in hdus])
    change(loaded)
    if message != NOT_WRITTEN:
        loaded[0].header["CONTHASH"] = content_of(loaded)
    loaded.writeto(path, checksum=True, overwrite=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h[0].header.set("PRODVERS", 3), "newer walop-jax"),
        (lambda h: h[0].header.set("PRODVERS", "one"), "not a version"),
        (lambda h: h[0].header.remove("PRODVERS"), "is missing"),
        (lambda h: h[0].header.set("INSTRUME", "WALOP-SUOTH"), "WALOP-SOUTH"),
        (lambda h: h[0].header.set("TRUSTED", True), NOT_WRITTEN),
        (lambda h: h[0].header.set("TRUSTED", 1), "not T or F"),
        (lambda h: h[0].header.set("CHI2", 5.0), NOT_WRITTEN),
        (lambda h: h[0].header.remove("DOF"), "DOF"),
        (lambda h: h["PARAMETERS"].data["VALUE"].__setitem__(1, 0.4), NOT_WRITTEN),
        (lambda h: h["PARAMETERS"].data["SIGMA"].__setitem__(1, 0.4), "does not agree with SIGMA"),
        (lambda h: h["PARAMETERS"].data["NAME"].__setitem__(1, "pupil.magnification"), "there twice"),
        (lambda h: h["COVARIANCE"].data.__setitem__((0, 1), 1.0), "not a covariance"),
        (lambda h: h["M22"].data.__setitem__((0, 1), np.nan), "not finite"),
        (lambda h: h["M22"].header.set("CD1_1", 0.3), "grid of M21"),
        (lambda h: h.__delitem__("M33_ERR"), r"\[M33_ERR\].*missing"),
        (lambda h: h.__delitem__("PARAMETERS"), r"\[PARAMETERS\].*missing"),
        (lambda h: h.__delitem__("MODEL"), r"\[MODEL\].*missing"),
        (lambda h: h["FILTERS"].data["FILTER"].__setitem__(0, "ODD"), "not|neither"),
    ],
)
def test_what_is_not_as_written_is_refused(path, change, message):
    rewrite(path, change, message)
    with pytest.raises(DataError, match=message) as caught:
        read_calibration(path, any_model=True)
    assert str(path) in str(caught.value)


def test_a_calibration_set_is_not_a_product(handmade):
    with pytest.raises(DataError, match="walop-jax refit"):
        read_calibration(handmade.write(), any_model=True)


def test_missing_truncated_and_alien_files(path, tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_calibration(tmp_path / "none.fits", any_model=True)
    whole = path.read_bytes()
    for length in (0, 100, 2880, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError):
            read_calibration(path, any_model=True)
    path.write_text("not FITS at all")
    with pytest.raises(DataError, match="FITS"):
        read_calibration(path, any_model=True)


def test_an_existing_product_is_not_lost(product, path, monkeypatch):
    before = path.read_bytes()
    with pytest.raises(DataError, match="exists already"):
        write_calibration(path, product)

    def interrupted(*args, **kwargs):
        raise OSError("No space left on device")

    monkeypatch.setattr(walop_jax.calibration.product, "sign_and_write", interrupted)
    with pytest.raises(DataError, match="No space left"):
        write_calibration(path, product, overwrite=True)
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.glob("*calibration*")] == ["calibration.fits"]
    assert not list(path.parent.glob(".walop-*"))


def test_inputs_with_foreign_letters(product, tmp_path):
    entry = dataclasses.replace(product.inputs[0], path=tmp_path / "Säugling Ω.fits")
    write_calibration(tmp_path / "p.fits", changed(product, inputs=(entry,)))
    shutil.move(tmp_path / "p.fits", tmp_path / "Straße.fits")
    assert "S\\xe4ugling" in str(read_calibration(tmp_path / "Straße.fits", any_model=True).inputs[0].path)


def test_shapes_are_checked(product):
    with pytest.raises(ValueError, match="3 parameters"):
        changed(product, values=np.zeros(2), covariance=np.eye(2))
