"""The database of a server: its tables and those of the catalog, in SQLite or PostgreSQL.

On both, one transaction writes at a time, and each that reads sees one state of all tables from beginning to end.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
import time
from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, delete, event, insert, select
from sqlalchemy.exc import (
    DataError,
    DBAPIError,
    IntegrityError,
    InterfaceError,
    OperationalError,
    SQLAlchemyError,
)

from tupli_mcap.errors import StorageError
from tupli_mcap.server import migrations, tables
from tupli_mcap.storage.texts import escape_text, unescape_text

__all__ = [
    "Database",
    "TooLongError",
    "UnavailableError",
    "audience",
    "audit",
    "demand_pending",
    "pend",
    "pending",
    "settle",
]

_BUSY_MS = 30_000
_STEPS = 20_000  # of SQLite, between two looks at the clock
_CANCELED = "57014"  # what PostgreSQL says of a statement that took too long
# A writer on PostgreSQL holds this lock, and its statements may take their time.
_ALONE = "SELECT set_config('statement_timeout', '0', true), pg_advisory_xact_lock(1953854572)"
_MOST_GROUPS_BYTES = 2000  # PostgreSQL indexes no longer texts


class UnavailableError(StorageError):
    """What the server keeps things in does not answer, or is busy; asked again later, it may."""


class TooLongError(StorageError):
    """A question takes longer than it may."""


class Database:
    """Transactions on the tables of a server, from any thread.

    seconds: how long a question may take, also one in a transaction that writes; more is a TooLongError.

    Raises:
        StorageError: the database cannot be opened, or is of a later version.
    """

    def __init__(self, url: str, seconds: float = 30.0) -> None:
        self._seconds = seconds
        self._engine = _engine(url, seconds)
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
            if connection.dialect.name == "postgresql":
                connection.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
            with connection.begin(), _interrupted(connection, deadline):
                yield connection

    @contextlib.contextmanager
    def writing(self) -> Iterator[Connection]:
        """A transaction that no other one writes beside: committed at the end, rolled back on an exception."""
        with _translated(), self._engine.connect() as connection:
            connection.execution_options(tupli_write=True)
            with connection.begin():
                if connection.dialect.name == "postgresql":
                    connection.exec_driver_sql(_ALONE)
                connection.execution_options(tupli_deadline=time.monotonic() + self._seconds)
                yield connection

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()


def audience(connection: Connection, groups: Sequence[str]) -> str:
    """The text that stands for a list of groups in `published_in`; from then on, SQL finds it by each of them.

    Raises:
        StorageError: there are too many groups.
    """
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
    """Notes that a user has changed something."""
    row = {"time": int(time.time()), "user": user, "action": action, "target": escape_text(target[:500])}
    connection.execute(insert(tables.AUDIT).values(**row))


def pend(connection: Connection, name: str) -> None:
    """Notes that a file is on its way in or out, until `settle`."""
    settle(connection, name)
    row = {"path": escape_text(name), "since": int(time.time())}
    connection.execute(insert(tables.PENDING).values(**row))


def settle(connection: Connection, name: str) -> None:
    """Notes that a file has come, or is gone."""
    connection.execute(delete(tables.PENDING).where(tables.PENDING.c.path == escape_text(name)))


def pending(connection: Connection, *, seconds: float) -> list[str]:
    """The files that have been pending for so long."""
    old = select(tables.PENDING.c.path).where(tables.PENDING.c.since <= time.time() - seconds)
    return [unescape_text(path) for path in connection.execute(old).scalars()]


def demand_pending(connection: Connection, name: str) -> None:
    """Raises UnavailableError if a file is not pending any more: it took too long to come, and was deleted."""
    there = select(tables.PENDING.c.path).where(tables.PENDING.c.path == escape_text(name))
    if connection.execute(there).first() is None:
        raise UnavailableError(f"{name} took too long to come; send it again")


def _engine(url: str, seconds: float) -> Engine:
    try:
        engine = create_engine(url, pool_pre_ping=not url.startswith("sqlite"), hide_parameters=True)
    except (SQLAlchemyError, ImportError) as err:
        raise StorageError(
            f"the database cannot be used: {err}; give a URL such as postgresql+psycopg://…"
        ) from err
    if engine.dialect.name not in ("sqlite", "postgresql"):
        raise StorageError(
            f"expected a database of SQLite or PostgreSQL, found {engine.dialect.name}; "
            "give a URL such as postgresql+psycopg://…"
        )
    if engine.dialect.name == "sqlite":
        _prepare_sqlite(engine)
    else:
        _prepare_postgresql(engine, seconds)
    return engine


def _prepare_sqlite(engine: Engine) -> None:
    @event.listens_for(engine, "connect")
    def _settings(connection: sqlite3.Connection, _: object) -> None:
        connection.isolation_level = None  # transactions are begun below
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute(f"PRAGMA busy_timeout = {_BUSY_MS}")
        connection.execute("PRAGMA synchronous = FULL")  # what was acknowledged outlives a power loss

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        # A transaction that writes takes the lock at once: one that has read before cannot wait for it.
        write = connection.get_execution_options().get("tupli_write")
        connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")


def _prepare_postgresql(engine: Engine, seconds: float) -> None:
    @event.listens_for(engine, "do_connect")
    def _settings(_dialect: object, _record: object, _args: object, kwargs: dict[str, object]) -> None:
        kwargs.setdefault("connect_timeout", 10)
        limits = f"-c lock_timeout={_BUSY_MS} -c statement_timeout={seconds * 1000:.0f}"
        kwargs["options"] = f"{kwargs.get('options', '')} {limits}"


@contextlib.contextmanager
def _interrupted(connection: Connection, deadline: float) -> Iterator[None]:
    """Ends statements of SQLite at a time; PostgreSQL does so by itself."""
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
    except (OperationalError, InterfaceError) as err:
        if getattr(err.orig, "sqlstate", "") == _CANCELED or str(err.orig) == "interrupted":
            raise TooLongError(
                "this takes too long; narrow the filter, or declare the keys in it (`declare_key`)"
            ) from err
        raise UnavailableError(f"the server's database cannot be used: {err.orig}") from err
    except DBAPIError as err:
        raise StorageError(f"the server's database cannot be used: {err.orig}") from err
