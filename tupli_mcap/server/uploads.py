"""Uploads of recordings that may be broken off and gone on with: files that grow, each of one user."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import secrets
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tupli_mcap.errors import StorageError
from tupli_mcap.server.people.access import Caller
from tupli_mcap.storage.atomic import write_bytes

__all__ = ["BusyError", "ChecksumError", "GoneError", "Upload", "Uploads"]

_ID = re.compile("[0-9a-f]{32}")
_KEPT_SECONDS = 7 * 24 * 3600


class BusyError(StorageError):
    """Another request writes to the upload."""


class GoneError(StorageError):
    """There is no such upload: it was finished, given up, or is somebody else's."""


class ChecksumError(StorageError):
    """The bytes that have come are not those that were announced."""


class Upload(NamedTuple):
    """id: what it goes by. path: the file that holds what has come. length, digest: its bytes and their SHA-256 in the
    end. sent_before: episodes with lower numbers were sent before, in parts."""

    id: str
    path: Path
    user: str
    length: int
    digest: str
    sent_before: int = 0

    @property
    def offset(self) -> int:
        """How many bytes have come."""
        return self.path.stat().st_size if self.path.exists() else 0


class Uploads:
    """Uploads below a directory, from any thread."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._busy: set[str] = set()
        self._turn = threading.Lock()

    def begin(self, caller: Caller, length: int, digest: str, sent_before: int = 0) -> Upload:
        """A new upload, or the one of the same bytes that this user has begun."""
        for path in self._directory.glob("*.json"):
            known = self._read(path.stem)
            if known is not None and (known.user, known.length, known.digest) == (
                caller.name,
                length,
                digest,
            ):
                return known
        upload = secrets.token_hex(16)
        told = {"user": caller.name, "length": length, "digest": digest, "sent_before": sent_before}
        self._directory.mkdir(parents=True, exist_ok=True)
        (self._directory / upload).touch()
        write_bytes(self._directory / f"{upload}.json", json.dumps(told).encode())
        return Upload(upload, self._directory / upload, caller.name, length, digest, sent_before)

    def find(self, caller: Caller, upload: str) -> Upload:
        """An upload of this user. GoneError if there is none."""
        found = self._read(upload) if _ID.fullmatch(upload) else None
        if found is None or found.user != caller.name:
            raise GoneError("there is no such upload; begin a new one")
        return found

    @contextlib.contextmanager
    def alone(self, upload: Upload) -> Iterator[None]:
        """Keeps others from writing to an upload. BusyError while somebody does."""
        with self._turn:
            if upload.id in self._busy:
                raise BusyError("this upload is being written by another request; try again later")
            self._busy.add(upload.id)
        try:
            yield
        finally:
            with self._turn:
                self._busy.discard(upload.id)

    def verify(self, upload: Upload) -> None:
        """Checks the bytes of an upload that is whole, and makes them durable.

        Raises:
            ChecksumError: they are not those that were announced; the upload is forgotten.
        """
        with upload.path.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
            os.fsync(file.fileno())
        if found != upload.digest:
            self.forget(upload)
            raise ChecksumError(
                f"expected bytes with the SHA-256 {upload.digest}, found {found}; send them again"
            )

    def forget(self, upload: Upload) -> None:
        """Deletes an upload; nothing happens if it is gone."""
        upload.path.unlink(missing_ok=True)
        (self._directory / f"{upload.id}.json").unlink(missing_ok=True)

    def forget_old(self) -> None:
        """Deletes the uploads that nobody has gone on with for a week."""
        for path in self._directory.glob("*.json"):
            upload = self._read(path.stem)
            if upload is not None and upload.path.stat().st_mtime < time.time() - _KEPT_SECONDS:
                self.forget(upload)

    def _read(self, upload: str) -> Upload | None:
        path = self._directory / upload
        try:
            told = json.loads((self._directory / f"{upload}.json").read_bytes())
        except (OSError, ValueError):
            return None
        if not path.exists():
            return None
        return Upload(upload, path, told["user"], told["length"], told["digest"], told.get("sent_before", 0))
