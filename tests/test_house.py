"""The house: who may import whom, who owns which library, how large a file may grow; by syntax trees."""

from __future__ import annotations

import ast
import functools
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from walop_jax.data.records import Points
from walop_jax.model.quadrature import gauss_rules
from walop_jax.science.polarisation import polarisation

PACKAGE = Path(__file__).resolve().parents[1] / "walop_jax"
ROOMS = (
    "io",
    "instruments",
    "data",
    "sky",
    "model",
    "likelihood",
    "simulation",
    "fit",
    "calibration",
    "posterior",
    "science",
    "diagnosis",
    "nights",
    "plans",
    "paper",
    "reports",
    "commands",
)
OWNERS = {
    "astropy": {"io", "data", "sky", "calibration", "diagnosis", "nights"},
    "optimistix": {"fit"},
    "emcee": {"posterior"},
    "arviz": {"posterior"},
    "arviz_stats": {"posterior"},
    "matplotlib": {"reports"},
    "corner": {"reports"},
    "jinja2": {"reports"},
    "typer": {"commands"},
    "rich": {"commands"},
    "tomlkit": {"simulation", "model", "fit"},
}
# Imported by nobody: tools of the tests, and what there is no need of.
STRANGERS = {"pandas", "elli", "beartype", "hypothesis", "pytest", "oracle", "tests"}
MACHINE = re.compile(r"""/(?:home|root|work|tmp|Users|opt|mnt|data)/|[A-Z]:\\\\|\.\./shared|file://""")


@functools.cache
def files() -> list[Path]:
    """All but the configuration of the site, which only Sphinx reads."""
    return sorted(set(PACKAGE.rglob("*.py")) - {PACKAGE / "docs" / "conf.py"})


@functools.cache
def parsed(source: str) -> ast.Module:
    """The tree of a text, which nobody may change."""
    return ast.parse(source)


def tree_of(path: Path) -> ast.Module:
    return parsed(path.read_text())


def room_of(module: str) -> str | None:
    """The room of a dotted module name; None for the package's door itself, and for `python -m`."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[1] != "__main__" else None


def imports(nodes: Iterable[ast.AST], module: str, is_package: bool) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of everything that nodes of a module import."""
    here = module.split(".") if is_package else module.split(".")[:-1]
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else []
            base = [*base, *(node.module.split(".") if node.module else [])]
            for alias in node.names:
                yield node.lineno, ".".join([*base, alias.name])


def complaints(source: str, module: str, is_package: bool = False) -> list[str]:
    """What a module does that the house forbids."""
    room, tree = room_of(module), parsed(source)
    found = []
    for line, name in imports(ast.walk(tree), module, is_package):
        top = name.split(".")[0]
        where = f"{module}:{line}"
        if top == PACKAGE.name:
            target = room_of(name)
            if room is None or target is None or target.startswith("__"):
                continue
            if room == ROOMS[-1] and target[0].isupper():
                continue  # a class of the public door, which only the top room may use
            if target not in ROOMS:
                found.append(f"{where}: {target} is no room")
            elif ROOMS.index(target) > ROOMS.index(room):
                found.append(f"{where}: {room} must not know {target}")
        elif room is not None and room not in OWNERS.get(top, {room}):
            found.append(f"{where}: only {sorted(OWNERS[top])} may import {top}")
        if top in STRANGERS:
            found.append(f"{where}: {top} has no business in the package")
    if room != "commands":
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print":
                found.append(f"{module}:{node.lineno}: prints; that is the business of commands")
    return found


# What a module need not know within its room: it works on whatever has the methods that it calls.
NOT_KNOWN = {
    "walop_jax.model.light_path": "walop_jax.model.effects",
    "walop_jax.model.instrument": "walop_jax.model.effects",
    "walop_jax.model.specification": "walop_jax.model.effects",
    "walop_jax.fit.base_model": "walop_jax.model.effects",
}


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@pytest.mark.parametrize("path", files(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_module_keeps_to_its_room(path):
    source = path.read_text()
    assert complaints(source, module_name(path), path.name == "__init__.py") == []
    assert [line for line in source.splitlines() if MACHINE.search(line)] == []


def known_modules(module: str) -> set[str]:
    """The modules of the package that a module imports, by way of others too."""
    homes = {module_name(path): path for path in files()}
    known, left = set(), [module]
    while left:
        here = left.pop()
        for _, name in imports(ast.walk(tree_of(homes[here])), here, homes[here].name == "__init__.py"):
            found = name if name in homes else name.rpartition(".")[0]
            if found in homes and room_of(found) and found not in known:
                known.add(found)
                left.append(found)
    return known


@pytest.mark.parametrize("module", NOT_KNOWN)
def test_what_a_module_works_without_is_not_imported(module):
    """A model and its parameters work on any patch; the catalogue of all that may be missing stands above them."""
    assert {name for name in known_modules(module) if f"{name}.".startswith(f"{NOT_KNOWN[module]}.")} == set()


def test_no_room_calls_upward_through_a_string():
    calls = set()
    for path in files():
        module = module_name(path)
        room = room_of(module)
        for node in ast.walk(tree_of(path)) if room else ():
            if isinstance(node, ast.Constant) and re.fullmatch(r"walop_jax(\.\w+){2,}", str(node.value)):
                target = room_of(str(node.value))
                if target in ROOMS and ROOMS.index(target) > ROOMS.index(room):
                    calls.add((module.split(".", 1)[1], str(node.value).split(".", 1)[1]))
    assert calls == set()


def test_every_library_is_declared():
    """What the package imports beyond Python itself stands in the dependencies of pyproject.toml."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    declared = {
        re.split(r"[<>=!~\[; ]", entry)[0].lower().replace("-", "_") for entry in project["dependencies"]
    }
    used = {
        name.split(".")[0]: module_name(path)
        for path in files()
        for _, name in imports(ast.walk(tree_of(path)), module_name(path), path.name == "__init__.py")
    }
    missing = set(used) - declared - set(sys.stdlib_module_names) - {PACKAGE.name}
    assert {name: used[name] for name in missing} == {}


def test_every_library_is_locked_with_its_hashes():
    """A version and the hashes of its files for every dependency, within the bounds of pyproject.toml."""
    declared = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())
    text = (PACKAGE.parent / ".ci" / "requirements.lock").read_text()
    locked = dict(
        re.findall(r"^([\w.-]+)==([\w.]+)[^\n]*\\\n    --hash=sha256:[0-9a-f]{64}", text, re.MULTILINE)
    )
    for entry in (*declared["project"]["dependencies"], *declared["dependency-groups"]["test"]):
        name, least = re.match(r"([\w-]+)(?:\[\w+\])?>=([\d.]+)", entry).groups()  # type: ignore[union-attr]
        version = locked[name.lower()]
        assert [int(n) for n in version.split(".")[:2]] >= [int(n) for n in least.split(".")[:2]], entry
    assert "://" not in text


def test_every_folder_is_a_room():
    """A new room must be given its place in the order."""
    folders = {path.parent.relative_to(PACKAGE).parts[0] for path in files() if path.parent != PACKAGE}
    assert folders <= set(ROOMS)
    assert {"data", "model", "likelihood"} <= folders


FAULTS = {
    "from walop_jax.fit import refit": "model must not know fit",
    "import walop_jax.reports.page": "model must not know reports",
    "def f():\n    from walop_jax import likelihood": "model must not know likelihood",
    "from ..commands import main": "model must not know commands",
    "from astropy.io import fits": "may import astropy",
    "import matplotlib.pyplot as plt": "may import matplotlib",
    "import pandas": "pandas has no business",
    "from walop_jax.attic import junk": "attic is no room",
    "print('here')": "prints",
}


@pytest.mark.parametrize("source", FAULTS)
def test_seeded_faults_are_caught(source):
    found = complaints(source, "walop_jax.model.light")
    assert len(found) == 1
    assert FAULTS[source] in found[0]


@pytest.mark.parametrize(
    "source",
    [
        "from walop_jax.data.records import Exposures",
        "from . import optics",
        "from .effects import base",
        "import jax.numpy as jnp",
        "from walop_jax import __version__",
        "text = 'print(1)'",
    ],
)
def test_what_is_allowed_is_not_complained_of(source):
    assert complaints(source, "walop_jax.model.light") == []


def test_relative_imports_of_a_package_are_followed():
    assert complaints("from ...fit import x", "walop_jax.model.effects", is_package=True) == [
        "walop_jax.model.effects:1: model must not know fit"
    ]


def test_machine_paths_are_recognised():
    assert MACHINE.search("open('/home/someone/data.fits')")
    assert MACHINE.search("Path('../shared/data')")
    assert not MACHINE.search("a/b, data/model, https://example.org")


GENERIC = {
    "Float", "Int", "Bool", "Shaped", "Inexact", "Complex", "tuple", "list", "dict", "set", "frozenset", "type",
    "Callable", "Mapping", "Sequence", "Iterable", "Iterator", "Collection", "Literal", "Minimum",
}  # fmt: skip


def type_names(tree: ast.Module) -> Iterator[str]:
    """Classes and aliases of types of a module: `Vector = Float[np.ndarray, " n"]`, `Fit: TypeAlias = "…"`."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.AnnAssign) and ast.unparse(node.annotation) == "TypeAlias":
            yield ast.unparse(node.target)
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            value, name = node.value, node.targets[0].id
            generic = isinstance(value, ast.Subscript) and ast.unparse(value.value) in GENERIC
            if (generic or isinstance(value, ast.BinOp)) and re.fullmatch(r"[A-Z]\w*[a-z]\w*", name):
                yield name


def class_names(tree: ast.Module) -> Iterator[str]:
    yield from (node.name for node in tree.body if isinstance(node, ast.ClassDef))


@pytest.mark.parametrize("names", [class_names, type_names])
def test_a_name_of_a_class_or_of_a_type_means_one_thing(names):
    """One home each; aliases of arrays of numpy that several files need live in `io/shapes.py`."""
    homes: dict[str, set[str]] = {}
    for path in files():
        home = path.relative_to(PACKAGE).as_posix()
        for name in names(tree_of(path)):
            if not name.startswith("_"):
                homes.setdefault(name, set()).add(home)
    assert {name: sorted(found) for name, found in homes.items() if len(found) > 1} == {}, (
        "a name with several homes: give one of them another name, or move it to io/shapes.py"
    )


def test_names_of_types_are_found():
    source = """
Vector = Float[np.ndarray, " n"]
Path = str | None
LIMIT = 3.0
Fit: TypeAlias = "FitResult | Path"
class Sum: ...
"""
    assert list(type_names(ast.parse(source))) == ["Vector", "Path", "Fit", "Sum"]


def test_annotated_shapes_are_checked():
    """The checks of `shapes.py`: of arguments, of axes that two have in common, of results, of dataclasses."""
    three = np.arange(3.0)
    polarisation(np.ones((2, 2)), np.stack([np.eye(2)] * 2))
    for qu, covariance in (
        (np.ones((2, 3)), np.ones((2, 2, 2))),
        (np.ones((2, 2)), np.ones((3, 2, 2))),
        ([[0.1, 0.1]], np.ones((1, 2, 2))),
    ):
        with pytest.raises(TypeCheckError):
            polarisation(qu, covariance)
    Points(np.arange(3), three, three)
    for point, y in ((three, three), (np.arange(3), three[:2])):
        with pytest.raises(TypeCheckError):
            Points(point, three, y)
    with pytest.raises(TypeCheckError):
        gauss_rules(three, three[:2], range(1, 2))
