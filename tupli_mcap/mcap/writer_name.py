"""The name and version of this program, as recordings give them."""

from __future__ import annotations

import functools
from importlib.metadata import version


@functools.cache  # it is read from the disk
def library() -> str:
    """The name and the version of this program."""
    return f"tupli-mcap {version('tupli-mcap')}"
