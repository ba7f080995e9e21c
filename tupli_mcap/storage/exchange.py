"""From one storage to another: benchmarks with all that they need, and their episodes."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import NamedTuple

from tupli_mcap.errors import FormatError
from tupli_mcap.recording import Recording, rewrite_recording
from tupli_mcap.schema import ArtifactMetadata, BaseFilter, BenchmarkQuery, FilterEQ, FilterIN
from tupli_mcap.storage import bundles
from tupli_mcap.storage.api import TupliAPIClient
from tupli_mcap.storage.base import TupliStorage
from tupli_mcap.storage.benchmark_json import DOCUMENT_NAME, unpack

__all__ = ["Copied", "copy_benchmark", "publish_benchmark", "push_recording", "unpublish_benchmark"]


class Copied(NamedTuple):
    """How much was new to the storage it was copied to."""

    artifacts: int
    episodes: int


def copy_benchmark(
    source: TupliStorage, target: TupliStorage, uri: str, filter: BaseFilter | None = None
) -> Copied:
    """Copies a benchmark, its artifacts and its episodes (those a filter is true of) to another storage.

    What that has already stays as it is there; episodes keep their ids. Nothing of it is executed.

    Raises:
        NotFoundError: the source has no such benchmark, or an artifact of it is gone.
        StorageError: the target refuses it.
    """
    benchmark = source.load_benchmark(uri)
    artifacts = _copy_artifacts(source, target, benchmark.serialized)
    target.store_benchmark(
        BenchmarkQuery(
            hash=benchmark.hash, serialized=benchmark.serialized, metadata=benchmark.stored_metadata
        )
    )
    of_benchmark = FilterEQ(key="benchmark_id", value=uri)
    headers = source.list_episodes(of_benchmark if filter is None else of_benchmark & filter)
    held = {header.id for header in target.list_episodes(of_benchmark)}
    by_recording: dict[str, list[int]] = {}
    for header in headers:
        if header.id not in held:
            by_recording.setdefault(header.recording, []).append(header.episode)
    for name, numbers in by_recording.items():
        if isinstance(target, TupliAPIClient):  # which lets a recording that has grown take its place
            kept = [h.episode for h in headers if h.recording == name]
        else:
            kept = numbers
        path = target.new_recording_path(uri)
        with source.open_recording(name) as recording:
            whole = len(kept) == len(recording)
            rewrite_recording(recording, path, episodes=None if whole else kept)
        target.ingest(path)
    if isinstance(target, TupliAPIClient):
        target.flush()
    return Copied(artifacts, sum(map(len, by_recording.values())))


def _copy_artifacts(source: TupliStorage, target: TupliStorage, serialized: str) -> int:
    try:
        wanted = unpack(serialized).artifacts
    except FormatError:  # a benchmark of somebody else's making names none
        return 0
    held = {item.id for item in target.list_artifacts(FilterIN(key="id", value=wanted))}
    missing = [uri for uri in wanted if uri not in held]
    for uri in missing:
        data = source.load_artifact(uri)
        (item,) = source.list_artifacts(FilterEQ(key="id", value=uri))
        target.store_artifact(data, ArtifactMetadata.model_validate(item.model_dump()))
    return len(missing)


def push_recording(client: TupliAPIClient, path: Path) -> str:
    """Sends a recording to a server, before it the benchmark and the artifacts that it carries; returns its name there.

    Raises:
        FormatError: the file is damaged.
        StorageError: the server refuses it: its benchmark is neither stored there nor in the file.
    """
    with Recording(path) as recording:
        carries = bool(recording.benchmark_id) and DOCUMENT_NAME in recording.attachments
        if carries and not client.list_benchmarks(FilterEQ(key="id", value=recording.benchmark_id)):
            record, _, query = bundles.incoming(recording, path)
            for data, metadata in bundles.carried_artifacts(recording, record, path):
                client.store_artifact(data, metadata)
            client.store_benchmark(query)
    return client.push(path)


def publish_benchmark(client: TupliAPIClient, uri: str, group: str) -> int:
    """Lets a group see a benchmark, its artifacts, and the caller's episodes of it; returns how many these are."""
    client.publish_benchmark(uri, group)
    with contextlib.suppress(FormatError):  # a benchmark of somebody else's making names no artifacts
        for artifact in unpack(client.load_benchmark(uri).serialized).artifacts:
            client.publish_artifact(artifact, group)
    return client.publish_episodes(_own_episodes(client, uri), group)


def unpublish_benchmark(client: TupliAPIClient, uri: str, group: str) -> int:
    """Takes a benchmark and the caller's episodes of it away from a group; returns how many these are. Its artifacts
    stay: other benchmarks may need them."""
    episodes = client.unpublish_episodes(_own_episodes(client, uri), group)
    client.unpublish_benchmark(uri, group)
    return episodes


def _own_episodes(client: TupliAPIClient, uri: str) -> BaseFilter:
    me = client.whoami().username
    return FilterEQ(key="benchmark_id", value=uri) & FilterEQ(key="created_by", value=me)
