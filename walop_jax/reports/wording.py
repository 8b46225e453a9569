"""Numbers and verdicts in words: what a page says is decided here, how it looks is not.

An agreement is "consistent with" a cause, never proof of one.
"""

from __future__ import annotations

import datetime
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration, Product
from walop_jax.data.records import CALIBRATION_PLATE, POLARISER
from walop_jax.fit.parameter_table import PRIOR_ONLY
from walop_jax.fit.verdict import Quality
from walop_jax.io.text import probability, rounded, some, value_and_error, with_error, with_minus_sign
from walop_jax.model.effects import EFFECTS
from walop_jax.model.effects.free_form import FreeForm
from walop_jax.reports.posterior_figures import LABELS
from walop_jax.sky.nights import night_of

MOST_PARAMETERS = 6  # of an effect, in a sentence
_PROPER = ("Wollaston", "Moon", "Stokes")


def effect_in_words(effect: str) -> str:
    """A few words on an effect that may stand inside a sentence; empty for a name that is not known."""
    if effect == FreeForm.name:
        return "unidentified patterns"
    known = next((entry for entry in EFFECTS if entry.name == effect), None)
    if known is None:
        return ""
    text = (known.__doc__ or "").strip().splitlines()[0].rstrip(".")
    return text if text.startswith(_PROPER) else text[:1].lower() + text[1:]


def listed(items: Sequence[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)


def verdict_of_fit(summary: Mapping[str, Any]) -> tuple[str, str]:
    """The verdict on a fit, as a label and a sentence with the reason."""
    ratio = summary["chi2"] / max(summary["dof"], 1)
    numbers = f"χ²/dof = {ratio:.4g} for {summary['dof']} degrees of freedom"
    if not summary["converged"]:
        return "Not trusted", f"The fit did not converge ({summary['message']}); {numbers}."
    if Quality.UNEXPLAINED & int(summary.get("quality", 0)):
        return "Not trusted", (
            f"The model does not explain the data: χ²/dof = {ratio:.3g}, where 1 is expected. Do not use this "
            "calibration. To find out what is missing, run walop-jax diagnose."
        )
    if not summary.get("trusted", True):
        doubts = summary.get("doubts") or summary.get("warnings") or ["the model does not explain the data"]
        told = "" if "χ²/dof" in doubts[0] else f" ({numbers})"
        return "Not trusted", f"{doubts[0][:1].upper()}{doubts[0][1:]}{told}."
    return "Trusted", f"The data are consistent with the model: {numbers}."


def hidden_in_words(summary: Mapping[str, Any]) -> str:
    """The mistakes that these data would not have shown, the worst first; empty where nobody asked or none counts."""
    entries = (summary.get("hidden") or [])[:4]
    sizes = [
        f"{entry['name']} ({rounded(entry['size'], '.2g')} {entry['unit']})".replace(" )", ")")
        for entry in entries
    ]
    told = "Mistakes larger than the errors that these data would not show, up to the size in brackets"
    return f"{told}: {listed(sizes)}." if sizes else ""


def verdict_of_diagnosis(diagnosis: Mapping[str, Any]) -> tuple[str, str]:
    """The findings of a diagnosis, as a label and the sentences that a scientist would say."""
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
        text = f"{base}, and no effect of the catalogue does: something unidentified is missing."
    else:
        text = f"{base}. They agree better with {found}{'' if term else f': χ²/dof is {after}'}, but an "
        text += "unidentified residual remains."
    return "Unexplained", " ".join(part for part in (text, term, *_confusions(steps)) if part)


def _found(step: Mapping[str, Any]) -> str:
    if step.get("sentences"):
        return f"an effect that is not in the catalogue ({'; '.join(told['words'] for told in step['sentences'])})"
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
        f"They cannot distinguish {step['effect']} from {listed(step['equivalent'])}."
        for step in steps
        if step["equivalent"]
    ]
    sentences = [
        f"Equally consistent with {step['effect']}: {'; or '.join(step['nameless'])}."
        for step in steps
        if step.get("nameless")
    ]
    return names + sentences


_MJD_0 = datetime.datetime(1858, 11, 17)
_MANY = 12
_KINDS = {"clp": "through the polariser", "moon": "of the Moon sky", "standard": "of standard stars"}


def data_in_words(product: Calibration | Product) -> list[tuple[str, str]]:
    """Nights, exposures, polariser angles, plate settings, Moon patches, standards, temperatures, filters."""
    e = product.exposures
    kinds = ", ".join(
        f"{number} {_KINDS.get(kind, kind)}" for kind, number in Counter(e.kind.tolist()).items()
    )
    low_x, high_x, low_y, high_y = product.field
    rows = [
        ("Nights", _nights(e.mjd, product.site.longitude)),
        ("Exposures", f"{len(e)} ({kinds})"),
        ("Field", with_minus_sign(f"X {low_x:+.2f} to {high_x:+.2f}°, Y {low_y:+.2f} to {high_y:+.2f}°")),
        ("Polariser angles", _angles(e.clp_angle[e.clp_in])),
    ]
    rows += [
        (
            "Calibration plate" if prefix == CALIBRATION_PLATE else prefix,
            _settings(p.angle[p.inside], bool((~p.inside).any())),
        )
        for prefix, p in e.positions.items()
        if prefix != POLARISER
    ]
    moon = e.direct("moon")
    places = {(round(float(a), 3), round(float(d), 3)) for a, d in zip(e.ra[moon], e.dec[moon], strict=True)}
    listed = some([str(name) for name in product.sources.name], _MANY)
    rows += [
        ("Moon patches", str(len(places)) if places else "none"),
        ("Standards", listed or "none"),
        ("Temperature", _range(e.temp, "°C")),
        ("Filters", ", ".join(sorted({str(name) for name in e.filter}))),
    ]
    return rows


def _nights(mjd: Float[np.ndarray, " e"], longitude: float) -> str:
    known = np.unique(night_of(mjd[np.isfinite(mjd)], longitude))
    days = [(_MJD_0 + datetime.timedelta(days=float(day))).date().isoformat() for day in known]
    if not days:
        return "not recorded"
    return days[0] if len(days) == 1 else f"{len(days)}, {days[0]} to {days[-1]}"


def _angles(angles: Float[np.ndarray, " a"]) -> str:
    if angles.size == 0:
        return "none"
    turn = np.unique(np.round(np.mod(angles, 180.0), 3))
    gap = np.diff(np.append(turn, turn[0] + 180.0)).max()
    full = ", over a full turn" if np.ptp(np.mod(angles, 360.0)) > 180.0 else ""
    return f"{len(turn)} modulo 180°, widest gap {gap:.3g}°{full}"


def _settings(angles: Float[np.ndarray, " a"], out: bool) -> str:
    found = (["out"] if out else []) + [f"{angle:g}°" for angle in np.unique(np.round(angles, 3))]
    return some(found, _MANY)


def _range(values: Float[np.ndarray, " e"], unit: str) -> str:
    known = values[np.isfinite(values)]
    if known.size == 0:
        return "not recorded"
    low, high = f"{known.min():.1f}", f"{known.max():.1f}"
    return with_minus_sign(f"{low} {unit}" if low == high else f"{low} to {high} {unit}")


def model_entries(product: Calibration | Product) -> dict[str, dict[str, str]]:
    """Start, prior, and state (fixed, tied to another, known from its prior only) of every parameter, by name."""
    found = {}
    for p, sigma in zip(product.parameters, product.sigma, strict=True):
        state = "" if p.free else "fixed"
        if p.tie is not None:
            state = f"tied to {p.tie}"
        elif p.free and p.prior is not None and sigma > PRIOR_ONLY * p.prior[1]:
            state = "prior only"
        same = (p.prior is not None and p.start == p.prior[0]) or not np.isfinite(p.start)
        found[p.name] = {
            "start": "" if same else rounded(p.start, ".6g"),
            "prior": "" if p.prior is None else with_error(p.prior[0] + 0.0, p.prior[1]),
            "state": state,
        }
    return found


PLACES = {
    "half1": "half1 for the half of the pupil with HWP1",
    "half2": "half2 for that with HWP2",
    "chwp": "chwp for the calibration half-wave plate",
    "throughput": "n0, n1, … for the cameras in their order",
}


def names_in_words(names: Iterable[str]) -> str:
    """Meanings of the first parts of names of parameters, where that is no word of its own."""
    used = {name.partition(".")[0] for name in names}
    found = [words for part, words in PLACES.items() if part in used]
    return f"In names of parameters stand {listed(found)}." if found else ""


def symbols_in_words(names: Sequence[str]) -> str:
    """The symbols that figures of a posterior use, with the names they stand for."""
    greek = {"\\delta": "δ", "\\kappa": "κ", "\\eta": "η", "\\ln": "ln"}
    found = []
    for name in names:
        symbol = re.sub(r"[${}]", "", LABELS.get(name, ""))
        for code, letter in greek.items():
            symbol = symbol.replace(code, letter)
        found += [f"{symbol} {name}"] if symbol else []
    return f"Symbols: {', '.join(found)}." if found else ""
