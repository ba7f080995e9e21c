"""How often a sign-in may fail, how many requests of a user are answered at a time, and how much a user may store.
Functions that take a connection work in the transaction of their caller."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import AsyncIterable, AsyncIterator, Mapping
from typing import Final, NamedTuple, TypeVar

from sqlalchemy import Connection, delete, func, insert, not_, select, update
from sqlalchemy.sql.elements import ColumnElement

from tupli_mcap.errors import NotFoundError, StorageError, TupliError, plural
from tupli_mcap.schema import Right
from tupli_mcap.server.database import audit
from tupli_mcap.server.people.access import Caller
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.tables import FAILURE, FILE, ITEM, UPLOAD, USER
from tupli_mcap.storage.texts import escape_text

_SECONDS: Final = 60
_MOST_WAITING: Final = 100  # requests of a user
_SIZES: Final = (
    (FILE.c.created_by, FILE.c.size),
    (ITEM.c.created_by, ITEM.c.size),
    (UPLOAD.c.user, UPLOAD.c.length),
)
_T = TypeVar("_T")


class TooManyError(TupliError):
    """There were too many attempts, or requests at a time; wait for `seconds`."""

    def __init__(self, seconds: float, text: str = "too many attempts; wait a minute") -> None:
        super().__init__(text)
        self.seconds = seconds


class Turns:
    """Lets each user have `most` requests answered at a time, so that one who asks much leaves threads and connections
    to the database to the others. Further requests wait for their turn, and keep no thread busy meanwhile. For one
    event loop."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._asked = Counter[str]()
        self._free = dict[str, asyncio.Semaphore]()

    @contextlib.asynccontextmanager
    async def turn(self, caller: Caller, address: str) -> AsyncIterator[None]:
        """The turn of a request, which ends with the block. Guests are told apart by their addresses. TooManyError if
        too many requests of this caller wait already."""
        user = f"guest at {address}" if caller.is_guest else caller.name
        if self._asked[user] >= self._most + _MOST_WAITING:
            raise TooManyError(1, "too many requests at a time; wait for the answers to earlier ones")
        self._asked[user] += 1
        try:
            async with self._free.setdefault(user, asyncio.Semaphore(self._most)):
                yield
        finally:
            self._asked[user] -= 1
            if not self._asked[user]:
                del self._asked[user], self._free[user]

    async def each(self, caller: Caller, address: str, pieces: AsyncIterable[_T]) -> AsyncIterator[_T]:
        """The pieces of an answer, each made in a turn of its own: a client that reads slowly keeps none."""
        remaining = aiter(pieces)
        while True:
            async with self.turn(caller, address):
                try:
                    piece = await anext(remaining)
                except StopAsyncIteration:
                    return
            yield piece


def demand_few_failures(connection: Connection, most: Mapping[str, int]) -> None:
    """Raises TooManyError if a key has failed too often. most: by key, how many failures a minute may have."""
    now = int(time.time())
    counted = select(FAILURE.c.key, func.count(), func.min(FAILURE.c.time)).group_by(FAILURE.c.key)
    recent = counted.where(_is_recent(now), FAILURE.c.key.in_(map(escape_text, most)))
    full = {escape_text(key): allowed for key, allowed in most.items()}
    first = [since for key, count, since in connection.execute(recent) if count >= full[key]]
    if first:
        raise TooManyError(max(first) + _SECONDS - now)


def _is_recent(now: int) -> ColumnElement[bool]:
    """The failures of the last minute. A later one is from before the clock was set back; whoever has failed then would
    wait until that time comes again."""
    return FAILURE.c.time.between(now - _SECONDS + 1, now)


def note_attempt(connection: Connection, most: Mapping[str, int], *, failed: bool) -> None:
    """Notes the end of an attempt, in the transaction that does what it was made for. Raises as `demand_few_failures`
    does: of attempts at the same time, those that end after too many have failed are refused, right or wrong, and tell
    nothing of a password."""
    demand_few_failures(connection, most)
    if failed:
        now = int(time.time())
        connection.execute(delete(FAILURE).where(not_(_is_recent(now))))
        connection.execute(insert(FAILURE), [{"key": escape_text(key), "time": now} for key in most])


# --- quotas ---


class FullError(StorageError):
    """A user's quota is used up, or the server's disk is full."""


class Usage(NamedTuple):
    """The bytes that a user has stored, and may store (`quota`; None: without a limit). own_quota: None if the quota is
    that of the settings."""

    used: int
    quota: int | None
    own_quota: int | None


def usages(connection: Connection, settings: Settings) -> dict[str, Usage]:
    """What each user has stored, and may store."""
    used = Counter[str]()
    for owner, size in _SIZES:
        for name, total in connection.execute(select(owner, func.sum(size)).group_by(owner)):
            used[name] += int(total)
    quotas = connection.execute(select(USER.c.name, USER.c.quota))
    return {name: Usage(used[name], settings.quota if own is None else own, own) for name, own in quotas}


def used_by(connection: Connection, user: str) -> int:
    """The bytes that a user has stored, with the final sizes of unfinished uploads."""
    sums = (select(func.coalesce(func.sum(size), 0)).where(owner == user) for owner, size in _SIZES)
    return sum(int(connection.execute(each).scalar_one()) for each in sums)


def quota_of(connection: Connection, settings: Settings, user: str) -> int | None:
    """How many bytes a user may store; None without a limit."""
    own: int | None = connection.execute(select(USER.c.quota).where(USER.c.name == user)).scalar()
    return settings.quota if own is None else own


def set_quota(connection: Connection, caller: Caller, user: str, size: int | None) -> None:
    """Gives a user a quota of their own (bytes); None for the quota of the settings. NotFoundError if there is no such
    user."""
    caller.demand(Right.USER_UPDATE)
    if not connection.execute(update(USER).where(USER.c.name == user).values(quota=size)).rowcount:
        raise NotFoundError("User does not exist")
    audit(connection, caller.name, "set_quota", f"{user}: {size}")


def demand_room(connection: Connection, settings: Settings, caller: Caller, size: int) -> None:
    """Raises FullError if a caller may not store so many bytes more."""
    allowed = quota_of(connection, settings, caller.name)
    if allowed is None:
        return
    used = used_by(connection, caller.name)
    if used + size > allowed:
        raise FullError(
            f"{caller.name} may store {plural(allowed, 'byte')}, and would use {used + size:,} with this; delete "
            "artifacts or whole recordings, or ask the server's admin for a larger quota "
            f"(tupli-mcap set-quota {caller.name})"
        )
