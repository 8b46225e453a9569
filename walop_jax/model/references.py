"""Sources of the physics of a model, also as BibTeX: those of elements, sources, materials and effects."""

from __future__ import annotations

import dataclasses
import functools
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from importlib.resources import files

from walop_jax.data.settings import DEFAULT_FILTER
from walop_jax.model import legendre, quadrature
from walop_jax.model.elements.geometry import Wedge
from walop_jax.model.elements.wave_plate import WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.materials import CRYSTALS, GLASSES
from walop_jax.model.sources import COLOUR_OF_STANDARDS
from walop_jax.model.specification import Model

_OWN = "physics of this package; no outside source"


@dataclasses.dataclass(frozen=True)
class Reference:
    """A piece of physics and its published works."""

    what: str
    source: str


class References(tuple[Reference, ...]):
    """Several references, printed as a line each."""

    __slots__ = ()

    def __repr__(self) -> str:
        return "\n".join(f"{entry.what}: {entry.source}" for entry in self)


def _optics(instrument: Instrument) -> Iterator[Reference]:
    behind = [element for arm in instrument.arms for element in (*arm.train(), arm.analyser)]
    elements = [*instrument.train(), *behind]
    for element in elements:
        yield Reference(element.kind.replace("_", " "), element.reference)
    for element in elements:
        if isinstance(element, Wedge):
            yield Reference(element.material, GLASSES[element.material].source)
        for layer in element.layers if isinstance(element, WavePlate) else ():
            yield Reference(layer.material, CRYSTALS[layer.material].source)


def references(model: Model, filters: Iterable[str] = ()) -> tuple[Reference, ...]:
    """The sources of the physics in a model, each once: the base in the order of the light path, then its effects.

    `filters` are the names of the used ones: built-in curves have a source.
    """
    instrument = model.template
    filter_source = "Doi et al. 2010, AJ 139, 1628, Table 4" if DEFAULT_FILTER in set(filters) else ""
    entries = [
        Reference("the instrument and its calibration", instrument.source),
        *_optics(instrument),
        Reference("band integral", quadrature.SOURCE),
        Reference(f"{DEFAULT_FILTER} filter curve", filter_source),
        Reference("colour of standards", COLOUR_OF_STANDARDS if instrument.standard.bands else ""),
        Reference("throughput over the field", legendre.SOURCE),
    ]
    for source in instrument.sources:
        if any(model.parameters[i].free for i in model.positions(source.name)):
            entries.append(Reference(f"light of KIND {source.kind}", source.reference))
    entries += [Reference(f"effect {e.name}", e.kind.reference or _OWN) for e in instrument.effects]
    return tuple(dict.fromkeys(entry for entry in entries if entry.source))


# ------------------------------------------------------------------------------------------------- as BibTeX

_YEAR = re.compile(r"^(?P<who>[^\d;]+?),? (?P<year>(?:19|20)\d\d), (?P<rest>.+)$")
_SOFTWARE = ("jax2018", "equinox2021", "optimistix2024", "astropy2022")
_OF_SAMPLES = ("emcee2013", "arviz2019")


@functools.cache
def _library() -> dict[str, str]:
    """The entries of `references.bib` by key."""
    text = (files("walop_jax.model") / "references.bib").read_text(encoding="utf-8")
    return {match[1]: match[0].strip() for match in re.finditer(r"@\w+{(\w+),.*?\n}", text, re.DOTALL)}


def bibtex(found: Sequence[Reference], version: str, *, sampled: bool = False) -> str:
    """BibTeX entries of this software, of all published works among the sources, and of the packages beneath.

    `sampled`: those of the posterior as well. A work missing from `references.bib` becomes an entry from its source.
    """
    library = _library()
    entries = {"walop_jax": library["walop_jax"].replace("VERSION", version)}
    for reference in found:
        for work in reference.source.split("; "):
            key = "maharana2022" if "Paper II" in work else _key(work)
            if key in library:
                entries[key] = library[key]
            elif (plain := _YEAR.match(work)) is not None:
                who = plain["who"].replace(" et al.", " and others").replace(" & ", " and ")
                fields = {"author": who, "note": work, "year": plain["year"]}
                listed = ",\n".join(f"  {name:<6} = {{{value}}}" for name, value in fields.items())
                entries[key] = f"@misc{{{key},\n{listed}\n}}".replace("&", r"\&").replace("_", r"\_")
    entries |= {key: library[key] for key in (*_SOFTWARE, *(_OF_SAMPLES if sampled else ()))}
    return "\n\n".join(entries.values()) + "\n"


def _key(work: str) -> str:
    """Family name of the first author and the year, that of the library for a work without one."""
    match = _YEAR.match(work)
    first = re.split(r",| et al\.| & | and ", match["who"] if match else work)[0]
    plain = unicodedata.normalize("NFKD", first).encode("ascii", "ignore").decode()
    name = re.sub(r"[^a-z]", "", plain.lower())
    if match:
        return name + match["year"]
    return next((key for key in _library() if key.rstrip("0123456789") == name), name)
