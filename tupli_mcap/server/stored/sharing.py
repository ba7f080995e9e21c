"""Publishes what is a caller's of a dataset: its benchmark with the artifacts, and the episodes.
Every function works in the transaction of its caller.
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
    benchmark: BenchmarkHeader | None = None,
    among: ColumnElement[bool] | None = None,
) -> Shared:
    """Publishes in a group the caller's own episodes that match a filter, and the benchmark with the artifacts that it
    needs, as far as these are the caller's. among: a condition on RECORDING for the episodes.

    Raises:
        DeniedError: nothing of this is the caller's, or the caller may not publish in the group.
        StorageError: no episode of the caller's matches the filter.
    """
    count = episodes.publish(connection, caller, _own(caller, chosen), group, only=among)
    if chosen is not None and not count:
        raise StorageError("no episode of yours matches; what others recorded, only they can publish")
    if benchmark is None or benchmark.created_by != caller.name:
        if not count:
            raise DeniedError("nothing of this is yours; only the owners may publish it")
        return Shared(benchmark=False, episodes=count, unseen=0)
    items.publish(connection, caller, "benchmark", benchmark.id, group)
    for artifact in _needed(connection, items, caller, benchmark)[1]:
        if artifact.created_by == caller.name:
            items.publish(connection, caller, "artifact", artifact.id, group)
    unseen = count_unseen(connection, items, caller, benchmark, {group})
    return Shared(benchmark=True, episodes=count, unseen=unseen)


def hide(
    connection: Connection,
    items: Items,
    caller: Caller,
    group: str,
    chosen: BaseFilter | None,
    *,
    benchmark: BenchmarkHeader | None = None,
    among: ColumnElement[bool] | None = None,
) -> Shared:
    """Hides from a group what `share` publishes; the benchmark only without a filter, and its artifacts never: other
    benchmarks may need them. StorageError if there is nothing to hide, DeniedError if the caller knows no such group.
    """
    wanted = _own(caller, chosen) & FilterEQ(key="published_in", value=group)
    count = episodes.publish(connection, caller, wanted, group, published=False, only=among)
    if (
        benchmark is not None
        and benchmark.created_by == caller.name
        and chosen is None
        and group in benchmark.published_in
    ):
        items.unpublish(connection, caller, "benchmark", benchmark.id, group)
        return Shared(benchmark=True, episodes=count, unseen=0)
    if not count:
        demand_known(connection, caller, group)
        raise StorageError(f"of this, nothing that is yours is published in {group}")
    return Shared(benchmark=False, episodes=count, unseen=0)


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


def _own(caller: Caller, chosen: BaseFilter | None) -> BaseFilter:
    own: BaseFilter = FilterEQ(key="created_by", value=caller.name)
    return own if chosen is None else own & chosen
