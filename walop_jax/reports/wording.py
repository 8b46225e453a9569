"""Numbers and verdicts in words: what a page says is decided here, how it looks is not.

An agreement is "consistent with" a cause, never proof of one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from walop_jax.diagnosis.figure_data import UNNAMED
from walop_jax.io.rounding import RAISED, probability, rounded, value_and_error
from walop_jax.model.effects import EFFECTS

MOST_PARAMETERS = 6  # of an effect, in a sentence
_PROPER = ("Wollaston", "Moon", "Stokes")


def effect_in_words(effect: str) -> str:
    """What an effect is, in a few words that may stand inside a sentence; empty for a name that is not known."""
    if effect == UNNAMED:
        return "patterns without a name"
    known = next((entry for entry in EFFECTS if entry.name == effect), None)
    if known is None:
        return ""
    return in_a_sentence((known.__doc__ or "").strip().splitlines()[0].rstrip("."))


def unit_in_words(unit: str) -> str:
    """A unit as it is printed: µm, deg⁻²."""
    raised = re.sub(r"(?<=[A-Za-z])-?\d+", lambda power: power[0].translate(RAISED), unit)
    return "µm" if raised == "um" else raised


def in_a_sentence(text: str) -> str:
    """A heading as it stands inside a sentence: its first letter small, unless it begins with a name."""
    return text if text.startswith(_PROPER) else text[:1].lower() + text[1:]


def listed(items: Sequence[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)


def verdict_of_fit(summary: Mapping[str, Any]) -> tuple[str, str]:
    """Whether a fit may be used, as a label and a sentence that says why."""
    ratio = summary["chi2"] / max(summary["dof"], 1)
    numbers = f"χ²/dof = {ratio:.4g} for {summary['dof']} degrees of freedom"
    if not summary["converged"]:
        return "Not trusted", f"The fit did not converge ({summary['message']}); {numbers}."
    if not summary.get("trusted", True):
        against = summary.get("doubts") or summary.get("warnings") or ["the model does not explain the data"]
        return "Not trusted", f"The fit converged, with {numbers}, but {against[0]}."
    return "Trusted", f"The fit converged, and the data are consistent with the model: {numbers}."


def hidden_in_words(summary: Mapping[str, Any]) -> str:
    """The mistakes that these data would not have shown, the worst first; empty where nobody asked or none counts."""
    entries = (summary.get("hidden") or [])[:4]
    sizes = [f"{entry['name']} ({entry['size']:.2g} {entry['unit']})".replace(" )", ")") for entry in entries]
    return (
        f"Not found if smaller than in brackets, and more than the errors: {listed(sizes)}." if sizes else ""
    )


def verdict_of_diagnosis(diagnosis: Mapping[str, Any]) -> tuple[str, str]:
    """What a diagnosis found, as a label and the sentences that a scientist would say."""
    steps, p = diagnosis["steps"], probability(diagnosis.get("p_value"))
    before, after = (rounded(diagnosis.get(f"chi2_per_dof_{when}")) for when in ("before", "after"))
    if diagnosis["verdict"] == "consistent":
        return "Consistent", (
            f"These data are consistent with the starting model (χ²/dof = {before}): noise alone gives a pattern at "
            f"least as strong as the strongest one found with p {p}."
        )
    base = f"The starting model does not explain these data (χ²/dof = {before}, p {p})"
    found = listed([_found(step) for step in steps])
    if diagnosis["verdict"] == "effect_found":
        return ("Effects found" if len(steps) > 1 else "Effect found"), " ".join(
            [f"{base}. They are consistent with {found}, with which χ²/dof is {after}.", *_confusions(steps)]
        )
    term = ""
    if diagnosis["unexplained"] and diagnosis["unexplained"].get("free_form"):
        term = f"A free-form term stands for it in this calibration, with which χ²/dof is {after}."
    if not steps:
        text = f"{base}, and no effect of the catalogue does: something without a name is missing."
    else:
        text = f"{base}. They agree better with {found}{'' if term else f': χ²/dof is {after}'}, but something without "
        text += "a name is left."
    return "Unexplained", " ".join(part for part in (text, term, *_confusions(steps)) if part)


def _found(step: Mapping[str, Any]) -> str:
    if step.get("sentences"):
        return f"something that has no name ({'; '.join(told['words'] for told in step['sentences'])})"
    words, values = effect_in_words(step["effect"]), []
    for name, entry in step["parameters"].items():
        value, sigma = value_and_error(entry["value"], entry["sigma"])
        unit = f" {entry['unit']}" if entry["unit"] else ""
        values.append(f"{name} = {value}{f' ± {sigma}' if sigma else ''}{unit}")
    if len(values) > MOST_PARAMETERS:
        values = [f"{len(values)} parameters"]
    inside = ": ".join(part for part in (words, ", ".join(values)) if part)
    return f"{step['effect']} ({inside})" if inside else str(step["effect"])


def _confusions(steps: Sequence[Mapping[str, Any]]) -> list[str]:
    names = [
        f"They cannot tell {step['effect']} from {listed(step['equivalent'])}."
        for step in steps
        if step["equivalent"]
    ]
    sentences = [
        f"Beside {step['effect']}, it may as well be: {'; or '.join(step['nameless'])}."
        for step in steps
        if step.get("nameless")
    ]
    return names + sentences
