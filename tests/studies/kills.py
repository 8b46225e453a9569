"""Whole commands that are killed, run side by side, or find the disk full.

    python tests/studies/kills.py [--commands refit sample …] [--states 200] [--full 60] [--kills 0] [--races 0]

states   A command runs once, and at every operation on files (audit hooks of Python) what lies on the disk is copied.
         Each different state is what a kill at that moment leaves behind: its results must be of the run before or
         of the new one, all of them or a part, and the next run must succeed on it with the result of an undisturbed
         run and leave nothing else behind. (`diagnose` is run again on the states whose results differ; its next run is
         a fit.)
full     The same with a limit on the size of files (RLIMIT_FSIZE), which writing meets at every possible place.
kills    Commands in processes of their own, killed (SIGKILL) after a random time.
races    Two processes with the same output at the same time.

Counted are runs, states, and what was wrong; the exit status is 1 if anything was.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from commands.conftest import content  # noqa: E402
from small_run import SEED, SMALL  # noqa: E402
from study_options import options_of  # noqa: E402

sampling = importlib.import_module("walop_jax.commands.sample")
diagnosing = importlib.import_module("walop_jax.commands.diagnose")
from walop_jax.commands.diagnose import diagnose  # noqa: E402
from walop_jax.commands.refit import refit  # noqa: E402
from walop_jax.commands.sample import sample  # noqa: E402
from walop_jax.data.write import write_calibration_set  # noqa: E402
from walop_jax.io.errors import DataError  # noqa: E402
from walop_jax.model.compiled import switch_on  # noqa: E402
from walop_jax.simulation.simulate import simulate  # noqa: E402

DEAD = 4194303  # no process has this number
COMMANDS = ("refit", "sample", "diagnose")
OUTPUTS = {
    "refit": ("calibration.fits", "summary.json"),
    "sample": sampling.OUTPUTS,
    "diagnose": diagnosing.OUTPUTS,
}
EVENTS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.truncate", "os.chmod")
LINES = {
    "refit": ("refit", "{set}", "-o", "{run}", "--overwrite"),
    "sample": ("sample", "{run}", "--overwrite", "--interval", "50", "--maximum-steps", "100", "--moves", "laplace"),
    "diagnose": ("diagnose", "{set}", "-o", "{run}", "--overwrite", "--minutes", "0"),
}  # fmt: skip


class Study:
    """A folder with two sets, a run of the first, and the commands on the second."""

    def __init__(self, folder: Path, command: str) -> None:
        self.command, self.outputs = command, OUTPUTS[command]
        self.sets = [folder / f"set{n}.fits" for n in range(2)]
        for seed, path in enumerate(self.sets, SEED):
            write_calibration_set(path, simulate(SMALL, seed=seed).calset)
        self.prepare(folder)

    def prepare(self, folder: Path) -> None:
        """Run with the first input and with the second, and keep what lies there after each."""
        self.folder, self.here = folder, folder / "here"
        self.here.mkdir()
        self.run = self.here / "RUN"
        if self.command == "sample":
            refit(self.sets[1], output=self.run)
        self.do(0)
        self.before = folder / "before"
        shutil.copytree(self.here, self.before)
        self.do(1)
        self.after = folder / "after"
        shutil.copytree(self.here, self.after)

    def do(self, number: int = 1) -> None:
        """The command with its first or second input, over what is there."""
        if self.command == "refit":
            refit(self.sets[number], output=self.run, overwrite=True)
        elif self.command == "sample":
            sample(self.run, interval=50, maximum_steps=100, moves="laplace", seed=number, overwrite=True)
        else:
            diagnose(self.sets[number], output=self.run, overwrite=True, minutes=0.0)

    def put(self, state: Path) -> None:
        """Bring a state of the disk back."""
        shutil.rmtree(self.here)
        shutil.copytree(state, self.here, symlinks=True)

    def mixed(self) -> str:
        """What is wrong with the results that lie there: they must be of one run, those that are there."""
        of = set()
        for name in self.outputs:
            path = self.run / name
            if not path.exists():
                continue
            try:
                found = content(path)
            except Exception as error:
                return f"{name} cannot be read: {type(error).__name__}: {error}"
            known = [w for w in ("before", "after") if same(found, content(getattr(self, w) / "RUN" / name))]
            if not known:
                return f"{name} is of no run"
            of.add(known[0] if len(known) == 1 else "both")
        of.discard("both")
        return "" if len(of) < 2 else f"results are mixed: {', '.join(sorted(of))}"

    def next_run(self) -> str:
        """What is wrong with the next run and with what it leaves behind."""
        try:
            self.do(1)
        except Exception as error:
            return f"the next run fails: {type(error).__name__}: {error}"
        for name in self.outputs:
            if not same(content(self.run / name), content(self.after / "RUN" / name)):
                return f"the next run gives another {name}"
        extra = set(listing(self.here)) ^ set(listing(self.after))
        return f"left behind or missing: {sorted(extra)}" if extra else ""


def same(one: Any, other: Any) -> bool:
    """Whether two contents are equal, times apart."""
    return repr(one) == repr(other)


def listing(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def fingerprint(folder: Path) -> str:
    found = hashlib.sha256()
    for name in listing(folder):
        path = folder / name
        found.update(name.encode() + (path.read_bytes() if path.is_file() else b"/"))
    return found.hexdigest()


_listener: list[Callable[[str], None]] = []


def _hook(event: str, _: object) -> None:
    if _listener and event in EVENTS:
        _listener[0](event)


@contextlib.contextmanager
def watched(here: Path, states: Path) -> Iterator[None]:
    """Copy what lies in `here` to a folder of `states` whenever it has changed, as of a process that is gone."""
    seen: set[str] = set()

    def look(_: str) -> None:
        listen = _listener.pop()
        try:
            mark = fingerprint(here)
            if mark not in seen:
                seen.add(mark)
                copy = states / f"{len(seen):04d}"
                shutil.copytree(here, copy, symlinks=True)
                for path in sorted(copy.rglob("*"), reverse=True):
                    if f"-{os.getpid()}-" in path.name:
                        path.rename(path.with_name(path.name.replace(f"-{os.getpid()}-", f"-{DEAD}-")))
        finally:
            _listener.append(listen)

    _listener.append(look)
    try:
        yield
    finally:
        _listener.clear()


def states(study: Study, most: int) -> tuple[int, list[str]]:
    """Number of states of the disk, and what was wrong with them."""
    kept, wrong = study.folder / "states", []
    kept.mkdir()
    study.put(study.before)
    with watched(study.here, kept):
        study.do(1)
    chosen = sorted(kept.iterdir())
    step = max(1, -(-len(chosen) // most))
    for number, state in enumerate(chosen):
        study.put(state)
        if trouble := study.mixed():
            wrong.append(f"state {state.name}: {trouble}")
        if number % step == 0 and (trouble := study.next_run()):
            wrong.append(f"state {state.name}: {trouble}")
    shutil.rmtree(kept)
    return len(chosen), wrong


@contextlib.contextmanager
def small_files(most: int) -> Iterator[None]:
    """No file may become longer: what a full disk does to whoever writes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def full(study: Study, count: int) -> tuple[int, list[str]]:
    """Number of runs that met the limit, and what was wrong."""
    sizes = sorted((study.after / "RUN" / name).stat().st_size for name in study.outputs)
    generator, wrong, met = random.Random(0), [], 0
    limits = sorted({0, 1, *(s - 1 for s in sizes), *(generator.randrange(sizes[-1]) for _ in range(count))})
    for limit in limits[:count]:
        study.put(study.before)
        try:
            with small_files(limit):
                study.do(1)
        except (DataError, OSError) as error:
            met += 1
            if ".walop-" in str(error) or "\n" in str(error):
                wrong.append(f"limit {limit}: the message shows {error}")
        except Exception as error:
            wrong.append(f"limit {limit}: {type(error).__name__}: {error}")
        if trouble := study.mixed():
            wrong.append(f"limit {limit}: {trouble}")
        results = set(listing(study.here)) - {n for n in listing(study.here) if n.startswith("RUN/sampling")}
        if extra := results - set(listing(study.before)) - set(listing(study.after)):
            wrong.append(f"limit {limit}: left behind: {sorted(extra)}")
    if trouble := study.next_run():
        wrong.append(f"afterwards: {trouble}")
    return met, wrong


def command_line(study: Study) -> list[str]:
    words = (w.format(set=study.sets[1], run=study.run) for w in LINES[study.command])
    return [sys.executable, "-c", "from walop_jax.commands import main; main()", *words]


def start(study: Study) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        command_line(study), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip


def kills(study: Study, count: int) -> tuple[int, list[str]]:
    """Number of kills before the end of the command, and what was wrong."""
    for _ in range(2):  # the first compiles
        study.put(study.before)
        began = time.perf_counter()
        start(study).communicate()
    whole, generator, wrong, killed = time.perf_counter() - began, random.Random(1), [], 0
    for number in range(count):
        if number and number % 10 == 0:
            print(f"    {number} tried, {killed} killed, wrong {len(wrong)}", flush=True)
        study.put(study.before)
        process = start(study)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(generator.uniform(0.0, 1.1 * whole))
        killed += process.poll() is None
        process.kill()
        process.communicate()
        if trouble := study.mixed() or study.next_run():
            wrong.append(trouble)
    return killed, wrong


def races(study: Study, count: int) -> tuple[int, list[str]]:
    """Number of races that one process lost with an error, and what was wrong."""
    study.put(study.before)
    alone = start(study)
    alone.communicate()
    lost, wrong = 0, []
    for _ in range(count):
        study.put(study.before)
        both = [start(study), start(study)]
        told = [process.communicate()[1].decode() for process in both]
        refused = ["is being written by" in text for text in told]
        beaten = [
            text
            for process, text, no in zip(both, told, refused, strict=True)
            if no or process.returncode != alone.returncode
        ]
        lost += len(beaten)
        if len(beaten) == 2 or any("is being written by" not in text for text in beaten):
            wrong.append(f"both failed, or not with the name of the other: {told}")
        if trouble := study.mixed() or study.next_run():
            wrong.append(trouble)
    return lost, wrong


def main(arguments: Sequence[str] | None = None) -> int:
    parser = options_of(__doc__, states=200, full=60, kills=0, races=0)
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    options = parser.parse_args(arguments)
    switch_on()  # as the commands do: programs that were kept differ from others in the last digits
    warnings.simplefilter("ignore")
    sys.addaudithook(_hook)
    bad = 0
    for command in options.commands:
        with tempfile.TemporaryDirectory() as name:
            study = Study(Path(name), command)
            for what in (states, full, kills, races):
                count = getattr(options, what.__name__)
                if count:
                    number, wrong = what(study, count)
                    bad += len(wrong)
                    print(f"{command}, {what.__name__}: {number}, wrong {len(wrong)}", flush=True)
                    for text in wrong[:5]:
                        print(f"    {text}", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
