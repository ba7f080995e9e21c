"""Pages to publish datasets, and to upload recordings."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Form, Response
from sqlalchemy import Connection

from tupli_mcap.errors import NotFoundError, StorageError
from tupli_mcap.page.answers import PageRoute, address
from tupli_mcap.page.datasets import Dataset, find_dataset, of_dataset
from tupli_mcap.schema import (
    ArtifactMetadataItem,
    BaseFilter,
    EpisodeHeader,
    FilterEQ,
    FilterIN,
    Right,
    parse_bound,
)
from tupli_mcap.server.pages.session import Code, Member, Visit, tried
from tupli_mcap.server.people import accounts
from tupli_mcap.server.people.access import DeniedError
from tupli_mcap.server.stored import episodes
from tupli_mcap.storage.benchmark_json import artifacts_needed

router = APIRouter(route_class=PageRoute, include_in_schema=False)
_Text = Annotated[str, Form()]


@router.get("/share")
def show(visit: Member, dataset: str, filter: str = "") -> Response:
    """The page of who sees a dataset, or its episodes that match a filter, with the forms to change that."""
    return _page(visit, dataset, filter)


@router.post("/share")
def change(
    visit: Code,
    dataset: _Text = "",
    filter: _Text = "",
    group: _Text = "",
    published: Annotated[bool, Form()] = True,
) -> Response:
    """Publishes the user's own part of a dataset in a group, or unpublishes it: the benchmark, its artifacts, and the
    user's episodes. With a filter, only the user's episodes that match it."""

    def work() -> None:
        wanted = parse_bound(filter, EpisodeHeader) if filter.strip() else None
        shelf = visit.shelf()
        with visit.library.database.writing() as connection:
            if group not in _groups(connection, visit):
                raise NotFoundError(f"you are in no group {group[:80]!r}")
            found = find_dataset(shelf, connection, dataset)
            whole = wanted is None and _turn_benchmark(connection, visit, found, group, published=published)
            own: BaseFilter = FilterEQ(key="created_by", value=visit.caller.name)
            wanted = own if wanted is None else own & wanted
            of = of_dataset(found.key)
            changed = episodes.publish(connection, visit.caller, wanted, group, published=published, only=of)
            if not changed and filter.strip():
                raise StorageError(
                    "none of your episodes of this dataset matches the filter; give another one"
                )
            if not changed and not whole:
                raise DeniedError("nothing of this is yours; only the owners may publish it")

    again = address("share", dataset=dataset, filter=filter)
    return tried(work, partial(_page, visit, dataset, filter), again)


def _turn_benchmark(
    connection: Connection, visit: Visit, dataset: Dataset, group: str, *, published: bool
) -> bool:
    """Publishes a benchmark and the caller's own of its artifacts, or unpublishes the benchmark; returns whether it is
    the caller's."""
    library, caller = visit.library, visit.caller
    if dataset.benchmark is None or dataset.benchmark.created_by != caller.name:
        return False
    if not published:  # its artifacts stay: other benchmarks may need them
        library.items.unpublish(connection, caller, "benchmark", dataset.benchmark_id, group)
        return True
    library.items.publish(connection, caller, "benchmark", dataset.benchmark_id, group)
    _, artifacts = _needed(connection, visit, dataset.benchmark_id)
    for artifact in artifacts:
        if artifact.created_by == caller.name:
            library.items.publish(connection, caller, "artifact", artifact.id, group)
    return True


def _needed(
    connection: Connection, visit: Visit, benchmark: str
) -> tuple[set[str], list[ArtifactMetadataItem]]:
    """The ids of the artifacts that a benchmark needs, and those of them that the user sees."""
    items, caller = visit.library.items, visit.caller
    ids = set(artifacts_needed(items.load_benchmark(connection, caller, benchmark).serialized))
    return ids, items.list_artifacts(connection, caller, FilterIN(key="id", value=sorted(ids)))


def _unseen(connection: Connection, visit: Visit, dataset: Dataset) -> int:
    """How many artifacts of others, which the user's benchmark needs, a group that sees the benchmark cannot see."""
    benchmark, me = dataset.benchmark, visit.caller.name
    if benchmark is None or benchmark.created_by != me:
        return 0
    if not (groups := {*benchmark.published_in} - {me}):
        return 0
    ids, artifacts = _needed(connection, visit, dataset.benchmark_id)
    seen = {
        artifact.id
        for artifact in artifacts
        if artifact.created_by == me
        or groups <= {*artifact.published_in}
        or "global" in artifact.published_in
    }
    return len(ids - seen)


def _page(visit: Visit, key: str, filter: str, wrong: str = "", status: int = 200) -> Response:
    shelf = visit.shelf()

    def ask(connection: Connection) -> tuple[Dataset, list[str], int]:
        found = find_dataset(shelf, connection, key)
        return found, _groups(connection, visit), _unseen(connection, visit, found)

    dataset, groups, unseen = shelf.ask(ask)
    facts = {
        "dataset": dataset.key,
        "benchmark": None if dataset.benchmark is None else dataset.benchmark.published_in,
        "episodes": [part._asdict() for part in dataset.audiences],
    }
    shown: dict[str, Any] = {"dataset": dataset, "groups": groups, "filter": filter, "unseen": unseen}
    at = address("share", dataset=key, filter=filter)
    return visit.page("share.html", facts, wrong, status, at=at, **shown)


def _groups(connection: Connection, visit: Visit) -> list[str]:
    """The groups in which the user may publish, `global` first."""
    name = visit.caller.name
    groups = accounts.memberships_of(connection, name)
    return [group for group in groups if group != name and visit.caller.may(Right.EPISODE_CREATE, group)]


@router.get("/upload")
def show_upload(visit: Member) -> Response:
    visit.caller.demand(Right.EPISODE_CREATE, visit.caller.name)
    return visit.page("upload.html", {"most_bytes": visit.library.settings.max_upload})
