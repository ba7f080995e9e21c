"""Reads a recording's bytes: of a local path, an open binary file, or a URL (by ranges)."""

from __future__ import annotations

import contextlib
import errno
import io
import mmap
import os
import resource
import stat
import threading
import weakref
from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Protocol
from urllib.parse import unquote, urlsplit

from tupli_mcap.errors import FormatError, NotFoundError, RecordingError, no_file, os_reason
from tupli_mcap.remote import RemoteSource, is_url, open_url, shown

HEAD_BYTES = 1024  # hold a file's first metadata: the recording's UUID, and which rewriting it is
_ROOM = 64  # files that a program opens beside recordings
_MANY_FILES = 10_240  # that every system allows
CHANGED = "the file was changed afterwards; open it again, or list the episodes again with load()"


class Source(Protocol):
    """Random access; `read` is safe from several threads."""

    name: str
    path: Path | None
    size: int

    def read(self, offset: int, length: int) -> bytes:
        """Exactly `length` bytes; FormatError if the file ends before, RecordingError if it cannot be read, or is
        closed."""
        ...

    def view(self, offset: int, length: int) -> memoryview:
        """The bytes that `read` returns, valid as long as the view is held; a local file is mapped into memory, not
        copied.

        If somebody cuts the file short, the system kills a process that touches the view (SIGBUS).
        """
        ...

    def refresh(self) -> None:
        """Updates `size`, for a file that is being written."""
        ...

    def close(self) -> None: ...


def head_of(source: Source) -> bytes:
    """The first bytes of a file, by which it is known again."""
    return source.read(0, min(HEAD_BYTES, source.size))


def begins_with(source: Source, head: bytes) -> bool:
    """Whether a file begins as another one does: it is the same recording, in the same rewriting."""
    return source.size >= len(head) and source.read(0, len(head)) == head


def open_regular(path: Path) -> int:
    """Opens a regular file for reading, and never waits, not even for a pipe's writer; OSError if the path cannot be
    opened, or is no regular file."""
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    _leave_room(fd)
    try:
        mode = os.fstat(fd).st_mode
    except BaseException:
        os.close(fd)
        raise
    if stat.S_ISREG(mode):
        return fd
    os.close(fd)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "a device, a pipe or a socket, and no file", str(path))


def most_open() -> int:
    """How many files of many are open at once; a few more while several threads read."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return 64 if limit == resource.RLIM_INFINITY else min(64, limit // 4)


def _leave_room(fd: int) -> None:
    """Raises the limit of files that this process may have open, where the newest one has nearly reached it: a program
    may hold many recordings open. The system sets a low limit for programs that wait for files with `select`."""
    limit, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limit != resource.RLIM_INFINITY and limit - _ROOM <= fd:
        higher = _MANY_FILES if most == resource.RLIM_INFINITY else most
        with contextlib.suppress(OSError, ValueError):  # the system may allow fewer
            resource.setrlimit(resource.RLIMIT_NOFILE, (max(limit, higher), most))


class _Checked(Source):
    """A source whose `_read` may return fewer bytes, or raise OSError."""

    def read(self, offset: int, length: int) -> bytes:
        self._check(offset, length)
        try:
            data = self._read(offset, length)
            while len(data) < length:  # Linux reads at most 2 GiB at once
                more = self._read(offset + len(data), length - len(data))
                if not more:
                    raise self._too_short(offset, length)
                data += more
        except OSError as err:  # a failing disk or connection is no defect of the file
            raise RecordingError(
                f"{self.name}: could not read {length} bytes at offset {offset}: {os_reason(err)}"
            ) from err
        return data

    def view(self, offset: int, length: int) -> memoryview:
        return memoryview(self.read(offset, length))

    def _check(self, offset: int, length: int) -> None:
        if offset + length > self.size:
            raise self._too_short(offset, length)

    def _too_short(self, offset: int, length: int) -> FormatError:
        return FormatError(
            f"{self.name}: expected {length} bytes at offset {offset}, found the end of the file at {self.size}"
        )

    @abstractmethod
    def _read(self, offset: int, length: int) -> bytes: ...

    def __del__(self) -> None:
        try:  # noqa: SIM105 - `contextlib`, too, may be gone at the end of the interpreter
            self.close()
        except AttributeError:
            pass


class PathSource(_Checked):
    """A local file, read with positioned reads."""

    def __init__(self, path: Path) -> None:
        self.path: Path | None = path
        self.name = str(path)
        self._mapped: Any = b""
        try:
            self._fd = open_regular(path)
        except IsADirectoryError as err:
            raise RecordingError(
                f"{path} is a directory; give one file, a recording (.mcap); tupli_mcap.open takes directories"
            ) from err
        except FileNotFoundError as err:
            raise no_file(path, "give the path of a recording (.mcap)") from err
        except OSError as err:
            raise RecordingError(f"{path} cannot be opened: {os_reason(err)}") from err
        except ValueError as err:
            raise RecordingError(f"{path!r} cannot be opened: {err}") from err  # a NUL in it
        try:
            self.refresh()
        except BaseException:
            self.close()
            raise

    def view(self, offset: int, length: int) -> memoryview:
        self._check(offset, length)
        mapped = self._mapped
        if offset + length > len(mapped):  # not mapped yet, or the file has grown
            try:
                mapped = self._mapped = mmap.mmap(self._fd, self.size, access=mmap.ACCESS_READ)
            except (OSError, ValueError):  # the file system cannot map files, or the file was cut short
                return memoryview(self.read(offset, length))
        return memoryview(mapped)[offset : offset + length]

    def _check(self, offset: int, length: int) -> None:
        if self._fd < 0:
            raise RecordingError(f"{self.name} is closed; open it again with Recording(...)")
        super()._check(offset, length)

    def _read(self, offset: int, length: int) -> bytes:
        return os.pread(self._fd, length, offset)

    def refresh(self) -> None:
        try:
            self.size = os.fstat(self._fd).st_size
        except OSError as err:
            raise RecordingError(f"{self.name} cannot be read: {os_reason(err)}") from err

    def __reduce__(self) -> tuple[Callable[..., Source], tuple[Any, ...]]:
        """A copy opens the file itself: a descriptor is no other object's, and of another file in another process."""
        place = Path(os.path.abspath(self.name))  # noqa: PTH100 - links stay
        return _opened_again, (place, head_of(self))

    def close(self) -> None:
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            self._mapped = b""  # views keep the mapping alive
            with contextlib.suppress(OSError):  # nothing was written
                os.close(fd)


class TemporarySource(PathSource):
    """A file that is deleted with the last reference to this object; errors call it `name`.

    An unpickled copy reads the same file while it exists, and does not delete it.
    """

    def __init__(self, place: Path, name: str, *, owned: bool = True) -> None:
        super().__init__(place)
        self.path, self.name, self._place = None, name, place
        if owned:
            weakref.finalize(self, _delete, place, os.getpid())

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(TemporarySource, owned=False), (self._place, self.name)


def _delete(place: Path, process: int) -> None:
    if os.getpid() == process:  # not in a fork
        with contextlib.suppress(OSError):
            place.unlink()


class FileSource(_Checked):
    """An open, seekable binary file. With a `url`, it is the whole of what is there: `close` closes it, and a copy in
    another process downloads it again."""

    def __init__(self, file: BinaryIO, name: str, *, url: str | None = None) -> None:
        self.path = None
        self.name = name
        self._file = file
        self._url = url
        self._lock = threading.Lock()
        self._process = os.getpid()
        # a system file is read at offsets, not at its cursor, which forked children share
        self._fd = file.fileno() if _is_system_file(file) else -1
        _leave_room(self._fd)
        try:
            self.refresh()
            is_binary = isinstance(file.read(0), bytes)
        except (OSError, ValueError, AttributeError) as err:
            raise RecordingError(f"{name}: expected a seekable binary file, found {file!r}") from err
        if not is_binary:
            raise RecordingError(
                f'{name}: expected a binary file, found {file!r}; open it with "rb", or give its path'
            )

    def _check(self, offset: int, length: int) -> None:
        if getattr(self._file, "closed", False):
            raise RecordingError(f"{self.name} is closed; open it again with Recording(...)")
        super()._check(offset, length)

    def _read(self, offset: int, length: int) -> bytes:
        if self._fd >= 0:
            return os.pread(self._fd, length, offset)
        if self._process != os.getpid():
            raise RecordingError(
                f"{self.name} was opened by the process that this one was forked from; open it again here"
            )
        with self._lock:
            self._file.seek(offset)
            return self._file.read(length)

    def refresh(self) -> None:
        with self._lock:
            self._file.seek(0, os.SEEK_END)
            self.size = self._file.tell()  # a map returns nothing when it seeks

    def close(self) -> None:
        if self._url is not None:
            self._file.close()

    def __reduce__(self) -> tuple[Callable[..., Source], tuple[str, bytes]]:
        if self._url is None:
            raise RecordingError(
                f"{self.name} was opened as a file object, which cannot be copied; give its path"
            )
        return _opened_again, (self._url, head_of(self))


def _opened_again(place: str | Path, head: bytes) -> Source:
    source = open_source(place)
    if not begins_with(source, head):
        raise RecordingError(f"{source.name} has been changed since it was opened; open it again")
    return source


def _is_system_file(file: BinaryIO) -> bool:
    raw = file.raw if type(file) is io.BufferedReader else file
    return type(raw) is io.FileIO and not file.closed


class OpenFiles:
    """Opens files when they are read, and keeps those open that were read last. Thread-safe.

    A forked child, or a copy in another process, opens them itself.

    Args:
        copies: the files are read once, to be copied: views of them are copies too, since a map would keep its file
            open.
    """

    def __init__(self, copies: bool = False) -> None:
        self.copies = copies
        self._forget()

    def _forget(self) -> None:
        self._sources: OrderedDict[tuple[str, bytes], Source] = OrderedDict()
        self._lock = threading.Lock()
        self._process = os.getpid()

    def source(self, where: str, head: bytes) -> Source:
        """The open file of a path. It closes when nobody holds it any more.
        NotFoundError if it does not begin with `head`: another file is there."""
        if self._process != os.getpid():  # the lock may be held by a thread that is not here
            self._forget()
        with self._lock:
            source = self._sources.get((where, head))
            if source is None:
                source = open_source(where)
                if not begins_with(source, head):
                    raise NotFoundError(
                        f"{where} was written anew{' meanwhile; start again' if self.copies else f': {CHANGED}'}"
                    )
                self._keep(where, head, source)
            self._sources.move_to_end((where, head))
            return source

    def _keep(self, where: str, head: bytes, source: Source) -> None:
        self._sources[where, head] = source
        if len(self._sources) > most_open():
            self._sources.popitem(last=False)  # the last reader's reference closes it

    def file(self, place: str | os.PathLike[str] | Source) -> str | FileOfMany:
        """The file of a path, or an open local one, as a `FileOfMany` of these; a URL is returned as it is. Raises as
        `open_source`."""
        if isinstance(place, str) and is_url(place):
            return place
        source = open_source(place) if isinstance(place, str | os.PathLike) else place
        assert source.path is not None  # it is no URL
        made = FileOfMany(self, source.name, source.path, source)
        with self._lock:
            self._keep(made.name, made.head, source)
        return made

    def __reduce__(self) -> tuple[type[OpenFiles], tuple[bool]]:
        return OpenFiles, (self.copies,)


class FileOfMany:
    """A `Source` that is open only while it is among the files read last.

    It must begin as it did: with the UUID of the recording, and which rewriting of it this is.
    """

    def __init__(self, files: OpenFiles, where: str, path: Path, source: Source) -> None:
        self._files = files
        self.name = where
        self.path: Path | None = path
        self.size = source.size
        self.head = head_of(source)

    def read(self, offset: int, length: int) -> bytes:
        return self._opened().read(offset, length)

    def view(self, offset: int, length: int) -> memoryview:
        opened = self._opened()
        return memoryview(opened.read(offset, length)) if self._files.copies else opened.view(offset, length)

    def _opened(self) -> Source:
        return self._files.source(self.name, self.head)

    def refresh(self) -> None:
        opened = self._opened()
        opened.refresh()  # it may have been open for long
        self.size = opened.size

    def close(self) -> None:
        """Does nothing: `OpenFiles` closes files."""


def open_source(source: str | os.PathLike[str] | BinaryIO | TemporarySource | FileOfMany) -> Source:
    """A Source for a path, a URL (`https://…`, `s3://…`) or an open binary file. RecordingError if it is none of these,
    or cannot be opened."""
    if isinstance(source, TemporarySource | FileOfMany):
        return source
    if isinstance(source, str) and source.startswith("file://"):
        return PathSource(Path(unquote(urlsplit(source).path)))
    if isinstance(source, str) and is_url(source):
        found = open_url(source)
        return found if isinstance(found, RemoteSource) else FileSource(found, shown(source), url=source)
    if isinstance(source, str | os.PathLike):
        return PathSource(Path(source))
    if not hasattr(source, "read") or not hasattr(source, "seek"):
        raise RecordingError(f"expected a path, a URL or a seekable binary file, found {source!r}")
    return FileSource(source, str(getattr(source, "name", "<file>")))
