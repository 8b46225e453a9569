"""Wrong descriptions of instruments are refused with their file, table and key, and with what to do."""

from __future__ import annotations

from pathlib import Path

import pytest
from own_instrument import OWN

from walop_jax.instruments.description import parsed, read_description
from walop_jax.io.errors import DataError
from walop_jax.model.instrument import Instrument, build

WINDOW = OWN[OWN.index('kind = "retarder"') : OWN.index("\n[arms.main]\n")]
# What is changed in OWN, and what the message says beside the name of the file: table, key, what to do.
WRONG = {
    "unknown key": (("[field]\n", "[field]\nsize = 3\n"), r"\[field\] there is no key 'size'"),
    "unknown key, nearest": (("[field]\n", "[field]\nlimits = 3\n"),
        r"\[field\] there is no key 'limits'.*limit"),
    "unknown table": (("[site]", "[sites]"), r"there is no key 'sites'.*site"),
    "unknown key of an element": (("delta =", "detla ="), r"\[elements\.window\].*'detla'.*delta"),
    "unknown key of a number": (("sigma = 0.02", "width = 0.02"),
        r"\[elements\.window\.delta\] there is no key 'width'"),
    "unknown key of a layer": (("thickness = 30.0", "thikness = 30.0"),
        r"layers\.second\].*'thikness'.*thickness"),
    "unknown key of an arm": (("[arms.main]\n", "[arms.main]\ncamera = 1\n"),
        r"\[arms\.main\] there is no key 'camera'"),
    "unknown key of cameras": (("[cameras]\n", "[cameras]\nnumber = 2\n"),
        r"\[cameras\] there is no key 'number'"),
    "kind": (('"retarder"', '"retardr"'),
        r"\[elements\.window\] there is no kind of element 'retardr'.*retarder"),
    "no kind": (('kind = "retarder"\n', ""), r"\[elements\.window\] has no kind"),
    "crystal": (('"mgf2"', '"calcite"'),
        r"\[arms\.main\.elements\.plate\.layers\.second\] there is no crystal 'calcite'"),
    "glass": (
        (
            'path = ["plate", "analyser"]',
            'path = ["w", "plate", "analyser"]\n[arms.main.elements.w]\nkind = "wedge"\nmaterial = "SF11"\n',
        ),
        r"\[arms\.main\.elements\.w\] there is no glass 'SF11'.*BK7",
    ),
    "no value": (("{ value = 0.1, sigma", "{ sigma"), r"\[elements\.window\.delta\] has no value"),
    "no thickness": (("thickness = 30.0\n", ""), r"layers\.second\] needs a thickness"),
    "thickness of 0": (("thickness = 30.0", "thickness = 0.0"),
        r"second\] needs a thickness .*; leave a layer of none"),
    "degrees for radians": (('value = 0.1, sigma = 0.02, unit = "rad",', "value = 180.0,"),
        r"\[elements\.window\] delta = 180 rad is 28\.6 waves; in degrees\? write 3\.14159, or set unit"),
    "a unit that can be converted": (
        ('value = 0.1, sigma = 0.02, unit = "rad",', 'value = 180.0, sigma = 9, unit = "deg",'),
        r"not in 'deg'; write value = 3\.14159\d+, sigma = 0\.15707",
    ),
    "a unit that cannot": (('unit = "rad"', 'unit = "mag"'), r"delta is in 'rad', not in 'mag'; convert it"),
    "nm for um": (("axis = 10.0", "axis = 10.0\nwavelength = 550"),
        r"\[elements\.window\] wavelength = 550 um is not light .* in nm\? write 0\.55"),
    "Angstrom for um": ((WINDOW, 'kind = "spectral"\ndelta_at = [4400, 5500]'),
        r"\[elements\.window\] delta_at = 4400 um is not light .* in Angstrom\? write 0\.44"),
    "per cent": (("efficiency = { value = 0.99", "efficiency = { value = 99.8"),
        r"analyser\] efficiency = 99\.8 must be between 0 and 1 \(a fraction, not per cent\)"),
    "no layers": ((WINDOW, 'kind = "wave_plate"'), r"\[elements\.window\] a wave plate needs layers"),
    "sigma of 0": (("sigma = 0.02", "sigma = 0.0"),
        r"\[elements\.window\.delta\] sigma = 0 must be above 0; leave it out"),
    "nan": (("axis = 10.0", "axis = nan"), r"\[elements\.window\] axis = nan must be a finite number"),
    "inf": (("axis = 10.0", "axis = inf"), r"\[elements\.window\] axis = inf must be a finite number"),
    "too large": (("axis = 10.0", f"axis = 1{'0' * 400}"),
        r"\[elements\.window\] axis = that must be a finite number"),
    "far too large": (("axis = 10.0", f"axis = 1{'0' * 5000}"), r"digits"),
    "bool": (("axis = 10.0", "axis = true"), r"\[elements\.window\] axis = True must be a finite number"),
    "text for a number": (("axis = 10.0", 'axis = "10"'),
        r"\[elements\.window\] axis = '10' must be a finite number"),
    "a date": (("axis = 10.0", "axis = 2026-01-01"),
        r"\[elements\.window\] axis = .* must be a finite number"),
    "number for a name": (('"quartz"', "5"), r"layers\.first\] material = 5.* must be a name"),
    "a choice as parameter": (('"quartz"', "{ value = 5, sigma = 1 }"),
        r"layers\.first\] material cannot be a parameter"),
    "path": (('"window"]', '"windw"]'), r"\[elements\] path names 'windw', which is not described.*window"),
    "not in the path": (('"polariser", "window"]', '"polariser"]'),
        r"\[elements\.window\] is described but missing from the path"),
    "path of an arm": (('"plate", "an', '"plat", "an'), r"\[arms\.main\.elements\] path names 'plat'.*plate"),
    "twice in the path": (('"window"]', '"window", "window"]'), r"path names something twice"),
    "no analyser at the end": (('["plate", "analyser"]', '["analyser", "plate"]'),
        r"\[arms\.main\] its path must end with"),
    "camera": (('["right", "left"]', '["right", "lift"]'),
        r"\[arms\.main\] camera 'lift' does not exist.*left"),
    "camera behind no analyser": (('["left", "right"]', '["left", "right", "third"]'),
        r"\[cameras\] every camera must be behind exactly one analyser"),
    "one camera of two": (('cameras = ["right", "left"]\n', 'cameras = ["right"]\n'),
        r"\[cameras\] every camera must be behind exactly one analyser"),
    "no cameras": (('cameras = ["right", "left"]\n', ""), r"\[arms\.main\] .* two cameras"),
    "cameras as text": (('cameras = ["right", "left"]', 'cameras = "right"'),
        r"analyser\] cameras = 'right' must be a list"),
    "no name": (('name = "OWN"\n', ""), r"name is missing; walop-jax docs"),
    "empty name": (('name = "OWN"', 'name = " "'), r"name = ' ' must be a text"),
    "no arms": ((OWN[OWN.index("[arms.main]") :], "[arms]\n"), r"\[arms\] needs one arm"),
    "arms not a table": ((OWN[OWN.index("[arms.main]") :], ""), r"arms is missing"),
    "degree": (("degree = 1", "degree = 1.5"), r"\[throughput\] degree = 1\.5 must be a whole number"),
    "level": (("level = 0.4", "level = 0"), r"\[throughput\] level = 0 must be above 0"),
    "scale of the field": (("scale = 0.1", "scale = -0.1"), r"\[field\] scale = -0\.1 must be above 0"),
    "latitude": (("latitude = 50.0", "latitude = 150.0"), r"\[site\] latitude = 150 must be between"),
    "columns of a polariser": (('moves = "CLP"', 'moves = "POL"'),
        r"\[elements\.polariser\] moves = 'POL': .* CLP"),
    "columns": (('moves = "WIN"', 'moves = "win"'),
        r"\[elements\.window\] moves = 'win' cannot begin the names of columns"),
    "what cannot turn": ((WINDOW, 'kind = "depolariser"\nmoves = "WIN"'),
        r"\[elements\.window\] moves, but an element of kind 'depolariser' has no axis that could turn"),
    "what bends the ray": ((WINDOW, 'kind = "wedge"\nmoves = "WIN"'),
        r"\[elements\.window\] moves, but .* 'wedge' has no axis"),
    "moving analyser": (('kind = "analyser"', 'kind = "analyser"\nmoves = "WOL"'),
        r"analyser\] an analyser does not move"),
    "analyser ahead of the arms": ((WINDOW, 'kind = "analyser"'),
        r"\[elements\.window\] an analyser ends an arm"),
    "two polarisers": ((WINDOW, 'kind = "polariser"'), r"\[elements\.window\] is a second polariser"),
    "polariser in an arm": (
        (
            '["plate", "analyser"]',
            '["pol", "plate", "analyser"]\n[arms.main.elements.pol]\nkind = "polariser"\n',
        ),
        r"\[arms\.main\.elements\.pol\] a polariser must be ahead of the arms",
    ),
    "names of two parameters": (('name = "eta"', 'name = "window.delta"'),
        r"2 parameters have the name 'window\.delta'"),
    "names of two parts": (('"window"]', '"window", "main"]\n[elements.main]\nkind = "depolariser"'),
        r"\[main\] more than one part"),
    "name of a source": (('"window"]', '"window", "sky"]\n[elements.sky]\nkind = "depolariser"'),
        r"\[sky\] more than one part"),
    "name with a dot": (('"window"]', '"window", "a.b"]\n[elements."a.b"]\nkind = "depolariser"'),
        r"'a\.b' cannot be a name: letters"),
    "layers twice": (('name = "second"', 'name = "first"'), r"layers names something twice: first, first"),
    "layers of an element without": (('kind = "wave_plate"\naxis = 5.0', 'kind = "depolariser"'),
        r"\[arms\.main\.elements\.plate\] an element of kind 'depolariser' has no layers"),
    "not TOML": (("[site]", "[site"), r"not valid TOML"),
    "deep nesting": (("axis = 10.0", f"axis = {'[' * 5000}{']' * 5000}"), r"nested too deep"),
    "control characters": (('about = "One arm"', 'about = "One\\u0007arm"'), r"about = .* must be a text"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused_with_its_place(tmp_path: Path, case):
    (old, new), message = WRONG[case]
    assert old in OWN
    path = tmp_path / "own.toml"
    path.write_text(OWN.replace(old, new, 1))
    with pytest.raises(DataError, match=message) as caught:
        Instrument.read(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert text.count(str(path)) == 1
    assert "\n" not in text


@pytest.mark.parametrize(
    ("edge", "what"),
    [
        ("edge = 5.0",
         r"\[elements\.collimator\] diattenuation may be 1\.05 at the edge of the field \(7\.07 deg"),
        ("edge = 2.0",
         r"\[elements\.pupil\] distortion may be 0\.4 .* below 0\.042 deg-2, or a smaller field"),
        ("edge = 1.8\nraster = 'line'\n[elements.pupil]\nmagnification = 50.0",
         "magnification = 50 turns .* by 105"),
    ],
)  # fmt: skip
def test_numbers_that_the_field_is_too_wide_for(edge: str, what: str):
    """Of an instrument like another: 0.012 ± 0.003 of light, 0.02 ± 0.01 of the angle, for each deg²."""
    with pytest.raises(DataError, match=what):
        build(parsed(f'name = "WIDE"\nlike = "WALOP-SOUTH"\n[field]\n{edge}\n', "a text"))


def test_a_file_that_cannot_be_read(tmp_path: Path):
    path = tmp_path / "own.toml"
    with pytest.raises(DataError, match=r"own\.toml: there is no such file; check the name"):
        read_description(path)
    path.write_bytes(OWN.encode("utf-16"))
    with pytest.raises(DataError, match=r"own\.toml: is not text in UTF-8"):
        read_description(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match=r"own\.toml: is not text in UTF-8"):
        read_description(path)
    with pytest.raises(DataError, match="is a folder"):
        read_description(tmp_path)


def test_an_unknown_name_lists_the_nearest():
    with pytest.raises(
        DataError, match=r"there is no instrument 'WALOP-SUOTH'; .*WALOP-SOUTH.*or give a description"
    ):
        Instrument.read("WALOP-SUOTH")
