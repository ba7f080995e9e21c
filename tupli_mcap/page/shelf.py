"""The interface between the pages and where recordings come from: a directory, a file, or a server's data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from typing import Protocol, TypeVar

from sqlalchemy import ColumnElement, Connection

from tupli_mcap.errors import NotFoundError
from tupli_mcap.recording import Episode, Recording
from tupli_mcap.schema import BaseFilter, BenchmarkHeader, EpisodeHeader, FilterIN
from tupli_mcap.storage.catalog.queries import find_episodes

T = TypeVar("T")


class Shelf(Protocol):
    """The recordings that one reader may see. Thread-safe.

    Attributes:
        title: a name for the whole.
        opened_by: the argument with which `tupli_mcap.open` opens it.
        changes: whether the reader may declare keys.
        user: the reader; empty if nobody is signed in.
        places: further pages for the reader: address and title.
        some_deleted: the recordings of which episodes were deleted that the reader is not to know of, as a condition on
            RECORDING.
        skipped: files that cannot be shown, and why, as of the last call of `ask`.
    """

    title: str
    opened_by: str
    changes: bool
    user: str

    @property
    def places(self) -> Sequence[tuple[str, str]]: ...

    @property
    def some_deleted(self) -> ColumnElement[bool]: ...

    @property
    def skipped(self) -> Mapping[str, str]: ...

    def ask(self, question: Callable[[Connection], T]) -> T:
        """Brings the catalog up to date, and returns the result of a function that reads it, in one transaction."""

    def seen(self, created_by: ColumnElement[str], published_in: ColumnElement[str]) -> ColumnElement[bool]:
        """The condition, on these two columns of the queried table, for rows that the reader may see."""

    def seen_episodes(self, connection: Connection) -> ColumnElement[bool]:
        """The condition on EPISODE for the episodes that the reader may see."""

    def as_told(self, connection: Connection, headers: Sequence[EpisodeHeader]) -> list[EpisodeHeader]:
        """The same headers, but published only in groups of which the reader may know."""

    def known_audiences(
        self, connection: Connection, among: Set[str]
    ) -> Callable[[str, Sequence[str]], list[str]]:
        """A function of an owner and groups (some `among` these): those of the groups of which the reader may know."""

    def open(self, recording: str, *, of: int = 1) -> Recording:
        """An open recording of the catalog; NotFoundError if there is none. Others use it at the same time: do not
        close it.

        of: how many recordings the caller opens for one answer; they share the memory of one cache.
        """

    def address_of(self, recording: str) -> str | None:
        """The path on this server where a viewer of another host may read a recording for a while; None if nowhere."""

    def loader_of(self, uris: Sequence[str]) -> Mapping[str, str]:
        """The parameters of the address at which Foxglove shows exactly these episodes by its remote data loader; empty
        if there is none that reads this server."""

    def benchmarks(
        self, connection: Connection, filter: BaseFilter | None = None
    ) -> Sequence[BenchmarkHeader]:
        """The benchmarks that the reader may see and that match a filter; for use within `ask`."""


def opened(shelf: Shelf, header: EpisodeHeader) -> Episode:
    """Opens the episode of a header. NotFoundError if it is gone."""
    recording = shelf.open(header.recording)
    return recording.episodes[position_in(recording, header)]


def position_in(recording: Recording, header: EpisodeHeader) -> int:
    """The position of a header's episode in its recording. NotFoundError if it is gone."""
    numbers = recording.index["episode"]
    found = int(numbers.searchsorted(header.episode))
    if found == len(numbers) or numbers[found] != header.episode:
        raise NotFoundError(f"episode {header.id} is gone")
    return found


def find_some(shelf: Shelf, connection: Connection, uris: Sequence[str]) -> list[EpisodeHeader]:
    """Episodes by their ids, each once, in the order of their recordings. NotFoundError if one does not exist, or the
    reader may not see it."""
    wanted = FilterIN(key="id", value=list(dict.fromkeys(uris)))
    found = list(find_episodes(connection, wanted, only=shelf.seen_episodes(connection)))
    known = {header.id for header in found}
    missing = [uri for uri in uris if uri not in known]
    if missing:
        raise NotFoundError(f"there is no episode {missing[0][:80]!r} here")
    return shelf.as_told(connection, found)


def find_episode(shelf: Shelf, connection: Connection, uri: str) -> EpisodeHeader:
    return find_some(shelf, connection, [uri])[0]


def python_line(shelf: Shelf, filter: str, sort: str = "") -> str:
    """Python code that opens the episodes that match a filter; all episodes if it is empty."""
    line = f"tupli_mcap.open({shelf.opened_by!r})"
    line += f".filter({filter!r})" if filter else ""
    falling = ", descending=True" if sort.startswith("-") else ""
    return line + (f".sort({sort.removeprefix('-')!r}{falling})" if sort else "")
