"""The SQLite file of a catalog: opening, replacing, sharing it, and transactions."""

from __future__ import annotations

import contextlib
import fcntl
import os
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from sqlalchemy import URL, Connection, Engine, create_engine, event
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from sqlalchemy.schema import CreateIndex, CreateTable

from tupli_mcap.errors import FilterError, StorageError
from tupli_mcap.storage.sqlite import register_functions
from tupli_mcap.storage.tables import APPLICATION_ID, METADATA, VERSION

_BUSY_MS: Final = 30_000
_CACHE_KIB: Final = 32 * 1024  # rows come in no order of a declared key: its index has to stay in memory
_UNUSABLE: Final = (
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_PERM,
)
_DAMAGED: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_TOO_LARGE: Final = ("too many SQL variables", "Expression tree is too large", "parser stack overflow")


class CatalogDamagedError(StorageError):
    """The catalog's file is damaged; `Catalog.reset` makes an empty one, to be filled from the recordings."""


class CatalogUnusableError(StorageError):
    """The system does not let the catalog be written: the disk is full, the file is another user's, ..."""


class Database:
    """Connections to one file, for several threads and processes, and for forked children.

    The file may be replaced or deleted while it is open: the next transaction is on the new one.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._engine = _engine(path)
        self._lock = threading.Lock()
        self._process = os.getpid()
        self._identity: tuple[int, int] | None = None
        self._closed = False

    def open(self) -> None:
        """Make sure that the file is a catalog of this version; anything else is replaced by an empty one.

        Raises:
            StorageError: The file cannot be opened or written.
        """
        with self._lock, _translated(self.path):
            self._open()

    def close(self) -> None:
        """Close the connections; closing twice is fine."""
        self._closed = True
        self._engine.dispose(close=self._process == os.getpid())

    def replace(self) -> None:
        """Put an empty catalog in the file's place."""
        with self._lock, _translated(self.path), _exclusive(self.path):
            self._create()

    @contextlib.contextmanager
    def transaction(self, *, write: bool = False) -> Iterator[Connection]:
        """A transaction: committed at the end, rolled back on an exception.

        Raises:
            StorageError: SQLite refuses, or the catalog is closed.
            CatalogDamagedError: The file is damaged.
            FilterError: The statement is too large for SQLite.
        """
        with _translated(self.path):
            self._refresh()
            with self._engine.connect() as connection:
                if write:
                    connection.execution_options(tupli_write=True)
                with connection.begin():
                    yield connection

    def _refresh(self) -> None:
        if self._closed:
            raise StorageError(f"catalog {str(self.path)!r} is closed")
        with self._lock:
            if self._process != os.getpid():
                # SQLite forbids to carry a connection over a fork, and to close it in the child.
                self._engine.dispose(close=False)
                self._process = os.getpid()
            if _identity(self.path) != self._identity:
                self._engine.dispose()
                self._open()

    def _open(self) -> None:
        try:
            self._open_or_create()
        except OSError as err:
            raise CatalogUnusableError(f"catalog {str(self.path)!r} cannot be used: {err}") from err

    def _open_or_create(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not _is_catalog(self._engine, self.path):
            with _exclusive(self.path):
                if not _is_catalog(self._engine, self.path):  # else another process was first
                    self._create()
        self._identity = _identity(self.path)

    def _create(self) -> None:
        """Make an empty catalog beside the file and rename it: nobody ever opens half of one."""
        self._engine.dispose()
        new = self.path.with_name(f"{self.path.name}.new")
        _remove(new)
        engine = _engine(new)
        try:
            with engine.connect() as connection, connection.begin():
                _create_tables(connection)
            with contextlib.closing(engine.raw_connection()) as raw:
                raw.cursor().execute("PRAGMA journal_mode = WAL")
        finally:
            engine.dispose()
        _remove(self.path)
        new.replace(self.path)
        self._identity = _identity(self.path)


def _engine(path: Path) -> Engine:
    engine = create_engine(URL.create("sqlite", database=str(path)))

    @event.listens_for(engine, "connect")
    def _prepare(connection: sqlite3.Connection, _: object) -> None:
        connection.isolation_level = None  # transactions are begun below
        connection.execute(f"PRAGMA busy_timeout = {_BUSY_MS}")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.execute(f"PRAGMA cache_size = -{_CACHE_KIB}")
        register_functions(connection)

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        # A transaction that writes takes the lock at once: one that has read before cannot wait for it.
        write = connection.get_execution_options().get("tupli_write")
        connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")

    return engine


def _is_catalog(engine: Engine, path: Path) -> bool:
    """Whether the file is a catalog of this version; False too if it is missing or no database at all."""
    if not path.exists():
        return False
    try:
        with engine.connect() as connection:
            application = connection.exec_driver_sql("PRAGMA application_id").scalar_one()
            version = connection.exec_driver_sql("PRAGMA user_version").scalar_one()
            names = set(connection.exec_driver_sql("SELECT name FROM sqlite_master").scalars())
    except DBAPIError as err:
        if _is_damage(err):
            return False
        raise
    return (application, version) == (APPLICATION_ID, VERSION) and names >= set(METADATA.tables)


def _create_tables(connection: Connection) -> None:
    for table in METADATA.sorted_tables:
        connection.execute(CreateTable(table))
        for index in sorted(table.indexes, key=lambda index: str(index.name)):
            connection.execute(CreateIndex(index))
    connection.exec_driver_sql(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.exec_driver_sql(f"PRAGMA user_version = {VERSION}")


def _remove(path: Path) -> None:
    """Delete a database and what SQLite keeps beside it (which would be taken for the next one's)."""
    for suffix in ("-wal", "-shm", "-journal", ""):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


@contextlib.contextmanager
def _exclusive(path: Path) -> Iterator[None]:
    """Hold the lock of those who create or replace the file."""
    with path.with_name(f"{path.name}.lock").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextlib.contextmanager
def _translated(path: Path) -> Iterator[None]:
    """Errors of SQLite and the system as those of this package."""
    try:
        yield
    except DBAPIError as err:
        if _is_damage(err):
            raise CatalogDamagedError(
                f"catalog {str(path)!r} is damaged ({err.orig}); delete it, it is rebuilt from the recordings"
            ) from err
        if any(reason in str(err.orig) for reason in _TOO_LARGE):
            raise FilterError(f"the filter has too many values or parts for SQLite ({err.orig})") from err
        kind = CatalogUnusableError if _has_code(err, _UNUSABLE) else StorageError
        raise kind(f"catalog {str(path)!r} cannot be used: {err.orig}") from err
    except SQLAlchemyError as err:
        raise StorageError(f"catalog {str(path)!r} cannot be used: {err}") from err


def _is_damage(err: DBAPIError) -> bool:
    return _has_code(err, _DAMAGED)


def _has_code(err: DBAPIError, codes: Sequence[int]) -> bool:
    code = getattr(err.orig, "sqlite_errorcode", None)
    return code is not None and code & 0xFF in codes
