"""Backs up and restores all data of a server, while it runs.

A backup is a directory like that of a server with SQLite: `tupli-mcap serve` can serve it as it is. Backing up and
restoring take the same steps, with any database and bucket on either side:

1. Copy the tables as they are at one moment. The server goes on meanwhile.
2. Copy the files that the tables name, except those that were copied before: the content of a name never changes.
   Compare each with its SHA-256 in the tables.
3. If a file was deleted since step 1, start again; only what is new is copied.
4. Replace the old tables by the new ones, at once.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import tempfile
from pathlib import Path
from typing import Final, NamedTuple

from sqlalchemy import Connection, func, inspect, select, text

from tupli_mcap import files
from tupli_mcap.errors import FormatError, StorageError
from tupli_mcap.progress import Progress, progress
from tupli_mcap.server.blobs import Blobs, LostError, blobs_of
from tupli_mcap.server.database import Database
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.stored.items import artifact_key
from tupli_mcap.server.tables import FAILURE, FILE, ITEM, METADATA, PENDING, UPLOAD, USER
from tupli_mcap.storage.atomic import os_errors
from tupli_mcap.storage.catalog import queries
from tupli_mcap.storage.catalog.tables import METADATA as CATALOG
from tupli_mcap.storage.texts import unescape_text

_PASSING: Final = (FAILURE, PENDING, UPLOAD)  # tables about the running server, which a backup leaves out
_ATTEMPTS: Final = 20
_UNLIMITED: Final = 7 * 24 * 3600.0
_ROWS: Final = 5000


class Copied(NamedTuple):
    """The numbers of users, recordings and artifacts in a backup, the bytes of its files, and how many files this call
    has copied."""

    users: int
    recordings: int
    artifacts: int
    bytes: int
    copied: int


def back_up(settings: Settings, target: Path) -> Copied:
    """Backs up a server into a directory, which is empty or holds an earlier backup. The server may run. After an
    interruption, call it again.

    Raises:
        StorageError: there is no data of a server, the directory holds something else, such as the data of a server, or
            a file cannot be read.
        FormatError: a file does not have the SHA-256 in the database.
    """
    source_blobs, sqlite = blobs_of(settings), _sqlite_of(target)
    if not settings.database and not _sqlite_of(settings.directory).exists():
        raise StorageError(
            f"expected the data of a server in {str(settings.directory)!r}, found none; check the path, or give "
            "--database"
        )
    if settings.directory.resolve() in (target.resolve(), *target.resolve().parents):
        raise StorageError(
            f"expected a directory outside of {str(settings.directory)!r} for the backup, found {str(target)!r}; "
            "choose another one"
        )
    if Settings(target).secret.exists():
        raise StorageError(
            f"expected a backup or nothing in {str(target)!r}, found the data of a server, or a backup that was "
            "served; choose another directory"
        )
    # an interrupted backup has left one of both
    own, new = sqlite.parent, Settings(target).next_database
    with os_errors("cannot back up into", target):
        is_empty = not target.exists() or all(
            each == own and not any(own.iterdir()) for each in target.iterdir()
        )
    if not (is_empty or sqlite.exists() or new.exists()):
        raise StorageError(
            f"expected a backup or nothing in {str(target)!r}, found other files; choose another directory"
        )
    with os_errors("cannot back up into", target):
        own.mkdir(parents=True, exist_ok=True, mode=0o700)
    with files.alone_in(own):  # no other backup goes into it meanwhile
        return _back_up(settings, source_blobs, target, new)


def _back_up(settings: Settings, source_blobs: Blobs, target: Path, new: Path) -> Copied:
    """Backs up into the directory of a backup, whose next database is at `new` until it is complete."""
    target_blobs, sqlite, making = blobs_of(Settings(target)), _sqlite_of(target), Settings(target).making
    with contextlib.closing(Database(settings.database_place, _UNLIMITED)) as source:
        for attempt in range(_ATTEMPTS):
            _empty(new)
            shutil.rmtree(making, ignore_errors=True)  # left by an interrupted backup
            making.mkdir()
            with contextlib.closing(Database(new, _UNLIMITED)) as made:
                _copy_tables(source, made)
                contents = _contents(made)
            try:
                copied = _copy_files(contents, source_blobs, target_blobs, making, "is --blobs right?")
                break
            except LostError:
                if attempt == _ATTEMPTS - 1:
                    raise
    for suffix in ("-wal", "-shm"):
        sqlite.with_name(sqlite.name + suffix).unlink(missing_ok=True)
    new.replace(sqlite)
    shutil.rmtree(making, ignore_errors=True)
    known = {target / name for name in contents.files}
    for path in [*(target / "artifacts").rglob("*"), *target.rglob("*.mcap")]:
        if path.is_file() and path not in known:
            path.unlink()  # of an earlier backup: a server that starts here would take a recording for the admin's
    return copied


def _empty(database: Path) -> None:
    """Makes the file of a database without tables. It is there at any time, as an interrupted backup is known by it."""
    for suffix in ("-wal", "-shm", "-journal"):  # of an interrupted backup
        database.with_name(database.name + suffix).unlink(missing_ok=True)
    database.write_bytes(b"")


def restore(backup: Path, settings: Settings) -> Copied:
    """Restores a backup into empty places. After an interruption, call it again. StorageError if there is no backup, a
    server is running on it, or the target holds data already; FormatError if a file of the backup is damaged."""
    source_blobs, target_blobs = blobs_of(Settings(backup)), blobs_of(settings)
    if not _sqlite_of(backup).exists():
        raise StorageError(f"expected the backup of a server in {str(backup)!r}, found none; check the path")
    newest = _sqlite_of(backup).with_name("server.sqlite-wal")  # changes that a copy of the other file lacks
    if newest.exists() and newest.stat().st_size:
        raise StorageError(
            f"expected a backup in {str(backup)!r}, found the data of a server that runs or was killed; "
            "back that up, and restore the backup"
        )
    with os_errors("cannot restore into", settings.directory):
        settings.own.mkdir(parents=True, exist_ok=True, mode=0o700)
        settings.making.mkdir(exist_ok=True)
    with contextlib.ExitStack() as stack:
        # the server deletes what is left there by a killed process
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=settings.making)))
        # a copy, because opening it upgrades the tables of an earlier version
        copy = folder / "server.sqlite"
        shutil.copyfile(_sqlite_of(backup), copy)
        source = stack.enter_context(contextlib.closing(Database(copy, _UNLIMITED)))
        target = stack.enter_context(contextlib.closing(Database(settings.database_place, _UNLIMITED)))
        with target.reading() as connection:
            if connection.execute(select(USER.c.name)).first():
                raise StorageError(
                    "the target's database holds a server's data already; restore into an empty one"
                )
        settings.next_database.touch()  # until it is complete, its files are not for a server that starts there
        advice = "restore another backup"
        copied = _copy_files(_contents(source), source_blobs, target_blobs, folder, advice)
        _copy_tables(source, target)
        settings.next_database.unlink()
    return copied


def _sqlite_of(directory: Path) -> Path:
    return Settings(directory).own / "server.sqlite"


# --- tables ---


def _copy_tables(source: Database, target: Database) -> None:
    tables = [each for each in (*CATALOG.sorted_tables, *METADATA.sorted_tables) if each not in _PASSING]
    with source.reading() as reading, target.writing() as writing:
        for table in reversed(tables):
            writing.execute(table.delete())  # rows that every new database has
        for table in tables:
            names = [column.name for column in table.columns]
            rows = reading.execute(select(table), execution_options={"yield_per": _ROWS})
            for page in rows.partitions():
                queries.insert_all(writing, table, names, [tuple(row) for row in page])
        if writing.dialect.name == "postgresql":
            for table in tables:
                _go_on_counting(writing, table.name)


def _go_on_counting(connection: Connection, table: str) -> None:
    """Makes PostgreSQL number new rows after the copied ones."""
    for column in inspect(connection).get_columns(table):
        if "nextval" in str(column["default"] or ""):
            name = column["name"]
            last = f'(SELECT coalesce(max("{name}"), 0) FROM "{table}")'
            sequence = f"pg_get_serial_sequence('{table}', '{name}')"
            connection.execute(text(f"SELECT setval({sequence}, 1 + {last}, false)"))


# --- files ---


class _Contents(NamedTuple):
    users: int
    recordings: int
    bytes: int
    files: dict[str, str]  # SHA-256 by name


def _contents(database: Database) -> _Contents:
    with database.reading() as connection:
        users = connection.execute(select(func.count()).select_from(USER)).scalar_one()
        places = connection.execute(select(FILE.c.place, FILE.c.digest).order_by(FILE.c.place))
        files = {unescape_text(place): digest for place, digest in places}
        ids = select(ITEM.c.id).where(ITEM.c.kind == "artifact").distinct().order_by(ITEM.c.id)
        artifacts = {artifact_key(uri): uri for uri in connection.execute(ids).scalars()}
        size = sum(
            int(connection.execute(select(func.coalesce(func.sum(column), 0))).scalar_one())
            for column in (FILE.c.size, ITEM.c.size)
        )
    return _Contents(users, len(files), size, files | artifacts)


def _copy_files(contents: _Contents, source: Blobs, target: Blobs, folder: Path, advice: str) -> Copied:
    """Copies the files that the target lacks. LostError, which ends with the advice, if the source lacks one."""
    total = copied = 0
    with progress(contents.bytes, "copying", in_bytes=True) as bar:
        for name, digest in contents.files.items():
            size = source.size(name)
            if size is None:
                raise LostError(f"{source.place(name)} is gone, and the database names it; {advice}")
            total += size
            if target.size(name) != size:
                _copy_file(name, digest, size, source, target, folder, bar)
                copied += 1
    artifacts = len(contents.files) - contents.recordings
    return Copied(contents.users, contents.recordings, artifacts, total, copied)


def _copy_file(
    name: str, digest: str, size: int, source: Blobs, target: Blobs, folder: Path, bar: Progress
) -> None:
    with tempfile.NamedTemporaryFile(dir=folder) as file:
        found = hashlib.sha256()
        for piece in source.pieces(name, 0, size):
            found.update(piece)
            file.write(piece)
            bar.advance(len(piece))
        file.flush()
        if found.hexdigest() != digest:
            raise FormatError(f"{name} is damaged: expected the SHA-256 {digest}, found {found.hexdigest()}")
        target.keep(name, Path(file.name))
