"""Shelves for this machine: a directory, a storage, one file. They write nothing into them."""

from __future__ import annotations

import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence, Set
from pathlib import Path
from typing import TypeVar
from urllib.parse import quote

from sqlalchemy import ColumnElement, Connection, false, select, true

from tupli_mcap.errors import NotFoundError, no_file
from tupli_mcap.recording import Recording
from tupli_mcap.schema import BaseFilter, BenchmarkHeader, EpisodeHeader
from tupli_mcap.storage import FileStorage
from tupli_mcap.storage.catalog.catalog import Catalog
from tupli_mcap.storage.catalog.entries import entry_of
from tupli_mcap.storage.catalog.tables import RECORDING
from tupli_mcap.storage.listing import RecordingStamp, stamp_of
from tupli_mcap.storage.texts import unescape_text

T = TypeVar("T")
_MOST_OPEN = 16
_CACHE_BYTES = 64 << 20  # of each open recording


def shelf_of(path: Path) -> DirectoryShelf | FileShelf:
    """The shelf of a directory, or of one recording. RecordingError if the path does not exist."""
    if path.is_dir():
        return DirectoryShelf(path)
    if not path.exists():
        raise no_file(path)
    return FileShelf(path)


class OpenedRecordings:
    """Keeps the recordings used last open, because opening takes longer than reading a picture. Thread-safe."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, Recording] = OrderedDict()
        self._turn = threading.Lock()

    def get(self, key: Hashable, opening: Callable[[int], Recording], of: int = 1) -> Recording:
        """The open recording of a key, which names one version of a file; None if the file is gone.

        opening: opens it with a cache of so many bytes. of: how many are opened for one answer; several are not kept,
        nor is one that is not finished. A recording that was dropped here is closed once no caller holds it.
        """
        if of > 1:
            return opening(_CACHE_BYTES // of)
        with self._turn:
            if key is not None and key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        opened = opening(_CACHE_BYTES)
        if key is not None and opened.complete:
            with self._turn:
                self._kept[key] = opened
                if len(self._kept) > _MOST_OPEN:
                    self._kept.popitem(last=False)
        return opened


class _OpenToAll:
    """A shelf whose only reader is the user who runs the program, and may read everything. A viewer on another host can
    read a recording only by an address with a secret ticket."""

    user = ""
    places: Sequence[tuple[str, str]] = ()
    some_deleted: ColumnElement[bool] = false()

    def __init__(self) -> None:
        self.ticket = secrets.token_urlsafe(16)

    def address_of(self, recording: str) -> str:
        return f"/file/{self.ticket}/{quote(recording, errors='surrogatepass')}"

    def loader_of(self, uris: Sequence[str]) -> Mapping[str, str]:
        return {}

    def seen(self, created_by: ColumnElement[str], published_in: ColumnElement[str]) -> ColumnElement[bool]:
        return true()

    def seen_episodes(self, connection: Connection) -> ColumnElement[bool]:
        return true()

    def as_told(self, connection: Connection, headers: Sequence[EpisodeHeader]) -> list[EpisodeHeader]:
        return list(headers)

    def known_audiences(
        self, connection: Connection, among: Set[str]
    ) -> Callable[[str, Sequence[str]], list[str]]:
        return lambda owner, names: list(names)


class DirectoryShelf(_OpenToAll):
    """The recordings below a directory, and the benchmarks of the storage that it is, and of those below it that have
    recordings."""

    def __init__(self, root: Path) -> None:
        super().__init__()
        self._storage = FileStorage(root)
        self._opened = OpenedRecordings()
        self.title = self._storage.root.name or str(self._storage.root)
        self.opened_by = str(self._storage.root)
        self.changes = True

    @property
    def skipped(self) -> Mapping[str, str]:
        return self._storage.skipped

    def ask(self, question: Callable[[Connection], T]) -> T:
        return self._storage.ask(question)

    def open(self, recording: str, *, of: int = 1) -> Recording:
        return _opened(self._opened, self._storage.root, recording, self.path_of(recording), of)

    def path_of(self, recording: str) -> Path:
        return self._storage.recording_path(recording)

    def benchmarks(
        self, connection: Connection, filter: BaseFilter | None = None
    ) -> Sequence[BenchmarkHeader]:
        found = {header.id: header for header in self._storage.list_benchmarks(filter)}
        inner = select(RECORDING.c.path).where(
            RECORDING.c.benchmark_id != "", RECORDING.c.path.contains("/recordings/")
        )
        paths = map(unescape_text, connection.execute(inner).scalars())
        for storage in sorted({path.partition("/recordings/")[0] for path in paths}):
            below = FileStorage(self._storage.root / storage)
            found = {header.id: header for header in below.list_benchmarks(filter)} | found
        return list(found.values())


class FileShelf(_OpenToAll):
    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path.absolute()
        self._catalog = Catalog(None)
        self._known: RecordingStamp | None = None
        self._turn = threading.Lock()
        self._opened = OpenedRecordings()
        self.skipped: Mapping[str, str] = {}
        self.title = self._path.name
        self.opened_by = str(self._path)
        self.changes = False

    def ask(self, question: Callable[[Connection], T]) -> T:
        with self._turn:
            self._follow()
        return self._catalog.ask(question)

    def _follow(self) -> None:
        """Updates the catalog if the file has changed. RecordingError or FormatError if it is gone, or damaged."""
        name = self._path.name
        stamp = _stamp(self._path.parent, name)
        if stamp is None:
            raise no_file(self._path)
        if self._known == stamp:
            return
        with entry_of(self._path.parent, name) as entry:
            self._catalog.put_recording(name, entry)
        self._known = entry.stamp

    def open(self, recording: str, *, of: int = 1) -> Recording:
        return _opened(self._opened, self._path.parent, recording, self.path_of(recording), of)

    def path_of(self, recording: str) -> Path:
        if recording != self._path.name:
            raise NotFoundError(f"there is no recording {recording[:200]!r} here")
        return self._path

    def benchmarks(
        self, connection: Connection, filter: BaseFilter | None = None
    ) -> Sequence[BenchmarkHeader]:
        return []


def _opened(kept: OpenedRecordings, root: Path, relative: str, path: Path, of: int) -> Recording:
    stamp = _stamp(root, relative)
    key = None if stamp is None else (relative, stamp)
    return kept.get(key, lambda size: Recording(path, cache_bytes=size), of)


def _stamp(root: Path, relative: str) -> RecordingStamp | None:
    try:
        return stamp_of(root, relative)
    except FileNotFoundError:
        return None
