"""A real PostgreSQL for tests: a cluster in a temporary directory, with its socket there, and databases of it."""

from __future__ import annotations

import contextlib
import itertools
import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, LiteralString

import psycopg

from tupli_mcap.schema import BaseFilter, EpisodeHeader
from tupli_mcap.server.database import Database
from tupli_mcap.storage.catalog import queries
from tupli_mcap.storage.catalog.entries import Entry

_NAMES = itertools.count()
_EMPTY = "template0 LOCALE_PROVIDER icu ICU_LOCALE 'en'"
_SETTINGS = {"fsync": "off", "max_connections": "200", "listen_addresses": "", "client_min_messages": "error"}


class NoPostgresError(Exception):
    """PostgreSQL is not installed here."""


class Cluster:
    """A running PostgreSQL, new or of the directory of an earlier one. Only the user who starts it may connect; the
    superuser is `postgres`. `settings` are added to those of tests."""

    def __init__(self, directory: Path, **settings: str) -> None:
        self._settings = {**_SETTINGS, **settings}
        found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb")) or list(
            filter(None, [shutil.which("initdb")])
        )
        if not found:
            raise NoPostgresError("initdb is missing: tools/setup-servers installs PostgreSQL")
        self._bin = Path(found[-1]).parent
        self._directory = directory
        self._own: list[str] = []
        self._template = ""  # the database that others are copies of, once there is one
        if os.getuid() == 0:  # as whom PostgreSQL refuses to run
            self._own = ["runuser", "-u", "postgres", "--"]
            os.chown(directory, pwd.getpwnam("postgres").pw_uid, -1)
        if not (directory / "PG_VERSION").exists():
            self._run("initdb", "--no-sync", "--auth=trust", "--username=postgres", "--encoding=UTF8")

    def start(self) -> None:
        """Starts it, also after a kill."""
        settings = " ".join(f"-c {key}='{value}'" for key, value in self._settings.items())
        log = str(self._directory / "log")
        self._run("pg_ctl", "--wait", "-l", log, "-o", f"{settings} -k {self._directory}", "start")

    def stop(self, how: str = "immediate") -> None:
        """Stops it; `immediate` is a crash."""
        self._run("pg_ctl", "--wait", "-m", how, "stop")

    @contextlib.contextmanager
    def database(self, *, empty: bool = False) -> Iterator[str]:
        """A new database, dropped after the block: its URL. Texts are ordered as English ones in it, unless a column
        says otherwise. Unless it is to be `empty`, it has the tables of a server, copied: to make them takes longer."""
        if not (empty or self._template):
            template = self._created(_EMPTY)
            Database(self._url(template)).close()
            self._template = template
        name = self._created(_EMPTY if empty else self._template)
        try:
            yield self._url(name)
        finally:
            self.execute(f"DROP DATABASE {name} WITH (FORCE)")

    def _created(self, template: str) -> str:
        name = f"d{os.getpid()}_{next(_NAMES)}"
        self.execute(f"CREATE DATABASE {name} TEMPLATE {template}")
        return name

    def _url(self, name: str) -> str:
        return f"postgresql+psycopg://postgres@/{name}?host={self._directory}"

    def execute(self, statement: LiteralString) -> None:
        """A statement of the superuser, outside of all databases of tests."""
        with psycopg.connect(f"host={self._directory} user=postgres", autocommit=True) as connection:
            connection.execute(statement)

    def _run(self, program: str, *arguments: str) -> None:
        command = [*self._own, str(self._bin / program), "-D", str(self._directory), *arguments]
        done = subprocess.run(
            command, cwd="/", stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
        )
        assert done.returncode == 0, done.stdout


@contextlib.contextmanager
def cluster() -> Iterator[Cluster]:
    """A cluster within the block. NoPostgresError if PostgreSQL is not installed."""
    with tempfile.TemporaryDirectory(prefix="pg") as folder:
        made = Cluster(Path(folder))
        made.start()
        try:
            yield made
        finally:
            made.stop()


class ServerCatalog:
    """The catalog in the database of a server, with the methods of `Catalog`."""

    def __init__(self, url: str) -> None:
        self._database = Database(url)

        self._read = self._database.reading

    def put_recording(self, relpath: str, entry: Entry) -> None:
        with self._database.writing() as connection:
            queries.put_recording(connection, relpath, entry)

    def remove_recording(self, relpath: str) -> None:
        with self._database.writing() as connection:
            queries.remove_recording(connection, relpath)

    def episodes(self, filter: BaseFilter | None = None, **page: Any) -> list[EpisodeHeader]:
        with self._database.reading() as connection:
            return list(queries.find_episodes(connection, filter, **page))

    def count(self, filter: BaseFilter | None = None) -> int:
        with self._database.reading() as connection:
            return queries.count_episodes(connection, filter)

    def explain(self, filter: BaseFilter | None) -> str:
        with self._database.reading() as connection:
            return queries.plan_of(connection, filter)

    def declare_key(self, key: str) -> None:
        with self._database.writing() as connection:
            queries.declare_key(connection, key)

    def __enter__(self) -> ServerCatalog:
        return self

    def __exit__(self, *_: object) -> None:
        self._database.close()
