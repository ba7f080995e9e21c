"""Pages to publish datasets, and to upload recordings."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Form, Response
from sqlalchemy import Connection

from tupli_mcap.page.answers import PageRoute, address
from tupli_mcap.page.datasets import Dataset, find_dataset, of_dataset
from tupli_mcap.schema import EpisodeHeader, Right, parse_bound
from tupli_mcap.server.pages.session import Code, Member, Visit, tried
from tupli_mcap.server.people import accounts
from tupli_mcap.server.stored import sharing

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
    user's episodes. With a filter, only those episodes that match it; the benchmark is not unpublished then."""

    def work() -> None:
        wanted = parse_bound(filter, EpisodeHeader) if filter.strip() else None
        shelf = visit.shelf()
        with visit.library.database.writing() as connection:
            found = find_dataset(shelf, connection, dataset)
            sharing.share(
                connection, visit.library.items, visit.caller, group, wanted,
                published=published, benchmark=found.benchmark, among=of_dataset(found.key),
            )  # fmt: skip

    again = address("share", dataset=dataset, filter=filter)
    return tried(work, partial(_page, visit, dataset, filter), again)


def _unseen(connection: Connection, visit: Visit, dataset: Dataset) -> int:
    """How many artifacts of others, which the user's benchmark needs, a group that sees the benchmark cannot see."""
    benchmark, me = dataset.benchmark, visit.caller.name
    if benchmark is None or benchmark.created_by != me:
        return 0
    groups = {*benchmark.published_in} - {me}
    if not groups:
        return 0
    return sharing.count_unseen(connection, visit.library.items, visit.caller, benchmark, groups)


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
    seen_by = _seen_by(dataset, visit.caller.name)
    shown: dict[str, Any] = {
        "dataset": dataset,
        "groups": groups,
        "seen_by": seen_by,
        "filter": filter,
        "unseen": unseen,
    }
    at = address("share", dataset=key, filter=filter)
    return visit.page("share.html", facts, wrong, status, at=at, **shown)


def _seen_by(dataset: Dataset, me: str) -> list[str]:
    """The groups that see something of a dataset that is the user's."""
    lists = [part.published_in for part in dataset.audiences if part.owner == me]
    if dataset.benchmark is not None and dataset.benchmark.created_by == me:
        lists.append(dataset.benchmark.published_in)
    return sorted({group for groups in lists for group in groups} - {me})


def _groups(connection: Connection, visit: Visit) -> list[str]:
    """The groups in which the user may publish, `global` first."""
    name = visit.caller.name
    groups = accounts.memberships_of(connection, name)
    return [group for group in groups if group != name and visit.caller.may(Right.EPISODE_CREATE, group)]


@router.get("/upload")
def show_upload(visit: Member) -> Response:
    visit.caller.demand(Right.EPISODE_CREATE, visit.caller.name)
    return visit.page("upload.html", {"most_bytes": visit.library.settings.max_upload})
