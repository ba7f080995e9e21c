"""The catalog: an index of episodes in SQLite, which can always be rebuilt from the recordings."""

from __future__ import annotations

import contextlib
import itertools
import sys
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Connection, Select, and_, delete, func, insert, select, true

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FilterError
from tupli_mcap.schema import BaseFilter, EpisodeHeader, bound
from tupli_mcap.schema.facts import path_in
from tupli_mcap.schema.predicate import bound_predicate
from tupli_mcap.storage.catalog.database import (
    CatalogDamagedError,
    CatalogMovedError,
    CatalogUnusableError,
    Database,
    MemoryDatabase,
)
from tupli_mcap.storage.catalog.filter_sql import Narrowed, merged, narrowed
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
    EPISODE_BITS,
    RECORDING,
    VALUE,
    in_order,
    of_one_recording,
)
from tupli_mcap.storage.listing import RecordingStamp
from tupli_mcap.storage.texts import escape_text, unescape_text

__all__ = [
    "Catalog",
    "CatalogDamagedError",
    "CatalogMovedError",
    "CatalogUnusableError",
    "EpisodeRow",
    "RecordingStamp",
]

_ROWS_AT_ONCE: Final = 20_000
_FIELDS: Final = ", ".join(f'"{name}"' for name in StoredRow._fields)
_PLACES: Final = ", ".join("?" * len(StoredRow._fields))
_INSERT: Final = f"INSERT INTO {EPISODE.name} ({_FIELDS}) VALUES ({_PLACES})"
_INSERT_VALUE: Final = f"INSERT INTO {VALUE.name} (episode_id, key, number, text) VALUES (?, ?, ?, ?)"
_COLUMNS: Final = tuple(EPISODE.c[name] for name in StoredRow._fields)


class Catalog:
    """The episodes of a storage's recordings, to be filtered without opening a file.

    Safe to use from several threads and several processes at once; usable in a forked child. What SQLite
    refuses is a StorageError.
    """

    def __init__(self, path: Path | None) -> None:
        """Open or create the catalog at `path`; None is one in memory, gone when it is closed.

        A file that is no catalog, one of another version, or one that somebody else could write, is replaced by an
        empty catalog.

        Raises:
            StorageError: The file cannot be opened or written.
        """
        self.path = path
        self._database = MemoryDatabase() if path is None else Database(path)
        self._finalizer = weakref.finalize(self, self._database.close)
        try:
            self._database.open()
        except BaseException:
            self.close()
            raise

    @property
    def identity(self) -> int:
        """Tells the file of the last transaction from others that were at its path."""
        return self._database.identity

    def is_current(self) -> bool:
        """Whether nobody has replaced or deleted the file of the last transaction."""
        return self._database.is_current()

    def alone(self) -> AbstractContextManager[None]:
        """The lock to hold while the catalog is brought up to date, so that nothing older replaces what is newer.

        Raises:
            CatalogUnusableError: The lock cannot be taken.
        """
        return self._database.alone()

    def close(self) -> None:
        """Release the file; closing twice is fine."""
        self._finalizer()

    def __enter__(self) -> Catalog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def reset(self) -> None:
        """Empty the catalog, even a damaged one; declared keys are forgotten too."""
        self._database.replace()

    def recordings(self) -> dict[str, RecordingStamp]:
        """The catalogued recordings: path relative to the storage, and what their files looked like."""
        columns = (RECORDING.c.path, *(RECORDING.c[name] for name in RecordingStamp._fields))
        with self._read() as connection:
            rows = connection.execute(select(*columns).order_by(RECORDING.c.path))
            return {unescape_text(path): RecordingStamp(*stamp) for path, *stamp in rows}

    def copies(self, relpath: str, uuid: str) -> bool:
        """Whether another recording of the same UUID is catalogued."""
        same = select(RECORDING.c.id).where(
            RECORDING.c.uuid == uuid, RECORDING.c.path != escape_text(relpath)
        )
        with self._read() as connection:
            return connection.execute(same.limit(1)).first() is not None

    def put_recording(
        self,
        relpath: str,
        stamp: RecordingStamp,
        *,
        uuid: str,
        benchmark_id: str,
        rows: Iterable[EpisodeRow],
        runs: str = "[{}]",
    ) -> None:
        """Catalogue a recording, in place of what was known of it; all of it or nothing.

        `runs` is JSON: a list of those that its episodes are of. `rows` is consumed a chunk at a time while the catalog
        is locked for other writers.

        Raises:
            FormatError: A row's metadata is no strict JSON object.
            StorageError: Two rows have one episode number, or SQLite refuses.
        """
        remaining = iter(rows)
        first = list(itertools.islice(remaining, _ROWS_AT_ONCE))  # read before the lock is taken
        with self._write() as connection:
            number, indexed = (
                _add_recording(connection, relpath, stamp, uuid, benchmark_id, runs),
                _indexed(connection),
            )
            chunk = first
            while chunk:
                stored = [store_row(number, row) for row in chunk]
                connection.exec_driver_sql(_INSERT, stored)
                _index(connection, stored, indexed)
                chunk = list(itertools.islice(remaining, _ROWS_AT_ONCE))

    def remove_recording(self, relpath: str) -> None:
        """Forget a recording and its episodes; nothing happens if it is not catalogued."""
        with self._write() as connection:
            _remove_recording(connection, relpath)

    def episodes(
        self, filter: BaseFilter | None = None, *, limit: int | None = None, offset: int = 0
    ) -> list[EpisodeHeader]:
        """The episodes that a filter is true of, ordered by recording (path) and episode number.

        Raises:
            FilterError: The filter names an unknown top-level key, or compares a fact with what it can never be.
        """
        meant = _bound(filter)
        with self._read() as connection:
            found = _narrowed(connection, meant)
            if found.exact:
                return list(_headers(connection, meant, found, limit, offset))
            headers = _headers(connection, meant, found, None, 0)
            stop = None if limit is None else min(offset + limit, sys.maxsize)
            return list(itertools.islice(headers, offset, stop))

    def count(self, filter: BaseFilter | None = None) -> int:
        """How many episodes a filter is true of. Raises as `episodes` does."""
        meant = _bound(filter)
        with self._read() as connection:
            found = _narrowed(connection, meant)
            if found.exact:
                return int(connection.execute(_query(meant, found, func.count())).scalar_one())
            return sum(1 for _ in _headers(connection, meant, found, None, 0))

    def explain(self, filter: BaseFilter | None) -> str:
        """The SQL of a filter, its parameters, SQLite's plan for it, and whether Python looks at what that finds."""
        meant = _bound(filter)
        with self._read() as connection:
            found = _narrowed(connection, meant)
            compiled = _query(meant, found, EPISODE.c.id).compile(
                connection, compile_kwargs={"render_postcompile": True}
            )
            values = tuple(compiled.params[name] for name in compiled.positiontup or ())
            plan = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {compiled}", values)
            steps = [f"  {row.detail}" for row in plan]
        last = [] if found.exact else ["then each episode that was found is compared exactly"]
        return "\n".join([str(compiled), f"parameters: {values!r}", "plan:", *steps, *last])

    def declare_key(self, key: str) -> None:
        """Index a key, so that filters on it find few episodes among many; declaring it twice is fine.

        Raises:
            FilterError: There is no such top-level key, or it is that of all metadata.
        """
        path = path_in(key, EpisodeHeader)
        if path == ("metadata",):
            raise FilterError(f"key {key!r} cannot be declared: name one in it, such as metadata.score")
        with self._write() as connection:
            if connection.execute(select(DECLARED).where(DECLARED.c.key == escape_text(key))).first():
                return
            number = connection.execute(select(func.count()).select_from(DECLARED)).scalar_one()
            connection.execute(insert(DECLARED).values(key=escape_text(key), number=number))
            if is_indexed(path):
                rows = connection.execute(select(*_COLUMNS).order_by(EPISODE.c.id))
                for chunk in rows.partitions(_ROWS_AT_ONCE):
                    _index(connection, [StoredRow(*row) for row in chunk], {path: number})

    def declared_keys(self) -> list[str]:
        """The declared keys, in the order of their declaration."""
        with self._read() as connection:
            keys = connection.execute(select(DECLARED.c.key).order_by(DECLARED.c.number)).scalars()
            return [unescape_text(key) for key in keys]

    @contextlib.contextmanager
    def _read(self) -> Iterator[Connection]:
        with self._database.transaction() as connection:
            yield connection

    @contextlib.contextmanager
    def _write(self) -> Iterator[Connection]:
        with self._database.transaction(write=True) as connection:
            yield connection


_OF_RECORDING: Final = (RECORDING.c.uuid, RECORDING.c.benchmark_id, RECORDING.c.path)
_EVERYTHING: Final = Narrowed(true(), exact=True)


def _bound(filter: BaseFilter | None) -> BaseFilter | None:
    return None if filter is None else merged(bound(filter, EpisodeHeader))


def _narrowed(connection: Connection, filter: BaseFilter | None) -> Narrowed:
    return _EVERYTHING if filter is None else narrowed(filter, _indexed(connection))


def _query(filter: BaseFilter | None, found: Narrowed, *columns: Any) -> Select[Any]:
    of = of_one_recording() if filter is not None else in_order()
    return select(*columns).select_from(EPISODE.join(RECORDING, of)).where(found.condition)


def _headers(
    connection: Connection, filter: BaseFilter | None, found: Narrowed, limit: int | None, offset: int
) -> Iterator[EpisodeHeader]:
    """The episodes that a filter is true of; `limit` and `offset` count those that SQL finds."""
    # Given the bare path to sort by, SQLite may walk all episodes in order for the few that match.
    path = RECORDING.c.path if filter is None else func.coalesce(RECORDING.c.path, "")
    query = _query(filter, found, *_COLUMNS, *_OF_RECORDING).order_by(path, EPISODE.c.id)
    rows = connection.execute(query.limit(limit).offset(offset or None))
    matches = None if filter is None or found.exact else bound_predicate(filter)
    width = len(_COLUMNS)
    runs: dict[int, list[dict[str, Any]]] = {}
    for row in rows:
        stored = StoredRow(*row[:width])
        if stored.recording_id not in runs:
            runs[stored.recording_id] = _runs_of(connection, stored.recording_id)
        uuid, benchmark_id, path = row[width:]
        made = header(stored, uuid, benchmark_id, path, runs[stored.recording_id][stored.run])
        if matches is None or matches(made):
            yield made


def _runs_of(connection: Connection, recording_id: int) -> list[dict[str, Any]]:
    """The runs that a recording's episodes are of, by their places."""
    found: list[dict[str, Any]] = jsonvalue.loads(
        connection.execute(select(RECORDING.c.runs).where(RECORDING.c.id == recording_id)).scalar_one()
    )
    return found


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
        connection.exec_driver_sql(_INSERT_VALUE, values)


def _add_recording(
    connection: Connection, relpath: str, stamp: RecordingStamp, uuid: str, benchmark_id: str, runs: str
) -> int:
    """Adds a recording without episodes, in place of what was known of it; returns its id."""
    _remove_recording(connection, relpath)
    values = {
        "path": escape_text(relpath), "uuid": uuid, "benchmark_id": escape_text(benchmark_id), "runs": runs
    }  # fmt: skip
    added = connection.execute(insert(RECORDING).values(**values, **stamp._asdict()))
    (number,) = added.inserted_primary_key or (0,)
    return int(number)


def _remove_recording(connection: Connection, relpath: str) -> None:
    number = connection.execute(
        select(RECORDING.c.id).where(RECORDING.c.path == escape_text(relpath))
    ).scalar()
    if number is None:
        return
    first = number << EPISODE_BITS
    for episodes in (VALUE.c.episode_id, EPISODE.c.id):
        of = and_(episodes >= first, episodes < first + (1 << EPISODE_BITS))
        connection.execute(delete(episodes.table).where(of))
    connection.execute(delete(RECORDING).where(RECORDING.c.id == number))
