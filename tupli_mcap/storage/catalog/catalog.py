"""The catalog: an index of episodes in SQLite, which can always be rebuilt from the recordings."""

from __future__ import annotations

import contextlib
import itertools
import weakref
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Connection, Select, delete, func, insert, select

from tupli_mcap.errors import FilterError
from tupli_mcap.schema import BaseFilter, EpisodeHeader, filter_keys, split_key
from tupli_mcap.schema.facts import check_key
from tupli_mcap.storage.catalog.database import (
    CatalogDamagedError,
    CatalogMovedError,
    CatalogUnusableError,
    Database,
    MemoryDatabase,
)
from tupli_mcap.storage.catalog.rows import EpisodeRow, StoredRow, header, store_row
from tupli_mcap.storage.catalog.sql import compile_filter
from tupli_mcap.storage.catalog.sqlite import SqliteDialect, is_searchable, key_statements
from tupli_mcap.storage.catalog.tables import (
    DECLARED,
    EPISODE,
    EPISODE_BITS,
    RECORDING,
    in_order,
    of_one_recording,
)
from tupli_mcap.storage.common import escape_text, unescape_text
from tupli_mcap.storage.scan import RecordingStamp

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
        """Held by who brings the catalog up to date: what another one read a moment ago must not replace what is newer.

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
    ) -> None:
        """Catalogue a recording, in place of what was known of it; all of it or nothing.

        `rows` is consumed a chunk at a time while the catalog is locked for other writers.

        Raises:
            FormatError: A row's metadata is no strict JSON object.
            StorageError: Two rows have one episode number, or SQLite refuses.
        """
        remaining = iter(rows)
        first = list(itertools.islice(remaining, _ROWS_AT_ONCE))  # read before the lock is taken
        with self._write() as connection:
            number = _add_recording(connection, relpath, stamp, uuid, benchmark_id)
            chunk = first
            while chunk:
                connection.exec_driver_sql(_INSERT, [store_row(number, row) for row in chunk])
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
            FilterError: The filter names an unknown top-level key, or has too many values.
        """
        columns = [EPISODE.c[name] for name in StoredRow._fields]
        with self._read() as connection:
            # Given the bare path to sort by, SQLite may walk all episodes in order for the few that match.
            path = RECORDING.c.path if filter is None else func.coalesce(RECORDING.c.path, "")
            query = self._query(connection, filter, *columns, *_OF_RECORDING).order_by(path, EPISODE.c.id)
            if limit is not None or offset:
                query = query.limit(-1 if limit is None else limit).offset(offset)
            width = len(columns)
            return [header(StoredRow(*row[:width]), *row[width:]) for row in connection.execute(query)]

    def count(self, filter: BaseFilter | None = None) -> int:
        """How many episodes a filter is true of. Raises as `episodes` does."""
        with self._read() as connection:
            return int(connection.execute(self._query(connection, filter, func.count())).scalar_one())

    def explain(self, filter: BaseFilter | None) -> str:
        """The SQL of a filter, its parameters, and SQLite's plan for it."""
        with self._read() as connection:
            compiled = self._query(connection, filter, EPISODE.c.id).compile(
                connection, compile_kwargs={"render_postcompile": True}
            )
            values = tuple(compiled.params[name] for name in compiled.positiontup or ())
            plan = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {compiled}", values)
            steps = [f"  {row.detail}" for row in plan]
        return "\n".join([str(compiled), f"parameters: {values!r}", "plan:", *steps])

    def declare_key(self, key: str) -> None:
        """Index a key, so that filters on it find few episodes among many; declaring it twice is fine.

        Raises:
            FilterError: There is no such top-level key, or SQLite cannot index it.
        """
        name, *inside = split_key(key)
        check_key(key, (name,), filter_keys(EpisodeHeader))
        if name == "metadata" and not (inside and is_searchable(tuple(inside))):
            raise FilterError(
                f"key {key!r} cannot be declared: its names need to be printable ASCII without quotes, "
                "backslashes and a leading $ (it can be filtered on)"
            )
        with self._write() as connection:
            if connection.execute(select(DECLARED).where(DECLARED.c.key == key)).first():
                return
            top = connection.execute(select(func.max(DECLARED.c.number))).scalar()
            number = 0 if top is None else top + 1
            connection.execute(insert(DECLARED).values(key=key, number=number))
            for statement in key_statements(key, number):
                connection.exec_driver_sql(statement)

    def declared_keys(self) -> list[str]:
        """The declared keys, in the order of their declaration."""
        with self._read() as connection:
            return list(connection.execute(select(DECLARED.c.key).order_by(DECLARED.c.number)).scalars())

    def _query(self, connection: Connection, filter: BaseFilter | None, *columns: Any) -> Select[Any]:
        query: Select[Any] = select(*columns)
        if filter is None:
            return query.select_from(EPISODE.join(RECORDING, in_order()))
        rows = connection.execute(select(DECLARED.c.key, DECLARED.c.number)).all()
        declared = {path[1:]: number for key, number in rows if (path := split_key(key))[0] == "metadata"}
        condition = compile_filter(filter, SqliteDialect(declared))
        return query.select_from(EPISODE.join(RECORDING, of_one_recording())).where(condition)

    @contextlib.contextmanager
    def _read(self) -> Iterator[Connection]:
        with self._database.transaction() as connection:
            yield connection

    @contextlib.contextmanager
    def _write(self) -> Iterator[Connection]:
        with self._database.transaction(write=True) as connection:
            yield connection


_OF_RECORDING: Final = (RECORDING.c.uuid, RECORDING.c.benchmark_id, RECORDING.c.path)


def _add_recording(
    connection: Connection, relpath: str, stamp: RecordingStamp, uuid: str, benchmark_id: str
) -> int:
    """Adds a recording without episodes, in place of what was known of it; returns its id."""
    _remove_recording(connection, relpath)
    values = {"path": escape_text(relpath), "uuid": uuid, "benchmark_id": escape_text(benchmark_id)}
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
    connection.execute(
        delete(EPISODE).where(EPISODE.c.id >= first, EPISODE.c.id < first + (1 << EPISODE_BITS))
    )
    connection.execute(delete(RECORDING).where(RECORDING.c.id == number))
