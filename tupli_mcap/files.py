"""Atomic writes: the only module that makes temporary files and puts files at their paths.

1. A new file is written in a new directory beside its goal. That directory has a random name, and only its owner may
   enter it, so nobody can prepare anything in it, such as a symbolic link.
2. The writer holds a lock on the directory until the file is at its goal. A process that dies loses the lock.
3. The file is synced, then renamed to its goal, or linked if nothing may be replaced; then the directory is synced.

So the goal is always the old file or the new one, and a temporary file without a lock was left by a killed process.
The temporary files of recordings and journals are not in directories, and are locked themselves.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import secrets
import shutil
import signal
import stat
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType

_NEW = "new"  # name of the file in its directory; without a suffix it does not look like a recording
_TEMPORARY = re.compile(r"\.tupli-mcap-[0-9a-f]{32}\.tmp|.+\.journal\.tmp")
_MOMENT = 60.0  # seconds after which a writer has surely locked its new file
_NO_SYNC = (errno.EINVAL, errno.ENOTSUP)  # not every file system syncs directories


def temporary_path(directory: Path) -> Path:
    """A random path for a temporary file in a directory."""
    return directory / f".tupli-mcap-{secrets.token_hex(16)}.tmp"


def create(path: Path, permissions: int = 0o666) -> int:
    """A descriptor of a new, empty file; a file at its path is removed first. Raises OSError if the system refuses, or
    somebody else makes a file there at the same time."""
    path.unlink(missing_ok=True)  # also a link that somebody has prepared
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, permissions)


def hold(fd: int) -> None:
    """Takes the lock of a file or directory, which says that it is in use, and waits for it. It is held as long as
    anybody has the descriptor, or a map of it."""
    with contextlib.suppress(OSError):  # no locks there: then nobody can tell that it is unheld either
        fcntl.flock(fd, fcntl.LOCK_EX)


@contextlib.contextmanager
def alone_in(directory: Path) -> Iterator[None]:
    """Holds the lock of a directory within the block, and waits for others who hold it: processes, and threads of this
    one. It is not reentrant. Raises OSError if there is no such directory."""
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        hold(fd)
        yield
    finally:
        with contextlib.suppress(OSError):  # a forked child may have the descriptor, too
            fcntl.flock(fd, fcntl.LOCK_UN)
        os.close(fd)


@contextlib.contextmanager
def replacing(goal: Path, *, overwrite: bool = True) -> Iterator[Path]:
    """Yields the path of a file to make; it becomes `goal` when the block ends without an error.

    The block may make a directory instead, whose files it has to sync; a directory replaces nothing, so pass
    `overwrite=False`.

    Raises:
        FileExistsError: `goal` exists by then, without `overwrite`.
        OSError: the system refuses; `goal` is unchanged.
    """
    if "\0" in str(goal):  # a ValueError, where the new file gets its name
        raise OSError(errno.EINVAL, "its name has a NUL", str(goal))
    with private_directory(goal.parent, shown=goal) as directory:
        new = directory / _NEW
        yield new
        sync(new)
        put(new, goal, overwrite=overwrite)
        with contextlib.suppress(OSError):  # the file is there, even if its name may not survive a power loss
            sync(goal.parent)


@contextlib.contextmanager
def private_directory(parent: Path, *, shown: Path) -> Iterator[Path]:
    """A directory that only this user may enter, and that goes with what is in it when the block ends.

    `shown` is what the system's errors name instead of it.
    """
    directory, fd = temporary_path(parent), -1
    try:
        directory.mkdir(mode=0o700)
        fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        hold(fd)
        yield directory
    except OSError as err:
        if err.filename is not None and os.fsdecode(err.filename).startswith(str(directory)):
            err.filename = str(shown)  # nobody knows the file by its other name
        raise
    finally:
        _remove(directory)
        if fd >= 0:
            with contextlib.suppress(OSError):  # nothing was written to it
                os.close(fd)


def write_bytes(goal: Path, data: bytes, *, overwrite: bool = True, permissions: int = 0o666) -> None:
    """Writes a file atomically; raises as `replacing` does."""
    with replacing(goal, overwrite=overwrite) as new, os.fdopen(create(new, permissions), "wb") as file:
        file.write(data)


def put(new: Path, goal: Path, *, overwrite: bool) -> None:
    """Gives a file its path; with `overwrite` it replaces the file there, else a FileExistsError is raised."""
    if overwrite:
        new.replace(goal)
        return
    try:
        os.link(new, goal)
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        if os.path.lexists(goal):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(goal)) from None
        new.rename(goal)
        return
    with contextlib.suppress(OSError):
        new.unlink()


def sync(path: Path) -> None:
    """Waits until a file, or the names in a directory, are on the disk; raises OSError if the disk refuses."""
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    except OSError as err:
        if err.errno not in _NO_SYNC:
            raise
    finally:
        os.close(fd)


# ---- files left by killed processes


def is_temporary(name: str) -> bool:
    """Whether a file with this name is a temporary one."""
    return _TEMPORARY.fullmatch(name) is not None


def left_in(directory: Path) -> list[Path]:
    """The temporary files of killed processes in a directory, without its subdirectories; raises OSError if the
    directory cannot be read."""
    found = sorted(name for name in os.listdir(directory) if is_temporary(name))  # noqa: PTH208 - names only
    return [path for path in map(directory.joinpath, found) if _is_left(path)]


def left_below(root: Path) -> Iterator[Path]:
    """The temporary files of killed processes in a directory and its subdirectories; links are not followed."""
    for directory, below, names in os.walk(root):
        place = Path(directory)
        temporary = sorted(name for name in (*below, *names) if is_temporary(name))
        below[:] = sorted(set(below).difference(temporary))
        yield from (path for path in map(place.joinpath, temporary) if _is_left(path))


def remove_left(paths: Iterable[Path]) -> int:
    """Removes temporary files that nobody holds; returns the number of bytes freed."""
    freed = 0
    for path in paths:
        with _unheld(path) as unheld, contextlib.suppress(OSError):
            if unheld:
                size = sum(_size(part) for part in (path, *path.rglob("*")))
                _remove(path)
                freed += 0 if os.path.lexists(path) else size
    return freed


def _size(path: Path) -> int:
    status = path.lstat()
    return status.st_size if stat.S_ISREG(status.st_mode) else 0


def _is_left(path: Path) -> bool:
    with _unheld(path) as unheld:
        return unheld


@contextlib.contextmanager
def _unheld(path: Path) -> Iterator[bool]:
    """Whether nobody holds a temporary file; within the block nobody can come to hold it."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:  # gone, or somebody else's
        yield False
        return
    try:
        yield is_temporary(path.name) and _is_unheld(fd, path)
    finally:
        os.close(fd)


def _is_unheld(fd: int, path: Path) -> bool:
    status = os.fstat(fd)
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)  # shared: whoever else looks does not hold it
    except OSError:
        return False
    is_empty = not status.st_size if stat.S_ISREG(status.st_mode) else not os.listdir(fd)
    return not is_empty or time.time() - status.st_mtime > _MOMENT


def _remove(path: Path) -> None:
    """Removes a temporary file, or a directory with what is in it, as far as the system allows it."""
    with contextlib.suppress(OSError):  # without a descriptor, which may not be had any more
        (path / _NEW).unlink()
    try:
        path.rmdir()
    except NotADirectoryError:
        with contextlib.suppress(OSError):
            path.unlink()
    except OSError:
        shutil.rmtree(path, ignore_errors=True)


def is_directory(path: str | os.PathLike[str]) -> bool:
    """Whether there is a directory; not at a path that the system refuses, such as one that is too long."""
    return os.path.isdir(path)  # noqa: PTH112 - `Path.is_dir` raises OSError


def is_there(path: str | os.PathLike[str]) -> bool:
    """Whether there is anything; not at a path that the system refuses, such as one that is too long."""
    return os.path.exists(path)  # noqa: PTH110 - `Path.exists` raises OSError


def is_same(one: Path, other: Path | None) -> bool:
    """Whether two paths lead to one file; not if one leads to none any more, or is None."""
    try:
        return other is not None and one.samefile(other)
    except OSError:
        return False


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[None]:
    """SIGTERM and SIGHUP raise KeyboardInterrupt within the block, as Ctrl-C does, so that what it has made is deleted:
    where they would end the process at once, and only in the main thread."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ending = [n for n in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) is signal.SIG_DFL]
    for number in ending:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in ending:
            signal.signal(number, signal.SIG_DFL)


def as_file_name(name: str) -> str:
    """A file name made of `name`: letters, digits, `_`, `-`, `+` and dots, at most 80 bytes.

    It does not begin with dots, which would hide the file, or with dashes, as an option does; so it may be empty.
    """
    return re.sub(r"[^\w.+-]+", "_", name.lstrip(".-")).encode()[:80].decode(errors="ignore")
