"""New recordings on a server: whole ones, parts of running ones, and wholes that replace their parts.
Functions that take a connection work in the transaction of their caller.
"""

from __future__ import annotations

import contextlib
import json
import re
import secrets
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from sqlalchemy import Connection, insert, select

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FormatError, StorageError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.about.run import OF_STORAGE
from tupli_mcap.recording.opened import is_finished
from tupli_mcap.schema import Right
from tupli_mcap.server.database import audience, audit, settle
from tupli_mcap.server.people.access import Caller, readable
from tupli_mcap.server.people.accounts import ConflictError
from tupli_mcap.server.stored.episodes import forget, whole_name
from tupli_mcap.server.tables import CLAIM, FILE, ITEM
from tupli_mcap.server.uploads import TooLargeError
from tupli_mcap.storage.base import new_name, no_such
from tupli_mcap.storage.catalog import queries
from tupli_mcap.storage.catalog.entries import Entry, rows_of, runs_of
from tupli_mcap.storage.catalog.tables import EPISODE, RECORDING
from tupli_mcap.storage.listing import RecordingStamp
from tupli_mcap.storage.sidecar import Sidecar
from tupli_mcap.storage.texts import escape_text, is_hash, unescape_text

_MOST_METADATA: Final = 64 << 10  # characters of JSON
_PLAIN: Final = "plain"  # where recordings without a benchmark lie
_ODD: Final = re.compile(r"[^A-Za-z0-9._-]+")  # in URLs of buckets


def demand_benchmark(connection: Connection, caller: Caller, benchmark_id: str) -> None:
    """Raises NotFoundError unless a benchmark of this id is stored, and the caller may read it; an empty id is none."""
    if not benchmark_id:
        return
    seen = readable(caller, Right.BENCHMARK_READ, ITEM.c.created_by, ITEM.c.published_in)
    there = select(ITEM.c.number).where(ITEM.c.kind == "benchmark", ITEM.c.id == benchmark_id, seen)
    if not is_hash(benchmark_id) or not connection.execute(there).first():
        raise no_such("benchmark", benchmark_id)


def demand_finished(path: Path) -> None:
    """Raises FormatError for a file without the end of a finished recording."""
    if not is_finished(path):
        raise FormatError(
            "expected a finished recording, found one without its end: it is still being recorded, its program was "
            "stopped, or a part of the file is missing; write a finished copy with tupli-mcap recover FILE, and send "
            "that"
        )


def demand_short(recording: Recording) -> None:
    """Raises TooLargeError for long metadata of an episode or a run: they are in everybody's lists, a run's with each
    of its episodes. FormatError for damaged ones of an episode; lists have nothing of a damaged run."""
    numbers = recording.index["episode"].tolist()
    texts = list(zip((f"episode {number}" for number in numbers), recording.all_metadata(), strict=True))
    with contextlib.suppress(FormatError):
        texts += [("a run", jsonvalue.dumps(run.as_dict())) for run in recording.recorded_runs.runs]
    for what, text in texts:
        if len(text) > _MOST_METADATA:
            raise TooLargeError(
                f"expected metadata of {what} of at most {_MOST_METADATA} characters of JSON, found {len(text)}; "
                "record large values as infos, or store an artifact"
            )


def demand_undamaged(recording: Recording) -> None:
    """Raises FormatError if a chunk or an attachment is damaged."""
    store = recording.file.store
    try:
        for chunk in range(len(store.table)):
            store.load(chunk, keep=False)
        for name in recording.attachments:
            recording.read_attachment(name)
    except FormatError as err:
        raise FormatError(
            f"expected an undamaged recording, found damage: {str(err).removeprefix(f'{recording.name}: ')}; "
            "nothing is stored or replaced; send a good copy, or what tupli-mcap recover FILE saves"
        ) from err


def new_place(benchmark_id: str, file: str) -> str:
    """A new place for a recording of a stored benchmark, or of none. What is plain in the name of its file is part of
    it: a run without a name is named after its file."""
    stem = file.removesuffix(".mcap")
    made = OF_STORAGE.fullmatch(stem)
    name = _ODD.sub("_", (made["name"] or "") if made else stem)
    return f"recordings/{benchmark_id or _PLAIN}/{new_name(name)}"


def stored_already(connection: Connection, caller: Caller, digest: str) -> str | None:
    """The name of the caller's recording with these bytes; None if there is none."""
    own = select(FILE.c.path).where(FILE.c.created_by == caller.name, FILE.c.digest == digest)
    found: str | None = connection.execute(own).scalar()
    return None if found is None else unescape_text(found)


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
    """Catalogs the episodes of a recording whose file is kept at `place`, without the `deleted` ones. Returns the name
    of the recording, and the places of files to delete.

    A running recording may come in parts: files with different episodes of it. A file with all episodes of earlier
    parts replaces them; published episodes stay published, and deleted ones deleted. An episode with a number below
    `sent_before` was sent before: if the server has it no more, it was deleted, and stays so.

    Raises:
        NotFoundError: its benchmark is not stored, or the caller may not read it.
        ConflictError: it has some episodes of a file that is stored, but lacks others.
        StorageError: it has no episodes.
    """
    caller.demand(Right.EPISODE_CREATE, caller.name)
    numbers = {int(number) for number in recording.index["episode"]}
    if not numbers:
        raise StorageError("expected a recording with episodes, found one without any")
    demand_benchmark(connection, caller, recording.benchmark_id)
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
    gone = [forget(connection, part.name) for part in replaced]
    name = _name_of(place, min(numbers), [part.name for part in earlier], [part.name for part in replaced])
    if numbers <= sidecar.deleted:
        return name, [*gone, place]
    recording.name = name  # a run without a name is named after its file
    settle(connection, place)
    audience(connection, [caller.name])
    rows = rows_of(recording, sidecar, created_by=caller.name)
    stamp = RecordingStamp(recording.size, 0, 0)
    entry = Entry(stamp, recording.uuid, recording.benchmark_id, rows, runs_of(recording))
    queries.put_recording(connection, name, entry)
    told = {"path": escape_text(name), "place": escape_text(place), "created_by": caller.name}
    told |= {"uuid": recording.uuid, "digest": digest, "deleted": json.dumps(sorted(sidecar.deleted))}
    counts = {
        "size": recording.size,
        "episodes": len(numbers),
        "rank": _rank(connection, caller, recording.uuid),
    }
    connection.execute(insert(FILE).values(**told, **counts))
    audit(connection, caller.name, "store_recording", name)
    return name, [each for each in gone if each != place]


class _Part(NamedTuple):
    """A stored file of a recording: who sees each of its episodes, and which were deleted."""

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
    """A name for a file with episodes from `first` on. It is the name of the whole recording if that is free, so that a
    client that has listed a part opens the file that has replaced it."""
    if not earlier:
        return place
    whole = whole_name(earlier[0])
    if whole in replaced or whole not in earlier:
        return whole
    return replaced[0] if replaced else f"{whole}/{first:010}-{secrets.token_hex(6)}.mcap"


def _rank(connection: Connection, caller: Caller, uuid: str) -> int:
    """How many other users have stored a recording of a UUID before the caller did so for the first time."""
    found = connection.execute(select(CLAIM.c.created_by, CLAIM.c.rank).where(CLAIM.c.uuid == uuid))
    ranks = {created_by: int(rank) for created_by, rank in found}
    if caller.name not in ranks:
        ranks[caller.name] = len(ranks)
        row = {"uuid": uuid, "created_by": caller.name, "rank": ranks[caller.name]}
        connection.execute(insert(CLAIM).values(**row))
    return ranks[caller.name]
