"""The scripts of the page on derivatives run as they stand there, each after the first one."""

from __future__ import annotations

import importlib.util
import re
import textwrap
from typing import Any

import pytest
from quick import quick
from small_run import SEED, SMALL

from walop_jax.commands.docs import pages
from walop_jax.data.write import write_calibration_set
from walop_jax.simulation.simulate import simulate


def script(text: str) -> str:
    """The indented lines of a text that are code: equations of the page hold θ."""
    blocks = re.findall(r"(?:^(?:    .*)?\n)+", text, re.MULTILINE)
    return textwrap.dedent("".join(block for block in blocks if "θ" not in block)).strip()


HEAD, *SECTIONS = re.split(r"^## ", pages()["differentiate"], flags=re.MULTILINE)
SCRIPTS = {section.splitlines()[0]: script(section) for section in SECTIONS}
SCRIPTS = {title: text for title, text in SCRIPTS.items() if text}
UNITS = "Units for solvers"
OPTIONAL = {"numpyro": "numpyro", "NUTS of blackjax": "blackjax", "A fit by optax": "optax"}


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> dict[str, Any]:
    """The names that the first script leaves."""
    folder = tmp_path_factory.mktemp("differentiate")
    write_calibration_set(folder / "run.fits", simulate(SMALL, seed=SEED).calset)
    names: dict[str, Any] = {"__name__": "script"}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(compile(script(HEAD), "first", "exec"), names)
    return names


@pytest.fixture(scope="module")
def in_units(first) -> dict[str, Any]:
    """The same with those of the script that all solvers use."""
    names = dict(first)
    exec(compile(SCRIPTS[UNITS], UNITS, "exec"), names)
    return names


def test_scripts_are_short_and_use_public_names():
    assert list(SCRIPTS) == [
        "Gradient and Jacobian",
        "Many instruments at once",
        UNITS,
        "A fit by optimistix",
        "A fit by optax",
        "NUTS of blackjax",
        "numpyro",
        "A likelihood of your own",
        "Sensitivity maps",
        "A forecast from a plan",
    ]
    for title, text in SCRIPTS.items():
        assert not re.search(r"walop_jax\.|import _|\._", text), title


@pytest.mark.parametrize(
    "title", quick(SCRIPTS, ["Many instruments at once", "Sensitivity maps", "A forecast from a plan"])
)
def test_it_runs(title: str, first, request: pytest.FixtureRequest):
    name = OPTIONAL.get(title)
    if name and importlib.util.find_spec(name) is None:
        pytest.skip(f"{name} is not installed")
    needs_units = title != UNITS and re.search(r"\broot\b|\brows\(|\bdensity\(", SCRIPTS[title])
    names = dict(request.getfixturevalue("in_units") if needs_units else first)
    exec(compile(SCRIPTS[title], title, "exec"), names)
    checks(title, names)


def checks(title: str, names: dict[str, Any]) -> None:
    """Results against the fit of the package and its covariance."""
    import numpy as np
    from small_run import small_fit

    result = small_fit()
    free, sigma = result.model.free, np.sqrt(np.diag(result.covariance))
    if title == "Gradient and Jacobian":
        i, h = names["model"].index("half2.plate.mgf2"), names["h"]
        slope = float(names["up"] - names["down"]) / (2.0 * h)
        assert float(names["gradient"][i]) == pytest.approx(slope, rel=1e-6)
    if title == "A fit by optimistix":
        assert np.abs((np.asarray(names["values"]) - result.values)[free] / sigma[free]).max() < 1e-3
    if title == "A fit by optax":
        highest = names["forward"].log_density(result.values)
        assert abs(float(highest) + float(names["value"])) < 1e-2
    if title == "A forecast from a plan":
        i = names["planned"].names.index("half2.plate.mgf2")
        assert 0.5 * sigma[i] < float(names["error"][i]) < 2.0 * sigma[i]
    if title == "NUTS of blackjax":
        assert float(names["acceptance"].mean()) > 0.5
