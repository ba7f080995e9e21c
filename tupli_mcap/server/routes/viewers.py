"""What viewers open: an episode as a Rerun recording."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import FileResponse

from tupli_mcap.page.copies import replay_file, sent
from tupli_mcap.page.shelf import find_episode
from tupli_mcap.server.pages.shelf import LibraryShelf
from tupli_mcap.server.routes.callers import Served, TicketHolder

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["viewers"])


@router.get("/episodes/{uri}.rrd", responses={501: {"description": "The server has no rerun-sdk."}})
def show_episode(request: Request, library: Served, holder: TicketHolder, uri: str) -> FileResponse:
    """An episode with its blueprint, for the Rerun viewer; a ticket for its recording will do."""
    shelf = LibraryShelf(library, holder.caller, "", request.app.state.kept)
    header = shelf.ask(lambda connection: find_episode(shelf, connection, uri))
    holder.of(header.recording)
    return sent(replay_file(shelf, [header]), f"{uri}.rrd")
