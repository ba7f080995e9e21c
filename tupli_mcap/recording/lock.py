"""The lock that tells a live writer from a dead one: an advisory lock on the recording's own descriptor."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from pathlib import Path

from tupli_mcap.errors import RecordingError

__all__ = ["FileLock", "is_locked"]

_ATTEMPTS = 5


class FileLock:
    """Opens (or creates) a recording for writing and locks it; `fd` is the descriptor to write with.

    Raises:
        RecordingError: the file exists (mode "x"), is missing (mode "a"), is being written, or cannot be opened.
    """

    def __init__(self, path: Path, mode: str) -> None:
        if mode not in ("x", "w", "a"):
            raise RecordingError(f'mode: expected "x" (new), "w" (replace) or "a" (append), found {mode!r}')
        flags = os.O_RDWR | os.O_CLOEXEC | {"x": os.O_CREAT | os.O_EXCL, "w": os.O_CREAT, "a": 0}[mode]
        try:
            self.fd = os.open(path, flags, 0o644)
        except FileExistsError as err:
            raise RecordingError(
                f'{path} exists and is not overwritten; choose another path, or mode="a" to append, "w" to replace'
            ) from err
        except FileNotFoundError as err:
            hint = (
                "its directory does not exist"
                if mode != "a"
                else 'it does not exist; use mode="x" to create it'
            )
            raise RecordingError(f"{path} cannot be recorded to: {hint}") from err
        except OSError as err:
            raise RecordingError(
                f"{path} cannot be recorded to: {err.strerror}; choose a writable place"
            ) from err
        for attempt in range(
            _ATTEMPTS
        ):  # a reader that asks whether the writer lives holds the lock for a moment
            try:
                fcntl.flock(self.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError as err:
                if attempt + 1 < _ATTEMPTS:
                    time.sleep(0.01)
                    continue
                os.close(self.fd)
                raise RecordingError(f"{path} is being recorded by another writer; close it first") from err
        self._open = True

    def release(self) -> None:
        """Unlocks and closes."""
        if self._open:
            self._open = False
            os.close(self.fd)

    def abandon(self) -> None:
        """Closes a forked child's copy of the descriptor, which leaves the parent's lock alone."""
        self.release()


def is_locked(path: Path) -> bool:
    """True if a live writer holds the recording."""
    with contextlib.suppress(OSError):
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
        finally:
            os.close(fd)
    return False
