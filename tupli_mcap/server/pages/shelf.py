"""The recordings of a server that one caller may read."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence, Set
from functools import partial
from typing import TypeVar
from urllib.parse import quote

from sqlalchemy import ColumnElement, Connection, exists, select

from tupli_mcap.errors import NotFoundError
from tupli_mcap.page.datasets import of_recording
from tupli_mcap.page.directory import OpenedRecordings
from tupli_mcap.recording import Recording
from tupli_mcap.recording.edit.stream import stream_excerpts
from tupli_mcap.schema import BaseFilter, BenchmarkHeader, EpisodeHeader, FilterIN, Right
from tupli_mcap.server.blobs import open_stored
from tupli_mcap.server.library import Library
from tupli_mcap.server.people.access import Caller, as_told, known_audiences, readable, readable_episodes
from tupli_mcap.server.stored.selection import EpisodeQuery, Selected, opened
from tupli_mcap.server.tables import FILE
from tupli_mcap.storage.catalog.tables import EPISODE, RECORDING, of_one_recording
from tupli_mcap.storage.texts import escape_text, unescape_text

T = TypeVar("T")


class LibraryShelf:
    """The shelf of what a caller may read; see `page.shelf.Shelf`.

    kept: open recordings, shared by all callers; the key of each names the episodes in it.
    """

    def __init__(self, library: Library, caller: Caller, address: str, kept: OpenedRecordings) -> None:
        self._library = library
        self._caller = caller
        self._kept = kept
        self.title = library.settings.directory.name or "tupli-mcap"
        self.opened_by = address
        self.user = "" if caller.is_guest else caller.name
        self.changes = not caller.is_guest
        self.skipped: Mapping[str, str] = {}

    @property
    def places(self) -> Sequence[tuple[str, str]]:
        if not self.user:
            return [("/sign-in", "Sign in")]
        users = [("/users", "Users")] if self._caller.may(Right.USER_READ) else []
        upload = [("/upload", "Upload")] if self._caller.may(Right.EPISODE_CREATE, self.user) else []
        return [*upload, ("/groups", "Groups"), *users, ("/account", self.user)]

    @property
    def some_deleted(self) -> ColumnElement[bool]:
        return exists().where(FILE.c.path == RECORDING.c.path, FILE.c.deleted != "[]")

    def ask(self, question: Callable[[Connection], T]) -> T:
        with self._library.database.reading() as connection:
            return question(connection)

    def seen(self, created_by: ColumnElement[str], published_in: ColumnElement[str]) -> ColumnElement[bool]:
        return readable(self._caller, Right.EPISODE_READ, created_by, published_in)

    def seen_episodes(self, connection: Connection) -> ColumnElement[bool]:
        return readable_episodes(connection, self._caller)

    def as_told(self, connection: Connection, headers: Sequence[EpisodeHeader]) -> list[EpisodeHeader]:
        return as_told(connection, self._caller, headers)

    def known_audiences(
        self, connection: Connection, among: Set[str]
    ) -> Callable[[str, Sequence[str]], list[str]]:
        return known_audiences(connection, self._caller, among)

    def open(self, recording: str, *, of: int = 1) -> Recording:
        """The recording; if the caller may read only some of its episodes, a recording of these."""
        place, numbers = self._readable(recording)
        if numbers is None:
            opening = partial(open_stored, self._library.blobs, place, recording)
            return self._kept.get((place, None), opening, of)
        some = Selected(recording, place, numbers, own=False)
        return self._kept.get((place, numbers), lambda size: self._cut(some, size), of)

    def _readable(self, recording: str) -> tuple[str, tuple[int, ...] | None]:
        """The place of a recording, and the episodes of it that the caller may read; None for all. NotFoundError if
        there are none."""
        file = select(FILE.c.place, FILE.c.episodes).where(FILE.c.path == escape_text(recording))
        numbers = select(EPISODE.c.episode).join(RECORDING, of_one_recording()).order_by(EPISODE.c.episode)
        with self._library.database.reading() as connection:
            found = connection.execute(file).first()
            of = self.seen_episodes(connection), of_recording(recording)
            seen = tuple(connection.execute(numbers.where(*of)).scalars())
        if found is None or not seen:
            raise NotFoundError(f"there is no recording {recording[:200]!r}")
        return unescape_text(found.place), None if len(seen) == found.episodes else seen

    def _cut(self, selected: Selected, cache_bytes: int) -> Recording:
        """A recording of some episodes, in a temporary file that is deleted once it is open."""
        with tempfile.NamedTemporaryFile(prefix="tupli-mcap-", suffix=".mcap") as file:
            for piece in stream_excerpts(opened(self._library.blobs, [selected])):
                file.write(piece)
            file.flush()
            recording = Recording(file.name, cache_bytes=cache_bytes)
        recording.name = selected.name
        return recording

    def address_of(self, recording: str) -> str | None:
        if self._readable(recording)[1] is not None:
            return None  # a recording that is made while it is sent cannot be read in ranges
        ticket = self._library.tokens.ticket(self._caller, recording=recording)
        return f"/v1/files/{quote(recording)}?ticket={ticket}"

    def loader_of(self, uris: Sequence[str]) -> Mapping[str, str]:
        loader = self._library.settings.loader
        if not loader:
            return {}
        query = EpisodeQuery(filter=FilterIN(key="id", value=list(uris))).model_dump(
            mode="json", exclude_none=True
        )
        ticket = self._library.tokens.ticket(self._caller, query=query)
        return {"ds": "remote-data-loader", "ds.dataLoaderUrl": loader, "ds.ticket": ticket}

    def benchmarks(
        self, connection: Connection, filter: BaseFilter | None = None
    ) -> Sequence[BenchmarkHeader]:
        return self._library.items.list_benchmarks(connection, self._caller, filter)
