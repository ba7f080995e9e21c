"""Where the bytes of recordings and artifacts lie: below a directory, as a `FileStorage` would lay them out."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from tupli_mcap.errors import StorageError
from tupli_mcap.storage.atomic import os_errors, write_bytes

__all__ = ["Blobs", "DirectoryBlobs"]


class Blobs(Protocol):
    """Named bytes that never change, from any thread. A name is a path with forward slashes."""

    def write(self, name: str, data: bytes) -> None:
        """Keeps bytes; the same name has the same bytes whenever it is written."""
        ...

    def take(self, name: str, path: Path) -> None:
        """Keeps a file, which is moved."""
        ...

    def read(self, name: str) -> bytes:
        """All bytes of a name. StorageError if they are gone."""
        ...

    def place(self, name: str) -> str:
        """The path or URL that a recording of this name is opened at."""
        ...

    def delete(self, name: str) -> None:
        """Forgets a name; nothing happens if it is not there."""
        ...

    def names(self) -> Iterator[str]:
        """All that are kept."""
        ...


class DirectoryBlobs:
    """Files below a directory."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def write(self, name: str, data: bytes) -> None:
        with os_errors("cannot write", self._root / name):
            write_bytes(self._root / name, data)

    def take(self, name: str, path: Path) -> None:
        target = self._root / name
        with os_errors("cannot write", target):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(path, target)

    def read(self, name: str) -> bytes:
        try:
            return (self._root / name).read_bytes()
        except OSError as err:
            raise StorageError(f"the server has lost {name}: {err}; restore it from a backup") from err

    def place(self, name: str) -> str:
        return str(self._root / name)

    def delete(self, name: str) -> None:
        with os_errors("cannot delete", self._root / name):
            (self._root / name).unlink(missing_ok=True)

    def names(self) -> Iterator[str]:
        for folder in ("artifacts", "recordings"):
            for path in sorted((self._root / folder).rglob("*")):
                if path.is_file():
                    yield path.relative_to(self._root).as_posix()
