"""Sums over the episodes of recordings: their number, lengths, returns and times."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

from sqlalchemy import (
    ColumnElement,
    Connection,
    Float,
    and_,
    case,
    cast,
    delete,
    exists,
    false,
    func,
    insert,
    select,
    true,
)

from tupli_mcap import jsonvalue
from tupli_mcap.storage.catalog.tables import EPISODE, RECORDING, TALLY, episodes_of
from tupli_mcap.storage.texts import unescape_text

Seen = Callable[[ColumnElement[str], ColumnElement[str]], ColumnElement[bool]]
"""What may be seen: a condition on `created_by` and `published_in` of any table that has them."""

_LARGE: Final = 1e290


class Tally(NamedTuple):
    """A recording, and sums over its visible episodes.

    Attributes:
        owner: of the visible episodes; the first by name if there are several.
        size: of the file (bytes); None unless all of its episodes are visible, and none is known to be deleted.
        returns, return_sum, return_least, return_most: of the episodes whose return is a number; None if none is. The
            sum is NaN if some are too large and others too small to be added.
        told, succeeded: number of episodes that say whether they succeeded, and of those that did.
        first, last: when the first and the last of them ended (ns since 1970, UTC).
        runs: of the visible episodes, as `EpisodeHeader.run`; those of deleted ones are left out only if the caller of
            `tallies` says of which recordings episodes were deleted.
    """

    recording: str
    uuid: str
    benchmark_id: str
    environment: str
    owner: str
    size: int | None
    mixed: int
    runs: list[dict[str, Any]]
    episodes: int
    steps: int
    returns: int
    return_sum: float | None
    return_least: float | None
    return_most: float | None
    told: int
    succeeded: int
    first: int
    last: int


def recordings_seen(seen: Seen) -> ColumnElement[bool]:
    """The recordings of which some episodes may be seen, as a condition on RECORDING."""
    return exists().where(
        TALLY.c.recording_id == RECORDING.c.id, seen(TALLY.c.created_by, TALLY.c.published_in)
    )


def tally(connection: Connection, recording_id: int) -> None:
    """Computes the sums of a recording again."""
    connection.execute(delete(TALLY).where(TALLY.c.recording_id == recording_id))
    groups = (EPISODE.c.recording_id, EPISODE.c.created_by, EPISODE.c.published_in)
    sums = (
        func.count(),
        func.sum(cast(EPISODE.c.n_tuples, Float)),
        func.count(EPISODE.c.episode_return),
        _sum_of_returns(),
        func.min(EPISODE.c.episode_return),
        func.max(EPISODE.c.episode_return),
        func.count(EPISODE.c.success),
        func.sum(case((EPISODE.c.success == 1, 1), else_=0)),
        func.min(EPISODE.c.created_at),
        func.max(EPISODE.c.created_at),
    )
    summed = select(*groups, *sums).where(episodes_of(recording_id, EPISODE.c.id)).group_by(*groups)
    connection.execute(insert(TALLY).from_select([column.name for column in TALLY.c], summed))


def _sum_of_returns() -> ColumnElement[float]:
    """The sum of returns; infinite if some are so large that PostgreSQL might fail, which refuses infinite sums."""
    found = EPISODE.c.episode_return
    usual = func.sum(case((func.abs(found) < _LARGE, found), else_=0.0))
    return case(
        (func.count(found) == 0, None),
        (func.max(found) >= _LARGE, math.inf),
        (func.min(found) <= -_LARGE, -math.inf),
        else_=usual,
    )


def tallies(
    connection: Connection,
    seen: ColumnElement[bool] | None = None,
    of: ColumnElement[bool] | None = None,
    some_deleted: ColumnElement[bool] | None = None,
) -> Iterator[Tally]:
    """The recordings with visible episodes, in the order of their paths.

    `seen` is a condition on TALLY.c.created_by and .published_in. `of` and `some_deleted` are conditions on RECORDING:
    which of them are meant, and of which episodes were deleted.
    """
    texts = [RECORDING.c[name] for name in ("path", "uuid", "benchmark_id", "environment")]
    others = [RECORDING.c[name] for name in ("id", "size", "mixed", "runs")]
    each = TALLY.alias()
    count = select(func.sum(each.c.episodes)).where(each.c.recording_id == RECORDING.c.id).scalar_subquery()
    is_shorter = case((false() if some_deleted is None else some_deleted, 1), else_=0)
    sums = [
        func.sum(TALLY.c.episodes),
        func.sum(TALLY.c.steps),
        func.sum(TALLY.c.returns),
        func.sum(TALLY.c.return_sum),
        func.min(TALLY.c.return_least),
        func.max(TALLY.c.return_most),
        func.sum(TALLY.c.told),
        func.sum(TALLY.c.succeeded),
        func.min(TALLY.c.first),
        func.max(TALLY.c.last),
    ]
    query = (
        select(*texts, func.min(TALLY.c.created_by), *others, count, is_shorter, *sums)
        .join(TALLY, TALLY.c.recording_id == RECORDING.c.id)
        .where(true() if seen is None else seen, true() if of is None else of)
        .group_by(RECORDING.c.id)
        .order_by(RECORDING.c.path)
    )
    found = connection.execute(query).all()
    for path, uuid, benchmark_id, environment, owner, *told in found:
        path, benchmark_id, environment, owner = map(unescape_text, (path, benchmark_id, environment, owner))
        (number, size, mixed, text, most, shorter), summed = told[:6], told[6:]
        counts: list[Any] = [int(value) if i not in (3, 4, 5) else value for i, value in enumerate(summed)]
        if counts[4] is not None and counts[4] <= -_LARGE and counts[5] >= _LARGE:
            counts[3] = math.nan
        runs, whole = jsonvalue.loads(text), counts[0] == int(most) and not shorter
        if len(runs) > 1 and not whole:
            runs = [runs[place] for place in _runs_seen(connection, number, seen)]
        size = size if whole else None
        yield Tally(path, uuid, benchmark_id, environment, owner, size, mixed, runs, *counts)


def _runs_seen(connection: Connection, recording_id: int, seen: ColumnElement[bool] | None) -> list[int]:
    """The places of the runs of which some episodes are visible, among those of their recording."""
    same = [TALLY.c[name] == EPISODE.c[name] for name in ("recording_id", "created_by", "published_in")]
    query = select(EPISODE.c.run).distinct().join(TALLY, and_(*same)).order_by(EPISODE.c.run)
    visible = true() if seen is None else seen
    return list(connection.execute(query.where(episodes_of(recording_id, EPISODE.c.id), visible)).scalars())
