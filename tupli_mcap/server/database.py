"""The database of a server: its tables and those of the catalog, in SQLite or PostgreSQL.

On both, one transaction writes at a time, and each reading transaction sees one state of all tables.
"""

from __future__ import annotations

import contextlib
import json
import re
import sqlite3
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, delete, event, func, insert, make_url, select
from sqlalchemy.exc import (
    DataError,
    DBAPIError,
    IntegrityError,
    InterfaceError,
    InternalError,
    OperationalError,
    SQLAlchemyError,
    TimeoutError as PoolTimeoutError,
)

from tupli_mcap.errors import StorageError
from tupli_mcap.server import migrations, tables
from tupli_mcap.storage.catalog.database import BUSY_MS, prepared_sqlite
from tupli_mcap.storage.texts import escape_text, unescape_text

_POSTGRESQL = re.compile("^postgres(ql)?://")  # as psql has it, without the driver that is installed with us
_STEPS = 20_000  # instructions of SQLite between two looks at the clock
_CANCELED = "57014"  # PostgreSQL's code for a statement that took too long
_FULL = "53100"  # and for a full disk
# What is set for each connection to PostgreSQL, as setting it for each transaction takes longer than some queries.
# Compiling a statement (JIT), or starting processes that share it, takes longer than running it.
_READS = (
    r"-c default_transaction_isolation=repeatable\ read -c default_transaction_read_only=on "
    "-c jit=off -c max_parallel_workers_per_gather=0"
)
# A writer sees what others have committed before it got this lock; no time limit is set for its statements.
_WRITES = (
    "SET TRANSACTION ISOLATION LEVEL READ COMMITTED, READ WRITE; "
    "SET LOCAL statement_timeout = 0; "
    "SELECT pg_advisory_xact_lock(1953854572)"
)
# PostgreSQL ends a transaction in which nothing is asked for so long: its process is frozen, or its machine
# is gone, and it may have the lock without which nobody writes. Within a transaction, a bucket is asked for
# less long.
_IDLE_MS = 60_000
_MOST_GROUPS_BYTES = 2000  # PostgreSQL cannot index longer texts


class UnavailableError(StorageError):
    """The database or the bucket does not answer, or is busy. A later attempt may succeed."""


class DiskFullError(UnavailableError):
    """The disk of the database is full."""


class TooLongError(StorageError):
    """A query takes longer than allowed."""


class Database:
    """Transactions on the tables of a server. Thread-safe. StorageError if the database cannot be opened, or is of a
    later version.

    place: a SQLAlchemy URL, or the path of a file of SQLite.
    seconds: how long a query may take, also in a writing transaction; TooLongError if it takes longer.
    """

    def __init__(self, place: str | Path, seconds: float = 30.0) -> None:
        self._seconds = seconds
        self._engine = _engine(place, seconds)
        try:
            with self.writing() as connection:
                migrations.upgrade(connection)
        except BaseException:
            self.close()
            raise

    @contextlib.contextmanager
    def reading(self) -> Iterator[Connection]:
        """A transaction that changes nothing."""
        with _translated(), self._engine.connect() as connection:
            deadline = time.monotonic() + self._seconds
            connection.execution_options(tupli_deadline=deadline)
            with connection.begin(), _interrupted(connection, deadline):
                yield connection

    @contextlib.contextmanager
    def writing(self) -> Iterator[Connection]:
        """The only writing transaction at its time: committed at the end, rolled back on an exception."""
        with _translated(), self._engine.connect() as connection:
            connection.execution_options(tupli_write=True)
            with connection.begin():
                if connection.dialect.name == "postgresql":
                    connection.exec_driver_sql(_WRITES)
                connection.execution_options(tupli_deadline=time.monotonic() + self._seconds)
                yield connection

    def close(self) -> None:
        self._engine.dispose()


def audience(connection: Connection, groups: Sequence[str]) -> str:
    """The text for a list of groups in `published_in`. It is also registered under each group, for SQL to find it.
    StorageError if there are too many groups."""
    text = json.dumps(list(groups))
    if len(text) > _MOST_GROUPS_BYTES:
        raise StorageError(
            f"expected groups of at most {_MOST_GROUPS_BYTES} bytes in all, found {len(groups)} groups "
            f"of {len(text)} bytes; unpublish some, or publish in 'global'"
        )
    table = tables.AUDIENCE
    known = set(connection.execute(select(table.c.team).where(table.c.published_in == text)).scalars())
    new = [group for group in dict.fromkeys(map(escape_text, groups)) if group not in known]
    if new:
        connection.execute(insert(table), [{"published_in": text, "team": group} for group in new])
    return text


def audit(connection: Connection, user: str, action: str, target: str) -> None:
    """Logs a change by a user in the audit table."""
    row = {"time": int(time.time()), "user": user, "action": action, "target": escape_text(target[:500])}
    connection.execute(insert(tables.AUDIT).values(**row))


def demand_few(connection: Connection, user: str, action: str, most: int) -> None:
    """Raises StorageError if a user has logged so many changes of one kind, of which all users share what there is."""
    table = tables.AUDIT
    done = select(func.count()).where(table.c.user == user, table.c.action == action)
    if connection.execute(done).scalar_one() >= most:
        raise StorageError(
            f"expected at most {most} times {action} by {user}, who has done that; ask an admin to do it"
        )


def pend(connection: Connection, name: str) -> None:
    """Notes that a file is being stored or deleted, until `settle`."""
    settle(connection, name)
    row = {"path": escape_text(name), "since": int(time.time())}
    connection.execute(insert(tables.PENDING).values(**row))


def settle(connection: Connection, name: str) -> None:
    """Notes that a file has been stored, or deleted."""
    connection.execute(delete(tables.PENDING).where(tables.PENDING.c.path == escape_text(name)))


def pending(connection: Connection, *, seconds: float) -> list[str]:
    """The files that have been pending for at least so many seconds."""
    old = select(tables.PENDING.c.path).where(tables.PENDING.c.since <= time.time() - seconds)
    return [unescape_text(path) for path in connection.execute(old).scalars()]


def demand_pending(connection: Connection, name: str) -> None:
    """Raises UnavailableError if a file is not pending any more: storing it took too long, and it was deleted."""
    there = select(tables.PENDING.c.path).where(tables.PENDING.c.path == escape_text(name))
    if connection.execute(there).first() is None:
        raise UnavailableError(f"{name} took too long to arrive; send it again")


def _engine(place: str | Path, seconds: float) -> Engine:
    try:
        if isinstance(place, Path):  # in the text of a URL, "?" and "%" mean something else
            url = URL.create("sqlite", database=str(place))
        else:
            url = make_url(_POSTGRESQL.sub("postgresql+psycopg://", place))
        is_sqlite = url.get_backend_name() == "sqlite"
        engine = create_engine(url, pool_pre_ping=not is_sqlite, hide_parameters=True)
    except (SQLAlchemyError, ImportError) as err:
        raise StorageError(
            f"the database cannot be used: {err}; give a URL such as postgresql://user@host/name"
        ) from err
    if engine.dialect.name not in ("sqlite", "postgresql"):
        raise StorageError(
            f"expected a database of SQLite or PostgreSQL, found {engine.dialect.name}; "
            "give a URL such as postgresql://user@host/name"
        )
    if engine.dialect.name == "sqlite":
        # acknowledged changes survive a power loss
        prepared_sqlite(engine, "journal_mode = WAL", "synchronous = FULL")
    else:
        _prepare_postgresql(engine, seconds)
    return engine


def _prepare_postgresql(engine: Engine, seconds: float) -> None:
    @event.listens_for(engine, "do_connect")
    def _settings(_dialect: object, _record: object, _args: object, kwargs: dict[str, object]) -> None:
        kwargs.setdefault("connect_timeout", 10)
        limits = f"-c lock_timeout={BUSY_MS} -c statement_timeout={seconds * 1000:.0f} "
        limits += f"-c idle_in_transaction_session_timeout={_IDLE_MS}"
        kwargs["options"] = f"{kwargs.get('options', '')} {limits} {_READS}"


@contextlib.contextmanager
def _interrupted(connection: Connection, deadline: float) -> Iterator[None]:
    """Interrupts statements of SQLite at the deadline. PostgreSQL has a time limit of its own."""
    driver: Any = connection.connection.dbapi_connection
    if not isinstance(driver, sqlite3.Connection):
        yield
        return
    driver.set_progress_handler(lambda: time.monotonic() > deadline, _STEPS)
    try:
        yield
    finally:
        driver.set_progress_handler(None, 0)


@contextlib.contextmanager
def _translated() -> Iterator[None]:
    try:
        yield
    except (DataError, UnicodeEncodeError) as err:
        raise StorageError("expected texts and numbers that a database can hold") from err
    except IntegrityError as err:
        raise StorageError(f"this contradicts what is stored: {str(err.orig).partition(chr(10))[0]}") from err
    except (OperationalError, InterfaceError, InternalError) as err:
        if getattr(err.orig, "sqlstate", "") == _CANCELED or str(err.orig) == "interrupted":
            raise TooLongError(
                "the query takes too long; narrow the filter, or declare the keys of filter and order with "
                "`declare_key`"
            ) from err
        code = getattr(err.orig, "sqlstate", None) or getattr(err.orig, "sqlite_errorname", "")
        if code in (_FULL, "SQLITE_FULL"):
            raise DiskFullError("the server's disk is full; try again when there is room") from err
        raise UnavailableError(f"the server's database cannot be used: {err.orig}") from err
    except PoolTimeoutError as err:
        raise UnavailableError(
            "all connections to the server's database are in use; try again later"
        ) from err
    except DBAPIError as err:
        raise StorageError(f"the server's database cannot be used: {err.orig}") from err
