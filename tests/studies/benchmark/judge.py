"""Score an answer to the benchmark: `python judge.py FOLDER ANSWER.jsonl [ANSWER.jsonl ...]`. Needs numpy alone.

An answer has one JSON object a line, for any of the scenes:

    scene       number (row of `residuals`)
    score       larger where it is more probable that something is hidden
    told        classes, best first: [["name or sentence", "what cannot be told from it", ...], ...]; [] for none;
                the first twenty members of a class are read
    complete    whether what is told explains the residuals (default true); false: it only says where something sits
    kept_back   the signal expected in the rows that were kept back (default: none)
    seconds     CPU seconds that the scene took (optional)

It counts as *right* when the first name of a class is one of those that the truth is, as *in its class* when another
member is. Where nothing that can be said is the truth, right is to raise the alarm and to tell nothing as complete.
A *false name* is a class in which the truth is not. The alarm stands at the score that 1 % of the scenes without
anything exceed. An error, between the points of the grid and at other angles, is the length of (expected − true) over
that of the true signal, or over one standard error where that is less.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

FALSE_ALARMS = 0.01
MOST_MEMBERS = 20
PUBLISHED = Path(__file__).resolve().parent / "published.json"


class SealError(ValueError):
    """The truth is not the one that was sealed."""


def opened(folder: Path) -> tuple[list[dict[str, Any]], np.ndarray, np.ndarray]:
    """What was hidden, what it does to the rows kept back, which of them lie between the points of the grid.

    Raises `SealError` if the truth was changed.
    """
    sums = dict(reversed(line.split()) for line in (folder / "SHA256SUMS").read_text().splitlines())
    found = hashlib.sha256((folder / "truth.npz").read_bytes()).hexdigest()
    if found != sums.get("truth.npz"):
        raise SealError(f"{folder / 'truth.npz'}: its SHA-256 is {found}, sealed was {sums.get('truth.npz')}")
    with np.load(folder / "truth.npz") as truth:
        return json.loads(str(truth["labels"])), truth["kept_back"], truth["between"]


def is_published(folder: Path) -> bool:
    """Whether the sealed files are those whose hashes are published beside the judge."""
    return PUBLISHED.exists() and json.loads(PUBLISHED.read_text())["sha256"] == dict(
        reversed(line.split()) for line in (folder / "SHA256SUMS").read_text().splitlines()
    )


def read(path: Path) -> dict[int, dict[str, Any]]:
    """An answer by scene."""
    lines = [json.loads(line) for line in path.read_text().splitlines() if line.strip()]
    return {int(line["scene"]): line for line in lines}


def sentences(name: str) -> set[str]:
    """The parts of a name: several sentences stand together with semicolons."""
    return set(name.split("; "))


def marked(
    truth: dict[str, Any], answer: dict[str, Any], alarm: float, signal: np.ndarray, between: np.ndarray
) -> dict[str, float]:
    """One scene: what is asked of it, as 0 or 1, number or error."""
    told = [one[:MOST_MEMBERS] for one in answer.get("told", [])]
    complete = answer.get("complete", True)
    detected, right = float(answer["score"]) > alarm, set(truth["said"])
    first = any(right & sentences(one[0]) for one in told)
    holds = [any(right & sentences(name) for name in one) for one in told]
    marks = {"detected": float(detected), "false names": float(len(told) - sum(holds))}
    marks["false names told as complete"] = marks["false names"] if complete else 0.0
    if told:
        marks["names in a class"] = float(np.mean([len(one) for one in told]))
    if truth["kind"] != "null":
        if right:
            marks |= {"right": float(first), "right or in its class": float(any(holds))}
        else:
            marks["left open, nothing holds it"] = float(detected and not (told and complete))
        expected = np.asarray(answer.get("kept_back") or np.zeros(len(signal)))
        for name, rows in {"between points": between, "at other angles": ~between}.items():
            error = np.linalg.norm((expected - signal)[rows])
            marks[f"error {name}"] = float(error / max(np.linalg.norm(signal[rows]), 1.0))
    if "seconds" in answer:
        marks["seconds"] = float(answer["seconds"])
    return marks


def judge(folder: Path, answers: dict[int, dict[str, Any]]) -> dict[str, dict[str, float]]:
    """By kind and signal-to-noise ratio: means over scenes, medians of errors and seconds, number of scenes."""
    labels, signals, between = opened(folder)
    quiet = [float(a["score"]) for i, a in answers.items() if labels[i]["kind"] == "null"]
    alarm = float(np.quantile(quiet, 1.0 - FALSE_ALARMS, method="higher")) if quiet else np.inf
    groups: dict[str, list[dict[str, float]]] = {}
    for i, answer in sorted(answers.items()):
        truth = labels[i]
        name = truth["kind"] + (f", SNR {truth['ratio']:g}" if truth["ratio"] else "")
        groups.setdefault(name, []).append(marked(truth, answer, alarm, signals[i], between))
    found = {}
    for name, marks in sorted(groups.items()):
        found[name] = {"scenes": float(len(marks))}
        for key in dict.fromkeys(key for mark in marks for key in mark):
            middle = np.median if key.startswith(("error", "seconds")) else np.mean
            found[name][key] = float(middle([mark[key] for mark in marks if key in mark]))
    return found


def main(folder: str, *answers: str) -> None:
    """Print the scores of answers."""
    if not is_published(Path(folder)):
        print("not the published scenes: numbers can be compared within this folder only")
    for answer in answers:
        print(Path(answer).stem)
        for name, marks in judge(Path(folder), read(Path(answer))).items():
            print(f"  {name}: " + ", ".join(f"{key} {value:.3g}" for key, value in marks.items()))


if __name__ == "__main__":
    main(*sys.argv[1:])
