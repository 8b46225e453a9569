"""Pages about runs: single HTML files, figures inside, nothing fetched from anywhere.

A page is a header (the first lines that the command displayed of its result), then sections: the rest, and figures.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
import io
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2

from walop_jax.calibration.accuracy import GOAL
from walop_jax.calibration.product import read_calibration
from walop_jax.data.user_tables import read_input_table
from walop_jax.fit.verdict import GO, Quality
from walop_jax.io.display import Display, Displayed, signed
from walop_jax.io.errors import fail
from walop_jax.io.names import (
    CHECK,
    DOCUMENTS,
    LIMITS,
    QUALITY_FIGURE,
    SUMMARY,
    TRACKS,
    WATCH_FIGURE,
)
from walop_jax.io.run_folder import RunFolder
from walop_jax.io.text import probability, rounded, value_and_error, with_error, with_minus_sign
from walop_jax.model.effects import EFFECTS
from walop_jax.posterior.run import Run
from walop_jax.reports import diagnosis_figures, figures, survey_figures
from walop_jax.reports.named import draw
from walop_jax.reports.posterior_figures import unit_in_words
from walop_jax.reports.run import FigureSource, RunContents, noted, read_limits
from walop_jax.reports.style import PAGE, TEMPLATES, WIDTHS, Canvas, texts
from walop_jax.reports.wording import data_in_words, effect_in_words, names_in_words, symbols_in_words
from walop_jax.science.commissioning import Certificate, requirements
from walop_jax.science.field_accuracy import FieldAccuracy, for_stars

GENERATOR = '<meta name="generator" content="walop-jax'  # of every page
MOST_PULLS = 8
SHOWN_CANDIDATES = 10
_NAMED = 3  # patterns in a sentence
MANY = 32  # rows of a table above which it is folded
PARTS = {
    "commissioning": "The calibration by itself",
    "epoch": "After new calibration exposures",
    "watch": "For these stars",
    "affected": "What changes",
    "quality": "Quality of the night",
}
"""Sections of the page of a check by the names of its parts, where there are several."""
SMALL = ("ladder", "protection")  # figures that take half of the width


NARROW = Canvas(width=WIDTHS["column"] / 25.4)
"""The canvas of the same figure on the screen of a telephone: panels go below each other."""


@dataclasses.dataclass(frozen=True, repr=False)
class Page(Displayed):
    """A page that was written: where, its length in bytes, and in words the files that the run lacked for it."""

    path: Path
    length: int
    missing: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """The page's path, length and missing files as plain data."""
        return {"page": str(self.path), "bytes": self.length, "missing": list(self.missing)}

    def display(self) -> Display:
        """Its file and size, and the files that the run lacked for it."""
        return Display(f"{self.path}: {self.length / 1e6:.1f} MB", notes=self.missing)


class Picture(NamedTuple):
    """An image as a data URI, its caption, whether it takes half of the width; `narrow` is it for a narrow screen."""

    source: str
    caption: str
    small: bool = False
    narrow: str = ""

    @property
    def alt(self) -> str:
        """The text in its place."""
        return re.split(r"[.:;] ", self.caption)[0].rstrip(".")


class Section(NamedTuple):
    """A part of a page: a text, facts, table and notes that are displayed, pictures, and tables that are folded."""

    name: str
    title: str
    shown: Display | None = None
    pictures: Sequence[Picture] = ()
    folded: Sequence[Display] = ()
    text: str = ""

    @property
    def empty(self) -> bool:
        """True if there is nothing to see."""
        shown = self.shown
        displayed = shown is not None and (shown.facts or shown.rows or shown.notes)
        return not (displayed or self.pictures or self.folded)


def display_of(document: Mapping[str, Any], path: Path) -> Display:
    """The display of a result, from its document. Raises `DataError` for one that does not hold it."""
    try:
        return Display.of(document["shown"])
    except (KeyError, TypeError, ValueError) as error:
        what = "does not hold its display ('shown')"
        raise fail(what, file=path, advice="run the command that made it again") from error


def filled(head: Display, sections: Iterable[Section], *, good: bool, **content: Any) -> str:
    """The text of a page; no line ends between a number and its sign or unit."""
    options: dict[str, Any] = {"autoescape": True, "undefined": jinja2.StrictUndefined}
    options |= {"trim_blocks": True, "lstrip_blocks": True}
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(TEMPLATES), **options)
    environment.filters |= {"unit": unit_in_words, "signed": signed}
    filled_sections = [section for section in sections if not section.empty]
    defaults = {**dict.fromkeys(("about", "first", "instrument"), ""), "versions": {}, "many": MANY}
    defaults |= dict.fromkeys(("doubts", "next", "missing"), ())
    content = defaults | content | {"head": head, "sections": filled_sections, "good": good}
    text = environment.get_template("page.html").render(content)
    return re.sub(r"(?<=\d) (?=[%σ±])|(?<=[=±≤]) (?=\d)", "\N{NO-BREAK SPACE}", text)


def embedded(content: bytes, kind: str = "png") -> str:
    """A picture as a data URI: for an image inside a page."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def picture(name: str, drawn_on: Callable[[Canvas], Any], **words: str) -> Picture:
    """A figure, wide and narrow (SVG, letters as outlines), with its caption."""
    images = []
    for canvas in (PAGE, NARROW):
        stream = io.BytesIO()
        drawn_on(canvas).savefig(stream, format="svg", metadata={"Date": None})
        images.append(embedded(stream.getvalue(), "svg+xml"))
    return Picture(images[0], texts("captions")[name].format(**words), name in SMALL, images[1])


def drawn(source: FigureSource, names: Sequence[str], missing: list[str], **words: str) -> list[Picture]:
    """Figures by name, with captions; what cannot be drawn is added to `missing`."""
    pictures = []
    for name in names:
        with noted(missing, f"The figure {name} is not drawn: {{}}."):
            pictures.append(picture(name, lambda canvas, name=name: draw(name, source.on(canvas)), **words))
    return pictures


# ------------------------------------------------------------------------------------------- a fit, a diagnosis


def render(run: RunContents, goal: float | None = None) -> tuple[str, tuple[str, ...]]:
    """The HTML text of the page about a fit or a diagnosis, and in words the files that the run lacks for it.

    `goal` is the error of p that is wanted (None: as the fit was asked).
    """
    summary, diagnosis, folder = run.summary, run.diagnosis, run.source.folder
    of_fit = (summary.get("accuracy_of_p") or {}).get("goal", GOAL)
    source = dataclasses.replace(run.source, goal=goal or of_fit)
    run = dataclasses.replace(run, source=source, missing=[*run.missing])
    fit = display_of(summary, folder / SUMMARY)
    head = fit if diagnosis is None else display_of(diagnosis, folder / "diagnosis.json")
    trusted = bool(summary.get("trusted", summary["converged"]))
    good = trusted and (diagnosis is None or diagnosis["verdict"] in ("consistent", "effect_found"))
    requirements_shown, go = _asked(run)
    answered = any(name.startswith("good for") for name, _ in head.facts)
    if trusted and requirements_shown is not None and (goal is not None or not answered):
        accuracy, complete = _accuracy(run), diagnosis is None or good
        head = head if accuracy is None else _with_goal(head, run, accuracy, complete=complete)
    error_maps = _accuracy_pictures(run) if trusted else ()
    limits = []
    if run.limits is not None:
        shown = run.limits.display()
        limits.append(dataclasses.replace(shown, title=f"{shown.title}: {len(run.limits.limits)} amplitudes"))
    held = run.calibration
    origin = "" if held is None or not held.origin else f"; data from {held.origin}"
    sampled = held is not None and held.verdict.covariance_from == "posterior"
    when = "" if held is None else held.date.replace("T", " at ")
    date = f", {'sampled' if sampled else 'fitted'} on {when} UTC" if when else ""
    sections = (
        Section("commissioning", "Go or no-go", requirements_shown),
        Section("accuracy", "Accuracy of p over the field", pictures=error_maps),
        Section("data", "The data", Display("", () if held is None else data_in_words(held))),
        *([] if diagnosis is None else _diagnosed(run, diagnosis, head)),
        Section("residuals", "Residuals before and after", pictures=_residual_pictures(run)),
        *([] if diagnosis is None else [_candidates(run, diagnosis)]),
        Section("limits", "What these data can show", folded=limits),
        Section("warnings", "Warnings", Display("", notes=_warnings(run) or ("None.",))),
        Section("matrix", "Instrument matrix", pictures=_matrix_pictures(run)),
        Section("pulls", "Largest pulls from the priors", _pulls(run)),
        _posterior(run),
        _parameters(run, fit if diagnosis is not None else dataclasses.replace(fit, facts=())),
        _inputs(summary),
    )
    text = filled(
        head,
        sections,
        good=good and go,
        untrusted=not good,
        title="Calibration" if diagnosis is None else "Diagnosis",
        instrument=summary.get("instrument", "WALOP"),
        about=f"{date}{origin}",
        first="" if requirements_shown is None else requirements_shown.title,
        doubts=() if trusted else _doubts(summary),
        name=folder.resolve().name,
        versions=summary["versions"],
        next=_next(run, good),
        missing=run.missing,
    )
    return text, tuple(run.missing)


def _asked(run: RunContents) -> tuple[Display | None, bool]:
    """Go or no-go with its reasons: as `check` has left it, or worked out; and whether it is a go."""
    if run.checked is not None and run.source.goal == GOAL:
        shown = display_of(run.checked["commissioning"], run.source.folder / CHECK)
        answer = str(run.checked.get("answer", GO)).capitalize()
        return dataclasses.replace(shown, title=answer), bool(run.checked["go"])
    accuracy = _accuracy(run)
    if run.calibration is None or accuracy is None:
        return None, True
    checks = requirements(run.calibration.verdict, "", accuracy, None)
    verdict = for_stars(run.calibration.verdict, accuracy)
    judged = Certificate(run.source.folder, (), checks)
    return dataclasses.replace(judged.display(), title=verdict.words.capitalize()), verdict.go


def _accuracy(run: RunContents) -> FieldAccuracy | None:
    """The error of p over the field; None where there is none: its figure, which is missing then, says why."""
    try:
        return None if run.calibration is None else run.source.accuracy
    except (ValueError, OSError):
        return None


def _with_goal(head: Display, run: RunContents, accuracy: FieldAccuracy, *, complete: bool) -> Display:
    """The head of a page with the answer for another goal in place of that of the fit."""
    answer = accuracy.facts(complete=complete)
    answers = {name for name, _ in (*answer, *head.facts) if name.startswith("good for")}
    head = head.without({"also", *answers, *(name for name, _ in answer)})
    shown = dataclasses.replace(head, facts=(*answer, *head.facts))
    if run.calibration is None or not complete:
        return shown
    subject = head.title.partition(": ")[0]
    verdict = dataclasses.replace(for_stars(run.calibration.verdict, accuracy), subject=subject)
    return verdict.on_top_of(shown)


def _accuracy_pictures(run: RunContents) -> list[Picture]:
    """The error of p over the field, and the effect of a systematic error that goes unnoticed."""
    if run.calibration is None:
        return []
    pictures = drawn(run.source, ["accuracy"], run.missing, filter=run.calibration.maps.filter)
    if pictures and run.limits is not None and run.limits.worst is not None:
        pictures += drawn(run.source, ["protection"], run.missing)
    return pictures


def _residual_pictures(run: RunContents) -> list[Picture]:
    """Residuals with the starting and the final model."""
    data = run.figure_data
    if run.diagnosis is None:
        return [] if run.calibration is None else drawn(run.source, ["residuals"], run.missing)
    if data is None:
        return []
    overall, *steps = data.comparisons
    if steps:
        names = ["ladder", "rms", "shares"] if len(steps) > 1 else ["ladder", "shares"]
        return drawn(run.source, names, run.missing)
    residuals = data.points, {"residuals": overall.field["BEFORE"]}, data.cameras
    draw_whole = functools.partial(diagnosis_figures.residual_maps, *residuals)
    whole = picture("whole", draw_whole, combination=in_greek(overall.combination))
    return [whole, *drawn(run.source, ["shares"], run.missing)]


def _matrix_pictures(run: RunContents) -> list[Picture]:
    """Maps of the instrument matrix, of its errors, and of the residuals, where there is one."""
    if run.calibration is None:
        return []
    maps, residuals = run.calibration.maps, run.calibration.residuals
    words = {"filter": maps.filter, "covariance": run.calibration.verdict.covariance_from}
    pictures = drawn(run.source, ["matrix", "matrix-errors"], run.missing, **words)
    if residuals is not None:
        words = {"filter": residuals.filter, "significance": f"{residuals.significance():.1f}"}
        pictures += drawn(run.source, ["residual-map"], [], **words)
    return pictures


def _diagnosed(run: RunContents, diagnosis: Mapping[str, Any], head: Display) -> list[Section]:
    """Sections on findings, with the figures of every addition."""
    comparisons, pictures = () if run.figure_data is None else run.figure_data.comparisons, []
    for number, comparison in enumerate(comparisons[1:], start=1):
        words = {"effect": comparison.effect, "combination": in_greek(comparison.combination)}
        step = dataclasses.replace(run.source, step=number)
        pictures += drawn(step, ["effect", "signature"], run.missing, **words)
    patterns = (diagnosis["unexplained"] or {}).get("patterns", ())
    rows = tuple((row["pattern"], _chance(row)) for row in patterns)
    shown = dataclasses.replace(head, facts=())
    left = Section("unexplained", "Unexplained patterns", Display("", head=("pattern", ">p"), rows=rows))
    return [Section("found", "Findings", shown, pictures), left]


def _chance(row: Mapping[str, Any]) -> str:
    """The p-value of a row, without a sign of equality."""
    return probability(row["p_value"]).removeprefix("= ")


def _candidates(run: RunContents, diagnosis: Mapping[str, Any]) -> Section:
    """Every effect of the catalogue at the first look, limits on effects that were not found."""
    catalogue = EFFECTS if run.source.run is None else run.source.run.catalogue
    rows = tuple(
        (row["effect"], effect_in_words(row["effect"], catalogue), rounded(row["score"], ".6g"), _chance(row))
        for row in diagnosis["candidates"]
    )
    table = Display("", head=("effect", "meaning", ">score", ">p"), rows=rows[:SHOWN_CANDIDATES])
    hidden_rows = rows[SHOWN_CANDIDATES:]
    limits = ()
    for row in diagnosis.get("limits", ()):
        texts = value_and_error(row["value"], row["sigma"])
        limits += ((row["effect"], row["parameter"], *texts, rounded(row["below_95"], ".2g"), row["unit"]),)
    title = "amplitudes that were not found, with the size they stay below with 95 % probability"
    head = ("effect", "parameter", ">value", ">σ", ">below (95 %)", "unit")
    more = Display(f"{len(hidden_rows)} more", head=table.head, rows=hidden_rows)
    folded = (more, Display(f"{len(limits)} {title}", head=head, rows=limits))
    text = "Every effect of the catalogue at the first look at the starting model; p is corrected for their number."
    folded = [display for display in folded if display.rows]
    return Section("candidates", "Candidates", table, folded=folded, text=text)


def _doubts(summary: Mapping[str, Any]) -> list[str]:
    """Sentences that forbid the use of a fit: first that it does not explain its data, if so."""
    doubts, warnings = summary.get("doubts", ()), summary["warnings"]
    first = warnings[:1] if Quality.UNEXPLAINED & int(summary.get("quality", 0)) or not doubts else ()
    return list(dict.fromkeys((*first, *doubts)))


def _warnings(run: RunContents) -> tuple[str, ...]:
    """All doubts about the fit."""
    summary = run.summary
    sentences = (summary["misfit"] or {}).get("sentences", ())
    flags = (f"Flag: {text}." for text in Quality(int(summary.get("quality", 0))).meanings)
    return (*summary["warnings"], *sentences, *flags, *summary["remarks"])


def _pulls(run: RunContents) -> Display:
    """The coefficients farthest from their priors, in prior widths, farthest first."""
    pulls = []
    if run.calibration is not None:
        c = run.calibration
        for p, value, sigma in zip(c.parameters, c.values.tolist(), c.sigma.tolist(), strict=True):
            if p.free and p.tie is None and p.prior is not None and sigma > 0:
                pulls.append(((value - p.prior[0]) / p.prior[1], p, p.prior, value, sigma))
    rows = tuple(
        (p.name, with_error(value, sigma), p.unit, with_error(*prior), with_minus_sign(f"{pull:+.2f}"))
        for pull, p, prior, value, sigma in sorted(pulls, key=lambda row: -abs(row[0]))[:MOST_PULLS]
    )
    return Display("", head=("parameter", ">fitted", "unit", ">prior", ">pull (σ of the prior)"), rows=rows)


def _posterior(run: RunContents) -> Section:
    """The verdict on the chains, intervals, and the corner plot."""
    shown = None if run.sample is None else display_of(run.sample, run.source.folder / "sample.json")
    names = [] if shown is None else [row[0] for row in shown.rows]
    words = texts("captions")["corner"] + symbols_in_words(names)
    pictures = [] if run.corner is None else [Picture(embedded(run.corner), words)]
    return Section("posterior", "Posterior", shown, pictures)


def _parameters(run: RunContents, shown: Display) -> Section:
    """The parameters as displayed; behind a line those that a display leaves out."""
    displayed = {row[0] for row in shown.rows}
    hidden_rows = []
    for name, entry in run.summary["parameters"].items():
        if name not in displayed:
            value, sigma = value_and_error(entry["value"], entry["sigma"])
            hidden_rows.append((name, value, sigma or "fixed", entry["unit"]))
    title = f"{len(hidden_rows)} more: throughputs of the cameras and fixed values"
    hidden_table = Display(title, head=("parameter", ">value", ">error", "unit"), rows=tuple(hidden_rows))
    text = names_in_words(run.summary["parameters"])
    return Section("parameters", "Parameters", shown, folded=[hidden_table] if hidden_rows else [], text=text)


def _inputs(summary: Mapping[str, Any]) -> Section:
    rows = tuple((str(entry["path"]), entry["sha256"]) for entry in summary["inputs"])
    versions = ", ".join(f"{name} {version}" for name, version in summary["versions"].items())
    seed = "" if summary.get("seed") is None else f"; seed {summary['seed']}"
    table = Display("", head=("input", "SHA-256"), rows=rows, notes=(f"{versions}{seed}.",))
    return Section("origin", "Inputs and versions", table)


def _next(run: RunContents, trusted: bool) -> list[tuple[str, str]]:
    """Next steps: words and a command line."""
    folder = run.source.folder.resolve().name
    name, other = shlex.quote(folder), shlex.quote(f"{folder}_diagnosis")
    sets = shlex.join(str(entry["path"]) for entry in run.summary["inputs"]) or "CALSET"
    steps = [("correct stars", f"walop-jax apply {name} STARS.fits -o OUT.fits")] if trusted else []
    if run.diagnosis is not None and run.diagnosis["verdict"] == "wrong_number":
        return [
            (
                "correct the number that the set states, and fit it again",
                f"walop-jax refit {sets} -o {name}_again",
            )
        ]
    if run.diagnosis is None:
        steps.append(("look for missing effects", f"walop-jax diagnose {sets} -o {other}"))
    if run.limits is None and trusted:
        steps.append(
            ("list systematic errors that these data would not show", f"walop-jax limits {sets} -o {name}")
        )
    left = {} if run.diagnosis is None else run.diagnosis["unexplained"]
    if left:
        # Further exposures of the same kind show an unknown effect again: they do not name it.
        seen = ", ".join(row["pattern"] for row in left.get("patterns", ())[:_NAMED]) or "what is left"
        steps.append((f"say what makes {seen}", f"walop-jax diagnose {sets} --effects OWN.toml -o {other}"))
    elif run.calibration is None or run.calibration.maps.arms == 2:
        steps.append(("plan better exposures", f"walop-jax plan {name} --minutes 10"))
    return steps  # with other arms it is for the user to say which error is to be small


def in_greek(text: str) -> str:
    """A combination as spelled in FITS, and its signs."""
    text = re.sub(r"(?<=\d) theta", "θ", text)
    return text.replace("theta", "θ").replace(" deg", "°").replace(" - ", " − ")


# -------------------------------------------------------------------------------------------------- other results


def kind_of_run(folder: Path) -> str:
    """One of the pages about no fit for a folder that holds such a document and no fit to report; else `fit`."""
    if (folder / SUMMARY).exists():
        return "fit"
    return next((kind for kind in texts("pages") if (folder / DOCUMENTS[kind]).exists()), "fit")


def render_other(folder: Path, kind: str) -> tuple[str, tuple[str, ...]]:
    """The HTML text of the page about such a folder, and in words the files that the folder lacks for it.

    Raises `DataError` for a document that cannot be read or lacks contents of the page.
    """
    page, missing = texts("pages")[kind], []
    document = RunFolder(folder).document(DOCUMENTS[kind], ("shown",))
    head = display_of(document, folder / DOCUMENTS[kind])
    pictures = _pictures(folder, kind, document, missing)
    limited = kind == "plan" and (folder / LIMITS).exists()
    limits = read_limits(folder / LIMITS).display() if limited else None
    good = bool(document.get(page.get("trust"), True))
    parts = {name: title for name, title in PARTS.items() if kind == "check" and name in document}
    sections = (
        Section("figures", "Figures", pictures=pictures),
        Section("numbers", "In numbers", dataclasses.replace(head, facts=())),
        *(
            Section(name, title, display_of(document[name], folder / CHECK))
            for name, title in (parts.items() if len(parts) > 1 else ())
        ),
        Section("limits", "Limits of the plan", limits),
    )
    text = filled(
        head,
        sections,
        good=good,
        untrusted=not document.get("trusted", True),
        title=page["title"],
        doubts=[warning for warning in document.get("warnings", ()) if warning not in head.notes],
        name=folder.resolve().name,
        next=page.get("next", ()),
        missing=missing,
    )
    return text, tuple(missing)


def _pictures(folder: Path, kind: str, document: Mapping[str, Any], missing: list[str]) -> list[Picture]:
    """The figures of such a folder; what cannot be drawn is added to `missing`."""
    if kind == "plan":
        if "field" not in document:
            missing.append("No map: what this plan is for is no error of p.")
            return []
        return [picture("planned", functools.partial(figures.planned_figure, document["field"]))]
    if kind == "limits":
        worst = read_limits(folder / LIMITS).worst
        names = ["separation"] if worst is None else ["protection", "separation"]
        return drawn(FigureSource(Run(folder)), names, missing)
    if kind == "check":
        pictures = _change_of_the_matrix(folder, document.get("epoch", {}), missing)
        drawn_there = (("watch", WATCH_FIGURE), ("quality", QUALITY_FIGURE))
        return [*pictures, *_saved(folder, [file for part, file in drawn_there if part in document], missing)]
    if kind == "survey":
        pictures = []
        with noted(missing, "Parameters against time are not drawn: {}."):
            tracks = read_input_table(folder / TRACKS).table
            if survey_figures.tracked(document):
                draw_tracks = functools.partial(survey_figures.tracks_figure, tracks, document)
                pictures.append(picture("tracks", draw_tracks))
        return [*pictures, picture("nights", functools.partial(survey_figures.nights_figure, document))]
    pattern = rf"{kind}.*\.png"
    return _saved(folder, [name for name in texts("captions") if re.fullmatch(pattern, name)], missing)


def _saved(folder: Path, names: Sequence[str], missing: list[str]) -> list[Picture]:
    """Pictures that a command has left in the folder, with their captions; those that are not there are `missing`."""
    missing += [f"{name} is not there." for name in names if not (folder / name).exists()]
    return [  # panels below each other are whole on a narrow screen
        Picture(
            embedded((folder / name).read_bytes()),
            texts("captions")[name],
            small=name in (WATCH_FIGURE, QUALITY_FIGURE),
        )
        for name in names
        if (folder / name).exists()
    ]


def _change_of_the_matrix(folder: Path, document: Mapping[str, Any], missing: list[str]) -> list[Picture]:
    """Maps of the change of the instrument matrix, if both calibrations are there and worth comparing."""
    pictures, old_file = [], document.get("old_file")
    if document.get("fits") is not None and not document.get("same"):
        with noted(missing, "The change of the instrument matrix is not drawn: {}."):
            if old_file is None:
                raise fail("the old calibration was in memory, not in a file")
            old, new = (read_calibration(Path(path), any_model=True).maps for path in (old_file, folder))
            pictures.append(picture("change", functools.partial(figures.matrix_change_figure, old, new)))
    return pictures


def is_page(path: Path) -> bool:
    """True if a file is a page that this program has written: then it is made anew without asking."""
    try:
        with path.open(encoding="utf-8") as stream:
            return GENERATOR in stream.read(1000)
    except (OSError, UnicodeDecodeError):
        return False
