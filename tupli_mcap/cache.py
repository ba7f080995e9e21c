"""The directory of files that may be deleted at any time, `<cache>`: `$TUPLI_MCAP_CACHE_DIR`, else the platform's user
cache directory."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable
from pathlib import Path

import platformdirs


def cache_dir() -> Path:
    """The cache directory of this user; it need not exist yet."""
    override = os.environ.get("TUPLI_MCAP_CACHE_DIR")
    found = Path(override) if override else platformdirs.user_cache_path("tupli-mcap", appauthor=False)
    return found.absolute()


def make_private(directory: Path) -> None:
    """Make a directory, and those above it that are missing, for this user alone."""
    if not directory.parent.exists():
        make_private(directory.parent)
    directory.mkdir(mode=0o700, exist_ok=True)


def delete_oldest(paths: Iterable[Path], budget: int, delete: Callable[[Path], bool]) -> None:
    """Deletes files, those with the oldest times of change first, until the rest is within a budget of bytes.

    `delete` returns whether it has deleted the file.
    """
    found = []
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            status = path.stat()
            found.append((status.st_mtime_ns, status.st_size, path))
    over = sum(size for _, size, _ in found) - budget
    for _, size, path in sorted(found):
        if over <= 0:
            return
        if delete(path):
            over -= size
