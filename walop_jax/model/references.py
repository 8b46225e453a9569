"""Where the physics of a model comes from: collected from the files that hold the equations, for citation.

Every file of physics states its sources in its head, under `Source`; what is active in a model decides which
of them count. Nothing is cited here that is not cited there.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
from collections.abc import Callable
from types import ModuleType

from walop_jax.model import legendre, materials, optics, plates, quadrature
from walop_jax.model.specification import Model

PAPER_II = (
    "Maharana et al. 2022, WALOP-South: A Four-Camera One-Shot Imaging Polarimeter for PASIPHAE Survey. "
    "Paper II - Polarimetric Modelling and Calibration"
)
_FILTER = "Doi et al. 2010, AJ 139, 1628, Table 4"


@dataclasses.dataclass(frozen=True)
class Reference:
    """A piece of physics and the works that it rests on."""

    what: str
    source: str


def stated_source(docstring: str | None) -> str:
    """What a docstring says under `Source` or `Sources`, on one line; empty when it says nothing."""
    found = re.search(r"^Sources? +(\S.*(?:\n +\S.*)*)", inspect.cleandoc(docstring or ""), re.MULTILINE)
    text = " ".join(found.group(1).split()) if found else ""
    return text.strip().rstrip(",;")


def _has_moon(model: Model) -> bool:
    return model["sky.depolarisation"].free


_BASE: tuple[tuple[str, ModuleType | str, Callable[[Model], bool]], ...] = (
    ("the instrument and its calibration", PAPER_II, lambda model: True),
    ("half-wave plates", plates, lambda model: True),
    ("rays, wedges and pupil", optics, lambda model: True),
    ("glasses and crystals", materials, lambda model: True),
    ("band integral", quadrature, lambda model: True),
    ("throughput over the field", legendre, lambda model: True),
    ("SDSS-r filter curve", _FILTER, lambda model: True),
    ("polarisation of the moonlit sky", "Maharana et al. 2022, Paper II, eq. 8", _has_moon),
)


def references(model: Model) -> tuple[Reference, ...]:
    """The sources of the physics in a model: the base, then its effects in the order light meets them."""
    found = []
    for what, source, applies in _BASE:
        if applies(model):
            text = source if isinstance(source, str) else stated_source(source.__doc__)
            found.append(Reference(what, text))
    for effect in model.template.effects:
        text = stated_source(sys.modules[type(effect).__module__].__doc__)
        found.append(Reference(f"effect {effect.name}", text or "physics of this package; no outside source"))
    return tuple(found)
