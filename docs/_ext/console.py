"""Sphinx's side of cells that are commands: they are coloured as a console."""

from __future__ import annotations

from docutils import nodes
from sphinx.application import Sphinx


def _colour(app: Sphinx, tree: nodes.document) -> None:
    for block in tree.findall(nodes.literal_block):
        if block.astext().startswith("$ "):
            block["language"] = "console"


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("doctree-read", _colour)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
