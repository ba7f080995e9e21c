"""A page of episodes: the first in some order that a filter is true of, without a look at all others.

1. If an index finds only a few episodes that may match, they are sorted, and checked one after another. Of a sorted
   page, the episodes of the recordings that the query is about may also be only a few.
2. If it finds many, or there is no index for the filter, but one for the order: the next episodes in that order are
   checked, since some of the many are probably among them.
3. If those were not enough, all episodes that all indexes find are sorted, and checked one after another.

The statements of 1 and 2 can be run in one way only. A database with a choice would choose badly: the columns of
`VALUE` depend on each other, so it cannot estimate how many rows it will find.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import ColumnElement, Connection, Select, Subquery, and_, func, or_, select, true

from tupli_mcap.schema import BaseFilter, EpisodeHeader
from tupli_mcap.storage.catalog.compare_sql import Narrowed
from tupli_mcap.storage.catalog.filter_sql import IndexLookup, in_all, narrowed, recordings_of, sources
from tupli_mcap.storage.catalog.order import After, Range, Sort, beyond, has_index, ranges
from tupli_mcap.storage.catalog.tables import (
    EPISODE,
    EPISODE_BITS,
    LAST_EPISODE,
    RECORDING,
    TALLY,
    episodes_of,
    in_order,
)
from tupli_mcap.storage.texts import escape_text

_FEW: Final = 5_000  # most episodes that are sorted (1)
_SCANNED: Final = 30_000  # most among which those of the query's recordings are counted (1)
_MOST: Final = 200_000  # most that are checked after sorting (3)
_NEAR: Final = 10_000  # that are checked in order, or as many as are wanted (2)
_RECORDINGS: Final = 100  # at once
_GROUP: Final = 500  # episodes that are worth a statement
_FETCHED_FIRST, _FETCHED = 50, 500  # rows at once
Told = Callable[[Sequence[EpisodeHeader]], Sequence[EpisodeHeader]]
"""Makes headers that name only some of their groups."""


@dataclass(frozen=True)
class Asked:
    """A query: which episodes, and in which order.

    filter: bound to headers of episodes. indexed: see `filter_sql.narrowed`. only, of: further conditions, on rows of
    EPISODE, and on rows of RECORDING alone. after: where the page begins. told: makes the headers that the filter looks
    at; None for those of the catalog.
    """

    filter: BaseFilter | None
    indexed: Mapping[tuple[str, ...], int]
    only: ColumnElement[bool]
    of: ColumnElement[bool]
    sort: Sort | None = None
    after: After | None = None
    backwards: bool = False
    told: Told | None = None

    def recordings(self) -> ColumnElement[bool]:
        """The recordings that may have such episodes."""
        return self.of if self.filter is None else and_(self.of, recordings_of(self.filter))

    @functools.cached_property
    def each(self) -> Narrowed:
        """The condition on rows of EPISODE and RECORDING of the filter, which looks at each of them."""
        if self.filter is None:
            return Narrowed(true())
        return narrowed(self.filter, self.indexed, by_index=False)

    def meets(self) -> ColumnElement[bool]:
        """The condition on rows of EPISODE and RECORDING that is true of all such episodes of their recordings."""
        return and_(self.only, self.each.may)

    def order(
        self, connection: Connection, *, few: bool, row_id: ColumnElement[int] = EPISODE.c.id
    ) -> list[Range]:
        """The ranges in which episodes lie, from where the page begins; see `ranges`."""
        found = ranges(self.sort, self.indexed, few=few, backwards=self.backwards, row_id=row_id)
        return found if self.after is None else beyond(connection, found, self.sort, self.after)


@dataclass
class Left:
    """How many more episodes may be looked at."""

    most: int


def candidates(connection: Connection, asked: Asked, wanted: int) -> Iterator[tuple[Iterable[int], Left]]:
    """The ids of episodes, in order and found as they are needed, among which the first `wanted` that match are likely
    to be. If more may be looked at after the last one, all that match were among them; else, if those were not enough,
    others follow, which start anew."""
    given = [] if asked.filter is None else sources(asked.filter, asked.indexed)
    near = wanted if asked.filter is None and asked.sort is None else max(wanted, _NEAR)
    fewest = _fewest(connection, asked, given)
    if fewest is not None:
        (source, count), left = fewest, Left(_FEW + 1)
        yield _ids(connection, asked, source, left) if count else (), left
        return
    left = Left(near)
    if asked.sort is None:
        yield _next(connection, asked, left), left
    elif has_index(asked.sort, asked.indexed):
        yield _by_index(connection, asked, left), left
    if given:
        left = Left(_MOST)
        yield _ids(connection, asked, in_all(given).subquery(), left), left


def _fewest(
    connection: Connection, asked: Asked, given: Sequence[IndexLookup]
) -> tuple[Subquery, int] | None:
    """The ids of the source that has the fewest, and how many, if they are few. If a page is sorted and all sources
    have many, only their ids in the recordings that may have such episodes are counted."""
    fewest, least = None, _FEW + 1
    if asked.sort is not None:
        of_recordings = in_order(), asked.recordings()
        given = [*given, IndexLookup(EPISODE.c.id, of_recordings, [true()], [])]
    for source in given:
        some = source.first(_FEW + 1)
        count = _count(connection, some)
        if count < least:
            fewest, least = (some, count), count
    if fewest is not None or asked.sort is None:
        return fewest
    for source in given[:-1]:
        every = source.first(_SCANNED)
        joined = every.join(RECORDING, RECORDING.c.id == every.c[0] // (1 << EPISODE_BITS))
        some = select(every.c[0]).select_from(joined).where(asked.recordings()).limit(_FEW + 1).subquery()
        count = _count(connection, some)
        if count < least and _count(connection, every) < _SCANNED:
            fewest, least = (some, count), count
    return fewest


def _count(connection: Connection, ids: Subquery) -> int:
    count: int = connection.execute(select(func.count()).select_from(ids)).scalar_one()
    return count


def _ids(connection: Connection, asked: Asked, source: Subquery, left: Left) -> Iterator[int]:
    """The ids of a source in order."""
    for part in asked.order(connection, few=True, row_id=source.c[0]):
        joined = source.join(RECORDING, RECORDING.c.id == source.c[0] // (1 << EPISODE_BITS))
        if asked.sort is not None:
            joined = joined.join(part.table, part.row_id == source.c[0])
        query = select(part.row_id).select_from(joined).where(asked.recordings(), part.having)
        for (row_id,) in _streamed(connection, query.order_by(*part.order).limit(left.most)):
            yield row_id
            left.most -= 1
        if left.most <= 0:
            return


def _by_index(connection: Connection, asked: Asked, left: Left) -> Iterator[int]:
    """The ids of the first episodes, in the order of an index, that SQL tells may match."""
    for part in asked.order(connection, few=False):
        both = part.table.join(RECORDING, RECORDING.c.id == part.row_id // (1 << EPISODE_BITS))
        if part.table is not EPISODE:
            both = both.join(EPISODE, EPISODE.c.id == part.row_id)
        query = select(part.row_id, and_(asked.meets(), asked.recordings())).select_from(both)
        query = query.where(part.having).order_by(*part.order).limit(left.most)
        for row_id, meets in _streamed(connection, query):
            if meets:
                yield row_id
            left.most -= 1
        if left.most <= 0:
            return


def _next(connection: Connection, asked: Asked, left: Left) -> Iterator[int]:
    """The ids of the next episodes, in the order of their recordings, that SQL tells may match; fetched a page at a
    time, as many episodes are looked at for each. Without a filter, only those that are found count as looked at."""
    found: Iterable[int]
    both = EPISODE.join(RECORDING, RECORDING.c.id == EPISODE.c.recording_id)
    meets = asked.meets()
    for group, size in _groups(connection, asked):
        if left.most <= 0:
            return
        own = or_(*(_part(asked, item) for item in group))
        query = select(EPISODE.c.id).select_from(both).where(meets, own)
        if len(group) == 1:  # of many, all are put in order below
            query = query.order_by(EPISODE.c.id.desc() if asked.backwards else EPISODE.c.id)
            if asked.filter is None:
                query = query.limit(left.most)
            elif size > left.most:
                query = query.where(_first(own, left.most, asked.backwards))
            found = (row_id for (row_id,) in _streamed(connection, query))
        else:
            found = _in_order(connection.execute(query).scalars(), group, asked.backwards)
        if asked.filter is not None:
            yield from found
            left.most -= size
            continue
        for row_id in itertools.islice(found, left.most):
            yield row_id
            left.most -= 1


def _first(own: ColumnElement[bool], most: int, backwards: bool) -> ColumnElement[bool]:
    """The condition that an episode is one of the first so many of some."""
    row_id = EPISODE.c.id
    others = select(row_id).where(own).order_by(row_id.desc() if backwards else row_id).offset(most).limit(1)
    bound = others.correlate(None).scalar_subquery()
    return row_id > func.coalesce(bound, -1) if backwards else row_id < func.coalesce(bound, sys.maxsize)


def _in_order(found: Iterable[int], group: Sequence[tuple[int, str]], backwards: bool) -> list[int]:
    """Ids in the order of recordings."""
    places, sign = {number: i for i, (number, _) in enumerate(group)}, -1 if backwards else 1
    return sorted(found, key=lambda row_id: (places[row_id >> EPISODE_BITS], sign * row_id))


def _streamed(connection: Connection, query: Select[*tuple[Any, ...]]) -> Iterator[Any]:
    """The rows that a query finds, fetched as they are needed: a few first, then more at once."""
    size = _FETCHED_FIRST
    with contextlib.closing(connection.execute(query, execution_options={"yield_per": size})) as rows:
        while some := rows.fetchmany(size):
            yield from some
            size = min(2 * size, _FETCHED)


def _part(asked: Asked, recording: tuple[int, str]) -> ColumnElement[bool]:
    """Where an episode is of a recording, and not before the page."""
    number, path = recording
    own = episodes_of(number, EPISODE.c.id)
    if asked.after is None or path != escape_text(asked.after.recording):
        return own
    reached = (number << EPISODE_BITS) + min(asked.after.episode, LAST_EPISODE)
    return and_(own, EPISODE.c.id < reached if asked.backwards else EPISODE.c.id > reached)


def _groups(connection: Connection, asked: Asked) -> Iterator[tuple[list[tuple[int, str]], int]]:
    """Recordings in order, by id and path: one of many episodes, or several of few, as often as there are more; and how
    many episodes they have."""
    path, reached = RECORDING.c.path, None if asked.after is None else escape_text(asked.after.recording)
    sums = select(func.sum(TALLY.c.episodes)).where(TALLY.c.recording_id == RECORDING.c.id).scalar_subquery()
    query = select(RECORDING.c.id, path, sums).where(asked.recordings()).limit(_RECORDINGS)
    query = query.order_by(path.desc() if asked.backwards else path)
    first = query if reached is None else query.where(path <= reached if asked.backwards else path >= reached)
    found = connection.execute(first).all()
    while found:
        group: list[tuple[int, str]] = []
        size = 0
        for number, name, episodes in found:
            if group and size + (episodes or 0) > _GROUP:
                yield group, size
                group, size = [], 0
            group.append((number, name))
            size += episodes or 0
        if group:
            yield group, size
        if len(found) < _RECORDINGS:
            return
        last = found[-1][1]
        found = connection.execute(query.where(path < last if asked.backwards else path > last)).all()
