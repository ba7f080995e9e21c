"""What the page shows: the one seam between it and a directory, a file, or what a server keeps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeVar

from sqlalchemy import ColumnElement, Connection, and_

from tupli_mcap.errors import NotFoundError
from tupli_mcap.recording import Recording
from tupli_mcap.schema import BaseFilter, BenchmarkHeader, EpisodeHeader, FilterIN
from tupli_mcap.storage.catalog.queries import each_once, find_episodes
from tupli_mcap.storage.catalog.tables import EPISODE

__all__ = ["Shelf", "find_episode", "find_some", "python_line", "seen_episodes"]

T = TypeVar("T")


class Shelf(Protocol):
    """Recordings as one reader sees them; from any thread.

    Attributes:
        title: what to call all of it.
        opened_by: what `tupli_mcap.open` is given to open it.
        user: who reads; empty where nobody is signed in.
        places: other pages that the reader may go to: address and title.
        skipped: files that cannot be shown, and why, as of the last question.
    """

    title: str
    opened_by: str
    user: str

    @property
    def places(self) -> Sequence[tuple[str, str]]: ...

    @property
    def skipped(self) -> Mapping[str, str]: ...

    def ask(self, question: Callable[[Connection], T]) -> T:
        """What a question finds in the tables of a catalog that is up to date, in one transaction."""
        ...

    def seen(self, created_by: ColumnElement[str], published_in: ColumnElement[str]) -> ColumnElement[bool]:
        """What may be read, as a condition on these columns of the table that is asked."""
        ...

    def open(self, recording: str) -> Recording:
        """A recording of the catalog, which others use at the same time: do not close it.

        Raises:
            NotFoundError: there is none.
        """
        ...

    def address_of(self, recording: str) -> str | None:
        """Where a viewer of another host may read a recording for a while: a path of this server; None for nowhere."""
        ...

    def benchmarks(
        self, connection: Connection, filter: BaseFilter | None = None
    ) -> Sequence[BenchmarkHeader]:
        """The benchmarks that may be read and that a filter is true of; within a question."""
        ...


def seen_episodes(shelf: Shelf, *conditions: ColumnElement[bool]) -> ColumnElement[bool]:
    """The episodes that may be read, and that all conditions are true of."""
    return and_(shelf.seen(EPISODE.c.created_by, EPISODE.c.published_in), *conditions)


def find_some(shelf: Shelf, connection: Connection, uris: Sequence[str]) -> list[EpisodeHeader]:
    """Episodes by their ids, each once, in the order of their recordings; of those that several people have stored,
    the reader's own.

    Raises:
        NotFoundError: one of them is not there, or may not be read.
    """
    wanted = FilterIN(key="id", value=list(dict.fromkeys(uris)))
    found = each_once(find_episodes(connection, wanted, only=seen_episodes(shelf)), shelf.user)
    known = {header.id for header in found}
    missing = [uri for uri in uris if uri not in known]
    if missing:
        raise NotFoundError(f"there is no episode {missing[0][:80]!r} here")
    return found


def find_episode(shelf: Shelf, connection: Connection, uri: str) -> EpisodeHeader:
    """An episode by its id. Raises NotFoundError, as `find_some` does."""
    return find_some(shelf, connection, [uri])[0]


def python_line(shelf: Shelf, filter: str, sort: str = "") -> str:
    """The Python that opens the episodes that match a filter; all of them where it is empty."""
    line = f"tupli_mcap.open({shelf.opened_by!r})"
    line += f".filter({filter!r})" if filter else ""
    falling = ", descending=True" if sort.startswith("-") else ""
    return line + (f".sort({sort.removeprefix('-')!r}{falling})" if sort else "")
