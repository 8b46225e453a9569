"""What the program says of itself: help that the terminal wraps, steps, sources as BibTeX, errors with advice."""

from __future__ import annotations

import inspect
import re

import pytest

import walop_jax as walop
from walop_jax.commands import COMMANDS, line_of
from walop_jax.commands.program import step_counter
from walop_jax.io.progress import Stage

RANDOM = (
    "simulate", "sample", "diagnose", "limits", "compare", "plan", "refit", "check",
)  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command(call, name):
    shown = call(name, "-h")
    assert shown.exit_code == 0
    assert shown.output == call(name, "--help").output
    # Wrapped by the terminal, to 80 columns here: no line breaks early, where the source breaks.
    paragraphs = re.split(r"\n\s*\n", shown.output)
    for text in paragraphs[1:]:
        lines = text.strip("\n").splitlines()
        if lines and not lines[0].rstrip().endswith(":"):
            assert all(len(line) > 55 for line in lines[:-1]), text
    assert ("--seed" in shown.output) == (name in RANDOM)
    assert not re.search(r"\ba [aeio]|may take\.|\bgiven away\b", shown.output), shown.output


@pytest.mark.parametrize("name", COMMANDS)
def test_a_line_of_the_list_begins_the_page_of_its_command(name):
    """Up to a colon or semicolon."""
    page = inspect.cleandoc(getattr(walop, name.replace("-", "_")).__doc__)
    first = re.split(r"[:;.](?:\s|$)", " ".join(page.split()))[0]
    assert line_of(name) == f"{first}."


def test_every_command_takes_a_seed(call):
    """Scripts may give it to all; where nothing is random it changes nothing."""
    assert call("cite", "--seed", "1").output == call("cite").output
    assert call("cite", "--seed", "one").exit_code == 2


def test_help_lists_exit_codes_and_completion(call):
    shown = call("-h").output
    assert "Exit codes: 0 done" in shown
    assert "--install-completion" in shown
    assert "…" not in shown
    assert "..." not in shown.replace("[ARGS]...", "")


def test_steps_are_counted():
    say = step_counter(("reading", "fitting"))
    assert say("waking up") == "waking up"
    assert say(Stage("a.fits is read", "reading")) == "step 1 of 2: a.fits is read"
    assert say("fitting begins with a χ² of 12") == "step 1 of 2: fitting begins with a χ² of 12"
    assert say(Stage("minimum", "fitting")) == "step 2 of 2: minimum"
    assert say(Stage("again", "reading")) == "step 2 of 2: again"


def test_cite_as_bibtex(call):
    text = call("cite", "--bibtex").output
    entries = re.findall(r"^@(\w+)\{(\w+),\n(.*?)\n\}$", text, re.MULTILINE | re.DOTALL)
    keys = [key for _, key, _ in entries]
    assert text.count("@") == len(entries)
    assert len(keys) == len(set(keys))
    assert {"walop_jax", "maharana2022", "yeh1980", "golub1969"} <= set(keys)
    yeh = dict(re.findall(r"(\w+)\s*= \{(.*)\}", next(body for _, key, body in entries if key == "yeh1980")))
    assert yeh == {
        "author": "Yeh, P.", "title": "Optics of anisotropic layered media: A new 4 x 4 matrix algebra",
        "journal": "Surface Science", "year": "1980", "volume": "96", "pages": "41",
    }  # fmt: skip
    for _, key, body in entries:
        assert body.count("{") == body.count("}")
        assert {"author", "title", "year"} <= set(re.findall(r"^\s*(\w+)\s*=", body, re.MULTILINE)), key


@pytest.mark.parametrize(
    ("effect", "words"),
    [("clp_wobble=amp:0.06", ("'amp'", "amplitude, phase")), ("clp_wobbel=1", ("clp_wobble",))],
)
def test_a_wrong_effect_is_named(call, tmp_path, effect, words):
    refused = call("simulate", "-o", tmp_path / "s.fits", "--effect", effect)
    assert refused.exit_code == 2
    assert all(word in refused.output for word in words), refused.output


def test_matrix_gives_its_provenance(call, run, tmp_path):
    from astropy.table import Table

    from walop_jax.calibration.product import read_calibration

    (tmp_path / "p.csv").write_text("X,Y\n0,0\n")
    assert call("matrix", run, "--points", tmp_path / "p.csv", "-o", tmp_path / "o.fits").exit_code == 0
    meta = Table.read(tmp_path / "o.fits").meta
    assert meta["CALHASH"] == read_calibration(run / "calibration.fits", any_model=True).content_hash()
    assert meta["ERRFROM"] == "covariance of the fit, N_ERR"
