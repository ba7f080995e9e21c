"""Selects the episodes of a query, and opens them for a recording that is made while it is sent."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from functools import reduce
from operator import and_
from typing import Final, NamedTuple

import numpy as np
from pydantic import Field
from sqlalchemy import Connection, select

from tupli_mcap.errors import NotFoundError, StorageError
from tupli_mcap.page.copies import MOST_MERGED
from tupli_mcap.recording.columns.fields import field_names
from tupli_mcap.recording.edit.merge import Excerpt
from tupli_mcap.schema import BaseFilter, FilterIN
from tupli_mcap.server.blobs import Blobs, open_stored
from tupli_mcap.server.people.access import Caller
from tupli_mcap.server.stored import episodes
from tupli_mcap.server.stored.items import Items
from tupli_mcap.server.tables import FILE
from tupli_mcap.server.wire import Asked, AskedFilter
from tupli_mcap.storage.texts import escape_text, unescape_text

_CACHE_BYTES: Final = 32 << 20  # cache of all recordings of an answer together


class EpisodeQuery(Asked):
    """A query for the episodes that meet all given conditions.

    recordings: names of recordings, as in headers of episodes. episodes: numbers, if one recording is named. fields:
    "states", "actions", "infos", "frames"; rewards, flags and times are always included.
    """

    filter: AskedFilter | None = None
    benchmark_filter: AskedFilter | None = None
    recordings: list[str] | None = Field(default=None, max_length=10_000, fail_fast=True)
    episodes: list[int] | None = Field(default=None, fail_fast=True)
    fields: list[str] | None = Field(default=None, fail_fast=True)

    @property
    def left_out(self) -> list[str]:
        """The fields that the query leaves out. Raises StorageError for an unknown field."""
        if self.fields is None:
            return []
        wanted = field_names(self.fields, error=StorageError)
        wanted += ["states"] if "next_states" in wanted else []
        return [field for field in ("states", "actions", "infos", "frames") if field not in wanted]


class Selected(NamedTuple):
    """Episodes of a recording, by number, the place of its file among the blobs, and whether it is the caller's own."""

    name: str
    place: str
    numbers: Sequence[int]
    own: bool


def select_episodes(
    connection: Connection, caller: Caller, items: Items, query: EpisodeQuery
) -> list[Selected]:
    """The episodes of a query that the caller may read. NotFoundError if there are none, StorageError if they are of
    more recordings than one answer can hold."""
    if query.episodes is not None and len(query.recordings or ()) != 1:
        raise StorageError(
            "expected numbers of episodes (`episodes`) with the name of one recording (`recordings`)"
        )
    wanted: list[BaseFilter] = [] if query.filter is None else [query.filter]
    if query.benchmark_filter is not None:
        ids = [header.id for header in items.list_benchmarks(connection, caller, query.benchmark_filter)]
        wanted.append(FilterIN(key="benchmark_id", value=ids))
    if query.recordings is not None:
        names = {episodes.name_now(connection, caller, name) for name in query.recordings}
        wanted.append(FilterIN(key="recording", value=sorted(names)))
    meant = reduce(and_, wanted) if wanted else None
    numbers: dict[str, list[int]] = {}
    kept = None if query.episodes is None else frozenset(query.episodes)
    for header in episodes.find_episodes(connection, caller, meant):
        if kept is None or header.episode in kept:
            numbers.setdefault(header.recording, []).append(header.episode)
    if not numbers:
        raise NotFoundError("there is no such episode")
    if len(numbers) > MOST_MERGED:
        raise StorageError(
            f"expected episodes of at most {MOST_MERGED} recordings, found {len(numbers)}; name some (`recordings`)"
        )
    asked = FILE.c.path.in_(map(escape_text, numbers))
    files = connection.execute(select(FILE.c.path, FILE.c.place, FILE.c.created_by).where(asked))
    of = {unescape_text(row.path): (unescape_text(row.place), row.created_by == caller.name) for row in files}
    return [Selected(name, place, some, own) for name, some in numbers.items() for place, own in [of[name]]]


@contextlib.contextmanager
def opened(blobs: Blobs, selected: Sequence[Selected]) -> Iterator[list[Excerpt]]:
    """Opens the selected episodes; their recordings are closed at the end of the block. NotFoundError if all have been
    deleted meanwhile; LostError, FormatError if a file is gone, or damaged."""
    with contextlib.ExitStack() as stack:
        excerpts = []
        for name, place, numbers, own in selected:
            source = open_stored(blobs, place, name, _CACHE_BYTES // len(selected))
            recording = stack.enter_context(source)
            rows = recording.index[np.isin(recording.index["episode"], list(numbers))]
            if len(rows):
                # what others may not read, they may not count either
                excerpts.append(Excerpt(recording, rows, alone=not own and len(rows) < len(recording)))
        if not excerpts:
            raise NotFoundError("there is no such episode any more")
        yield excerpts
