"""Recordings: sent as files (tus 1.0), fetched whole, in ranges, or cut to what the caller may read."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import re
from collections.abc import AsyncIterator
from typing import Annotated
from urllib.parse import quote, unquote

from fastapi import APIRouter, Body, Depends, Header, HTTPException, Request, Response
from starlette.concurrency import run_in_threadpool

from tupli_mcap.errors import StorageError
from tupli_mcap.page.answers import FILE_NAME, FOR_VIEWERS
from tupli_mcap.schema import Right
from tupli_mcap.server.library import Library
from tupli_mcap.server.people.access import Caller
from tupli_mcap.server.people.limits import FullError
from tupli_mcap.server.routes.bodies import BODY, MEDIA, body_of
from tupli_mcap.server.routes.callers import Reader, Served, TicketHolder, Writer
from tupli_mcap.server.routes.query import streamed
from tupli_mcap.server.stored import episodes
from tupli_mcap.server.stored.selection import EpisodeQuery, select_episodes
from tupli_mcap.server.uploads import Incoming, TooLargeError, Upload
from tupli_mcap.server.wire import REFUSALS, Asked
from tupli_mcap.storage.api.answers import Ticket
from tupli_mcap.storage.texts import is_hash

router = APIRouter(prefix="/v1", tags=["recordings"], responses=REFUSALS)
_TUS_VERSION = "1.0.0"
_TUS = {"Tus-Resumable": _TUS_VERSION}
_TUS_MEDIA = "application/offset+octet-stream"
_AT_ONCE = 1 << 20  # bytes that are written at a time


class Named(Asked):
    """A recording by its name, as in the headers of its episodes."""

    recording: str


# --- sending ---


def _demand_tus(request: Request) -> None:
    """Raises HTTPException for a request of another version of tus, or bytes that are announced as something else."""
    version = request.headers.get("Tus-Resumable", _TUS_VERSION)
    if version != _TUS_VERSION:
        detail = f"expected Tus-Resumable: {_TUS_VERSION}, found {version:.20}"
        raise HTTPException(412, detail, {"Tus-Version": _TUS_VERSION})
    media = request.headers.get("Content-Type", _TUS_MEDIA)
    if request.method == "PATCH" and media != _TUS_MEDIA:
        raise HTTPException(415, f"expected Content-Type: {_TUS_MEDIA}, found {media:.80}")


_BY_TUS = [Depends(_demand_tus)]


@router.options("/uploads", status_code=204)
def describe_uploads(library: Served) -> Response:
    """What tus can do here, and how large a recording may be."""
    able = {"Tus-Version": _TUS_VERSION, "Tus-Extension": "creation,termination"}
    return Response(
        status_code=204, headers={**_TUS, **able, "Tus-Max-Size": str(library.settings.max_upload)}
    )


@router.post(
    "/uploads",
    dependencies=_BY_TUS,
    status_code=201,
    response_class=Response,
    responses={
        200: {"description": "The caller has stored these bytes; `Recording` is their name, as URLs have it."}
    },
)
def begin_upload(
    library: Served,
    caller: Writer,
    upload_length: Annotated[int, Header(ge=1)],
    upload_metadata: Annotated[
        str,
        Header(
            description="`sha256` and the hex digits in base64; also `sent_before` and a number, where episodes "
            "with lower numbers were sent before, in parts: of these, what is not there any more stays deleted"
        ),
    ],
) -> Response:
    """Begins an upload, or continues the caller's upload of the same bytes. If the server has them already, the answer
    names the recording."""
    caller.demand(Right.EPISODE_CREATE, caller.name)
    if upload_length > library.settings.max_upload:
        raise TooLargeError(f"expected at most {library.settings.max_upload} bytes, found {upload_length}")
    told = _metadata(upload_metadata)
    digest = told.get("sha256", "")
    if not is_hash(digest):
        raise StorageError("expected Upload-Metadata with `sha256`: 64 lower-case hex digits, in base64")
    upload = library.begin_upload(caller, upload_length, digest, _number(told.get("sent_before", "0")))
    if isinstance(upload, str):
        return Response(status_code=200, headers={**_TUS, "Recording": quote(upload)})
    headers = {**_TUS, "Location": f"/v1/uploads/{upload.id}", "Upload-Offset": str(upload.offset)}
    return Response(status_code=201, headers=headers)


@router.head("/uploads/{upload_id}", dependencies=_BY_TUS, response_class=Response)
def ask_upload(library: Served, caller: Writer, upload_id: str) -> Response:
    """How much of an upload has arrived."""
    upload = _find(library, caller, upload_id)
    told = {"Upload-Offset": str(upload.offset), "Upload-Length": str(upload.length)}
    return Response(headers={**_TUS, **told, "Cache-Control": "no-store"})


@router.patch("/uploads/{upload_id}", dependencies=_BY_TUS, status_code=204)
async def go_on_with_upload(
    library: Served,
    caller: Writer,
    request: Request,
    upload_id: str,
    upload_offset: Annotated[int, Header(ge=0)],
    recording_name: Annotated[
        str,
        Header(description="the name of the file, as URLs have it; it becomes part of the recording's name"),
    ] = "",
) -> Response:
    """Adds bytes to an upload. The last ones store the recording; the header `Recording` is then its name (quoted)."""
    upload = await run_in_threadpool(_find, library, caller, upload_id)
    with library.uploads.writing(upload) as incoming:
        if incoming.offset != upload_offset:
            raise HTTPException(
                409, f"expected bytes from {incoming.offset} on", {"Upload-Offset": str(incoming.offset)}
            )
        try:
            await _append(incoming, request.stream())
        except FullError:  # without its bytes, it would only count as stored
            await run_in_threadpool(library.forget_upload, upload)
            raise
        told = {**_TUS, "Upload-Offset": str(incoming.offset)}
        if incoming.offset == upload.length:
            name = await run_in_threadpool(library.take_in, caller, incoming, unquote(recording_name))
            told["Recording"] = quote(name)
    return Response(status_code=204, headers=told)


@router.delete("/uploads/{upload_id}", dependencies=_BY_TUS, status_code=204)
def end_upload(library: Served, caller: Writer, upload_id: str) -> Response:
    """Deletes an upload."""
    library.forget_upload(_find(library, caller, upload_id))
    return Response(status_code=204, headers=_TUS)


def _find(library: Library, caller: Caller, upload_id: str) -> Upload:
    with library.database.reading() as connection:
        return library.uploads.find(connection, caller, upload_id)


async def _append(incoming: Incoming, pieces: AsyncIterator[bytes]) -> None:
    """Writes bytes as they arrive. If the client disconnects, the bytes until then are kept."""
    room = incoming.upload.length - incoming.offset
    coming, size, written = list[bytes](), 0, None
    try:
        async for piece in pieces:
            room -= len(piece)
            if room < 0:
                raise TooLargeError(f"expected {incoming.upload.length} bytes in all, found more")
            coming.append(piece)
            size += len(piece)
            if size >= _AT_ONCE:
                if written is not None:
                    await written
                written = asyncio.ensure_future(run_in_threadpool(incoming.write, coming))
                coming, size = [], 0
    finally:
        if written is not None:
            await written
        await run_in_threadpool(incoming.write, coming)


def _metadata(text: str) -> dict[str, str]:
    """The pairs of an `Upload-Metadata` header, without pairs whose value is not valid base64."""
    found = {}
    for pair in text.split(","):
        key, _, value = pair.strip().partition(" ")
        with contextlib.suppress(ValueError):
            found[key] = base64.b64decode(value, validate=True).decode(errors="replace")
    return found


def _number(text: str) -> int:
    if not re.fullmatch("[0-9]{1,10}", text):
        raise StorageError(f"expected `sent_before` in Upload-Metadata to be a number, found {text[:40]!r}")
    return int(text)


# --- fetching ---


@router.post("/tickets")
def open_recording(library: Served, caller: Reader, told: Annotated[Named, Body()]) -> Ticket:
    """An address at which programs that cannot sign in may read a recording for a while."""
    with library.database.reading() as connection:
        found = episodes.file_of(connection, caller, told.recording)
    ticket = library.tokens.ticket(caller, recording=found.name, digest=found.digest, whole=found.whole)
    path = f"/v1/files/{quote(found.name)}?ticket={ticket}"
    size, count = (found.size, found.episodes) if found.whole else (0, 0)
    return Ticket(path=path, whole=found.whole, digest=found.digest, size=size, episodes=count)


@router.get("/files/" + FILE_NAME, response_class=Response, responses=BODY)
@router.head("/files/" + FILE_NAME, response_class=Response)
def read_recording(library: Served, holder: TicketHolder, name: str, request: Request) -> Response:
    """The bytes of a recording, or ranges of them. Their SHA-256 is the `ETag`; `If-Match` is supported.

    If the holder of the ticket may not read all episodes, the answer is a recording of the others.
    """
    caller = holder.of(name)
    with library.database.reading() as connection:
        found = episodes.file_of(connection, caller, name)
        if not found.whole:
            query = EpisodeQuery(recordings=[found.name])
            selected = select_episodes(connection, caller, library.items, query)
    ticket = holder.ticket or {}
    if ticket.get("digest", found.digest) != found.digest or (ticket.get("whole") and not found.whole):
        raise HTTPException(412, "this has changed; open it again")
    if not found.whole:
        return _of_unknown_length() if request.method == "HEAD" else streamed(library, selected)
    file_name = name.rpartition("/")[2]
    body = body_of(library, request, found.place, digest=found.digest, file_name=file_name)
    if holder.ticket is not None:
        body.headers.update(FOR_VIEWERS)
    return body


def _of_unknown_length() -> Response:
    """The answer to a HEAD for what is made while it is sent."""
    answer = Response(media_type=MEDIA)
    del answer.headers["Content-Length"]
    return answer
