"""What viewers open: an episode as a Rerun recording."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import FileResponse
from starlette.background import BackgroundTask

from tupli_mcap import viewer
from tupli_mcap.recording import Recording
from tupli_mcap.schema import FilterEQ
from tupli_mcap.server import episodes
from tupli_mcap.server.routes.callers import Served, TicketHolder

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["viewers"])


@router.get("/episodes/{uri}.rrd", responses={501: {"description": "The server has no rerun-sdk."}})
def show_episode(library: Served, holder: TicketHolder, uri: str) -> FileResponse:
    """An episode with its blueprint, for the Rerun viewer; a ticket for its recording will do."""
    with library.database.reading() as connection:
        found = episodes.find_episodes(connection, holder.caller, FilterEQ(key="id", value=uri))
        header = next(iter(found), None)
        if header is None:
            raise episodes.no_episode(uri)
        file = episodes.file_of(connection, holder.of(header.recording), header.recording)
    folder = Path(tempfile.mkdtemp(prefix="tupli-mcap-"))
    try:
        with Recording(library.blobs.place(file.place)) as recording:
            path = viewer.save(recording, folder / "episode.rrd", [header.episode])
    except BaseException:
        shutil.rmtree(folder)
        raise
    return FileResponse(
        path,
        media_type="application/octet-stream",
        filename=f"{uri}.rrd",
        background=BackgroundTask(shutil.rmtree, folder),
    )
