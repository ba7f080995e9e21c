"""The routes for viewers: an episode as a file for Rerun; for Foxglove's remote data loader, the recordings of a query,
and their bytes.

The loader passes on the parameters of a view's address (`&ds.filter=…&ds.recording=…`, or the ticket of a query), and
the user's bearer token if it has one. It always gets all fields, also if a query selects some.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple
from urllib.parse import quote, urlencode

from fastapi import APIRouter, Body, Depends, HTTPException, Query, Request, Response
from fastapi.responses import FileResponse, StreamingResponse
from pydantic import BaseModel

from tupli_mcap.errors import StorageError
from tupli_mcap.page.copies import replay_file, sent
from tupli_mcap.page.shelf import find_episode
from tupli_mcap.schema import parse_filter
from tupli_mcap.schema.times import iso_utc
from tupli_mcap.server.library import Library
from tupli_mcap.server.pages.shelf import LibraryShelf
from tupli_mcap.server.people.access import Caller
from tupli_mcap.server.routes.bodies import MADE
from tupli_mcap.server.routes.callers import Reader, Served, TicketHolder
from tupli_mcap.server.routes.query import streamed
from tupli_mcap.server.stored import episodes
from tupli_mcap.server.stored.selection import EpisodeQuery, Selected, opened, select_episodes
from tupli_mcap.server.wire import REFUSALS, Error

router = APIRouter(prefix="/v1", tags=["viewers"], responses=REFUSALS)
_LONGEST_TICKET = 4096
_MADE = 1  # to be increased when the same episodes give different bytes
_MARGIN_NS = 1_000_000


class Address(BaseModel):
    """The path of a manifest that can be read for a while without signing in."""

    path: str


class _Asked(NamedTuple):
    """The caller and the query, the given parameters that mean it, for the addresses in the manifest, and what the
    ticket says if there is one."""

    caller: Caller
    query: EpisodeQuery
    given: dict[str, str]
    ticket: Mapping[str, Any] | None


_RRD = {**MADE, 501: {"model": Error, "description": "The server has no rerun-sdk."}}


@router.get("/episodes/{uri}.rrd", response_class=Response, responses=_RRD)
def show_episode(request: Request, library: Served, holder: TicketHolder, uri: str) -> FileResponse:
    """An episode with its blueprint, for the Rerun viewer. A ticket for its recording is enough."""
    shelf = LibraryShelf(library, holder.caller, "", request.app.state.kept)
    header = shelf.ask(lambda connection: find_episode(shelf, connection, uri))
    holder.of(header.recording)
    return sent(replay_file(shelf, [header]), f"{uri}.rrd")


@router.post("/query/tickets")
def open_query(library: Served, caller: Reader, told: Annotated[EpisodeQuery, Body()]) -> Address:
    """The manifest of a query, as this caller may read it, for programs that cannot sign in."""
    with library.database.reading() as connection:
        select_episodes(connection, caller, library.items, told)
    ticket = library.tokens.ticket(caller, query=told.model_dump(mode="json", exclude_none=True))
    if len(ticket) > _LONGEST_TICKET:
        raise StorageError("the query is too long for an address; ask for the same by a shorter filter")
    return Address(path=f"/v1/manifest?ticket={ticket}")


def _asked(
    holder: TicketHolder,
    ticket: Annotated[str | None, Query(max_length=_LONGEST_TICKET)] = None,
    filter: Annotated[str | None, Query(max_length=2000)] = None,
    benchmark_filter: Annotated[str | None, Query(max_length=2000)] = None,
    recording: Annotated[list[str] | None, Query(max_length=100)] = None,
) -> _Asked:
    if holder.ticket is not None:
        if "query" not in holder.ticket:
            raise StorageError("expected the ticket of a query, found that of a recording")
        query = EpisodeQuery.model_validate(holder.ticket["query"])
    else:
        query = EpisodeQuery(
            filter=None if filter is None else parse_filter(filter),
            benchmark_filter=None if benchmark_filter is None else parse_filter(benchmark_filter),
        )
    if recording is not None:
        known = query.recordings
        named = [name for name in recording if known is None or name in known]
        query = query.model_copy(update={"recordings": named})
    words = {"ticket": ticket, "filter": filter, "benchmark_filter": benchmark_filter}
    given = {name: word for name, word in words.items() if word is not None}
    return _Asked(holder.caller, query, given, holder.ticket)


_Wanted = Annotated[_Asked, Depends(_asked)]


@router.get("/manifest")
def manifest(library: Served, asked: _Wanted) -> dict[str, Any]:
    """The manifest for Foxglove: for each recording its file if all is selected, else a source made of episodes."""
    with library.database.reading() as connection:
        selected = select_episodes(connection, asked.caller, library.items, asked.query)
        files = [episodes.file_of(connection, asked.caller, each.name) for each in selected]
    sources: list[dict[str, Any]] = []
    for each, file in zip(selected, files, strict=True):
        if file.whole and len(each.numbers) == file.episodes:
            told = {"version": file.digest[:16]}  # the loader's cache key
            if asked.ticket is not None:
                told["ticket"] = library.tokens.ticket(asked.caller, of=asked.ticket, recording=file.name)
            url = f"files/{quote(file.name)}?{urlencode(told)}"
            sources.append({"url": url, "supportsRangeRequests": True})
            continue
        number = _id(each, file.digest)
        url = f"data?{urlencode({**asked.given, 'recording': each.name, 'id': number})}"
        sources.append({"url": url, "id": number, **_described(library, each)})
    name = selected[0].name.rpartition("/")[2] if len(selected) == 1 else f"{len(selected)} recordings"
    return {"name": name, "sources": sources}


@router.get("/data", response_class=StreamingResponse, responses=MADE)
def data(library: Served, asked: _Wanted, id: Annotated[str, Query(max_length=64)]) -> StreamingResponse:
    """The bytes of a source that a manifest has named."""
    with library.database.reading() as connection:
        selected = select_episodes(connection, asked.caller, library.items, asked.query)
        digest = episodes.file_of(connection, asked.caller, selected[0].name).digest
    if len(selected) > 1 or _id(selected[0], digest) != id:
        raise HTTPException(409, "these are other episodes by now; open them again")
    return streamed(library, selected)


def _id(selected: Selected, digest: str) -> str:
    """The id of a source, equal for equal bytes; the loader's cache key."""
    return hashlib.sha256(f"{_MADE} {digest} {sorted(selected.numbers)}".encode()).hexdigest()


def _described(library: Library, selected: Selected) -> dict[str, Any]:
    """The topics of a source, their schemas, and the time range of its messages."""
    with opened(library.blobs, [selected]) as excerpts:
        recording, rows, *_ = excerpts[0]
        contents, store = recording.file.contents, recording.file.store
        channels = [channel for channel in contents.channels.values() if store.count(channel.id)]
        schemas = [contents.schemas[number] for number in sorted({c.schema_id for c in channels})]
    return {
        "topics": [
            {"name": c.topic, "messageEncoding": c.message_encoding, "schemaId": c.schema_id}
            for c in channels
        ],
        "schemas": [
            {"id": s.id, "name": s.name, "encoding": s.encoding, "data": base64.b64encode(s.data).decode()}
            for s in schemas
        ],
        # a picture is taken before its reset or step returns
        "startTime": iso_utc(int(rows["start_time"].min()) - _MARGIN_NS),
        "endTime": iso_utc(int(rows["end_time"].max()) + _MARGIN_NS),
    }
