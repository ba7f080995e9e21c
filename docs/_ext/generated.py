"""What pages say that the program knows: `<!-- generated: NAME ARGUMENT -->` is replaced when a page is read."""

from __future__ import annotations

import re
from collections.abc import Callable

import api
import changes
import commands
import house
import routes
import words
from sphinx.application import Sphinx

_MARK = re.compile(r"^<!-- generated: (\w+)(?: (\S+))? -->$", re.MULTILINE)
_MAKERS: dict[str, Callable[..., str]] = {
    "api": api.documented,
    "changes": changes.unreleased,
    "commands": commands.documented,
    "keys": words.filter_keys,
    "checks": words.checks,
    "extras": words.extras,
    "layers": house.layers,
    "routes": routes.documented,
}


def replaced(text: str) -> str:
    """A page's text with everything generated in its place."""
    return _MARK.sub(lambda mark: _MAKERS[mark[1]](*filter(None, [mark[2]])), text)


def _read(app: Sphinx, page: str, source: list[str]) -> None:
    source[0] = replaced(source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", _read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
