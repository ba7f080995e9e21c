"""Benchmarks as text, as in `BenchmarkQuery.serialized`, and the hash that identifies a benchmark."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import gymnasium as gym
from pydantic import BaseModel

from tupli_mcap.environment import (
    DOCUMENT_NAME,
    MAX_PICKLE,
    PICKLE_NAME,
    EnvironmentRecord,
    canonical_json,
    sha256,
)
from tupli_mcap.errors import FormatError, SpaceError, StorageError
from tupli_mcap.jsonvalue import dumps_plain, loads
from tupli_mcap.schema import BenchmarkHeader, BenchmarkMetadata
from tupli_mcap.spaces.leaves import own_space
from tupli_mcap.spaces.space_json import space_from_json, space_to_json
from tupli_mcap.storage.texts import is_hash

ARTIFACT_PREFIX = "artifacts/"
EDITABLE = ("name", "description")  # of a benchmark's metadata


class BenchmarkContent(NamedTuple):
    """An environment and the ids (SHA-256) of the artifacts that it needs, sorted."""

    record: EnvironmentRecord
    artifacts: tuple[str, ...]


def plain(model: BaseModel) -> dict[str, Any]:
    """A model as JSON-able dict: NumPy values become numbers and lists, NaN becomes `{"$float": "nan"}`.
    StorageError if a value has no JSON form."""
    try:
        value: dict[str, Any] = json.loads(dumps_plain(model.model_dump()))
    except (TypeError, ValueError) as err:
        raise StorageError(f"{type(model).__name__}: expected values that JSON can hold: {err}") from err
    return value


def benchmark_entry(header: BenchmarkHeader) -> dict[str, Any]:
    """A header as the `benchmark` entry of a document, whose `environment` entry has the name."""
    return {key: value for key, value in plain(header).items() if key != "environment"}


def header_of(entry: Any) -> BenchmarkHeader:
    """The header in the `benchmark` entry of a document, with its latest name and description.
    FormatError or ValidationError if the entry is no header."""
    header = BenchmarkHeader.model_validate(restored(entry))
    for edit in edits_of(entry):
        header = header.edited({key: edit[key] for key in EDITABLE if key in edit})
    return header


def edits_of(entry: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The edits of a benchmark's name and description, in order. FormatError if the entry holds something else."""
    said = entry.get("edits", [])
    if not isinstance(said, list) or not all(map(_is_edit, said)):
        raise FormatError(f"expected edits with a name or a description, found {said!r:.100}")
    return said


def _is_edit(said: Any) -> bool:
    return isinstance(said, dict) and all(isinstance(said.get(key, ""), str) for key in EDITABLE)


def restored(value: Any) -> Any:
    """The values that `plain` turned into JSON: `{"$float": "nan"}` becomes NaN again.
    FormatError if `plain` did not make this JSON."""
    return loads(json.dumps(value))


def benchmark_hash(content: BenchmarkContent, metadata: BenchmarkMetadata) -> str:
    """The identity of a benchmark: SHA-256 (64 hex digits) over its environment, artifacts and metadata."""
    return sha256(
        canonical_json(
            {
                "environment": content.record.digest,
                "artifacts": sorted(set(content.artifacts)),
                "metadata": plain(metadata),
            }
        )
    )


def pack(
    record: EnvironmentRecord, artifacts: Iterable[str] = (), facts: Mapping[str, Any] | None = None
) -> str:
    """The text of an environment: `benchmark.json` with the pickle inside, in base64. `facts` are added to
    its `benchmark` entry."""
    entry = {**(facts or {}), "artifacts": sorted(set(artifacts))}
    document = json.loads(record.to_json(entry))
    if record.pickle is not None:
        document["pickle"] = base64.b64encode(record.pickle).decode("ascii")
    return json.dumps(document, ensure_ascii=False)


def unpack(serialized: str, *, where: str = "the benchmark") -> BenchmarkContent:
    """Parse a text of `pack`; executes nothing. FormatError if it is something else."""
    try:
        document = json.loads(serialized)
        encoded = document.get("pickle") if isinstance(document, dict) else None
        pickle = None if encoded is None else base64.b64decode(encoded, validate=True)
    except (ValueError, TypeError, RecursionError, binascii.Error) as err:
        raise FormatError(f"{where}: expected a serialized benchmark: {err}") from err
    record = EnvironmentRecord.from_json(serialized.encode("utf-8", "replace"), pickle, where=where)
    return BenchmarkContent(record, artifacts_of(record, where))


def artifacts_needed(serialized: str) -> tuple[str, ...]:
    """The ids of the artifacts that a serialized benchmark needs; none if another program wrote its text."""
    try:
        return unpack(serialized).artifacts
    except FormatError:
        return ()


def artifacts_of(record: EnvironmentRecord, where: str) -> tuple[str, ...]:
    """The artifact ids that the `benchmark` entry of a document names. FormatError if they are no ids."""
    ids = (record.benchmark or {}).get("artifacts", [])
    if not isinstance(ids, list) or not all(is_hash(item) for item in ids):
        raise FormatError(f"{where}: expected artifacts named by 64 hex digits, found {str(ids)[:100]!r}")
    return tuple(sorted(set(ids)))


def facts_about(env: gym.Env[Any, Any]) -> dict[str, Any]:
    """Facts about an environment for the `benchmark` entry, besides its identity: its spaces, if they have JSON."""
    try:
        return {
            "observation_space": space_to_json(own_space(env.observation_space)),
            "action_space": space_to_json(own_space(env.action_space)),
        }
    except SpaceError:
        return {}


def declared_spaces(serialized: str) -> list[gym.Space[Any]]:
    """The observation and action space that a serialized benchmark declares; empty if it declares none."""
    try:
        facts = unpack(serialized).record.benchmark or {}
        return [space_from_json(facts[name]) for name in ("observation_space", "action_space")]
    except (FormatError, KeyError):
        return []


def recording_attachments(serialized: str) -> dict[str, tuple[str, bytes]]:
    """The attachments of a recording for its benchmark: name -> (media type, bytes).

    A pickle of more than 16 MiB stays in the storage, and is added when a bundle is made.
    """
    try:
        record = unpack(serialized).record
    except FormatError:
        return {}
    too_large = record.pickle is not None and len(record.pickle) > MAX_PICKLE
    return {} if too_large else attachments_of(record)


def attachments_of(
    record: EnvironmentRecord, entry: Mapping[str, Any] | None = None
) -> dict[str, tuple[str, bytes]]:
    """An environment as attachments; `entry` replaces its `benchmark` entry."""
    attachments = {DOCUMENT_NAME: ("application/json", record.to_json(entry))}
    if record.pickle is not None:
        attachments[PICKLE_NAME] = ("application/octet-stream", record.pickle)
    return attachments
