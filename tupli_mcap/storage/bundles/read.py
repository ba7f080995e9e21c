"""Imports a file into a storage: its benchmark, the artifacts, and the episodes that the storage lacks."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from tupli_mcap import trust as _trust
from tupli_mcap.environment import DOCUMENT_NAME
from tupli_mcap.errors import FormatError, RecordingError, StorageError, plural, warn
from tupli_mcap.files import create
from tupli_mcap.jsonvalue import dumps_plain, loads
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.recording import Recording, rewrite_recording
from tupli_mcap.recording.about.run import file_name, name_after
from tupli_mcap.recording.sign.sign import episodes_alike
from tupli_mcap.schema import ArtifactMetadata, BenchmarkQuery, FilterIN
from tupli_mcap.storage.atomic import fill, os_errors
from tupli_mcap.storage.base import by_recording, episode_id
from tupli_mcap.storage.benchmark_json import artifacts_of
from tupli_mcap.storage.bundles.carried import (
    carried_artifacts,
    carried_benchmark,
    carried_environment,
    checked_signature,
)
from tupli_mcap.storage.listing import scan
from tupli_mcap.storage.sidecar import Notes

if TYPE_CHECKING:
    from tupli_mcap.storage.files import FileStorage

_PIECE = 1 << 22
_LONGEST = 230  # bytes of a file's name: a number, and the endings of its notes and its journal, fit into 255


class Imported(NamedTuple):
    """The contents of a file, and how much of it was new to a storage, or would be; without a benchmark, its id and
    name are empty. `signed_by`: the fingerprint of the key, where a signature was required."""

    benchmark_id: str
    name: str
    episodes: int
    new_episodes: int
    artifacts: int
    new_artifacts: int
    signed_by: str | None


def read_bundle(
    storage: FileStorage,
    path: Path,
    *,
    trust: bool = False,
    require_signature: bool = False,
    signers: Sequence[str] = (),
    name: str = "",
    dry_run: bool = False,
) -> Imported:
    """Import a recording, with its benchmark and artifacts if it has a benchmark, into a storage.

    Nothing in the file is executed. Its environment can be rebuilt afterwards if this user made it, if it
    needs no trust, for as long as this user trusts the key that signed it, or with `trust=True`. Importing a
    file twice changes nothing. Episodes that were deleted beside the file are left out. Those that were deleted in the
    storage, and can be restored there, stay deleted; a warning says how many.

    require_signature: refuse it unless it is signed, by one of the `signers` if there are any (64 hex digits each),
        else by a key that this user trusts.
    name: its path or URL, where `path` is a copy.
    dry_run: check the whole file but its steps, and write nothing.

    Raises:
        SignatureError: A signature is required, and missing, not fitting, or of another key.
        FormatError: The file is damaged, or its contents are not what its benchmark says.
        RecordingError: It is being recorded.
        StorageError: It lacks its benchmark, or an artifact; or the storage holds episodes of this recording already,
            with other contents.
    """
    with Recording(path) as recording:  # what is refused leaves nothing behind
        deleted = _deleted_beside(recording, path)
        signature = checked_signature(recording, require_signature, signers)
        carried = _Carried.by(recording, path, storage)
        new, deleted_there = _missing(storage, recording, deleted)
        say_what_was_deleted(deleted_there, storage.root)
        say_what_differs(_differing(storage, recording, deleted))
        imported = Imported(
            benchmark_id=carried.benchmark_id,
            name=carried.name,
            episodes=len(recording) - len(deleted),
            new_episodes=len(new),
            artifacts=len(carried.needed),
            new_artifacts=len(set(carried.needed) - {item.id for item in storage.list_artifacts()}),
            signed_by=signature.fingerprint if require_signature and signature else None,
        )
        if dry_run:
            return imported
        for data, metadata in carried.artifacts:
            storage.store_artifact(data, metadata)
        if carried.digest and trust:
            _trust.trust(carried.digest)
        elif carried.digest and signature is not None and signature.trusted:
            _trust.vouch(carried.digest, signature.public_key)
        with storage.import_lock:
            if carried.query is not None:
                storage.store_benchmark(carried.query)

            def check(copy: Recording) -> None:
                if require_signature:
                    checked_signature(copy, True, signers)
                if _Carried.by(copy, path, storage).benchmark_id != carried.benchmark_id:
                    raise FormatError(
                        f"{path} was replaced by another bundle while it was imported; import that"
                    )

            target = place_for(storage, carried.benchmark_id, name or str(path))
            _copy(storage, recording, target, check, deleted)
    return imported


class _Carried(NamedTuple):
    """What a file brings besides its episodes; all of it is empty if it carries no environment, and all but the digest
    if it has no benchmark.

    Attributes:
        digest: of its environment.
        name: of its benchmark, as it was last renamed.
        needed: the ids of the artifacts that its benchmark needs, of which the file carries `artifacts`.
    """

    digest: str = ""
    benchmark_id: str = ""
    name: str = ""
    query: BenchmarkQuery | None = None
    needed: Sequence[str] = ()
    artifacts: Sequence[tuple[bytes, ArtifactMetadata]] = ()

    @classmethod
    def by(cls, recording: Recording, path: Path, storage: FileStorage) -> _Carried:
        if recording.benchmark_id:
            record, header, query = carried_benchmark(recording, path)
            artifacts = carried_artifacts(recording, record, path, storage)
            needed = artifacts_of(record, str(path))
            return cls(record.digest, header.id, header.metadata.name, query, needed, artifacts)
        has_environment = DOCUMENT_NAME in recording.attachments
        return cls(carried_environment(recording, path).digest) if has_environment else cls()


def place_for(storage: FileStorage, benchmark_id: str, name: str) -> Path:
    """An unused path for a recording that is copied into a storage from a path or a URL. With a benchmark, the name of
    its run is part of it, or of its file; without one, it keeps its file's name, or the first part of a long one:
    `run.mcap`, or `run-2.mcap`. Dots that would hide it go, and what is no UTF-8."""
    if benchmark_id:
        return storage.new_recording_path(benchmark_id, name_after(name))
    stem = file_name(name).removesuffix(".mcap").encode(errors="ignore").decode().lstrip(".") or "recording"
    stem = stem.encode()[:_LONGEST].decode(errors="ignore")
    place = storage.root / "recordings"
    others = (place / f"{stem}-{number}.mcap" for number in itertools.count(2))
    return next(
        each for each in itertools.chain([place / f"{stem}.mcap"], others) if not os.path.lexists(each)
    )


def restorable(storage: FileStorage) -> set[str]:
    """The ids of deleted episodes that a storage can restore: in another file they would come back twice. A recording
    that cannot be read brings none back."""
    found: set[str] = set()
    for item in scan(storage.root):
        with contextlib.suppress(FormatError, RecordingError):
            found.update(storage.deleted_episodes({item.relative}))
    return found


def say_what_was_deleted(episodes: int, directory: Path | None) -> None:
    """Warns of episodes that are not copied, as they were deleted at the target; `directory`: where they can be
    restored."""
    if episodes:
        hint = "" if directory is None else f"; `tupli-mcap restore {directory}` restores them"
        warn(f"not copied: {plural(episodes, 'episode')} that had been deleted there{hint}")


def say_what_differs(episodes: int, hint: str = "") -> None:
    """Warns of episodes that the target has with other metadata: it does not get those of the source."""
    if episodes:
        warn(f"there already with other metadata, and left so: {plural(episodes, 'episode')}{hint}")


def _differing(storage: FileStorage, recording: Recording, left_out: Collection[int]) -> int:
    """How many of its episodes, without some, the storage has with other metadata."""
    texts = dict(zip(recording.index["episode"].tolist(), recording.all_metadata(), strict=True))
    ids = [episode_id(recording.uuid, number) for number in texts if number not in left_out]
    held = storage.list_episodes(FilterIN(key="id", value=ids))
    return sum(dumps_plain(header.metadata) != dumps_plain(loads(texts[header.episode])) for header in held)


def _deleted_beside(recording: Recording, path: Path) -> set[int]:
    """Numbers of the episodes of a file that were deleted. RecordingError if more of them may still come."""
    if not recording.complete and is_locked(path):
        raise RecordingError(f"{path} is being recorded; import it when its writer has closed it")
    return Notes.read(path).about(recording.metadata).deleted & set(recording.index["episode"].tolist())


def _missing(storage: FileStorage, recording: Recording, left_out: Collection[int]) -> tuple[list[int], int]:
    """Numbers of the episodes that the storage lacks, without some, and how many others it can restore. StorageError if
    it holds other episodes with the same ids."""
    numbers = [number for number in recording.index["episode"].tolist() if number not in left_out]
    ids = {episode_id(recording.uuid, number): number for number in numbers}
    known = by_recording(storage.list_episodes(FilterIN(key="id", value=list(ids))))
    stored_numbers = {name: [header.episode for header in headers] for name, headers in known.items()}
    for name, numbers in stored_numbers.items():
        with storage.open_recording(name) as stored:
            if not _same_file(recording, stored) and not episodes_alike(
                recording, stored, numbers, storage.root
            ):
                raise StorageError(
                    f"episodes of the recording {recording.uuid} are in {str(storage.root)!r} already, with other "
                    f"contents: {name!r} differs from {recording.name!r}; delete the one that is wrong, and compact "
                    "the storage"
                )
    held = {number for numbers in stored_numbers.values() for number in numbers}
    missing = {uri: number for uri, number in ids.items() if number not in held}
    deleted = missing.keys() & restorable(storage) if missing else set()
    return [number for uri, number in missing.items() if uri not in deleted], len(deleted)


def _same_file(one: Recording, other: Recording) -> bool:
    """Whether two finished files have the same bytes."""
    if not (one.complete and other.complete and one.size == other.size):
        return False
    return all(a == b for a, b in zip(_pieces(one), _pieces(other), strict=True))


def _pieces(recording: Recording) -> Iterator[bytes]:
    for start in range(0, recording.size, _PIECE):
        yield recording.file.source.read(start, min(_PIECE, recording.size - start))


class _NothingNewError(Exception):
    pass


def _copy(
    storage: FileStorage,
    recording: Recording,
    target: Path,
    check: Callable[[Recording], None],
    left_out: Collection[int],
) -> None:
    """Copy the episodes that the storage does not hold yet into a new file of it, without some.

    Others may change the file at any time. So it is copied to where nobody else can write: `check` is called with the
    copy, and the copy goes into the storage.
    """
    try:
        with os_errors("cannot import", target), fill(target) as new:
            if recording.complete:
                recording.file.source.refresh()  # as it is now, whole
                with os.fdopen(create(new), "wb") as file:
                    file.writelines(_pieces(recording))
            else:
                rewrite_recording(recording, new)  # with what is in its journal
            with Recording(new) as copy:
                check(copy)
                missing, _ = _missing(storage, copy, left_out)
                if not missing:
                    raise _NothingNewError
                if len(missing) < len(copy):
                    rewrite_recording(copy, new, episodes=missing)
    except _NothingNewError:
        return
    storage.ingest(target)
