"""Effects and kinds of elements of one's own: what is misspelt is named, what is saved can be read."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from one_arm import POLARISER, one_arm

import walop_jax as walop
from walop_jax.diagnosis.hypotheses import applicable
from walop_jax.model.effects.base import Effect
from walop_jax.model.effects.catalogue import EFFECTS, own_entries
from walop_jax.model.instrument import nominal_instrument
from walop_jax.model.parameters import param

BAD = """
[bad]
about = "Axis of a plate that is not there"
source = "a slip of the pen"
revealed_by = "nothing"
separated_by = "nothing"
angle = { does = "axis of half2.plat", unit = "deg", width = 0.5, about = "turn" }
"""
ELEMENT = '''
from typing import ClassVar

import jax
import jax.numpy as jnp

from walop_jax.model.elements.base import Element
from walop_jax.model.parameters import number


class Grey(Element):
    """A share of the linear polarisation is lost."""

    loss: jax.Array = number(unit="", about="share lost")
    kind: ClassVar[str] = "grey_depolariser"

    def mueller(self, ray):
        kept = 1.0 - self.loss * jnp.ones_like(ray.wavelength)
        return jax.vmap(jnp.diag)(jnp.stack([jnp.ones_like(kept), kept, kept, jnp.ones_like(kept)], axis=-1))
'''
GREY = """
[elements.grey]
kind = "grey_depolariser"
loss = { value = 0.3, sigma = 0.02, unit = "", source = "a measurement" }
"""
THREE = one_arm(
    "THREE", ["polariser", "grey"], POLARISER + GREY, field="limit = 0.2\nscale = 0.1", cameras=("left", "right"),
    degree=1,
)  # fmt: skip
PLAN = 'instrument = "three.toml"\ngrid = 2\npolariser_angles = 6\nmoon_patches = 0\nstandards = 0\n'
ALONE = """
from typer.testing import CliRunner

import walop_jax as walop
from walop_jax.commands.program import app

held = walop.read("RUN").calibration
print("unavailable|", held.unavailable)
try:
    held.matrix(0.0, 0.0)
except walop.DataError as error:
    print("matrix|", error)
for line in (
    ["matrix", "RUN", "--points", "p.csv", "-o", "alone.fits"],
    ["apply", "RUN", "p.csv", "-o", "stars.fits"],
    ["check", "RUN"],
):
    done = CliRunner().invoke(app, line)
    told = done.stderr if done.exit_code == 1 else done.stdout
    print(done.exit_code, told.splitlines()[0], sep="|")
print(walop.Calibration.read("RUN", elements="grey.py")["grey.loss"].value)
"""
MISSPELT = "no part 'half2.plat'; did you mean 'plate'"


class Misspelt(Effect):
    """Acts on a plate that is not there."""

    angle: float = param(unit="deg", about="turn", source="a slip of the pen", width=0.5, default=0.0)
    name = "misspelt"

    def patch(self, instrument):
        return instrument.changed("half2.plat", axis=lambda axis: axis + self.angle)


@pytest.fixture
def bad(tmp_path: Path) -> Path:
    path = tmp_path / "bad.toml"
    path.write_text(BAD)
    return path


def test_a_misspelt_place_of_ones_own_effect_is_named(bad: Path):
    """It was taken for an effect that this instrument has no place for, and dropped."""
    instrument, context = nominal_instrument(), walop.ObservingPlan(grid=2).context()
    for kind in (Misspelt, *own_entries(bad)):
        with pytest.raises(ValueError, match=f"effect '{kind.name}': .*{MISSPELT}"):
            applicable((*EFFECTS, kind), context, instrument)


def test_effects_of_the_package_without_their_place_are_left_out():
    north = nominal_instrument("WALOP-LAB")
    kept = applicable(EFFECTS, walop.ObservingPlan("WALOP-LAB", grid=2).context(), north)
    assert 0 < len(kept) < len(EFFECTS)


@pytest.mark.parametrize("command", ["diagnose", "limits"])
def test_commands_say_so(command: str, bad: Path, call, calset_file: Path, tmp_path: Path):
    done = call(command, calset_file, "--effects", bad, "-o", tmp_path / "out")
    assert done.exit_code == 1
    assert MISSPELT in done.stderr


@pytest.fixture
def own(tmp_path: Path, monkeypatch) -> Path:
    """A folder with an instrument that holds an element of a class of one's own, and the file of that class."""
    monkeypatch.chdir(tmp_path)
    for name, text in {
        "grey.py": ELEMENT,
        "three.toml": THREE,
        "plan.toml": PLAN,
        "p.csv": "X,Y\n0,0\n",
    }.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def test_what_is_fitted_with_an_element_of_ones_own_is_read(own: Path, call):
    """Saved without a word, it could not be read by anything."""
    with_class = ("--elements", "grey.py")
    assert "Three" not in call("instrument", "three.toml", *with_class).stderr
    done = call("simulate", "plan.toml", "-o", "set.fits", *with_class)
    assert done.exit_code == 0, done.output
    done = call("refit", "set.fits", "--instrument", "three.toml", "-o", "RUN", *with_class)
    assert done.exit_code == 0, done.output
    apply = "walop-jax apply RUN STARS.fits -o OUT.fits --elements grey.py"
    assert f"Next: walop-jax report RUN --elements grey.py or {apply}" in done.stderr
    held = walop.read("RUN", elements="grey.py").calibration
    assert held is not None
    assert held["grey.loss"].value == pytest.approx(0.3, abs=0.1)
    assert held.design.description.count("# element grey_depolariser: class Grey of grey.py") == 1
    for line in (
        ("matrix", "RUN", "--points", "p.csv", "-o", "m.fits"),
        ("trace", "RUN", "--x", 0.1),
        ("check", "RUN"),
        ("report", "RUN"),
        ("cite", "RUN"),
    ):
        done = call(*line, *with_class)
        assert done.exit_code == 0, f"{line}: {done.output}"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    told = subprocess.run(
        [sys.executable, "-c", ALONE], capture_output=True, text=True, env=environment, check=True
    )
    *said, value = told.stdout.splitlines()
    assert [line.split("|")[0] for line in said] == ["unavailable", "matrix", "1", "1", "3"]
    for line in said:
        assert "there is no kind of element 'grey_depolariser'" in line
        assert "It is class Grey of grey.py: give --elements FILE.py, in Python elements=[CLASS]" in line
    np.testing.assert_allclose(float(value), held["grey.loss"].value, rtol=1e-12)


def test_a_file_without_elements_is_refused(call, tmp_path: Path):
    (tmp_path / "none.py").write_text("x = 1\n")
    done = call("cite", "--elements", tmp_path / "none.py")
    assert "none.py: defines no kind of element; give a Python file" in done.stderr
    with pytest.raises(TypeError, match="is no class of elements"):
        walop.read("RUN", elements=[int])
