"""The line of Python that loads what a page shows."""

from __future__ import annotations

from tupli_mcap.page.shelf import Shelf

__all__ = ["both", "python_line"]


def python_line(shelf: Shelf, filter: str, sort: str = "") -> str:
    """What opens the episodes that a filter is true of; all of them where it is empty."""
    line = f"tupli_mcap.open({shelf.opened_by!r})"
    line += f".filter({filter!r})" if filter else ""
    falling = ", descending=True" if sort.startswith("-") else ""
    return line + (f".sort({sort.removeprefix('-')!r}{falling})" if sort else "")


def both(a: str, b: str) -> str:
    """A filter that is true where two are."""
    given = [text for text in (a, b) if text.strip()]
    return given[0] if len(given) == 1 else " and ".join(f"({text})" for text in given)
