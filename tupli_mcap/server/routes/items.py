"""Benchmarks and artifacts; and what is published of a benchmark as a whole."""

from __future__ import annotations

import base64
from typing import Annotated

from fastapi import APIRouter, Body, Header, Request, Response
from starlette.concurrency import run_in_threadpool

from tupli_mcap.errors import StorageError
from tupli_mcap.schema import BenchmarkMetadata, BenchmarkQuery
from tupli_mcap.server.routes.bodies import BODY, body_of
from tupli_mcap.server.routes.callers import Reader, Served, Writer
from tupli_mcap.server.stored import sharing
from tupli_mcap.server.stored.items import artifact_key
from tupli_mcap.server.wire import (
    REFUSALS,
    Asked,
    AskedFilter,
    Listing,
    answer,
    artifact_metadata,
    demand_short,
    paged,
)
from tupli_mcap.storage.api.answers import Page, Shared
from tupli_mcap.storage.benchmark_json import restored
from tupli_mcap.storage.catalog.tables import RECORDING

router = APIRouter(prefix="/v1", tags=["benchmarks and artifacts"], responses=REFUSALS)


class Share(Asked):
    """What of the caller's own to publish in a group, or to unpublish: the episodes that match, and with the id of a
    benchmark only these of it, and itself with its artifacts. `dry_run` changes nothing, and answers the same."""

    group: str
    benchmark: str | None = None
    filter: AskedFilter | None = None
    published: bool = True
    dry_run: bool = False


@router.post("/share")
def share(library: Served, caller: Writer, told: Share) -> Shared:
    """Publishes what is the caller's own of a benchmark, or of all episodes, in a group, or unpublishes it: all, or
    none."""
    if told.benchmark is None and told.filter is None:
        raise StorageError("expected a benchmark, or a filter that says which episodes")
    benchmark, among = None, None
    with library.database.writing() as connection:
        if told.benchmark is not None:
            benchmark = library.items.load_benchmark(connection, caller, told.benchmark)
            among = RECORDING.c.benchmark_id == benchmark.id
        found = sharing.share(
            connection, library.items, caller, told.group, told.filter,
            published=told.published, benchmark=benchmark, among=among,
        )  # fmt: skip
        if told.dry_run:
            connection.rollback()
    return found


@router.post("/benchmarks")
def store_benchmark(library: Served, caller: Writer, told: BenchmarkQuery) -> Response:
    """Stores a benchmark, unless the caller has it already; answers with its header."""
    demand_short(told.metadata)
    metadata = BenchmarkMetadata.model_validate(restored(told.metadata.model_dump()))
    query = told.model_copy(update={"metadata": metadata})
    with library.database.writing() as connection:
        return answer(library.items.store_benchmark(connection, caller, query))


@router.post("/benchmarks/list", response_model=Page)
def list_benchmarks(library: Served, caller: Reader, told: Annotated[Listing, Body()]) -> Response:
    """The benchmarks that match a filter, oldest first."""
    with library.database.reading() as connection:
        found = library.items.list_benchmarks(connection, caller, told.filter)
    return paged(found, told, library.settings.max_page)


@router.get("/benchmarks/{uri}")
def load_benchmark(library: Served, caller: Reader, uri: str) -> Response:
    """A benchmark with its environment as text."""
    with library.database.reading() as connection:
        return answer(library.items.load_benchmark(connection, caller, uri))


@router.delete("/benchmarks/{uri}")
def delete_benchmark(library: Served, caller: Writer, uri: str, episodes: bool = False) -> Response:
    """Deletes a benchmark, and with `episodes` the caller's episodes of it too; `{"episodes": how many}`."""
    return answer({"episodes": library.delete_benchmark(caller, uri, with_episodes=episodes)})


@router.put("/benchmarks/{uri}/published")
def publish_benchmark(library: Served, caller: Writer, uri: str, group: str) -> None:
    """Lets a group see a benchmark."""
    with library.database.writing() as connection:
        library.items.publish(connection, caller, "benchmark", uri, group)


@router.delete("/benchmarks/{uri}/published")
def unpublish_benchmark(library: Served, caller: Writer, uri: str, group: str) -> None:
    """Hides a benchmark from a group."""
    with library.database.writing() as connection:
        library.items.unpublish(connection, caller, "benchmark", uri, group)


@router.post("/artifacts")
async def store_artifact(
    library: Served,
    caller: Writer,
    request: Request,
    metadata: Annotated[str, Header(alias="Artifact-Metadata", description="JSON in base64")],
) -> Response:
    """Stores the bytes of the body, unless the caller has them already; answers with their metadata."""
    try:
        text = base64.b64decode(metadata)
    except ValueError as err:
        raise StorageError(f"expected the metadata of an artifact in base64: {err}") from err
    told = artifact_metadata(text)
    data = await request.body()
    return answer(await run_in_threadpool(library.store_artifact, caller, data, told))


@router.post("/artifacts/list", response_model=Page)
def list_artifacts(library: Served, caller: Reader, told: Annotated[Listing, Body()]) -> Response:
    """The artifacts that match a filter, oldest first."""
    with library.database.reading() as connection:
        found = library.items.list_artifacts(connection, caller, told.filter)
    return paged(found, told, library.settings.max_page)


@router.get("/artifacts/{uri}", response_class=Response, responses=BODY)
def load_artifact(library: Served, caller: Reader, request: Request, uri: str) -> Response:
    """The bytes of an artifact. Their SHA-256 is the `ETag`; with it in `If-None-Match`, the answer is 304."""
    with library.database.reading() as connection:
        item = library.items.load_artifact(connection, caller, uri)
    return body_of(library, request, artifact_key(item.id), digest=item.id)


@router.get("/artifacts/{uri}/users")
def artifact_users(library: Served, caller: Reader, uri: str) -> list[str]:
    """The ids of the benchmarks that need an artifact."""
    with library.database.reading() as connection:
        return library.items.artifact_users(connection, caller, uri)


@router.delete("/artifacts/{uri}")
def delete_artifact(library: Served, caller: Writer, uri: str, force: bool = False) -> None:
    """Deletes an artifact; with `force`, even one that a benchmark needs."""
    library.delete_artifact(caller, uri, force=force)


@router.put("/artifacts/{uri}/published")
def publish_artifact(library: Served, caller: Writer, uri: str, group: str) -> None:
    """Lets a group see an artifact."""
    with library.database.writing() as connection:
        library.items.publish(connection, caller, "artifact", uri, group)


@router.delete("/artifacts/{uri}/published")
def unpublish_artifact(library: Served, caller: Writer, uri: str, group: str) -> None:
    """Hides an artifact from a group."""
    with library.database.writing() as connection:
        library.items.unpublish(connection, caller, "artifact", uri, group)
