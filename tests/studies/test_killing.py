"""The study of kills sees what a careless writer leaves, and nothing wrong in a careful one."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from kills import Study, _hook, full, states

from walop_jax.io.folder import output_folder

sys.addaudithook(_hook)


class Careful(Study):
    """Two files of a number each, put there at once."""

    def __init__(self, folder: Path) -> None:
        self.command, self.outputs = "nothing", ("a.txt", "b.txt")
        self.prepare(folder)

    def do(self, number: int = 1) -> None:
        with output_folder(self.run, self.outputs, overwrite=True) as out, out.filled() as folder:
            for name in self.outputs:
                (folder / name).write_text(f"{number}" * 3000)


class Careless(Careful):
    """The same, one after the other."""

    def do(self, number: int = 1) -> None:
        self.run.mkdir(exist_ok=True)
        for name in self.outputs:
            (self.run / name).write_text(f"{number}" * 3000)


def test_a_folder_of_results_is_whole_at_every_state_of_the_disk(tmp_path):
    study = Careful(tmp_path)
    number, wrong = states(study, 100)
    assert number >= 4
    assert wrong == []
    assert full(study, 6) == (6, [])  # all of them below the size of the files


@pytest.mark.parametrize("how", [lambda s: states(s, 100), lambda s: full(s, 6)], ids=["states", "full"])
def test_a_careless_writer_is_found_out(tmp_path, how):
    _, wrong = how(Careless(tmp_path))
    assert any("is of no run" in text or "mixed" in text for text in wrong)
