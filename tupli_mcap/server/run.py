"""The process of a server."""

from __future__ import annotations

from collections.abc import Callable

import uvicorn

from tupli_mcap.server.app import create_app
from tupli_mcap.server.library import Library
from tupli_mcap.server.settings import Settings

__all__ = ["run"]


def run(settings: Settings, host: str, port: int, tell: Callable[[str, str | None], None]) -> None:
    """Serves a directory until the process is told to stop; requests that have begun are finished.

    tell: called with the address and the admin's new password (None if there is no new one), once it is known.

    Raises:
        StorageError: the directory or its database cannot be used.
    """
    library = Library(settings)
    password = library.first_password()
    library.adopt()
    tell(f"http://{host}:{port}", password)
    config = uvicorn.Config(
        create_app(library),
        host=host,
        port=port,
        log_level="warning",
        server_header=False,
        timeout_keep_alive=30,
    )
    uvicorn.Server(config).run()
