"""Folders of results: all files or none."""

from __future__ import annotations

import os

import pytest

from walop_jax.data import DataError
from walop_jax.io.folder import atomic_folder, check_folder

NAMES = ("a.txt", "b.txt")


def fill(path, text="new", **options):
    with atomic_folder(path, NAMES, **options) as folder:
        for name in NAMES:
            (folder / name).write_text(text)


def left(path):
    return sorted(str(entry.relative_to(path)) for entry in path.rglob("*"))


def test_a_new_folder_appears_whole(tmp_path):
    fill(tmp_path / "run")
    assert left(tmp_path) == ["run", "run/a.txt", "run/b.txt"]
    assert (tmp_path / "run").stat().st_mode & 0o700 == 0o700


def test_an_empty_folder_and_one_with_other_files_are_filled(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "notes.txt").write_text("mine")
    fill(tmp_path / "run")
    assert left(tmp_path / "run") == ["a.txt", "b.txt", "notes.txt"]


def test_results_are_not_replaced_unasked(tmp_path):
    fill(tmp_path / "run", "old")
    with pytest.raises(DataError, match=r"holds a\.txt already"):
        fill(tmp_path / "run")
    assert (tmp_path / "run" / "b.txt").read_text() == "old"
    fill(tmp_path / "run", overwrite=True)
    assert (tmp_path / "run" / "b.txt").read_text() == "new"
    assert left(tmp_path / "run") == ["a.txt", "b.txt"]


@pytest.mark.parametrize("existing", [False, True])
def test_an_interrupt_leaves_nothing(tmp_path, existing):
    if existing:
        fill(tmp_path / "run", "old")

    def interrupted():
        with atomic_folder(tmp_path / "run", NAMES, overwrite=True) as folder:
            (folder / "a.txt").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert left(tmp_path) == (["run", "run/a.txt", "run/b.txt"] if existing else [])
    if existing:
        assert (tmp_path / "run" / "a.txt").read_text() == "old"


def test_a_file_that_was_forgotten_stops_all(tmp_path):
    with (
        pytest.raises(DataError, match=r"b\.txt was not written"),
        atomic_folder(tmp_path / "run", NAMES) as folder,
    ):
        (folder / "a.txt").write_text("one")
    assert left(tmp_path) == []


def test_places_that_cannot_be(tmp_path):
    with pytest.raises(DataError, match="does not exist"):
        check_folder(tmp_path / "none" / "run")
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="is a file"):
        check_folder(tmp_path / "file")


def test_a_read_only_folder_is_refused(tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    monkeypatch.setattr(os, "access", lambda *args: False)  # root may write everywhere
    for path in (tmp_path / "run", tmp_path / "new"):
        with pytest.raises(DataError, match="read-only"):
            check_folder(path)
