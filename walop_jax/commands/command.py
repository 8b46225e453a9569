"""The parts of a command: the record that it works with, the outcome that it returns, and a decorator.

The body of a command takes a `Job` and its own arguments, and returns an `Outcome`. The decorator makes two faces of
it: the Python function, which takes `overwrite`, `progress` and `seed` beside those arguments and returns the value;
and the command of the program, whose options are the parameters with an `Option` (`program.py`).
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import logging
import os
import re
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from walop_jax.io.atomic import atomic_path, check_output
from walop_jax.io.errors import DataError, PathLike, nearest
from walop_jax.io.folder import NotWrittenError, OutputFolder, check_apart, output_folder
from walop_jax.io.names import NIGHTS, PRODUCT
from walop_jax.io.progress import Stage, Tell
from walop_jax.io.text import json_text

if TYPE_CHECKING:
    from walop_jax.io.display import Display

LOG = logging.getLogger("walop_jax")
"""Of calls in Python: progress (INFO), and the warnings of a result; silent unless the caller sets it up."""
LOG.addHandler(logging.NullHandler())

T = TypeVar("T")
Writers = Mapping[str, str | Callable[[Path], object] | None]
"""Texts, or writers, of files by name; None: this result has no such file."""


@dataclasses.dataclass(frozen=True)
class Option:
    """A parameter as an option of the program: `--name VALUE`, or `-o` as well; a `bool` is a switch.

    `kind` is the type of the typed text (default: the type in the annotation). `required` holds on the command line
    only, where results that are not written would be lost. With `placed` it is an argument, known by its position.
    """

    help: str
    metavar: str | None = None
    kind: Any = None
    short: str = ""
    required: bool = False
    least: float | None = None
    placed: bool = False

    def spelled(self, name: str) -> str:
        """The word on the command line for the parameter `name`: `--clip`, or `CALSET` for an argument."""
        return (self.metavar or name.upper()).strip("[]") if self.placed else f"--{name.replace('_', '-')}"


SHARED: Mapping[str, Option] = {
    "data": Option(
        "Calibration sets (FITS), fitted as one.", metavar="CALSET...", kind=list[Path], placed=True
    ),
    "model": Option(
        "Model file: parameters free, fixed or tied; effects added.", metavar="MODEL.toml", kind=Path
    ),
    "instrument": Option(
        "An instrument that comes with the package, or a description file; see walop-jax instrument.",
        metavar="NAME|FILE.toml",
        kind=str,
    ),
    "effects": Option(
        "Effects of your own beside those of the catalogue; see walop-jax docs adding-an-effect.",
        metavar="FILE.toml|.py",
        kind=Path,
    ),
    "goal": Option(
        "Error of p of a star that is wanted, in per cent (default: 0.1).",
        metavar="PERCENT",
        kind=float,
        least=0.0,
    ),
    "posterior": Option(
        "Use draws of walop-jax sample, not the covariance.", metavar="posterior.nc", kind=Path
    ),
    "elements": Option(
        "Kinds of elements of your own; see walop-jax docs adding-an-instrument.",
        metavar="FILE.py",
        kind=Path,
    ),
    "overwrite": Option("Replace outputs that exist."),
    "seed": Option("Seed of random numbers (default: 0).", least=0),
    "quiet": Option("Print nothing but warnings and errors.", short="-q"),
    "json": Option("Machine-readable result to stdout, nothing else."),
    "at": Option(
        "Angle (deg) of a moving element in the beam, named like its columns: CHWP=45. May be repeated.",
        metavar="P=ANGLE",
        kind=list[str],
    ),
}
"""Options of all commands with such a parameter, unless they have one of that name themselves."""


class UsageError(ValueError):
    """Arguments that cannot be meant; exit code 2 on the command line. `option` is the one that is wrong."""

    def __init__(self, message: str, option: str | None = None) -> None:
        super().__init__(message)
        self.option = option


@dataclasses.dataclass(frozen=True)
class Job:
    """Working conditions of a command, apart from its own arguments.

    `overwrite`: replace outputs that exist. `seed`: of random numbers. `progress` is called with each step. `folder`
    is the reserved folder of results (None: nothing is written). `typed`: on the command line, not from Python.
    """

    overwrite: bool = False
    seed: int = 0
    progress: Tell = lambda text: None
    folder: OutputFolder | None = None
    typed: bool = False
    began: float = dataclasses.field(default_factory=time.perf_counter)

    def tell(self, text: str, stage: str = "") -> None:
        """Report a step; `stage` is the stage of the command that begins with this step."""
        self.progress(Stage(text, stage) if stage else text)

    def begin(self, stage: str) -> None:
        """Say that a stage of the command begins, by its name."""
        self.tell(stage, stage)

    @property
    def seconds(self) -> float:
        """The time since the command began."""
        return time.perf_counter() - self.began

    def use_jax(self) -> None:
        """Switch JAX on, for commands that most often do without it."""
        if self.typed:
            from walop_jax.model.compiled import switch_on

            switch_on()


def several(given: Any) -> list[Any]:
    """Items that were given one by one or in a list."""
    return list(given) if isinstance(given, list | tuple) else [given]


class Listing(dict[str, str]):
    """Names with a line about each, printed so."""

    def __repr__(self) -> str:
        width = max(map(len, self), default=0)
        return "\n".join(f"{name:<{width}}  {about}" for name, about in self.items())


def write_text(path: PathLike, text: str, *, overwrite: bool) -> None:
    """Write a single text file, whole or not at all."""
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")


def typed(*words: object) -> str:
    """A command line to type, quoted as a shell needs it; the empty text where one of the words cannot be typed."""
    can_be = all(isinstance(word, str | os.PathLike) for word in words)
    return shlex.join(("walop-jax", *map(str, words))) if can_be else ""


def after_fit(folder: object, *, usable: bool = True) -> tuple[str, ...]:
    """Command lines to type after a fit: its page, and stars corrected with it if it is `usable`."""
    stars = typed("apply", folder, "STARS.fits", "-o", "OUT.fits")
    return (typed("report", folder), stars) if usable else (typed("report", folder),)


def with_own_classes(steps: Sequence[str], elements: object, effects: object) -> tuple[str, ...]:
    """Command lines to type next, with the Python files of a user's own kinds of elements and effects.

    What was fitted with such a class is read with its file alone. Effects of a TOML file need none: results hold them.
    """
    files = {"--elements": elements, "--effects": effects}
    python = {option: file for option, file in files.items() if str(file).endswith(".py")}

    def completed(step: str) -> str:
        missing = [
            word for option, file in python.items() if option not in step for word in (option, str(file))
        ]
        return f"{step} {shlex.join(missing)}" if missing and step.startswith("walop-jax ") else step

    return tuple(map(completed, steps))


def given(**options: object) -> list[object]:
    """The words by which options are given; those that are None are left out."""
    return [word for name, value in options.items() if value is not None for word in (f"--{name}", value)]


def figure_file(draw: Callable[..., Any], *data: Any) -> Callable[[Path], object]:
    """Writer of the figure `draw(*data)` as a picture."""
    return lambda path: draw(*data).savefig(path, dpi=130)


@dataclasses.dataclass(frozen=True)
class Outcome(Generic[T]):
    """Result of a command: `value` for Python, and the output of the program.

    `document` is plain data (None: the document of the value), to which `extra` is added; `display` is shown on a
    terminal (None: the display of the value), with the text `below` it; `text` is printed in place of both. `files` are
    the files of the output folder by name: a text, or a function that writes the file at a path. The document is
    written as the file `saved_as`, together with the display; the files `drop` are removed then. `warnings` are
    sentences to bear in mind. `failure` is the error (exit code 1), `trusted` whether the result can be used (exit code
    3 if not). `next` are command lines that one might want to type next (`typed`; empty ones are left out). `markdown`:
    the text is laid out on a terminal.
    """

    value: T
    document: Any = None
    text: str | None = None
    _: dataclasses.KW_ONLY
    extra: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    display: Display | None = None
    below: str = ""
    files: Writers = dataclasses.field(default_factory=dict)
    saved_as: str = ""
    drop: Sequence[str] = ()
    warnings: Sequence[str] = ()
    failure: str = ""
    trusted: bool = True
    next: Sequence[str] = ()
    markdown: bool = False

    @functools.cached_property
    def content(self) -> Any:
        """The document as plain data, with `extra` added; made once."""
        value: Any = self.value
        plain = value.document() if self.document is None else self.document
        return {**plain, **self.extra} if self.extra else plain

    @functools.cached_property
    def shown(self) -> Display:
        """The display: as given, or of the value."""
        value: Any = self.value
        return self.display or value.display()

    def printed(self) -> str:
        """The text for a terminal."""
        if self.text is not None:
            return self.text
        return "\n".join(filter(None, (self.shown.text(), self.below)))

    def save(self, folder: OutputFolder) -> Outcome[T]:
        """Put all files into the output folder, together; gives the outcome, a failure where one was not written."""
        absent = [name for name, write in self.files.items() if write is None]
        names = [name for name in folder.names if name not in absent]
        try:
            with folder.filled(names, (*self.drop, *absent)) as temporary:
                for name, write in self.files.items():
                    if callable(write):
                        write(temporary / name)
                    elif write is not None:
                        (temporary / name).write_text(write, encoding="utf-8")
                if self.saved_as:
                    displayed = self.display is not None or hasattr(self.value, "display")
                    content = {**self.content, **({"shown": self.shown.document()} if displayed else {})}
                    (temporary / self.saved_as).write_text(json_text(content), encoding="utf-8")
        except NotWrittenError as error:
            return dataclasses.replace(self, failure=self.failure or str(error))
        return self


COMMON: Mapping[str, tuple[Any, str]] = {
    "overwrite": (False, "bool"), "progress": (None, "Callable[[str], None] | None"), "seed": (0, "int"),
}  # fmt: skip
"""The parameters that every command takes in Python, with their defaults and kinds."""

IN_PYTHON = {
    "overwrite": "Replace outputs that exist.",
    "progress": "Called with a line of text about each step; print, for example.",
    "seed": "Seed of random numbers.",
}
"""Lines about these parameters, for `help`."""

NUMBERS = ("bool", "int", "int | None", "float", "float | None")  # annotations of parameters that are no text

OF_MODELS = ("free", "fixed", "fix", "frozen", "start", "prior", "priors", "tie", "ties", "bounds")
IN_THE_MODEL = "that is a matter of the model: model=base_model(calset).change('half1.wedge', free=False)"
"""Advice on arguments that users of other fitting programs expect."""


@dataclasses.dataclass
class Command(Generic[T]):
    """A command: `function` is the Python function, `run` the call of the program.

    `stages` are the stages that its progress goes through, in their order; `writes` the files of its output folder, or
    "file" or "table" if `output` is a single one; () if the body looks after its outputs itself. `random`: its seed
    matters. `jax`: it computes. `outputs` are the arguments that name what is written. `elements`: it takes kinds of
    elements of a user's own, as commands with `effects` do. `signature` is the signature of the Python function: the
    arguments of the body, with their types spelt out, then the arguments that all commands have. `options` are the
    options of the arguments of the body by name: those that are given, and those of `SHARED`. `described` are all
    options that it might have.
    """

    body: Callable[..., Outcome[T]]
    stages: Sequence[str] = ()
    writes: Sequence[str] | Literal["file", "table"] | None = None
    random: bool = False
    jax: bool = True
    elements: bool = False
    outputs: Sequence[str] = ("output",)
    options: Mapping[str, Option] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        self.name = self.body.__name__
        module = vars(sys.modules[self.body.__module__])
        aliases = {name: text for name, text in module.items() if isinstance(text, str)}
        own = [
            p.replace(annotation=re.sub(r"\w+", lambda word: aliases.get(word[0], word[0]), p.annotation))
            for p in list(inspect.signature(self.body).parameters.values())[1:]
        ]
        self.elements |= "effects" in (p.name for p in own)
        shared = {"elements": (None, "PathLike | Sequence[type] | None"), **COMMON}
        absent = {"elements": not self.elements, "overwrite": self.writes is None}
        make = functools.partial(inspect.Parameter, kind=inspect.Parameter.KEYWORD_ONLY)
        added = [make(name, default=default, annotation=kind) for name, (default, kind) in shared.items()]
        self.signature = inspect.Signature([*own, *(p for p in added if not absent.get(p.name))])
        self.described = {**SHARED, **self.options}
        names = (name for name in self.signature.parameters if name not in COMMON)
        self.options = {name: self.described[name] for name in names if name in self.described}

    def bound(self, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> dict[str, Any]:
        """The arguments of a call by name, with defaults. Raises TypeError, in a sentence, for others."""
        names = self.signature.parameters
        for key in kwargs:
            if key not in names:
                advice = IN_THE_MODEL if key in OF_MODELS and "model" in names else nearest(key, names)
                raise TypeError(f"{self.name}: there is no argument {key!r}; {advice}")
        try:
            call = self.signature.bind(*args, **kwargs)
        except TypeError as error:
            raise TypeError(f"{self.name}: {error}; the arguments are {', '.join(names)}") from None
        for key, value in call.arguments.items():
            if isinstance(value, str) and names[key].annotation in NUMBERS:
                raise TypeError(f"{self.name}: {key} is the text {value!r}; give a number")
        call.apply_defaults()
        return dict(call.arguments)

    @functools.cached_property
    def function(self) -> Callable[..., T]:
        """The Python function: it takes `overwrite`, `progress` and `seed` as well, and returns the value."""

        def call(*args: Any, **kwargs: Any) -> T:
            from walop_jax.model.compiled import float64

            arguments = self.bound(args, kwargs)
            shared = {name: arguments.pop(name) for name in COMMON if name in arguments}
            tell = shared["progress"]

            def logged(text: str) -> None:
                LOG.info("%s", text)
                if tell is not None:
                    tell(text)

            shared["progress"] = logged
            with float64():
                outcome = self.run(Job(**shared), arguments)
            for sentence in outcome.warnings:
                LOG.warning("%s", sentence)
            if outcome.failure:
                LOG.error("%s", outcome.failure)
            return outcome.value

        functools.update_wrapper(call, self.body)
        del call.__dict__["__wrapped__"]
        call.__signature__ = self.signature  # type: ignore[attr-defined]
        call.command = self  # type: ignore[attr-defined]
        told = {name: option.help for name, option in self.options.items()} | {
            name: help for name, help in IN_PYTHON.items() if name in self.signature.parameters
        }
        described = [f"{name}: {help}" for name, help in told.items()]
        call.__doc__ = python_first(inspect.cleandoc(self.body.__doc__ or ""), "\n".join(described))
        return call

    def run(self, job: Job, arguments: Mapping[str, Any]) -> Outcome[T]:
        """Do the work, with results written as they are asked for."""
        arguments = dict(arguments)
        if (elements := arguments.pop("elements", None)) is not None:
            from walop_jax.model.elements.registry import load_elements

            load_elements(elements)
        outcome = self._written(job, arguments)
        steps = with_own_classes(outcome.next, elements, arguments.get("effects"))
        return dataclasses.replace(outcome, next=steps)

    def _written(self, job: Job, arguments: dict[str, Any]) -> Outcome[T]:
        """The outcome of the body, with its results written."""
        output, names = arguments.get("output"), self.writes
        self._check_apart(arguments)
        body = self._body_of(arguments)
        if output is not None and isinstance(names, str):
            check_output(output, overwrite=job.overwrite)
            if names == "table":
                from walop_jax.io.plain_tables import table_format

                table_format(output)
        if output is None or not names or isinstance(names, str):
            return body(job, **arguments)
        with output_folder(output, names, overwrite=job.overwrite) as folder:
            outcome = body(dataclasses.replace(job, folder=folder), **arguments)
            return outcome.save(folder) if outcome.files or outcome.saved_as else outcome

    def _body_of(self, arguments: dict[str, Any]) -> Callable[..., Outcome[T]]:
        """The body; the arguments up to those of any number (`*inputs`) are given by position, and taken out."""
        own = [*self.signature.parameters.values()]
        many = next((n for n, p in enumerate(own) if p.kind is inspect.Parameter.VAR_POSITIONAL), None)
        if many is None:
            return self.body
        *first, rest = [arguments.pop(p.name) for p in own[: many + 1]]
        return lambda job, **others: self.body(job, *first, *(rest or ()), **others)

    def _check_apart(self, arguments: Mapping[str, Any]) -> None:
        """Refuse, as `UsageError`, outputs that are inputs, and two outputs in one file."""
        files = {
            name: path for name in self.outputs if isinstance(path := arguments.get(name), str | os.PathLike)
        }
        read = [
            path for name, given in arguments.items() if name not in self.outputs for path in _paths_in(given)
        ]
        written = {name: [path] for name, path in files.items()}
        if "output" in files and self.writes and not isinstance(self.writes, str):
            folder = Path(files.pop("output"))
            written["output"] = [folder / name for name in self.writes]
            # A survey that grows keeps the nights that it had; any other calibration would be lost.
            if PRODUCT in self.writes and NIGHTS not in self.writes and (folder / PRODUCT).exists():
                written["output"].append(folder)
        for name, paths in written.items():
            try:
                check_apart(paths, read)
            except DataError as error:
                raise UsageError(str(error), name) from error
        same: dict[str, str] = {}
        for name, path in files.items():
            if (other := same.setdefault(os.path.realpath(path), name)) != name:
                raise UsageError(f"{path} is the file of {other} as well: give each a name of its own", name)


def _paths_in(given: Any) -> list[PathLike]:
    """The paths that an argument consists of: one, or those of a list; for a run the path of its folder."""
    entries = (getattr(entry, "folder", entry) for entry in several(given))
    return [entry for entry in entries if isinstance(entry, str | os.PathLike)]


def python_first(text: str, arguments: str) -> str:
    """The docstring of a command for `help`: what Python gives and takes, the example, then the command line.

    `text` is the docstring of the body, in which a paragraph `In Python: …` and the example come last; `arguments` are
    lines about its arguments.
    """
    first, _, rest = text.partition("\n\n")
    paragraphs = rest.split("\n\n") if rest else []
    python = [part for part in paragraphs if part.startswith(("In Python:", ">>>"))]
    typed = [part for part in paragraphs if part not in python]
    typed = [f"On the command line:\n\n{typed[0]}", *typed[1:]] if typed else []
    said = [part for part in python if not part.startswith(">>>")]
    examples = [part for part in python if part.startswith(">>>")]
    return "\n\n".join(
        (first, *said, f"Arguments:\n{arguments}" if arguments else "", *examples, *typed)
    ).replace("\n\n\n\n", "\n\n")


def command(**options: Any) -> Callable[[Callable[..., Outcome[T]]], Callable[..., T]]:
    """Make a command of a body `(job, …) -> Outcome`: the Python function, with the command as its `command`.

    `options` are the fields of `Command`.
    """
    return lambda body: Command(body, **options).function


def command_of(function: Callable[..., T]) -> Command[T]:
    """The command that a Python function belongs to."""
    return vars(function)["command"]
