"""The datasets of a shelf, and tables of episodes."""

from __future__ import annotations

import functools
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, TypeGuard

from fastapi import APIRouter, Query, Request, Response
from markupsafe import Markup
from sqlalchemy import Connection, func, select

from tupli_mcap.dataset.keys import check_metadata
from tupli_mcap.errors import FilterError, NotFoundError
from tupli_mcap.page import charts
from tupli_mcap.page.answers import PageRoute, Shown, address, page
from tupli_mcap.page.copies import MOST_CHOSEN, MOST_COMPARED
from tupli_mcap.page.datasets import Dataset, all_datasets, dataset_filter, find_dataset, seen_in
from tupli_mcap.page.shelf import Shelf, find_episode, python_line
from tupli_mcap.plots.statistics import LARGEST
from tupli_mcap.remote import is_url
from tupli_mcap.schema import BaseFilter, EpisodeHeader, join_key, parse_bound
from tupli_mcap.schema.facts import comparisons, path_in
from tupli_mcap.storage.catalog.metadata_sql import can_search
from tupli_mcap.storage.catalog.order import After, Sort
from tupli_mcap.storage.catalog.queries import count_episodes, declared_keys, find_episodes
from tupli_mcap.storage.catalog.tables import TALLY

router = APIRouter(route_class=PageRoute, include_in_schema=False)
_DATASETS: Final = 50  # on a page
_ROWS: Final = 50
_COUNTED: Final = 1_000  # beyond so many episodes, a page says "More than"
_KEYS: Final = 4  # most keys of metadata that get a column
_MANY: Final = 50_000  # episodes, all of whose metadata take a while to read
_ASKED: Final = 1_000  # of at most so many episodes, a key that none has is named


@dataclass(frozen=True)
class Table:
    """A page of episodes.

    error: what is wrong with the filter. position: the character (from 0) at which it is wrong, if known. count: None
    for more than `most`. keys: the metadata keys that have a column; ordered: those of them that episodes can be sorted
    by. before, after: the ids between which this page lies; None for no further page. slow: the keys that no index
    leads to, each with the command that makes one.
    """

    rows: Sequence[EpisodeHeader]
    error: str = ""
    position: int | None = None
    count: int | None = 0
    most: int = _COUNTED
    keys: Sequence[str] = ()
    ordered: Sequence[str] = ()
    before: str | None = None
    after: str | None = None
    slow: Sequence[tuple[str, str]] = ()

    def bar(self, row: EpisodeHeader) -> Markup:
        """A bar: where the return of a row lies between the smallest and the largest of the page."""
        known = [r.episode_return for r in self.rows if _is_drawable(r.episode_return)]
        value = row.episode_return
        if not _is_drawable(value) or min(known) == max(known):
            return Markup("")
        return charts.share((value - min(known)) / (max(known) - min(known)))


@router.api_route("/", methods=["GET", "HEAD"])
def datasets(
    request: Request, shelf: Shown, q: str = "", number: Annotated[int, Query(alias="page", ge=1)] = 1
) -> Response:
    """The page of all datasets, or of those that contain the words of `q`."""
    found = shelf.ask(lambda connection: all_datasets(shelf, connection))
    chosen = [dataset for dataset in found if dataset.holds(q.lower().split())]
    first = (number - 1) * _DATASETS
    shown = chosen[first : first + _DATASETS]
    if first and not shown:
        raise NotFoundError(f"there is no page {number} of datasets")
    facts = {
        "datasets": [dataset.facts() for dataset in shown],
        "count": len(chosen),
        "skipped": dict(shelf.skipped),
    }
    return page(
        request, "datasets.html", facts, shelf=shelf, datasets=shown, all=len(found), q=q, number=number,
        more=len(chosen) > first + _DATASETS,
    )  # fmt: skip


@router.get("/episodes")
def episodes(
    request: Request,
    shelf: Shown,
    dataset: str = "",
    filter: str = "",
    sort: str = "",
    after: str = "",
    before: str = "",
) -> Response:
    """A page of the episodes that match a filter, sorted."""

    def ask(connection: Connection) -> tuple[Dataset | None, Table]:
        of = find_dataset(shelf, connection, dataset) if dataset else None
        return of, table_of(shelf, connection, dataset, filter, sort, after=after, before=before)

    of, table = shelf.ask(ask)
    facts = {
        "episodes": [dict(row) for row in table.rows],
        "count": table.count,
        "error": table.error or None,
        "position": table.position,
        "after": table.after,
        "before": table.before,
    }
    status = 400 if table.error else 200
    link = functools.partial(address, "episodes", dataset=dataset, filter=filter, sort=sort)
    return page(
        request, "episodes.html", facts, status=status, shelf=shelf, dataset=of, table=table, filter=filter, sort=sort,
        link=link, most_compared=MOST_COMPARED, most_chosen=MOST_CHOSEN,
        python=python_line(shelf, _both(dataset_filter(dataset), filter), sort),
    )  # fmt: skip


def table_of(
    shelf: Shelf,
    connection: Connection,
    dataset: str,
    filter: str,
    sort: str,
    *,
    after: str = "",
    before: str = "",
) -> Table:
    """A page of a table; by default, the first one. dataset: a key; empty for all datasets."""
    try:
        wanted = parse_bound(filter, EpisodeHeader) if filter.strip() else None
        order = Sort.parse(sort)
        seen = seen_in(shelf, connection, dataset)
        at = _beside(shelf, connection, after or before)
        place = None if at is None else After(at.recording, at.episode)
        seen_from = {**seen, "after": place, "backwards": bool(before)}
        found = list(find_episodes(connection, wanted, limit=_ROWS + 1, sort=order, **seen_from))
        if not found and at is None and wanted is not None:
            among = list(find_episodes(connection, None, limit=_ASKED + 1, **seen))
            if len(among) <= _ASKED:
                check_metadata(wanted, among)
    except FilterError as err:
        return Table((), str(err), err.position)
    more, rows = len(found) > _ROWS, shelf.as_told(connection, found[:_ROWS])
    if before:
        rows.reverse()
    count = len(rows)
    if more or at is not None:  # there are others
        count = count_episodes(connection, wanted, most=_COUNTED + 1, **seen)
    keys = _common_keys(rows)
    return Table(
        rows,
        count=count if count <= _COUNTED else None,
        keys=keys,
        ordered=_ordered(connection, keys),
        before=rows[0].id if rows and (after or (before and more)) else None,
        after=rows[-1].id if rows and (before or more) else None,
        slow=_slow(shelf, connection, wanted, order) if shelf.changes else (),
    )


def _beside(shelf: Shelf, connection: Connection, uri: str) -> EpisodeHeader | None:
    """The episode that a page comes after, or before; None for the first page."""
    try:
        return find_episode(shelf, connection, uri) if uri else None
    except NotFoundError as err:
        raise NotFoundError(
            f"the episode beside which this page begins is gone ({uri[:80]}); begin with the first page again"
        ) from err


def _is_drawable(value: float | None) -> TypeGuard[float]:
    return value is not None and abs(value) <= LARGEST


def _slow(
    shelf: Shelf, connection: Connection, filter: BaseFilter | None, sort: Sort | None
) -> list[tuple[str, str]]:
    """The keys of metadata that are not declared, if there are many episodes, and the command that declares each."""
    named = [part.key or "" for part in comparisons(filter)] if filter is not None else []
    paths = {path_in(key, EpisodeHeader) for key in [*named, *([sort.key] if sort else [])]}
    paths -= {path_in(key, EpisodeHeader) for key in declared_keys(connection)}
    keys = sorted(join_key(path) for path in paths if path[0] == "metadata" and len(path) > 1)
    seen = shelf.seen(TALLY.c.created_by, TALLY.c.published_in)
    episodes = select(func.sum(TALLY.c.episodes)).where(seen)
    if not keys or (connection.execute(episodes).scalar() or 0) <= _MANY:
        return []
    option = "--url" if is_url(shelf.opened_by) else "--storage"
    return [(key, shlex.join(["tupli-mcap", "declare-key", key, option, shelf.opened_by])) for key in keys]


def _ordered(connection: Connection, keys: Sequence[str]) -> list[str]:
    """Those keys of metadata that episodes can be sorted by."""
    declared = {path_in(key, EpisodeHeader) for key in declared_keys(connection)}
    return [key for key in keys if can_search([key]) or ("metadata", key) in declared]


def _both(a: str, b: str) -> str:
    """The text of a filter for episodes that match both of two filters."""
    given = [text for text in (a, b) if text.strip()]
    return given[0] if len(given) == 1 else " and ".join(f"({text})" for text in given)


def _common_keys(rows: Sequence[EpisodeHeader]) -> list[str]:
    """Up to four metadata keys: those for which the most rows have a number, a flag or a text."""
    said: Counter[str] = Counter()
    for row in rows:
        said.update(key for key, value in row.metadata.items() if isinstance(value, bool | int | float | str))
    return [key for key, _ in said.most_common(_KEYS)]
