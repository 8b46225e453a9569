"""Descriptions of instruments: the shipped ones against the design, typed by hand; a user's own; one like another."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from own_instrument import OWN

from walop_jax.instruments.description import described, merged, parsed, shipped
from walop_jax.io.errors import DataError
from walop_jax.model.elements.base import Element
from walop_jax.model.elements.simple import Diattenuator
from walop_jax.model.instrument import Instrument, build, nominal_instrument
from walop_jax.model.parameters import leaves, values_of
from walop_jax.model.ray import Ray

# ------------------------------------------------------------------------- the shipped ones, as designed

# Start, standard deviation of what is built, unit: the nominal WALOP-South.
SOUTH = {
    "sky.depolarisation": (0.8, None, ""),
    "collimator.diattenuation": (0.012, 0.003, "deg-2"),
    "collimator.q": (0.0, 0.0015, ""),
    "collimator.u": (0.0, 0.0015, ""),
    "chwp.quartz": (2407.0, 1.0, "um"),
    "chwp.mgf2": (1930.0, 1.0, "um"),
    "pupil.magnification": (15.63, 0.05, ""),
    "pupil.distortion": (0.02, 0.01, "deg-2"),
    "half1.wedge": (-0.230, 0.001, "rad"),
    "half1.plate.quartz": (2407.0, 1.0, "um"),
    "half1.plate.mgf2": (1930.0, 1.0, "um"),
    "half1.efficiency": (0.999, 0.0003, ""),
    "half2.wedge": (0.230, 0.001, "rad"),
    "half2.plate.quartz": (2407.0, 1.0, "um"),
    "half2.plate.mgf2": (1930.0, 1.0, "um"),
    "half2.efficiency": (0.999, 0.0003, ""),
}
QUARTZ = 582.484539824296  # µm: with 474 µm of MgF2 half a wave at 0.62 µm
LAB = SOUTH | {
    "collimator.diattenuation": (0.0, 6.75e-7, "deg-2"),
    "pupil.magnification": (1.0, 0.05, ""),
    "pupil.distortion": (0.0, 2.25e-6, "deg-2"),
    **{f"half{h}.wedge": (0.0, 0.001, "rad") for h in (1, 2)},
    **{f"{p}.quartz": (QUARTZ, 1.0, "um") for p in ("chwp", "half1.plate", "half2.plate")},
    **{f"{p}.mgf2": (474.0, 1.0, "um") for p in ("chwp", "half1.plate", "half2.plate")},
}
DESIGNS = {"WALOP-SOUTH": SOUTH, "WALOP-LAB": LAB}
SHIPPED = ("WALOP-LAB", "WALOP-NORTH", "WALOP-SOUTH")
SITES = {
    "WALOP-SOUTH": (-32.3795, 20.8107, 1798.0),
    "WALOP-NORTH": (35.2120, 24.8982, 1750.0),
    "WALOP-LAB": (18.5590, 73.8250, 560.0),
}


def table(instrument: Instrument) -> dict[str, tuple[float, float | None, str]]:
    """Start, width of the prior and unit of every parameter."""
    values = np.asarray(values_of(instrument))
    return {
        leaf.name: (float(value), leaf.width, leaf.unit)
        for leaf, value in zip(leaves(instrument), values, strict=True)
    }


def test_these_are_shipped():
    assert shipped() == SHIPPED


@pytest.mark.parametrize("name", DESIGNS)
def test_parameters_are_those_of_the_design(name):
    """Every parameter but the throughput, in any order; the throughput is a series of degree 4 about 0.5, no prior."""
    found = table(nominal_instrument(name))
    series = {key: found.pop(key) for key in [*found] if key.startswith("throughput.")}
    assert found == DESIGNS[name]
    assert len(series) == 4 * 15
    for key, entry in series.items():
        assert entry == (0.5 if key.endswith(".p00") else 0.0, None, "")


@pytest.mark.parametrize("name", DESIGNS)
def test_what_is_fixed_is_that_of_the_design(name):
    instrument = nominal_instrument(name)
    assert instrument.path == ("polariser", "collimator", "pupil", "chwp")
    assert [arm.path for arm in instrument.arms] == [("wedge", "plate", "analyser")] * 2
    assert instrument.cameras.names == ("O1", "E1", "O2", "E2")
    assert instrument.cameras.pairs == ((0, 1), (2, 3))
    assert instrument.polariser is not None
    assert float(instrument.polariser.extinction) == 2e-5
    plates = [e for part in (instrument, *instrument.arms) for e in part.elements if e.kind == "wave_plate"]
    assert [float(plate.axis) for plate in plates] == [0.0, 0.0, 22.5]
    for plate in plates:
        assert [(layer.material, float(layer.axis)) for layer in plate.layers] == [
            ("quartz", 0),
            ("mgf2", 90),
        ]
        assert plate.model == "waves"
    assert instrument.moving() == ("CHWP",)
    assert described(name).place[1:4] == SITES[name]


def test_sources_of_the_numbers_are_said():
    for name in SHIPPED:
        assert all(leaf.source for leaf in leaves(nominal_instrument(name)))
        assert all(leaf.about for leaf in leaves(nominal_instrument(name)))


def test_names_of_the_family_stay_where_more_are_known():
    """WALOP-NORTH has every parameter of WALOP-SOUTH, its columns, cameras and place."""
    north, south = nominal_instrument("WALOP-NORTH"), nominal_instrument("WALOP-SOUTH")
    assert set(table(south)) < set(table(north))
    assert north.moving() == south.moving()
    assert (north.cameras.names, north.cameras.pairs) == (south.cameras.names, south.cameras.pairs)
    assert described("WALOP-NORTH").place[1:4] == SITES["WALOP-NORTH"]


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_name_may_be_written_small(name):
    assert Instrument.read(name.lower()).name == name


# ----------------------------------------------------------------------------------------- a user's own


@pytest.fixture
def own(tmp_path: Path):
    """A function that writes a description, with words replaced, and gives its path."""

    def write(*changes: tuple[str, str], text: str = OWN) -> Path:
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / "own.toml"
        path.write_text(text)
        return path

    return write


def test_a_file_of_ones_own(own):
    instrument = Instrument.read(own())
    found = table(instrument)
    assert {name: entry for name, entry in found.items() if not name.startswith("throughput")} == {
        "sky.depolarisation": (0.8, None, ""),
        "polariser.extinction": (1e-4, 2e-5, ""),
        "window.delta": (0.1, 0.02, "rad"),
        "main.plate.first": (51.0, 1.0, "um"),
        "main.plate.second.axis": (90.0, None, "deg"),
        "eta": (0.99, 0.005, ""),
    }
    assert [name for name in found if name.startswith("throughput")] == [
        f"throughput.n{k}.{p}" for k in (0, 1) for p in ("p00", "p10", "p01")
    ]
    assert instrument.moving() == ("WIN",)
    assert instrument.cameras.pairs == ((1, 0),)
    every = {leaf.name: leaf for leaf in leaves(instrument)}
    assert every["window.delta"].source == "a measurement"
    assert every["eta"].source == "description file"
    assert every["main.plate.second.axis"].loose == 2.0
    # P1 of the throughput series is X over the scale of the field.
    basis = instrument.throughput.basis(jnp.asarray(0.05), jnp.asarray(-0.1))
    np.testing.assert_allclose(basis, [1.0, 0.5, -1.0])


class Mirror(Element):
    """An element of a user, with a choice that is no number."""

    kind = "flat_mirror"

    def mueller(self, ray: Ray):
        return jnp.diag(jnp.asarray([1.0, 1.0, -1.0, -1.0]))


def test_elements_of_a_user_are_known_by_their_kind(own):
    path = own(('kind = "retarder"', 'kind = "flat_mirror"'), ('moves = "WIN"\n', ""), (
        'delta = { value = 0.1, sigma = 0.02, unit = "rad", source = "a measurement" }\naxis = 10.0\n', ""
    ))  # fmt: skip
    with pytest.raises(DataError, match="there is no kind of element 'flat_mirror'"):
        Instrument.read(path)
    instrument = Instrument.read(path, elements=[Mirror, Diattenuator])
    assert isinstance(instrument.elements[1], Mirror)


# -------------------------------------------------------------------------------- standing on another one


def test_like_says_only_what_differs(own):
    """Numbers, a field of a number, layers by name, an element more; all else as in WALOP-South."""
    path = own(
        text="""
name = "SOUTH-2"
like = "walop-south"
path = ["polariser", "collimator", "pupil", "derotator", "chwp"]
[elements.pupil]
magnification = { value = 20.0, sigma = 0.5 }
distortion = { sigma = 0.05 }
[elements.collimator]
q = 0.001
[elements.derotator]
kind = "retarder"
moves = "DEROT"
delta = 3.0
[[arms.half2.elements.plate.layers]]
name = "quartz"
thickness = { value = 1200.0, sigma = 2.0 }
[[arms.half2.elements.plate.layers]]
name = "mgf2"
"""
    )
    instrument = Instrument.read(path)
    expected = SOUTH | {
        "pupil.magnification": (20.0, 0.5, ""),
        "pupil.distortion": (0.02, 0.05, "deg-2"),
        "half2.plate.quartz": (1200.0, 2.0, "um"),
    }
    del expected["collimator.q"]  # a fixed number now
    found = {name: entry for name, entry in table(instrument).items() if not name.startswith("throughput")}
    assert found == expected
    assert [float(e.q) for e in instrument.elements if e.name == "collimator"] == [0.001]
    assert instrument.moving() == ("DEROT", "CHWP")


def test_tables_are_merged_key_by_key():
    old = {
        "a": {"b": 1, "c": {"value": 2, "sigma": 3}},
        "l": [{"name": "x", "t": 1}, {"name": "y", "t": 2}],
        "n": 5,
    }
    new = {"a": {"c": {"value": 7}}, "l": [{"name": "x", "t": 9}, {"name": "y"}], "m": 6}
    assert merged(old, new) == {
        "a": {"b": 1, "c": {"value": 7}}, "l": [{"name": "x", "t": 9}, {"name": "y", "t": 2}], "n": 5, "m": 6
    }  # fmt: skip
    # Other layers are another list.
    assert merged(old, {"l": [{"name": "x"}]})["l"] == [{"name": "x"}]


@pytest.mark.parametrize("like", ['"OWN"', '"WALOP-SUOTH"', "5", "[1]"])
def test_like_names_a_shipped_one(own, like):
    with pytest.raises(
        DataError, match=r"own\.toml: like = .* must name a shipped instrument; .*WALOP-SOUTH"
    ):
        Instrument.read(own(('name = "OWN"', f'name = "OWN"\nlike = {like}')))


def test_the_text_of_a_description_gives_its_instrument_again():
    for name in shipped():
        assert table(build(parsed(described(name).text, name))) == table(nominal_instrument(name))


def test_only_an_instrument_that_says_so_is_the_default():
    """A comment is no statement, and an instrument that stands on the default one is another."""
    text = '# not the default\nname = "OTHER"\nlike = "WALOP-SOUTH"\n'
    assert parsed('name = "WALOP-SOUTH"\nlike = "WALOP-SOUTH"\ndefault = true', "a text").default
    assert not parsed(text, "a text").default
    assert described("WALOP-SOUTH").default
