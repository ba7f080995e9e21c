"""Files that take the place of another one, or of none, once they are whole."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from tupli_mcap import files
from tupli_mcap.errors import RecordingError, os_reason


@contextlib.contextmanager
def replacing(goal: Path, permissions: int = 0o666) -> Iterator[tuple[int, Path]]:
    """A descriptor and the path of a file that becomes `goal`, synced, when the block ends without an error.

    Directories that are missing are made.

    Raises:
        RecordingError: the system refuses, here or in the block; `goal` is as it was.
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
    """Removes what killed processes have left in a directory that is about to be written to."""
    with contextlib.suppress(OSError):  # whoever writes there will say it
        files.remove_left(files.left_in(directory))
