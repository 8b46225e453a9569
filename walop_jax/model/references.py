"""Where the physics of a model comes from: what its elements, sources, materials and effects say of themselves."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from walop_jax.model import legendre, quadrature
from walop_jax.model.elements import WavePlate, Wedge
from walop_jax.model.elements.base import Element
from walop_jax.model.instrument import Instrument
from walop_jax.model.materials import CRYSTALS, GLASSES
from walop_jax.model.specification import Model

PAPER_II = (
    "Maharana et al. 2022, WALOP-South: A Four-Camera One-Shot Imaging Polarimeter for PASIPHAE Survey. "
    "Paper II - Polarimetric Modelling and Calibration"
)
_OWN = "physics of this package; no outside source"


@dataclasses.dataclass(frozen=True)
class Reference:
    """A piece of physics and the works that it rests on."""

    what: str
    source: str


def _materials(element: Element) -> Iterator[Reference]:
    if isinstance(element, Wedge):
        yield Reference(element.material, GLASSES[element.material].source)
    if isinstance(element, WavePlate):
        for layer in element.layers:
            yield Reference(layer.material, CRYSTALS[layer.material].source)


def _optics(instrument: Instrument) -> Iterator[Reference]:
    behind = [element for arm in instrument.arms for element in (*arm.train(), arm.analyser)]
    elements = [*instrument.train(), *behind]
    for element in elements:
        if element.reference:
            yield Reference(element.kind.replace("_", " "), element.reference)
    for element in elements:
        yield from _materials(element)


def references(model: Model) -> tuple[Reference, ...]:
    """The sources of the physics in a model, each once: the base in the order light meets it, then its effects."""
    instrument = model.template
    found = [Reference("the instrument and its calibration", PAPER_II), *_optics(instrument)]
    found.append(Reference("band integral", quadrature.SOURCE))
    found.append(Reference("SDSS-r filter curve", "Doi et al. 2010, AJ 139, 1628, Table 4"))
    found.append(Reference("throughput over the field", legendre.SOURCE))
    for source in instrument.sources:
        used = any(model.parameters[i].free for i in model.positions(source.name))
        if source.reference and used:
            found.append(Reference(f"light of KIND {source.kind}", source.reference))
    found += [Reference(f"effect {effect.name}", effect.reference or _OWN) for effect in instrument.effects]
    return tuple(dict.fromkeys(found))
