"""The order of episodes, by a field or a value of their metadata, and the condition for the next page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, Final, NamedTuple, Self

from sqlalchemy import ColumnElement, Connection, and_, case, false, func, or_, select

from tupli_mcap.errors import FilterError, NotFoundError
from tupli_mcap.schema import EpisodeHeader, join_key
from tupli_mcap.schema.facts import path_in
from tupli_mcap.storage.catalog.metadata_sql import number_at, text_at
from tupli_mcap.storage.catalog.tables import EPISODE, LAST_EPISODE, RECORDING, first_of, of_one_recording
from tupli_mcap.storage.texts import escape_text

__all__ = ["After", "Place", "Sort", "beyond", "places"]

_FACTS: Final = {
    name: EPISODE.c[name] for name in ("created_at", "n_tuples", "env", "episode", "end", "created_by")
}
_MAYBE: Final = {name: EPISODE.c[name] for name in ("episode_return", "seed")}
_OF_RECORDING: Final = {"recording": RECORDING.c.path, "benchmark_id": RECORDING.c.benchmark_id}
_SEARCHABLE: Final = re.compile(r"(?!\$)[ !#-&(-\[\]-~]+")  # printable ASCII without " ' and \


_BY_RECORDING: Final = 2  # number of values for the order by recording: path, number of the episode


class After(NamedTuple):
    """The last episode of a page: the path of its recording, and its number there."""

    recording: str
    episode: int


class Sort(NamedTuple):
    """A key to sort episodes by, as filters name it, such as `return` or `metadata.score`.

    Numbers come before texts; episodes with neither come last, in a falling order too, as do metadata that SQL cannot
    look into. Episodes with equal values are ordered by recording (path) and number.
    """

    key: str
    descending: bool = False

    @classmethod
    def parse(cls, text: str) -> Self | None:
        """`-return` is a falling order; None for an empty text."""
        return cls(text.removeprefix("-"), text.startswith("-")) if text else None


class Place(NamedTuple):
    """One of the values that decide the place of an episode; none is NULL."""

    value: ColumnElement[Any]
    descending: bool


def places(
    sort: Sort | None,
    *,
    few: bool,
    backwards: bool = False,
    row_id: ColumnElement[int] = EPISODE.c.id,
) -> list[Place]:
    """What episodes are ordered by, the most important first.

    few: whether they are few among many. Given the bare path to sort by, SQLite walks all episodes in order.
    row_id: the column that has their ids.

    Raises:
        FilterError: there is no such key, or it cannot be sorted by.
    """
    path = func.coalesce(RECORDING.c.path, "") if few else RECORDING.c.path
    found = [*([] if sort is None else _of_key(sort)), Place(path, False), Place(row_id, False)]
    return [Place(value, not falling) for value, falling in found] if backwards else found


def beyond(connection: Connection, order: Sequence[Place], after: After) -> ColumnElement[bool]:
    """The condition for episodes after a given one. If they are ordered by recording alone, that one may be deleted.

    Raises:
        NotFoundError: it was deleted, and the order depends on its values.
    """
    reached: Sequence[Any] | None
    if len(order) == _BY_RECORDING:
        reached = (escape_text(after.recording), first_of(RECORDING.c.id) + min(after.episode, LAST_EPISODE))
    else:
        this = and_(RECORDING.c.path == escape_text(after.recording), EPISODE.c.episode == after.episode)
        values = select(*(value for value, _ in order)).join(RECORDING, of_one_recording()).where(this)
        reached = connection.execute(values).first()
    if reached is None:
        raise NotFoundError("the episode after which the page begins is gone; list from the beginning")
    condition: ColumnElement[bool] = false()
    for (value, descending), limit in zip(reversed(order), reversed(reached), strict=True):
        further = value < limit if descending else value > limit
        condition = or_(further, and_(value == limit, condition))
    (first, descending), limit = order[0], reached[0]
    return and_(first <= limit if descending else first >= limit, condition)  # the former leads to an index


def _of_key(sort: Sort) -> list[Place]:
    name, *inside = path_in(sort.key, EpisodeHeader)
    if not inside and (name in _FACTS or name in _OF_RECORDING):
        return [Place({**_FACTS, **_OF_RECORDING}[name], sort.descending)]
    if not inside and name in _MAYBE:
        return _last_where_missing(_MAYBE[name], sort.descending)
    if name != "metadata" or not inside or not all(map(_SEARCHABLE.fullmatch, inside)):
        raise FilterError(
            f"cannot sort by {join_key([name, *inside])!r}; sort by return, steps, ended, end, seed, env, episode, "
            "recording, or a key of the metadata such as metadata.score"
        )
    number, text = (case((EPISODE.c.readable, at(inside))) for at in (number_at, text_at))
    return [
        *_last_where_missing(number, sort.descending),
        Place(case((text.is_(None), 1), else_=0), False),
        Place(func.coalesce(text, ""), sort.descending),
    ]


def _last_where_missing(value: ColumnElement[Any], descending: bool) -> list[Place]:
    return [Place(case((value.is_(None), 1), else_=0), False), Place(func.coalesce(value, 0), descending)]
