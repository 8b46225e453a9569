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


@pytest.fixture
def kept_apart(tmp_path, monkeypatch):
    """Scripts write into a folder of their own, which is also their home; JAX is configured as before afterwards."""
    import jax

    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_scripts_are_short_and_use_public_names():
    assert list(SCRIPTS) == [
        "Compilation, precision and saving",
        "Gradient and Jacobian",
        "Many instruments at once",
        "Many sets at once",
        UNITS,
        "A fit by optimistix",
        "A fit by optax",
        "NUTS of blackjax",
        "numpyro",
        "A likelihood of your own",
        "Another prior in the place of one",
        "The evidence by Laplace's method",
        "Sensitivity maps",
        "A forecast from a plan",
    ]
    for title, text in SCRIPTS.items():
        assert not re.search(r"walop_jax\.|import _|\._", text), title


@pytest.mark.parametrize(
    "title", quick(SCRIPTS, ["Many instruments at once", "Sensitivity maps", "A forecast from a plan"])
)
def test_it_runs(title: str, first, request: pytest.FixtureRequest, kept_apart):
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
    if title == "Compilation, precision and saving":
        assert float(names["again"].chi2(result.values)) == float(names["forward"].chi2(result.values))
    if title == "Many sets at once":
        each = [float(one.chi2(one.start)) for one in names["each"]]
        assert np.asarray(names["chi2"](names["stacked"])) == pytest.approx(each, rel=1e-12)
        assert len({round(value) for value in each}) == len(each)
    if title == "Another prior in the place of one":
        values, (at, mean, width) = result.values, map(np.asarray, names["forward"].prior)
        plates = np.isin(at, names["plates"])
        pulls = (values[at[plates]] - mean[plates]) / width[plates]
        apart = values[np.asarray(names["plates"])] - 1929.0
        make = np.sum(-0.5 * (apart / np.exp(0.3)) ** 2 - 0.3 - 0.5 * np.log(2 * np.pi))
        expected = float(names["forward"].log_density(values)) + 0.5 * np.sum(pulls**2) + make
        assert plates.sum() == 2
        assert float(names["hierarchical"](values, 1929.0, 0.3)) == pytest.approx(expected, rel=1e-12)
    if title == "The evidence by Laplace's method":
        # Savage and Dickey: the Bayes factor against a number held at a value is prior over posterior density there.
        wider, calset = names["wider"], names["calset"]
        refitted = names["walop"].refit(calset, wider)
        (extra,) = wider.positions("hwp2_axis")
        prior = wider.parameters[extra].prior
        error = np.sqrt(refitted.covariance[extra, extra])
        density = [
            -0.5 * (z / s) ** 2 - np.log(s) for z, s in ((0.0, prior[1]), (refitted.values[extra], error))
        ]
        found = float(names["evidence"](wider) - names["evidence"](names["model"]))
        assert found == pytest.approx(density[0] - density[1], abs=0.02)
    if title == "NUTS of blackjax":
        assert float(names["acceptance"].mean()) > 0.5
