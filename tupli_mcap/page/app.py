"""The application behind `tupli-mcap browse`: the pages of a directory or a file on this machine."""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import webbrowser
from collections.abc import Callable
from pathlib import Path

import uvicorn
from fastapi import FastAPI, Request
from fastapi.responses import FileResponse
from starlette.exceptions import HTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware

from tupli_mcap.errors import StorageError
from tupli_mcap.page.answers import FILE_NAME, FOR_VIEWERS, address, error_page
from tupli_mcap.page.datasets import all_datasets
from tupli_mcap.page.directory import DirectoryShelf, FileShelf, shelf_of
from tupli_mcap.page.routes import PAGES
from tupli_mcap.viewer.process import has_display

_HOST = "127.0.0.1"


def read_recording(request: Request, ticket: str, name: str) -> FileResponse:
    """Sends a recording to a viewer of another host. The secret ticket in its address comes from one of our pages."""
    shelf: DirectoryShelf | FileShelf = request.app.state.shelf
    if not secrets.compare_digest(ticket.encode(), shelf.ticket.encode()):
        raise HTTPException(404, "there is no such file")
    headers = {**FOR_VIEWERS, "X-Content-Type-Options": "nosniff"}
    return FileResponse(shelf.path_of(name), media_type="application/octet-stream", headers=headers)


def create_app(shelf: DirectoryShelf | FileShelf) -> FastAPI:
    """The application that shows a shelf to programs of this machine only."""
    app = FastAPI(title="tupli-mcap", docs_url=None, redoc_url=None, openapi_url=None)
    app.state.shelf = shelf
    app.state.shown = lambda request: contextlib.nullcontext(shelf)
    for router in PAGES:
        app.router.routes += router.routes  # as they are: `include_router` would make each of them again
    app.get("/file/{ticket}/" + FILE_NAME)(read_recording)
    app.add_exception_handler(HTTPException, error_page)  # for addresses of no route
    # Against DNS rebinding: a foreign page whose host name resolves to this machine must not read our pages.
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=[_HOST, "localhost"])
    return app


def browse(path: Path, port: int, tell: Callable[[str], None], *, show: bool) -> None:
    """Shows a directory or a recording at an address of this machine, until Ctrl-C; of one dataset, that first.

    Args:
        port: 0 takes a free one.
        tell: called with the address.
        show: whether to open it in a browser.

    Raises:
        RecordingError, FormatError: there is no such file, or it is no recording.
        StorageError: the port is taken.
    """
    shelf = shelf_of(path)
    found = shelf.ask(lambda connection: all_datasets(shelf, connection))  # catalogs new recordings, too
    app = create_app(shelf)
    listening = _listen(port)
    first = address("dataset", found[0].key) if len(found) == 1 else ""
    url = f"http://{_HOST}:{listening.getsockname()[1]}{first}"
    tell(url)
    if show and has_display():  # without a display, a text browser may take over the terminal
        webbrowser.open(url)
    config = uvicorn.Config(app, log_level="warning", server_header=False, timeout_graceful_shutdown=2)
    with contextlib.suppress(KeyboardInterrupt):  # uvicorn raises it again after its shutdown
        uvicorn.Server(config).run([listening])


def _listen(port: int) -> socket.socket:
    try:
        return socket.create_server((_HOST, port), backlog=100)
    except OSError as err:
        raise StorageError(
            f"port {port} cannot be used: {os.strerror(err.errno or 0)}; choose another with --port, or leave it out"
        ) from err
