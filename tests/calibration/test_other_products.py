"""Products of other instruments (PRODVERS 2): any number of arms, further moving elements, lamps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from astropy.io import fits
from calibration_in_words import changed, in_words
from handmade_run import parameters
from test_product import NOT_WRITTEN, assert_equal, rewrite

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import MatrixMaps, ResidualMap, matrix_names, residual_names
from walop_jax.calibration.product import read_calibration, write_calibration
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.grid import Grid
from walop_jax.fit.verdict import Quality, Verdict
from walop_jax.io.errors import DataError

NAN = float("nan")
GRID = Grid(4, 3, (2.5, 2.0), (0.0, 0.0), ((10.0, 0.0), (0.0, 20.0)))
NAMES = {
    1: ["M21", "M22", "M23"],
    2: ["M21", "M22", "M23", "M31", "M32", "M33"],
    3: ["M21", "M22", "M23", "M31", "M32", "M33", "M41", "M42", "M43"],
}
RATIOS = {1: [], 2: ["RATIO"], 3: ["RATIO2", "RATIO3"]}


def maps(arms: int, positions: dict[str, float]) -> MatrixMaps:
    values = np.arange(3.0 * arms * 12).reshape(3 * arms, 3, 4)
    return MatrixMaps(GRID, "SDSS-r", values, values + 0.5, positions)


def residuals(arms: int, positions: dict[str, float]) -> ResidualMap:
    values = np.arange((4.0 * arms - 1) * 12).reshape(-1, 3, 4)
    values[0, 1, 1] = NAN
    return ResidualMap(GRID, "SDSS-r", values, values + 0.5, np.ones((3, 4)), {"CHWP": 45.0} | positions)


def product_of(calset, arms: int, positions: dict[str, float]) -> Calibration:
    two = parameters(
        ("hwp.retardance", "waves", 0.5, (0.5, 0.25), True), ("throughput.n1.p00", "", 0.25, None, True)
    )
    return in_words(
        instrument=calset.instrument,
        parameters=two,
        maps=maps(arms, positions),
        values=np.array([0.5, 0.25]),
        site=calset.site,
        origin=calset.origin,
        date="2026-11-21T10:00:00",
        verdict=Verdict(100.0, 90, 120, 1.0, True),
        covariance=np.diag([0.125**2, 0.25]),
        field=(-15.0, 15.0, -20.0, 20.0),
        exposures=calset.exposures,
        filters=calset.filters,
        sources=calset.sources,
        inputs=calset.inputs,
        versions={"python": "3.11.7"},
        residuals=residuals(arms, positions),
    )


@pytest.fixture
def calset(two_cameras):
    return read_calibration_set(two_cameras.write())


def same(one, other):
    assert_equal(one, other)
    assert one.content_hash() == other.content_hash()


@pytest.mark.parametrize("arms", [1, 2, 3])
def test_round_trip_is_exact(calset, arms, tmp_path):
    product = product_of(calset, arms, {"HWP": 22.5})
    write_calibration(tmp_path / "p.fits", product)
    same(product, read_calibration(tmp_path / "p.fits", any_model=True))


@pytest.mark.parametrize("arms", [1, 2, 3])
def test_names_of_the_elements(calset, arms, tmp_path):
    assert list(matrix_names(arms)) == NAMES[arms]
    assert list(residual_names(arms)) == NAMES[arms] + RATIOS[arms]
    write_calibration(tmp_path / "p.fits", product_of(calset, arms, {"HWP": 22.5, "RET_1": -7.25}))
    with fits.open(tmp_path / "p.fits", checksum=True) as hdus:
        assert hdus[0].header["PRODVERS"] == 2
        assert hdus[0].header["INSTRUME"] == "Bench of two"
        images = [hdu.name for hdu in hdus[1:] if hdu.name.startswith("M") and hdu.name != "MODEL"]
        assert images == NAMES[arms] + [f"{name}_ERR" for name in NAMES[arms]]
        np.testing.assert_array_equal(hdus["M23"].data.ravel(), 24.0 + np.arange(12))
        planes = [hdus["RESIDUAL"].header[f"PLANE{n}"] for n in range(1, 4 * arms)]
        assert planes == NAMES[arms] + RATIOS[arms]
        for name in ("M21", "M22_ERR", "RESIDUAL"):
            head = hdus[name].header
            assert [head[key] for key in ("ELEM1", "ANGLE1", "ELEM2", "ANGLE2")] == [
                "HWP",
                22.5,
                "RET_1",
                -7.25,
            ]
            assert "ELEM3" not in head
        assert hdus["EXPOSURES"].data["HWP_ANGLE"].tolist() == [0.0, 22.5, 45.0, 67.5, 0.0, 22.5, 45.0, 360.0]


def test_the_oldest_version_that_holds_a_product_is_written(handmade, tmp_path):
    old = read_calibration_set(handmade.write())
    lamps = np.where(old.exposures.kind == "clp", "lamp", old.exposures.kind)
    cases = [
        (product_of(old, 2, {}), 1),
        (product_of(old, 1, {}), 2),
        (product_of(dataclasses.replace(old, instrument="OTHER"), 2, {}), 2),
        (
            product_of(
                dataclasses.replace(old, exposures=dataclasses.replace(old.exposures, kind=lamps)), 2, {}
            ),
            2,
        ),
    ]
    for number, (product, version) in enumerate(cases):
        path = tmp_path / f"{number}.fits"
        write_calibration(path, product)
        assert fits.getheader(path)["PRODVERS"] == version
        same(product, read_calibration(path, any_model=True))


def test_a_kind_of_the_user_stays_in_the_product(calset, tmp_path):
    """Whether there is a source for a KIND is for the model to say."""
    exposures = dataclasses.replace(calset.exposures, kind=np.full(8, "twilight"))
    product = product_of(dataclasses.replace(calset, exposures=exposures), 1, {})
    write_calibration(tmp_path / "p.fits", product)
    assert read_calibration(tmp_path / "p.fits", any_model=True).exposures.kind.tolist() == ["twilight"] * 8


def test_blanks_in_a_name_stay(calset, tmp_path):
    product = product_of(dataclasses.replace(calset, instrument="Two  blanks"), 1, {})
    write_calibration(tmp_path / "p.fits", product)
    assert read_calibration(tmp_path / "p.fits", any_model=True).instrument == "Two  blanks"
    with pytest.raises(DataError, match=r"q\.fits \[PRIMARY\] INSTRUME: is ' A', not a name"):
        write_calibration(tmp_path / "q.fits", changed(product, instrument=" A"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h.__delitem__("M42"), r"\[M42\].*missing"),
        (lambda h: h.__delitem__("M43_ERR"), r"\[M43_ERR\].*missing"),
        (lambda h: [h.__delitem__(f"M4{k}{e}") for k in (1, 2, 3) for e in ("", "_ERR")], "RESIDUAL"),
        (
            lambda h: [h.__delitem__(f"M3{k}{e}") for k in (1, 2, 3) for e in ("", "_ERR")],
            r"\[M31\].*missing",
        ),
        (lambda h: h["M41"].header.set("CD1_1", 0.3), r"\[M41\].*grid of M21"),
        (lambda h: setattr(h["RESIDUAL"], "data", h["RESIDUAL"].data[:7]), r"\[RESIDUAL\]"),
        (lambda h: h["M21"].header.remove("ANGLE1"), r"\[M21\] ELEM1: is 'HWP' at None"),
        (lambda h: h["M21"].header.set("ELEM1", "hwp 2"), r"\[M21\] ELEM1: is 'hwp 2'"),
        (lambda h: h["M21"].header.set("ANGLE1", 30.0), NOT_WRITTEN),
        (lambda h: h["EXPOSURES"].data["HWP_ANGLE"].__setitem__(1, 20.0), NOT_WRITTEN),
        (
            lambda h: h["EXPOSURES"].data["HWP_ANGLE"].__setitem__(1, NAN),
            r"HWP_ANGLE: is not finite in row 1",
        ),
        (lambda h: h[0].header.set("PRODVERS", 1), NOT_WRITTEN),
        (lambda h: h.__delitem__("RESIDUAL_ERR"), "RESIDUAL_ERR.*missing"),
        (lambda h: h.__delitem__("RESIDUAL_CHI2"), "RESIDUAL_CHI2.*missing"),
    ],
)
def test_what_is_not_as_written_is_refused(calset, tmp_path, change, message):
    path = tmp_path / "p.fits"
    write_calibration(path, product_of(calset, 3, {"HWP": 22.5}))
    rewrite(path, change, message)
    with pytest.raises(DataError, match=message) as caught:
        read_calibration(path, any_model=True)
    assert str(path) in str(caught.value)


def test_records_refuse_what_cannot_be(calset):
    product = product_of(calset, 2, {})
    with pytest.raises(ValueError, match="three elements for each arm"):
        dataclasses.replace(product.maps, values=np.zeros((4, 3, 4)), errors=np.zeros((4, 3, 4)))
    with pytest.raises(ValueError, match="6 planes"):
        dataclasses.replace(residuals(2, {}), values=np.zeros((6, 3, 4)), errors=np.zeros((6, 3, 4)))
    with pytest.raises(ValueError, match="of 3 arms, the matrix has 2"):
        changed(product, residuals=residuals(3, {}))


def test_quality_in_words():
    """The numbers are those of the file format, which other programs read."""
    words = {
        1: "not converged", 2: "ill-conditioned", 4: "edge of its prior", 8: "excess noise", 16: "cross-talk",
        32: "extrapolated in the field", 64: "wavelength or temperature", 128: "camera is missing",
        256: "saturated", 512: "free-form", 1024: "class of causes", 2048: "validity forced",
        4096: "non-physical", 8192: "does not explain", 16384: "no Stokes parameters",
    }  # fmt: skip
    for bit, text in words.items():
        (meaning,) = Quality(bit).meanings
        assert text in meaning
    assert len(Quality(16 | 8192).meanings) == 2
    assert Quality(0).meanings == ()
