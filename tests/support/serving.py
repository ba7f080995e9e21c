"""A real server on a port of this machine, within a block."""

from __future__ import annotations

import contextlib
import functools
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from pwdlib import PasswordHash
from pwdlib.hashers.argon2 import Argon2Hasher

from tupli_mcap.server.app import create_app
from tupli_mcap.server.database import Database
from tupli_mcap.server.library import Library
from tupli_mcap.server.people import accounts
from tupli_mcap.server.run import Listening, configured
from tupli_mcap.server.settings import Settings

PASSWORD = "correct horse battery staple"
REAL_HASHES = accounts._HASHES
# Of passwords that nobody attacks: made in no time. A server in a process of its own has the real ones.
_QUICK_HASHES = PasswordHash((Argon2Hasher(time_cost=1, memory_cost=8, parallelism=1),))


@contextlib.contextmanager
def serving(
    settings: Settings, listening: Listening | None = None, *, hashes: PasswordHash = _QUICK_HASHES
) -> Iterator[str]:
    """Serves in a thread; yields the address. The admin's password is PASSWORD."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accounts, "_HASHES", hashes)
        patch.setenv("TUPLI_MCAP_ADMIN_PASSWORD", PASSWORD)
        database = settings.own / "server.sqlite"
        if not settings.database and not database.exists():
            settings.own.mkdir(parents=True, exist_ok=True, mode=0o700)
            database.write_bytes(_tables())
        library = Library(settings)
        library.first_password()
        library.adopt()
        patch.delenv("TUPLI_MCAP_ADMIN_PASSWORD")
        config = configured(lambda: create_app(library), settings, listening or Listening())
        config.port = 0
        with running(config) as url:
            yield url


@functools.cache
def _tables() -> bytes:
    """The database of a new server in SQLite, which is copied: to make the tables takes longer."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "server.sqlite")
        Database(f"sqlite:///{file}").close()
        return file.read_bytes()


@contextlib.contextmanager
def running(config: uvicorn.Config) -> Iterator[str]:
    """Serves in a thread; yields the address."""
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.01)
    sockets: Any = server.servers[0].sockets
    try:
        yield f"http://127.0.0.1:{sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(30)


ENGINES = ("sqlite and a directory", "postgresql and s3")


@contextlib.contextmanager
def settings_of(engine: str, request: pytest.FixtureRequest, directory: Path) -> Iterator[Settings]:
    """The settings of a server on an engine, whose data last as long as the block."""
    if engine != ENGINES[1]:
        yield Settings(directory)
        return
    import buckets  # not where d3rlpy is

    with request.getfixturevalue("postgres").database() as database, buckets.bucket() as bucket:
        yield Settings(directory, database=database, blobs=bucket.url)
