"""Where the bytes of recordings and artifacts lie: below a directory, as a `FileStorage` would lay them out, or in a
bucket of an object store under the same names."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Final, Protocol

from tupli_mcap import files
from tupli_mcap.errors import StorageError
from tupli_mcap.remote import open_store, shown
from tupli_mcap.server.database import UnavailableError
from tupli_mcap.storage.atomic import os_errors

__all__ = ["PIECE", "Blobs", "BucketBlobs", "DirectoryBlobs", "LostError"]

PIECE: Final = 4 << 20
"""Bytes of a body that are fetched at once."""
_QUICK: Final = timedelta(seconds=10)
_AT_ONCE: Final = 4  # parts on their way, of one file


class LostError(StorageError):
    """What the database names is not there."""


class Blobs(Protocol):
    """Named bytes that never change, from any thread. A name is a path with forward slashes.

    Every method raises UnavailableError where the object store does not answer, and StorageError where the file
    system refuses.
    """

    def write(self, name: str, data: bytes) -> None:
        """Keeps bytes; the same name has the same bytes whenever it is written."""
        ...

    def keep(self, name: str, path: Path) -> None:
        """Keeps what a file holds, which is not written to any more. The file stays the caller's."""
        ...

    def place(self, name: str) -> str:
        """The path or URL that a recording of this name is opened at."""
        ...

    def size(self, name: str) -> int | None:
        """How many bytes a name has; None if it is not there."""
        ...

    def piece(self, name: str, start: int, stop: int) -> bytes:
        """The bytes `start:stop` of a name that is there."""
        ...

    def delete(self, name: str) -> None:
        """Forgets a name; nothing happens if it is not there."""
        ...


class DirectoryBlobs:
    """Files below a directory. In another one, on the same file system, they are made."""

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
        return path.stat().st_size if path.is_file() else None

    def piece(self, name: str, start: int, stop: int) -> bytes:
        with os_errors("cannot read", self._root / name), (self._root / name).open("rb") as file:
            file.seek(start)
            return file.read(stop - start)

    def delete(self, name: str) -> None:
        with os_errors("cannot delete", self._root / name):
            (self._root / name).unlink(missing_ok=True)


class BucketBlobs:
    """Objects of S3, Google Cloud Storage or Azure, below a URL such as `s3://bucket/prefix`.

    Credentials are taken from the environment, as where recordings are read in place. A large file goes there in
    several parts; parts that a killed process has left are deleted by a rule of the bucket.

    Raises:
        RecordingError: the URL is none.
        MissingExtraError: obstore is not installed.
    """

    def __init__(self, url: str) -> None:
        self._url = url.rstrip("/")
        self._store, self._prefix = open_store(self._url)
        # What is done while nobody else may write must not wait for long.
        self._quick, _ = open_store(self._url, within=_QUICK)

    def write(self, name: str, data: bytes) -> None:
        import obstore

        with self._asked(name):
            obstore.put(self._store, self._key(name), data, max_concurrency=_AT_ONCE)

    def keep(self, name: str, path: Path) -> None:
        import obstore

        with self._asked(name):
            obstore.put(self._store, self._key(name), path, chunk_size=2 * PIECE, max_concurrency=_AT_ONCE)

    def place(self, name: str) -> str:
        return f"{self._url}/{name}"

    def size(self, name: str) -> int | None:
        import obstore
        from obstore.exceptions import NotFoundError

        with self._asked(name):
            try:
                return int(obstore.head(self._quick, self._key(name))["size"])
            except (NotFoundError, FileNotFoundError):
                return None

    def piece(self, name: str, start: int, stop: int) -> bytes:
        import obstore

        with self._asked(name):
            return bytes(obstore.get_range(self._store, self._key(name), start=start, end=stop))

    def delete(self, name: str) -> None:
        import obstore
        from obstore.exceptions import NotFoundError

        with self._asked(name), contextlib.suppress(NotFoundError, FileNotFoundError):
            obstore.delete(self._quick, self._key(name))

    def signed(self, name: str, seconds: int) -> str:
        """An address at which everybody may read a name for a while."""
        import obstore

        with self._asked(name):
            made = obstore.sign(self._store, "GET", self._key(name), timedelta(seconds=seconds))
        return str(made)

    def _key(self, name: str) -> str:
        return f"{self._prefix}/{name}" if self._prefix else name

    @contextlib.contextmanager
    def _asked(self, name: str) -> Iterator[None]:
        from obstore.exceptions import BaseError, NotFoundError

        try:
            yield
        except (NotFoundError, FileNotFoundError) as err:
            raise LostError(f"the server has lost {name}; restore it from a backup") from err
        except (BaseError, OSError, ValueError) as err:
            said = shown(str(err).partition("\n")[0])
            raise UnavailableError(f"{shown(self.place(name))} cannot be used: {said:.300}") from err
