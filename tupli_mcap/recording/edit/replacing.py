"""Writes files that replace another one, if there is one, only when they are whole."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from tupli_mcap import files
from tupli_mcap.errors import RecordingError, os_reason


@contextlib.contextmanager
def replacing(goal: Path, permissions: int = 0o666) -> Iterator[tuple[int, Path]]:
    """Yields a descriptor and a path; the file becomes `goal`, synced, when the block ends without an error.

    Missing directories are made.

    Raises:
        RecordingError: the system refuses, here or in the block; `goal` is unchanged.
    """
    try:
        goal.parent.mkdir(parents=True, exist_ok=True)
        with files.replacing(goal) as new:
            fd = files.create(new, permissions)
            try:
                yield fd, new
            finally:
                os.close(fd)
    except OSError as err:
        raise RecordingError(f"{goal} cannot be written: {os_reason(err)}") from err


def tidy(directory: Path) -> None:
    """Removes files that killed processes left in a directory."""
    with contextlib.suppress(OSError):  # writing there will raise it
        files.remove_left(files.left_in(directory))
