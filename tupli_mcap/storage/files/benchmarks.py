"""Benchmarks in a directory: `<id>.json` is the `benchmark.json` document, `<id>.cloudpickle` the
environment if it has no spec."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from pydantic import ValidationError

from tupli_mcap.environment import EnvironmentRecord, canonical_json, sha256
from tupli_mcap.errors import FormatError, NotFoundError, StorageError, warn
from tupli_mcap.jsonvalue import is_unicode
from tupli_mcap.schema import (
    BaseFilter,
    Benchmark,
    BenchmarkHeader,
    BenchmarkMetadata,
    BenchmarkQuery,
    compile_predicate,
)
from tupli_mcap.schema.times import iso_utc
from tupli_mcap.storage.atomic import Lock, os_errors, read_bytes, write_bytes
from tupli_mcap.storage.base import LOCAL_USER, no_such, oldest_first, published_in
from tupli_mcap.storage.benchmark_json import (
    artifacts_of,
    benchmark_entry,
    benchmark_hash,
    edits_of,
    header_of,
    pack,
    plain,
    restored,
    unpack,
)
from tupli_mcap.storage.texts import first_defect, is_hash, to_json

_Edits: TypeAlias = Sequence[Mapping[str, Any]]


class BenchmarkFiles:
    """The benchmarks of a directory. Several processes may use it at once."""

    def __init__(self, directory: Path, lock: Lock) -> None:
        self._directory = directory
        self._lock = lock

    def store(self, query: BenchmarkQuery) -> BenchmarkHeader:
        metadata = restored(plain(query.metadata))
        uri, document, pickle = document_of(query)
        path = self._path(uri)
        with self._lock, os_errors("cannot store the benchmark", path):
            with contextlib.suppress(NotFoundError, FormatError):  # a damaged one is stored anew
                self.load(uri)
                return self.header(uri)
            header = BenchmarkHeader.create_new(
                id=uri, hash=query.hash, metadata=metadata, created_by=LOCAL_USER
            )
            document["benchmark"] = {**(document.get("benchmark") or {}), **benchmark_entry(header)}
            if pickle is not None:
                write_bytes(self._pickle_path(uri), pickle)
            write_bytes(path, to_json(document))  # last: the benchmark is there once this is
        return header.model_copy(update={"environment": name_in(document)})

    def load(self, uri: str) -> Benchmark:
        document = self._read(uri)
        header = self._header(uri, document)
        if document.get("environment") is None:
            serialized = str(document.get("serialized", ""))
            self._demand(uri, _foreign_id(header.hash, serialized, header.stored_metadata))
        else:
            serialized = self._serialized(uri, header)
        stored = Benchmark(
            **{**header.model_dump(), "metadata": header.stored_metadata}, serialized=serialized
        )
        return stored.edited(dict(header.metadata))

    def header(self, uri: str) -> BenchmarkHeader:
        return self._header(uri, self._read(uri))

    def list(self, filter: BaseFilter | str | None) -> list[BenchmarkHeader]:
        matches = compile_predicate(filter, BenchmarkHeader)
        headers = []
        for path in sorted(self._directory.glob("*.json")):
            try:
                headers.append(self.header(path.stem))
            except NotFoundError:
                pass  # deleted since, or not a benchmark's name
            except (FormatError, StorageError) as err:
                warn(f"skipped a benchmark: {err}")
        return oldest_first(header for header in headers if matches(header))

    def delete(self, uri: str) -> None:
        with self._lock:
            path = self._find(uri)
            with os_errors("cannot delete the benchmark", path):
                path.unlink(missing_ok=True)
                self._pickle_path(uri).unlink(missing_ok=True)

    def publish(self, uri: str, publish_in: str) -> None:
        with self._lock:
            document = self._read(uri)
            header = self._header(uri, document)
            document["benchmark"]["published_in"] = published_in(header.published_in, publish_in)
            with os_errors("cannot publish the benchmark", self._path(uri)):
                write_bytes(self._path(uri), to_json(document))

    def edit(self, uri: str, changes: Mapping[str, str], by: str, *, dry_run: bool) -> BenchmarkHeader:
        """Changes the metadata that are shown. The stored metadata, and the id, stay."""
        are_texts = all(isinstance(text, str) and is_unicode(text) for text in changes.values())
        if not changes or not are_texts or not changes.get("name", "x").strip():
            raise StorageError(
                f"expected a name or a description of the benchmark, found {dict(changes)!r:.100}"
            )
        edit = {**changes, "by": by, "at": iso_utc(time.time_ns())}
        return self._say(uri, lambda edits: (*edits, edit), dry_run)

    def undo_edit(self, uri: str, *, dry_run: bool) -> BenchmarkHeader:
        """Undoes the last edit."""

        def shortened(edits: _Edits) -> _Edits:
            if not edits:
                raise StorageError(f"benchmark {uri} has no edit to take back")
            return edits[:-1]

        return self._say(uri, shortened, dry_run)

    def _say(self, uri: str, change: Callable[[_Edits], _Edits], dry_run: bool) -> BenchmarkHeader:
        with self._lock:
            document = self._read(uri)
            self._header(uri, document)  # refuses a damaged one
            document["benchmark"]["edits"] = [*change(edits_of(document["benchmark"]))]
            if not dry_run:
                with os_errors("cannot edit the benchmark", self._path(uri)):
                    write_bytes(self._path(uri), to_json(document))
            return self._header(uri, document)

    def artifacts(self, uri: str) -> tuple[str, ...]:
        """The ids of the artifacts a benchmark needs."""
        entry = self._read(uri).get("benchmark")
        ids = entry.get("artifacts", []) if isinstance(entry, dict) else []
        return tuple(item for item in ids if is_hash(item)) if isinstance(ids, list) else ()

    def exists(self, uri: str) -> bool:
        return is_hash(uri) and self._path(uri).is_file()

    def _serialized(self, uri: str, header: BenchmarkHeader) -> str:
        path, beside = self._path(uri), self._pickle_path(uri)
        with os_errors("cannot read the benchmark", path):
            pickle = read_bytes(beside, sys.maxsize) if beside.exists() else None
            record = EnvironmentRecord.from_json(read_bytes(path), pickle, where=str(path))
        facts = dict(record.benchmark or {})
        artifacts = artifacts_of(record, str(path))
        serialized = pack(record, artifacts, facts)
        self._demand(uri, benchmark_hash(unpack(serialized, where=str(path)), header.stored_metadata))
        return serialized

    def _demand(self, uri: str, identity: str) -> None:
        """Raises FormatError if the content of a benchmark has another id."""
        if identity != uri:
            raise FormatError(
                f"{self._path(uri)}: expected the content of benchmark {uri}, found that of {identity}"
            )

    def _read(self, uri: str) -> dict[str, Any]:
        path = self._find(uri)
        with os_errors("cannot read the benchmark", path):
            data = read_bytes(path)
        try:
            document = json.loads(data)
        except (ValueError, RecursionError) as err:
            raise FormatError(f"{path}: expected JSON: {err}") from err
        if not isinstance(document, dict) or document.get("format") != "tupli_mcap.benchmark":
            raise FormatError(f"{path}: expected a benchmark document, found {data[:40]!r}")
        return document

    def _header(self, uri: str, document: dict[str, Any]) -> BenchmarkHeader:
        try:
            header = header_of(document.get("benchmark"))
        except (FormatError, ValidationError) as err:
            raise FormatError(f"{self._path(uri)}: expected a benchmark: {first_defect(err)}") from err
        if header.id != uri:
            raise FormatError(f"{self._path(uri)}: expected benchmark {uri}, found {header.id[:80]!r}")
        return header.model_copy(update={"environment": name_in(document)})

    def _find(self, uri: str) -> Path:
        if not self.exists(uri):
            raise no_such("benchmark", uri)
        return self._path(uri)

    def _path(self, uri: str) -> Path:
        return self._directory / f"{uri}.json"

    def _pickle_path(self, uri: str) -> Path:
        return self._directory / f"{uri}.cloudpickle"


def name_in(document: dict[str, Any]) -> str:
    """The name of the environment in a document."""
    environment = document.get("environment")
    name = environment.get("name") if isinstance(environment, dict) else ""
    return name if isinstance(name, str) else ""


def _foreign_id(told: str, serialized: str, metadata: BenchmarkMetadata) -> str:
    """The id of a benchmark whose text another program wrote, with the hash that it was told."""
    return sha256(canonical_json({"hash": told, "serialized": serialized, "metadata": plain(metadata)}))


def document_of(query: BenchmarkQuery) -> tuple[str, dict[str, Any], bytes | None]:
    """The id of a benchmark, its document without the header's fields, and its pickle.
    StorageError if its hash is not that of its content."""
    try:
        content = unpack(query.serialized)
    except FormatError:
        # A foreign text: kept unchanged, and never executed.
        if not is_unicode(query.serialized):
            raise StorageError("expected the text of a benchmark, found one with a lone surrogate") from None
        uri = _foreign_id(query.hash, query.serialized, query.metadata)
        document = {
            "format": "tupli_mcap.benchmark",
            "version": 1,
            "environment": None,
            "serialized": query.serialized,
        }
        return uri, document, None
    uri = benchmark_hash(content, query.metadata)
    if query.hash != uri:
        raise StorageError(f"expected the hash {uri} of the benchmark's content, found {query.hash[:80]!r}")
    return uri, json.loads(content.record.to_json()), content.record.pickle
