"""The order of episodes, by a field or a value of their metadata: ranges of an index that lie one after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple, Self

from sqlalchemy import ColumnElement, Connection, FromClause, and_, case, exists, func, or_, select, true

from tupli_mcap.errors import FilterError, NotFoundError
from tupli_mcap.schema import EpisodeHeader, join_key
from tupli_mcap.schema.facts import path_in
from tupli_mcap.storage.catalog.metadata_sql import can_search, number_at, text_at
from tupli_mcap.storage.catalog.tables import (
    EPISODE,
    INDEXED_FACTS,
    LAST_EPISODE,
    RECORDING,
    VALUE,
    first_of,
    of_one_recording,
)
from tupli_mcap.storage.texts import escape_text

ORDERED: Final = VALUE.alias("ordered")
"""`VALUE`, by which episodes are put in order."""

_FACTS: Final = {
    name: EPISODE.c[name] for name in ("created_at", "n_tuples", "env", "episode", "end", "created_by")
}
_OF_RECORDING: Final = {"recording": RECORDING.c.path, "benchmark_id": RECORDING.c.benchmark_id}
_MAYBE: Final = {name: EPISODE.c[name] for name in ("episode_return", "seed", "success")}


class After(NamedTuple):
    """The last episode of a page: the path of its recording, and its number there."""

    recording: str
    episode: int


class Sort(NamedTuple):
    """A key to sort episodes by, as filters name it, such as `return` or `metadata.score`.

    Numbers come before texts; episodes with neither come last, in a falling order too. Without a declared key, metadata
    that SQL cannot look into have neither; with one, texts are compared by their beginnings. Episodes with equal values
    are ordered by recording (path) and number.
    """

    key: str
    descending: bool = False

    @classmethod
    def parse(cls, text: str) -> Self | None:
        """Parses a key; `-return` is a descending order. None for an empty text."""
        return cls(text.removeprefix("-"), text.startswith("-")) if text else None


class SortValue(NamedTuple):
    """A value that decides on the place of an episode, and whether the largest one is the first."""

    value: ColumnElement[Any]
    falling: bool


class Range(NamedTuple):
    """Episodes that lie one after the other in an order.

    Attributes:
        table: the one whose index has the order: EPISODE or ORDERED.
        having: which episodes these are.
        places: what they are ordered by, the most important first, and their ids last; none is NULL.
        led_by: columns that the index has before those of `places`, and that are NULL in all these rows. A statement
            has to order by them too, or the database does not use the index.
    """

    table: FromClause
    having: ColumnElement[bool]
    places: Sequence[SortValue]
    led_by: Sequence[ColumnElement[Any]] = ()

    @property
    def row_id(self) -> ColumnElement[int]:
        """The column of their ids."""
        return self.places[-1].value

    @property
    def rows(self) -> FromClause:
        """EPISODE, RECORDING, and what has the value, of all episodes."""
        both = EPISODE.join(RECORDING, of_one_recording())
        return both if self.table is EPISODE else both.join(self.table, self.row_id == EPISODE.c.id)

    @property
    def order(self) -> list[ColumnElement[Any]]:
        """What to order a statement by."""
        places = [*(SortValue(column, self.places[0].falling) for column in self.led_by), *self.places]
        return [value.desc() if falling else value for value, falling in places]

    def backwards(self) -> Range:
        """The same episodes in the opposite order."""
        return self._replace(places=[SortValue(value, not falling) for value, falling in self.places])

    def beyond(self, reached: Sequence[Any]) -> list[Range]:
        """The ranges after an episode with these values."""
        conditions: list[ColumnElement[bool]] = []
        same: ColumnElement[bool] = true()
        for (value, falling), limit in zip(self.places, reached, strict=True):
            conditions.append(and_(same, value < limit if falling else value > limit))
            same = and_(same, value == limit)
        return [self._replace(having=and_(self.having, condition)) for condition in reversed(conditions)]


def has_index(sort: Sort, indexed: Mapping[tuple[str, ...], int]) -> bool:
    """Whether an index has the order of all episodes."""
    path = path_in(sort.key, EpisodeHeader)
    return path in indexed or path[0] in INDEXED_FACTS


def ranges(
    sort: Sort | None,
    indexed: Mapping[tuple[str, ...], int],
    *,
    few: bool,
    backwards: bool = False,
    row_id: ColumnElement[int] = EPISODE.c.id,
) -> list[Range]:
    """The ranges of all episodes, one after the other.

    indexed: see `filter_sql.narrowed`.
    few: whether episodes are few among many. Given the bare path to order by, SQLite walks all of them in order.
    row_id: where no value is needed, the column that has their ids.

    Raises:
        FilterError: there is no such key, or it cannot be sorted by.
    """
    if sort is not None:
        found = _of_key(sort, indexed)
    elif few:
        found = [Range(EPISODE, true(), _by_recording(row_id))]
    else:
        found = [Range(EPISODE, true(), (SortValue(RECORDING.c.path, False), SortValue(row_id, False)))]
    return [part.backwards() for part in reversed(found)] if backwards else found


def beyond(connection: Connection, found: Sequence[Range], sort: Sort | None, after: After) -> list[Range]:
    """The ranges after an episode. If they are ordered by recording alone, that one may be deleted.
    NotFoundError if it was deleted, and the order depends on its values."""
    path, row_id = escape_text(after.recording), row_of(after)
    if sort is None:
        return found[0].beyond([path, row_id])
    for i, part in enumerate(found):
        values = select(*(value for value, _ in part.places)).select_from(part.rows)
        this = values.where(part.having, part.row_id == row_id, RECORDING.c.path == path)
        reached = connection.execute(this).first()
        if reached is not None:
            return [*part.beyond(reached), *found[i + 1 :]]
    raise gone_meanwhile()


def row_of(after: After) -> ColumnElement[int]:
    """The id that an episode has, beside the row of its recording."""
    return first_of(RECORDING.c.id) + min(after.episode, LAST_EPISODE)


def gone_meanwhile() -> NotFoundError:
    """The error for a page that begins after an episode which is not there any more."""
    return NotFoundError("the episode after which the page begins is gone; list from the beginning")


def _by_recording(row_id: ColumnElement[int] = EPISODE.c.id) -> list[SortValue]:
    return [SortValue(func.coalesce(RECORDING.c.path, ""), False), SortValue(row_id, False)]


def _of_key(sort: Sort, indexed: Mapping[tuple[str, ...], int]) -> list[Range]:
    path, falling = path_in(sort.key, EpisodeHeader), sort.descending
    name, *inside = path
    if path in indexed and name not in INDEXED_FACTS:
        return _of_declared(indexed[path], falling)
    if not inside and name in (*_FACTS, *_OF_RECORDING):
        return [_of_column({**_FACTS, **_OF_RECORDING}[name], true(), falling)]
    if not inside and name in _MAYBE:
        column = _MAYBE[name]
        return [
            _of_column(column, column.is_not(None), falling),
            Range(EPISODE, column.is_(None), _by_recording()),
        ]
    if name != "metadata" or not inside or not can_search(inside):
        raise FilterError(
            f"cannot sort by {join_key([name, *inside])!r}; sort by return, steps, success, ended, end, seed, env, "
            "episode, recording, or a key of the metadata such as metadata.score"
        )
    number, text = (case((EPISODE.c.readable, at(inside))) for at in (number_at, text_at))
    return [
        _of_column(number, number.is_not(None), falling),
        _of_column(text, text.is_not(None), falling),
        Range(EPISODE, and_(number.is_(None), text.is_(None)), _by_recording()),
    ]


def _of_column(value: ColumnElement[Any], having: ColumnElement[bool], falling: bool) -> Range:
    return Range(EPISODE, having, [SortValue(value, falling), *_by_recording()])


def _of_declared(key: int, falling: bool) -> list[Range]:
    row_id, number, text = ORDERED.c.episode_id, ORDERED.c.number, ORDERED.c.text
    of_key, after = ORDERED.c.key == key, _by_recording(row_id)
    texts = and_(number.is_(None), text.is_not(None))
    held = exists().where(row_id == EPISODE.c.id, of_key, or_(number.is_not(None), text.is_not(None)))
    return [
        Range(ORDERED, and_(of_key, number.is_not(None)), [SortValue(number, falling), *after]),
        Range(ORDERED, and_(of_key, texts), [SortValue(text, falling), *after], led_by=[number]),
        Range(EPISODE, ~held, _by_recording()),
    ]
