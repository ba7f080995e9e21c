"""Reads and writes the small files of a storage, writes atomically, and locks out other processes while it does."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import functools
import inspect
import io
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, TypeVar

from pydantic import BaseModel, ValidationError

from tupli_mcap import files
from tupli_mcap.errors import FormatError, RecordingError, SignatureError, StorageError, os_reason
from tupli_mcap.mcap.lock import drop_private, open_private
from tupli_mcap.mcap.source import open_regular
from tupli_mcap.recording import journal_path
from tupli_mcap.storage.texts import first_defect

_Class = TypeVar("_Class")
_Model = TypeVar("_Model", bound=BaseModel)
_NO_FILE: Final = (errno.EINVAL, errno.EISDIR, errno.ELOOP, errno.ENXIO)
_MOST_BYTES: Final = 256 << 20  # of a file of JSON


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically, and make its directory if it is missing: a crash leaves the old file, or none.
    OSError if the directory cannot be written to, the disk is full, ..."""
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_bytes(path, data)


def read_bytes(path: Path, most: int = _MOST_BYTES) -> bytes:
    """The content of a file, which anybody may have put into its directory.

    Raises:
        OSError: the system refuses.
        FormatError: it is no file, such as a pipe, or has more than `most` bytes.
    """
    try:
        fd = open_regular(path)
    except OSError as err:
        if err.errno not in _NO_FILE:
            raise
        raise FormatError(f"{path}: expected a file, found something else: {err.strerror}") from err
    with os.fdopen(fd, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise FormatError(f"{path}: expected a file of at most {most} bytes, found {size}")
        return file.read(size)


def is_missing(err: OSError) -> bool:
    """Whether it says that there is no such file. No file has a name that is too long: that of a recording may be so
    long that there can be none beside it."""
    return err.errno in (errno.ENOENT, errno.ENAMETOOLONG)


def remove(path: Path) -> None:
    """Remove a file if there is one. OSError if it cannot be removed."""
    try:
        path.unlink()
    except OSError as err:
        if not is_missing(err):
            raise


def read_model(kind: type[_Model], path: Path, expected: str, advice: str = "") -> _Model:
    """The model in a file of JSON; an empty one if there is no file.

    Raises:
        FormatError: The file is something else than what is expected.
        StorageError: It cannot be read.
    """
    with os_errors("cannot read", path):
        try:
            return kind.model_validate_json(read_bytes(path))
        except OSError as err:
            if not is_missing(err):
                raise
            return kind()
        except ValidationError as err:
            raise FormatError(f"{path}: expected {expected}: {first_defect(err)}{advice}") from err


@contextlib.contextmanager
def fill(path: Path) -> Iterator[Path]:
    """Yields the path of a recording to write; it becomes `path` when the block ends without an error.

    Raises:
        FileExistsError: There is a file at `path` by then.
        OSError: The directory cannot be written to, the disk is full, ...
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with files.replacing(path, overwrite=False) as new:
        try:
            yield new
        except (FormatError, RecordingError, SignatureError) as err:
            # the user does not know the temporary name
            raise type(err)(str(err).replace(str(new), str(path))) from err
        finally:
            with contextlib.suppress(OSError):  # left by an interrupted writer
                journal_path(new).unlink(missing_ok=True)


@contextlib.contextmanager
def os_errors(what: str, path: Path) -> Iterator[None]:
    """Turns an OSError of the block into a StorageError: `<what> '<path>': <reason>; <what to do>`."""
    try:
        yield
    except OSError as err:
        raise StorageError(f"{what} {str(path)!r}: {os_reason(err)}") from err


def refusals_told(cls: type[_Class]) -> type[_Class]:
    """A class decorator: an OSError in a public method becomes a StorageError that names the file."""
    for name, member in list(vars(cls).items()):
        if inspect.isfunction(member) and not name.startswith("_"):
            setattr(cls, name, _told(member))
    return cls


def _told(method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def call(self: Any, *args: Any, **kwargs: Any) -> Any:
        try:
            return method(self, *args, **kwargs)
        except OSError as err:
            place = self.root if err.filename is None else os.fsdecode(err.filename)
            raise StorageError(f"{method.__name__} failed at {str(place)!r}: {os_reason(err)}") from err

    return call


class LockError(StorageError):
    """The lock's file cannot be opened or locked: the storage is read-only, the disk is full, or it has no locks."""


class Lock:
    """Keeps the other processes and threads out while a block reads, changes and writes. Reentrant in a
    thread. A forked child does not inherit it. LockError if the file cannot be opened or locked."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._forget()

    def _forget(self) -> None:
        self._process = os.getpid()
        self._thread_lock = threading.RLock()
        self._depth = 0
        self._file: io.FileIO | None = None

    def __enter__(self) -> Self:
        if self._process != os.getpid():  # forked: a thread of the parent may hold it
            self._forget()
        self._thread_lock.acquire()
        try:
            if self._depth == 0:
                self._open()
            self._depth += 1
        except BaseException:
            self._thread_lock.release()
            raise
        return self

    def _open(self) -> None:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file = locked(self._path)
        except OSError as err:
            raise LockError(
                f"cannot change the storage: its lock {str(self._path)!r} cannot be taken: {os_reason(err)}"
            ) from err

    def __exit__(
        self, kind: type[BaseException] | None, err: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process != os.getpid() or self._file is None:
            return  # the parent entered the block before the fork
        self._depth -= 1
        if self._depth == 0:
            file, self._file = self._file, None
            drop_private(file)
        self._thread_lock.release()


def locked(path: Path, *, exclusive: bool = True) -> io.FileIO:
    """A file, made if it is missing, whose lock is held; close it with `drop_private`."""
    file = open_private(path, "a+")
    try:
        fcntl.flock(file, fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH)
    except BaseException:  # Ctrl-C while waiting
        drop_private(file)
        raise
    return file
