"""Artifacts in a directory: `<sha256>` holds the bytes, `<sha256>.json` their metadata."""

from __future__ import annotations

import contextlib
from pathlib import Path

from pydantic import ValidationError

from tupli_mcap.environment import sha256
from tupli_mcap.errors import FormatError, StorageError, warn
from tupli_mcap.jsonvalue import loads
from tupli_mcap.schema import ArtifactMetadata, ArtifactMetadataItem, BaseFilter, compile_predicate
from tupli_mcap.storage.atomic import Lock, os_errors, read_bytes, write_bytes
from tupli_mcap.storage.base import LOCAL_USER, no_such, oldest_first, published_in
from tupli_mcap.storage.benchmark_json import plain, restored
from tupli_mcap.storage.texts import first_defect, is_hash, to_json


class ArtifactFiles:
    """The artifacts of a directory. Several processes may use it at once."""

    def __init__(self, directory: Path, lock: Lock) -> None:
        self._directory = directory
        self._lock = lock

    def store(self, artifact: bytes, metadata: ArtifactMetadata) -> ArtifactMetadataItem:
        if not isinstance(artifact, bytes | bytearray | memoryview):
            raise StorageError(f"expected the bytes of an artifact, found {type(artifact).__name__}")
        data = bytes(artifact)
        uri = sha256(data)
        path, sidecar = self._directory / uri, self._sidecar(uri)
        with self._lock, os_errors("cannot store the artifact", sidecar):
            item = ArtifactMetadataItem.create_new(
                **{**restored(plain(metadata)), "id": uri, "hash": uri, "created_by": LOCAL_USER}
            )
            # The bytes first: a crash in between leaves bytes that nothing names.
            if not path.is_file() or path.read_bytes() != data:
                write_bytes(path, data)
            with contextlib.suppress(FormatError):  # damaged: written anew
                if sidecar.exists():
                    return self._read(sidecar)
            self._write(sidecar, item)
        return item

    def load(self, uri: str) -> bytes:
        path = self.path(uri)
        with os_errors("cannot read the artifact", path):
            data = path.read_bytes()
        if sha256(data) != uri:
            raise FormatError(
                f"{path}: expected bytes with SHA-256 {uri}, found {sha256(data)}: the file is damaged"
            )
        return data

    def item(self, uri: str) -> ArtifactMetadataItem:
        """The metadata of an artifact; raises NotFoundError if there are none, as for bytes that nothing names."""
        self.path(uri)
        if not self._sidecar(uri).exists():
            raise no_such("artifact", uri)
        return self._read(self._sidecar(uri))

    def list(self, filter: BaseFilter | str | None) -> list[ArtifactMetadataItem]:
        matches = compile_predicate(filter, ArtifactMetadataItem)
        items = []
        for sidecar in sorted(self._directory.glob("*.json")):
            try:
                items.append(self._read(sidecar))
            except (FormatError, StorageError) as err:
                warn(f"skipped an artifact: {err}")
        return oldest_first(item for item in items if matches(item))

    def delete(self, uri: str) -> None:
        with self._lock:
            path = self.path(uri)
            with os_errors("cannot delete the artifact", path):
                self._sidecar(uri).unlink(missing_ok=True)
                path.unlink(missing_ok=True)

    def publish(self, uri: str, publish_in: str) -> None:
        with self._lock:
            item = self.item(uri)
            groups = published_in(item.published_in, publish_in)
            with os_errors("cannot publish the artifact", self._sidecar(uri)):
                self._write(self._sidecar(uri), item.model_copy(update={"published_in": groups}))

    def path(self, uri: str) -> Path:
        """The file of an artifact; raises NotFoundError if there is none."""
        path = self._directory / uri if is_hash(uri) else None
        if path is None or not path.is_file():
            raise no_such("artifact", uri)
        return path

    def _sidecar(self, uri: str) -> Path:
        return self._directory / f"{uri}.json"

    def _read(self, sidecar: Path) -> ArtifactMetadataItem:
        with os_errors("cannot read the artifact", sidecar):
            text = read_bytes(sidecar)
        try:
            item = ArtifactMetadataItem.model_validate(loads(text))
        except (FormatError, ValidationError) as err:
            raise FormatError(f"{sidecar}: expected an artifact's metadata: {first_defect(err)}") from err
        if item.id != sidecar.stem:
            raise FormatError(
                f"{sidecar}: expected the metadata of artifact {sidecar.stem}, found {item.id[:80]!r}"
            )
        return item

    def _write(self, sidecar: Path, item: ArtifactMetadataItem) -> None:
        write_bytes(sidecar, to_json(plain(item)))
