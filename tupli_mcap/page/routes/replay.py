"""Shows episodes in the Rerun viewer, which our pages serve."""

from __future__ import annotations

from typing import Annotated, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import FileResponse

from tupli_mcap.errors import NotFoundError, TupliError
from tupli_mcap.page.answers import POLICY, PageRoute, Shown, address, error_page, page
from tupli_mcap.page.copies import replay_file, sent
from tupli_mcap.page.shelf import Shelf, find_some
from tupli_mcap.page.viewer_files import NAMES, viewer_file, viewer_version

router = APIRouter(route_class=PageRoute, include_in_schema=False)
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
    facts = {"replay": replay, "viewer": viewer_version()}
    return page(
        request, "viewer.html", facts, shelf=shelf, replay=replay, files=f"/viewer/{viewer_version()}"
    )


@router.get("/viewer/{number}/{name}")
def file(number: str, name: str) -> FileResponse:
    """A file of the viewer."""
    if name not in NAMES or number != viewer_version():
        raise NotFoundError("there is no such file of the viewer")
    kept = {"Content-Encoding": "gzip", "Cache-Control": "private, max-age=31536000, immutable"}
    return FileResponse(viewer_file(name), media_type=NAMES[name], headers=kept)


@router.get("/replay.rrd")
def replay(shelf: Shown, uris: _Ids) -> FileResponse:
    """The data for the viewer: one episode with its blueprint, or several in the same plots."""
    headers = shelf.ask(lambda connection: find_some(shelf, connection, uris))
    return sent(replay_file(shelf, headers), "episodes.rrd")
