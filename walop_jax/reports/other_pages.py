"""Pages about runs that hold no fit to report: a comparison with Paper II, an old calibration and new data, limits."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from walop_jax.io.errors import fail
from walop_jax.io.rounding import two_digits
from walop_jax.io.text import read_json
from walop_jax.reports.limits_figures import protection_figure, separation_figure
from walop_jax.reports.limits_in_words import limits_in_words
from walop_jax.reports.page import embedded, environment
from walop_jax.reports.run import COMPARISON, EPOCH, LIMITS, SUMMARY, read_limits

SHOWN = 24  # parameters that have moved
KINDS = {"comparison": COMPARISON, "epoch": EPOCH, "limits": LIMITS}
NEEDED = {
    "comparison": ("on_grid", "between"),
    "epoch": ("fits", "moved", "star_errors"),
    "limits": ("probability",),
}
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
    "Standard deviations between an effect that is just detected (row) and another that does its best to look like it "
    "(column)."
)

Picture = tuple[str, str, str]


def kind_of_run(folder: Path) -> str:
    """One of `KINDS` for a folder that holds such a document and no fit to report; else `fit`."""
    if (folder / SUMMARY).exists():
        return "fit"
    return next((kind for kind, file in KINDS.items() if (folder / file).exists()), "fit")


def render_other(folder: Path, kind: str) -> tuple[str, tuple[str, ...]]:
    """The HTML text of the page about such a folder, and in words what the folder lacks for it.

    Raises `DataError` for a document that cannot be read or lacks what the page shows.
    """
    path = folder / KINDS[kind]
    document: dict[str, Any] = read_json(path)
    for key in NEEDED[kind]:
        if key not in document:
            raise fail(f"has no {key!r}", file=path, advice="run the command that made it again")
    words, pictures, missing = None, list[Picture](), ()
    if kind == "comparison":
        pictures, missing = _of_comparison(folder)
    elif kind == "limits":
        found = read_limits(path)
        words = limits_in_words(found)
        drawn = {PROTECTION: protection_figure(found)} if found.worst is not None else {}
        pictures = [
            (embedded(figure), caption, caption)
            for caption, figure in (drawn | {SEPARATION: separation_figure(found)}).items()
        ]
    text = environment().get_template(f"{kind}.html").render(
        document=document, name=folder.resolve().name, versions={}, pictures=pictures, missing=missing,
        shown=SHOWN, percent=two_digits, words=words,
    )  # fmt: skip
    return text, missing


def _of_comparison(folder: Path) -> tuple[list[Picture], tuple[str, ...]]:
    """The figures that the command has drawn, and those that are not there."""
    found, missing = [], []
    for name, caption in PICTURES.items():
        if not (folder / name).exists():
            missing.append(f"{name} is not there.")
            continue
        data = base64.b64encode((folder / name).read_bytes()).decode("ascii")
        found.append((f"data:image/png;base64,{data}", caption, caption))
    return found, tuple(missing)
