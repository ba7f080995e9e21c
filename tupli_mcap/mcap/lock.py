"""The lock that tells a live writer from a dead one: an advisory lock on the recording's own descriptor.

A forked child has a copy of every descriptor, and a copy holds the lock as well: a child that outlives a killed writer
would go on holding it. So this module notes the descriptors of locks, and a child closes its copies before it does
anything else.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import os
import stat
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tupli_mcap import files
from tupli_mcap.errors import RecordingError, asking, os_reason

_BUSY = (errno.EAGAIN, errno.EACCES)
_PATIENCE = 2.0  # seconds to wait for readers that ask whether the writer lives
_guard = threading.RLock()  # held while a descriptor is opened and noted, so that no fork comes between
_private: weakref.WeakSet[io.FileIO] = weakref.WeakSet()


def open_private(
    path: str | os.PathLike[str], mode: str, opener: Callable[[str, int], int] | None = None
) -> io.FileIO:
    """Opens a file that no child process keeps open, whether it was forked or started as another program.

    If an interrupt keeps the file from its owner, its last reference closes it.
    """
    with _guard:
        file = io.FileIO(path, mode, opener=opener or partial(os.open, mode=0o666))
        _private.add(file)
    return file


def _close_private(file: io.FileIO) -> None:
    """Unlocks and closes a file of `open_private`; does nothing in a child, where it is closed already."""
    with _guard:
        if not file.closed:
            try:
                # a child that C code forked may have a copy
                fcntl.flock(file, fcntl.LOCK_UN)
            finally:
                file.close()


def drop_private(file: io.FileIO | None) -> None:
    """Closes a file that nothing was written to, and ignores errors."""
    if file is not None:
        with contextlib.suppress(OSError):
            _close_private(file)


def _drop_in_child() -> None:
    global _guard
    _guard = threading.RLock()
    for file in list(_private):
        with contextlib.suppress(OSError):
            file.close()


os.register_at_fork(
    before=lambda: _guard.acquire(), after_in_parent=lambda: _guard.release(), after_in_child=_drop_in_child
)


class LockedError(RecordingError):
    """Somebody else writes to the recording."""


class FileLock:
    """A recording opened for writing and locked; `fd` is the descriptor to write with.

    A new file is made under another name; `publish` puts it at its path, locked, so that nobody finds a file without
    its first records. Until then the file that it will replace stays, locked too. Readers that have the replaced file
    open keep it.

    RecordingError if the file exists (mode "x"), is missing (mode "a"), is being written, or cannot be opened.
    """

    def __init__(self, path: Path, mode: str) -> None:
        if mode not in ("x", "w", "a"):
            raise RecordingError(f'mode: expected "x" (new), "w" (replace) or "a" (append), found {mode!r}')
        self._shown, self._path = path, Path(os.path.realpath(path))
        self._process = os.getpid()
        self._temporary: Path | None = None
        self._file: io.FileIO | None = None
        self._old: io.FileIO | None = None
        try:
            self._open(path, mode)
        except BaseException:
            with contextlib.suppress(RecordingError):  # the first error says why
                self.release()
            raise

    def _open(self, path: Path, mode: str) -> None:
        if mode == "x" and os.path.lexists(path):
            raise _exists(path)
        if mode == "a" or (mode == "w" and path.exists()):
            self._old = _open_locked(path, hint='use mode="x" to create it')
        if self._old is not None and (mode == "a" or not stat.S_ISREG(os.fstat(self._old.fileno()).st_mode)):
            self._file, self._old = self._old, None
            return
        self._temporary = files.temporary_path(self._path.parent)
        try:
            self._file = open_private(self._temporary, "x+")
        except OSError as err:
            self._temporary = None
            reason = os_reason(err)
            if isinstance(err, FileNotFoundError):
                reason = "its directory does not exist; make it"
            elif self._old is not None:
                reason = f"{reason}; a new file is made beside the one that it replaces"
            raise RecordingError(f"{self._shown} cannot be recorded to: {reason}") from err
        _lock(self._file.fileno(), self._shown)

    @property
    def fd(self) -> int:
        """The descriptor to write with; -1 once it is released."""
        return -1 if self._file is None or self._file.closed else self._file.fileno()

    @property
    def replaces(self) -> bool:
        """True while the file that `publish` will replace is still there."""
        return self._old is not None

    def publish(self) -> None:
        """Puts a new file at its path; RecordingError if somebody else has made one there."""
        if self._temporary is None:
            return
        try:
            is_there = self._old is not None and _is_at(self._old.fileno(), self._path)
            files.put(self._temporary, self._path, overwrite=is_there)
        except FileExistsError as err:
            raise _exists(self._shown) from err
        except OSError as err:
            raise RecordingError(f"{self._shown} cannot be recorded to: {os_reason(err)}") from err
        self._temporary = None
        drop_private(self._old)
        self._old = None

    @property
    def is_deleted(self) -> bool:
        """True if somebody deleted the file after it was published."""
        with contextlib.suppress(OSError):
            return self._temporary is None and os.fstat(self.fd).st_nlink == 0
        return False

    def unlink(self) -> None:
        """Removes the file from its path, if it was published and is still there."""
        if self._temporary is None and self.fd >= 0:
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(self.fd), self._path.stat()):
                    self._path.unlink()

    def release(self) -> None:
        """Unlocks and closes the file, and removes it if it was not published. Does nothing in a forked child.
        RecordingError if a file system that writes late (NFS) lost something."""
        if self._process != os.getpid():
            return
        if self._temporary is not None:
            with contextlib.suppress(OSError):
                self._temporary.unlink()
            self._temporary = None
        drop_private(self._old)
        self._old = None
        if self._file is None:
            return
        try:
            _close_private(self._file)
        except OSError as err:
            raise RecordingError(f"{self._shown} could not be closed: {os_reason(err)}") from err


def _exists(path: Path) -> RecordingError:
    append, replace = asking('mode="a"', "--mode a"), asking('mode="w"', "--mode w")
    return RecordingError(
        f"{path} exists and is not overwritten; choose another path, or {append} to append, {replace} to replace; "
        "a directory gets a new file each time"
    )


@contextlib.contextmanager
def writers_kept_out(path: Path) -> Iterator[None]:
    """Holds the lock of a recording, so that nobody writes to it while it is read, replaced or deleted; RecordingError
    if somebody is writing to it, or it is gone."""
    file = _open_locked(path, mode="r", hint="it was deleted")
    try:
        yield
    finally:
        drop_private(file)


def _open_locked(path: Path, *, mode: str = "r+", hint: str) -> io.FileIO:
    # again, if it is deleted or replaced between opening and locking: whatever is written to it would be lost
    while True:
        file: io.FileIO | None = None
        try:
            file = open_private(path, mode)
            _lock(file.fileno(), path)
            if _is_at(file.fileno(), path):
                found, file = file, None
                return found
        except FileNotFoundError as err:
            raise RecordingError(f"{path} cannot be recorded to: it does not exist; {hint}") from err
        except IsADirectoryError as err:
            raise RecordingError(f"{path} is a directory; give one file, a recording (.mcap)") from err
        except OSError as err:
            raise RecordingError(f"{path} cannot be recorded to: {os_reason(err)}") from err
        finally:
            drop_private(file)


def _lock(fd: int, path: Path) -> None:
    """Takes the writer's lock. Waits for readers, which take a shared lock for a moment to ask for a writer."""
    deadline = time.monotonic() + _PATIENCE
    while True:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except OSError as err:
            if err.errno not in _BUSY:
                raise RecordingError(f"{path} cannot be locked: {os_reason(err)}") from err
            if time.monotonic() > deadline or not _try_shared(fd):
                raise LockedError(
                    f"{path} is being recorded by another writer, perhaps an earlier one in this program; close it, "
                    "or, if a command such as tag is changing the file, try again after it"
                ) from err
        time.sleep(0.001)


def _try_shared(fd: int) -> bool:
    """True if no writer holds the lock."""
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as err:
        if err.errno not in _BUSY:
            raise
        return False
    fcntl.flock(fd, fcntl.LOCK_UN)
    return True


def _is_at(fd: int, path: Path) -> bool:
    """Whether the file of a descriptor is still the one at the path; devices and pipes pass."""
    found = os.fstat(fd)
    if not stat.S_ISREG(found.st_mode):
        return True
    try:
        return os.path.samestat(found, path.stat())
    except FileNotFoundError:
        return False


def is_locked(path: Path) -> bool:
    """True if a live writer holds the recording; False if there is no file, or this user may not open it.
    RecordingError if the system does not say (too many open files, for example): there may be a writer."""
    try:
        # does not wait for the other end of a pipe
        file = open_private(path, "r", lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
        try:
            return not _try_shared(file.fileno())
        finally:
            drop_private(file)
    except (FileNotFoundError, PermissionError):
        return False
    except IsADirectoryError as err:
        raise RecordingError(f"{path} is a directory; give one file, a recording (.mcap)") from err
    except OSError as err:
        raise RecordingError(f"{path}: cannot tell whether it is being recorded: {os_reason(err)}") from err
