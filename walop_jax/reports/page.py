"""Pages about runs: single HTML files, figures inside, nothing fetched from anywhere."""

from __future__ import annotations

import base64
import contextlib
import io
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
from matplotlib.figure import Figure

from walop_jax.calibration.product import read_product
from walop_jax.data.user_tables import read_input_table
from walop_jax.diagnosis.findings import sentences
from walop_jax.diagnosis.limits_found import DetectionLimits
from walop_jax.fit.verdict import Quality
from walop_jax.io.errors import DataError
from walop_jax.io.names import COMPARISON, EPOCH, LIMITS, PLANNED, SUMMARY, SURVEY, TRACKS, WATCHED
from walop_jax.io.run_folder import RunFolder
from walop_jax.io.text import (
    probability,
    rounded,
    two_digits,
    value_and_error,
    with_error,
    with_minus_sign,
)
from walop_jax.model.cameras import Cameras
from walop_jax.model.effects.free_form import FreeForm
from walop_jax.posterior.result import interval_in_words
from walop_jax.reports import diagnosis_figures, figures, survey_figures
from walop_jax.reports.named import draw
from walop_jax.reports.posterior_figures import unit_in_words
from walop_jax.reports.run import RunContents, read_limits
from walop_jax.reports.wording import (
    data_in_words,
    effect_in_words,
    hidden_in_words,
    model_entries,
    names_in_words,
    symbols_in_words,
    verdict_of_diagnosis,
    verdict_of_fit,
)
from walop_jax.science.field_accuracy import FieldAccuracy, judged

TEMPLATES = Path(__file__).parent / "templates"
MOST_PULLS = 8
STRONG_PULL = 3.0  # prior widths
SHOWN_CANDIDATES = 10
MANY = 24  # parameters of an effect above which its table is folded


def render(run: RunContents, accuracy: FieldAccuracy | None = None) -> str:
    """The HTML text of the page about a run; `accuracy` is that of p over the field, if it is known."""
    return filled("report.html", **_context(run, accuracy))


def filled(template: str, **content: Any) -> str:
    """The text of a page; no line ends between a number and its sign or unit."""
    text = environment().get_template(template).render(content)
    return re.sub(r"(?<=\d) (?=[%σ±])|(?<=[=±≤]) (?=\d)", "\N{NO-BREAK SPACE}", text)


def environment() -> jinja2.Environment:
    """The templates of all pages, and the functions that they use."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["unit"] = unit_in_words
    made.globals.update(
        effect_in_words=effect_in_words,
        names_in_words=names_in_words,
        value_and_error=value_and_error,
        judged=judged,
        rounded=rounded,
        probability=probability,
    )
    return made


def _context(run: RunContents, accuracy: FieldAccuracy | None) -> dict[str, Any]:
    summary, diagnosis = run.summary, run.diagnosis
    label, sentence = verdict_of_fit(summary) if diagnosis is None else verdict_of_diagnosis(diagnosis)
    trusted = bool(summary.get("trusted", summary["converged"]))
    good = trusted and (diagnosis is None or diagnosis["verdict"] != "unexplained")
    if run.commissioning is not None:
        label = f"{'Go' if run.commissioning['go'] else 'No-go'} – {label[:1].lower()}{label[1:]}"
    main, rest = _parameters(run)
    found_steps = [] if diagnosis is None else diagnosis["steps"]
    quality = Quality(int(summary.get("quality", 0)))
    return {
        "run": run,
        "name": run.source.folder.resolve().name,
        "instrument": summary.get("instrument", "WALOP"),
        "summary": summary,
        "diagnosis": diagnosis,
        "commissioning": run.commissioning,
        "said": [] if diagnosis is None else tuple(sentences(diagnosis)),
        "label": label,
        "sentence": sentence,
        "fit_sentence": ": ".join(verdict_of_fit(summary)),
        "good": good,
        "noise_alone": _noise_alone(None if run.product is None else run.product.design.cameras),
        "trusted": trusted,
        "quality": quality.meanings,
        "hidden": hidden_in_words(summary),
        "steps": [dict(step) | _drawn(run, number) for number, step in enumerate(found_steps, start=1)],
        "unnamed": None if diagnosis is None else _drawn(run, len(found_steps) + 1),
        "unnamed_term": FreeForm.name,
        "shown_candidates": SHOWN_CANDIDATES,
        "ladder": _ladder(run),
        "whole_combination": ""
        if run.figure_data is None
        else in_greek(run.figure_data.comparisons[0].combination),
        "pulls": _pulls(run),
        "parameters": main,
        "other_parameters": rest,
        "many": MANY,
        "intervals": [interval_in_words(row) for row in run.intervals],
        "figures": _figures(run, accuracy),
        "versions": summary["versions"],
        "accuracy": None if accuracy is None else _accuracy_in_words(accuracy),
        "facts": [] if accuracy is None else accuracy.facts(complete=good),
        "next": _next(run, good),
        "data": [] if run.product is None else data_in_words(run.product),
        "limits": limits_in_words(run.limits),
        "symbols": ""
        if run.corner is None
        else symbols_in_words([str(row["NAME"]) for row in run.intervals]),
    }


def _noise_alone(cameras: Cameras | None) -> str:
    """Mean squared residual of noise: a flux is fitted to the cameras of a row, one of each arm where it is split."""
    if cameras is None:
        return "1 − 1/K, of K cameras,"
    return rounded(1.0 - cameras.fluxes / len(cameras), ".3g")


def _next(run: RunContents, trusted: bool) -> list[tuple[str, str]]:
    """Next steps: words and a command line."""
    name = run.source.folder.resolve().name
    sets = " ".join(str(entry["path"]) for entry in run.summary["inputs"]) or "CALSET"
    steps = [("correct stars", f"walop-jax apply {name} STARS.fits -o OUT.fits")] if trusted else []
    if run.diagnosis is None:
        steps.append(("look for what is missing", f"walop-jax diagnose {sets} -o {name}_diagnosis"))
    if run.limits is None and trusted:
        steps.append(("see what could hide in these data", f"walop-jax limits {sets} -o {name}"))
    return [*steps, ("plan better exposures", f"walop-jax plan {name} --minutes 10")]


def _accuracy_in_words(accuracy: FieldAccuracy) -> dict[str, str]:
    return {
        "median": two_digits(100 * accuracy.median),
        "share": f"{100 * accuracy.share:.0f}",
        "filter": accuracy.filter,
        "hidden": two_digits(100 * accuracy.hidden) if accuracy.hidden > 0 else "",
        "hidden_by": accuracy.hidden_by,
        "remedy": accuracy.remedy,
    }


def _drawn(run: RunContents, number: int) -> dict[str, str]:
    """The figures of one comparison of `diagnosis.fits` and its combination in words; empty without that."""
    if run.figure_data is None or number >= len(run.figure_data.comparisons):
        return {"maps": "", "signature": "", "combination": ""}
    data, one = run.figure_data, run.figure_data.comparisons[number]
    return {
        "maps": embedded(diagnosis_figures.effect_figure(data, number)),
        "signature": embedded(diagnosis_figures.signature_figure(one, data.exposures, data.cameras)),
        "combination": in_greek(one.combination),
    }


def _ladder(run: RunContents) -> list[dict[str, Any]]:
    """Rungs as rows: model, χ², degrees of freedom and what each has gained."""
    if run.figure_data is None:
        return []
    ladder, rows, before = run.figure_data.ladder, [], math.nan
    for model, chi2, dof in zip(ladder["MODEL"], ladder["CHI2"], ladder["DOF"], strict=True):
        rows.append({"model": str(model), "chi2": float(chi2), "dof": int(dof), "gain": before - float(chi2)})
        before = float(chi2)
    return rows


def _parameters(run: RunContents) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of the fitted coefficients of the instrument; rows of throughputs and of what was not fitted."""
    main, rest = [], []
    known = {} if run.product is None else model_entries(run.product)
    for name, entry in run.summary["parameters"].items():
        value, sigma = value_and_error(entry["value"], entry["sigma"])
        row = {"name": name, "value": value, "sigma": sigma or "fixed", "unit": entry["unit"]}
        row |= known.get(name, {"start": "", "prior": "", "state": ""})
        if row["state"].startswith("tied"):
            row["sigma"] = sigma or "tied"
        (rest if name.startswith("throughput.") or not sigma else main).append(row)
    return main, rest


def _pulls(run: RunContents) -> list[dict[str, Any]]:
    """The coefficients farthest from their priors, in prior widths, farthest first."""
    if run.product is None:
        return []
    c, pulls = run.product, []
    for p, value, sigma in zip(c.parameters, c.values.tolist(), c.sigma.tolist(), strict=True):
        if p.free and p.tie is None and p.prior is not None and sigma > 0:
            pulls.append((p, p.prior, value, sigma, (value - p.prior[0]) / p.prior[1]))
    return [
        {
            "name": p.name,
            "value": with_error(value, sigma),
            "unit": p.unit,
            "prior": with_error(*prior),
            "pull": with_minus_sign(f"{pull:+.2f}"),
            "strong": abs(pull) > STRONG_PULL,
        }
        for p, prior, value, sigma, pull in sorted(pulls, key=lambda row: -abs(row[-1]))[:MOST_PULLS]
    ]


def _figures(run: RunContents, accuracy: FieldAccuracy | None) -> dict[str, str]:
    """The figures of the run as a whole, as data URIs."""
    made: dict[str, Figure] = {}
    if accuracy is not None:
        made["accuracy"] = figures.accuracy_figure(accuracy)
    if run.limits is not None and run.limits.worst is not None:
        made["protection"] = diagnosis_figures.protection_figure(run.limits)
    if run.product is not None:
        made["matrix"] = figures.matrix_maps_figure(run.product.maps)
        made["errors"] = figures.matrix_errors_figure(run.product.maps)
        if run.product.residuals is not None:
            made["residual_map"] = draw("residual-map", run.source)
    if run.diagnosis is None and run.product is not None:
        with contextlib.suppress(ValueError, OSError):  # data that are not there: the page says so
            made["fit_residuals"] = draw("residuals", run.source)
    if run.figure_data is not None:
        data = run.figure_data
        whole = data.comparisons[0]
        made["shares"] = diagnosis_figures.shares_figure(data.shares)
        if len(data.comparisons) == 1:
            rows = {"residuals": whole.before}
            made["residuals"] = diagnosis_figures.residual_maps(data.points, rows, data.cameras)
        else:
            made["ladder"] = diagnosis_figures.ladder_figure(data.ladder)
        if len(data.comparisons) > 2:
            made["rms"] = diagnosis_figures.rms_figure(data)
    uris = {name: embedded(figure) for name, figure in made.items()}
    if run.corner is not None:
        uris["corner"] = "data:image/png;base64," + base64.b64encode(run.corner).decode("ascii")
    return uris


def embedded(figure: Figure) -> str:
    """A figure as a data URI (SVG, letters as outlines): for an image inside a page."""
    stream = io.BytesIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def in_greek(text: str) -> str:
    """A combination as FITS spells it, with the signs it stands for."""
    text = re.sub(r"(?<=\d) theta", "θ", text)
    return text.replace("theta", "θ").replace(" deg", "°").replace(" - ", " − ")


def limits_in_words(found: DetectionLimits | None) -> dict[str, Any] | None:
    """The protection level as a sentence (empty where no exposure gives q and u), and rows of the amplitudes."""
    if found is None:
        return None
    level = found.protection_in_words()
    names = ("amplitude", "detected", "named", "unit", "error", "taken_for")
    return {
        "level": f"{level[:1].upper()}{level[1:]}." if level else "",
        "rows": [dict(zip(names, row, strict=True)) for row in found.display().rows],
        "untestable": found.untestable,
        "median": 100 * found.mistakes[0].error[0] if found.mistakes else None,
    }


SHOWN = 24  # parameters that have moved
PICTURES = {
    "comparison_histogram.png": "Errors of q, u and p over the field, on the grid points and between them.",
    "comparison_map.png": "Maps of the errors of q and u of both methods.",
    "comparison_offset.png": "Where the offsets Δq and Δu of Paper II come from.",
    "comparison_spectral.png": "Efficiencies across the filter, and what the colour of a star changes.",
}
PROTECTION = (
    "The largest error of q and u that a single effect can make at each field point without being detected."
)
SEPARATION = (
    "Standard deviations between an effect at its detection limit (row) and another fitted to imitate it "
    "(column)."
)

Pictures = tuple[list[tuple[str, str, str]], tuple[str, ...]]
"""Images with a text in their place and a caption, and what is missing in words."""


def kind_of_run(folder: Path) -> str:
    """One of `OTHERS` for a folder that holds such a document and no fit to report; else `fit`."""
    if (folder / SUMMARY).exists():
        return "fit"
    return next((kind for kind, other in OTHERS.items() if (folder / other.file).exists()), "fit")


def render_other(folder: Path, kind: str) -> tuple[str, tuple[str, ...]]:
    """The HTML text of the page about such a folder, and in words what the folder lacks for it.

    Raises `DataError` for a document that cannot be read or lacks what the page shows.
    """
    file, needed, drawn = OTHERS[kind]
    document = RunFolder(folder).document(file, needed)
    pictures, missing = drawn(folder, document)
    words = None
    if kind in ("plan", "limits") and (folder / LIMITS).exists():
        words = limits_in_words(read_limits(folder / LIMITS))
    changes = [*document.get("breaks", []), *document.get("events", [])]
    text = filled(
        f"{kind}.html", document=document, name=folder.resolve().name, versions={}, pictures=pictures, missing=missing,
        shown=SHOWN, percent=two_digits, words=words,
        rows=sorted(changes, key=lambda row: row.get("mjd", row.get("night"))),
    )  # fmt: skip
    return text, missing


def _of_plan(folder: Path, document: Mapping[str, Any]) -> Pictures:
    """Maps of the error of p, if the plan is one of an instrument that measures it, and what each exposure is worth."""
    if "field" not in document:
        return [], ("No map: what this plan is for is no error of p.",)
    caption = (
        "Error of p (%) before and after the plan: median over the instruments drawn, largest of all filters and "
        "colours. Crosses: one exposure holds no u there."
    )
    drawn = embedded(figures.planned_figure(document["field"]))
    return [(drawn, "Error of p over the field", caption)], ()


def _of_limits(folder: Path, document: Mapping[str, Any]) -> Pictures:
    """Protection, where an exposure gives q and u, and separation."""
    found = read_limits(folder / LIMITS)
    drawn = {PROTECTION: diagnosis_figures.protection_figure(found)} if found.worst is not None else {}
    drawn |= {SEPARATION: diagnosis_figures.separation_figure(found)}
    return [(embedded(figure), caption, caption) for caption, figure in drawn.items()], ()


def _of_epoch(folder: Path, document: Mapping[str, Any]) -> Pictures:
    """Maps of what has changed of the instrument matrix, if both calibrations are there and worth comparing."""
    if document["fits"] is None or document.get("same"):
        return [], ()
    try:
        old, new = (read_product(Path(path)).maps for path in (document["old_file"], folder))
        drawn = figures.matrix_change_figure(old, new)
    except (ValueError, OSError, KeyError, TypeError) as error:
        return [], (f"The change of the instrument matrix is not drawn: {error}.",)
    caption = "Change of the instrument matrix over the field, new − old, in per cent."
    return [(embedded(drawn), "Maps of the change of the instrument matrix", caption)], ()


def _of_survey(folder: Path, document: Mapping[str, Any]) -> Pictures:
    """Parameters against time, if they are there, and χ² of every night."""
    found, missing = [], ()
    try:
        tracks = read_input_table(folder / TRACKS).table
        drawn = survey_figures.tracks_figure(tracks, document)
    except DataError as error:
        drawn, missing = None, (f"Parameters against time are not drawn: {error}.",)
    if drawn is not None:
        caption = (
            "Parameters that change: value under the law and its error (band), what each night would have by itself "
            "(dots), breaks (dashed) and what was done (dotted)."
        )
        found.append((embedded(drawn), "Parameters against time", caption))
    caption = "χ² of every night against its expectation, in standard deviations; the band is ±2."
    return [*found, (embedded(survey_figures.nights_figure(document)), "χ² night by night", caption)], missing


def _of_comparison(folder: Path, document: Mapping[str, Any]) -> Pictures:
    """The figures that the command has drawn, and those that are not there."""
    return _drawn_before(folder, PICTURES)


def _of_watch(folder: Path, document: Mapping[str, Any]) -> Pictures:
    """The figure that the command has drawn."""
    return _drawn_before(folder, {"watch.png": "Gain of every camera since the calibration, group by group."})


def _drawn_before(folder: Path, pictures: Mapping[str, str]) -> Pictures:
    """Pictures of a folder with their captions, and those that are not there."""
    found, missing = [], []
    for name, caption in pictures.items():
        if not (folder / name).exists():
            missing.append(f"{name} is not there.")
            continue
        data = base64.b64encode((folder / name).read_bytes()).decode("ascii")
        found.append((f"data:image/png;base64,{data}", caption, caption))
    return found, tuple(missing)


class OtherPage(NamedTuple):
    """A page about no fit: the document it is about, keys that this must have, and its pictures."""

    file: str
    needed: tuple[str, ...]
    drawn: Callable[[Path, Mapping[str, Any]], Pictures]


OTHERS = {
    "comparison": OtherPage(COMPARISON, ("on_grid", "between"), _of_comparison),
    "epoch": OtherPage(EPOCH, ("fits", "moved", "star_errors"), _of_epoch),
    "plan": OtherPage(PLANNED, ("exposures", "bound", "value", "beside"), _of_plan),
    "limits": OtherPage(LIMITS, ("probability",), _of_limits),
    "survey": OtherPage(SURVEY, ("breaks", "events", "by_night", "advice"), _of_survey),
    "watch": OtherPage(WATCHED, ("holds", "changes", "groups", "warnings"), _of_watch),
}
