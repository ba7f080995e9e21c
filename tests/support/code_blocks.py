"""Code in pages: its blocks, and running them as one script."""

from __future__ import annotations

import re
from typing import Any

_BLOCK = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(text: str, language: str) -> list[tuple[int, str]]:
    """The fenced blocks of a language, each with the number of its first line."""
    return [
        (text.count("\n", 0, found.start(2)) + 1, found[2])
        for found in _BLOCK.finditer(text)
        if found[1] == language
    ]


def run_python(text: str) -> dict[str, Any]:
    """Run the Python blocks in order, as one script; returns its names."""
    names: dict[str, Any] = {"__name__": "__main__"}  # classes are stored with their code, as in a script
    for line, code in blocks(text, "python"):
        exec(compile("\n" * (line - 1) + code, "README.md", "exec"), names)
    return names
