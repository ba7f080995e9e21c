"""How much a user has stored, and may store. Every function works in the transaction of its caller."""

from __future__ import annotations

from sqlalchemy import Connection, func, select, update

from tupli_mcap.errors import NotFoundError, StorageError
from tupli_mcap.server.people.access import Caller
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.tables import FILE, ITEM, UPLOAD, USER


class FullError(StorageError):
    """A user's quota is used up, or the server's disk is full."""


def used_by(connection: Connection, user: str) -> int:
    """The bytes that a user has stored, with the final sizes of unfinished uploads."""
    sums = (
        select(func.coalesce(func.sum(size), 0)).where(owner == user)
        for size, owner in (
            (FILE.c.size, FILE.c.created_by),
            (ITEM.c.size, ITEM.c.created_by),
            (UPLOAD.c.length, UPLOAD.c.user),
        )
    )
    return sum(int(connection.execute(each).scalar_one()) for each in sums)


def quota_of(connection: Connection, settings: Settings, user: str) -> int | None:
    """How many bytes a user may store; None without a limit."""
    own: int | None = connection.execute(select(USER.c.quota).where(USER.c.name == user)).scalar()
    return settings.quota if own is None else own


def set_quota(connection: Connection, user: str, size: int | None) -> None:
    """Gives a user a quota of their own (bytes); None for the quota of the settings. NotFoundError if there is no such
    user."""
    if not connection.execute(update(USER).where(USER.c.name == user).values(quota=size)).rowcount:
        raise NotFoundError("User does not exist")


def demand_room(connection: Connection, settings: Settings, caller: Caller, size: int) -> None:
    """Raises FullError if a caller may not store so many bytes more."""
    allowed = quota_of(connection, settings, caller.name)
    if allowed is None:
        return
    used = used_by(connection, caller.name)
    if used + size > allowed:
        raise FullError(
            f"{caller.name} may store {allowed} bytes, uses {used}, and cannot store {size} more; delete something, "
            "or ask the server's admin for a larger quota"
        )
