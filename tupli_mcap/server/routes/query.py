"""Episodes of any recordings as one recording."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Body
from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from tupli_mcap.recording.edit.stream import stream_excerpts
from tupli_mcap.server.library import Library
from tupli_mcap.server.routes.callers import Reader, Served
from tupli_mcap.server.selection import EpisodeQuery, Selected, opened, select_episodes

__all__ = ["router", "streamed"]

router = APIRouter(prefix="/v1", tags=["episodes"])
_MEDIA = "application/octet-stream"


@router.post("/query", response_class=StreamingResponse)
def query_episodes(
    library: Served, caller: Reader, told: Annotated[EpisodeQuery, Body()]
) -> StreamingResponse:
    """A recording of exactly the episodes that are meant.

    Of one recording (`Recording-Count: 1`) they keep their numbers. Those of several are merged: numbered anew, in the
    order of their times; where their spaces differ, the error names two that do.
    """
    with library.database.reading() as connection:
        selected = select_episodes(connection, caller, library.items, told)
    return streamed(library, selected)


def streamed(library: Library, selected: Sequence[Selected]) -> StreamingResponse:
    """The answer that a recording of some episodes is.

    Raises:
        SpaceError, RecordingError: they cannot be merged. What goes wrong later ends the connection.
    """
    pieces = stream_excerpts(opened(library.blobs, selected))
    first = next(pieces)
    headers = {
        "Content-Disposition": 'attachment; filename="episodes.mcap"',
        "Episode-Count": str(sum(len(each.numbers) for each in selected)),
        "Recording-Count": str(len(selected)),
    }
    return _Streamed(_after(first, pieces), media_type=_MEDIA, headers=headers)


def _after(first: bytes, pieces: Generator[bytes]) -> Generator[bytes]:
    yield first
    yield from pieces


class _Streamed(StreamingResponse):
    """An answer whose pieces are closed when it ends, also where its client goes away."""

    def __init__(self, pieces: Generator[bytes], **more: Any) -> None:
        super().__init__(pieces, **more)
        self._pieces = pieces

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._pieces.close()
