"""Recordings on their way to a server: written here first, and sent behind by one thread.

They lie below the directory of this user's data, by server and user, until the server has acknowledged them: what was
left by a process that ended too early is sent by the next one.
"""

from __future__ import annotations

import base64
import contextlib
import datetime
import hashlib
import os
import queue
import secrets
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import platformdirs

from tupli_mcap import files
from tupli_mcap.errors import StorageError, TupliError
from tupli_mcap.mcap.lock import is_locked, writers_kept_out
from tupli_mcap.recording import Recording, journal_path, rewrite_recording
from tupli_mcap.storage.api.session import Session, UnreachableError
from tupli_mcap.storage.atomic import os_errors
from tupli_mcap.storage.catalog.entries import rows_of
from tupli_mcap.storage.sidecar import Sidecar

__all__ = ["outbox_of", "send_file"]

_ATTEMPTS: Final = 6
_PIECE: Final = 1 << 20
_TUS: Final = {"Tus-Resumable": "1.0.0"}
_DATA_VARIABLE: Final = "TUPLI_MCAP_DATA_DIR"

_turn = threading.Lock()
_outboxes: dict[tuple[int, tuple[str, ...]], Outbox] = {}


def outbox_of(session: Session) -> Outbox:
    """The outbox of a session's server and user: one in a process, however many clients there are."""
    with _turn:
        key = (os.getpid(), session.identity)
        if key not in _outboxes:
            _outboxes[key] = Outbox(session.another())
        return _outboxes[key]


class Outbox:
    """The recordings that a user sends to a server. Usable from any thread."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._directory = _directory_of(session)
        self._queue: queue.Queue[Path] = queue.Queue()
        self._sender: threading.Thread | None = None
        self._turn = threading.Lock()
        self._waiting: set[Path] = set()
        self._failed: dict[Path, TupliError] = {}
        self._names: dict[Path, str] = {}
        self._given: set[Path] = set()  # somebody in this process may write to them
        self._shown: dict[Path, int] = {}  # how many episodes of them were sent

    def new_path(self, benchmark_id: str, name: str) -> Path:
        """Where a recording may be written; nothing is there yet."""
        directory = self._directory / benchmark_id
        with os_errors("cannot make the directory", directory):
            directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        now = datetime.datetime.now(datetime.UTC)
        named = f"{files.as_file_name(name)}-" if name else ""
        path = directory / f"{now:%Y%m%dT%H%M%S}-{named}{secrets.token_hex(6)}.mcap"
        with self._turn:
            self._given.add(path)
        return path

    def send(self, path: Path) -> None:
        """Sends a finished recording behind; one without episodes is removed, one that is being written is left."""
        if not path.exists() or is_locked(path):
            return
        with Recording(path) as recording:
            if not recording.complete:
                return
            if not len(recording):
                _remove(path)
                return
        with self._turn:
            if path in self._waiting:
                return
            self._waiting.add(path)
            self._failed.pop(path, None)
            if self._sender is None or not self._sender.is_alive():
                self._sender = threading.Thread(target=self._run, name="tupli-mcap-sender", daemon=True)
                self._sender.start()
        self._queue.put(path)

    def send_left(self) -> None:
        """Sends what waits here, of this process or of others that have ended."""
        for path in sorted(self._directory.rglob("*.mcap")):
            with contextlib.suppress(TupliError):  # damaged: it stays
                self.send(path)

    def flush(self) -> None:
        """Waits until everything is sent; of recordings that this process writes, the episodes that have ended.

        Raises:
            StorageError: something could not be sent; it stays here, and is tried again at the next start.
        """
        with self._turn:
            given = sorted(self._given - self._waiting)
        for path in given:
            if not path.exists():  # it was sent, or nothing was written
                continue
            if is_locked(path):
                self._send_ended(path)
            else:
                self.send(path)
        self._queue.join()
        with self._turn:
            failed, self._failed = self._failed, {}
        for path, err in failed.items():
            raise type(err)(f"{path} was not sent, and is kept: {err}") from err

    def _send_ended(self, path: Path) -> None:
        """Sends a copy of the episodes that have ended, of which the finished recording will take the place."""
        with Recording(path) as recording:
            ended = [row.episode for row in rows_of(recording, Sidecar(), live=True)]
            if len(ended) <= self._shown.get(path, 0):
                return
            with tempfile.TemporaryDirectory(prefix="tupli-mcap-") as folder:
                copy = Path(folder) / path.name
                rewrite_recording(recording, copy, episodes=ended)
                send_file(self._session, copy)
        self._shown[path] = len(ended)

    def name_of(self, path: Path) -> str:
        """What the server calls a recording that was sent."""
        return self._names[path]

    def _run(self) -> None:
        while True:
            path = self._queue.get()
            try:
                with writers_kept_out(path):  # nor does another process send it meanwhile
                    self._names[path] = send_file(self._session, path)
                    _remove(path)
            except TupliError as err:
                with self._turn:
                    self._failed[path] = err
            except OSError as err:
                with self._turn:
                    self._failed[path] = StorageError(f"{path} cannot be read: {err}")
            finally:
                with self._turn:
                    self._waiting.discard(path)
                self._queue.task_done()


def send_file(session: Session, path: Path) -> str:
    """Sends a recording, going on where a connection broke off; returns what the server calls it.

    Sent twice, it is stored once.

    Raises:
        StorageError: the server refuses it, or does not answer.
    """
    with os_errors("cannot read", path), path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        size = file.tell()
    metadata = f"sha256 {base64.b64encode(digest.encode()).decode()}"
    told = {**_TUS, "Upload-Length": str(size), "Upload-Metadata": metadata}
    for attempt in range(_ATTEMPTS):
        try:
            begun = session.send("POST", "/v1/uploads", headers=told, repeat=True)
            if "Recording" in begun.headers:
                return begun.headers["Recording"]
            return _send_rest(
                session, path, begun.headers["Location"], int(begun.headers["Upload-Offset"]), size
            )
        except UnreachableError:
            if attempt == _ATTEMPTS - 1:
                raise
        time.sleep(0.5 * 2**attempt)
    raise UnreachableError("the server does not answer")


def _send_rest(session: Session, path: Path, location: str, offset: int, size: int) -> str:
    def pieces() -> Iterator[bytes]:
        with path.open("rb") as file:
            file.seek(offset)
            while piece := file.read(_PIECE):
                yield piece

    headers = {
        **_TUS,
        "Upload-Offset": str(offset),
        "Content-Type": "application/offset+octet-stream",
        "Content-Length": str(size - offset),
    }
    done = session.send("PATCH", location, content=pieces(), headers=headers, repeat=False)
    return str(done.headers["Recording"])


def _remove(path: Path) -> None:
    try:
        for gone in (path, journal_path(path)):
            gone.unlink(missing_ok=True)
    except OSError as err:
        warnings.warn(f"{path} was sent, and cannot be deleted here: {err}", stacklevel=2)


def _directory_of(session: Session) -> Path:
    """Where the recordings of a server and user wait."""
    server = hashlib.sha256(f"{session.url}\n{session.username}".encode()).hexdigest()[:16]
    return _data_dir() / "outbox" / server


def _data_dir() -> Path:
    override = os.environ.get(_DATA_VARIABLE)
    found = Path(override) if override else platformdirs.user_data_path("tupli-mcap", appauthor=False)
    return found.absolute()
