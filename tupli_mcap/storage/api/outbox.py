"""Recordings that wait for a server: written here first, then sent by one background thread, which tries again while
the server is down.

1. They are in the user's data directory, by server and user, until the server has acknowledged them.
2. An unfinished recording without a writer was left by a killed process. It is finished before it is sent.
3. A process that sends a recording holds its lock, as a writer does: one process sends it, the others wait.
4. Of a damaged recording, as much as possible is saved and sent; the original is moved to `damaged/`.
5. A query while a recording grows first sends the episodes that ended since the last one, as a recording with the same
   UUID. The server takes this as a part; the finished recording later replaces all parts. A note beside the recording
   says how many episodes were sent, so that those deleted on the server do not come back with the whole.
"""

from __future__ import annotations

import atexit
import contextlib
import glob
import itertools
import json
import os
import threading
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import platformdirs

from tupli_mcap import files
from tupli_mcap.environment import sha256
from tupli_mcap.errors import FormatError, RecordingError, TupliError, warn
from tupli_mcap.mcap.lock import LockedError, is_locked, writers_kept_out
from tupli_mcap.mcap.records import has_summary
from tupli_mcap.mcap.source import PathSource
from tupli_mcap.recording import (
    Recording,
    finish_recording,
    journal_path,
    recover_recording,
    rewrite_recording,
)
from tupli_mcap.storage.api.answers import (
    ConflictError,
    FailedError,
    SignInError,
    UnreachableError,
    is_of_all,
)
from tupli_mcap.storage.api.session import Session
from tupli_mcap.storage.api.upload import Tell, send_file
from tupli_mcap.storage.atomic import os_errors
from tupli_mcap.storage.base import new_name
from tupli_mcap.storage.listing import running

_DATA_VARIABLE: Final = "TUPLI_MCAP_DATA_DIR"
_WHOSE: Final = "whose.json"
_MOST_PAUSE: Final = 60.0  # seconds between two attempts
_POLL: Final = 0.05  # seconds until it is looked again whether another process has sent a file

_outboxes: dict[tuple[int, tuple[str, ...]], Outbox] = {}
_turn = threading.Lock()


def _forget_turn() -> None:
    global _turn
    _turn = threading.Lock()  # another thread of the parent may have held it


os.register_at_fork(after_in_child=_forget_turn)


def outbox_of(session: Session, *, sends_left: bool = True) -> Outbox:
    """The outbox of a session's server and user, one per process. When it is made, it starts to send what earlier
    processes left in it, or leaves it there."""
    with _turn:
        key = (os.getpid(), session.identity)
        if key not in _outboxes:
            _outboxes[key] = Outbox(session.another())
            if sends_left:
                _outboxes[key].send_left()
        return _outboxes[key]


class Waiting(NamedTuple):
    """A recording that the server does not have yet; state: `recording`, `finished` or `unfinished`."""

    path: Path
    size: int
    state: str


class Outbox:
    """The recordings that a user sends to a server. Thread-safe."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._identity = session.identity
        whose = sha256(f"{session.url}\n{session.username}".encode())
        self.directory = _data_dir() / "outbox" / whose[:16]
        self._turn = threading.Condition()
        self._behind: dict[Path, None] = {}  # what the thread has to send, in order
        self._thread: threading.Thread | None = None
        self._given: set[str] = set()  # stems of the names that this process records to
        self._refused: dict[Path, TupliError] = {}  # of these, what the server does not take
        self._alone: defaultdict[Path, threading.Lock] = defaultdict(threading.Lock)
        atexit.register(self._send_at_exit, os.getpid())

    def new_path(self, benchmark_id: str, name: str) -> Path:
        """A new path for a recording."""
        directory = self.directory / benchmark_id
        with os_errors("cannot make the directory", directory):
            directory.mkdir(parents=True, exist_ok=True, mode=0o700)
            whose = {"url": self._identity[0], "username": self._identity[1]}
            files.write_bytes(self.directory / _WHOSE, json.dumps(whose).encode())
        path = directory / new_name(name)
        with self._turn:
            self._given.add(path.stem)
        return path

    def waiting(self) -> list[Waiting]:
        """The recordings that the server does not have yet."""
        found = []
        for path in _recordings_in(self.directory):
            with contextlib.suppress(FileNotFoundError):
                found.append(Waiting(path, path.stat().st_size, _state_of(path)))
        return found

    def waiting_elsewhere(self) -> dict[tuple[str, str], int]:
        """The number of recordings that wait for other servers and users, by (address, name)."""
        found = {}
        for path in self.directory.parent.glob(f"*/{_WHOSE}"):
            waiting = len(_recordings_in(path.parent))
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                whose = json.loads(path.read_bytes())
                if waiting and path.parent != self.directory:
                    found[str(whose["url"]), str(whose["username"])] = waiting
        return found

    def _is_ours(self, path: Path) -> bool:
        """Whether this process records to the path, or to the first file of its series (`run` of `run_0001`)."""
        return not self._given.isdisjoint((path.stem, path.stem.rpartition("_")[0]))

    # --- sending ---

    def send(self, path: Path) -> None:
        """Sends a finished recording in the background."""
        with self._turn:
            self._behind[path] = None
            self._refused.pop(path, None)
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._run, name="tupli-mcap-sender", daemon=True)
                self._thread.start()
            self._turn.notify_all()

    def send_left(self) -> None:
        """Sends the recordings of ended processes in the background."""
        if self.directory.is_dir():
            files.remove_left(files.left_below(self.directory))
        for path in _recordings_in(self.directory):
            if not self._is_ours(path):
                self.send(path)

    def flush(self, *, everything: bool = False, tell: Tell = lambda _: None) -> None:
        """Waits until the server has everything that this process has recorded, or has to send for ended ones; of
        growing recordings, the ended episodes.

        everything: send all recordings of ended processes, and raise what the server refuses of them, too.

        Raises:
            UnreachableError: the server does not answer; the recordings stay here, and are sent later.
            SignInError: the user is no longer signed in; likewise.
            StorageError: the server refuses a recording, which stays here.
        """
        with self._turn:
            refused, behind = dict(self._refused), set(self._behind)
        for path in _recordings_in(self.directory):
            ours = everything or self._is_ours(path)
            if path in refused or not (ours or path in behind):
                continue
            try:
                self._send_now(path, tell)
            except TupliError as err:
                if is_of_all(err):
                    raise
                if ours or isinstance(err, FailedError):  # else the thread warns of it
                    refused[path] = err
        with self._turn:
            self._refused = {}
        for path, why in refused.items():
            raise type(why)(
                f"{path} was not sent, and is kept: {why}; tupli-mcap push tries again, or delete it"
            ) from why

    def _run(self) -> None:
        pause = 1.0
        while True:
            with self._turn:
                self._turn.wait_for(lambda: self._behind)
                path = next(iter(self._behind))
            try:
                self._send_now(path)
            except (UnreachableError, SignInError):
                with self._turn:
                    self._behind[path] = self._behind.pop(path)  # the server may take the others
                time.sleep(pause)
                pause = min(2 * pause, _MOST_PAUSE)
                continue
            except TupliError as err:
                if self._is_ours(path):
                    self._refused[path] = err
                warn(f"{path} was not sent, and is kept: {err}", RuntimeWarning)
            pause = 1.0
            with self._turn:
                self._behind.pop(path, None)

    def _send_now(self, path: Path, tell: Tell = lambda _: None) -> None:
        """Sends a recording as it is now, or waits while another thread or process sends it."""
        if self._session.identity != self._identity:
            raise SignInError(f"{path} is of {self._identity[1] or 'nobody'}, who is not signed in any more")
        with self._alone[path], os_errors("cannot send", path):
            while path.exists():
                state = _state_of(path)
                if state == "recording":
                    self._send_ended(path)
                    return
                if state == "unfinished":
                    path = _finished(path)
                try:
                    with writers_kept_out(path):
                        self._send_whole(path, tell)
                    return
                except LockedError:  # another process sends it
                    time.sleep(_POLL)
                except RecordingError:
                    if path.exists():  # else another process has sent it
                        raise

    def _send_whole(self, path: Path, tell: Tell) -> None:
        before = _sent_before(path)
        with Recording(path) as recording:
            if len(recording):
                try:
                    send_file(self._session, path, name=path.name, sent_before=before, tell=tell)
                except ConflictError:  # some of what was sent is not here any more
                    if not before:
                        raise
                    self._send_part(path, recording, _numbers_of(recording, before))
        try:
            for gone in (path, journal_path(path), _note(path)):
                gone.unlink(missing_ok=True)
        except OSError as err:
            warn(f"{path} was sent, and cannot be deleted here: {err}", RuntimeWarning)

    def _send_ended(self, path: Path) -> None:
        """Sends the ended episodes that were not sent yet, up to the first running one."""
        with Recording(path) as recording:
            growing = set(recording.index["episode"][list(running(recording))].tolist())
            new = itertools.takewhile(
                lambda number: number not in growing, _numbers_of(recording, _sent_before(path))
            )
            self._send_part(path, recording, list(new))

    def _send_part(self, path: Path, recording: Recording, numbers: Sequence[int]) -> None:
        if not numbers:
            return
        with files.private_directory(path.parent, shown=path) as directory:
            rewrite_recording(recording, directory / path.name, episodes=numbers)
            send_file(self._session, directory / path.name, name=path.name)
        files.write_bytes(_note(path), json.dumps({"sent_before": numbers[-1] + 1}).encode())

    def _send_at_exit(self, process: int) -> None:
        """At exit, sends what `flush` sends; the next program sends the rest."""
        if os.getpid() != process:
            return
        try:
            self.flush()
        except (TupliError, KeyboardInterrupt) as err:
            why = "interrupted" if isinstance(err, KeyboardInterrupt) else err
            left = f"what was recorded waits in {self.directory} ({why}); tupli-mcap push sends it"
            warn(left, RuntimeWarning)


def _data_dir() -> Path:
    override = os.environ.get(_DATA_VARIABLE)
    found = Path(override) if override else platformdirs.user_data_path("tupli-mcap", appauthor=False)
    return found.absolute()


# ---- the files of waiting recordings


def _recordings_in(outbox: Path) -> list[Path]:
    """The recordings in an outbox, where other processes may write."""
    # Path.glob raises FileNotFoundError if a directory goes meanwhile
    return sorted(map(Path, glob.glob(f"{glob.escape(str(outbox))}/*/*.mcap")))  # noqa: PTH207


def _state_of(path: Path) -> str:
    """`recording` while somebody writes to it, else `finished` or `unfinished`."""
    with contextlib.suppress(RecordingError, FormatError):  # where it is gone on with at this moment
        source = PathSource(path)
        try:
            if has_summary(source):
                return "finished"
        finally:
            source.close()
    return "recording" if is_locked(path) else "unfinished"


def _numbers_of(recording: Recording, first: int) -> list[int]:
    """The numbers of the episodes from `first` on."""
    return sorted(number for number in recording.index["episode"].tolist() if number >= first)


def _finished(path: Path) -> Path:
    """Finishes the recording of a killed process; returns the path of the file to send.
    RecordingError or FormatError if nothing of it can be saved."""
    try:
        finish_recording(path)
        return path
    except (RecordingError, FormatError) as err:
        if is_locked(path):  # another process is at it
            return path
        report = recover_recording(path, overwrite=True)
        if report.target is None or not report.saved:
            raise RecordingError(f"{path}: nothing of it can be saved; delete it") from err
    saved, damaged = Path(report.target), path.parents[1] / "damaged" / path.parent.name
    damaged.mkdir(parents=True, exist_ok=True, mode=0o700)
    moved = {_note(path): _note(saved)} | {each: damaged / each.name for each in (journal_path(path), path)}
    for each, goal in moved.items():
        with contextlib.suppress(FileNotFoundError):
            each.replace(goal)
    told = f"{path} was damaged: what could be saved of it is sent, the original is kept in {damaged}"
    warn(told, RuntimeWarning)
    return saved


def _note(path: Path) -> Path:
    """The path of the note of how many episodes of a recording were sent."""
    return path.with_name(f"{path.name}.sent")


def _sent_before(path: Path) -> int:
    """The first episode of a recording that was not sent yet."""
    try:
        return int(json.loads(_note(path).read_bytes())["sent_before"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0
