"""Injects faults of the operating system: chosen calls on files below a directory fail.

The calls are those that Python's own modules make (`os`, `io`, `mmap`, `fcntl`); the files are real.
"""

from __future__ import annotations

import builtins
import contextlib
import errno
import fcntl
import io
import mmap
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

_CREATES = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO}
_CHANGES = {errno.EROFS, errno.EIO}
_OPENS = {errno.EMFILE, errno.ENFILE, errno.EIO}
FITS: dict[str, set[int]] = {
    "create": _CREATES | _OPENS,
    "open-to-write": _CHANGES | _OPENS,
    "open": _OPENS,
    "scandir": _OPENS,
    "write": {*_CREATES, errno.EFBIG},
    "allocate": {*_CREATES, errno.EFBIG},
    "mkdir": _CREATES,
    "link": _CREATES,
    "replace": _CREATES,
    "unlink": _CHANGES,
    "truncate": _CHANGES,
    "chmod": _CHANGES,
    "sync": {errno.EIO, errno.ENOSPC, errno.EDQUOT},
    "close": {errno.EIO, errno.EDQUOT},
    "map": {errno.ENOMEM},
    "lock": {errno.ENOLCK, errno.EIO},
    "read": {errno.EIO},
    "stat": {errno.EIO},
}
"""Which errors each kind of call may give."""


class Faults:
    """Counts the calls on files below `root`, and fails call number `at` (from 0) with `code`.

    lasting: later calls that can raise `code` fail too (a disk that stays full).
    short: a failing write first stores half of its bytes.
    kinds: count only calls of these kinds.
    """

    def __init__(
        self,
        root: Path,
        at: int = -1,
        code: int = errno.EIO,
        *,
        lasting: bool = False,
        short: bool = False,
        kinds: frozenset[str] = frozenset(FITS),
    ) -> None:
        self._root = os.path.realpath(root) + os.sep
        self._at, self._code, self._lasting, self._short, self._kinds = at, code, lasting, short, kinds
        self._lock = threading.Lock()
        self.calls: list[tuple[str, str]] = []
        self.failed: list[tuple[str, str]] = []

    # ---- what is asked of a call

    def check(self, kind: str, path: str) -> None:
        """Counts a call; raises if it should fail."""
        with self._lock:
            number = len(self.calls)
            if kind not in self._kinds:
                return
            self.calls.append((kind, path))
            hit = number == self._at or (self._lasting and 0 <= self._at <= number)
            if not hit or self._code not in FITS[kind]:
                return
            self.failed.append((kind, path))
        raise OSError(self._code, os.strerror(self._code), path)

    def written(self, path: str, data: Any, write: Callable[[Any], int]) -> int:
        """Makes a write: whole, half or not at all."""
        try:
            self.check("write", path)
        except OSError:
            if self._short and len(memoryview(data).cast("B")) > 1:
                view = memoryview(data).cast("B")
                write(view[: len(view) // 2])
            raise
        return write(data)

    def below(self, path: Any) -> str | None:
        """The path, if it is below the root."""
        path = path.fileno() if hasattr(path, "fileno") else path
        if isinstance(path, int):
            try:
                path = os.readlink(f"/proc/self/fd/{path}")  # noqa: PTH115
            except OSError:
                return None
        text = os.path.abspath(os.fsdecode(path))  # noqa: PTH100 - Path would call what is replaced here
        return text if text.startswith(self._root) else None

    # ---- the calls

    @contextlib.contextmanager
    def __call__(self) -> Iterator[Faults]:
        """Makes calls fail within the block."""
        replaced: list[tuple[Any, str, Any]] = []

        def replace(module: Any, name: str, make: Callable[[Any], Any]) -> None:
            if hasattr(module, name):
                real = getattr(module, name)
                replaced.append((module, name, real))
                setattr(module, name, make(real))

        for name, kind in (
            ("mkdir", "mkdir"), ("unlink", "unlink"), ("remove", "unlink"), ("rmdir", "unlink"), ("scandir", "scandir"),
            ("stat", "stat"), ("ftruncate", "truncate"), ("fchmod", "chmod"), ("fsync", "sync"), ("fdatasync", "sync"),
            ("fstat", "stat"), ("posix_fallocate", "allocate"), ("pread", "read"), ("listdir", "scandir"),
            ("sendfile", "write"),
        ):  # fmt: skip
            replace(os, name, self._checked(kind))
        for name, kind in (("replace", "replace"), ("rename", "replace"), ("link", "link")):
            replace(os, name, self._checked(kind, 1))
        replace(os, "open", self._os_open)
        replace(os, "close", self._os_close)
        replace(os, "write", self._os_write)
        replace(os, "pwrite", self._os_write)
        replace(os, "pwritev", self._os_writev)
        replace(mmap, "mmap", self._checked("map"))
        replace(fcntl, "flock", self._checked("lock"))
        replace(io, "open", self._io_open)
        replace(builtins, "open", self._io_open)
        try:
            yield self
        finally:
            for module, name, real in reversed(replaced):
                setattr(module, name, real)

    def _checked(self, kind: str, position: int = 0) -> Callable[[Any], Any]:
        def make(real: Any) -> Any:
            def call(*args: Any, **kwargs: Any) -> Any:
                path = (
                    self.below(args[position]) if len(args) > position and not kwargs.get("dir_fd") else None
                )
                if path is not None:
                    self.check(kind, path)
                return real(*args, **kwargs)

            return call

        return make

    def _os_open(self, real: Any) -> Any:
        def call(path: Any, flags: int, *args: Any, **kwargs: Any) -> int:
            found = None if kwargs.get("dir_fd") else self.below(path)
            if found is not None:
                writes = flags & (os.O_WRONLY | os.O_RDWR)
                self.check("create" if flags & os.O_CREAT else "open-to-write" if writes else "open", found)
            fd: int = real(path, flags, *args, **kwargs)
            return fd

        return call

    def _os_close(self, real: Any) -> Any:
        def call(fd: int) -> None:
            path = self.below(fd)
            real(fd)  # a descriptor is gone even where closing it failed
            if path is not None:
                self.check("close", path)

        return call

    def _os_write(self, real: Any) -> Any:
        def call(fd: int, data: Any, *where: int) -> int:
            path = self.below(fd)
            if path is None:
                written: int = real(fd, data, *where)
                return written
            return self.written(path, data, lambda part: real(fd, part, *where))

        return call

    def _os_writev(self, real: Any) -> Any:
        write = self._os_write(lambda fd, data, *where: real(fd, [data], *where))

        def call(fd: int, parts: Any, *where: int) -> int:
            written: int = write(fd, b"".join(parts), *where)
            return written

        return call

    def _io_open(self, real: Any) -> Any:
        def call(file: Any, mode: str = "r", buffering: int = -1, *args: Any, **kwargs: Any) -> Any:
            path = None if isinstance(file, int) else self.below(file)
            if path is None or "b" not in mode:
                if path is not None:
                    self.check("create" if set(mode) & set("wax") else "open", path)
                return real(file, mode, buffering, *args, **kwargs)
            self.check(
                "create" if set(mode) & set("wax") else "open-to-write" if "+" in mode else "open", path
            )
            raw = _File(self, path, mode)
            if buffering == 0:
                return raw
            if raw.readable() and raw.writable():
                return io.BufferedRandom(raw)
            return io.BufferedReader(raw) if raw.readable() else io.BufferedWriter(raw)

        return call


class _File(io.FileIO):
    """A file whose reads and writes may fail."""

    def __init__(self, faults: Faults, path: str, mode: str) -> None:
        super().__init__(path, mode)
        self._faults, self._path = faults, path

    def write(self, data: Any) -> int:
        return self._faults.written(self._path, data, super().write)

    def readinto(self, buffer: Any) -> int:  # type: ignore[override]
        self._faults.check("read", self._path)
        return super().readinto(buffer) or 0

    def readall(self) -> bytes:
        self._faults.check("read", self._path)
        return super().readall() or b""
