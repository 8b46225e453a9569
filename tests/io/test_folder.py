"""Folders of results: all files or none."""

from __future__ import annotations

import errno
import os
import random
import signal
import subprocess
import sys
import textwrap
import time

import pytest

from walop_jax.io.errors import DataError
from walop_jax.io.folder import check_folder, output_folder

NAMES = ("a.txt", "b.txt")


def fill(path, text="new", **options):
    with output_folder(path, NAMES, **options) as out, out.filled() as folder:
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
        with output_folder(tmp_path / "run", NAMES, overwrite=True) as out, out.filled() as folder:
            (folder / "a.txt").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert left(tmp_path) == (["run", "run/a.txt", "run/b.txt"] if existing else [])
    if existing:
        assert (tmp_path / "run" / "a.txt").read_text() == "old"


def test_a_file_that_was_forgotten_costs_no_other(tmp_path):
    """The check of the outputs came before they were put in place, and threw all of them away."""
    with (
        pytest.raises(DataError, match=r"b\.txt was not written"),
        output_folder(tmp_path / "run", NAMES) as out,
        out.filled() as folder,
    ):
        (folder / "a.txt").write_text("one")
    assert left(tmp_path) == ["run", "run/a.txt"]


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


# ---- one writer at a time, and one set of results at any moment ----

WRITER = textwrap.dedent(
    """
    import sys
    from walop_jax.io.folder import output_folder

    for number in range(100000):
        with output_folder(sys.argv[1], ("a.txt", "b.txt"), overwrite=True) as out:
            with out.filled(drop=("partial",)) as folder:
                (folder / "a.txt").write_text(f"{sys.argv[2]} {number}")
                (folder / "b.txt").write_text(f"{sys.argv[2]} {number}")
        print(number, flush=True)
    """
)


def start(path, name):
    """Another process that writes the folder again and again; it has begun when this returns."""
    command = [sys.executable, "-c", WRITER, str(path), name]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    writer.stdout.readline()
    return writer


def consistent(path):
    """Files of one run, the first of them always; what else the folder holds is there too."""
    second = path / "b.txt"
    assert (path / "a.txt").read_text() == (second if second.exists() else path / "a.txt").read_text()
    assert (path / "notes" / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize("kills", [4, pytest.param(200, marks=pytest.mark.long)])
def test_kills_leave_results_of_one_run_and_the_next_one_cleans_up(tmp_path, kills):
    run, draw = tmp_path / "run", random.Random(1)
    (run / "notes").mkdir(parents=True)
    (run / "notes" / "mine.txt").write_text("mine")
    for _ in range(kills):
        writer = start(run, "one")
        time.sleep(draw.uniform(0.0, 0.03))
        writer.kill()
        writer.communicate()
        consistent(run)
        fill(run, "again", overwrite=True)
        consistent(run)
        assert left(tmp_path) == ["run", "run/a.txt", "run/b.txt", "run/notes", "run/notes/mine.txt"]


def test_the_second_of_two_writers_is_told_who_the_first_is(tmp_path):
    run = tmp_path / "run"
    with output_folder(run, NAMES) as out:
        with pytest.raises(
            DataError, match=rf"run: is being written by process {os.getpid()} on .* since 20"
        ):
            fill(run)
        with output_folder(tmp_path / "other", NAMES), out.filled() as folder:
            for name in NAMES:
                (folder / name).write_text("first")
    fill(run, "second", overwrite=True)
    assert left(tmp_path) == ["run", "run/a.txt", "run/b.txt"]


@pytest.mark.parametrize("races", [2, pytest.param(100, marks=pytest.mark.long)])
def test_races_end_with_one_winner_and_errors_for_the_others(tmp_path, races):
    run = tmp_path / "run"
    (run / "notes").mkdir(parents=True)
    (run / "notes" / "mine.txt").write_text("mine")
    for _ in range(races):
        writers = [start(run, name) for name in ("one", "two", "three")]
        time.sleep(0.05)
        for writer in writers:
            writer.send_signal(signal.SIGKILL)
            error = writer.communicate()[1]
            assert not error or "is being written by" in error or "meanwhile" in error
        consistent(run)


@pytest.mark.parametrize("place", ["usual", "current", "read-only parent"])
@pytest.mark.parametrize("moved", [0, 1])
def test_a_disk_that_fails_on_the_way_mixes_nothing(tmp_path, monkeypatch, place, moved):
    run = tmp_path / "run"
    fill(run, "old")
    number = run.stat().st_ino
    if place == "current":
        monkeypatch.chdir(run)
    elif place == "read-only parent":
        access = os.access
        monkeypatch.setattr(
            os, "access", lambda path, mode: access(path, mode) and str(path) != str(tmp_path)
        )
    placed, replace = [], os.replace

    def some(source, target):
        if len(placed) == moved:
            raise OSError(errno.EIO, "the disk is gone")
        placed.append(target)
        replace(source, target)

    monkeypatch.setattr(os, "replace", some)
    with pytest.raises(DataError, match="writing failed: the disk is gone"):
        fill(run, "new", overwrite=True)
    # b.txt of old is gone, a.txt always there.
    assert {path.name: path.read_text() for path in run.iterdir()} == {"a.txt": ("old", "new")[moved]}
    monkeypatch.setattr(os, "replace", replace)
    fill(run, "new", overwrite=True)
    assert run.stat().st_ino == number
    assert left(tmp_path) == ["run", "run/a.txt", "run/b.txt"]


def test_links_and_permissions_of_a_folder_stay(tmp_path):
    fill(tmp_path / "run", "old")
    (tmp_path / "run").chmod(0o750)
    (tmp_path / "run" / "b.txt").chmod(0o640)
    (tmp_path / "run" / "link").symlink_to("nowhere")
    (tmp_path / "latest").symlink_to("run")
    fill(tmp_path / "latest", "new", overwrite=True)
    assert (tmp_path / "latest").is_symlink()
    assert (tmp_path / "run" / "a.txt").read_text() == "new"
    assert (tmp_path / "run" / "link").is_symlink()
    assert (tmp_path / "run").stat().st_mode & 0o777 == 0o750
    assert (tmp_path / "run" / "b.txt").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("kind", [DataError, OSError])
def test_temporary_names_are_never_in_messages(tmp_path, kind):
    run = tmp_path / "run"
    fill(run, "old")

    def failing():
        with output_folder(run, NAMES, overwrite=True) as out, out.filled() as folder:
            path = folder / "a.txt"
            raise (
                DataError(f"{path}: cannot be")
                if kind is DataError
                else OSError(28, "No space left", str(path))
            )

    with pytest.raises(DataError) as caught:
        failing()
    assert ".walop" not in str(caught.value)
    assert str(run) in str(caught.value)
    assert left(tmp_path) == ["run", "run/a.txt", "run/b.txt"]


def test_a_full_disk_does_not_keep_the_lock_waiting(tmp_path, monkeypatch):
    """Not even the name of the holder can be written: the folder is reserved all the same, at once."""

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def late(*_):
        raise AssertionError("still waiting")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(10)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", full)
            with output_folder(tmp_path / "run", NAMES) as out:
                assert out.target == tmp_path / "run"
                with pytest.raises(DataError, match="is being written by another process"):
                    fill(tmp_path / "run")
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    assert left(tmp_path) == []
