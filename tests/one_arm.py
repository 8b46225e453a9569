"""Descriptions of instruments of one arm: elements ahead of it, and an analyser with its cameras."""

from __future__ import annotations

import json
from collections.abc import Sequence

POLARISER = """
[elements.polariser]
kind = "polariser"
moves = "CLP"
"""


def one_arm(
    name: str,
    path: Sequence[str],
    elements: str,
    *,
    head: str = "",
    field: str = "limit = 0.1",
    cameras: Sequence[str] = ("a", "b"),
    degree: int = 0,
    analyser: str = "",
) -> str:
    """A description in TOML; `head` is what it says of itself, `analyser` what of the analyser beside its cameras."""
    listed = json.dumps(list(cameras))
    return f"""
name = "{name}"
path = {json.dumps(list(path))}
{head}
[field]
{field}
[cameras]
names = {listed}
[throughput]
degree = {degree}
{elements}
[arms.main]
path = ["analyser"]
[arms.main.elements.analyser]
kind = "analyser"
cameras = {listed}
{analyser}
"""
