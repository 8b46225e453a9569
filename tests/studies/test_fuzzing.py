"""A few hundred damaged files of every kind; `fuzz.py` reads thousands."""

from __future__ import annotations

import numpy as np
import pytest
from fuzz import OUTCOMES, Answer, Subject, outcome, study, subjects

from walop_jax.io.errors import DataError


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> list[Subject]:
    return subjects(tmp_path_factory.mktemp("sound"))


def test_damage_is_an_error_or_does_no_harm(made, tmp_path):
    """Neither traceback nor delay of any file; where there are checksums, no other answer without a word.

    But for two exchanged words, which no sum notices.
    """
    for number, subject in enumerate(made):
        found, kept = study(subject, 40, np.random.default_rng(number), tmp_path)
        results = {result for _, result in found}
        assert not results & {"traceback", "slow"}, kept
        if subject.kind in ("set with checksums", "product"):
            assert not any(result == "silent" for kind, result in found if kind != "swap"), kept
        assert sum(found.values()) == 40


def test_every_outcome_is_told_from_the_others(tmp_path):
    """A reader that does with the content what it says."""

    def read(path):
        text = path.read_text(encoding="utf-8")
        if text == "error":
            raise DataError("no good; mend it")
        if text == "traceback":
            raise KeyError(text)
        return Answer(text.split()[0], tuple(text.split()[1:]))

    subject = Subject("nothing", b"sound", "", read)
    contents = {"error": "error", "same": "sound", "word": "other remark", "silent": "other"}
    for result, content in (contents | {"traceback": "traceback"}).items():
        assert result in OUTCOMES
        assert outcome(subject, content.encode(), Answer("sound"), tmp_path / "file")[0] == result
