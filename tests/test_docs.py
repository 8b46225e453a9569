"""The reference pages: every topic is there, links lead somewhere, and what the code writes is explained."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import handmade_run
import jsonschema
import pytest
from small_run import small_fit

import walop_jax as walop
from walop_jax.calibration.summary import summary
from walop_jax.commands import COMMANDS
from walop_jax.commands.docs import about, pages
from walop_jax.io.text import json_text

ROOT = Path(__file__).resolve().parents[1]
PAGES = pages()
TOPICS = (
    "adding-a-command",
    "adding-an-effect",
    "adding-an-instrument",
    "coming-from",
    "conventions",
    "differentiate",
    "effects",
    "files",
    "large-sets",
    "model",
    "nights",
    "observer",
    "organisation",
    "reading",
    "recipes",
    "sources",
    "validation",
    "vocabulary",
    "year",
)
every_page = pytest.mark.parametrize("topic", TOPICS)


def slug(heading: str) -> str:
    """The anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def anchors(text: str) -> set[str]:
    return {slug(heading) for heading in re.findall(r"^#+ (.+)$", text, re.MULTILINE)}


def section(topic: str, title: str) -> str:
    """The text below a heading, down to the next one of its level or above."""
    lines = PAGES[topic].splitlines()
    start = next(i for i, line in enumerate(lines) if re.fullmatch(rf"#+ {re.escape(title)}", line))
    level = lines[start].index(" ")
    rest = [i for i in range(start + 1, len(lines)) if re.match(rf"#{{1,{level}}} ", lines[i])]
    return "\n".join(lines[start + 1 : rest[0] if rest else None])


def rows(text: str) -> Iterator[list[str]]:
    """Cells of all rows of the tables in a text, headers left out."""
    lines = text.splitlines()
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if line.startswith("|") and not line.startswith("| ---") and not following.startswith("| ---"):
            yield [cell.strip() for cell in line.strip("|").split("|")]


def keys_written(module: str, *functions: str) -> set[str]:
    """Keys of the dictionaries that functions of a module write out, from their syntax trees."""
    tree = ast.parse(Path(importlib.import_module(module).__file__ or "").read_text(encoding="utf-8"))
    found = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name in functions]
    assert {node.name for node in found} == set(functions)
    dictionaries = [node for function in found for node in ast.walk(function) if isinstance(node, ast.Dict)]
    keys = [key for dictionary in dictionaries for key in dictionary.keys]
    return {key.value for key in keys if isinstance(key, ast.Constant) and isinstance(key.value, str)}


def unexplained(names: set[str], text: str) -> list[str]:
    """Names that a text does not give: keys of JSON between backticks, columns and keywords as words."""

    def given(name: str) -> bool:
        pattern = rf"\b{re.escape(name)}\b" if name.isupper() else rf"`{re.escape(name)}`"
        return re.search(pattern, text) is not None

    assert names
    return sorted(name for name in names if not given(name))


# ----------------------------------------------------------------------------------------------- the pages


def test_topics():
    assert tuple(PAGES) == TOPICS


@every_page
def test_a_page_has_a_title_and_one_sentence_about_it(topic):
    lines = PAGES[topic].splitlines()
    assert re.fullmatch(r"# \S.*", lines[0])
    assert lines[1] == "" == lines[3]
    assert re.fullmatch(r"[A-Z].+\.", about(PAGES[topic]))
    assert PAGES[topic].endswith("\n")
    assert [line for line in lines if len(line) > 120 and not line.startswith("|")] == []


@every_page
def test_links_lead_somewhere(topic):
    links = re.findall(r"\]\(([^)]+)\)", PAGES[topic])
    for link in links:
        page, _, anchor = link.partition("#")
        target = page.removesuffix(".md") if page else topic
        assert target in PAGES, link
        assert not anchor or anchor in anchors(PAGES[target]), link


def test_every_page_can_be_reached_from_the_readme():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    linked = re.findall(r"\]\(walop_jax/docs/([\w-]+)\.md\)", readme)
    assert sorted(linked) == list(TOPICS)


def test_tables_have_as_many_cells_in_every_row():
    for topic, text in PAGES.items():
        for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
            counts = {line.count("|") for line in table.splitlines()}
            assert len(counts) == 1, (topic, table.splitlines()[0])


def test_code_cites_pages_that_exist():
    cited = {
        (path.name, topic)
        for folder in ("walop_jax", "tests")
        for path in (ROOT / folder).rglob("*.py")
        if path.name != Path(__file__).name
        for topic in re.findall(r"\bdocs: ([a-z-]+)", path.read_text(encoding="utf-8"))
    }
    assert len(cited) > 5
    assert [entry for entry in cited if entry[1] not in TOPICS] == []


def test_every_command_is_on_a_page():
    told = "\n".join([(ROOT / "README.md").read_text(encoding="utf-8"), *PAGES.values()])
    assert [name for name in COMMANDS if f"walop-jax {name}" not in told] == []


@every_page
def test_commands_of_a_page_exist(topic):
    named = set(re.findall(r"(?:`|^    (?:\$ )?)walop-jax ([a-z][a-z-]*)", PAGES[topic], re.MULTILINE))
    assert named <= {*COMMANDS, "instrument"}  # the last one comes with description files


# --------------------------------------------------------------------------------------------------- files


def test_columns_of_a_calibration_set():
    """Every table of the schema with the columns, types, units and defaults of the page, and none besides."""
    from walop_jax.data.schema import SKY, TABLES

    widths = {1: "", None: " (any number)"}
    for name, columns in TABLES.items():
        columns = {**columns, "SKY": SKY} if name == "INTENSITIES" else columns
        told = {row[0]: tuple(row[1:4]) for row in rows(section("files", name)) if len(row) == 5}
        expected = {
            column: (
                rule.kind + widths.get(rule.width, f" ({rule.width})"),
                rule.unit,
                "required" if rule.missing is None else str(rule.missing).replace("nan", "NaN"),
            )
            for column, rule in columns.items()
        }
        assert told == expected, name


def test_errors_of_the_numbers_of_a_set():
    """Every word with its name in Python, its unit and its usual size, and none besides."""
    from walop_jax.data.records import ERROR_WORDS

    told = {tuple(row) for row in rows(section("files", "Errors of the numbers of a set"))}
    assert told == {
        (word, f"`{name}`", unit, f"{usual:g}", about)
        for name, (word, unit, usual, about) in ERROR_WORDS.items()
    }


def test_kinds_and_flags():
    from walop_jax.data.kinds import KINDS
    from walop_jax.data.records import DataFlag

    kinds = [row[0].strip("`") for row in rows(section("files", "Kinds of exposure"))]
    assert set(KINDS) <= set(kinds)
    flags = {
        int(row[0]): row[1]
        for row in rows(section("files", "INTENSITIES"))
        if len(row) == 2 and row[0].isdigit()
    }
    assert flags == {bit.value: bit.meaning for bit in DataFlag}


def test_quality_bits():
    from walop_jax.fit.verdict import Quality

    told = {int(row[0]): row[1] for row in rows(section("files", "Quality bits"))}
    assert told == {bit.value: bit.meanings[0] for bit in Quality}


def test_calibration():
    from walop_jax.calibration import product

    text = section("files", "Calibration")
    names = {*product.TABLES, "EXPOSURES", "COVARIANCE", *product.TABLES["PARAMETERS"]}
    names |= keys_written("walop_jax.calibration.product", "_primary")
    assert unexplained(names, text) == []


def test_tables_and_catalogues():
    from walop_jax.science.field_points import POINT_COLUMNS

    assert unexplained(set(POINT_COLUMNS), section("files", "Tables of field points")) == []
    catalogues = section("files", "Catalogues")
    assert unexplained({"X", "Y", "N", "N_ERR", "ID", "ROTATOR", "N_FLAG", *POINT_COLUMNS}, catalogues) == []
    added = keys_written("walop_jax.science.stokes_columns", "stokes_columns", "header")
    assert unexplained(added, catalogues) == []


def test_keys_of_the_summary():
    from walop_jax.fit.misfit import Misfit

    text = section("files", "summary.json")
    names = keys_written("walop_jax.calibration.summary", "summary") | {"seed"}
    names |= {field.name for field in dataclasses.fields(Misfit)} - {"positions"}
    assert unexplained(names | {"calibration_plate", "elements"}, text) == []


def test_keys_of_the_diagnosis():
    names = keys_written("walop_jax.diagnosis.findings", "document", "_step")
    names |= keys_written("walop_jax.diagnosis.findings", "describe")
    assert unexplained(names, section("files", "diagnosis.json")) == []


SCHEMAS = json.loads((ROOT / "walop_jax/docs/schemas.json").read_text(encoding="utf-8"))
WRITTEN = {
    "summary.json": ("walop_jax.calibration.summary", "summary"),
    "diagnosis.json": ("walop_jax.diagnosis.findings", "document"),
    "plan.json": ("walop_jax.plans.exposure_plan", "document"),
}


def faults(name: str, document: Any) -> list[str]:
    """What the schema of a file finds wrong with a document."""
    validator = jsonschema.Draft202012Validator({"$ref": f"#/$defs/{name}", "$defs": SCHEMAS["$defs"]})
    return [error.message for error in validator.iter_errors(json.loads(json_text(document)))]


def test_schemas_hold_every_key_that_is_written():
    jsonschema.Draft202012Validator.check_schema(SCHEMAS)
    for name, (module, function) in WRITTEN.items():
        tree = ast.parse(Path(importlib.import_module(module).__file__ or "").read_text(encoding="utf-8"))
        written = next(
            node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name == function
        )
        outer = next(node for node in ast.walk(written) if isinstance(node, ast.Dict))
        keys = {key.value for key in outer.keys if isinstance(key, ast.Constant)}
        assert len(keys) > 10
        assert keys <= set(SCHEMAS["$defs"][name]["properties"]), name


def test_documents_follow_their_schemas():
    summary_of_fit = summary(small_fit(), seconds=1.0)
    for name, document in (
        ("summary.json", summary_of_fit),
        ("summary.json", handmade_run.SUMMARY),
        ("diagnosis.json", handmade_run.DIAGNOSIS),
    ):
        assert faults(name, document) == []
        for key in SCHEMAS["$defs"][name]["required"]:
            assert faults(name, {k: v for k, v in document.items() if k != key})
    assert faults("summary.json", summary_of_fit | {"converged": "yes"})
    assert faults("diagnosis.json", handmade_run.DIAGNOSIS | {"verdict": "good"})


def numbers_of(tree: ast.Module) -> Iterator[tuple[str, Any]]:
    """Constants of a module that are numbers, or several of them."""
    for node in tree.body:
        if not isinstance(node, ast.Assign):
            continue
        (target,), value = node.targets, node.value
        pairs = [(target, value)]
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            pairs = list(zip(target.elts, value.elts, strict=True))
        for name, number in pairs:
            leaves = [leaf.value for leaf in ast.walk(number) if isinstance(leaf, ast.Constant)]
            plain = not any(
                isinstance(part, ast.Subscript | ast.Dict | ast.Set)
                or (isinstance(part, ast.Name) and part.id.isupper())  # it follows from another number
                for part in ast.walk(number)
            )
            if leaves and plain and all(isinstance(leaf, int | float) for leaf in leaves):
                yield ast.unparse(name), number


def test_every_number_of_the_diagnosis_is_in_the_table_with_its_study():
    """Named as in the code, with its value there; those that decide are as many as the page says."""
    text, code = section("validation", "Numbers of a diagnosis"), {}
    for path in sorted((ROOT / "walop_jax" / "diagnosis").glob("*.py")):
        for name, number in numbers_of(ast.parse(path.read_text(encoding="utf-8"))):
            leaves = (leaf.value for leaf in ast.walk(number) if isinstance(leaf, ast.Constant))
            code[f"`{path.stem}.{name}`"] = list(leaves)
    table = {name: cells for name, *cells in rows(text)}
    assert sorted(table) == sorted(code)
    for name, (value, role, study) in table.items():
        assert [float(one) for one in re.findall(r"[\d.]+(?:e-?\d+)?", value)] == code[name], name
        assert role in ("decides", "work", "arithmetic", "definition", "wording"), name
        assert study, name
    assert f"{sum(role == 'decides' for _, role, _ in table.values())} of them decide" in text


def test_concepts_of_the_diagnosis_have_their_homes():
    table = list(rows(section("organisation", "A diagnosis, from alarm to verdict")))
    for _, _, home in table:
        module, name = home.strip("`").split(".")
        assert getattr(importlib.import_module(f"walop_jax.diagnosis.{module}"), name).__doc__


def test_tables_of_the_diagnosis():
    from walop_jax.diagnosis.figure_data import _TABLES

    told = {row[0]: row[1] for row in rows(section("files", "diagnosis.fits"))}
    assert set(told) == set(_TABLES)
    for name, columns in _TABLES.items():
        assert unexplained(set(columns), told[name]) == [], name


def test_keys_of_the_sampling():
    from walop_jax.commands.sample import OUTPUTS

    assert (
        unexplained(keys_written("walop_jax.posterior.result", "document"), section("files", "Posterior"))
        == []
    )
    assert [name for name in OUTPUTS if name not in section("files", "RUN")] == []


def test_example_of_a_model_file():
    """The example is read, and does what it says."""
    from walop_jax.fit.model_file import model_without_data

    lines = [line for line in section("files", "MODEL.toml").splitlines() if line.startswith("    ")]
    text = "\n".join(line.removeprefix("    ") for line in lines)
    assert set(tomllib.loads(text)) == {"model", "effects", "noise", "parameters"}
    made = model_without_data("WALOP-SOUTH", text)
    assert made.effect_names == ("clp_wobble", "blemish")
    assert made["half2.plate.mgf2"].tie == "half1.plate.mgf2"


# -------------------------------------------------------------------------------------- model and effects


def catalogue_tables() -> str:
    """The tables of all effects in docs: effects, as Markdown, from the catalogue."""
    from walop_jax.model.effects import EFFECTS, Context

    lines: list[str] = []
    entries = tomllib.loads((ROOT / "walop_jax" / "model" / "effects" / "catalogue.toml").read_text())
    for effect in EFFECTS:
        if part := entries[effect.name].get("part"):
            lines += ["", f"### {part}", ""]
            lines += ["| effect | parameter | unit | width | meaning |", "| --- | --- | --- | --- | --- |"]
        choices = effect.neutral(Context()).choices()
        equation = re.split(r"\n(?=Symbols|Source)", effect.head().partition("Equation")[2])[0]
        told = [
            inspect.cleandoc(effect.__doc__ or "").splitlines()[0].rstrip("."),
            *(f"choice: `{name}`" for name in choices),
            " ".join(equation.split()),
        ]
        declared = effect.numbers()
        for name, d in declared.items() or [("none", None)]:
            width = "" if d is None or d.width is None else f"{d.width:g}"
            what = "" if d is None else d.about + ("" if d.width else " (shape)")
            cells = (
                effect.name if told else "",
                name,
                d.unit if d else "",
                width,
                "; ".join((*told, what)).rstrip("; "),
            )
            lines.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |".replace("|  |", "| |"))
            told = []
    return re.sub(r"\|  (?=\|)", "| ", "\n".join(lines).strip()) + "\n"


def test_tables_of_effects_are_those_of_the_catalogue():
    page, tables = section("effects", "The catalogue of effects"), catalogue_tables().strip()
    start, stop = page.index("### Sky and stars"), page.index("`free_form` is not an effect")
    said = page[start:stop].strip() == tables
    assert said, f"replace the tables of docs/effects.md, 'The catalogue of effects', by\n{tables}"


def elements_table() -> str:
    """The table of all kinds of elements in docs: adding-an-instrument, as Markdown, from their classes."""
    from walop_jax.model.elements.registry import ELEMENTS
    from walop_jax.model.elements.wave_plate import Layer
    from walop_jax.model.parameters import numbers_of

    lines = ["| kind | number | unit | meaning |", "| --- | --- | --- | --- |"]
    for name, kind in {**{one.kind: one for one in ELEMENTS}, "layers": Layer}.items():
        about_kind = inspect.cleandoc(kind.__doc__ or "").splitlines()[0].rstrip(".")
        lines.append(f"| `{name}` | | | {about_kind} |")
        lines += [f"| | `{name}` | {d.unit} | {d.about} |" for name, d in numbers_of(kind).items()]
    return "\n".join(lines).replace("|  |", "| |")


def test_table_of_elements_is_that_of_their_classes():
    table = elements_table()
    said = table in section("adding-an-instrument", "Kinds of elements")
    assert said, f"replace the table of docs/adding-an-instrument.md, 'Kinds of elements', by\n{table}"


def test_kinds_and_factors_of_descriptions_are_in_their_tables():
    from walop_jax.model.effects.change import KINDS
    from walop_jax.model.effects.factors import FORMS, PLAIN

    page = section("effects", "Descriptions")
    kinds = {row[0] for row in rows(page)}
    said = {
        f"{one.split(', ')[0].rpartition(' ')[0]} {axis}".strip()
        for one in kinds
        for axis in re.findall(r"\b[quvxy]\b|radial|diagonal", one)
    }
    said |= {kind for one in kinds for kind in one.split(", ")}
    assert set(KINDS) - said - {"shade"} == set()
    assert [one for one in (*PLAIN, *", ".join(FORMS).split(", ")) if f"`{one}`" not in page] == []


def test_effects_that_look_alike_exist():
    from walop_jax.model.effects import EFFECTS

    names = {kind.name for kind in EFFECTS}
    mentioned = set(re.findall(r"\b[a-z0-9]+_[a-z0-9_]+\b", section("effects", "Effects that look alike")))
    assert len(mentioned) > 12
    assert mentioned <= names


def test_verdicts():
    from typing import get_args

    from walop_jax.diagnosis.findings import DiagnosisVerdict

    told = [row[0] for row in rows(section("effects", "How a diagnosis reports"))]
    assert set(told) == set(get_args(DiagnosisVerdict))


def test_files_of_a_days_reading_exist():
    named = re.findall(r"`((?:\w+/)+[\w.-]*)`", PAGES["reading"])
    assert len(named) > 30
    assert [name for name in named if not (ROOT / "walop_jax" / name).exists()] == []


def glossary() -> list[list[str]]:
    """Rows of the vocabulary: term, meaning, synonyms that are not used."""
    return [row for row in rows(PAGES["vocabulary"]) if len(row) == 3]


def test_a_concept_has_one_term():
    terms = [term for row in glossary() for term in row[0].split(", ")]
    assert len(terms) == len(set(terms))


@pytest.mark.parametrize("synonym", [word for row in glossary() for word in row[2].split(", ") if word])
def test_pages_and_help_use_the_terms_of_the_glossary(synonym):
    texts = {name: text for name, text in PAGES.items() if name != "vocabulary"}
    texts |= {name: (ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "CHANGELOG.md")}
    texts |= {name: inspect.getdoc(getattr(walop, name.replace("-", "_"))) or "" for name in COMMANDS}
    word = re.compile(rf"(?<![\w-]){re.escape(synonym)}s?\b", re.IGNORECASE)
    assert [name for name, text in texts.items() if word.search(text)] == []


def test_no_page_of_others_is_cited():
    """The package cites its own pages and literature, nothing that its users do not have."""
    files = [*(ROOT / "walop_jax").rglob("*.py"), *(ROOT / "walop_jax").rglob("*.md")]
    guilty = [
        path for path in files if re.search(r"contract", path.read_text(encoding="utf-8"), re.IGNORECASE)
    ]
    assert [path.name for path in guilty] == []
