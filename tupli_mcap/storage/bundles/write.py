"""Writes a benchmark, its artifacts and its episodes into one file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tupli_mcap.environment import DOCUMENT_NAME
from tupli_mcap.errors import FormatError, NotFoundError, SpaceError, StorageError
from tupli_mcap.mcap.container import Container
from tupli_mcap.recording import Recording, rewrite_recording, write_recording
from tupli_mcap.recording.edit.assemble import replacing
from tupli_mcap.recording.edit.merge import Excerpt, UnmergeableError, check_mergeable, merge_excerpts
from tupli_mcap.recording.sign.sign import sign_recording
from tupli_mcap.remote import check_local
from tupli_mcap.schema import BaseFilter, BenchmarkHeader, BenchmarkMetadata, EpisodeHeader, FilterEQ, bound
from tupli_mcap.spaces.space_json import space_to_json
from tupli_mcap.storage.atomic import fill, os_errors
from tupli_mcap.storage.base import LOCAL_USER, TupliStorage, anew, by_recording
from tupli_mcap.storage.benchmark_json import (
    ARTIFACT_PREFIX,
    artifacts_of,
    attachments_of,
    benchmark_entry,
    benchmark_hash,
    declared_spaces,
    pack,
    plain,
    unpack,
)
from tupli_mcap.storage.bundles.carried import carried_environment
from tupli_mcap.storage.sidecar import Notes

if TYPE_CHECKING:
    from tupli_mcap.signing import SigningKey

Attachments = dict[str, tuple[str, bytes]]


def write_bundle(
    storage: TupliStorage,
    benchmark_id: str,
    target: Path,
    filter: BaseFilter | str | None = None,
    sign: SigningKey | None = None,
) -> Path:
    """Write a benchmark with its artifacts and its episodes (those that match a filter) into a new file.

    sign: the key to sign it with.

    Raises:
        NotFoundError: There is no such benchmark, or one of its artifacts is gone.
        StorageError: The file exists or cannot be written, or the episodes do not fit into one file.
    """
    _refuse_existing(target)
    attachments = _attachments(storage, benchmark_id)
    of_benchmark: BaseFilter = FilterEQ(key="benchmark_id", value=benchmark_id)
    wanted = of_benchmark if filter is None else of_benchmark & bound(filter, EpisodeHeader)

    def attempt() -> None:
        headers = storage.list_episodes(wanted)
        with os_errors("cannot write the bundle", target), fill(target) as temporary:
            _write_episodes(storage, benchmark_id, headers, temporary, attachments)
            if sign is not None:
                sign_recording(temporary, sign)

    anew(attempt)
    return target


def export_episodes(
    storage: TupliStorage, target: Path, filter: BaseFilter | str | None = None, *, dry_run: bool = False
) -> list[EpisodeHeader]:
    """Write the episodes that match a filter into the new recording `target`, without artifacts; returns them as the
    storage lists them.

    Args:
        dry_run: only check.

    Raises:
        StorageError: There are none, they are of several benchmarks, or the file exists or cannot be written.
    """
    check_local(target)
    _refuse_existing(target)
    headers = storage.list_episodes(filter)
    benchmarks = sorted({header.benchmark_id for header in headers})
    if len(benchmarks) != 1:
        raise StorageError(
            "expected episodes of one benchmark to export, "
            f"found {len(headers)} episodes of {len(benchmarks)}: "
            f"{', '.join(benchmarks)[:300] or 'nothing matches'}"
        )
    if dry_run:
        with _excerpts(storage, benchmarks[0], headers) as excerpts:
            check_mergeable(excerpts)
        return headers
    with os_errors("cannot export", target), fill(target) as temporary:
        _write_episodes(storage, benchmarks[0], headers, temporary, None)
    return headers


def bundle_recording(
    path: Path, target: Path, storage: TupliStorage | None = None, sign: SigningKey | None = None
) -> Path:
    """Write the episodes of one recording into a new file that carries its benchmark and all artifacts.

    A recording that was made outside a storage gets a benchmark: its environment, under the name that it has. One
    without an environment, such as that of a robot, gets none: its episodes are all that there is.

    Args:
        storage: has the parts that the recording lacks; None if it lacks none, like a bundle or a recording of an
            environment that needs no artifacts.
        sign: the key to sign it with; without it, a signature stays if nothing it covers changes.

    Raises:
        NotFoundError: The storage does not know the recording's benchmark.
        StorageError: Something is missing and no storage given; or the file exists or cannot be written.
    """
    _refuse_existing(target)
    notes = Notes.read(path)
    with Recording(path) as recording:
        deleted = notes.about(recording.metadata).deleted
        attachments: Attachments = {}
        benchmark_id = recording.benchmark_id
        if benchmark_id:
            record = recording.benchmark.record if DOCUMENT_NAME in recording.attachments else None
            named = () if record is None else artifacts_of(record, str(path))
            if record is None or any(ARTIFACT_PREFIX + uri not in recording.attachments for uri in named):
                if storage is None:
                    raise StorageError(
                        f"{str(path)!r} lacks artifacts of its benchmark {recording.benchmark_id}; "
                        "name the storage that has them"
                    )
                attachments = _attachments(storage, recording.benchmark_id)
        elif DOCUMENT_NAME in recording.attachments:
            benchmark_id, attachments = _own_benchmark(recording, path)
        kept = [int(number) for number in recording.index["episode"] if int(number) not in deleted]
        with os_errors("cannot write the bundle", target), fill(target) as temporary:
            chosen = kept if len(kept) < len(recording) else None
            rewrite_recording(
                recording, temporary, episodes=chosen, attachments=attachments, benchmark_id=benchmark_id
            )
            if sign is not None:
                sign_recording(temporary, sign)
    return target


def _own_benchmark(recording: Recording, path: Path) -> tuple[str, Attachments]:
    """The id of a benchmark made of a recording's environment alone, and the attachments for it."""
    record = carried_environment(recording, path)
    spaces = {"observation_space": recording.observation_space, "action_space": recording.action_space}
    facts = {name: space_to_json(space) for name, space in spaces.items()}
    metadata = BenchmarkMetadata(name=record.name)
    uri = benchmark_hash(unpack(pack(record)), metadata)
    header = BenchmarkHeader.create_new(id=uri, hash=uri, metadata=metadata, created_by=LOCAL_USER)
    document = record.to_json({**facts, "artifacts": [], **benchmark_entry(header)})
    return uri, {DOCUMENT_NAME: ("application/json", document)}


def _attachments(storage: TupliStorage, benchmark_id: str) -> Attachments:
    benchmark = storage.load_benchmark(benchmark_id)
    try:
        content = unpack(benchmark.serialized)
    except FormatError as err:
        raise StorageError(f"benchmark {benchmark_id} holds no environment that a bundle can carry") from err
    items = {uri: storage.list_artifacts(FilterEQ(key="id", value=uri)) for uri in content.artifacts}
    entry = {
        **(content.record.benchmark or {}),
        "artifact_metadata": {uri: plain(listed[0]) for uri, listed in items.items() if listed},
    }
    attachments = attachments_of(content.record, entry)
    for uri in content.artifacts:
        attachments[ARTIFACT_PREFIX + uri] = ("application/octet-stream", storage.load_artifact(uri))
    return attachments


def _refuse_existing(target: Path) -> None:
    if target.exists():
        raise StorageError(f"{str(target)!r} exists and is not overwritten; choose another path or delete it")


def _write_episodes(
    storage: TupliStorage,
    benchmark_id: str,
    headers: Sequence[EpisodeHeader],
    target: Path,
    attachments: Attachments | None,
) -> None:
    if not headers:
        spaces = declared_spaces(storage.load_benchmark(benchmark_id).serialized)
        if not spaces:
            raise StorageError(f"benchmark {benchmark_id} has no episodes, and its spaces are not known")
        write_recording(
            target,
            (),
            observation_space=spaces[0],
            action_space=spaces[1],
            benchmark_id=benchmark_id,
            attachments=attachments,
        )
        return
    with _excerpts(storage, benchmark_id, headers) as excerpts:
        if len(excerpts) == 1:
            ((recording, rows, *_),) = excerpts
            rewrite_recording(
                recording,
                target,
                episodes=rows["episode"].tolist(),
                attachments=attachments,
                benchmark_id=benchmark_id,
            )
            return
        with replacing(target) as (fd, _):
            merge_excerpts(excerpts, Container(fd, str(target), "zstd"), attachments=attachments or {})


@contextmanager
def _excerpts(
    storage: TupliStorage, benchmark_id: str, headers: Sequence[EpisodeHeader]
) -> Iterator[list[Excerpt]]:
    """The episodes by recording, open within the block, which raises StorageError if one file cannot hold them."""
    with ExitStack() as opened:
        excerpts = [
            _excerpt(opened.enter_context(storage.open_recording(name)), same)
            for name, same in by_recording(headers).items()
        ]
        try:
            yield excerpts
        except (SpaceError, UnmergeableError) as err:
            raise StorageError(
                f"the recordings of benchmark {benchmark_id} differ, so that one file cannot hold them all ({err}); "
                "use a filter on `recording`"
            ) from err


def _excerpt(recording: Recording, headers: Sequence[EpisodeHeader]) -> Excerpt:
    """The episodes of these headers. NotFoundError if one was deleted meanwhile."""
    numbers = [header.episode for header in headers]
    rows = recording.index[np.isin(recording.index["episode"], numbers)]
    if len(rows) < len(numbers):
        raise NotFoundError(f"an episode of {recording.name} was deleted meanwhile")
    return Excerpt(recording, rows)
