"""Keeps the bytes of recordings and artifacts: in a directory, with the layout of a `FileStorage`, or in a bucket of an
object store under the same names."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Generator, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any, Final, Protocol

from tupli_mcap import files
from tupli_mcap.errors import FormatError, RecordingError, StorageError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.opened import CACHE_BYTES
from tupli_mcap.remote import open_store, shown, why
from tupli_mcap.server.database import UnavailableError
from tupli_mcap.server.settings import Settings
from tupli_mcap.storage.atomic import os_errors

_PIECE: Final = 4 << 20  # bytes of an object that are fetched at a time
_READ: Final = 1 << 18  # bytes of a file sent at a time; the allocator keeps larger ones, for each thread
_QUICK: Final = timedelta(seconds=10)
_AT_ONCE: Final = 4  # parts of a file that are sent at the same time


class LostError(StorageError):
    """A file that the database names is missing."""


def lost(name: str) -> LostError:
    """What to raise for a file that is missing."""
    return LostError(f"the server has lost {name}; a backup may have it")


def open_stored(blobs: Blobs, place: str, name: str, cache_bytes: int = CACHE_BYTES) -> Recording:
    """The recording of a name, whose file is at `place`. LostError if the file is missing; RecordingError or
    FormatError if it cannot be opened, or is damaged, which must not reveal paths on the server."""
    file = blobs.place(place)
    try:
        recording = Recording(file, cache_bytes=cache_bytes)
    except (RecordingError, FormatError) as err:
        if blobs.size(place) is None:
            raise lost(name) from err
        raise type(err)(str(err).replace(file, name)) from err
    recording.name = name  # for later errors
    return recording


class Blobs(Protocol):
    """Named bytes that never change. Thread-safe. A name is a path with forward slashes. Methods raise UnavailableError
    if the object store does not answer, and StorageError if the file system refuses."""

    def write(self, name: str, data: bytes) -> None:
        """Keeps bytes. Writing a name again requires the same bytes."""

    def keep(self, name: str, path: Path) -> None:
        """Keeps the content of a file that nobody writes to. The caller keeps the file itself."""

    def place(self, name: str) -> str:
        """The path or URL with which a recording of this name is opened."""

    def size(self, name: str) -> int | None:
        """The size of a name (bytes); None if there is no such name."""

    def pieces(self, name: str, start: int, stop: int) -> Generator[bytes]:
        """The bytes `start:stop` of a name, one piece after another. LostError at once if there is no such name (a
        bucket is not asked for no bytes); from a directory, all come, even if the name is deleted meanwhile."""

    def delete(self, name: str) -> None:
        """Deletes a name; nothing happens if there is no such name."""


def blobs_of(settings: Settings) -> Blobs:
    """Where a server keeps its bytes."""
    if settings.blobs:
        return BucketBlobs(settings.blobs)
    return DirectoryBlobs(settings.directory, settings.making)


class DirectoryBlobs:
    """Files in a directory. They are written in another directory on the same file system, and then moved."""

    def __init__(self, root: Path, making: Path) -> None:
        self._root, self._making = root, making

    def write(self, name: str, data: bytes) -> None:
        target = self._root / name
        with os_errors("cannot write", target):
            for folder in (self._making, target.parent):
                folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=self._making) as made:
                new = Path(made) / "new"
                new.write_bytes(data)
                files.sync(new)
                new.replace(target)
            files.sync(target.parent)

    def keep(self, name: str, path: Path) -> None:
        target = self._root / name
        with os_errors("cannot write", target):
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(path, target)
            except OSError:  # another file system, or one without links
                shutil.copyfile(path, target)
            files.sync(target)
            files.sync(target.parent)

    def place(self, name: str) -> str:
        return str(self._root / name)

    def size(self, name: str) -> int | None:
        path = self._root / name
        with os_errors("cannot read", path), contextlib.suppress(FileNotFoundError):
            return path.stat().st_size
        return None

    def pieces(self, name: str, start: int, stop: int) -> Generator[bytes]:
        path = self._root / name
        with os_errors("cannot read", path):
            try:
                file = path.open("rb", buffering=0)
            except FileNotFoundError as err:
                raise lost(name) from err

        def of_file() -> Generator[bytes]:
            at = start
            with os_errors("cannot read", path), file:
                file.seek(start)
                while at < stop and (piece := file.read(min(_READ, stop - at))):
                    at += len(piece)
                    yield piece

        return of_file()

    def delete(self, name: str) -> None:
        with os_errors("cannot delete", self._root / name):
            (self._root / name).unlink(missing_ok=True)


class BucketBlobs:
    """Objects of S3, Google Cloud Storage or Azure, below a URL such as `s3://bucket/prefix`.

    Credentials come from the environment, as for reading remote recordings. A large file is sent in several parts; a
    rule of the bucket has to delete parts that a killed process has left.

    Raises:
        RecordingError: the URL is not valid.
        MissingExtraError: obstore is not installed.
    """

    def __init__(self, url: str) -> None:
        self._url = url.rstrip("/")
        self._store, self._prefix = open_store(self._url)
        # Some calls happen within a write transaction, which blocks all others: they must not wait for long.
        self._quick, _ = open_store(self._url, within=_QUICK)
        import obstore  # which `open_store` has found
        from obstore.exceptions import NotFoundError

        self._obstore: Any = obstore
        self._missing = NotFoundError, FileNotFoundError

    def write(self, name: str, data: bytes) -> None:
        with self._asked(name):
            self._obstore.put(self._store, self._key(name), data, max_concurrency=_AT_ONCE)

    def keep(self, name: str, path: Path) -> None:
        options = {"chunk_size": 2 * _PIECE, "max_concurrency": _AT_ONCE}
        with self._asked(name):
            self._obstore.put(self._store, self._key(name), path, **options)

    def place(self, name: str) -> str:
        return f"{self._url}/{name}"

    def size(self, name: str) -> int | None:
        with self._asked(name):
            try:
                return int(self._obstore.head(self._quick, self._key(name))["size"])
            except self._missing:
                return None

    def pieces(self, name: str, start: int, stop: int) -> Generator[bytes]:
        def piece(at: int) -> bytes:
            with self._asked(name):
                end = min(at + _PIECE, stop)
                return bytes(self._obstore.get_range(self._store, self._key(name), start=at, end=end))

        first = piece(start) if stop > start else b""

        def all_of_them() -> Generator[bytes]:
            yield first
            yield from map(piece, range(start + _PIECE, stop, _PIECE))

        return all_of_them()

    def delete(self, name: str) -> None:
        with self._asked(name), contextlib.suppress(*self._missing):
            self._obstore.delete(self._quick, self._key(name))

    def signed(self, name: str, seconds: int) -> str:
        """A URL with which everybody can read a name for so many seconds."""
        with self._asked(name):
            within = timedelta(seconds=seconds)
            return str(self._obstore.sign(self._store, "GET", self._key(name), within))

    def _key(self, name: str) -> str:
        return f"{self._prefix}/{name}" if self._prefix else name

    @contextlib.contextmanager
    def _asked(self, name: str) -> Iterator[None]:
        from obstore.exceptions import BaseError

        try:
            yield
        except self._missing as err:
            raise lost(name) from err
        except (BaseError, OSError, ValueError) as err:
            raise UnavailableError(f"{shown(self.place(name))} cannot be used: {why(str(err))}") from err
