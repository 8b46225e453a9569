"""Where the physics of a model comes from, also as BibTeX: what elements, sources, materials and effects say of it."""

from __future__ import annotations

import dataclasses
import re
import unicodedata
from collections.abc import Iterator, Sequence

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


# ------------------------------------------------------------------------------------------------- as BibTeX

_YEAR = re.compile(r"^(?P<who>[^\d;]+?),? (?P<year>(?:19|20)\d\d), (?P<rest>.+)$")
_ARTICLE = re.compile(r"^(?P<journal>[^,]*?) (?P<volume>[A-Z]?\d+), (?P<page>[A-Z]?\d+)(?P<more>.*)$")
_ARXIV = re.compile(r"arXiv:(\d{4}\.\d{4,5})")
_FULL_NAMES = {
    "A&A": "Astronomy and Astrophysics",
    "AJ": "The Astronomical Journal",
    "PASP": "Publications of the Astronomical Society of the Pacific",
    "JATIS": "Journal of Astronomical Telescopes, Instruments, and Systems",
    "JGR": "Journal of Geophysical Research",
}
SOFTWARE = """@software{walop_jax,
  author  = {{The walop-jax developers}},
  title   = {walop-jax: differentiable end-to-end calibration of the WALOP imaging polarimeters},
  version = {%s}
}"""
_PAPER_II = """@article{maharana2022,
  author  = {Maharana and others},
  title   = {WALOP-South: A Four-Camera One-Shot Imaging Polarimeter for PASIPHAE Survey. Paper II --
             Polarimetric Modelling and Calibration},
  journal = {arXiv e-prints},
  year    = {2022},
  eprint  = {2208.12441}
}"""


def bibtex(found: Sequence[Reference], version: str) -> str:
    """BibTeX entries of the software and of all published works among the sources, each once."""
    entries = {"walop_jax": SOFTWARE % version}
    for reference in found:
        for key, entry in _entries(reference.source):
            entries.setdefault(key, entry)
    return "\n\n".join(entries.values()) + "\n"


def _entries(source: str) -> Iterator[tuple[str, str]]:
    for part in source.split("; "):
        if part == PAPER_II or "Paper II" in part:
            yield "maharana2022", _PAPER_II
            continue
        found = _YEAR.match(part)
        if found is None:
            continue
        key, fields = _key(found["who"], found["year"]), {"author": _authors(found["who"])}
        article, preprint = _ARTICLE.match(found["rest"]), _ARXIV.search(found["rest"])
        kind = "article"
        if article is not None:
            journal = article["journal"]
            fields |= {"journal": _escaped(_FULL_NAMES.get(journal, journal)), "year": found["year"]}
            fields |= {"volume": article["volume"], "pages": article["page"]}
        elif preprint is not None:
            fields |= {"journal": "arXiv e-prints", "year": found["year"], "eprint": preprint[1]}
            key += preprint[1].replace(".", "")
        else:
            kind = "misc"
            fields |= {"title": _escaped(found["rest"]), "year": found["year"]}
        width = max(map(len, fields))
        lines = ",\n".join(f"  {name:<{width}} = {{{value}}}" for name, value in fields.items())
        yield key, f"@{kind}{{{key},\n{lines}\n}}"


def _authors(who: str) -> str:
    names = who.replace(" et al.", ", others").replace(" & ", ", ").replace(" and ", ", ")
    return _escaped(" and ".join(name.strip() for name in names.split(",") if name.strip()))


def _key(who: str, year: str) -> str:
    first = re.split(r",| et al\.| & | and ", who)[0]
    plain = unicodedata.normalize("NFKD", first).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z]", "", plain.lower()) + year


def _escaped(text: str) -> str:
    return text.replace("&", r"\&").replace("_", r"\_")
