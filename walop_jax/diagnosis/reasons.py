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


def why(found: Document, name: str) -> str:
    """Sentences on why a diagnosis has, or has not, named an effect, a description or a change of the instrument.

    ValueError, with the nearest names, for what is none of them.
    """
    sentences = [*_of_the_result(found, name), *_of_the_first_look(found, name), *_of_the_rounds(found, name)]
    if not any(_asked(turn, name) for turn in found.get("rounds", ())) and not sentences:
        sentences = [*_of_a_description(found, name)]
    sentences += _beside(found, name)
    return "\n".join(f"{name}: {sentence}" for sentence in sentences)


def _of_the_result(found: Document, name: str) -> Iterator[str]:
    """Its fate in the final model."""
    for step in found["steps"]:
        texts = [one["sentence"] for one in step.get("sentences", ())]
        if name == step["effect"] or set(name.split("; ")) & set(texts):
            p = probability(step["p_value"])
            yield f"it was named (ln B = {step['log_bayes']:.4g}, p {p}), and is in the model"
            return
    added = [turn["added"] for turn in found.get("rounds", ())]
    parts = (found.get("unexplained") or {}).get("parts", ())
    if name in added and not any(part.startswith(name) for part in parts):
        yield "it was added, and taken out again: the final model does not need it"
    for part in parts:
        if part.startswith(name):
            yield f"it explains a part only, and may stand in for something else: {part}"


def _of_the_first_look(found: Document, name: str) -> Iterator[str]:
    """Its score ahead of every addition, or why it has none."""
    if reason := found.get("not_scored", {}).get(name):
        yield reason
    if name in found.get("cannot_be_tested", ()):
        yield "these data cannot show it at any plausible size, so they say nothing about it"
    for one in found["candidates"]:
        if one["effect"] == name:
            p, least = probability(one["p_value"]), f"{thresholds.ALARM:g}"
            sense = "" if one["p_value"] < thresholds.ALARM else f", where {least} or less is significant"
            yield f"at the first look its score is {one['score']:.4g} (p {p}{sense})"
    for one in found.get("choices", ()):
        if one["change"] == name:
            left = f"behind one linear step it leaves {100 * one['left']:.3g} % of the squared residuals"
            fitted = "it was not fitted: others leave less"
            if one["better_by"] is not None:
                fitted = f"fitted, it is better by {one['better_by']:.4g} in χ²"
            yield f"{left}; {fitted}"


def _of_the_rounds(found: Document, name: str) -> Iterator[str]:
    """The reasons of every round."""
    known = {one["effect"] for one in found["candidates"]}
    rounds = found.get("rounds", ())
    for number, turn in enumerate(rounds, start=1):
        one = _asked(turn, name)
        if one is None and name not in known:
            continue
        added = f"; {turn['added']} was added" if turn["added"] and turn["added"] != name else ""
        if one is None:
            yield f"round {number}: not significant by itself, so not tried{added}"
            continue
        how = "fitted" if one["fitted"] else "by a linear step"
        numbers = f"ln B = {one['evidence']:.4g} {how}, p {probability(one['p_value'])}"
        yield f"round {number}: {numbers}: {one['reason'] or 'added'}{added if one['reason'] else ''}"
    if not rounds and name in known:
        yield f"nothing was tried: of all patterns together p {probability(found['p_value'])}, nothing is missing"


def _asked(turn: Document, name: str) -> Document | None:
    return next((one for one in turn["asked"] if one["name"] == name), None)


def _of_a_description(found: Document, name: str) -> Iterator[str]:
    """An answer on what no list of the document holds: a description that came too far behind, or no name at all."""
    try:
        for text in name.split("; "):
            Change.parsed(text)
    except ValueError:
        lists = [
            (one["effect"] for one in found["candidates"]),
            found.get("cannot_be_tested", ()),
            found.get("not_scored", ()),
            (one["name"] for turn in found.get("rounds", ()) for one in turn["asked"]),
            (one["change"] for one in found.get("choices", ())),
        ]
        raise unknown_name("candidate of this diagnosis", name, itertools.chain(*lists)) from None
    count, rounds = found.get("descriptions"), found.get("rounds", ())
    of = f"one of {count} descriptions" if count is not None else "a description"
    if not rounds:
        yield f"{of}; nothing was tried: of all patterns together p {probability(found['p_value'])}"
        return
    yield (
        f"in none of {len(rounds)} rounds is it among those that were tried or listed: as {of} it was not significant "
        "by itself, came behind all that are listed, or is one of a longer group or part of an effect"
    )
    for number, turn in enumerate(rounds, start=1):
        best = max(turn["asked"], key=lambda one: one["evidence"], default=None)
        if best is not None:
            yield f"round {number}: the most probable was {best['name']} (ln B = {best['evidence']:.4g})"


def _beside(found: Document, name: str) -> Iterator[str]:
    """Its rivals, and its limit."""
    for step in found["steps"]:
        if name in (*step.get("equivalent", ()), *step.get("nameless", ())):
            away = step.get("separation_sigma", {}).get(name)
            distance = "" if away is None else f" ({away:.3g} σ apart)"
            yield f"these data cannot distinguish it from {step['effect']}, which was named{distance}"
    for one in found.get("limits", ()):
        if one["effect"] == name:
            size = f"{one['below_95']:.3g} {one['unit']}".rstrip()
            yield f"its {one['parameter']} is below {size} with 95 % probability"
