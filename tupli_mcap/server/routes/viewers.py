"""An episode as a file for the Rerun viewer."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.responses import FileResponse

from tupli_mcap.page.copies import replay_file, sent
from tupli_mcap.page.shelf import find_episode
from tupli_mcap.server.pages.shelf import LibraryShelf
from tupli_mcap.server.routes.bodies import MADE
from tupli_mcap.server.routes.callers import Served, TicketHolder
from tupli_mcap.server.wire import Error

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["viewers"])


_RRD = {**MADE, 501: {"model": Error, "description": "The server has no rerun-sdk."}}


@router.get("/episodes/{uri}.rrd", response_class=Response, responses=_RRD)
def show_episode(request: Request, library: Served, holder: TicketHolder, uri: str) -> FileResponse:
    """An episode with its blueprint, for the Rerun viewer. A ticket for its recording is enough."""
    shelf = LibraryShelf(library, holder.caller, "", request.app.state.kept)
    header = shelf.ask(lambda connection: find_episode(shelf, connection, uri))
    holder.of(header.recording)
    return sent(replay_file(shelf, [header]), f"{uri}.rrd")
