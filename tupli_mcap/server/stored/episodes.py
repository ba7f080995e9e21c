"""Recordings on a server, and their episodes. Every function works in the transaction of its caller."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

from sqlalchemy import Connection, and_, delete, select, update
from sqlalchemy.sql.elements import ColumnElement

from tupli_mcap.errors import NotFoundError
from tupli_mcap.schema import BaseFilter, EpisodeHeader, FilterEQ, Right
from tupli_mcap.server.database import audience, audit, pend
from tupli_mcap.server.people.access import (
    Caller,
    DeniedError,
    as_told,
    demand_audience,
    left_alone,
    readable,
    readable_episodes,
)
from tupli_mcap.server.tables import FILE, USER
from tupli_mcap.storage.base import by_recording, no_such, published_in
from tupli_mcap.storage.catalog import queries
from tupli_mcap.storage.catalog.order import After, Sort, gone_meanwhile, row_of
from tupli_mcap.storage.catalog.tables import EPISODE, RECORDING, VALUE
from tupli_mcap.storage.catalog.tallies import Seen, recordings_seen, tally
from tupli_mcap.storage.texts import escape_text, unescape_text

_MOST_VALUES: Final = 1000


class StoredFile(NamedTuple):
    """The file of a recording: its place among the blobs, SHA-256, size, number of episodes, and whether the caller may
    read all of it (`whole`)."""

    name: str
    place: str
    digest: str
    size: int
    episodes: int
    whole: bool


# --- asking ---


def find_episodes(
    connection: Connection,
    caller: Caller,
    filter: BaseFilter | None,
    *,
    limit: int | None = None,
    offset: int = 0,
    after: After | None = None,
    sort: Sort | None = None,
    only: ColumnElement[bool] | None = None,
    copies: bool = False,
) -> Iterator[EpisodeHeader]:
    """The readable episodes that match a filter, see `queries.find_episodes`.

    copies: with all episodes of one id, not only the one that it shows the caller.

    Raises:
        NotFoundError: the caller may not read the episode to go on after: its place in an order would tell its value.
    """
    seen = _seen(caller)
    rows = (
        seen(EPISODE.c.created_by, EPISODE.c.published_in)
        if copies
        else readable_episodes(connection, caller)
    )
    rows, of = rows if only is None else and_(rows, only), recordings_seen(seen)
    told = partial(as_told, connection, caller)
    after = None if after is None else _after_now(connection, after)
    if after is not None and sort is not None:
        this = RECORDING.c.path == escape_text(after.recording), EPISODE.c.id == row_of(after)
        if connection.execute(select(EPISODE.c.id).join(RECORDING).where(rows, *this)).first() is None:
            raise gone_meanwhile()
    return queries.find_episodes(
        connection, filter, limit=limit, offset=offset, after=after, only=rows, of=of, sort=sort, told=told
    )


def count_episodes(connection: Connection, caller: Caller, filter: BaseFilter | None) -> int:
    """The number of readable episodes that match a filter."""
    of = recordings_seen(_seen(caller))
    rows, told = readable_episodes(connection, caller), partial(as_told, connection, caller)
    return queries.count_episodes(connection, filter, only=rows, of=of, told=told)


def file_of(connection: Connection, caller: Caller, name: str) -> StoredFile:
    """The file of a recording. NotFoundError if there is none of which the caller may read an episode."""
    for each in dict.fromkeys((name, whole_name(name))):  # the part may have been replaced
        found = connection.execute(select(FILE).where(FILE.c.path == escape_text(each))).first()
        if found is not None:
            seen = count_episodes(connection, caller, FilterEQ(key="recording", value=each))
            if seen:
                place = unescape_text(found.place)
                whole = seen == found.episodes
                return StoredFile(each, place, found.digest, found.size, found.episodes, whole)
    raise NotFoundError(f"there is no recording {name[:200]!r}")


def deleted_of(connection: Connection, caller: Caller) -> dict[str, list[int]]:
    """The numbers of deleted episodes of the caller's recordings, by UUID. They stay deleted as long as others of the
    same recording are stored."""
    own = select(FILE.c.uuid, FILE.c.deleted).where(FILE.c.created_by == caller.name, FILE.c.deleted != "[]")
    found: dict[str, set[int]] = {}
    for uuid, deleted in connection.execute(own):
        found.setdefault(uuid, set()).update(json.loads(deleted))
    return {uuid: sorted(numbers) for uuid, numbers in found.items()}


def name_now(connection: Connection, caller: Caller, name: str) -> str:
    """The name of a recording, or that of the whole one which has replaced this part."""
    if whole_name(name) == name:
        return name
    try:
        return file_of(connection, caller, name).name
    except NotFoundError:
        return name


def _after_now(connection: Connection, after: After) -> After:
    """The same place in the whole recording, if that has replaced the part of the last episode since. The whole is
    listed before its parts."""
    name = whole_name(after.recording)
    part = select(FILE.c.path).where(FILE.c.path == escape_text(after.recording))
    if name == after.recording or connection.execute(part).first():
        return after
    rest = select(EPISODE.c.id).join(RECORDING, RECORDING.c.id == EPISODE.c.recording_id)
    rest = rest.where(RECORDING.c.path == escape_text(name), EPISODE.c.episode >= after.episode).limit(1)
    return After(name, after.episode) if connection.execute(rest).first() else after


def whole_name(name: str) -> str:
    """The name of the recording that a file is a part of."""
    stem, part, _ = name.partition(".mcap/")
    return f"{stem}.mcap" if part else name


def _seen(caller: Caller) -> Seen:
    return partial(readable, caller, Right.EPISODE_READ)


# --- changing ---


def publish(
    connection: Connection,
    caller: Caller,
    filter: BaseFilter | None,
    group: str,
    *,
    published: bool = True,
    only: ColumnElement[bool] | None = None,
) -> int:
    """Lets a group see the caller's own episodes that match a filter, or hides them: all, or none; returns how many.
    Doing it twice changes nothing. Who has the right to delete in the group may hide what others have published there,
    and hides all episodes of an id. only: see `find_episodes`."""
    copies = not published and caller.may(Right.EPISODE_DELETE, group)
    found = []
    for header in find_episodes(connection, caller, filter, only=only, copies=copies):
        if published and header.created_by != caller.name:
            raise DeniedError(f"episode {header.id} is somebody else's; only its owner may publish it")
        if header.created_by != caller.name:
            caller.demand(Right.EPISODE_DELETE, group)
        found.append(header)
    if published and found:
        published_in([], group)
        demand_audience(connection, caller, Right.EPISODE_CREATE, group)

    def changed(groups: list[str]) -> list[str]:
        return published_in(groups, group) if published else [name for name in groups if name != group]

    _set_audiences(connection, found, changed)
    action, where = ("publish_episodes", "in") if published else ("unpublish_episodes", "from")
    _note(connection, caller, action, found, f" {where} {group}")
    return len(found)


def publish_one(
    connection: Connection, caller: Caller, uri: str, group: str, *, published: bool = True
) -> None:
    """Publishes one episode in a group, or unpublishes it. Raises NotFoundError if there is none of this id."""
    if not publish(connection, caller, FilterEQ(key="id", value=uri), group, published=published):
        raise no_such("episode", uri)


def deletable(connection: Connection, caller: Caller, filter: BaseFilter) -> list[EpisodeHeader]:
    """The readable episodes that match a filter; for a caller who may delete what others have stored, all episodes of
    an id. DeniedError if one is somebody else's, and the caller may not delete it."""
    may = caller.may(Right.EPISODE_DELETE)
    doomed = []
    for header in find_episodes(connection, caller, filter, copies=may):
        if header.created_by != caller.name and not may:
            raise DeniedError(f"episode {header.id} is somebody else's; only its owner may delete it")
        doomed.append(header)
    return doomed


def delete_episodes(connection: Connection, caller: Caller, filter: BaseFilter) -> tuple[int, list[str]]:
    """Deletes those of `deletable`; returns how many, and the names of files to delete."""
    doomed = deletable(connection, caller, filter)
    _note(connection, caller, "delete_episodes", doomed)
    return len(doomed), _delete(connection, doomed)


def forget_unseen(connection: Connection) -> list[str]:
    """Deletes the episodes that only deleted users could see; returns the names of files to delete."""
    owners = select(FILE.c.created_by).where(FILE.c.created_by.not_in(select(USER.c.name))).limit(1)
    if connection.execute(owners).first() is None:
        return []
    unseen = left_alone(EPISODE.c.created_by, EPISODE.c.published_in)
    return _delete(connection, list(queries.find_episodes(connection, None, only=unseen)))


def forget(connection: Connection, path: str) -> str:
    """Removes a recording from the catalog; returns the place of its file, which is pending from then on."""
    place = connection.execute(select(FILE.c.place).where(FILE.c.path == escape_text(path))).scalar_one()
    queries.remove_recording(connection, path)
    connection.execute(delete(FILE).where(FILE.c.path == escape_text(path)))
    pend(connection, unescape_text(place))
    return unescape_text(place)


def _delete(connection: Connection, doomed: Sequence[EpisodeHeader]) -> list[str]:
    empty = []
    for path, headers in by_recording(doomed).items():
        name, numbers = escape_text(path), [header.episode for header in headers]
        recording = connection.execute(select(RECORDING.c.id).where(RECORDING.c.path == name)).scalar_one()
        for of in _rows(recording, numbers):
            ids = select(EPISODE.c.id).where(of)
            connection.execute(delete(VALUE).where(VALUE.c.episode_id.in_(ids)))
            connection.execute(delete(EPISODE).where(of))
        known = connection.execute(select(FILE.c.deleted).where(FILE.c.path == name)).scalar_one()
        deleted = json.dumps(sorted({*json.loads(known), *numbers}))
        connection.execute(update(FILE).where(FILE.c.path == name).values(deleted=deleted))
        tally(connection, recording)
        left = select(EPISODE.c.id).where(EPISODE.c.recording_id == recording).limit(1)
        if not connection.execute(left).first():
            empty.append(forget(connection, path))
    return empty


def _set_audiences(
    connection: Connection, headers: Sequence[EpisodeHeader], changed: Callable[[list[str]], list[str]]
) -> None:
    """Changes who sees episodes, by a function of the groups that saw them before."""
    for path, of_recording in by_recording(headers).items():
        of = select(RECORDING.c.id).where(RECORDING.c.path == escape_text(path))
        recording = connection.execute(of).scalar_one()
        numbers: dict[tuple[str, ...], list[int]] = {}
        for header in of_recording:
            numbers.setdefault(tuple(header.published_in), []).append(header.episode)
        for groups, some in numbers.items():
            values: dict[str, Any] = {"published_in": audience(connection, changed(list(groups)))}
            for rows in _rows(recording, some):
                connection.execute(update(EPISODE).where(rows).values(**values))
        tally(connection, recording)


def _note(
    connection: Connection, caller: Caller, action: str, headers: Sequence[EpisodeHeader], more: str = ""
) -> None:
    """Logs a change of episodes in the audit table."""
    for path, of_recording in by_recording(headers).items():
        numbers = ", ".join(str(header.episode) for header in of_recording)
        audit(connection, caller.name, action, f"{path}{more}: {numbers}")


def _rows(recording: int, numbers: Sequence[int]) -> Iterator[ColumnElement[bool]]:
    """Conditions that together match episodes of a recording; several, as a statement may hold only so many values."""
    ordered = sorted(numbers)
    for start in range(0, len(ordered), _MOST_VALUES):
        some = ordered[start : start + _MOST_VALUES]
        yield and_(EPISODE.c.recording_id == recording, EPISODE.c.episode.in_(some))
