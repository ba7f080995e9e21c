"""Publishes what is a caller's of a dataset: its benchmark with the artifacts, and the episodes.
Functions work in the transaction of their caller.
"""

from __future__ import annotations

from collections.abc import Set

from sqlalchemy import Connection
from sqlalchemy.sql.elements import ColumnElement

from tupli_mcap.errors import StorageError
from tupli_mcap.schema import ArtifactMetadataItem, BaseFilter, BenchmarkHeader, FilterEQ, FilterIN
from tupli_mcap.server.people.access import GLOBAL, Caller, DeniedError, demand_known
from tupli_mcap.server.stored import episodes
from tupli_mcap.server.stored.items import Items
from tupli_mcap.storage.api.answers import Shared
from tupli_mcap.storage.benchmark_json import artifacts_needed


def share(
    connection: Connection,
    items: Items,
    caller: Caller,
    group: str,
    chosen: BaseFilter | None,
    *,
    published: bool,
    benchmark: BenchmarkHeader | None = None,
    among: ColumnElement[bool] | None = None,
) -> Shared:
    """Publishes in a group, or hides from it, the caller's own episodes that match a filter, and the benchmark if it is
    the caller's: published with those of its artifacts that are, too, and hidden only without a filter. Artifacts are
    never hidden: other benchmarks may need them. among: a condition on RECORDING for the episodes.

    Raises:
        DeniedError: nothing of this is the caller's, or the caller may not publish in the group, or knows none of that
            name.
        StorageError: no episode of the caller's matches the filter, or there is nothing to hide.
    """
    own: BaseFilter = FilterEQ(key="created_by", value=caller.name)
    own = own if chosen is None else own & chosen
    mine = benchmark if benchmark is not None and benchmark.created_by == caller.name else None
    if not published:
        own &= FilterEQ(key="published_in", value=group)
        mine = mine if mine is not None and chosen is None and group in mine.published_in else None
    count = episodes.publish(connection, caller, own, group, published=published, only=among)
    if not count and published and chosen is not None:
        raise StorageError("no episode of yours matches; what others recorded, only they can publish")
    if not count and mine is None:
        if published:
            raise DeniedError("nothing of this is yours; only the owners may publish it")
        demand_known(connection, caller, group)
        raise StorageError(f"of this, nothing that is yours is published in {group}")
    if mine is None:
        return Shared(benchmark=False, episodes=count, unseen=0)
    if not published:
        items.unpublish(connection, caller, "benchmark", mine.id, group)
        return Shared(benchmark=True, episodes=count, unseen=0)
    items.publish(connection, caller, "benchmark", mine.id, group)
    for artifact in _needed(connection, items, caller, mine)[1]:
        if artifact.created_by == caller.name:
            items.publish(connection, caller, "artifact", artifact.id, group)
    unseen = count_unseen(connection, items, caller, mine, {group})
    return Shared(benchmark=True, episodes=count, unseen=unseen)


def count_unseen(
    connection: Connection, items: Items, caller: Caller, benchmark: BenchmarkHeader, groups: Set[str]
) -> int:
    """How many artifacts of others, which the caller's benchmark needs, some of the groups cannot see."""
    needed, artifacts = _needed(connection, items, caller, benchmark)
    seen = {
        artifact.id
        for artifact in artifacts
        if artifact.created_by == caller.name
        or groups <= {*artifact.published_in}
        or GLOBAL in artifact.published_in
    }
    return len(needed - seen)


def _needed(
    connection: Connection, items: Items, caller: Caller, benchmark: BenchmarkHeader
) -> tuple[set[str], list[ArtifactMetadataItem]]:
    """The ids of the artifacts that a benchmark needs, and those of them that the caller sees."""
    ids = set(artifacts_needed(items.load_benchmark(connection, caller, benchmark.id).serialized))
    return ids, items.list_artifacts(connection, caller, FilterIN(key="id", value=sorted(ids)))
