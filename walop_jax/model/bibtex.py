"""Sources as BibTeX: what the code says of where its physics comes from, in the form that papers take."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Sequence

from walop_jax.model.references import PAPER_II, Reference

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
