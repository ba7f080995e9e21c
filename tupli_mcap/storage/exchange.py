"""Copies benchmarks, with everything that they need, and their episodes from one storage to another."""

from __future__ import annotations

import contextlib
import shlex
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from tupli_mcap import trust
from tupli_mcap.environment import DOCUMENT_NAME
from tupli_mcap.errors import NotFoundError, RecordingError, StorageError, TupliError, bytes_of, plural, warn
from tupli_mcap.jsonvalue import dumps_plain
from tupli_mcap.progress import Progress, progress
from tupli_mcap.recording import Recording, rewrite_recording
from tupli_mcap.recording.about.run import file_name
from tupli_mcap.recording.signature_file import SIGNATURE_NAME
from tupli_mcap.remote import shown_name
from tupli_mcap.schema import (
    ArtifactMetadata,
    BaseFilter,
    BenchmarkQuery,
    EpisodeHeader,
    FilterEQ,
    FilterIN,
)
from tupli_mcap.storage.api import TupliAPIClient
from tupli_mcap.storage.api.answers import Shared, is_of_all
from tupli_mcap.storage.api.outbox import Waiting
from tupli_mcap.storage.api.recordings import without_deleted
from tupli_mcap.storage.api.upload import Sent
from tupli_mcap.storage.atomic import fill, os_errors
from tupli_mcap.storage.base import TupliStorage, anew, by_recording, episode_id, no_such
from tupli_mcap.storage.benchmark_json import artifacts_needed
from tupli_mcap.storage.bundles import carried_artifacts, carried_benchmark, checked_signature
from tupli_mcap.storage.bundles.read import place_for, restorable, say_what_differs, say_what_was_deleted
from tupli_mcap.storage.files import FileStorage

_ASKED: Final = 1000  # episodes, to find a recording on a server


class Copied(NamedTuple):
    """Numbers of items that were new to the target, or would be."""

    artifacts: int
    episodes: int


def copy_episodes(
    source: TupliStorage,
    target: TupliStorage,
    filter: BaseFilter | None = None,
    *,
    benchmark_id: str | None = None,
    dry_run: bool = False,
    refused: dict[str, TupliError] | None = None,
) -> dict[str, Copied]:
    """Copies the episodes that match a filter to another storage, with their benchmarks and what these need; only
    those of one benchmark if it is named. Without a filter, benchmarks without episodes are copied, too.

    Items that the target has stay unchanged; episodes keep their ids. Nothing is executed. In a directory, an
    environment is trusted if it was before, or as long as a key is trusted that signed one of its recordings, which has
    to be copied whole for that.

    Args:
        refused: gets what could not be copied, by name, and why: recordings, with their own error or that of their
            benchmark, and benchmarks without episodes. All others are copied. None: the first such error is raised.

    Returns:
        By benchmark, how much was copied. A warning tells how many episodes the target has with other metadata (from an
        annotation, for example), and names benchmarks that the source lacks, or an artifact of them;
        their episodes are not copied.

    Raises:
        NotFoundError: the source lacks the named benchmark, or an artifact of it.
        StorageError: the target refuses it.
    """
    return anew(lambda: _copy(source, target, filter, benchmark_id, refused, dry_run=dry_run))


def _copy(
    source: TupliStorage,
    target: TupliStorage,
    filter: BaseFilter | None,
    benchmark_id: str | None,
    refused: dict[str, TupliError] | None,
    *,
    dry_run: bool,
) -> dict[str, Copied]:
    wanted: dict[str, list[EpisodeHeader]] = {}
    chosen = filter
    if benchmark_id is not None:
        wanted[benchmark_id] = []
        of_it = FilterEQ(key="benchmark_id", value=benchmark_id)
        chosen = of_it if filter is None else of_it & filter
    elif filter is None:
        wanted = {header.id: [] for header in source.list_benchmarks()}
    listed = {header.id: header for header in source.list_episodes(chosen)}  # a server may list one twice
    for header in listed.values():
        wanted.setdefault(header.benchmark_id, []).append(header)
    deleted = _deleted_at(target)
    into = target if isinstance(target, FileStorage) else None
    # as an import does: nobody else brings the same episodes meanwhile
    alone = into.import_lock if into and not dry_run else contextlib.nullcontext()
    copied, differ, left = {}, 0, 0
    for uri, headers in wanted.items():
        try:
            artifacts = _copy_benchmark(source, target, uri, dry_run=dry_run) if uri else 0
        except NotFoundError as err:
            if uri == benchmark_id:
                raise
            # somebody has published the episodes without their benchmark, which must not keep the others away
            of_user = isinstance(source, TupliAPIClient) and headers
            hint = f"; ask {headers[0].created_by} to publish it" if of_user else ""
            warn(f"not copied: {plural(len(headers), 'episode')}: {err}{hint}")
            continue
        except TupliError as err:
            if refused is None or is_of_all(err):
                raise
            refused |= dict.fromkeys(by_recording(headers) or [f"benchmarks/{uri}.json"], err)
            continue
        with alone:
            held = {each.id: each for each in target.list_episodes(FilterEQ(key="benchmark_id", value=uri))}
            absent = [header for header in headers if header.id not in held]
            new = [header for header in absent if header.id not in deleted]
            taken, gone = (len(new), 0) if dry_run else _copy_recordings(source, target, uri, new, refused)
            if uri and into and not dry_run:
                _vouch(into, uri)
        differ += sum(_differs(header, held[header.id]) for header in headers if header.id in held)
        left += len(absent) - len(new) + gone
        copied[uri] = Copied(artifacts, taken)
    hint = "; `tupli-mcap push FILE` sends a recording anew" if isinstance(target, TupliAPIClient) else ""
    say_what_differs(differ, hint)
    say_what_was_deleted(left, into.root if into else None)
    return copied


def _copy_recordings(
    source: TupliStorage,
    target: TupliStorage,
    benchmark_id: str,
    headers: Sequence[EpisodeHeader],
    refused: dict[str, TupliError] | None,
) -> tuple[int, int]:
    """Copies listed episodes; returns how many the target has taken, and how many it would not take again."""
    taken = left = 0
    groups = by_recording(headers)
    with progress(len(groups), f"copying {plural(len(groups), 'recording')}") as bar:
        for done, (name, of) in enumerate(groups.items()):
            bar.reach(done)
            with _kept(name, refused):
                brought = _copy_recording(
                    source, target, benchmark_id, name, [each.episode for each in of], bar
                )
                taken += brought
                left += len(of) - brought
    return taken, left


@contextlib.contextmanager
def _kept(name: str, refused: dict[str, TupliError] | None) -> Iterator[None]:
    """Keeps an error of the block in `refused`. It raises what all recordings would meet, and NotFoundError: something
    was deleted meanwhile, and `anew` lists again."""
    try:
        yield
    except TupliError as err:
        if refused is None or isinstance(err, NotFoundError) or is_of_all(err):
            raise
        refused[name] = err


def _deleted_at(target: TupliStorage) -> set[str]:
    """The ids of deleted episodes that a storage would not take again, or that it can restore."""
    if isinstance(target, TupliAPIClient):
        return target.deleted_episodes()
    return restorable(target) if isinstance(target, FileStorage) else set()


def _differs(here: EpisodeHeader, there: EpisodeHeader) -> bool:
    return dumps_plain(here.metadata) != dumps_plain(there.metadata)


def _copy_benchmark(source: TupliStorage, target: TupliStorage, uri: str, *, dry_run: bool) -> int:
    """Copies a benchmark and the artifacts that it needs; returns how many of these were new. On a server, the caller
    gets a copy of each: others may hide or delete theirs."""
    benchmark = source.load_benchmark(uri)
    wanted = artifacts_needed(benchmark.serialized)
    among: BaseFilter = FilterIN(key="id", value=list(wanted))
    if isinstance(target, TupliAPIClient):
        among = _own(target, among)
    held = {item.id for item in target.list_artifacts(among)}
    missing = [artifact for artifact in wanted if artifact not in held]
    if dry_run:
        return len(missing)
    for artifact in missing:
        data = source.load_artifact(artifact)
        items = source.list_artifacts(FilterEQ(key="id", value=artifact))
        if not items:  # its metadata are gone or damaged
            raise no_such("artifact", artifact)
        target.store_artifact(data, ArtifactMetadata.model_validate(items[0].model_dump()))
    told = benchmark.stored_metadata  # the metadata that its hash covers
    target.store_benchmark(
        BenchmarkQuery(hash=benchmark.hash, serialized=benchmark.serialized, metadata=told)
    )
    return len(missing)


def _copy_recording(
    source: TupliStorage, target: TupliStorage, uri: str, name: str, numbers: Sequence[int], bar: Progress
) -> int:
    """Copies episodes of a recording, of the benchmark `uri` if that is not empty; returns how many the target has
    taken."""
    with _file_with(source, name, numbers, bar) as path:
        if isinstance(target, TupliAPIClient):
            size = path.stat().st_size
            sent = target.send(path, lambda count: bar.advance(count / size), file_name(name))
            return _stored(target, sent.name)
        goal = (
            place_for(target, uri, name)
            if isinstance(target, FileStorage)
            else target.new_recording_path(uri)
        )
        with os_errors("cannot write", goal), fill(goal) as new:
            shutil.copyfile(path, new)
        target.ingest(goal)
    return len(numbers)


def _stored(client: TupliAPIClient, name: str) -> int:
    """How many episodes of a recording a server has: those that were deleted there are not stored again."""
    return client.count_episodes(FilterEQ(key="recording", value=name))


@contextlib.contextmanager
def _file_with(source: TupliStorage, name: str, numbers: Sequence[int], bar: Progress) -> Iterator[Path]:
    """A file with exactly these episodes of a recording: its own file, if that has no others."""
    if isinstance(source, TupliAPIClient):
        with source.downloaded(name, len(numbers), bar.advance) as path:
            if path is not None:
                yield path
                return
    with source.open_recording(name, numbers) as recording:
        path = recording.file.source.path
        if path is not None and recording.complete and len(numbers) == len(recording):
            yield path
            return
        with tempfile.TemporaryDirectory(prefix="tupli-mcap-") as folder:
            path = Path(folder) / "episodes.mcap"
            rewrite_recording(recording, path, episodes=numbers)
            yield path


def _vouch(target: FileStorage, uri: str) -> None:
    """Trusts the environment of a benchmark as long as a key is trusted that signed one of its recordings."""
    if not trust.trusted_keys():
        return
    for name in {
        header.recording for header in target.list_episodes(FilterEQ(key="benchmark_id", value=uri))
    }:
        with target.open_recording(name) as recording:
            if SIGNATURE_NAME in recording.attachments and DOCUMENT_NAME in recording.attachments:
                digest = carried_benchmark(recording, target.root / name)[0].digest
                if trust.is_trusted(digest):
                    return
                signature = checked_signature(recording, required=False)
                if signature is not None and signature.trusted:
                    trust.vouch(digest, signature.public_key)
                    return


class Pushed(NamedTuple):
    """A recording that was sent, or would be.

    Attributes:
        name: what the server calls it; empty if it was not sent.
        benchmark_id: of its benchmark; empty if it has none.
        episodes: how many it has there.
        was_there: the server had all of it.
    """

    name: str
    benchmark_id: str
    episodes: int
    was_there: bool


def push_recording(client: TupliAPIClient, path: Path, *, name: str = "", dry_run: bool = False) -> Pushed:
    """Sends a recording to a server, without its deleted episodes, after the benchmark and artifacts that it carries.
    `name`: its path or URL, where `path` is a copy.

    Raises:
        RecordingError: the recording is not finished, or has no episodes; nothing was sent.
        FormatError: the file is damaged.
        StorageError: the server refuses it: its benchmark is neither stored there nor in the file.
    """
    with without_deleted(path, name) as kept, Recording(kept) as recording:
        if not len(recording):
            hint = (
                ""
                if kept == path
                else f"; tupli-mcap restore {shlex.quote(str(path))} brings deleted ones back"
            )
            raise RecordingError(
                f"expected episodes to send, found none in {shown_name(name or str(path))}{hint}"
            )
        if recording.benchmark_id and DOCUMENT_NAME in recording.attachments:
            _send_carried(client, recording, path, dry_run=dry_run)
        if dry_run:
            found = _stored_as(client, recording)
            there = found if found and client.is_stored(found, kept) else ""
            if not there:
                ids = {episode_id(recording.uuid, number) for number in recording.index["episode"].tolist()}
                taken = len(ids - client.deleted_episodes())
                say_what_was_deleted(len(recording) - taken, None)
                return Pushed("", recording.benchmark_id, taken, False)
            sent = Sent(there, was_there=True)
        else:
            with progress(kept.stat().st_size, f"sending {shown_name(str(path))}", in_bytes=True) as bar:
                sent = client.send(kept, bar.advance, file_name(name) if name else path.name)
        stored = _stored(client, sent.name)
        say_what_was_deleted(len(recording) - stored, None)
        return Pushed(sent.name, recording.benchmark_id, stored, sent.was_there)


def demand_room(client: TupliAPIClient, url: str, size: int) -> None:
    """Raises StorageError if nobody is signed in, or if the caller's quota has no room for a recording at a URL and the
    server has nothing of it: what it has already needs no room."""
    me = client.whoami()
    if me.quota is None or (me.used or 0) + size <= me.quota:
        return
    with Recording(url) as recording:
        if not _stored_as(client, recording):
            raise StorageError(
                f"{shown_name(url)} has {bytes_of(size)}, and {me.username} may store {bytes_of(me.quota)}, of which "
                f"{bytes_of(me.used or 0)} are used; delete artifacts or whole recordings, or ask the server's admin "
                f"for a larger quota (tupli-mcap set-quota {me.username})"
            )


def _stored_as(client: TupliAPIClient, recording: Recording) -> str:
    """The name of a recording of the caller's on the server with one of the first episodes of this one; empty if there
    is none."""
    ids = [episode_id(recording.uuid, number) for number in recording.index["episode"][:_ASKED].tolist()]
    found = client.list_episodes(_own(client, FilterIN(key="id", value=ids)), limit=1)
    return found[0].recording if found else ""


def _send_carried(client: TupliAPIClient, recording: Recording, path: Path, *, dry_run: bool) -> None:
    """Stores the benchmark and artifacts that a recording carries, unless the caller has stored the benchmark. The
    caller gets a copy of somebody else's: they may hide or delete theirs. If the recording lacks an artifact, nothing
    is stored; StorageError then, unless the server has the benchmark."""
    of_id = FilterEQ(key="id", value=recording.benchmark_id)
    if client.list_benchmarks(_own(client, of_id)):
        return
    record, _, query = carried_benchmark(recording, path)
    try:
        artifacts = carried_artifacts(recording, record, path)
    except StorageError:
        if client.list_benchmarks(of_id):
            return
        raise
    if dry_run:
        return
    for data, metadata in artifacts:
        client.store_artifact(data, metadata)
    client.store_benchmark(query)


def send_waiting(client: TupliAPIClient, *, dry_run: bool = False) -> list[Waiting]:
    """Sends the recordings of a server that wait on this machine; returns those that waited.
    StorageError if the server does not answer, or refuses some of it."""
    waiting = client.waiting()
    if not dry_run:
        with progress(sum(each.size for each in waiting), "sending", in_bytes=True) as bar:
            client.flush(everything=True, tell=bar.advance)
    return waiting


def share_benchmark(
    client: TupliAPIClient,
    uri: str,
    group: str,
    chosen: BaseFilter | None = None,
    *,
    published: bool = True,
    dry_run: bool = False,
) -> Shared:
    """Publishes or hides what is the caller's of a benchmark, see `TupliAPIClient.share`. A warning tells of artifacts
    that are somebody else's and that the group cannot see."""
    shared = client.share(uri, chosen, group, published=published, dry_run=dry_run)
    if shared.unseen:
        warn(
            f"not published in {group}: {plural(shared.unseen, 'artifact')} of others that benchmark {uri[:8]} needs; "
            "only the owner may publish it"
        )
    return shared


def share_own(
    client: TupliAPIClient, group: str, chosen: BaseFilter, *, published: bool = True, dry_run: bool = False
) -> Shared:
    """Publishes or hides the caller's episodes that match a filter. A warning counts the published ones whose benchmark
    the group does not see."""
    shared = client.share(None, chosen, group, published=published, dry_run=dry_run)
    if not published:
        return shared
    hidden = [one.id for one in client.list_benchmarks() if {group, "global"}.isdisjoint(one.published_in)]
    count = client.count_episodes(_own(client, chosen) & FilterIN(key="benchmark_id", value=hidden))
    if count:
        warn(
            f"{plural(count, 'episode')} of these cannot be pulled by others, as the benchmark is not published in "
            f"{group}: tupli-mcap publish {hidden[0][:8] if len(hidden) == 1 else 'BENCHMARK_ID'}"
        )
    return shared


def _own(client: TupliAPIClient, chosen: BaseFilter) -> BaseFilter:
    return FilterEQ(key="created_by", value=client.whoami().username) & chosen
