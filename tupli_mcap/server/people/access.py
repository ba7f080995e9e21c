"""Who may do what: rights, the roles that give them, and the one condition that says what a caller may read.

A user has roles in groups. A right counts in the group where a role gives it, and everywhere if that group is
`global`; reading is the exception: what is private stays so for an admin too. Everybody who is signed in has a group
of their own, with their name. An item is read by who made it, and by who may read in a group it is published in.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from sqlalchemy import Connection, and_, or_, select
from sqlalchemy.sql.elements import ColumnElement

from tupli_mcap.errors import TupliError
from tupli_mcap.schema import Right
from tupli_mcap.server.tables import AUDIENCE, GROUP, USER
from tupli_mcap.storage.texts import escape_text

__all__ = [
    "DEFAULT_ROLES",
    "GLOBAL",
    "GUEST",
    "Caller",
    "DeniedError",
    "Right",
    "demand_audience",
    "left_alone",
    "readable",
]

GLOBAL: Final = "global"
"""The group of everybody who is signed in."""
GUEST: Final = "$$GUEST$$"
"""The name of who is not signed in; no user can have it."""


class DeniedError(TupliError):
    """The caller has not the right to do this."""


def _content(*verbs: str) -> frozenset[Right]:
    return frozenset(
        Right(f"{kind}_{verb}") for kind in ("benchmark", "artifact", "episode") for verb in verbs
    )


_USERS: Final = frozenset({Right.USER_CREATE, Right.USER_READ, Right.USER_UPDATE, Right.USER_DELETE})
_GROUPS: Final = frozenset({Right.GROUP_CREATE, Right.GROUP_READ, Right.GROUP_UPDATE, Right.GROUP_DELETE})

DEFAULT_ROLES: Final[Mapping[str, frozenset[Right]]] = {
    "admin": frozenset(Right),
    "content_admin": _content("create", "read", "delete"),
    "user_admin": _USERS,
    "group_admin": _GROUPS | {Right.USER_READ},
    "contributor": _content("create", "read"),
    "member": _content("read") | {Right.GROUP_READ, Right.USER_READ},
    "global_member": _content("read") | {Right.GROUP_CREATE, Right.USER_READ},
    "guest": _content("read"),
}


class Caller(NamedTuple):
    """Who asks: a user, or a guest; the rights in each group, and whether the token at hand may change anything.

    epoch: how often the user's password was changed.
    """

    name: str
    rights: Mapping[str, frozenset[Right]]
    may_write: bool = True
    epoch: int = 0

    @property
    def is_guest(self) -> bool:
        """Whether nobody is signed in."""
        return self.name == GUEST

    def may(self, right: Right, group: str = GLOBAL) -> bool:
        """Whether a right is held in a group, or everywhere."""
        return any(right in self.rights.get(name, ()) for name in (group, GLOBAL))

    def groups_with(self, right: Right) -> list[str]:
        """The groups in which a right is held."""
        return [group for group, rights in self.rights.items() if right in rights]

    def demand(self, right: Right, group: str = GLOBAL) -> None:
        """Raises DeniedError without the right in the group, or everywhere."""
        if not self.may(right, group):
            raise DeniedError(f"Insufficient permissions in group: {group}. Required: {right}")


def readable(
    caller: Caller, right: Right, created_by: ColumnElement[Any], published_in: ColumnElement[Any]
) -> ColumnElement[bool]:
    """What a caller may read: the only place that says so.

    created_by, published_in: columns of the table that is asked.
    """
    groups = [escape_text(group) for group in caller.groups_with(right)]
    seen = select(AUDIENCE.c.published_in).where(AUDIENCE.c.team.in_(groups))
    return or_(created_by == escape_text(caller.name), published_in.in_(seen))


def demand_audience(connection: Connection, caller: Caller, right: Right, group: str) -> None:
    """Raises DeniedError without the right to publish in a group, or in a user's own one.

    A group that is not there is refused, since whoever makes one of that name later would see what was published; one
    that the caller may not know of is refused in the same words.
    """
    if group not in (GLOBAL, *caller.rights):
        known = {Right.GROUP_READ: GROUP.c.name, Right.USER_READ: USER.c.name}
        names = [select(name).where(name == group) for right, name in known.items() if caller.may(right)]
        if not any(connection.execute(query).first() for query in names):
            raise DeniedError(
                f"Insufficient permissions in group: {group:.100}. Either it is not there, or you are not in it; "
                "`tupli-mcap list-groups` names those that you may know of"
            )
    caller.demand(right, group)


def left_alone(created_by: ColumnElement[Any], published_in: ColumnElement[Any]) -> ColumnElement[bool]:
    """What a deleted user has left, and nobody can see any more.

    created_by, published_in: columns of the table that is asked.
    """
    users = select(USER.c.name)
    there = or_(
        AUDIENCE.c.team == GLOBAL, AUDIENCE.c.team.in_(users), AUDIENCE.c.team.in_(select(GROUP.c.name))
    )
    seen = select(AUDIENCE.c.published_in).where(there)
    return and_(created_by.not_in(users), published_in.not_in(seen))
