"""Sets of other instruments: any number of cameras, further moving elements, lamps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from astropy.io import fits
from frames_file import write_frames
from test_writing import columns as all_columns
from test_writing import equal

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.grid import Grid
from walop_jax.data.inspection import inspect
from walop_jax.data.records import Block, Position
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.write import write_calibration_set
from walop_jax.io.errors import DataError

NAN = float("nan")
E, P, I = "EXPOSURES", "POINTS", "INTENSITIES"  # noqa: E741 - as in the tables


# ---- what stands in the file is what is read ----


def test_two_cameras_and_two_elements(two_cameras):
    calset = read_calibration_set(two_cameras.write())
    e = calset.exposures
    assert (calset.instrument, calset.cameras, calset.remarks) == ("Bench of two", 2, ())
    assert e.kind.tolist() == ["lamp"] * 6 + ["standard"] * 2
    assert list(e.further) == ["RET_1", "HWP"]
    assert e.position("RET_1").inside.tolist() == [True] * 4 + [False] * 2 + [True, False]
    np.testing.assert_array_equal(e.position("RET_1").angle, [0.0, 0.0, 30.0, 30.0, NAN, NAN, 60.0, NAN])
    assert e.position("HWP").inside.all()
    assert e.position("HWP").angle.tolist() == [0.0, 22.5, 45.0, 67.5, 0.0, 22.5, 45.0, 360.0]
    for prefix in ("CLP", "CHWP"):
        assert not e.position(prefix).inside.any()
        assert np.isnan(e.position(prefix).angle).all()
    block = calset.intensities.block(1, 3)
    # exposure 14 (row 4) at point 7, by the formula of the fixture
    assert block.counts[1, 4].tolist() == [104200.0, 104210.0]
    assert block.source[:, 5:].tolist() == [[-1, 0, 0], [-1, 0, 0]]
    assert calset.intensities.rows == 24


def test_an_unknown_element_names_the_nearest(two_cameras):
    e = read_calibration_set(two_cameras.write()).exposures
    with pytest.raises(
        ValueError, match=r"no moving element 'RET1': give RET1_IN .*; did you mean 'RET_1'\?"
    ):
        e.position("RET1")


@pytest.mark.parametrize("value", [{"RET": 3}, {"ret": 8}, {"1": 8}, {"": 8}, {"A B": 8}])
def test_exposures_refuse_elements_that_cannot_be(two_cameras, value):
    e = read_calibration_set(two_cameras.write()).exposures
    ((prefix, number),) = value.items()
    with pytest.raises(ValueError, match=r"cannot be the prefix|3 positions for 8 exposures"):
        e.placed(**{prefix: Position.out(number)})
    with pytest.raises(ValueError, match="HWP is in the beam without an angle"):
        e.placed(HWP=Position(np.ones(8, bool), np.full(8, NAN)))


def test_parts_of_exposures_carry_the_elements(two_cameras):
    e = read_calibration_set(two_cameras.write()).exposures
    for rows in (np.array([6, 0, 6]), slice(2, 5), e.kind == "standard"):
        part = e[rows]
        for name, values in e.columns().items():
            np.testing.assert_array_equal(part.columns()[name], values[rows])


def test_angles_have_units(two_cameras):
    entry = two_cameras[E]["RET_1_ANGLE"]
    entry[1], entry[2] = "rad", np.deg2rad(entry[2])
    angle = read_calibration_set(two_cameras.write()).exposures.position("RET_1").angle
    np.testing.assert_allclose(angle, [0.0, 0.0, 30.0, 30.0, NAN, NAN, 60.0, NAN], rtol=1e-14)


def test_an_element_that_is_out_has_no_angle(two_cameras):
    two_cameras.values(E, "RET_1_ANGLE")[4] = 12.0
    assert np.isnan(read_calibration_set(two_cameras.write()).exposures.position("RET_1").angle[4])


def test_underscores_belong_to_the_prefix(two_cameras):
    """A_IN is the column of A that says whether it is in; A_IN_ANGLE that of an element A_IN."""
    for name in ("A_IN_ANGLE", "A_ANGLE"):
        two_cameras[E][name] = ["D", "deg", np.full(8, 1.0 + len(name))]
    two_cameras[E]["A_IN"] = ["L", None, np.ones(8, bool)]
    e = read_calibration_set(two_cameras.write()).exposures
    assert set(e.further) == {"RET_1", "HWP", "A_IN", "A"}
    assert e.position("A").angle[0] == 8.0
    assert e.position("A_IN").angle[0] == 11.0


def test_polariser_and_plate_beside_further_elements(two_cameras):
    two_cameras[E]["CLP_IN"] = ["L", None, np.array([True] * 6 + [False] * 2)]
    two_cameras[E]["CLP_ANGLE"] = ["D", "deg", np.array([0.0, 36.0, 72.0, 108.0, 144.0, 10.0, NAN, NAN])]
    two_cameras.values(E, "KIND")[:2] = "clp"
    calset = read_calibration_set(two_cameras.write())
    assert calset.exposures.clp_in.tolist() == [True] * 6 + [False] * 2
    assert calset.exposures.kind[:3].tolist() == ["clp", "clp", "lamp"]
    assert calset.remarks == ()


def test_a_kind_of_the_users_own(two_cameras):
    two_cameras.values(E, "KIND")[:2] = "DOME"
    path = two_cameras.write()
    with pytest.raises(DataError, match=r"\[EXPOSURES\] KIND: 'dome' is not a kind, in rows 0, 1"):
        read_calibration_set(path)
    calset = read_calibration_set(path, kinds=["dome"])
    assert calset.exposures.kind[:3].tolist() == ["dome", "dome", "lamp"]
    write_calibration_set(two_cameras.folder / "again.fits", calset)
    equal(calset, read_calibration_set(two_cameras.folder / "again.fits", kinds=["dome"]))
    assert inspect(calset).kinds == {"dome": 2, "lamp": 4, "standard": 2}


def test_any_field_of_another_instrument(two_cameras):
    two_cameras.values(P, "X")[:] = [-90.0, 0.0, 90.0]
    assert read_calibration_set(two_cameras.write()).points.x.tolist() == [-90.0, 0.0, 90.0]
    two_cameras.values(P, "X")[2] = 91.0
    with pytest.raises(DataError, match=r"\[POINTS\] X: lies outside ±90° of Bench of two in row 2"):
        read_calibration_set(two_cameras.write())
    two_cameras.header["INSTRUME"] = "walop-south"  # the names of old know no upper and lower case
    two_cameras.values(P, "X")[:] = [-0.2, 0.0, 0.36]
    with pytest.raises(DataError, match=r"lies outside ±0.35° of WALOP-SOUTH in row 2"):
        read_calibration_set(two_cameras.write())


def test_a_set_of_version_1_has_no_further_elements(handmade):
    """A column that would be that of an element is unknown there, and so is a picture beside a table."""
    handmade[E]["HWP_ANGLE"] = ["D", "deg", np.zeros(8)]
    path = handmade.folder / "set.fits"
    fits.HDUList([*handmade.hdus(), fits.ImageHDU(np.zeros((2, 2)), name="N4")]).writeto(path, checksum=True)
    calset = read_calibration_set(path)
    assert calset.exposures.further == {}
    assert len(calset.remarks) == 2
    assert "[N4]: unknown extension" in calset.remarks[0]
    assert "[EXPOSURES] HWP_ANGLE: unknown column, not used" in calset.remarks[1]


# ---- writing ----


def test_round_trip_is_exact(two_cameras):
    calset = read_calibration_set(two_cameras.write())
    path = two_cameras.folder / "again.fits"
    write_calibration_set(path, calset)
    again = read_calibration_set(path)
    equal(calset, again)
    assert list(again.exposures.further) == ["RET_1", "HWP"]
    with fits.open(path, checksum=True) as hdus:
        assert hdus[0].header["CALVERS"] == 2
        assert hdus[0].header["INSTRUME"] == "Bench of two"
        assert hdus[I].columns["N"].format == "2D"
        made = hdus[E].columns
        assert made.names[-4:] == ["RET_1_IN", "RET_1_ANGLE", "HWP_IN", "HWP_ANGLE"]
        assert [made[name].format for name in made.names[-4:]] == ["L", "D", "L", "D"]
        assert made["HWP_ANGLE"].unit == "deg"
        np.testing.assert_array_equal(hdus[E].data["RET_1_ANGLE"], two_cameras.values(E, "RET_1_ANGLE"))


def lamp(calset):
    kind = np.where(np.arange(8) == 2, "lamp", calset.exposures.kind)
    return dataclasses.replace(calset, exposures=dataclasses.replace(calset.exposures, kind=kind))


def element(calset):
    return dataclasses.replace(calset, exposures=calset.exposures.placed(HWP=Position.out(8)))


def fifth_camera(calset):
    block = calset.intensities.block(0, 3)
    counts, sigma = (np.concatenate([a, a[..., :1]], axis=2) for a in (block.counts, block.sigma))
    more = Block(block.x, block.y, counts, sigma, block.used, block.source)
    return dataclasses.replace(
        calset, instrument="Bench of five", intensities=TableIntensities.dense(calset.points, more)
    )


def named(calset):
    return dataclasses.replace(calset, instrument="WALOP-EAST")


@pytest.mark.parametrize("change", [lambda c: c, lamp, element, fifth_camera, named])
def test_whatever_a_set_holds_is_written(handmade, change):
    calset = change(read_calibration_set(handmade.write()))
    path = handmade.folder / "again.fits"
    write_calibration_set(path, calset)
    again = read_calibration_set(path)
    assert (again.instrument, again.cameras) == (calset.instrument, calset.cameras)
    one, other = all_columns(calset), all_columns(again)
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name])


@pytest.mark.parametrize("name", ["", " A", 33 * "A", "Größe", "A\nB"])
def test_a_name_that_cannot_be_read_is_not_written(two_cameras, name):
    calset = dataclasses.replace(read_calibration_set(two_cameras.write()), instrument=name)
    with pytest.raises(DataError, match=r"again\.fits \[PRIMARY\] INSTRUME: .*printable ASCII"):
        write_calibration_set(two_cameras.folder / "again.fits", calset)
    assert not (two_cameras.folder / "again.fits").exists()


# ---- whole frames ----

GRID = Grid(4, 3, (2.5, 2.0), (0.0, 0.0), ((5.0, 0.0), (0.0, 5.0)))


def lamps_in_frames(two_cameras, calset, counts, used):
    """Frames of the first exposures of a set, and the block that is in them."""
    shape = counts.shape[:2]
    block = Block(GRID.points.x, GRID.points.y, counts, np.sqrt(counts), used, np.full(shape, -1))
    scene = dataclasses.replace(
        calset,
        exposures=calset.exposures[: shape[1]],
        points=GRID.points,
        intensities=TableIntensities.dense(GRID.points, block),
    )
    path = two_cameras.folder / "frames.fits"
    write_frames(path, scene, GRID, dtype="f8")
    return path, block


@pytest.fixture(params=[2, 3, 6])
def frames(request, two_cameras):
    """Frames of K cameras, a fifth of the pixels not used, and the block that is in them."""
    rng = np.random.default_rng(request.param)
    counts = rng.integers(1000, 100000, (12, 6, request.param)) / 4
    lamps = read_calibration_set(two_cameras.write())
    return lamps_in_frames(two_cameras, lamps, counts, rng.random((12, 6)) > 0.2)


def test_frames_of_any_number_of_cameras(frames):
    path, block = frames
    cameras = block.counts.shape[-1]
    calset = read_calibration_set(path)
    assert isinstance(calset.intensities, TableIntensities)
    assert calset.cameras == cameras
    assert list(calset.exposures.further) == ["RET_1", "HWP"]
    found = calset.intensities.block(2, 9)
    np.testing.assert_array_equal(found.used, block.used[2:9])
    np.testing.assert_array_equal(found.counts[found.used], block.counts[2:9][found.used])
    with fits.open(path, checksum=True) as hdus:
        names = [hdu.name for hdu in hdus[1:] if isinstance(hdu, fits.ImageHDU)]
        assert names == [f"{what}{k}" for what in "NE" for k in range(cameras)] + ["FLAG"]


@pytest.mark.parametrize(
    ("gone", "message"),
    [
        (("N1",), r"\[N1\]: the image extension is missing; frames need N0…N{last} and E0…E{last}"),
        (("E0",), r"\[E0\]: the image extension is missing"),
        (("N{last}",), r"\[N{last}\]: the image extension is missing"),
        (("N1", "E1"), r"\[N1\]: the image extension is missing"),
    ],
)
def test_a_camera_of_frames_is_missing(frames, gone, message):
    path, block = frames
    last = block.counts.shape[-1] - 1
    with fits.open(path, memmap=False) as hdus:
        for name in gone:
            hdus.pop(hdus.index_of(name.format(last=last)))
        hdus.writeto(path.with_name("less.fits"))
    with pytest.raises(DataError, match=message.format(last=last)):
        read_calibration_set(path.with_name("less.fits"))


# ---- several files ----


def test_an_element_that_another_file_lacks_is_out(two_cameras):
    one = two_cameras.write("one.fits")
    other = two_cameras.copy()
    other.values(E, "MJD")[:] += 1.0
    for name in ("RET_1_IN", "RET_1_ANGLE"):
        del other[E][name]
    other[E]["CLP_IN"] = ["L", None, np.array([True] + [False] * 7)]
    other[E]["CLP_ANGLE"] = ["D", "deg", np.array([30.0] + [NAN] * 7)]
    other[E]["K_ANGLE"] = ["D", "deg", np.full(8, 7.0)]
    two = other.write("two.fits")
    first = read_calibration_set(one).exposures
    e = read_calibration_set(one, two).exposures
    assert list(e.further) == ["RET_1", "HWP", "K"]
    np.testing.assert_array_equal(e.position("RET_1").angle[:8], first.position("RET_1").angle)
    assert not e.position("RET_1").inside[8:].any()
    assert np.isnan(e.position("RET_1").angle[8:]).all()
    assert e.position("K").inside.tolist() == [False] * 8 + [True] * 8
    np.testing.assert_array_equal(e.position("HWP").angle, np.tile(first.position("HWP").angle, 2))
    assert np.flatnonzero(e.clp_in).tolist() == [8]
    remarks = read_calibration_set(one, two).remarks
    assert any("two.fits [EXPOSURES] RET_1_ANGLE: column missing; taken as out" in r for r in remarks)
    assert any("one.fits [EXPOSURES] K_ANGLE: column missing; taken as out" in r for r in remarks)


def test_other_numbers_of_cameras_are_not_merged(two_cameras):
    one = two_cameras.write("one.fits")
    for name in ("N", "N_ERR"):
        values = two_cameras.values(I, name)
        two_cameras[I][name] = ["3D", "electron", np.column_stack([values, values[:, 0]])]
    with pytest.raises(DataError, match=r"two\.fits N: has 3 cameras, .*one\.fits has 2"):
        read_calibration_set(one, two_cameras.write("two.fits"))


def test_frames_and_table_of_two_cameras(two_cameras):
    table = two_cameras.write("table.fits")
    calset = read_calibration_set(table)
    counts = np.random.default_rng(3).integers(1000, 100000, (12, 6, 2)) / 4
    path, _ = lamps_in_frames(two_cameras, calset, counts, np.ones((12, 6), bool))
    mixed = read_calibration_set(path, table)
    assert (mixed.cameras, len(mixed.points), len(mixed.exposures)) == (2, 15, 14)
    whole = mixed.intensities.block(0, 15)
    np.testing.assert_array_equal(whole.counts[:12, :6], counts)
    np.testing.assert_array_equal(whole.counts[12:, 6:], calset.intensities.block(0, 3).counts)


def test_a_copied_exposure_has_the_same_positions(two_cameras):
    """Two exposures with the same counts are copies only where every element stands alike."""
    for name, entry in two_cameras[E].items():
        if name not in ("EXPOSURE", "HWP_ANGLE"):
            entry[2][1] = entry[2][0]
    for name in ("N", "N_ERR"):
        values = two_cameras.values(I, name)
        values[3:6] = values[:3]
    assert read_calibration_set(two_cameras.write()).intensities.rows == 24
    two_cameras.values(E, "HWP_ANGLE")[1] = two_cameras.values(E, "HWP_ANGLE")[0]
    assert read_calibration_set(two_cameras.write()).intensities.rows == 21


# ---- a look at it ----


def test_inspection_counts_lamps_and_elements(two_cameras):
    found = inspect(read_calibration_set(two_cameras.write()))
    assert found.cameras == 2
    assert found.kinds == {"lamp": 6, "standard": 2}
    assert [(use.prefix, use.exposures, use.angles) for use in found.elements] == [
        ("RET_1", 5, (0.0, 30.0, 60.0)),
        ("HWP", 8, (0.0, 22.5, 45.0, 67.5, 360.0)),
    ]
    assert [(group.kind, group.exposures) for group in found.groups] == [
        ("lamp", 5), ("lamp", 1), ("standard", 1), ("standard", 1),
    ]  # fmt: skip
    assert not [finding for finding in found.findings if finding.severity == "fault"]


def test_inspection_of_elements_that_hardly_move(two_cameras):
    two_cameras.values(E, "RET_1_IN")[:] = False
    two_cameras.values(E, "HWP_ANGLE")[:] = [10.0, 20.0] * 4
    faults = [
        f.what for f in inspect(read_calibration_set(two_cameras.write())).findings if f.severity == "fault"
    ]
    assert faults == ["2 distinct setting(s) of the moving elements with usable data"]


def test_inspection_suspects_radians(two_cameras):
    angles = np.deg2rad([0.0, 40.1, 80.2, 120.3, 160.4, 200.5, 240.6, 280.7])
    two_cameras.values(E, "HWP_ANGLE")[:] = angles
    found = inspect(read_calibration_set(two_cameras.write())).findings
    assert [f.what for f in found if "radians" in f.what] == ["the angles of HWP look like radians"]
