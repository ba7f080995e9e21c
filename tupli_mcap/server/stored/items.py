"""Benchmarks and artifacts on a server. Every function works in the transaction of its caller.

Content that a user stores twice is one item. Two users who store the same content have an item each, and neither learns
of the other's.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Final, Literal, TypeVar

from sqlalchemy import Connection, Row, Select, delete, insert, select, update

from tupli_mcap import jsonvalue
from tupli_mcap.environment import sha256
from tupli_mcap.errors import StorageError
from tupli_mcap.schema import (
    ArtifactMetadata,
    ArtifactMetadataItem,
    BaseFilter,
    Benchmark,
    BenchmarkHeader,
    BenchmarkQuery,
    Right,
    compile_predicate,
)
from tupli_mcap.server.database import audience, audit, pend
from tupli_mcap.server.people import limits
from tupli_mcap.server.people.access import (
    Caller,
    DeniedError,
    as_told,
    demand_audience,
    left_alone,
    readable,
)
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.tables import AUDIT, ITEM
from tupli_mcap.storage.base import no_such, oldest_first, published_in
from tupli_mcap.storage.benchmark_json import artifacts_needed, plain
from tupli_mcap.storage.files.benchmarks import document_of, name_in
from tupli_mcap.storage.texts import is_hash

Kind = Literal["benchmark", "artifact"]
_Item = TypeVar("_Item", BenchmarkHeader, ArtifactMetadataItem)
_CREATE: Final = {"benchmark": Right.BENCHMARK_CREATE, "artifact": Right.ARTIFACT_CREATE}
_READ: Final = {"benchmark": Right.BENCHMARK_READ, "artifact": Right.ARTIFACT_READ}
_DELETE: Final = {"benchmark": Right.BENCHMARK_DELETE, "artifact": Right.ARTIFACT_DELETE}


class Items:
    """The benchmarks and artifacts that a caller may see."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    # --- benchmarks ---

    def store_benchmark(
        self, connection: Connection, caller: Caller, query: BenchmarkQuery
    ) -> BenchmarkHeader:
        """As `TupliStorage.store_benchmark`."""
        caller.demand(Right.BENCHMARK_CREATE, caller.name)
        uri, document, _ = document_of(query)
        own = self._own(connection, caller, "benchmark", uri)
        if not own:
            header = BenchmarkHeader.create_new(
                id=uri,
                hash=query.hash,
                metadata=query.metadata,
                created_by=caller.name,
                environment=name_in(document),
            )
            text = query.serialized
            needs, size = artifacts_needed(text), len(text.encode(errors="replace"))
            own = self._add(connection, caller, "benchmark", header, content=text, needs=needs, size=size)
        return _told(connection, caller, BenchmarkHeader, *own)[0]

    def load_benchmark(self, connection: Connection, caller: Caller, uri: str) -> Benchmark:
        """As `TupliStorage.load_benchmark`; NotFoundError also if the caller may not read it."""
        row = self._find(connection, caller, "benchmark", uri)
        content = connection.execute(select(ITEM.c.content).where(ITEM.c.number == row.number)).scalar_one()
        header = _told(connection, caller, BenchmarkHeader, row)[0]
        return Benchmark(**dict(header), serialized=content or "")

    def list_benchmarks(
        self, connection: Connection, caller: Caller, filter: BaseFilter | None
    ) -> list[BenchmarkHeader]:
        """The readable benchmarks that match a filter, oldest first."""
        matches = compile_predicate(filter, BenchmarkHeader)
        found = _told(connection, caller, BenchmarkHeader, *self._readable(connection, caller, "benchmark"))
        return oldest_first(header for header in found if matches(header))

    def delete_benchmark(self, connection: Connection, caller: Caller, uri: str) -> None:
        """Deletes the caller's own benchmark; with the right to, also one that others have published."""
        self._delete(connection, caller, "benchmark", uri)

    # --- artifacts ---

    def store_artifact(
        self, connection: Connection, caller: Caller, data: bytes, metadata: ArtifactMetadata
    ) -> ArtifactMetadataItem:
        """As `TupliStorage.store_artifact`; the bytes have to be kept under `artifact_key` before."""
        caller.demand(Right.ARTIFACT_CREATE, caller.name)
        uri = sha256(data)
        own = self._own(connection, caller, "artifact", uri)
        if not own:
            item = ArtifactMetadataItem.create_new(**dict(metadata), id=uri, hash=uri, created_by=caller.name)
            own = self._add(connection, caller, "artifact", item, size=len(data))
        return _told(connection, caller, ArtifactMetadataItem, *own)[0]

    def has_artifact(self, connection: Connection, caller: Caller, data: bytes) -> bool:
        """Whether a caller, who may store artifacts, has stored these bytes already."""
        caller.demand(Right.ARTIFACT_CREATE, caller.name)
        return bool(self._own(connection, caller, "artifact", sha256(data)))

    def load_artifact(self, connection: Connection, caller: Caller, uri: str) -> ArtifactMetadataItem:
        """The metadata of a readable artifact; its bytes are kept under `artifact_key`."""
        found = self._find(connection, caller, "artifact", uri)
        return _told(connection, caller, ArtifactMetadataItem, found)[0]

    def list_artifacts(
        self, connection: Connection, caller: Caller, filter: BaseFilter | None
    ) -> list[ArtifactMetadataItem]:
        """The readable artifacts that match a filter, oldest first."""
        matches = compile_predicate(filter, ArtifactMetadataItem)
        rows = self._readable(connection, caller, "artifact")
        found = _told(connection, caller, ArtifactMetadataItem, *rows)
        return oldest_first(item for item in found if matches(item))

    def artifact_users(self, connection: Connection, caller: Caller, uri: str) -> list[str]:
        """The ids of the readable benchmarks that need a readable artifact."""
        self._find(connection, caller, "artifact", uri)
        return [
            row.id for row in self._readable(connection, caller, "benchmark") if uri in json.loads(row.needs)
        ]

    def delete_artifact(self, connection: Connection, caller: Caller, uri: str, *, force: bool) -> None:
        """Deletes the caller's own artifact; with the right to, also one that others have published. StorageError if a
        benchmark of its owners needs it, unless `force`."""
        doomed = self._doomed(connection, caller, "artifact", uri)
        owners = [row.created_by for row in doomed]
        if not force:
            of_owners = select(ITEM.c.id, ITEM.c.needs).where(
                ITEM.c.kind == "benchmark", ITEM.c.created_by.in_(owners)
            )
            users = [row.id for row in connection.execute(of_owners) if uri in json.loads(row.needs)]
            if users:
                seen = {row.id for row in self._readable(connection, caller, "benchmark")}
                known = [user for user in users if user in seen]
                by = f"benchmark {', '.join(known)}" if known else "a private benchmark of its owner"
                raise StorageError(f"artifact {uri} is needed by {by}; delete that first, or pass force=True")
        self._delete(connection, caller, "artifact", uri)

    # --- both ---

    def deleted_of(self, connection: Connection, owner: str) -> set[str]:
        """The ids of a user's items that were deleted at some time."""
        deleted = select(AUDIT.c.target).where(AUDIT.c.action.in_(("delete_benchmark", "delete_artifact")))
        targets = (target.partition(" of ") for target in connection.execute(deleted).scalars())
        return {uri for uri, _, of in targets if of == owner}

    def forget_unseen(self, connection: Connection) -> list[str]:
        """Deletes items that only deleted users could see; returns the names of files to delete."""
        unseen = left_alone(ITEM.c.created_by, ITEM.c.published_in)
        rows = connection.execute(select(ITEM.c.number, ITEM.c.kind, ITEM.c.id).where(unseen)).all()
        for row in rows:
            connection.execute(delete(ITEM).where(ITEM.c.number == row.number))
        names = [artifact_key(row.id) for row in rows if row.kind == "artifact"]
        for name in names:
            pend(connection, name)
        return names

    def publish(self, connection: Connection, caller: Caller, kind: Kind, uri: str, group: str) -> None:
        """Lets a group see the caller's own item. Doing it twice changes nothing."""
        row = self._find(connection, caller, kind, uri)
        if row.created_by != caller.name:
            raise DeniedError(f"{kind} {uri} is somebody else's; only its owner may publish it")
        groups = published_in(json.loads(row.published_in), group)
        demand_audience(connection, caller, _CREATE[kind], group)
        self._set_audience(connection, row, groups)
        audit(connection, caller.name, f"publish_{kind}", f"{uri} in {group}")

    def unpublish(self, connection: Connection, caller: Caller, kind: Kind, uri: str, group: str) -> None:
        """Hides an item from a group. The owner may; whoever has the right to delete in that group hides all readable
        ones of this id."""
        may = caller.may(_DELETE[kind], group)
        visible = self._visible(connection, caller, kind, uri)
        rows = [row for row in visible if may or row.created_by == caller.name]
        if not rows:
            self._find(connection, caller, kind, uri)
            raise DeniedError(f"Insufficient permissions in group: {group}. Required: {_DELETE[kind]}")
        for row in rows:
            groups = json.loads(row.published_in)
            if group in groups:
                self._set_audience(connection, row, [name for name in groups if name != group])
                audit(connection, caller.name, f"unpublish_{kind}", f"{uri} from {group}")

    def _set_audience(self, connection: Connection, row: Row[Any], groups: list[str]) -> None:
        text = audience(connection, groups)
        connection.execute(update(ITEM).where(ITEM.c.number == row.number).values(published_in=text))

    def _add(
        self,
        connection: Connection,
        caller: Caller,
        kind: Kind,
        item: BenchmarkHeader | ArtifactMetadataItem,
        *,
        content: str | None = None,
        needs: Sequence[str] = (),
        size: int,
    ) -> Sequence[Row[Any]]:
        header = json.dumps(plain(item))
        size += len(header)
        limits.demand_room(connection, self._settings, caller, size)
        row = {
            "kind": kind,
            "id": item.id,
            "created_by": caller.name,
            "published_in": audience(connection, item.published_in),
            "header": header,
            "content": content,
            "needs": json.dumps(list(needs)),
            "size": size,
        }
        connection.execute(insert(ITEM).values(**row))
        audit(connection, caller.name, f"store_{kind}", item.id)
        return self._own(connection, caller, kind, item.id)

    def _own(self, connection: Connection, caller: Caller, kind: Kind, uri: str) -> Sequence[Row[Any]]:
        """The caller's item of an id, if there is one."""
        own = _COLUMNS.where(ITEM.c.kind == kind, ITEM.c.id == uri, ITEM.c.created_by == caller.name)
        return connection.execute(own).all()

    def _visible(self, connection: Connection, caller: Caller, kind: Kind, uri: str) -> list[Row[Any]]:
        """The readable items of an id, the caller's own one first."""
        if not is_hash(uri):
            return []
        seen = readable(caller, _READ[kind], ITEM.c.created_by, ITEM.c.published_in)
        of_id = _COLUMNS.where(ITEM.c.kind == kind, ITEM.c.id == uri, seen).order_by(ITEM.c.number)
        return sorted(connection.execute(of_id).all(), key=lambda row: row.created_by != caller.name)

    def _find(self, connection: Connection, caller: Caller, kind: Kind, uri: str) -> Row[Any]:
        found = self._visible(connection, caller, kind, uri)
        if not found:
            raise no_such(kind, uri)
        return found[0]

    def _readable(self, connection: Connection, caller: Caller, kind: Kind) -> list[Row[Any]]:
        """One item for each readable id: the caller's own, or else the oldest."""
        seen = readable(caller, _READ[kind], ITEM.c.created_by, ITEM.c.published_in)
        rows = connection.execute(_COLUMNS.where(ITEM.c.kind == kind, seen).order_by(ITEM.c.number)).all()
        chosen: dict[str, Row[Any]] = {}
        for row in sorted(rows, key=lambda row: row.created_by != caller.name):
            chosen.setdefault(row.id, row)
        return list(chosen.values())

    def _doomed(self, connection: Connection, caller: Caller, kind: Kind, uri: str) -> list[Row[Any]]:
        """The items to delete: the caller's own one, or else, with the right to, all readable ones of this id.
        NotFoundError if there is none, DeniedError if the caller may read it, but not delete it."""
        found = self._visible(connection, caller, kind, uri)
        if found and found[0].created_by == caller.name:
            return found[:1]
        if found and caller.may(_DELETE[kind]):
            return found
        self._find(connection, caller, kind, uri)
        raise DeniedError(f"{kind} {uri} is somebody else's; only its owner may delete it")

    def _delete(self, connection: Connection, caller: Caller, kind: Kind, uri: str) -> None:
        for row in self._doomed(connection, caller, kind, uri):
            connection.execute(delete(ITEM).where(ITEM.c.number == row.number))
            audit(connection, caller.name, f"delete_{kind}", f"{uri} of {row.created_by}")
        if kind == "artifact":
            pend(connection, artifact_key(uri))


_COLUMNS: Final[Select[Any]] = select(
    ITEM.c.number, ITEM.c.id, ITEM.c.created_by, ITEM.c.published_in, ITEM.c.header, ITEM.c.needs
)


def artifact_key(uri: str) -> str:
    """The name under which the bytes of an artifact are kept."""
    return f"artifacts/{uri}"


def _told(connection: Connection, caller: Caller, model: type[_Item], *rows: Row[Any]) -> list[_Item]:
    """Items as the caller is told of them."""
    found = [
        model.model_validate({**jsonvalue.loads(row.header), "published_in": json.loads(row.published_in)})
        for row in rows
    ]
    return as_told(connection, caller, found)
