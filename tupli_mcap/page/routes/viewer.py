"""Shows episodes in the Rerun web viewer of rerun-sdk. Our pages serve its files, so that they load nothing from other
hosts.

The program `rerun` contains the files and serves them. We fetch them from it once, and keep them compressed in the
user's cache directory, where nobody else can write. Viewer and data have the same version: a viewer reads no other.
"""

from __future__ import annotations

import gzip
import threading
import urllib.request
from pathlib import Path
from typing import Annotated, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import FileResponse

from tupli_mcap import files
from tupli_mcap.cache import cache_dir, make_private
from tupli_mcap.errors import NotFoundError, StorageError, TupliError, os_reason
from tupli_mcap.page.answers import POLICY, PageRoute, Shown, address, error_page, page
from tupli_mcap.page.copies import replay_file, sent
from tupli_mcap.page.shelf import Shelf, find_some
from tupli_mcap.storage.catalog.place import is_private

router = APIRouter(route_class=PageRoute, include_in_schema=False)
_NAMES: Final = {"re_viewer.js": "text/javascript", "re_viewer_bg.wasm": "application/wasm"}
_turn = threading.Lock()
_Ids = Annotated[list[str], Query(alias="episode", min_length=1, max_length=8)]
# The viewer needs WebAssembly, and is embedded in our own pages.
_VIEWER_POLICY: Final = POLICY.replace("frame-ancestors 'none'", "frame-ancestors 'self'") + (
    "; script-src 'self' 'wasm-unsafe-eval'; connect-src 'self' blob: data:; worker-src 'self' blob:"
)


@router.get("/viewer")
def viewer(request: Request, shelf: Shown, uris: _Ids) -> Response:
    """A page that holds only the viewer, or an error in its place."""
    try:
        response = _viewer_page(request, shelf, uris)
    except TupliError as err:
        response = error_page(request, err)
    response.headers["Content-Security-Policy"] = _VIEWER_POLICY
    return response


def _viewer_page(request: Request, shelf: Shelf, uris: list[str]) -> Response:
    headers = shelf.ask(lambda connection: find_some(shelf, connection, uris))
    replay = address("replay.rrd", episode=[header.id for header in headers])
    facts = {"replay": replay, "viewer": _viewer_version()}
    return page(
        request, "viewer.html", facts, shelf=shelf, replay=replay, files=f"/viewer/{_viewer_version()}"
    )


@router.get("/viewer/{number}/{name}")
def file(number: str, name: str) -> FileResponse:
    if name not in _NAMES or number != _viewer_version():
        raise NotFoundError("there is no such file of the viewer")
    kept = {"Content-Encoding": "gzip", "Cache-Control": "private, max-age=31536000, immutable"}
    return FileResponse(_viewer_file(name), media_type=_NAMES[name], headers=kept)


@router.get("/replay.rrd")
def replay(shelf: Shown, uris: _Ids) -> FileResponse:
    """The data for the viewer: one episode with its blueprint, or several in the same plots."""
    headers = shelf.ask(lambda connection: find_some(shelf, connection, uris))
    return sent(replay_file(shelf, headers), "episodes.rrd")


def _viewer_version() -> str:
    """The version of rerun-sdk. MissingExtraError if it is not installed."""
    from tupli_mcap.viewer.sdk import rerun_sdk

    return str(rerun_sdk().__version__)


def _viewer_file(name: str) -> Path:
    """One of _NAMES, compressed by gzip. ViewerError if the program of rerun-sdk cannot be run, StorageError if files
    cannot be kept, or others may write to their directory."""
    folder = cache_dir() / "viewer" / _viewer_version()
    with _turn:
        if not (folder / f"{name}.gz").is_file():
            _take(folder)
        if not is_private(folder) or not is_private(folder / f"{name}.gz"):
            raise StorageError(f"other users may write to {folder}; remove it, or set TUPLI_MCAP_CACHE_DIR")
    return folder / f"{name}.gz"


def _take(folder: Path) -> None:
    from tupli_mcap.viewer.process import LOCAL, viewer_program, web_viewer

    try:
        make_private(folder)
        with web_viewer(viewer_program()) as (_, _, port):
            for name in _NAMES:
                with urllib.request.urlopen(f"http://{LOCAL}:{port}/{name}", timeout=60) as answer:
                    data = gzip.compress(answer.read(), 6, mtime=0)
                files.write_bytes(folder / f"{name}.gz", data, permissions=0o600)
    except OSError as err:
        raise StorageError(f"the viewer's files cannot be kept in {folder}: {os_reason(err)}") from err
