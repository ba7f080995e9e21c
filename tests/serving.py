"""A real server on a port of this machine, within a block."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from tupli_mcap.server.app import create_app
from tupli_mcap.server.library import Library
from tupli_mcap.server.run import Listening, configured
from tupli_mcap.server.settings import Settings

PASSWORD = "correct horse battery staple"


@contextlib.contextmanager
def serving(settings: Settings, listening: Listening | None = None) -> Iterator[str]:
    """Serves in a thread; yields the address. The admin's password is PASSWORD."""
    with pytest_environment("TUPLI_MCAP_ADMIN_PASSWORD", PASSWORD):
        library = Library(settings)
        library.first_password()
        library.adopt()
    config = configured(lambda: create_app(library), settings, listening or Listening())
    config.port = 0
    with running(config) as url:
        yield url


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


@contextlib.contextmanager
def pytest_environment(name: str, value: str) -> Iterator[None]:
    """Sets a variable of the environment for a block."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(name, value)
        yield
