"""Episodes of any recordings as one recording."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Annotated

from fastapi import APIRouter, Body
from fastapi.responses import StreamingResponse

from tupli_mcap.page import copies
from tupli_mcap.server.library import Library
from tupli_mcap.server.routes.bodies import MADE
from tupli_mcap.server.routes.callers import Reader, Served
from tupli_mcap.server.stored.selection import EpisodeQuery, Selected, opened, select_episodes
from tupli_mcap.server.wire import REFUSALS

router = APIRouter(prefix="/v1", tags=["episodes"], responses=REFUSALS)


@router.post("/query", response_class=StreamingResponse, responses=MADE)
def query_episodes(
    library: Served, caller: Reader, told: Annotated[EpisodeQuery, Body()]
) -> StreamingResponse:
    """A recording of exactly the episodes of a query.

    Episodes of one recording (`Recording-Count: 1`) keep their numbers. Episodes of several recordings are merged, and
    numbered anew in the order of their times; if spaces differ, the error names two recordings. If states or actions
    are not among the fields, their spaces are empty.
    """
    left_out = told.left_out
    with library.database.reading() as connection:
        selected = select_episodes(connection, caller, library.items, told)
    return streamed(library, selected, left_out)


def streamed(
    library: Library, selected: Sequence[Selected], without: Collection[str] = ()
) -> StreamingResponse:
    """The answer that a recording of some episodes is, see `copies.streamed`."""
    headers = {
        "Content-Disposition": 'attachment; filename="episodes.mcap"',
        "Episode-Count": str(sum(len(each.numbers) for each in selected)),
        "Recording-Count": str(len(selected)),
    }
    return copies.streamed(opened(library.blobs, selected), without, **headers)
