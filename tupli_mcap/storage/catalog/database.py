"""The SQLite database of a catalog, a file or in memory: opening, replacing, sharing it, and transactions."""

from __future__ import annotations

import contextlib
import functools
import os
import sqlite3
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from sqlalchemy import URL, Connection, Dialect, Engine, Pool, StaticPool, create_engine, event
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from tupli_mcap.cache import make_private
from tupli_mcap.errors import StorageError, os_reason
from tupli_mcap.mcap.lock import drop_private
from tupli_mcap.storage.atomic import Lock, LockError, locked
from tupli_mcap.storage.catalog.place import is_private
from tupli_mcap.storage.catalog.tables import APPLICATION_ID, METADATA, VERSION

BUSY_MS: Final = 30_000
_ATTEMPTS: Final = 100  # to open a file that others replace
# the index of a declared key has to stay in memory: rows do not come in its order
_CACHE_KIB: Final = 32 * 1024
_UNUSABLE: Final = (
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_PERM,
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_PROTOCOL,
)
_DAMAGED: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_SCHEMA: Final = "SELECT type, name, tbl_name, sql FROM sqlite_master"


class CatalogDamagedError(StorageError):
    """The catalog's file is damaged; `Catalog.reset` makes an empty one, to be filled from the recordings."""


class CatalogMovedError(StorageError):
    """The catalog's file was deleted or replaced during a transaction; the next one uses the new file."""


class CatalogUnusableError(StorageError):
    """SQLite or the system refuses to use the catalog: the disk is full, the file stays locked, ..."""


class _Connections:
    """Connections of an engine. A forked child makes its own: SQLite forbids to carry one over a fork, and to close it
    in the child."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._process = os.getpid()
        self._inherited: list[Pool] = []  # a parent's connections
        self._opened = 0  # number of databases opened so far
        self._closed = False
        self._begin()

    def _begin(self) -> None:
        """Sets what each process begins with: nothing is open, and no thread holds a lock."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the connections; closing twice is fine."""
        self._closed = True
        self._leave_parent()
        self._engine.dispose()

    @property
    def identity(self) -> int:
        """Tells the database of the last transaction from others that were in its place."""
        return self._opened  # not the inode: a new file may get that of one that nobody has open

    def _leave_parent(self) -> None:
        if self._process != os.getpid():
            self._process = os.getpid()
            self._inherited.append(self._engine.pool)
            self._engine.dispose(close=False)
            self._begin()


class Database(_Connections):
    """Connections to one file, for several threads and processes, and for forked children.

    The file may be replaced or deleted while it is open: the next transaction uses the new one.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._alone = Lock(path.with_name(f"{path.name}.sync.lock"))
        super().__init__(_engine(path, guarded=True))

    def _begin(self) -> None:
        self._lock = threading.Lock()
        self._identity: tuple[int, int] | None = None  # the inode may be used again where no file is open

    def open(self) -> None:
        """Make sure that the file is a catalog of this version; anything else is replaced by an empty one.
        StorageError if the file cannot be opened or written."""
        with self._lock, _translated(self.path), _usable(self.path):
            self._open()

    def replace(self) -> None:
        """Put an empty catalog in the file's place."""
        with self._lock, _translated(self.path), _usable(self.path), _guard(self.path):
            self._create()

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Locks out other threads and processes that update the catalog; reentrant in a thread.
        CatalogUnusableError if the lock cannot be taken."""
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(self._alone)
            except LockError as err:
                raise CatalogUnusableError(f"catalog {str(self.path)!r} cannot be used: {err}") from err
            yield

    @contextlib.contextmanager
    def transaction(self, *, write: bool = False) -> Iterator[Connection]:
        """A transaction: committed at the end, rolled back on an exception.

        Raises:
            StorageError: SQLite refuses, or the catalog is closed.
            CatalogMovedError: The file was deleted or replaced meanwhile.
            CatalogDamagedError: The file is damaged.
        """
        with _translated(self.path):
            self._refresh()
            opened = self._identity
            try:
                with self._engine.connect() as connection:
                    if write:
                        connection.execution_options(tupli_write=True)
                    with connection.begin():
                        yield connection
            except DBAPIError as err:
                if opened is None or _identity(self.path) != opened:
                    raise CatalogMovedError(f"catalog {str(self.path)!r} was replaced meanwhile") from err
                raise

    def is_current(self) -> bool:
        """Whether the file of the last transaction still is the one at its path."""
        return self._identity is not None and self._identity == _identity(self.path)

    def _refresh(self) -> None:
        if self._closed:
            raise StorageError(f"catalog {str(self.path)!r} is closed")
        self._leave_parent()
        with self._lock, _usable(self.path):
            if self._identity is None or _identity(self.path) != self._identity:
                self._engine.dispose()
                self._open()

    def _open(self) -> None:
        make_private(self.path.parent)
        for _ in range(_ATTEMPTS):
            if not _is_catalog(self._engine, self.path):
                self._make()
            # An inode may be used again once nobody has its file open: one of our connections stays in the pool.
            identity = _identity(self.path)
            try:
                with self._engine.connect():
                    pass
            except DBAPIError:
                if identity is not None and identity == _identity(self.path):
                    raise
            if identity is not None and identity == _identity(self.path):
                self._identity = identity
                self._opened += 1
                return
            self._engine.dispose()  # it was replaced or deleted meanwhile
        raise CatalogMovedError(
            f"catalog {str(self.path)!r} was replaced during each of {_ATTEMPTS} attempts"
        )

    def _make(self) -> None:
        """Make the catalog, unless another process is first."""
        with _guard(self.path):
            engine = _engine(self.path)
            try:
                is_there = _is_catalog(engine, self.path)
            finally:
                engine.dispose()
            if not is_there:
                self._create()

    def _create(self) -> None:
        """Make an empty catalog beside the file and rename it, so that nobody opens an incomplete one."""
        self._engine.dispose()
        new = self.path.with_name(f"{self.path.name}.new")
        remove_database(new)
        os.close(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
        engine = _engine(new)
        try:
            with engine.connect() as connection, connection.begin():
                _create_tables(connection)
            with contextlib.closing(engine.raw_connection()) as raw:
                raw.cursor().execute("PRAGMA journal_mode = WAL")
            engine.dispose()
            remove_database(self.path)
            new.replace(self.path)
        except BaseException:
            engine.dispose()
            with contextlib.suppress(OSError):
                remove_database(new)
            raise
        self._identity = None  # until it is open


class MemoryDatabase(_Connections):
    """A database in the memory of this process: one connection, which threads use one after the other."""

    def __init__(self) -> None:
        options = {"poolclass": StaticPool, "connect_args": {"check_same_thread": False}}
        super().__init__(_prepared(create_engine("sqlite://", **options)))

    def _begin(self) -> None:
        self._turn = threading.RLock()
        self._is_made = False

    def open(self) -> None:
        """Does nothing: the first transaction opens it."""

    def replace(self) -> None:
        """Empty it."""
        self._leave_parent()
        with self._turn:
            self._engine.dispose()
            self._is_made = False

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """As `Database.alone`, for threads."""
        self._leave_parent()
        with self._turn:
            yield

    @contextlib.contextmanager
    def transaction(self, *, write: bool = False) -> Iterator[Connection]:
        """A transaction, as `Database.transaction`; in a forked child, the catalog is empty at first."""
        self._leave_parent()
        with self._turn, _translated(None):
            if self._closed:
                raise StorageError("the catalog is closed")
            with self._engine.connect() as connection:
                if not self._is_made:
                    with connection.begin():
                        _create_tables(connection)
                    self._is_made = True
                    self._opened += 1
                with connection.begin():
                    yield connection

    def is_current(self) -> bool:
        """Whether the database of the last transaction is still in use."""
        return self._is_made and self._process == os.getpid()


def _engine(path: Path, *, guarded: bool = False) -> Engine:
    """An engine for a file; if it is guarded, nobody replaces the file while a connection is opened."""
    # A file that is deleted meanwhile must not come back, empty, without the lock of those who make one.
    uri = f"file:{quote(str(path))}?mode=rw"
    engine = _prepared(create_engine(URL.create("sqlite", database=uri, query={"uri": "true"})))

    @event.listens_for(engine, "do_connect")
    def _connect(dialect: Dialect, _: object, args: Any, kwargs: Any) -> Any:
        with _guard(path, exclusive=False) if guarded else contextlib.nullcontext():
            connection: Any = dialect.connect(*args, **kwargs)
            try:
                # Opens SQLite's files beside this one, by name: later it might find those of a new file instead.
                connection.execute("PRAGMA schema_version").fetchone()
            except BaseException:
                connection.close()
                raise
        return connection

    return engine


def _prepared(engine: Engine) -> Engine:
    """An engine whose connections have the settings of catalogs."""
    return prepared_sqlite(engine, "synchronous = NORMAL", f"cache_size = -{_CACHE_KIB}")


def prepared_sqlite(engine: Engine, *settings: str) -> Engine:
    """An engine whose connections have these settings of SQLite, and begin transactions themselves."""

    @event.listens_for(engine, "connect")
    def _prepare(connection: sqlite3.Connection, _: object) -> None:
        connection.isolation_level = None  # transactions are begun below
        for setting in (f"busy_timeout = {BUSY_MS}", *settings):
            _set(connection, setting)

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        # A transaction that writes takes the lock at once: SQLite lets none wait for it that has read before.
        write = connection.get_execution_options().get("tupli_write")
        connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")

    return engine


def _set(connection: sqlite3.Connection, setting: str) -> None:
    """Two that change `journal_mode` at once would wait for each other; SQLite refuses one of them at once."""
    deadline = time.monotonic() + BUSY_MS / 1000
    while True:
        try:
            connection.execute(f"PRAGMA {setting}")
            return
        except sqlite3.OperationalError as err:
            if err.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or time.monotonic() > deadline:
                raise
        time.sleep(0.01)


def _is_catalog(engine: Engine, path: Path) -> bool:
    """Whether the file is a catalog of this version and nothing else; False too if it is missing.

    A file is opened only if nobody else can write it, and never with a rollback journal, which catalogs have not.
    """
    if not _is_ours(path):
        return False
    try:
        with engine.connect() as connection:
            application = connection.exec_driver_sql("PRAGMA application_id").scalar_one()
            version = connection.exec_driver_sql("PRAGMA user_version").scalar_one()
            schema = {tuple(row) for row in connection.exec_driver_sql(_SCHEMA)}
            return (application, version, schema) == (APPLICATION_ID, VERSION, _our_schema())
    except DBAPIError as err:
        if _has_code(err, _DAMAGED) or not path.exists():
            return False
        raise


def _is_ours(path: Path) -> bool:
    if os.path.lexists(path.with_name(f"{path.name}-journal")):
        return False
    beside = (path.with_name(path.name + suffix) for suffix in ("-wal", "-shm"))
    try:
        return all(is_private(file) and file.is_file() for file in (path, *filter(os.path.lexists, beside)))
    except FileNotFoundError:
        return False


@functools.cache
def _our_schema() -> set[tuple[Any, ...]]:
    engine = create_engine("sqlite://")
    try:
        with engine.connect() as connection:
            METADATA.create_all(connection)
            return {tuple(row) for row in connection.exec_driver_sql(_SCHEMA)}
    finally:
        engine.dispose()


def _create_tables(connection: Connection) -> None:
    METADATA.create_all(connection, checkfirst=False)
    connection.exec_driver_sql(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.exec_driver_sql(f"PRAGMA user_version = {VERSION}")


def remove_database(path: Path) -> None:
    """Delete a database and SQLite's files beside it, which would be taken for those of the next one."""
    for suffix in ("", "-wal", "-shm", "-journal"):  # the file first: nobody may open it without the others
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


@contextlib.contextmanager
def _guard(path: Path, *, exclusive: bool = True) -> Iterator[None]:
    """Hold the lock for creating or replacing the file; if not `exclusive`, keep others from it."""
    file = locked(path.with_name(f"{path.name}.lock"), exclusive=exclusive)
    try:
        yield
    finally:
        drop_private(file)


@contextlib.contextmanager
def _usable(path: Path) -> Iterator[None]:
    """Turns errors of the system on opening the file into the one after which another file is taken."""
    try:
        yield
    except OSError as err:
        raise CatalogUnusableError(f"catalog {str(path)!r} cannot be used: {os_reason(err)}") from err


@contextlib.contextmanager
def _translated(path: Path | None) -> Iterator[None]:
    """Turns errors of SQLite and the system into those of this package."""
    named = "the catalog in memory" if path is None else f"catalog {str(path)!r}"
    try:
        yield
    except DBAPIError as err:
        if _has_code(err, _DAMAGED):
            raise CatalogDamagedError(
                f"{named} is damaged ({err.orig}); delete it, it is rebuilt from the recordings"
            ) from err
        kind = CatalogUnusableError if _has_code(err, _UNUSABLE) else StorageError
        raise kind(f"{named} cannot be used: {err.orig}") from err
    except SQLAlchemyError as err:
        raise StorageError(f"{named} cannot be used: {err}") from err
    except sqlite3.Error as err:  # of a connection that is used as it is
        raise CatalogUnusableError(f"{named} cannot be used: {err}") from err


def _has_code(err: DBAPIError, codes: Sequence[int]) -> bool:
    code = getattr(err.orig, "sqlite_errorcode", None)
    return code is not None and code & 0xFF in codes
