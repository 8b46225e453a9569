"""Pages about runs that hold no fit of their own: a comparison with Paper II, an old calibration and new data."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from walop_jax.io.errors import fail
from walop_jax.io.text import read_json
from walop_jax.reports.page import environment
from walop_jax.reports.run import COMPARISON, EPOCH

SHOWN = 24  # parameters that have moved
PICTURES = {
    "comparison_histogram.png": "Errors of q, u and p over the field, on the grid points and between them.",
    "comparison_map.png": "Maps of the errors of q and u of both methods.",
    "comparison_offset.png": "Where the offsets Δq and Δu of Paper II come from.",
    "comparison_spectral.png": "Efficiencies across the filter, and what the colour of a star changes.",
}


def kind_of_run(folder: Path) -> str:
    """`comparison` or `epoch` for a folder that holds such a document and no fit to report; else `fit`."""
    if (folder / "summary.json").exists():
        return "fit"
    return "comparison" if (folder / COMPARISON).exists() else "epoch" if (folder / EPOCH).exists() else "fit"


def render_other(folder: Path, kind: str) -> tuple[str, tuple[str, ...]]:
    """The HTML text of the page about such a folder, and in words what the folder lacks for it.

    Raises `DataError` for a document that cannot be read or lacks what the page shows.
    """
    path = folder / (COMPARISON if kind == "comparison" else EPOCH)
    document: dict[str, Any] = read_json(path)
    needed = ("on_grid", "between") if kind == "comparison" else ("fits", "moved", "star_errors")
    for key in needed:
        if key not in document:
            raise fail(f"has no {key!r}", file=path, advice="run the command that made it again")
    there = {name: folder / name for name in PICTURES if (folder / name).exists()}
    missing: tuple[str, ...] = ()
    if kind == "comparison":
        missing = tuple(f"{name} is not there." for name in PICTURES if name not in there)
    pictures = [
        (
            "data:image/png;base64," + base64.b64encode(p.read_bytes()).decode("ascii"),
            PICTURES[name],
            PICTURES[name],
        )
        for name, p in there.items()
    ]
    text = environment().get_template(f"{kind}.html").render(
        document=document, name=folder.resolve().name, versions={}, pictures=pictures, missing=missing,
        shown=SHOWN, percent=lambda value: f"{value:.2g}",
    )  # fmt: skip
    return text, missing
