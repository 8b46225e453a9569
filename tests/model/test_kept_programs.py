"""Traced programs on disk: the same results, nothing of what they were not traced for, nothing of a user's classes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import walop_jax
from walop_jax.model import compiled as kept
from walop_jax.model.compiled import compiled
from walop_jax.model.effects import Context, Described, Effect
from walop_jax.model.effects.base import Scalar
from walop_jax.model.parameters import param


@pytest.fixture
def programs(tmp_path, monkeypatch) -> Path:
    """A cache folder in which programs are kept."""
    before = jax.config.jax_compilation_cache_dir
    (tmp_path / kept.FOLDER).mkdir()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path / kept.FOLDER
    jax.config.update("jax_compilation_cache_dir", before)


def double(tree):
    """Twice every number, and a number that depends on what is no number."""
    return {
        "twice": jax.tree.map(lambda leaf: 2.0 * jnp.asarray(leaf), tree),
        "arcs": jnp.sin(jnp.arange(3.0)),
    }


def untraceable(tree):
    raise AssertionError("traced")


def test_a_second_process_need_not_trace(programs):
    """The same name and arguments, another wrapper, a function that cannot be traced."""
    tree = {"a": np.arange(4.0), "b": (1.5, jnp.ones((2, 3)))}
    first = compiled(double, kept_as="double")(tree)
    assert len(list(programs.iterdir())) == 1
    again = compiled(untraceable, kept_as="double")(tree)
    direct = double(tree)
    assert jax.tree.structure(first) == jax.tree.structure(again) == jax.tree.structure(direct)
    for one, two, three in zip(*map(jax.tree.leaves, (first, again, direct)), strict=True):
        np.testing.assert_array_equal(one, two)
        np.testing.assert_allclose(one, three, rtol=1e-15)


@pytest.mark.parametrize(
    "other",
    [
        {"a": np.arange(5.0), "b": 1.0},
        {"a": np.arange(4), "b": 1.0},
        {"a": np.arange(4.0), "c": 1.0},
        {"a": np.arange(4.0), "b": np.float64(1.0)},
    ],
    ids=["shape", "type", "structure", "weak type"],
)
def test_other_arguments_are_another_program(programs, other):
    compiled(double, kept_as="double")({"a": np.arange(4.0), "b": 1.0})
    with pytest.raises(AssertionError, match="traced"):
        compiled(untraceable, kept_as="double")(other)


def test_what_is_no_number_is_part_of_the_key(programs):
    """The choices of an effect are not numbers: another choice is another program."""
    run = compiled(double, kept_as="double")
    one, same, other = (
        Described.of(Context(), sentences=(f"axis of {plate}.plate",))
        for plate in ("half1", "half1", "half2")
    )
    run(one)
    compiled(untraceable, kept_as="double")(same)
    with pytest.raises(AssertionError, match="traced"):
        compiled(untraceable, kept_as="double")(other)


class Own(Effect):
    """An effect of somebody's own: its source is not that of the package."""

    size: Scalar = param(unit="", about="", source="", width=1.0, default=0.0)
    name: ClassVar[str] = "own_of_test"

    def patch(self, instrument):
        return instrument


def test_classes_of_others_are_not_kept(programs):
    found = compiled(double, kept_as="double")((Own(size=jnp.asarray(1.0)),))
    assert float(found["twice"][0].size) == 2.0
    assert not list(programs.iterdir())


def test_a_damaged_program_is_made_again(programs):
    compiled(double, kept_as="double")(1.0)
    (file,) = programs.iterdir()
    content = bytearray(file.read_bytes())
    content[100] ^= 1
    file.write_bytes(content)
    with pytest.raises(AssertionError, match="traced"):
        compiled(untraceable, kept_as="double")(1.0)
    assert float(compiled(double, kept_as="double")(1.0)["twice"]) == 2.0
    compiled(untraceable, kept_as="double")(1.0)


def test_source_that_was_changed_since_is_not_trusted(programs, monkeypatch):
    monkeypatch.setattr(kept, "_STARTED", 0.0)
    kept._source.cache_clear()
    compiled(double, kept_as="double")(1.0)
    assert not list(programs.iterdir())
    monkeypatch.undo()
    kept._source.cache_clear()


def test_without_the_folder_nothing_is_kept(tmp_path):
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    compiled(double, kept_as="double")(1.0)
    jax.config.update("jax_compilation_cache_dir", before)
    assert not list(tmp_path.rglob(kept.FOLDER))


def test_every_program_has_a_name_of_its_own():
    root = Path(walop_jax.__file__).parent
    names = [n for path in root.rglob("*.py") for n in re.findall(r'kept_as="(\w+)"', path.read_text())]
    assert len(names) > 10
    assert len(set(names)) == len(names)
