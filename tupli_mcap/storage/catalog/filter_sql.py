"""Turns filters into SQL that finds all rows which may match, with the columns and indexes there are.

Python looks again at rows of which SQL is not sure (`tupli_mcap.schema.predicate`), so that a filter means the same
everywhere.

Everything is SQL of any database, but for what is in `metadata_sql`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from sqlalchemy import (
    CompoundSelect,
    Select,
    Subquery,
    and_,
    case,
    exists,
    false,
    func,
    or_,
    select,
    true,
    tuple_,
    union_all,
)
from sqlalchemy.sql.elements import ColumnElement

from tupli_mcap.schema import BaseFilter, FilterIN, FilterType
from tupli_mcap.schema.facts import comparisons
from tupli_mcap.schema.filters import COMBINING, path_of
from tupli_mcap.storage.catalog.compare_sql import (
    ALL,
    Condition,
    Narrowed,
    compared,
    flagged,
    near_value,
    of_runs,
    recorded,
    unsure_value,
)
from tupli_mcap.storage.catalog.tables import EPISODE, EPISODE_BITS, INDEXED_FACTS, VALUE

_MOST_COMPARISONS: Final = 64  # in a statement: databases limit them
_NOT_INDEXED: Final = (FilterType.NE, FilterType.CONTAINS)


def narrowed(
    filter: BaseFilter, indexed: Mapping[tuple[str, ...], int], *, by_index: bool = True
) -> Narrowed:
    """The condition on rows of `EPISODE` joined with `RECORDING` of a filter that is `bound` to episode headers.

    indexed: the paths of declared keys that `VALUE` holds, and their numbers there.
    by_index: whether an index of `VALUE` has to find the episodes; else `VALUE` is asked about each episode.
    """
    parts = list(filter.filters) if filter.type is FilterType.AND else [filter]
    kept, room = [], _MOST_COMPARISONS
    for part in parts:
        size = sum(1 for _ in comparisons(part))
        if size <= room:
            kept.append(part)
            room -= size
    found = _all(kept, indexed, by_index)
    return found if len(kept) == len(parts) else found._replace(unsure=ALL.unsure)


def recordings_of(filter: BaseFilter) -> Condition:
    """A condition on rows of `RECORDING` alone that is true for all recordings with episodes that may match a
    filter."""
    if filter.type is FilterType.AND:
        return and_(true(), *(recordings_of(part) for part in filter.filters))
    if filter.type in COMBINING:
        return true()
    path = path_of(filter)
    if path[0] in ("recording", "benchmark_id"):
        return compared(filter).may
    if path == ("created_at",):
        return recorded(filter)
    if path == ("run", "name") and filter.type in (FilterType.EQ, FilterType.IN):
        return of_runs(filter)
    return true()


class IndexLookup(NamedTuple):
    """Episodes that an index leads to.

    Attributes:
        row_id: the column of their ids.
        all: conditions that hold for them.
        either: one of these holds, too. A database uses an index for each of them, but not for one OR.
        by: the columns of the index.
    """

    row_id: ColumnElement[int]
    all: Sequence[Condition]
    either: Sequence[Condition]
    by: Sequence[ColumnElement[Any]]

    def first(self, most: int) -> Subquery:
        """At most so many of their ids. Those of a range are sorted by its index: otherwise a database that expects to
        find a few of many rows would search the table."""
        if len(self.either) > 1:
            return self._union().limit(most).subquery()
        return select(self.row_id).where(*self.all, *self.either).order_by(*self.by).limit(most).subquery()

    def _union(self) -> CompoundSelect[Any]:
        return union_all(*(select(self.row_id).where(*self.all, one) for one in self.either))

    def has(self, ids: Subquery) -> Condition:
        """The condition that a row of ids is one of theirs."""
        row_id = ids.c[0]
        same = self.row_id == row_id, _recording(self.row_id) == _recording(row_id)
        return exists().where(*same, *self.all, or_(*self.either)).correlate(ids)


def sources(filter: BaseFilter, indexed: Mapping[tuple[str, ...], int]) -> list[IndexLookup]:
    """What an index finds for a filter; each has all episodes that match."""
    if filter.type is FilterType.AND:
        parts = [*_leaves(filter)]
    else:
        parts = [] if filter.type in COMBINING else [filter]
    values: list[BaseFilter] = []
    facts: dict[str, list[Condition]] = {}
    for part in parts:
        path = path_of(part)
        if part.type in _NOT_INDEXED:
            continue
        if path[0] in INDEXED_FACTS:
            facts.setdefault(path[0], []).append(compared(part).may)
        elif path in indexed:
            values.append(part)
    row_id = EPISODE.c.id
    of_facts = (
        IndexLookup(row_id, found, [true()], (EPISODE.c[name], row_id)) for name, found in facts.items()
    )
    return [*of_facts, *_by_values(values, indexed)]


def in_all(given: Sequence[IndexLookup]) -> Select[Any]:
    """Ids of episodes that each source has, and of their recordings: PostgreSQL hashes ids alone so that many of them
    collide."""
    # of several alternatives, each is for one value, and an index has its ids in order
    first, *others = sorted(given, key=lambda source: len(source.either), reverse=True)
    ids = first._union().subquery()
    row_id = ids.c[0]
    return select(row_id, _recording(row_id)).where(*(other.has(ids) for other in others))


def _recording(row_id: ColumnElement[int]) -> ColumnElement[int]:
    return row_id // (1 << EPISODE_BITS)


def _by_values(parts: Sequence[BaseFilter], indexed: Mapping[tuple[str, ...], int]) -> list[IndexLookup]:
    """What the index of `VALUE` finds for comparisons that must all be true. Flags are in each of its rows, and lead
    to episodes by themselves only if nothing else does."""
    values: dict[int, list[Sequence[Condition]]] = {}
    flags: dict[int, list[Sequence[Condition]]] = {}
    also = []
    for part in parts:
        key = indexed[path_of(part)]
        flag = flagged(part, key)
        (values if flag is None else flags).setdefault(key, []).append(near_value(part))
        also += [] if flag is None else [flag]
    by = (VALUE.c.number, VALUE.c.text, VALUE.c.episode_id)
    found = []
    for key, alternatives in (values or dict(itertools.islice(flags.items(), 1))).items():
        most = max(alternatives, key=len)
        others = [or_(*each) for each in alternatives if each is not most]
        found.append(IndexLookup(VALUE.c.episode_id, [VALUE.c.key == key, *also, *others], most, by))
    return found


def _leaves(filter: BaseFilter) -> Iterator[BaseFilter]:
    """The comparisons that must all be true if a filter is true."""
    for part in filter.filters:
        if part.type is FilterType.AND:
            yield from _leaves(part)
        elif part.type not in COMBINING:
            yield part


def merged(filter: BaseFilter) -> BaseFilter:
    """The same filter; parts of an OR that compare one key with one value each become one IN."""
    if filter.type not in COMBINING:
        return filter
    parts = [merged(part) for part in filter.filters]
    if filter.type is FilterType.OR:
        equal: dict[tuple[str, ...], list[BaseFilter]] = {}
        for part in parts:
            if part.type is FilterType.EQ:
                equal.setdefault(path_of(part), []).append(part)
        parts = [part for part in parts if part.type is not FilterType.EQ]
        for same in equal.values():
            parts.append(FilterIN(key=same[0].key, value=[part.value for part in same]))
    return filter.model_copy(update={"filters": tuple(parts)})


def _narrow(filter: BaseFilter, indexed: Mapping[tuple[str, ...], int], by_index: bool) -> Narrowed:
    if filter.type is FilterType.NOT:
        return _narrow(filter.filters[0], indexed, False).negated()  # no index leads to what does not match
    if filter.type is FilterType.OR:
        parts = [_narrow(part, indexed, by_index) for part in filter.filters]
        either = or_(false(), *(part.may for part in parts))
        return Narrowed(either, _unsure(parts))
    found = _all(filter.filters if filter.type is FilterType.AND else [filter], indexed, by_index)
    if found.ids is None:
        return found
    both = tuple_(EPISODE.c.id, EPISODE.c.recording_id)
    return Narrowed(and_(found.may, both.in_(found.ids)), found.unsure)


def _all(filters: Sequence[BaseFilter], indexed: Mapping[tuple[str, ...], int], by_index: bool) -> Narrowed:
    """The condition that all filters are true; comparisons of one key in `VALUE` are joined."""
    parts: list[Narrowed] = []
    values: list[BaseFilter] = []
    by_index = by_index and not any(_names_few(part) for part in filters)
    for part in filters:
        if part.type in COMBINING:
            parts.append(_narrow(part, indexed, by_index))
            continue
        path, narrow = path_of(part), compared(part)
        is_fact = path[0] != "metadata"  # which has a column of its own
        if path in indexed and part.type not in _NOT_INDEXED and (by_index or not is_fact):
            values.append(part)
            narrow = narrow if is_fact else Narrowed(true(), unsure_value(part, indexed[path]))
        parts.append(narrow)
    ids, held = None, []
    if by_index and values:
        ids = in_all(_by_values(values, indexed))
    else:
        held = [_held(part, indexed[path_of(part)]) for part in values]
    return Narrowed(and_(true(), *held, *(part.may for part in parts)), _unsure(parts), ids)


def _held(part: BaseFilter, key: int) -> Condition:
    """The condition that an episode's `VALUE` at a key may be as a comparison says. A database looks up what is asked
    for in this way, and does not read the values of all episodes instead."""
    own = VALUE.c.episode_id == EPISODE.c.id, VALUE.c.key == key
    flag = flagged(part, key)
    met = case((and_(or_(*near_value(part)), true() if flag is None else flag), 1), else_=0)
    return func.coalesce(select(met).where(*own).correlate(EPISODE).scalar_subquery(), 0) == 1


def _unsure(parts: Sequence[Narrowed]) -> list[Condition]:
    return [condition for part in parts for condition in part.unsure]


def _names_few(filter: BaseFilter) -> bool:
    """Whether a filter names episodes or recordings: checking each is quicker than finding others by a value."""
    is_equal = filter.type in (FilterType.EQ, FilterType.IN)
    return is_equal and path_of(filter)[0] in ("id", "recording")
