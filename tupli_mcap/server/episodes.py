"""Recordings on a server, and their episodes. Every function works in a transaction of its caller's."""

from __future__ import annotations

import datetime
import json
import secrets
from collections.abc import Collection, Iterator, Sequence
from typing import Any, Final, NamedTuple

from sqlalchemy import Connection, and_, delete, insert, select, update
from sqlalchemy.sql.elements import ColumnElement

from tupli_mcap.errors import NotFoundError, StorageError
from tupli_mcap.recording import Recording
from tupli_mcap.schema import BaseFilter, EpisodeHeader, FilterEQ
from tupli_mcap.server.database import audience, audit, pend, settle
from tupli_mcap.server.people.access import Caller, DeniedError, Right, readable
from tupli_mcap.server.people.accounts import ConflictError
from tupli_mcap.server.tables import FILE, ITEM
from tupli_mcap.storage.base import published_in
from tupli_mcap.storage.catalog import queries
from tupli_mcap.storage.catalog.entries import rows_of, runs_of
from tupli_mcap.storage.catalog.queries import After
from tupli_mcap.storage.catalog.tables import EPISODE, RECORDING, VALUE
from tupli_mcap.storage.catalog.tallies import tally
from tupli_mcap.storage.listing import RecordingStamp
from tupli_mcap.storage.sidecar import Sidecar
from tupli_mcap.storage.texts import escape_text, is_hash, unescape_text

__all__ = ["StoredFile", "count_episodes", "delete_episodes", "file_of", "find_episodes", "names_of", "new_name",
           "no_episode",
           "publish", "register", "stored_already", "unpublish"]  # fmt: skip

_PLAIN: Final = "plain"  # where recordings without a benchmark lie


class StoredFile(NamedTuple):
    """The file of a recording: its place among the blobs, SHA-256, size, and how many episodes are in it; `whole` if
    the caller may read all of it."""

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
    only: ColumnElement[bool] | None = None,
) -> Iterator[EpisodeHeader]:
    """The readable episodes that a filter is true of, see `queries.find_episodes`."""
    seen = _seen(caller) if only is None else and_(_seen(caller), only)
    return queries.find_episodes(connection, filter, limit=limit, offset=offset, after=after, only=seen)


def count_episodes(connection: Connection, caller: Caller, filter: BaseFilter | None) -> int:
    """How many readable episodes a filter is true of."""
    return queries.count_episodes(connection, filter, only=_seen(caller))


def file_of(connection: Connection, caller: Caller, name: str) -> StoredFile:
    """The file of a recording.

    Raises:
        NotFoundError: there is none, or none of its episodes may be read.
    """
    for each in names_of(name):
        found = connection.execute(select(FILE).where(FILE.c.path == escape_text(each))).first()
        if found is not None:
            seen = count_episodes(connection, caller, FilterEQ(key="recording", value=each))
            if seen:
                place = unescape_text(found.place)
                whole = seen == found.episodes
                return StoredFile(each, place, found.digest, found.size, found.episodes, whole)
    raise NotFoundError(f"there is no recording {name[:200]!r}")


def names_of(name: str) -> list[str]:
    """The names under which a recording may be found now: its own, and that of the one it has become a part of."""
    return list(dict.fromkeys((name, _whole(name))))


def _seen(caller: Caller) -> ColumnElement[bool]:
    return readable(caller, Right.EPISODE_READ, EPISODE.c.created_by, EPISODE.c.published_in)


# --- taking in ---


def new_name(benchmark_id: str) -> str:
    """A name for a recording that nothing has yet: time (UTC) and random digits."""
    now = datetime.datetime.now(datetime.UTC)
    return f"recordings/{benchmark_id or _PLAIN}/{now:%Y%m%dT%H%M%S}-{secrets.token_hex(6)}.mcap"


def stored_already(connection: Connection, caller: Caller, digest: str) -> str | None:
    """The name of the caller's recording with these bytes; None if there is none."""
    own = select(FILE.c.path).where(FILE.c.created_by == caller.name, FILE.c.digest == digest)
    found: str | None = connection.execute(own).scalar()
    return found


def register(
    connection: Connection,
    caller: Caller,
    recording: Recording,
    place: str,
    digest: str,
    *,
    deleted: Collection[int] = (),
    sent_before: int = 0,
) -> tuple[str, list[str]]:
    """Lists the episodes of a recording whose file is kept at `place`, but those that are `deleted`; returns the
    name of the recording, and the places of files to forget.

    A recording that goes on may come in parts: files with some of its episodes, each in one of them. A file that has
    all episodes of earlier ones takes their place: what was published stays published, and what was deleted deleted.
    Deleted are, too, those with numbers below `sent_before` that are not there any more: the caller has sent them.

    Raises:
        NotFoundError: its benchmark is not stored, or the caller may not read it.
        ConflictError: it has some episodes of a file that is stored, but lacks others.
        StorageError: it has no episodes.
    """
    caller.demand(Right.EPISODE_CREATE, caller.name)
    numbers = {int(number) for number in recording.index["episode"]}
    if not numbers:
        raise StorageError("expected a recording with episodes, found one without any")
    _demand_benchmark(connection, caller, recording.benchmark_id)
    earlier = _parts(connection, caller, recording.uuid)
    replaced = [part for part in earlier if part.seen_by.keys() <= numbers]
    sidecar = Sidecar(uuid=recording.uuid)
    for part in earlier:
        if part in replaced:
            sidecar.published_in |= part.seen_by
        elif numbers & part.seen_by.keys():
            raise ConflictError(
                f"the recording {recording.uuid} is stored with episode {min(part.seen_by.keys() - numbers)}, which "
                "this file lacks; delete what is stored first"
            )
    stored = {number for part in earlier for number in part.seen_by}
    gone_since = {number for number in numbers - stored if number < sent_before}
    sidecar.deleted = gone_since.union(deleted, *(part.deleted for part in earlier))
    gone = [_forget(connection, part.name) for part in replaced]
    name = _name_of(place, min(numbers), [part.name for part in earlier], [part.name for part in replaced])
    if numbers <= sidecar.deleted:
        return name, [*gone, place]
    settle(connection, place)
    _put(connection, caller, recording, name, sidecar)
    told = {"path": escape_text(name), "place": escape_text(place), "created_by": caller.name}
    told |= {"uuid": recording.uuid, "digest": digest, "deleted": json.dumps(sorted(sidecar.deleted))}
    connection.execute(insert(FILE).values(**told, size=recording.size, episodes=len(numbers)))
    audit(connection, caller.name, "store_recording", name)
    return name, [each for each in gone if each != place]


class _Part(NamedTuple):
    """A file that is stored of a recording: who sees each of its episodes, and which of them were deleted."""

    name: str
    seen_by: dict[int, list[str]]
    deleted: set[int]


def _parts(connection: Connection, caller: Caller, uuid: str) -> list[_Part]:
    own = select(FILE.c.path, FILE.c.deleted).where(FILE.c.created_by == caller.name, FILE.c.uuid == uuid)
    listed = select(EPISODE.c.episode, EPISODE.c.published_in).join(
        RECORDING, RECORDING.c.id == EPISODE.c.recording_id
    )
    parts = []
    for path, deleted in connection.execute(own.order_by(FILE.c.path)).all():
        found = connection.execute(listed.where(RECORDING.c.path == path))
        seen_by = {number: json.loads(groups) for number, groups in found}
        parts.append(_Part(unescape_text(path), seen_by, set(json.loads(deleted))))
    return parts


def _name_of(place: str, first: int, earlier: Sequence[str], replaced: Sequence[str]) -> str:
    """The name of a file, with episodes from `first` on, among those of its recording: that of the whole where it is
    free, so that who has listed a part opens what has taken its place."""
    if not earlier:
        return place
    whole = _whole(earlier[0])
    if whole in replaced or whole not in earlier:
        return whole
    return replaced[0] if replaced else f"{whole}/{first:010}-{secrets.token_hex(6)}.mcap"


def _whole(name: str) -> str:
    """The name of the recording that a file is a part of."""
    stem, part, _ = name.partition(".mcap/")
    return f"{stem}.mcap" if part else name


def _put(connection: Connection, caller: Caller, recording: Recording, name: str, sidecar: Sidecar) -> None:
    """Lists a recording in the catalog."""
    audience(connection, [caller.name])
    queries.put_recording(
        connection,
        name,
        RecordingStamp(recording.size, 0, 0),
        uuid=recording.uuid,
        benchmark_id=recording.benchmark_id,
        rows=rows_of(recording, sidecar, created_by=caller.name),
        runs=runs_of(recording),
    )


def _demand_benchmark(connection: Connection, caller: Caller, benchmark_id: str) -> None:
    if not benchmark_id:
        return
    seen = readable(caller, Right.BENCHMARK_READ, ITEM.c.created_by, ITEM.c.published_in)
    there = select(ITEM.c.number).where(ITEM.c.kind == "benchmark", ITEM.c.id == benchmark_id, seen)
    if not is_hash(benchmark_id) or not connection.execute(there).first():
        raise NotFoundError(
            f"there is no benchmark with id {benchmark_id[:80]!r}; list_benchmarks() names them all"
        )


# --- changing ---


def publish(
    connection: Connection,
    caller: Caller,
    filter: BaseFilter | None,
    group: str,
    *,
    only: ColumnElement[bool] | None = None,
) -> int:
    """Lets a group see the caller's own episodes that a filter is true of: all, or none; done twice, nothing changes.

    only: see `find_episodes`.

    Returns:
        How many they are.
    """
    found = _own_first(connection, caller, filter, only)
    for header in found:
        if header.created_by != caller.name:
            raise DeniedError(f"episode {header.id} is somebody else's; only its owner may publish it")
        groups = published_in(header.published_in, group)
        caller.demand(Right.EPISODE_CREATE, group)
        _set_audience(connection, header, groups)
        audit(connection, caller.name, "publish_episode", f"{header.id} in {group}")
    _tally(connection, found)
    return len(found)


def unpublish(
    connection: Connection,
    caller: Caller,
    filter: BaseFilter | None,
    group: str,
    *,
    only: ColumnElement[bool] | None = None,
) -> int:
    """Takes episodes away from a group: the owner may, and who has the right to delete there.

    only: see `find_episodes`.

    Returns:
        How many they are.
    """
    found = _own_first(connection, caller, filter, only)
    for header in found:
        if header.created_by != caller.name:
            caller.demand(Right.EPISODE_DELETE, group)
        _set_audience(connection, header, [name for name in header.published_in if name != group])
        audit(connection, caller.name, "unpublish_episode", f"{header.id} from {group}")
    _tally(connection, found)
    return len(found)


def delete_episodes(connection: Connection, caller: Caller, filter: BaseFilter) -> tuple[int, list[str]]:
    """Deletes the readable episodes that a filter is true of; returns how many, and the names of files to forget.

    Raises:
        DeniedError: one of them is somebody else's, and the caller has not the right; none is deleted then.
    """
    doomed: dict[str, set[int]] = {}
    found = list(find_episodes(connection, caller, filter))
    own = {header.id for header in found if header.created_by == caller.name}
    for header in found:
        if header.created_by != caller.name and not caller.may(Right.EPISODE_DELETE):
            if header.id in own:  # somebody else has stored the same recording
                continue
            raise DeniedError(f"episode {header.id} is somebody else's; only its owner may delete it")
        doomed.setdefault(header.recording, set()).add(header.episode)
    empty = []
    for path, numbers in doomed.items():
        name = escape_text(path)
        recording = connection.execute(select(RECORDING.c.id).where(RECORDING.c.path == name)).scalar_one()
        of = and_(EPISODE.c.recording_id == recording, EPISODE.c.episode.in_(sorted(numbers)))
        ids = select(EPISODE.c.id).where(of)
        connection.execute(delete(VALUE).where(VALUE.c.episode_id.in_(ids)))
        connection.execute(delete(EPISODE).where(of))
        known = connection.execute(select(FILE.c.deleted).where(FILE.c.path == name)).scalar_one()
        deleted = json.dumps(sorted({*json.loads(known), *numbers}))
        connection.execute(update(FILE).where(FILE.c.path == name).values(deleted=deleted))
        tally(connection, recording)
        left = select(EPISODE.c.id).where(EPISODE.c.recording_id == recording).limit(1)
        if not connection.execute(left).first():
            empty.append(_forget(connection, path))
        audit(connection, caller.name, "delete_episodes", f"{path}: {', '.join(map(str, sorted(numbers)))}")
    return sum(map(len, doomed.values())), empty


def _own_first(
    connection: Connection, caller: Caller, filter: BaseFilter | None, only: ColumnElement[bool] | None
) -> list[EpisodeHeader]:
    """The readable episodes that a filter is true of; of one that several people have stored, the caller's own."""
    found: dict[str, EpisodeHeader] = {}
    for header in find_episodes(connection, caller, filter, only=only):
        if header.id not in found or header.created_by == caller.name:
            found[header.id] = header
    return list(found.values())


def no_episode(uri: str) -> NotFoundError:
    """The error for an id that no readable episode has."""
    return NotFoundError(f"there is no episode with id {str(uri)[:80]!r}; list_episodes() names them all")


def _set_audience(connection: Connection, header: EpisodeHeader, groups: Sequence[str]) -> None:
    of = select(RECORDING.c.id).where(RECORDING.c.path == escape_text(header.recording)).scalar_subquery()
    row = and_(EPISODE.c.recording_id == of, EPISODE.c.episode == header.episode)
    values: dict[str, Any] = {"published_in": audience(connection, groups)}
    connection.execute(update(EPISODE).where(row).values(**values))


def _tally(connection: Connection, changed: Sequence[EpisodeHeader]) -> None:
    """Makes the sums of the recordings of changed episodes anew."""
    for path in dict.fromkeys(header.recording for header in changed):
        of = select(RECORDING.c.id).where(RECORDING.c.path == escape_text(path))
        tally(connection, connection.execute(of).scalar_one())


def _forget(connection: Connection, path: str) -> str:
    """Forgets a recording; returns the place of its file, which is pending."""
    place = connection.execute(select(FILE.c.place).where(FILE.c.path == escape_text(path))).scalar_one()
    queries.remove_recording(connection, path)
    connection.execute(delete(FILE).where(FILE.c.path == escape_text(path)))
    pend(connection, unescape_text(place))
    return unescape_text(place)
