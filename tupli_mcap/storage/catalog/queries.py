"""Changes and queries of the tables of a catalog, each within a transaction of the caller.

The tables may be in any SQL database: in the catalog of a directory, or in that of a server.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import sys
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from sqlalchemy import (
    Connection,
    CursorResult,
    FromClause,
    Select,
    Table,
    and_,
    delete,
    false,
    func,
    insert,
    not_,
    or_,
    select,
    true,
    update,
)
from sqlalchemy.exc import DBAPIError

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FilterError
from tupli_mcap.schema import BaseFilter, EpisodeHeader, bound
from tupli_mcap.schema.facts import comparisons, path_in
from tupli_mcap.schema.filters import path_of
from tupli_mcap.schema.predicate import bound_predicate
from tupli_mcap.storage.catalog.compare_sql import Condition, Narrowed
from tupli_mcap.storage.catalog.entries import Entry
from tupli_mcap.storage.catalog.filter_sql import merged, narrowed
from tupli_mcap.storage.catalog.metadata_sql import among
from tupli_mcap.storage.catalog.order import After, Sort
from tupli_mcap.storage.catalog.pages import Asked, Told, candidates
from tupli_mcap.storage.catalog.rows import (
    StoredRow,
    flag_bits,
    header,
    indexed_values,
    is_indexed,
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
from tupli_mcap.storage.texts import escape_text, unescape_text

ROWS_AT_ONCE: Final = 20_000
"""How many rows of episodes are in memory while they are written."""
_MOST_NEAR: Final = 200  # episodes of a page, and those before it
_GROWTH: Final = 8  # how many times as many episodes are looked at next, where none has matched
_MARGIN: Final = 1.5  # how many times as many are looked at as are likely to have the missing ones
_MOST_AT_ONCE: Final = 4_000
_ROWS_OF_ANSWER: Final = 500
_STREAMED: Final = {"yield_per": _ROWS_OF_ANSWER}
_COLUMNS: Final = tuple(EPISODE.c[name] for name in StoredRow._fields)


def put_recording(connection: Connection, relpath: str, entry: Entry) -> None:
    """Adds a recording, or replaces its entry. FormatError if a row's metadata is not a strict JSON object."""
    remove_recording(connection, relpath)
    values = {
        "path": escape_text(relpath),
        "uuid": entry.uuid,
        "benchmark_id": escape_text(entry.benchmark_id),
        "environment": escape_text(_environment(entry.runs)),
        "runs": entry.runs,
    }
    added = connection.execute(insert(RECORDING).values(**values, **entry.stamp._asdict()))
    number = int((added.inserted_primary_key or (0,))[0])
    indexed = _indexed(connection)
    remaining = iter(entry.rows)
    while chunk := [store_row(number, row) for row in itertools.islice(remaining, ROWS_AT_ONCE)]:
        insert_all(connection, EPISODE, StoredRow._fields, chunk)
        if indexed:
            _insert_values(connection, [value for row in chunk for value in indexed_values(row, indexed)])
    tally(connection, number)


def find_episodes(
    connection: Connection,
    filter: BaseFilter | str | None,
    *,
    limit: int | None = None,
    offset: int = 0,
    after: After | None = None,
    only: Condition | None = None,
    of: Condition | None = None,
    sort: Sort | None = None,
    backwards: bool = False,
    told: Told | None = None,
) -> Iterator[EpisodeHeader]:
    """The episodes that match a filter, by default ordered by recording (path) and episode number.

    after: where to continue. only, of: further conditions, on rows of EPISODE and RECORDING, and on rows of RECORDING
    alone, which skips the episodes of other recordings.
    backwards: in the opposite order; `after` is then the episode before which they lie.
    told: names the groups that a comparison with `published_in` sees; by default, it sees all.

    Raises:
        FilterError: The filter names an unknown top-level key, or compares a fact with what it can never be; or
            the key to sort by is unknown.
        NotFoundError: The episode to go on after is gone.
    """
    asked = _asked(connection, filter, only, of, told, sort, after, backwards)
    if limit is None:
        return _all_of_them(connection, asked, None, offset)
    wanted = offset + limit
    in_file_order = filter is None and asked.sort is None
    if wanted <= (ROWS_AT_ONCE if in_file_order else _MOST_NEAR):
        for ids, left in candidates(connection, asked, wanted):
            if in_file_order:
                return _looked_at(connection, asked, itertools.islice(ids, offset, None), wanted)
            found = list(itertools.islice(_looked_at(connection, asked, ids, wanted), wanted))
            if len(found) == wanted or left.most > 0:
                return iter(found[offset:])
    return _all_of_them(connection, asked, limit, offset)


def count_episodes(
    connection: Connection,
    filter: BaseFilter | str | None,
    *,
    only: Condition | None = None,
    of: Condition | None = None,
    told: Told | None = None,
    most: int | None = None,
) -> int:
    """How many episodes match a filter, see `find_episodes`, counted up to `most`."""
    asked = _asked(connection, filter, only, of, told)
    found = _narrowed(asked)
    unsure = or_(false(), *found.unsure)
    sure = _query(asked, found, EPISODE.c.id).where(not_(unsure)).limit(most).subquery()
    count = int(connection.execute(select(func.count()).select_from(sure)).scalar_one())
    if not found.unsure or count == most:
        return count
    others = _query(asked, found, *_COLUMNS, *_OF_RECORDING).where(unsure)
    rows = connection.execute(others, execution_options=_STREAMED)
    left = None if most is None else most - count
    return count + sum(1 for _ in itertools.islice(_in_pages(connection, asked, found, rows), left))


def plan_of(connection: Connection, filter: BaseFilter | str | None) -> str:
    """The SQL of a filter, its parameters, the database's plan for it, and whether Python checks the rows that it
    finds."""
    asked = _asked(connection, filter, None, None)
    found = _narrowed(asked)
    compiled = _query(asked, found, EPISODE.c.id).compile(
        connection, compile_kwargs={"render_postcompile": True}
    )
    values: Any = compiled.params
    if compiled.positional:
        values = tuple(compiled.params[name] for name in compiled.positiontup or ())
    explain = "EXPLAIN QUERY PLAN" if connection.dialect.name == "sqlite" else "EXPLAIN"
    steps = [f"  {row[-1]}" for row in connection.exec_driver_sql(f"{explain} {compiled}", values)]
    last = ["then each episode that was found is compared exactly"] if found.unsure else []
    return "\n".join([str(compiled), f"parameters: {values!r}", "plan:", *steps, *last])


def declare_key(connection: Connection, key: str) -> None:
    """Indexes a key, so that filters on it find few episodes among many; declaring it twice is fine.
    FilterError as `path_to_declare` raises it."""
    path = path_to_declare(key)
    if connection.execute(select(DECLARED).where(DECLARED.c.key == escape_text(key))).first():
        return
    number = connection.execute(select(func.count()).select_from(DECLARED)).scalar_one()
    connection.execute(insert(DECLARED).values(key=escape_text(key), number=number))
    if is_indexed(path):
        indexed = _indexed(connection)
        all_rows = select(*_COLUMNS).order_by(EPISODE.c.id)
        for chunk in connection.execute(all_rows, execution_options={"yield_per": ROWS_AT_ONCE}).partitions():
            _index_anew(connection, [StoredRow(*row) for row in chunk], indexed, number)


def path_to_declare(key: str) -> tuple[str, ...]:
    """The path of a key that can be declared. FilterError if there is no such top-level key, or it is that of all
    metadata."""
    path = path_in(key, EpisodeHeader)
    if path == ("metadata",):
        raise FilterError(f"key {key!r} cannot be declared: name one in it, such as metadata.score")
    return path


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


def _asked(
    connection: Connection,
    filter: BaseFilter | str | None,
    only: Condition | None,
    of: Condition | None,
    told: Told | None = None,
    sort: Sort | None = None,
    after: After | None = None,
    backwards: bool = False,
) -> Asked:
    meant = None if filter is None else merged(bound(filter, EpisodeHeader))
    if meant is None or all(path_of(each)[0] != "published_in" for each in comparisons(meant)):
        told = None
    indexed = {} if filter is None and sort is None else _indexed(connection)
    only, of = (true() if condition is None else condition for condition in (only, of))
    return Asked(meant, indexed, only, of, sort, after, backwards, told)


def _narrowed(asked: Asked) -> Narrowed:
    """The condition on rows of EPISODE and RECORDING."""
    also = and_(asked.only, asked.recordings())
    if asked.filter is None:
        return Narrowed(also)
    found = narrowed(asked.filter, asked.indexed)
    return found._replace(may=and_(found.may, also))


def _query(asked: Asked, found: Narrowed, *columns: Any, rows: FromClause | None = None) -> Select[Any]:
    """rows: EPISODE and RECORDING, and maybe more."""
    query = select(*columns).where(found.may)
    if found.ids is None:
        both = EPISODE.join(RECORDING, of_one_recording() if asked.filter is not None else in_order())
        return query.select_from(both if rows is None else rows)
    ids = found.ids.limit(sys.maxsize).subquery()  # the limit makes a database begin with them
    row_id, recording_id = ids.c
    if rows is None:
        joined = ids.join(RECORDING, RECORDING.c.id == recording_id)
        return query.select_from(joined.join(EPISODE, EPISODE.c.id == row_id))
    return query.select_from(rows.join(ids, and_(row_id == EPISODE.c.id, recording_id == RECORDING.c.id)))


def _looked_at(
    connection: Connection, asked: Asked, ids: Iterable[int], wanted: int
) -> Iterator[EpisodeHeader]:
    """The matching episodes among those with some ids, in the same order. Looks at as many as are wanted first, then
    at as many as are likely to have the missing ones."""
    of_them = select(*_COLUMNS, *_OF_RECORDING).join(RECORDING, RECORDING.c.id == EPISODE.c.recording_id)
    of_them = of_them.where(asked.meets(), asked.recordings())
    ids = iter(ids)
    size, looked_at, found = wanted, 0, 0
    while some := list(itertools.islice(ids, size)):
        rows = connection.execute(of_them.where(among(EPISODE.c.id, some)))
        known = {row.id: row for row in rows}
        ordered = [known[number] for number in some if number in known]
        for each in _headers(connection, asked, asked.each, ordered):
            found += 1
            yield each
        looked_at += len(some)
        if 0 < found < wanted:
            size = math.ceil(_MARGIN * (wanted - found) * looked_at / found)
        else:
            size *= _GROWTH
        size = min(size, _MOST_AT_ONCE)


def _all_of_them(
    connection: Connection, asked: Asked, limit: int | None, offset: int
) -> Iterator[EpisodeHeader]:
    """The matching episodes, all found by one statement for each range of the order."""
    found, parts = _narrowed(asked), asked.order(connection, few=asked.filter is not None)
    skipped = offset if not found.unsure and len(parts) == 1 else 0  # by the database
    first, last = offset - skipped, None if limit is None else min(offset - skipped + limit, sys.maxsize)

    def queries(*columns: Any) -> Iterator[Select[Any]]:
        for part in parts:
            of = None if asked.sort is None else part.rows
            query = _query(asked, found, *columns, rows=of).where(part.having).order_by(*part.order)
            yield query.limit(None if found.unsure else last).offset(skipped or None)

    if limit is not None and not found.unsure:  # a database puts ids in order quicker than whole rows
        each = (connection.execute(query).scalars() for query in queries(EPISODE.c.id))
        ids = itertools.islice(itertools.chain.from_iterable(each), first, last)
        return _looked_at(connection, asked, ids, _ROWS_OF_ANSWER)
    rows = (
        connection.execute(query, execution_options=_STREAMED) for query in queries(*_COLUMNS, *_OF_RECORDING)
    )
    headers = (_in_pages(connection, asked, found, each) for each in rows)
    return itertools.islice(itertools.chain.from_iterable(headers), first, last)


def _in_pages(
    connection: Connection, asked: Asked, found: Narrowed, rows: CursorResult[Any]
) -> Iterator[EpisodeHeader]:
    with contextlib.closing(rows):
        for page in rows.partitions(_ROWS_OF_ANSWER):
            yield from _headers(connection, asked, found, page)


def _headers(
    connection: Connection, asked: Asked, found: Narrowed, rows: Iterable[Any]
) -> Iterator[EpisodeHeader]:
    """The episodes of rows, of `_COLUMNS` and `_OF_RECORDING`, that match.
    FilterError if the connection has the option `tupli_deadline`, and that has passed."""
    if time.monotonic() > connection.get_execution_options().get("tupli_deadline", math.inf):
        raise FilterError("this takes too long; narrow the filter, or declare the keys of filter and order")
    matches = None if asked.filter is None or not found.unsure else bound_predicate(asked.filter)
    width, rows = len(_COLUMNS), list(rows)
    runs = _runs(connection, {row.recording_id for row in rows})

    def made(row: Any) -> EpisodeHeader:
        stored, (uuid, benchmark_id, path) = StoredRow(*row[:width]), row[width:]
        return header(stored, uuid, benchmark_id, path, runs[stored.recording_id][stored.run])

    if matches is None:
        yield from map(made, rows)
    elif asked.told is None:
        yield from filter(matches, map(made, rows))
    else:
        headers = [made(row) for row in rows]
        yield from itertools.compress(headers, map(matches, asked.told(headers)))


def _runs(connection: Connection, recordings: Collection[int]) -> dict[int, list[dict[str, Any]]]:
    """The runs that the episodes of recordings are of, by their places."""
    if not recordings:
        return {}
    found = select(RECORDING.c.id, RECORDING.c.runs).where(among(RECORDING.c.id, list(recordings)))
    return {number: jsonvalue.loads(runs) for number, runs in connection.execute(found)}


def _indexed(connection: Connection) -> dict[tuple[str, ...], int]:
    """The paths of declared keys whose values are in `VALUE`, with their numbers there."""
    declared = connection.execute(select(DECLARED.c.key, DECLARED.c.number)).all()
    paths = {path_in(unescape_text(key), EpisodeHeader): number for key, number in declared}
    return {path: number for path, number in paths.items() if is_indexed(path)}


def _index_anew(
    connection: Connection, rows: Sequence[StoredRow], indexed: Mapping[tuple[str, ...], int], key: int
) -> None:
    """Puts the values of rows at one more key into `VALUE`."""
    values = [value for row in rows for value in indexed_values(row, indexed) if value[1] == key]
    _insert_values(connection, values)
    both, told = flag_bits([True, False], key), dict[int, list[int]]()
    for row_id, *_, flags in values:
        if flags & both:
            told.setdefault(flags & both, []).append(row_id)
    for bits, ids in told.items():
        others = among(VALUE.c.episode_id, ids), VALUE.c.key != key
        connection.execute(update(VALUE).where(*others).values(flags=VALUE.c.flags.bitwise_or(bits)))


def _insert_values(connection: Connection, values: Sequence[tuple[Any, ...]]) -> None:
    if values:
        insert_all(connection, VALUE, ("episode_id", "key", "number", "text", "flags"), values)


def _environment(runs: str) -> str:
    """The environment that the first of some runs names; a recording without episodes has none."""
    first: dict[str, Any] = next(iter(jsonvalue.loads(runs)), {})
    named = first.get("environment", "")
    return named if isinstance(named, str) else ""


def insert_all(
    connection: Connection, table: Table, fields: Sequence[str], rows: Sequence[tuple[Any, ...]]
) -> None:
    """Inserts rows through the driver: SQLAlchemy would prepare each value of each row."""
    if connection.dialect.name == "postgresql":
        _copy(connection, table, fields, rows)
        return
    compiled = insert(table).compile(dialect=connection.dialect, column_keys=fields)
    connection.exec_driver_sql(str(compiled), list(rows))


def _copy(
    connection: Connection, table: Table, fields: Sequence[str], rows: Sequence[tuple[Any, ...]]
) -> None:
    """Inserts rows with PostgreSQL's COPY, which SQLAlchemy does not support."""
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
