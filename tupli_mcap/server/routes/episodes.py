"""Episodes: listed, counted, published, deleted."""

from __future__ import annotations

import base64
import json
from typing import Annotated

from fastapi import APIRouter, Body, Response
from pydantic import Field

from tupli_mcap.errors import StorageError
from tupli_mcap.schema import FilterEQ, Right
from tupli_mcap.server.database import audit, demand_few
from tupli_mcap.server.people.access import as_told
from tupli_mcap.server.routes.callers import Reader, Served, Writer
from tupli_mcap.server.stored import episodes
from tupli_mcap.server.wire import REFUSALS, Asked, AskedFilter, Listing, answer, listed
from tupli_mcap.storage.api.answers import Page
from tupli_mcap.storage.base import no_such
from tupli_mcap.storage.catalog import queries
from tupli_mcap.storage.catalog.order import After, Sort

router = APIRouter(prefix="/v1/episodes", tags=["episodes"], responses=REFUSALS)
_LONGEST_KEY = 200
_MOST_KEYS, _MOST_KEYS_OF_A_USER = 100, 10  # each is a row for every episode that has it


class Chosen(Asked):
    """The episodes to count: all that match a filter."""

    filter: AskedFilter | None = None


class Doomed(Chosen):
    """The episodes to delete. `dry_run` changes nothing, and answers the same."""

    dry_run: bool = False


class Shown(Chosen):
    """The episodes to publish in a group, or to unpublish."""

    group: str
    published: bool = True


class Key(Asked):
    """A key of episodes' metadata, such as `metadata.score`."""

    key: str = Field(max_length=_LONGEST_KEY)


class SortedListing(Listing):
    """sort: a key such as `return`, `ended` or `metadata.score`; `-return` puts the largest first. By default, episodes
    are in the order of their recordings."""

    sort: str | None = Field(default=None, max_length=_LONGEST_KEY)


@router.post("/list", response_model=Page)
def list_episodes(library: Served, caller: Reader, told: Annotated[SortedListing, Body()]) -> Response:
    """The episodes that match a filter, in an order, a page at a time."""
    most = library.settings.max_page
    size = most if told.limit is None else min(told.limit, most)
    order, after = Sort.parse(told.sort or ""), _after(told.cursor)
    with library.database.reading() as connection:
        page = episodes.find_episodes(
            connection, caller, told.filter, limit=size, offset=told.offset, after=after, sort=order
        )
        found = as_told(connection, caller, list(page))
    if not found or len(found) < size:
        return listed(found, None)
    last = json.dumps([found[-1].recording, found[-1].episode])
    return listed(found, base64.urlsafe_b64encode(last.encode()).decode())


@router.post("/count")
def count_episodes(library: Served, caller: Reader, told: Annotated[Chosen, Body()]) -> int:
    """How many episodes match a filter."""
    with library.database.reading() as connection:
        return episodes.count_episodes(connection, caller, told.filter)


@router.get("/deleted")
def list_deleted(library: Served, caller: Reader) -> dict[str, list[int]]:
    """The numbers of the episodes that were deleted of the caller's recordings, by UUID: they are not stored again."""
    with library.database.reading() as connection:
        return episodes.deleted_of(connection, caller)


@router.post("/delete")
def delete_episodes(library: Served, caller: Writer, told: Annotated[Doomed, Body()]) -> Response:
    """Deletes the episodes that match a filter; `{"episodes": how many}`."""
    if told.filter is None:
        raise StorageError("expected a filter that says which episodes to delete")
    return answer({"episodes": library.delete_episodes(caller, told.filter, dry_run=told.dry_run)})


@router.post("/publish")
def publish_episodes(library: Served, caller: Writer, told: Annotated[Shown, Body()]) -> Response:
    """Publishes the episodes of a filter in a group, or unpublishes them: all, or none; `{"episodes": how many}`."""
    with library.database.writing() as connection:
        count = episodes.publish(connection, caller, told.filter, told.group, published=told.published)
    return answer({"episodes": count})


@router.post("/keys")
def declare_key(library: Served, caller: Writer, told: Key) -> None:
    """Makes an index for a key of metadata, so that filters on it are fast."""
    with library.database.writing() as connection:
        known = queries.declared_keys(connection)
        if told.key in known:
            return
        if len(known) >= _MOST_KEYS:
            raise StorageError(
                f"expected at most {_MOST_KEYS} keys that are declared; filter without this one"
            )
        if not caller.may(Right.ROLE_MANAGEMENT):
            demand_few(connection, caller.name, "declare_key", _MOST_KEYS_OF_A_USER)
        queries.declare_key(connection, told.key)
        audit(connection, caller.name, "declare_key", told.key)


@router.delete("/{uri}")
def delete_episode(library: Served, caller: Writer, uri: str) -> None:
    """Deletes one episode."""
    if not library.delete_episodes(caller, FilterEQ(key="id", value=uri)):
        raise no_such("episode", uri)


@router.put("/{uri}/published")
def publish_episode(library: Served, caller: Writer, uri: str, group: str) -> None:
    """Lets a group see an episode."""
    with library.database.writing() as connection:
        episodes.publish_one(connection, caller, uri, group)


@router.delete("/{uri}/published")
def unpublish_episode(library: Served, caller: Writer, uri: str, group: str) -> None:
    """Hides an episode from a group."""
    with library.database.writing() as connection:
        episodes.publish_one(connection, caller, uri, group, published=False)


def _after(cursor: str | None) -> After | None:
    if cursor is None:
        return None
    try:
        recording, episode = json.loads(base64.urlsafe_b64decode(cursor))
        if not isinstance(recording, str) or not isinstance(episode, int) or not 0 <= episode < 1 << 63:
            raise ValueError("another cursor")
        return After(recording, episode)
    except (ValueError, TypeError, RecursionError) as err:
        raise StorageError("expected the cursor of the page before; list from the beginning") from err
