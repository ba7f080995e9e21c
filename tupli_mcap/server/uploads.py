"""Resumable uploads of recordings: rows of a table, each with a growing file.

Every function that takes a connection works in the transaction of its caller. Any process of the server may continue an
upload; it holds a lock on the file meanwhile.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import secrets
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

from sqlalchemy import Connection, Row, delete, func, insert, select, update

from tupli_mcap.errors import StorageError
from tupli_mcap.server.people.access import Caller
from tupli_mcap.server.people.limits import FullError
from tupli_mcap.server.tables import UPLOAD
from tupli_mcap.storage.atomic import os_errors

_KEPT_SECONDS: Final = 7 * 24 * 3600
_BEGUN_SECONDS: Final = 3600  # without a byte


class BusyError(StorageError):
    """Another request is writing to the upload."""


class GoneError(StorageError):
    """There is no such upload: it was finished or given up, or is another user's."""


class ChecksumError(StorageError):
    """The received bytes do not have the announced SHA-256."""


class TooLargeError(StorageError):
    """The sent content is too large."""


class TooManyUploadsError(StorageError):
    """A user has too many unfinished uploads."""


class Upload(NamedTuple):
    """path: the file of the received bytes. length, digest: the final size (bytes) and SHA-256. sent_before: episodes
    with lower numbers were sent before, in parts."""

    id: str
    path: Path
    length: int
    digest: str
    sent_before: int = 0

    @property
    def offset(self) -> int:
        return self.path.stat().st_size if self.path.exists() else 0

    def drop(self) -> None:
        """Deletes the file of a forgotten upload. If that fails, `Uploads.forget_old` deletes it later."""
        with contextlib.suppress(OSError):
            self.path.unlink()


class Incoming:
    """The file of an upload while one request writes to it."""

    def __init__(self, upload: Upload, file: IO[bytes]) -> None:
        self.upload = upload
        self.offset = os.fstat(file.fileno()).st_size
        self._file = file
        self._hash = hashlib.sha256() if self.offset == 0 else None

    def write(self, pieces: Iterable[bytes]) -> None:
        """Appends bytes. FullError if the disk is full; then all bytes of the upload are deleted: they would keep it
        full for everybody."""
        begun = self.offset
        with os_errors("cannot write", self.upload.path):
            try:
                for piece in pieces:
                    self._append(piece)
            except OSError as err:
                if err.errno not in (errno.ENOSPC, errno.EDQUOT):
                    raise
                self._file.truncate(0)
                raise FullError("the server's disk is full; send it again when there is room") from err
        # Linux then begins to write them to the disk, so that `verify` waits less.
        if hasattr(os, "posix_fadvise"):
            os.posix_fadvise(self._file.fileno(), begun, self.offset - begun, os.POSIX_FADV_DONTNEED)

    def _append(self, piece: bytes) -> None:
        left = memoryview(piece)
        while left:
            left = left[self._file.write(left) :]
        self.offset += len(piece)
        if self._hash is not None:
            self._hash.update(piece)

    def verify(self) -> None:
        """Checks the bytes of a complete upload, and writes them to the disk. ChecksumError if they do not have the
        announced SHA-256."""
        with os_errors("cannot write", self.upload.path):
            os.fsync(self._file.fileno())
            found = self._hash or self._read()
        if found.hexdigest() != self.upload.digest:
            raise ChecksumError(
                f"expected bytes with the SHA-256 {self.upload.digest}, found {found.hexdigest()}; send them again"
            )

    def _read(self) -> Any:
        with self.upload.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256")


class Uploads:
    """The uploads of a server, whose files are in a directory."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        directory.mkdir(parents=True, exist_ok=True)

    def begin(
        self, connection: Connection, caller: Caller, length: int, digest: str, *, sent_before: int, most: int
    ) -> Upload:
        """A new upload, or the user's unfinished upload of the same bytes, with the given `sent_before`.
        TooManyUploadsError if the user has `most` of them."""
        own = select(UPLOAD).where(UPLOAD.c.user == caller.name)
        same = own.where(UPLOAD.c.digest == digest, UPLOAD.c.length == length)
        known = connection.execute(same).first()
        if known is not None:
            of_it = update(UPLOAD).where(UPLOAD.c.id == known.id)
            connection.execute(of_it.values(sent_before=sent_before, since=int(time.time())))
            return self._upload(known)._replace(sent_before=sent_before)
        count = connection.execute(select(func.count()).select_from(own.subquery())).scalar_one()
        if count >= most:
            raise TooManyUploadsError(
                f"expected at most {most} unfinished uploads of {caller.name}, found {count}; finish or delete some"
            )
        number = secrets.token_hex(16)
        told = {"id": number, "user": caller.name, "since": int(time.time())}
        row = {**told, "length": length, "digest": digest, "sent_before": sent_before}
        connection.execute(insert(UPLOAD).values(**row))
        return Upload(number, self._directory / number, length, digest, sent_before)

    def find(self, connection: Connection, caller: Caller, upload: str) -> Upload:
        """An upload of this user. GoneError if there is none."""
        query = select(UPLOAD).where(UPLOAD.c.id == upload, UPLOAD.c.user == caller.name)
        found = connection.execute(query).first()
        if found is None:
            raise GoneError("there is no such upload; begin a new one")
        return self._upload(found)

    @contextlib.contextmanager
    def writing(self, upload: Upload) -> Iterator[Incoming]:
        """Opens the file of an upload, for one request at a time. BusyError while another one writes to it."""
        with os_errors("cannot write", upload.path), upload.path.open("ab", buffering=0) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise BusyError("this upload is being written by another request; try again later") from None
            yield Incoming(upload, file)

    def forget(self, connection: Connection, upload: Upload) -> None:
        """Deletes an upload; nothing happens if it is gone. Its file stays: the caller drops it after the commit,
        without which the upload goes on."""
        connection.execute(delete(UPLOAD).where(UPLOAD.c.id == upload.id))

    def forget_old(self, connection: Connection) -> None:
        """Deletes uploads that were not continued for a week, those without a byte after an hour, as a full disk leaves
        them, and files without an upload."""
        now, known = time.time(), {}
        for row in connection.execute(select(UPLOAD)).all():
            upload = self._upload(row)
            empty = not upload.offset
            continued = row.since if empty else max(row.since, upload.path.stat().st_mtime)
            if continued < now - (_BEGUN_SECONDS if empty else _KEPT_SECONDS):
                self.forget(connection, upload)
            else:
                known[upload.id] = upload
        for path in self._directory.iterdir():
            if path.name not in known:
                with contextlib.suppress(OSError):  # it stays for the next time
                    path.unlink()

    def _upload(self, row: Row[Any]) -> Upload:
        return Upload(row.id, self._directory / row.id, row.length, row.digest, row.sent_before)
