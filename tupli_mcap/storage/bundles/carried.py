"""Checks what a recording carries besides its episodes: its benchmark, the benchmark's artifacts, the signature."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from tupli_mcap import trust as _trust
from tupli_mcap.environment import DOCUMENT_NAME, EnvironmentRecord, sha256
from tupli_mcap.errors import FormatError, SignatureError, StorageError, warn
from tupli_mcap.recording import Recording
from tupli_mcap.recording.check.signature import Signature, verify_signature
from tupli_mcap.recording.signature_file import SIGNATURE_NAME
from tupli_mcap.schema import ArtifactMetadata, BenchmarkHeader, BenchmarkQuery, FilterEQ
from tupli_mcap.storage.base import TupliStorage
from tupli_mcap.storage.benchmark_json import (
    ARTIFACT_PREFIX,
    artifacts_of,
    benchmark_hash,
    header_of,
    pack,
    restored,
    unpack,
)
from tupli_mcap.storage.texts import first_defect


def carried_environment(recording: Recording, path: Path) -> EnvironmentRecord:
    """The environment that a recording carries; raises StorageError if there is none, FormatError if it is damaged."""
    if DOCUMENT_NAME not in recording.attachments:
        raise StorageError(
            f"{str(path)!r} names a benchmark, but carries no environment ({DOCUMENT_NAME}); ask for a bundle, or copy "
            "it into the storage's directory, where its episodes are found (tupli-mcap verify checks it before)"
        )
    return recording.benchmark.record


def carried_benchmark(
    recording: Recording, path: Path
) -> tuple[EnvironmentRecord, BenchmarkHeader, BenchmarkQuery]:
    """The benchmark that a recording carries; raises StorageError if there is none, FormatError if its id is wrong."""
    record = carried_environment(recording, path)
    header = _header(record, path)
    query = BenchmarkQuery(
        hash=header.hash,
        serialized=pack(record, artifacts_of(record, str(path)), record.benchmark),
        metadata=header.stored_metadata,
    )
    if benchmark_hash(unpack(query.serialized), query.metadata) != header.id:
        raise FormatError(f"{path}: expected the content of benchmark {header.id}, found something else")
    return record, header, query


def _header(record: EnvironmentRecord, path: Path) -> BenchmarkHeader:
    if not (record.benchmark or {}).get("id"):
        raise StorageError(
            f"{str(path)!r} names a benchmark, but carries only an environment ({DOCUMENT_NAME}); ask for a bundle, or "
            "copy it into the storage's directory, where its episodes are found"
        )
    try:
        return header_of(record.benchmark)
    except ValidationError as err:
        raise FormatError(f"{path}: {DOCUMENT_NAME}: {first_defect(err)}") from err


def carried_artifacts(
    recording: Recording, record: EnvironmentRecord, path: Path, storage: TupliStorage | None = None
) -> list[tuple[bytes, ArtifactMetadata]]:
    """The artifacts that a recording carries, checked; raises StorageError if recording and storage both lack one."""
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


def checked_signature(recording: Recording, required: bool, signers: Sequence[str] = ()) -> Signature | None:
    """The checked signature of a recording to import; None if it has none, or if its signature does not fit.
    SignatureError if one is required, and is missing, does not fit, or is of another key."""
    if not required:
        known = _trust.trusted_keys() and SIGNATURE_NAME in recording.attachments
        try:
            return verify_signature(recording) if known else None
        except SignatureError as err:
            warn(f"imported as if it were not signed: {err}")
            return None
    signature = verify_signature(recording)
    if signature.public_key not in signers if signers else not signature.trusted:
        wanted = "one of the keys given" if signers else "a key that you trust (tupli-mcap trust --key)"
        raise SignatureError(
            f"{recording.name}: expected a signature of {wanted}, found {signature.fingerprint}"
        )
    return signature
