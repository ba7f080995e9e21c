"""The name and version of this program, as recordings give them."""

from __future__ import annotations

import functools
from importlib.metadata import version

__all__ = ["library"]


@functools.cache  # reading it takes a millisecond
def library() -> str:
    """The name and the version of this program."""
    return f"tupli-mcap {version('tupli-mcap')}"
