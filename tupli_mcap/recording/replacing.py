"""Files that take the place of another one, or of none, once they are whole."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from tupli_mcap.errors import RecordingError
from tupli_mcap.system import refused

__all__ = ["replacing"]


@contextlib.contextmanager
def replacing(goal: Path, permissions: int = 0o644) -> Iterator[tuple[int, Path]]:
    """A descriptor and the path of a file that becomes `goal`, synced, when the block ends without an error.

    Raises:
        RecordingError: the system refuses, here or in the block; `goal` is as it was.
    """
    temporary = goal.with_name(f".{goal.name}.{os.getpid()}.tmp")
    try:
        fd = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, permissions)
        try:
            yield fd, temporary
            os.fsync(fd)
        finally:
            os.close(fd)
        temporary.replace(goal)
    except BaseException as err:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(err, OSError):
            raise RecordingError(f"{goal} cannot be written: {refused(err)}") from err
        raise
