"""The lock that tells a live writer from a dead one: an advisory lock on the recording's own descriptor.

A lock belongs to what a descriptor has opened, and a forked child has a copy of every descriptor: a child that outlives
a killed writer would go on holding its lock. So the descriptors of locks are noted here, and a child closes its copies
before it does anything else.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
import stat
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from tupli_mcap.errors import RecordingError
from tupli_mcap.system import refused

__all__ = ["FileLock", "drop_private", "is_locked", "open_private", "writers_kept_out"]

_BUSY = (errno.EAGAIN, errno.EACCES)
_PATIENCE = 2.0  # seconds to wait for those who only ask whether the writer lives
_guard = threading.RLock()  # no fork between opening a descriptor and noting it
_private: set[int] = set()


def open_private(path: str | os.PathLike[str], flags: int, mode: int = 0o666) -> int:
    """A descriptor that children do not get, neither those that go on as a copy nor those that start a program."""
    with _guard:
        fd = os.open(path, flags | os.O_CLOEXEC, mode)
        _private.add(fd)
    return fd


def _close_private(fd: int) -> None:
    """Unlocks and closes such a descriptor; in a child, where it is closed already, nothing happens."""
    with _guard:
        if fd not in _private:
            return
        _private.discard(fd)
        try:
            # a child that was forked by other means than Python's may have a copy
            fcntl.flock(fd, fcntl.LOCK_UN)
        finally:
            os.close(fd)


def drop_private(fd: int) -> None:
    """Closes a descriptor that nothing was written to: what the system says then is of no use."""
    with contextlib.suppress(OSError):
        _close_private(fd)


def _drop_in_child() -> None:
    global _guard
    _guard = threading.RLock()
    for fd in _private:
        with contextlib.suppress(OSError):
            os.close(fd)
    _private.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=lambda: _guard.acquire(),
        after_in_parent=lambda: _guard.release(),
        after_in_child=_drop_in_child,
    )


class FileLock:
    """A recording opened for writing and locked; `fd` is the descriptor to write with.

    A new file is made under another name, and is at its path, locked, from `publish` on: nobody finds a file without
    its first records. Readers of a file that is replaced keep the old one.

    Raises:
        RecordingError: the file exists (mode "x"), is missing (mode "a"), is being written, or cannot be opened.
    """

    def __init__(self, path: Path, mode: str) -> None:
        if mode not in ("x", "w", "a"):
            raise RecordingError(f'mode: expected "x" (new), "w" (replace) or "a" (append), found {mode!r}')
        self._shown, self._path = path, Path(os.path.realpath(path))
        self._process = os.getpid()
        self._temporary: Path | None = None
        self._old = -1
        if mode == "x" and os.path.lexists(path):
            raise _exists(path)
        if mode == "a" or (mode == "w" and path.exists()):
            self._old = _open_locked(path, hint='use mode="x" to create it')
        if mode == "a" or (self._old >= 0 and not stat.S_ISREG(os.fstat(self._old).st_mode)):
            self.fd, self._old = self._old, -1
        else:
            self.fd = self._make()

    def _make(self) -> int:
        temporary = self._path.with_name(f".{secrets.token_hex(8)}.tmp")
        try:
            fd = open_private(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
        except OSError as err:
            if self._old >= 0 and isinstance(err, PermissionError):
                fd, self._old = self._old, -1  # a file that may be written, in a directory that may not
                return fd
            self._close_old()
            reason = refused(err)
            if isinstance(err, FileNotFoundError):
                reason = "its directory does not exist; make it"
            raise RecordingError(f"{self._shown} cannot be recorded to: {reason}") from err
        try:
            _lock(fd, self._shown)
        except BaseException:
            self._close_old()
            drop_private(fd)
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
        self._temporary = temporary
        return fd

    def publish(self) -> None:
        """Puts a new file at its path.

        Raises:
            RecordingError: somebody else has made one there.
        """
        if self._temporary is None:
            return
        try:
            if self._old >= 0:
                self._temporary.replace(self._path)
            else:
                _link(self._temporary, self._path)
        except FileExistsError as err:
            raise _exists(self._shown) from err
        except OSError as err:
            raise RecordingError(f"{self._shown} cannot be recorded to: {refused(err)}") from err
        self._temporary = None
        self._close_old()

    @property
    def is_deleted(self) -> bool:
        """True if somebody has taken the file's last name since it was published."""
        with contextlib.suppress(OSError):
            return self._temporary is None and os.fstat(self.fd).st_nlink == 0
        return False

    def release(self) -> None:
        """Unlocks and closes, and removes a file that was not published; in a forked child, where the descriptors are
        closed already, nothing happens.

        Raises:
            RecordingError: a file system that writes late (NFS) has lost something.
        """
        if self._process != os.getpid():
            return
        temporary, self._temporary = self._temporary, None
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()
        fd, self.fd = self.fd, -1
        self._close_old()
        try:
            _close_private(fd)
        except OSError as err:
            raise RecordingError(f"{self._shown} could not be closed: {refused(err)}") from err

    def _close_old(self) -> None:
        fd, self._old = self._old, -1
        drop_private(fd)


def _exists(path: Path) -> RecordingError:
    return RecordingError(
        f'{path} exists and is not overwritten; choose another path, or mode="a" to append, "w" to replace'
    )


def _link(temporary: Path, path: Path) -> None:
    """Gives a file its name unless there is one of that name."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, "exists", str(path)) from None
        temporary.rename(path)
        return
    with contextlib.suppress(OSError):
        temporary.unlink()


@contextlib.contextmanager
def writers_kept_out(path: Path) -> Iterator[None]:
    """Nobody writes to a recording while it is read, replaced or deleted.

    Raises:
        RecordingError: somebody does, or it is gone.
    """
    fd = _open_locked(path, flags=os.O_RDONLY, hint="it was deleted")
    try:
        yield
    finally:
        drop_private(fd)


def _open_locked(path: Path, *, flags: int = os.O_RDWR, hint: str) -> int:
    while True:
        try:
            fd = open_private(path, flags)
        except FileNotFoundError as err:
            raise RecordingError(f"{path} cannot be recorded to: it does not exist; {hint}") from err
        except OSError as err:
            raise RecordingError(f"{path} cannot be recorded to: {refused(err)}") from err
        try:
            _lock(fd, path)
            if _is_at(fd, path):
                return fd
        except BaseException as err:
            drop_private(fd)
            if isinstance(err, OSError):
                raise RecordingError(f"{path} cannot be recorded to: {refused(err)}") from err
            raise
        # it was deleted or replaced between opening and locking: what is written to it would be lost
        drop_private(fd)


def _lock(fd: int, path: Path) -> None:
    """Takes the writer's lock. Those who ask for it hold a shared one for a moment: they are waited for."""
    deadline = time.monotonic() + _PATIENCE
    while True:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except OSError as err:
            if err.errno not in _BUSY:
                raise RecordingError(f"{path} cannot be locked: {refused(err)}") from err
            if time.monotonic() > deadline or not _try_shared(fd):
                raise RecordingError(f"{path} is being recorded by another writer; close it first") from err
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
    """True if a live writer holds the recording.

    Raises:
        RecordingError: the system does not say (too many open files, say): there may be one.
    """
    try:
        fd = open_private(path, os.O_RDONLY | os.O_NONBLOCK)  # no pipe is waited for
        try:
            return not _try_shared(fd)
        finally:
            drop_private(fd)
    except (FileNotFoundError, PermissionError):
        return False
    except OSError as err:
        raise RecordingError(f"{path}: cannot tell whether it is being recorded: {refused(err)}") from err
