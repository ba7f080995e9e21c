"""Bundles: one recording that carries its benchmark and all artifacts, so that nothing else is needed."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pydantic import ValidationError

from tupli_mcap import trust as _trust
from tupli_mcap.environment import EnvironmentRecord, sha256
from tupli_mcap.errors import FormatError, NotFoundError, SignatureError, StepError, StorageError
from tupli_mcap.files import create
from tupli_mcap.messages.frames import EncodedFrame
from tupli_mcap.recording import EpisodeData, Recording, rewrite_recording, write_recording
from tupli_mcap.recording.check.signature import Signature, verify_signature
from tupli_mcap.recording.sign.sign import episodes_alike, sign_recording
from tupli_mcap.recording.signature_file import SIGNATURE_NAME
from tupli_mcap.recording.write.options import CAMERA
from tupli_mcap.schema import (
    ArtifactMetadata,
    BaseFilter,
    BenchmarkHeader,
    BenchmarkMetadata,
    BenchmarkQuery,
    EpisodeHeader,
    FilterEQ,
    FilterIN,
)
from tupli_mcap.spaces.space_json import space_to_json
from tupli_mcap.storage.atomic import fill, os_errors
from tupli_mcap.storage.base import LOCAL_USER, anew
from tupli_mcap.storage.benchmark_json import (
    ARTIFACT_PREFIX,
    DOCUMENT_NAME,
    PICKLE_NAME,
    artifacts_of,
    benchmark_entry,
    benchmark_hash,
    declared_spaces,
    header_of,
    pack,
    plain,
    restored,
    unpack,
)
from tupli_mcap.storage.recordings import episode_id
from tupli_mcap.storage.sidecar import Notes
from tupli_mcap.storage.texts import first_defect

if TYPE_CHECKING:
    from tupli_mcap.signing import SigningKey
    from tupli_mcap.storage.files import FileStorage

__all__ = [
    "ImportPreview",
    "carried_artifacts",
    "checked_signature",
    "export",
    "from_recording",
    "incoming",
    "preview",
    "read",
    "write",
]

_PIECE = 1 << 22

Attachments = dict[str, tuple[str, bytes]]


class ImportPreview(NamedTuple):
    """What a file holds, and how much of it a storage does not have yet."""

    benchmark_id: str
    name: str
    episodes: int
    new_episodes: int
    artifacts: int
    new_artifacts: int


def write(
    storage: FileStorage,
    benchmark_id: str,
    target: Path,
    filter: BaseFilter | None = None,
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
    wanted = of_benchmark if filter is None else of_benchmark & filter

    def attempt() -> None:
        headers = storage.list_episodes(wanted)
        with os_errors("cannot write the bundle", target), fill(target) as temporary:
            _write_episodes(storage, benchmark_id, headers, temporary, attachments)
            if sign is not None:
                sign_recording(temporary, sign)

    anew(attempt)
    return target


def export(storage: FileStorage, target: Path, filter: BaseFilter | None = None) -> Path:
    """Write the episodes that match a filter into the new recording `target`, without artifacts.

    Raises:
        StorageError: There are none, they are of several benchmarks, or the file exists or cannot be written.
    """
    _refuse_existing(target)
    headers = storage.list_episodes(filter)
    benchmarks = sorted({header.benchmark_id for header in headers})
    if len(benchmarks) != 1:
        raise StorageError(
            "expected episodes of one benchmark to export, "
            f"found {len(headers)} episodes of {len(benchmarks)}: "
            f"{', '.join(benchmarks)[:300] or 'nothing matches'}"
        )
    with os_errors("cannot export", target), fill(target) as temporary:
        _write_episodes(storage, benchmarks[0], headers, temporary, None)
    return target


def read(
    storage: FileStorage,
    path: Path,
    *,
    trust: bool = False,
    require_signature: bool = False,
    signers: Sequence[str] = (),
) -> str:
    """Take a recording with its benchmark and artifacts into a storage; returns the benchmark's id.

    Nothing in the file is executed. Its environment can be rebuilt afterwards if this user made it, if it
    needs no trust, for as long as this user trusts the key that signed it, or with `trust=True`. Importing a
    file twice changes nothing.

    require_signature: refuse it unless it is signed, by one of the `signers` if there are any (64 hex digits each),
        else by a key that this user trusts.

    Raises:
        SignatureError: A signature is required, and missing, not fitting, or of another key.
        FormatError: The file is damaged, or its contents are not what its benchmark says.
        StorageError: It carries no benchmark, or lacks an artifact; or the storage holds episodes of this recording
            already, with other contents.
    """
    with Recording(path) as recording:  # what is refused leaves nothing behind
        signature = checked_signature(recording, require_signature, signers)
        record, header, query = incoming(recording, path)
        _missing(storage, recording)
        for data, metadata in _read_artifacts(storage, recording, record, path):
            storage.store_artifact(data, metadata)
        if trust:
            _trust.trust(record.digest)
        elif signature is not None and signature.trusted:
            _trust.vouch(record.digest, signature.public_key)
        with storage.import_lock:
            storage.store_benchmark(query)

            def check(copy: Recording) -> None:
                if require_signature:
                    checked_signature(copy, True, signers)
                if incoming(copy, path)[1].id != header.id:
                    raise FormatError(
                        f"{path} was replaced by another bundle while it was imported; import that"
                    )

            _copy(storage, recording, header.id, check)
    return header.id


def checked_signature(recording: Recording, required: bool, signers: Sequence[str] = ()) -> Signature | None:
    """The signature of a recording that is to be imported, checked; None if nobody asks or it has none.

    Raises:
        SignatureError: One is required, and missing, not fitting, or of another key.
    """
    if not required:
        known = _trust.trusted_keys() and SIGNATURE_NAME in recording.attachments
        try:
            return verify_signature(recording) if known else None
        except SignatureError as err:
            warnings.warn(f"imported as if it were not signed: {err}", stacklevel=3)
            return None
    signature = verify_signature(recording)
    if signature.public_key not in signers if signers else not signature.trusted:
        wanted = "one of the keys given" if signers else "a key that you trust (tupli-mcap trust --key)"
        raise SignatureError(
            f"{recording.name}: expected a signature of {wanted}, found {signature.fingerprint}"
        )
    return signature


def preview(storage: FileStorage | None, path: Path) -> ImportPreview:
    """What `read` would do; checks the whole file but its steps, and writes nothing. Raises as `read` does.

    storage: None stands for an empty one.
    """
    with Recording(path) as recording:
        record, header, _ = incoming(recording, path)
        artifacts = artifacts_of(record, str(path))
        _read_artifacts(storage, recording, record, path)
        stored = set() if storage is None else {item.id for item in storage.list_artifacts()}
        return ImportPreview(
            benchmark_id=header.id,
            name=header.metadata.name,
            episodes=len(recording),
            new_episodes=len(_missing(storage, recording)),
            artifacts=len(artifacts),
            new_artifacts=len(set(artifacts) - stored),
        )


def from_recording(
    path: Path, target: Path, storage: FileStorage | None = None, sign: SigningKey | None = None
) -> Path:
    """Write the episodes of one recording into a new file that carries its benchmark and all artifacts.

    A recording that was made outside a storage gets a benchmark: its environment, under the name that it has.

    sign: the key to sign it with; without it, a signature stays where nothing it covers changes.

    storage: has what the recording lacks; None if it lacks nothing, as a bundle or a recording of a plain
    environment does.

    Raises:
        NotFoundError: The storage does not know the recording's benchmark.
        StorageError: The recording carries no environment; something is missing and no storage given; or the file
            exists or cannot be written.
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
        else:
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
    """The id of a benchmark that is a recording's environment and nothing else, and what a file carries of it."""
    record = _environment(recording, path)
    spaces = {"observation_space": recording.observation_space, "action_space": recording.action_space}
    facts = {name: space_to_json(space) for name, space in spaces.items()}
    metadata = BenchmarkMetadata(name=record.name)
    uri = benchmark_hash(unpack(pack(record)), metadata)
    header = BenchmarkHeader.create_new(id=uri, hash=uri, metadata=metadata, created_by=LOCAL_USER)
    document = record.to_json({**facts, "artifacts": [], **benchmark_entry(header)})
    return uri, {DOCUMENT_NAME: ("application/json", document)}


def incoming(recording: Recording, path: Path) -> tuple[EnvironmentRecord, BenchmarkHeader, BenchmarkQuery]:
    """The benchmark that a recording carries. StorageError if there is none, FormatError if it is not what it says."""
    record = _environment(recording, path)
    header = _header(record, path)
    query = BenchmarkQuery(
        hash=header.hash,
        serialized=pack(record, artifacts_of(record, str(path)), record.benchmark),
        metadata=header.stored_metadata,
    )
    if benchmark_hash(unpack(query.serialized), query.metadata) != header.id:
        raise FormatError(f"{path}: expected the content of benchmark {header.id}, found something else")
    return record, header, query


def _attachments(storage: FileStorage, benchmark_id: str) -> Attachments:
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
    attachments = {DOCUMENT_NAME: ("application/json", content.record.to_json(entry))}
    if content.record.pickle is not None:
        attachments[PICKLE_NAME] = ("application/octet-stream", content.record.pickle)
    for uri in content.artifacts:
        attachments[ARTIFACT_PREFIX + uri] = ("application/octet-stream", storage.load_artifact(uri))
    return attachments


def _refuse_existing(target: Path) -> None:
    if target.exists():
        raise StorageError(f"{str(target)!r} exists and is not overwritten; choose another path or delete it")


def _write_episodes(
    storage: FileStorage,
    benchmark_id: str,
    headers: Sequence[EpisodeHeader],
    target: Path,
    attachments: Attachments | None,
) -> None:
    names = sorted({header.recording for header in headers})
    if len(names) == 1:
        with storage.open_recording(names[0]) as recording:
            numbers = [header.episode for header in headers]
            rewrite_recording(
                recording, target, episodes=numbers, attachments=attachments, benchmark_id=benchmark_id
            )
        return
    reward_space = None
    drawn = False
    for name in names:
        with storage.open_recording(name) as recording:
            drawn = drawn or CAMERA in recording.cameras
    if names:
        with storage.open_recording(names[0]) as recording:
            spaces = [recording.observation_space, recording.action_space]
            reward_space = recording.layout.reward_space
            attachments = attachments or _carried(recording)
    else:
        spaces = declared_spaces(storage.load_benchmark(benchmark_id).serialized)
        if not spaces:
            raise StorageError(f"benchmark {benchmark_id} has no episodes, and its spaces are not known")
    try:
        write_recording(
            target,
            _episodes(storage, headers),
            observation_space=spaces[0],
            action_space=spaces[1],
            reward_space=reward_space,
            benchmark_id=benchmark_id,
            attachments=attachments,
            frames=drawn,
        )
    except StepError as err:
        raise StorageError(
            f"the recordings of benchmark {benchmark_id} differ in what they hold, so that one file cannot "
            f"take them all ({err}); use a filter on `recording`"
        ) from err


def _carried(recording: Recording) -> Attachments:
    """What a recording carries, without its signature, which is of its own episodes only."""
    return {
        name: (info.media_type, recording.read_attachment(name))
        for name, info in recording.attachments.items()
        if name != SIGNATURE_NAME
    }


def _episodes(storage: FileStorage, headers: Sequence[EpisodeHeader]) -> Iterator[EpisodeData]:
    """The episodes of several recordings as values, one recording open at a time."""
    for name, group in itertools.groupby(headers, key=lambda header: header.recording):
        with storage.open_recording(name) as recording:
            positions = {int(number): i for i, number in enumerate(recording.index["episode"])}
            for header in group:
                if header.episode not in positions:
                    raise NotFoundError(f"episode {header.id} was deleted meanwhile")
                episode = recording.episodes[positions[header.episode]]
                steps = list(episode)
                yield EpisodeData(
                    states=[step.state for step in steps],
                    actions=[step.action for step in steps],
                    rewards=[step.reward for step in steps],
                    terminals=[step.terminal for step in steps],
                    timeouts=[step.timeout for step in steps],
                    final_state=episode.final_state,
                    seed=episode.seed,
                    options=episode.options,
                    metadata=episode.metadata,
                    infos=None if episode.infos is None else [info or {} for info in episode.infos],
                    end=episode.end,
                    frames=_frames(recording, positions[header.episode]),
                )


def _frames(recording: Recording, position: int) -> list[tuple[int, EncodedFrame]]:
    if CAMERA not in recording.cameras:
        return []
    frames = recording.frames(position, CAMERA)
    return [(step, frames.encoded(i)) for i, step in enumerate(frames.steps.tolist())]


def _environment(recording: Recording, path: Path) -> EnvironmentRecord:
    if DOCUMENT_NAME not in recording.attachments:
        raise StorageError(
            f"{str(path)!r} carries no environment ({DOCUMENT_NAME}), so there is no benchmark of it; it is whole as "
            "it is: copy it into the storage's directory, where its episodes are found"
        )
    pickle = recording.read_attachment(PICKLE_NAME) if PICKLE_NAME in recording.attachments else None
    return EnvironmentRecord.from_json(
        recording.read_attachment(DOCUMENT_NAME), pickle, where=f"{path}: {DOCUMENT_NAME}"
    )


def _header(record: EnvironmentRecord, path: Path) -> BenchmarkHeader:
    if not (record.benchmark or {}).get("id"):
        raise StorageError(
            f"{str(path)!r} carries an environment, but no benchmark: it was recorded outside a storage; make a bundle "
            "of it (tupli-mcap bundle), or copy it into the storage's directory, where its episodes are found"
        )
    try:
        return header_of(record.benchmark)
    except ValidationError as err:
        raise FormatError(f"{path}: {DOCUMENT_NAME}: {first_defect(err)}") from err


def _read_artifacts(
    storage: FileStorage | None, recording: Recording, record: EnvironmentRecord, path: Path
) -> list[tuple[bytes, ArtifactMetadata]]:
    """The artifacts a recording carries, checked; what it lacks, the storage must have."""
    said = (record.benchmark or {}).get("artifact_metadata")
    facts = said if isinstance(said, dict) else {}
    artifacts = []
    for uri in artifacts_of(record, str(path)):
        if ARTIFACT_PREFIX + uri not in recording.attachments:
            if storage is not None and storage.list_artifacts(FilterEQ(key="id", value=uri)):
                continue
            raise StorageError(f"{str(path)!r} lacks the artifact {uri} of its benchmark; ask for a bundle")
        data = recording.read_attachment(ARTIFACT_PREFIX + uri)
        if sha256(data) != uri:
            raise FormatError(f"{path}: expected artifact {uri}, found bytes with SHA-256 {sha256(data)}")
        try:
            artifacts.append((data, ArtifactMetadata.model_validate(restored(facts.get(uri, {"name": uri})))))
        except ValidationError as err:
            raise FormatError(f"{path}: artifact {uri}: {first_defect(err)}") from err
    return artifacts


def carried_artifacts(
    recording: Recording, record: EnvironmentRecord, path: Path
) -> list[tuple[bytes, ArtifactMetadata]]:
    """The artifacts that a bundle carries, checked. StorageError if it lacks one."""
    return _read_artifacts(None, recording, record, path)


def _missing(storage: FileStorage | None, recording: Recording) -> list[int]:
    """Numbers of the episodes that the storage does not hold yet.

    Raises:
        StorageError: It holds others under their names.
    """
    ids = {episode_id(recording.uuid, int(number)): int(number) for number in recording.index["episode"]}
    if storage is None:
        return list(ids.values())
    stored_numbers: dict[str, list[int]] = {}
    for header in storage.list_episodes(FilterIN(key="id", value=list(ids))):
        stored_numbers.setdefault(header.recording, []).append(header.episode)
    for name, numbers in stored_numbers.items():
        with storage.open_recording(name) as stored:
            if not _same_file(recording, stored) and not episodes_alike(
                recording, stored, numbers, storage.root
            ):
                raise StorageError(
                    f"episodes of the recording {recording.uuid} are in {str(storage.root)!r} already, with other "
                    f"contents: {name!r} differs from {recording.name!r}; delete the one that is wrong"
                )
    held = {number for numbers in stored_numbers.values() for number in numbers}
    return [number for number in ids.values() if number not in held]


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
    storage: FileStorage, recording: Recording, benchmark_id: str, check: Callable[[Recording], None]
) -> None:
    """Copy the episodes that the storage does not hold yet.

    The file may be changed by others at any time. So what counts is a copy that nobody else can write to: `check` is
    made on it, and what it holds goes into the storage.
    """
    target = storage.new_recording_path(benchmark_id)
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
                missing = _missing(storage, copy)
                if not missing:
                    raise _NothingNewError
                if len(missing) < len(copy):
                    rewrite_recording(copy, new, episodes=missing)
    except _NothingNewError:
        return
    storage.ingest(target)
