"""Configuration of the site: `sphinx-build -W -b html walop_jax/docs SITE`, with the dependency group `site`.

The pages are those that `walop-jax docs` shows. Three directives make text from the package, which is not copied:
the reference of the commands, that of the public names, and a gallery of the notebooks.
"""

from __future__ import annotations

import base64
import inspect
import json
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import walop_jax
from walop_jax.commands import COMMANDS

project, author, release = "walop-jax", "The walop-jax developers", walop_jax.__version__
extensions = ["myst_parser", "sphinx.ext.mathjax"]
myst_heading_anchors = 3
html_theme = "pydata_sphinx_theme"
html_theme_options = {"show_prev_next": False, "secondary_sidebar_items": ["page-toc"]}
html_show_sourcelink = False
html_sidebars: dict[str, list[str]] = {
    "**": []
}  # all pages are in the bar at the top: no empty column beside the text
exclude_patterns = ["build"]
NOTEBOOKS = Path(walop_jax.__file__).parents[1] / "notebooks"


class Commands(SphinxDirective):
    """A section for every command: its docstring and its options."""

    def run(self) -> list[nodes.Node]:
        """The sections about the commands, each made of its help."""
        parts = []
        for name in COMMANDS:
            command = getattr(walop_jax, name.replace("-", "_")).command
            words = [o.metavar or k for k, o in command.options.items() if o.placed]
            parts += [f"## {name}", f"    walop-jax {name} {' '.join(words)}".rstrip()]
            parts.append(inspect.cleandoc(command.body.__doc__ or ""))
            options = {k: o for k, o in command.options.items() if not o.placed}
            options |= {"overwrite": command.described["overwrite"]} if command.writes is not None else {}
            if options:
                rows = [f"| `--{k.replace('_', '-')}` | {o.help} |" for k, o in options.items()]
                parts.append("\n".join(["| option | meaning |", "| --- | --- |", *rows]))
        return self.parse_text_to_nodes("\n\n".join(parts), allow_section_headings=True)


class Names(SphinxDirective):
    """A section for every public name that is not a command: its signature and its docstring."""

    def run(self) -> list[nodes.Node]:
        """The sections about the public names, each made of its docstring."""
        parts = []
        commands = {name.replace("-", "_") for name in COMMANDS}
        for name in sorted(set(walop_jax.__all__) - commands - {"Scalar", "EFFECTS"}):
            found = getattr(walop_jax, name)
            parts += [f"## walop.{name}", inspect.cleandoc(found.__doc__ or "")]
            if inspect.isfunction(found):
                arguments = ", ".join(inspect.signature(found).parameters)
                parts.insert(-1, f"```python\n{name}({arguments})\n```")
        return self.parse_text_to_nodes("\n\n".join(parts), allow_section_headings=True)


class Gallery(SphinxDirective):
    """The last picture of every notebook, below its title."""

    def run(self) -> list[nodes.Node]:
        """Titles and pictures, written beside the page as it is built."""
        target = Path(self.env.app.outdir) / "_images"
        target.mkdir(parents=True, exist_ok=True)
        found: list[nodes.Node] = []
        for path in sorted(NOTEBOOKS.glob("*.ipynb")):
            cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
            title = next(
                line.lstrip("# ").strip() for c in cells for line in c["source"] if line.startswith("#")
            )
            outputs = [o.get("data", {}) for c in cells for o in c.get("outputs", [])]
            pictures = [data["image/png"] for data in outputs if "image/png" in data]
            found.append(nodes.rubric(text=title))
            if pictures:
                (target / f"{path.stem}.png").write_bytes(base64.b64decode(pictures[-1]))
                source = (
                    f'<img src="../_images/{path.stem}.png" alt="The last figure of the notebook: {title}">'
                )
                found.append(nodes.raw("", source, format="html"))
        return found


def setup(app: Sphinx) -> None:
    """Register the directives with Sphinx."""
    app.add_directive("walop-commands", Commands)
    app.add_directive("walop-names", Names)
    app.add_directive("walop-gallery", Gallery)
