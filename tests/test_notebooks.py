"""Notebooks run from beginning to end, are stored as they came out, and hold no definitions."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import nbformat
import pytest
from calls_fit import complaints

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS, MODULES = sorted(FOLDER.glob("*.ipynb")), sorted(FOLDER.glob("*.py"))
NOT_OURS = {
    "charis": ("CHARIS_TABLE", "charis_internal.ecsv"),
    "metasurface": ("METASURFACE_TABLE", "metasurface_calibration5.ecsv"),
    "nasmyth": ("NASMYTH_TABLE", "efosc2_2016.ecsv"),
    "two_retarders": ("TWO_RETARDERS_TABLE", "uah_2021.ecsv"),
    "walop_north_design": ("NORTH_DESIGN", "walop_north_design.fits"),
}
"""Notebooks that read what does not come with the project: the variable that says where it lies, and the file."""
TIMEOUT = 900  # seconds per cell, on a machine that does other things as well


def read(path: Path) -> nbformat.NotebookNode:
    return nbformat.read(path, as_version=4)


def code_of(notebook: nbformat.NotebookNode) -> list[str]:
    """Code cells without the lines that only IPython understands."""
    cells = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    return ["\n".join(line for line in cell.splitlines() if not line.startswith("%")) for cell in cells]


def test_there_are_notebooks():
    assert [path.stem for path in NOTEBOOKS] == [
        "charis",
        "differentiable_model",
        "first_calibration",
        "hidden_effect",
        "metasurface",
        "nasmyth",
        "paper_versus_joint",
        "posteriors",
        "two_retarders",
        "walop_north_design",
        "year_of_an_instrument",
        "your_own_effect",
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_stored_as_they_came_out(path: Path):
    """Run from beginning to end in one go, so that readers see the figures, or not at all; no machine is named."""
    cells = [cell for cell in read(path).cells if cell.cell_type == "code"]
    counts = [cell.execution_count for cell in cells]
    if path.stem in NOT_OURS and counts == [None] * len(cells):
        return
    assert counts == list(range(1, len(cells) + 1))
    outputs = [out for cell in cells for out in cell.outputs]
    assert not [out for out in outputs if out.output_type == "error" or out.get("name") == "stderr"]
    assert len([out for out in outputs if "image/png" in out.get("data", {})]) >= 2
    texts = [out.get("text", "") + str(out.get("data", {}).get("text/plain", "")) for out in outputs]
    assert not [text for text in texts if re.search(r"/(home|root|tmp|work|Users)/", text)]


def deep_imports(cells: list[str]) -> set[str]:
    """Modules below `walop_jax` that pieces of code import, without its name."""
    nodes = [node for cell in cells for node in ast.walk(ast.parse(cell))]
    modules = {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}
    modules |= {name.name for node in nodes if isinstance(node, ast.Import) for name in node.names}
    return {name.removeprefix("walop_jax.") for name in modules if name.startswith("walop_jax.")}


def test_deep_imports_are_found():
    code = [
        "import walop_jax as walop\nfrom walop_jax import Model",
        "def f():\n    import walop_jax.io.text",
    ]
    assert deep_imports([*code, "from walop_jax.fit.refit import fit"]) == {"io.text", "fit.refit"}


@pytest.mark.parametrize("path", [*NOTEBOOKS, *MODULES], ids=lambda path: path.name)
def test_notebooks_use_public_names(path: Path):
    cells = code_of(read(path)) if path in NOTEBOOKS else [path.read_text(encoding="utf-8")]
    assert deep_imports(cells) == set()


@pytest.mark.parametrize("path", [*NOTEBOOKS, *MODULES], ids=lambda path: path.name)
def test_calls_of_notebooks_fit(path: Path, monkeypatch: pytest.MonkeyPatch):
    """Quick: the notebooks themselves take minutes. Names, attributes, arguments and figures are all there."""
    monkeypatch.syspath_prepend(FOLDER)
    cells = code_of(read(path)) if path in NOTEBOOKS else [path.read_text(encoding="utf-8")]
    assert complaints(cells, [module.stem for module in MODULES]) == []


def test_calls_that_do_not_fit_are_found():
    code = """
import walop_jax as walop
from walop_jax.reports.figures import nothing
calset, truth = walop.simulate(gird=3)
result = walop.refit(calset)
print(result.trustd, result.model.nmes)
result.plot("matrx")
walop.Calibration.from_fit(result).matrix()
[step.name for step in walop.diagnose(calset).stps]
for one in (walop.refitt, calset.exposures.clpin):
    print(one)
"""
    assert complaints([code]) == [
        "walop_jax.reports.figures has no nothing",
        "walop.simulate: got an unexpected keyword argument 'gird'",
        "FitResult has no trustd",
        "Model has no nmes",
        "there is no figure matrx",
        "walop.Calibration.from_fit(result).matrix: missing a required argument: 'x'",
        "Diagnosis has no stps",
        "walop_jax has no refitt",
        "Exposures has no clpin",
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_prose_and_calls(path: Path):
    for source in code_of(read(path)):
        kinds = {type(node) for node in ast.walk(ast.parse(source))}
        assert not kinds & {ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda}, source


# The machinery of Jupyter warns of its own future; its sockets may be collected late.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.long  # half a minute to minutes each; the rooms that they call have tests of their own
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run(path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch):
    from nbclient import NotebookClient

    if path.stem in NOT_OURS:
        variable, name = NOT_OURS[path.stem]
        monkeypatch.setenv(variable, str(request.getfixturevalue("shared_data") / name))

    notebook = read(path)
    client = NotebookClient(
        notebook, timeout=TIMEOUT, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    )
    client.execute()
    errors = [out for cell in notebook.cells for out in cell.get("outputs", []) if out.output_type == "error"]
    assert errors == []
    pictures = [
        out
        for cell in notebook.cells
        for out in cell.get("outputs", [])
        if "image/png" in out.get("data", {})
    ]
    assert len(pictures) >= 2
