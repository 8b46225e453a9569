"""Why something was not named: an answer from the content of `diagnosis.json` alone."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

from walop_jax.diagnosis import thresholds
from walop_jax.io.text import probability
from walop_jax.model.effects.change import Change
from walop_jax.model.parameters import unknown_name

Document = Mapping[str, Any]


def why(doc: Document, name: str) -> str:
    """Sentences on why a diagnosis has, or has not, named an effect, a description or a change of the instrument.

    ValueError, with the nearest names, for any other.
    """
    sentences = [*_of_the_result(doc, name), *_of_the_first_look(doc, name), *_of_the_rounds(doc, name)]
    if not any(_asked(turn, name) for turn in doc.get("rounds", ())) and not sentences:
        sentences = [*_of_a_description(doc, name)]
    sentences += _beside(doc, name)
    return "\n".join(f"{name}: {sentence}" for sentence in sentences)


def _of_the_result(document: Document, name: str) -> Iterator[str]:
    """Its fate in the final model."""
    for step in document["steps"]:
        texts = [sentence["sentence"] for sentence in step.get("sentences", ())]
        if name == step["effect"] or set(name.split("; ")) & set(texts):
            p = probability(step["p_value"])
            yield f"it was named (ln B = {step['log_bayes']:.4g}, p {p}), and is in the model"
            return
    added = [turn["added"] for turn in document.get("rounds", ())]
    partial = (document.get("unexplained") or {}).get("parts", ())
    parts = [text for text in partial if text.startswith(f"{name} (")]
    if name in added and not parts:
        yield "it was added, and taken out again: the final model does not need it"
    for text in parts:
        yield f"it explains a part only, and may imitate something else: {text}"


def _of_the_first_look(document: Document, name: str) -> Iterator[str]:
    """Its score ahead of every addition, or why it has none."""
    if reason := document.get("not_scored", {}).get(name):
        yield reason
    if name in document.get("cannot_be_tested", ()):
        yield "these data are insensitive to it at any plausible size"
    for entry in document["candidates"]:
        if entry["effect"] == name:
            p, least = probability(entry["p_value"]), f"{thresholds.ALARM:g}"
            sense = "" if entry["p_value"] < thresholds.ALARM else f", where {least} or less is significant"
            yield f"at the first look its score is {entry['score']:.4g} (p {p}{sense})"
    for entry in document.get("choices", ()):
        if entry["change"] == name:
            text = f"behind one linear step it leaves {100 * entry['left']:.3g} % of the squared residuals"
            fitted = "it was not fitted: others leave less"
            if entry["better_by"] is not None:
                fitted = f"fitted, it is better by {entry['better_by']:.4g} in χ²"
            yield f"{text}; {fitted}"


def _of_the_rounds(document: Document, name: str) -> Iterator[str]:
    """The reasons of every round."""
    scored = {entry["effect"] for entry in document["candidates"]}
    rounds = document.get("rounds", ())
    for number, turn in enumerate(rounds, start=1):
        entry = _asked(turn, name)
        if entry is None and name not in scored:
            continue
        added = f"; {turn['added']} was added" if turn["added"] and turn["added"] != name else ""
        if entry is None:
            yield f"round {number}: not significant by itself, so not tried{added}"
            continue
        how = "fitted" if entry["fitted"] else "by a linear step"
        worth = "no ln B" if entry["evidence"] is None else f"ln B = {entry['evidence']:.4g}"
        numbers = f"{worth} {how}, p {probability(entry['p_value'])}"
        yield f"round {number}: {numbers}: {entry['reason'] or 'added'}{added if entry['reason'] else ''}"
    if not rounds and name in scored:
        yield f"nothing was tried: of all candidates together p {probability(document['p_value'])}, nothing is missing"


def _asked(turn: Document, name: str) -> Document | None:
    return next((entry for entry in turn["asked"] if entry["name"] == name), None)


def _of_a_description(document: Document, name: str) -> Iterator[str]:
    """An answer on what no list of the document holds: a description that came too far behind, or no name at all."""
    try:
        for text in name.split("; "):
            Change.parsed(text)
    except ValueError:
        lists = [
            (entry["effect"] for entry in document["candidates"]),
            document.get("cannot_be_tested", ()),
            document.get("not_scored", ()),
            (entry["name"] for turn in document.get("rounds", ()) for entry in turn["asked"]),
            (entry["change"] for entry in document.get("choices", ())),
        ]
        raise unknown_name("candidate of this diagnosis", name, itertools.chain(*lists)) from None
    count, rounds = document.get("descriptions"), document.get("rounds", ())
    of = f"one of {count} descriptions" if count is not None else "a description"
    if not rounds:
        yield f"{of}; nothing was tried: of all candidates together p {probability(document['p_value'])}"
        return
    yield (
        f"in none of {len(rounds)} rounds is it among those that were tried or listed: as {of} it was not significant "
        "by itself, came behind all that are listed, or is one of a longer group or part of an effect"
    )
    for number, turn in enumerate(rounds, start=1):
        with_evidence = [entry for entry in turn["asked"] if entry["evidence"] is not None]
        best = max(with_evidence, key=lambda entry: entry["evidence"], default=None)
        if best is not None:
            yield f"round {number}: the most probable was {best['name']} (ln B = {best['evidence']:.4g})"


def _beside(document: Document, name: str) -> Iterator[str]:
    """Its rivals, and its limit."""
    for step in document["steps"]:
        if name in (*step.get("equivalent", ()), *step.get("nameless", ())):
            away = step.get("separation_sigma", {}).get(name)
            distance = "" if away is None else f" ({away:.3g} σ apart)"
            yield f"these data cannot distinguish it from {step['effect']}, which was named{distance}"
    for limit in document.get("limits", ()):
        if limit["effect"] == name:
            size = f"{limit['below_95']:.3g} {limit['unit']}".rstrip()
            yield f"its {limit['parameter']} is below {size} with 95 % probability"
