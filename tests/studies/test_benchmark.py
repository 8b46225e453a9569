"""The judge of the benchmark, on scenes written by hand."""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent / "benchmark"))

from judge import SealError, judge

LABELS = [
    {"kind": "null", "name": "", "ratio": 0.0, "said": []},
    {"kind": "null", "name": "", "ratio": 0.0, "said": []},
    {"kind": "outside", "name": "film that turns with X", "ratio": 10.0, "said": ["turn of polariser * x"]},
    {"kind": "outside", "name": "ring", "ratio": 10.0, "said": []},
    {"kind": "left out", "name": "ghost", "ratio": 30.0, "said": ["opposite in O1", "opposite in E1"]},
]
BETWEEN = np.array([True, False])
SIGNALS = np.array([[0.0, 0.0], [0.0, 0.0], [3.0, 4.0], [1.0, 2.0], [0.0, 2.0]])


@pytest.fixture
def folder(tmp_path):
    np.savez(tmp_path / "truth.npz", labels=np.array(json.dumps(LABELS)), kept_back=SIGNALS, between=BETWEEN)
    seal = hashlib.sha256((tmp_path / "truth.npz").read_bytes()).hexdigest()
    (tmp_path / "SHA256SUMS").write_text(f"{seal}  truth.npz\n")
    return tmp_path


def answers(**changed):
    """Perfect ones, with all of them changed in some keys."""
    found = {}
    for i, (truth, signal) in enumerate(zip(LABELS, SIGNALS, strict=True)):
        told = [["; ".join(truth["said"])]] if truth["said"] else []
        found[i] = {"score": truth["ratio"], "told": told, "kept_back": list(signal)} | changed
    return found


def test_a_perfect_answer_has_all_and_an_empty_one_nothing(folder):
    perfect, empty = judge(folder, answers()), judge(folder, answers(score=0.0, told=[], kept_back=None))
    asked = ("detected", "right", "right or in its class", "left open, nothing holds it")
    for name in ("outside, SNR 10", "left out, SNR 30"):
        assert [v for k, v in perfect[name].items() if k in asked] == [1.0] * sum(
            k in asked for k in perfect[name]
        )
        assert [v for k, v in empty[name].items() if k in asked] == [0.0] * sum(
            k in asked for k in empty[name]
        )
        assert (perfect[name]["error at other angles"], empty[name]["error at other angles"]) == (0.0, 1.0)
    assert perfect["null"]["detected"] == perfect["null"]["false names"] == empty["null"]["detected"] == 0.0


def test_wrong_names_count_and_classes_are_read(folder):
    wrong = judge(folder, answers(told=[["blemish"], ["gain of O1", "turn of polariser * x"]]))
    assert wrong["null"]["false names"] == 2.0
    assert wrong["outside, SNR 10"]["right"] == 0.0
    assert wrong["outside, SNR 10"]["right or in its class"] == 1.0
    assert wrong["outside, SNR 10"]["false names"] == 1.5  # one of two, and both where nothing is right
    assert wrong["outside, SNR 10"]["left open, nothing holds it"] == 0.0
    open_ = judge(folder, answers(told=[["blemish"]], complete=False))["outside, SNR 10"]
    assert (open_["left open, nothing holds it"], open_["false names told as complete"]) == (1.0, 0.0)
    # Twenty members of a class are read: what could be anything says nothing.
    anything = [[*map(str, range(20)), "turn of polariser * x"]]
    assert judge(folder, answers(told=anything))["outside, SNR 10"]["right or in its class"] == 0.0


def test_a_truth_that_was_changed_is_refused(folder):
    with np.load(folder / "truth.npz") as truth:
        np.savez(
            folder / "truth.npz",
            labels=truth["labels"],
            kept_back=truth["kept_back"] + 1e-12,
            between=BETWEEN,
        )
    with pytest.raises(SealError, match="sealed was"):
        judge(folder, answers())
