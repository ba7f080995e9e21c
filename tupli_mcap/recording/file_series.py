"""The files of one recording that went on in several: `run.mcap`, `run_0001.mcap`, ..."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path

__all__ = [
    "series",
]


_NUMBERED = re.compile(r"(.+)_([0-9]{4,})\Z")


def series(path: Path) -> tuple[Path, dict[int, Path]]:
    """The first file of the series that a path belongs to, and those that follow it and exist, by number."""
    match = _NUMBERED.match(path.stem)
    base = path if match is None else path.with_stem(match[1])
    if match is not None and not base.exists():
        base = path
    pattern = re.compile(re.escape(base.stem) + r"_([0-9]{4,})" + re.escape(base.suffix) + r"\Z")
    found = {}
    with contextlib.suppress(OSError):
        for name in os.listdir(base.parent):  # noqa: PTH208 - names are all it takes
            if number := pattern.match(name):
                found[int(number[1])] = base.with_name(name)
    return base, dict(sorted(found.items()))
