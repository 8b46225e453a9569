"""The script `notebooks/zemax.py`: text exports of an optical design program, and what a set holds of them.

Held against numbers typed by hand and, where it lies beside the project, a set made by other code from real exports.
"""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from zemax_exports import FIELDS, STATES, export_text, transmission, write_folder

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.inspection import inspect
from walop_jax.data.records import CalibrationSet
from walop_jax.data.write import write_calibration_set
from walop_jax.io.errors import DataError

SCRIPT = Path(__file__).resolve().parents[1] / "notebooks" / "zemax.py"


def script():
    """The script as a module, from its path: it lies beside a notebook and in no package."""
    spec = importlib.util.spec_from_file_location("zemax", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["zemax"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


zemax = script()
read_export = zemax.read_export


def import_transmissions(folder, **options) -> CalibrationSet:
    """The set alone."""
    return zemax.import_transmissions(folder, **options)[0]


def remarks_of(folder, **options) -> list[str]:
    return zemax.import_transmissions(folder, **options)[1]


@pytest.fixture
def folder(tmp_path):
    return write_folder(tmp_path / "exports")


def test_outside_exports_give_the_outside_set(shared_data, tmp_path):
    """Made elsewhere from the same exports, through single precision, without 0.66 µm and half of the points."""
    folder = shared_data / "zemax_text"
    if not folder.is_dir():
        pytest.skip("no text exports beside the project (../shared/data/zemax_text)")
    ours, theirs = import_transmissions(folder), read_calibration_set(shared_data / "walop_north_design.fits")
    assert remarks_of(folder) == []
    assert (len(ours.exposures), len(ours.points), ours.intensities.rows) == (7 * 9, 12, 7 * 9 * 12)
    assert set(ours.filters) == set(theirs.filters) | {"MONO-6600"}
    for name, curve in theirs.filters.items():
        assert ours.filters[name].wavelength.tolist() == curve.wavelength.tolist()
        assert ours.filters[name].throughput.tolist() == curve.throughput.tolist()
    assert (ours.instrument, ours.origin) == (theirs.instrument, theirs.origin)

    mine, hers = {}, {}
    for calset, known in ((ours, mine), (theirs, hers)):
        e, block = calset.exposures, calset.intensities.block(0, len(calset.points))
        for p, j in np.argwhere(block.used):
            # To 1e-9 degrees, because arctangents differ in the last bit.
            key = (str(e.filter[j]), float(np.round(e.clp_angle[j], 9)) if e.clp_in[j] else None)
            known[*key, block.x[p], block.y[p]] = (j, block.counts[p, j], block.sigma[p, j])
    common = sorted(set(mine) & set(hers), key=str)
    assert len(common) == 6 * 9 * 6
    for key in common:
        (a, n, sigma), (b, n_single, sigma_single) = mine[key], hers[key]
        np.testing.assert_allclose(n_single, n, rtol=2.0**-24)  # half of the last bit in single precision
        np.testing.assert_allclose(sigma_single, sigma, rtol=2.0**-24)
        for name in ("kind", "clp_in", "exptime", "temp", "ha", "ra", "rotator", "teff"):
            np.testing.assert_array_equal(
                getattr(ours.exposures, name)[a], getattr(theirs.exposures, name)[b], name
            )
        assert not any(set_.exposures.position("CHWP").inside.any() for set_ in (ours, theirs))
    # The same order: exposures by wavelength, unpolarised light first, then by angle.
    assert [mine[key][0] for key in sorted(common, key=lambda key: mine[key][0])] == [
        mine[key][0] for key in sorted(common, key=lambda key: (hers[key][0], mine[key][0]))
    ]


def test_a_calibration_set(folder, tmp_path):
    calset = import_transmissions(folder)
    e = calset.exposures
    assert calset.instrument == "WALOP-NORTH"
    assert remarks_of(folder) == []
    assert e.kind.tolist() == ["flux"] * 12
    assert e.filter.tolist() == ["MONO-5400"] * 6 + ["MONO-6600"] * 6
    assert calset.filters["MONO-6600"].wavelength.tolist() == [0.66]
    assert e.clp_in.tolist() == [False, *[True] * 5] * 2
    np.testing.assert_allclose(e.clp_angle[:6], [np.nan, 0.0, 45.0, 90.0, 135.0, 180.0], rtol=1e-14)
    assert calset.points.x.tolist() == [-0.16, -0.16, 0.25]
    assert calset.points.y.tolist() == [-0.03, 0.01, 0.01]
    block = calset.intensities.block(0, 3)
    assert block.used.all()
    # Unpolarised light, and light at 45°, of 0.54 µm at (0.25, 0.01): O1, E1, O2, E2 are configurations 1, 3, 2, 4.
    np.testing.assert_allclose(block.counts[2, 0], [53001.0, 55001.0, 54001.0, 56001.0], rtol=1e-14)
    np.testing.assert_allclose(block.counts[2, 2], [53001.0, 55001.0, 108001.0, 1.0], rtol=1e-14)
    # A thousandth; of one electron that is still more than the rounding at the ninth decimal, 10⁻³ / √12 electrons.
    np.testing.assert_allclose(block.sigma[2, 2], [53.001, 55.001, 108.001, 0.001], rtol=1e-12)
    np.testing.assert_allclose(
        import_transmissions(folder, error=0.0).intensities.block(0, 3).sigma, 2.8867513e-4, rtol=1e-7
    )

    write_calibration_set(tmp_path / "set.fits", calset)
    again = read_calibration_set(tmp_path / "set.fits")
    assert again.remarks == ()
    np.testing.assert_array_equal(again.intensities.block(0, 3).counts, block.counts)
    assert [entry.what for entry in inspect(again).findings if entry.severity == "fault"] == []


def test_amplitudes_are_angles_to_four_decimals(tmp_path):
    """0.3827 and 0.9239 are printed for 67.5°; 0.9239 / 0.3827 = 2.41416 is the tangent of 67.49957°."""
    path = tmp_path / "export.txt"
    text = export_text().replace("X-Field     :  1.0000", "X-Field     :  0.3827")
    path.write_text(text.replace("Y-Field     :  0.0000", "Y-Field     :  0.9239"), encoding="latin-1")
    export = read_export(path)
    assert export is not None
    assert export.angle == pytest.approx(67.49957, abs=1e-5)


def comma(text: str) -> str:
    """As a Windows that is set to decimal commas prints it."""
    head, rest = text.split("X-Field")
    digits = "0123456789"
    return f"{head}X-Field" + "".join(
        "," if c == "." and rest[i - 1] in digits and rest[i + 1] in digits else c for i, c in enumerate(rest)
    )


@pytest.mark.parametrize(
    "write",
    [
        lambda text: text.encode("latin-1"),
        lambda text: text.encode("utf-8"),
        lambda text: text.encode("utf-8-sig"),
        lambda text: text.encode("utf-16"),
        lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
        lambda text: text.replace("\n", "\r\n").encode("utf-16"),
        lambda text: text.replace("\n", "\r\n").encode("cp1252"),
        lambda text: ("\n\n" + text).encode("latin-1"),
        lambda text: comma(text).encode("latin-1"),
    ],
    ids=["latin-1", "utf-8", "utf-8-sig", "utf-16", "utf-16-be", "utf-16-crlf", "crlf", "blank", "comma"],
)
def test_encodings(write, tmp_path):
    path = tmp_path / "export.txt"
    path.write_bytes(write(export_text(2, ("-0.7071", "0.7071"))))
    export = read_export(path)
    assert export is not None
    assert (export.configuration, export.title, export.angle) == (2, "WALOP-North", pytest.approx(135.0))
    assert export.x.tolist() == [-0.16, 0.25, -0.16]
    assert export.y.tolist() == [0.01, 0.01, -0.03]
    assert export.wavelength.tolist() == [0.54, 0.66]
    assert export.transmission[1].tolist() == [0.000001, 0.000001]
    assert export.step.tolist() == [[1e-9, 1e-9]] * 3


def test_numbers_with_exponents(tmp_path):
    path = tmp_path / "export.txt"
    path.write_text(
        export_text(2, ("-0.7071", "0.7071")).replace("0.000001000", "1.0E-06"), encoding="latin-1"
    )
    export = read_export(path)
    assert export is not None
    assert export.transmission[1].tolist() == [1e-6, 1e-6]
    assert export.step[1] == pytest.approx([1e-7, 1e-7])


FIRST = transmission(1, ("1.0000", "0.0000"), 0, 0)
BAD = {
    "elliptical": ("Y-Phase     :    0.00", "Y-Phase     :   90.00", "line 8: is elliptical.*export linear"),
    "dark": ("X-Field     :  1.0000", "X-Field     :  0.0000", "no electric field"),
    "no state": ("X-Field     :  1.0000\n", "", "neither X-Field nor"),
    "bad state": ("X-Field     :  1.0000", "X-Field     :  east", "line 8: X-Field is 'east', not a number"),
    "no configuration": ("Configuration 1 of 4\n", "", "does not name its configuration"),
    "error entry": (FIRST, "Error", "line 18: the transmission is 'Error', not a number.*without this field"),
    "not a number": (FIRST, "NaN", "line 18: the transmission is 'NaN', not a number"),
    "nothing": (FIRST, "", "line 18: the transmission is '', not a number"),
    "per cent": (FIRST, "5.1", r"line 18: the transmission 5\.1 is not in 0 … 1; fractions"),
    "negative": (FIRST, "-0.05", "is not in 0 … 1"),
    "altered": (FIRST, "0.201001000", "line 17: a total of .* is no mean of its transmissions"),
    "unknown line": (
        "  Total Trans",
        "  Vignetted\n  Total Trans",
        "line 20: 'Vignetted' says something unknown",
    ),
    "wavelength twice": ("at    0.6600", "at    0.5400", r"line 19: 0\.54 µm is there twice"),
    "another wavelength": (
        "0.0300 (deg)\n  Transmission at    0.5400",
        "0.0300 (deg)\n  Transmission at    0.5410",
        "line 27: has other wavelengths",
    ),
    "point twice": ("0.2500, 0.0100", "-0.1600, 0.0100", "line 22: the field point is there twice"),
    "millimetres": (
        "0.0100 (deg)",
        "0.0100 (mm)",
        "line 17: .* is not a pair of angles; export field angles",
    ),
    "one coordinate": ("-0.1600, 0.0100 (deg)", "0.0100 (deg)", "line 17: .* is not a pair of angles"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_exports(name, tmp_path):
    old, new, message = BAD[name]
    text = export_text()
    assert old in text
    text = text.replace(old, new, 1)
    path = tmp_path / "export.txt"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(DataError, match=message) as caught:
        read_export(path)
    assert str(caught.value).startswith(str(path))


def test_every_truncation_is_noticed(tmp_path):
    """Cut anywhere ahead of the part on chief rays an export is refused: never fewer points without a word."""
    text = export_text()
    path = tmp_path / "export.txt"
    heading = len("Polarization Transmission Data")
    for end in range(heading + 1, text.index("Chief Ray"), 7):
        path.write_text(text[:end], encoding="latin-1")
        with pytest.raises(DataError, match=r"export (the file again|field angles)"):
            read_export(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty; export the file again, or remove it"),
        (b" \r\n", "is empty"),
        (export_text().encode("utf-16")[2:], "UTF-16 without its mark; save it as UTF-8"),
        (export_text().encode("utf-16")[:1001], "cut off within a letter"),
    ],
)
def test_files_that_are_no_text(content, message, tmp_path):
    path = tmp_path / "export.txt"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_export(path)


def test_a_vignetted_field_point_is_left_out(folder):
    """One camera dark at one point in unpolarised light of one wavelength."""
    path = folder / "Unpol" / "Config_3" / "transmission_field1_pol0.txt"
    value = transmission(3, None, 1, 0)
    text = path.read_text(encoding="latin-1")
    assert value in text
    path.write_text(text.replace(value, "0.000000000"), encoding="latin-1")
    block = import_transmissions(folder).intensities.block(0, 3)
    assert np.argwhere(~block.used).tolist() == [[2, 0]]
    (remark,) = remarks_of(folder)
    assert "1 of 36 rows are left out because a transmission is 0 (vignetted)" in remark


def test_rows_that_lack_a_camera_are_left_out_and_told(folder):
    (folder / "Config_2" / "transmission_field1_pol3.txt").unlink()  # light at 90°
    calset = import_transmissions(folder)
    assert np.mod(calset.exposures.clp_angle[1:5], 360).tolist() == pytest.approx([0.0, 45.0, 135.0, 180.0])
    assert calset.intensities.rows == 2 * 5 * 3
    (remark,) = remarks_of(folder)
    assert "6 of 36 rows" in remark
    assert "0 of E1 (configuration 3), 6 of O2 (configuration 2)" in remark

    # Another ensemble of field points, exported for three cameras only: its points are not there.
    for k in (1, 2, 3):
        text = export_text(k, ("1.0000", "0.0000"), ("0.0500, 0.2000",))
        (folder / f"Config_{k}" / "transmission_field2_pol1.txt").write_text(text, encoding="latin-1")
    calset = import_transmissions(folder)
    assert len(calset.points) == 3
    assert "of 48 rows" in remarks_of(folder)[0]
    # With the fourth they are, in that state alone.
    text = export_text(4, ("1.0000", "0.0000"), ("0.0500, 0.2000",))
    (folder / "Config_4" / "transmission_field2_pol1.txt").write_text(text, encoding="latin-1")
    calset = import_transmissions(folder)
    used = calset.intensities.block(0, 4).used
    assert calset.points.y[3] == 0.2
    assert np.flatnonzero(used[3]).tolist() == [1, 6]


def test_a_camera_that_is_not_there_at_all(folder):
    shutil.rmtree(folder / "Config_4")
    shutil.rmtree(folder / "Unpol" / "Config_4")
    with pytest.raises(DataError, match=r"no row has all four.* 36 of E2 \(configuration 4\)"):
        import_transmissions(folder)


def test_data_that_are_there_twice(folder):
    source = folder / "Config_1" / "transmission_field1_pol2.txt"
    shutil.copy(source, source.with_name("transmission_field1_pol2 (copy).txt"))
    with pytest.raises(DataError, match=r"pol2.* holds what stands in .*pol2.* too.*remove one"):
        import_transmissions(folder)


def test_a_file_in_the_wrong_folder(folder):
    (folder / "Config_1" / "transmission_field1_pol2.txt").rename(folder / "Config_2" / "stray.txt")
    with pytest.raises(DataError, match=r"stray\.txt: says configuration 1 in a folder 'Config_2'"):
        import_transmissions(folder)


def test_names_of_files_mean_nothing(folder, tmp_path):
    """All in one folder, in any order, letters of any case; what is no export is told."""
    flat = tmp_path / "flat"
    flat.mkdir()
    for n, path in enumerate(sorted(folder.rglob("*.txt"), reverse=True)):
        shutil.copy(path, flat / f"{n}.TXT")
    (flat / "notes.txt").write_text("Exported on Tuesday.")
    (flat / "._0.txt").write_bytes(b"\x00\x05\x16\x07")
    (flat / "design.zmx").write_bytes(b"\x00")
    calset, other = import_transmissions(folder), import_transmissions(flat)
    np.testing.assert_array_equal(other.intensities.block(0, 3).counts, calset.intensities.block(0, 3).counts)
    (remark,) = remarks_of(flat)
    assert "1 text files are no exports and not read, notes.txt" in remark


def test_every_file_is_read_once(folder, monkeypatch):
    read: list[str] = []
    original = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append(str(path)) or original(path))
    import_transmissions(folder)
    assert len(read) == len(set(read)) == 4 * len(STATES)


def test_other_cameras(folder):
    """Configurations by another order, and one that is no camera."""
    counts = import_transmissions(folder).intensities.block(0, 3).counts
    other = import_transmissions(folder, configurations=(1, 3, 4, 2)).intensities.block(0, 3).counts
    np.testing.assert_array_equal(other, counts[..., [0, 1, 3, 2]])
    with pytest.raises(DataError, match=r"configuration 2 is no camera; .*\[1, 3, 5, 4\]"):
        import_transmissions(folder, configurations=(1, 3, 5, 4))


def test_which_instrument(folder):
    assert import_transmissions(folder, instrument="WALOP-SOUTH").instrument == "WALOP-SOUTH"
    (remark,) = remarks_of(folder, instrument="WALOP-SOUTH")
    assert "WALOP-SOUTH is not among the titles of the exports (WALOP-North)" in remark
    with pytest.raises(DataError, match="WALOP-NORTH"):
        import_transmissions(folder, instrument="WALOP-NORT")


@pytest.mark.parametrize(
    "options",
    [{"configurations": (1, 2, 3)}, {"configurations": (1, 3, 2, 2)}, {"error": -1.0}, {"error": np.nan}],
)
def test_options_that_cannot_be_meant(folder, options):
    with pytest.raises(ValueError, match=r"are not four different|is not a share"):
        import_transmissions(folder, **options)


def test_points_outside_the_field(folder):
    for path in folder.rglob("*.txt"):
        path.write_text(
            path.read_text(encoding="latin-1").replace(FIELDS[1], "0.2500, 12.00"), encoding="latin-1"
        )
    with pytest.raises(DataError, match=r"\[POINTS\] Y: lies outside ±0.35° of WALOP-NORTH"):
        import_transmissions(folder)


def test_folders_without_exports(tmp_path):
    with pytest.raises(DataError, match="is not a folder"):
        import_transmissions(tmp_path / "none")
    with pytest.raises(DataError, match="none of 0 text files begins with"):
        import_transmissions(tmp_path)


# ----------------------------------------------------------------------------------------- the command line


def test_a_set_that_other_commands_read(folder, tmp_path, capsys):
    output = tmp_path / "design.fits"
    assert zemax.main([str(folder), "-o", str(output)]) == 0
    told = capsys.readouterr()
    assert told.out == f"{output}: WALOP-NORTH, 2 wavelengths, 12 exposures of 3 points, 36 rows to use\n"
    assert told.err == ""
    assert set(read_calibration_set(output).filters) == {"MONO-5400", "MONO-6600"}


def test_options_and_warnings(folder, tmp_path, capsys):
    (folder / "Config_2" / "transmission_field1_pol3.txt").unlink()
    output = tmp_path / "design.fits"
    output.write_text("mine")
    words = [str(folder), "-o", str(output), "--cameras", "1, 3, 4, 2", "--error", "0.01"]
    assert zemax.main(words) == 1
    assert output.read_text() == "mine"
    assert zemax.main([*words, "--overwrite"]) == 0
    assert "zemax.py: warning: " in (told := capsys.readouterr().err)
    assert "6 of E2 (configuration 2)" in told
    block = read_calibration_set(output).intensities.block(0, 3)
    assert block.sigma[0, 0] == pytest.approx(0.01 * block.counts[0, 0])


@pytest.mark.parametrize("words", [(), ("--cameras", "O1,E1,O2,E2"), ("--instrument", "WALOP-EAST")])
def test_nothing_is_half_written(folder, tmp_path, capsys, words):
    if not words:  # an export that is cut off
        path = folder / "Config_1" / "transmission_field1_pol2.txt"
        path.write_text(path.read_text(encoding="latin-1")[:700], encoding="latin-1")
    assert zemax.main([str(folder), "-o", str(tmp_path / "design.fits"), *words]) == 1
    assert capsys.readouterr().err.startswith("zemax.py: error: ")
    assert [entry.name for entry in tmp_path.iterdir()] == ["exports"]
