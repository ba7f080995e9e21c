"""What is written to the tables of a catalog and asked of them, each in a transaction of the caller's.

The tables may lie in any SQL database: in the catalog of a directory, or in that of a server.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import sys
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from sqlalchemy import Connection, Select, Table, and_, delete, func, insert, select, true
from sqlalchemy.exc import DBAPIError
from sqlalchemy.sql.elements import ColumnElement

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FilterError
from tupli_mcap.schema import BaseFilter, EpisodeHeader, bound
from tupli_mcap.schema.facts import path_in
from tupli_mcap.schema.predicate import bound_predicate
from tupli_mcap.storage.catalog.filter_sql import Narrowed, merged, narrowed
from tupli_mcap.storage.catalog.order import After, Place, Sort, beyond, places
from tupli_mcap.storage.catalog.rows import (
    EpisodeRow,
    StoredRow,
    header,
    indexed_value,
    is_indexed,
    load_metadata,
    store_row,
)
from tupli_mcap.storage.catalog.tables import (
    DECLARED,
    EPISODE,
    RECORDING,
    TALLY,
    VALUE,
    episodes_of,
    in_order,
    of_one_recording,
)
from tupli_mcap.storage.catalog.tallies import tally
from tupli_mcap.storage.listing import RecordingStamp
from tupli_mcap.storage.texts import escape_text, unescape_text

__all__ = [
    "After",
    "Sort",
    "count_episodes",
    "declare_key",
    "declared_keys",
    "each_once",
    "find_episodes",
    "insert_all",
    "plan_of",
    "put_recording",
    "remove_recording",
]

_ROWS_AT_ONCE: Final = 20_000
_ROWS_OF_ANSWER: Final = 500  # as many recordings are named in a statement at most
_COLUMNS: Final = tuple(EPISODE.c[name] for name in StoredRow._fields)


def put_recording(
    connection: Connection,
    relpath: str,
    stamp: RecordingStamp,
    *,
    uuid: str,
    benchmark_id: str,
    rows: Iterable[EpisodeRow],
    runs: str,
) -> None:
    """Adds a recording in place of what was known of it. `runs` is JSON: a list of those that its episodes are of.

    Raises:
        FormatError: A row's metadata is not a strict JSON object.
    """
    number = _add_recording(connection, relpath, stamp, uuid, benchmark_id, runs)
    indexed = _indexed(connection)
    remaining = iter(rows)
    while chunk := [store_row(number, row) for row in itertools.islice(remaining, _ROWS_AT_ONCE)]:
        insert_all(connection, EPISODE, StoredRow._fields, chunk)
        _index(connection, chunk, indexed)
    tally(connection, number)


def find_episodes(
    connection: Connection,
    filter: BaseFilter | None,
    *,
    limit: int | None = None,
    offset: int = 0,
    after: After | None = None,
    only: ColumnElement[bool] | None = None,
    sort: Sort | None = None,
    backwards: bool = False,
) -> Iterator[EpisodeHeader]:
    """The episodes that match a filter, by default ordered by recording (path) and episode number.

    after: where to go on. only: a condition on rows of EPISODE and RECORDING that holds besides the filter.
    backwards: in the opposite order; `after` is then the episode before which they lie.

    Raises:
        FilterError: The filter names an unknown top-level key, or compares a fact with what it can never be; or
            the key to sort by is unknown.
        NotFoundError: The episode to go on after is gone.
    """
    meant, order = _bound(filter), places(sort, few=filter is not None, backwards=backwards)
    found = _narrowed(connection, meant, only)
    if after is not None:
        found = found._replace(condition=and_(found.condition, beyond(connection, order, after)))
    if found.exact:
        return _headers(connection, meant, found, order, limit, offset)
    headers = _headers(connection, meant, found, order, None, 0)
    return itertools.islice(headers, offset, None if limit is None else min(offset + limit, sys.maxsize))


def each_once(headers: Iterable[EpisodeHeader], user: str) -> list[EpisodeHeader]:
    """Each episode once: of one that several people have stored, the user's own, or else the first."""
    found: dict[str, EpisodeHeader] = {}
    for each in headers:
        if each.id not in found or each.created_by == user:
            found[each.id] = each
    return list(found.values())


def count_episodes(
    connection: Connection,
    filter: BaseFilter | None,
    *,
    only: ColumnElement[bool] | None = None,
    most: int | None = None,
) -> int:
    """How many episodes match a filter, counted up to `most`. Raises as `find_episodes` does."""
    meant = _bound(filter)
    found = _narrowed(connection, meant, only)
    if found.exact and most is None:
        return int(connection.execute(_query(meant, found, func.count())).scalar_one())
    if found.exact:
        some = _query(meant, found, EPISODE.c.id).limit(most).subquery()
        return int(connection.execute(select(func.count()).select_from(some)).scalar_one())
    headers = _headers(connection, meant, found, places(None, few=True), None, 0)
    return sum(1 for _ in itertools.islice(headers, most))


def plan_of(connection: Connection, filter: BaseFilter | None) -> str:
    """The SQL of a filter, its parameters, the database's plan for it, and whether Python looks at what that finds."""
    meant = _bound(filter)
    found = _narrowed(connection, meant, None)
    compiled = _query(meant, found, EPISODE.c.id).compile(
        connection, compile_kwargs={"render_postcompile": True}
    )
    values: Any = compiled.params
    if compiled.positional:
        values = tuple(compiled.params[name] for name in compiled.positiontup or ())
    explain = "EXPLAIN QUERY PLAN" if connection.dialect.name == "sqlite" else "EXPLAIN"
    steps = [f"  {row[-1]}" for row in connection.exec_driver_sql(f"{explain} {compiled}", values)]
    last = [] if found.exact else ["then each episode that was found is compared exactly"]
    return "\n".join([str(compiled), f"parameters: {values!r}", "plan:", *steps, *last])


def declare_key(connection: Connection, key: str) -> None:
    """Indexes a key, so that filters on it find few episodes among many; declaring it twice is fine.

    Raises:
        FilterError: There is no such top-level key, or it is that of all metadata.
    """
    path = path_in(key, EpisodeHeader)
    if path == ("metadata",):
        raise FilterError(f"key {key!r} cannot be declared: name one in it, such as metadata.score")
    if connection.execute(select(DECLARED).where(DECLARED.c.key == escape_text(key))).first():
        return
    number = connection.execute(select(func.count()).select_from(DECLARED)).scalar_one()
    connection.execute(insert(DECLARED).values(key=escape_text(key), number=number))
    if is_indexed(path):
        all_rows = select(*_COLUMNS).order_by(EPISODE.c.id)
        for chunk in connection.execute(
            all_rows, execution_options={"yield_per": _ROWS_AT_ONCE}
        ).partitions():
            _index(connection, [StoredRow(*row) for row in chunk], {path: number})


def declared_keys(connection: Connection) -> list[str]:
    """The declared keys, in the order of their declaration."""
    keys = connection.execute(select(DECLARED.c.key).order_by(DECLARED.c.number)).scalars()
    return [unescape_text(key) for key in keys]


def remove_recording(connection: Connection, relpath: str) -> None:
    """Forgets a recording and its episodes; nothing happens if it is not catalogued."""
    number = connection.execute(
        select(RECORDING.c.id).where(RECORDING.c.path == escape_text(relpath))
    ).scalar()
    if number is None:
        return
    connection.execute(delete(TALLY).where(TALLY.c.recording_id == number))
    for episodes in (VALUE.c.episode_id, EPISODE.c.id):
        connection.execute(delete(episodes.table).where(episodes_of(number, episodes)))
    connection.execute(delete(RECORDING).where(RECORDING.c.id == number))


_OF_RECORDING: Final = (RECORDING.c.uuid, RECORDING.c.benchmark_id, RECORDING.c.path)
_EVERYTHING: Final = Narrowed(true(), exact=True)


def _bound(filter: BaseFilter | None) -> BaseFilter | None:
    return None if filter is None else merged(bound(filter, EpisodeHeader))


def _narrowed(
    connection: Connection, filter: BaseFilter | None, only: ColumnElement[bool] | None
) -> Narrowed:
    found = _EVERYTHING if filter is None else narrowed(filter, _indexed(connection))
    return found if only is None else found._replace(condition=and_(found.condition, only))


def _query(filter: BaseFilter | None, found: Narrowed, *columns: Any) -> Select[Any]:
    of = of_one_recording() if filter is not None else in_order()
    return select(*columns).select_from(EPISODE.join(RECORDING, of)).where(found.condition)


def _headers(
    connection: Connection,
    filter: BaseFilter | None,
    found: Narrowed,
    order: Sequence[Place],
    limit: int | None,
    offset: int,
) -> Iterator[EpisodeHeader]:
    """The episodes that match a filter; `limit` and `offset` count those that SQL finds.

    Raises:
        FilterError: the connection has the option `tupli_deadline`, and that has passed.
    """
    by = [value.desc() if descending else value for value, descending in order]
    query = _query(filter, found, *_COLUMNS, *_OF_RECORDING).order_by(*by)
    if limit is None:
        rows = connection.execute(
            query.offset(offset or None), execution_options={"yield_per": _ROWS_OF_ANSWER}
        )
    else:  # first which ones they are: a database puts ids in order quicker than whole rows
        few = _query(filter, found, EPISODE.c.id).order_by(*by).limit(limit).offset(offset or None)
        rows = connection.execute(query.where(EPISODE.c.id.in_(few)))
    matches = None if filter is None or found.exact else bound_predicate(filter)
    width = len(_COLUMNS)
    deadline = connection.get_execution_options().get("tupli_deadline", math.inf)
    runs: dict[int, list[dict[str, Any]]] = {}
    with contextlib.closing(rows):
        for page in rows.partitions(_ROWS_OF_ANSWER):
            if time.monotonic() > deadline:
                raise FilterError("this takes too long; narrow the filter, or declare the keys in it")
            stored = [StoredRow(*row[:width]) for row in page]
            _add_runs(connection, runs, {row.recording_id for row in stored})
            for row, (*_, uuid, benchmark_id, path) in zip(stored, page, strict=True):
                made = header(row, uuid, benchmark_id, path, runs[row.recording_id][row.run])
                if matches is None or matches(made):
                    yield made


def _add_runs(
    connection: Connection, known: dict[int, list[dict[str, Any]]], recordings: Collection[int]
) -> None:
    """Adds the runs that the episodes of recordings are of, by their places."""
    missing = [number for number in recordings if number not in known]
    if missing:
        found = select(RECORDING.c.id, RECORDING.c.runs).where(RECORDING.c.id.in_(missing))
        known.update((number, jsonvalue.loads(runs)) for number, runs in connection.execute(found))


def _indexed(connection: Connection) -> dict[tuple[str, ...], int]:
    """The paths of declared keys whose values are in `VALUE`, with their numbers there."""
    declared = connection.execute(select(DECLARED.c.key, DECLARED.c.number)).all()
    paths = {path_in(unescape_text(key), EpisodeHeader): number for key, number in declared}
    return {path: number for path, number in paths.items() if is_indexed(path)}


def _index(connection: Connection, rows: Sequence[StoredRow], indexed: Mapping[tuple[str, ...], int]) -> None:
    """Puts what rows hold at declared keys into `VALUE`."""
    values = []
    for row in rows if indexed else ():
        metadata = load_metadata(row.metadata)
        for path, number in indexed.items():
            value = indexed_value(row, metadata, path)
            if value is not None:
                values.append((row.id, number, *value))
    if values:
        insert_all(connection, VALUE, ("episode_id", "key", "number", "text"), values)


def _add_recording(
    connection: Connection, relpath: str, stamp: RecordingStamp, uuid: str, benchmark_id: str, runs: str
) -> int:
    """Adds a recording without episodes, in place of what was known of it; returns its id."""
    remove_recording(connection, relpath)
    values = {
        "path": escape_text(relpath),
        "uuid": uuid,
        "benchmark_id": escape_text(benchmark_id),
        "environment": escape_text(_environment(runs)),
        "runs": runs,
    }
    added = connection.execute(insert(RECORDING).values(**values, **stamp._asdict()))
    (number,) = added.inserted_primary_key or (0,)
    return int(number)


def _environment(runs: str) -> str:
    """The environment that the first of some runs names; a recording without episodes has none."""
    first: dict[str, Any] = next(iter(jsonvalue.loads(runs)), {})
    named = first.get("environment", "")
    return named if isinstance(named, str) else ""


def insert_all(
    connection: Connection, table: Table, fields: Sequence[str], rows: Sequence[tuple[Any, ...]]
) -> None:
    """Inserts rows as the driver takes them: SQLAlchemy would prepare each value of each row."""
    if connection.dialect.name == "postgresql":
        _copy(connection, table, fields, rows)
        return
    compiled = insert(table).compile(dialect=connection.dialect, column_keys=fields)
    connection.exec_driver_sql(str(compiled), list(rows))


def _copy(
    connection: Connection, table: Table, fields: Sequence[str], rows: Sequence[tuple[Any, ...]]
) -> None:
    """Inserts rows by PostgreSQL's COPY, of which SQLAlchemy knows nothing."""
    named = connection.dialect.identifier_preparer.quote
    statement = f"COPY {named(table.name)} ({', '.join(map(named, fields))}) FROM STDIN"
    driver: Any = connection.connection.dbapi_connection
    kinds = connection.dialect.loaded_dbapi.Error
    try:
        with driver.cursor() as cursor, cursor.copy(statement) as copy:
            for row in rows:
                copy.write_row(row)
    except kinds as err:
        raise DBAPIError.instance(statement, None, err, kinds, dialect=connection.dialect) from err
