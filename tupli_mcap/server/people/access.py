"""Rights, the roles that give them, and the one condition for what a caller may read.

A user has roles in groups. A right counts in the group where a role gives it, and everywhere if that group is `global`.
Reading is the exception: private items stay private for an admin too. Every user has a group of their own, with their
name. An item can be read by its owner, and by users with the right to read in a group in which it is published.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from typing import Any, Final, NamedTuple, TypeVar

from sqlalchemy import Connection, FromClause, and_, literal, not_, or_, select, union_all
from sqlalchemy.sql.elements import ColumnElement

from tupli_mcap.errors import TupliError, did_you_mean
from tupli_mcap.schema import DBItem, Right
from tupli_mcap.server.tables import AUDIENCE, FILE, GROUP, USER
from tupli_mcap.storage.catalog.tables import EPISODE, RECORDING, TALLY, first_of
from tupli_mcap.storage.texts import escape_text

_Item = TypeVar("_Item", bound=DBItem)
GLOBAL: Final = "global"
"""The group of all signed-in users."""
ADMIN: Final = "admin"
"""The role that has all rights."""
GUEST: Final = "$$GUEST$$"
"""The name of a caller who is not signed in; no user can have it."""


# Recordings that another user has stored before.
_COPIES: Final = select(FILE.c.uuid).where(FILE.c.rank > 0).limit(1)


class DeniedError(TupliError):
    """The caller lacks the right to do this."""


def _content(*verbs: str) -> frozenset[Right]:
    return frozenset(
        Right(f"{kind}_{verb}") for kind in ("benchmark", "artifact", "episode") for verb in verbs
    )


_USERS: Final = frozenset({Right.USER_CREATE, Right.USER_READ, Right.USER_UPDATE, Right.USER_DELETE})
_GROUPS: Final = frozenset({Right.GROUP_CREATE, Right.GROUP_READ, Right.GROUP_UPDATE, Right.GROUP_DELETE})

DEFAULT_ROLES: Final[Mapping[str, frozenset[Right]]] = {
    ADMIN: frozenset(Right),
    "content_admin": _content("create", "read", "delete"),
    "user_admin": _USERS,
    "group_admin": _GROUPS | {Right.USER_READ},
    "contributor": _content("create", "read"),
    "member": _content("read") | {Right.GROUP_READ, Right.USER_READ},
    "global_member": _content("read") | {Right.GROUP_CREATE, Right.USER_READ},
    "guest": _content("read"),
}


class Caller(NamedTuple):
    """The user or guest who sends a request: the rights in each group, and whether the token allows writing.

    epoch: how often the user's password was changed. sign_in: the sign-in by which the caller is known, or the id of a
    token for machines (`is_machine`).
    """

    name: str
    rights: Mapping[str, frozenset[Right]]
    may_write: bool = True
    epoch: int = 0
    sign_in: str = ""
    is_machine: bool = False

    @property
    def is_guest(self) -> bool:
        """Whether nobody is signed in."""
        return self.name == GUEST

    def may(self, right: Right, group: str = GLOBAL) -> bool:
        """Whether the caller has a right in a group, or everywhere."""
        return any(right in self.rights.get(name, ()) for name in (group, GLOBAL))

    def groups_with(self, right: Right) -> list[str]:
        """The groups in which the caller has a right."""
        return [group for group, rights in self.rights.items() if right in rights]

    def demand(self, right: Right, group: str = GLOBAL) -> None:
        """Raises DeniedError unless the caller has a right in a group, or everywhere."""
        if not self.may(right, group):
            raise DeniedError(
                f"Insufficient permissions in group: {group}. Required: {right}; "
                "ask an admin for a role that gives it"
            )


def readable(
    caller: Caller, right: Right, created_by: ColumnElement[Any], published_in: ColumnElement[Any]
) -> ColumnElement[bool]:
    """The condition for what a caller may read. No other code decides this.

    created_by, published_in: columns of the queried table.
    """
    groups = [escape_text(group) for group in caller.groups_with(right)]
    seen = select(AUDIENCE.c.published_in).where(AUDIENCE.c.team.in_(groups))
    return or_(created_by == escape_text(caller.name), published_in.in_(seen))


def readable_episodes(connection: Connection, caller: Caller) -> ColumnElement[bool]:
    """The condition on EPISODE for the episodes that a caller may read, of which no two have the same id.

    Anybody can store a file with the UUID of somebody else's recording, and refusing it would reveal that this exists.
    So an id shows the caller's own episode, or else that of the user who was the first to store a recording of this
    UUID; the others do not exist for the caller as long as that one may be read.
    """
    seen = _seen(caller, EPISODE)
    if connection.execute(_COPIES).first() is None:  # as nearly always
        return seen
    copied = (
        select(FILE.c.uuid)
        .join(RECORDING, RECORDING.c.path == FILE.c.path)
        .join(TALLY, TALLY.c.recording_id == RECORDING.c.id)
        .where(FILE.c.rank > 0, _seen(caller, TALLY))
    )
    if connection.execute(copied.limit(1)).first() is None:
        return seen
    file, other, recording, episode = FILE.alias(), FILE.alias(), RECORDING.alias(), EPISODE.alias()
    same = select(episode.c.id).where(
        and_(RECORDING.c.id == EPISODE.c.recording_id, file.c.path == RECORDING.c.path),
        and_(other.c.uuid == file.c.uuid, recording.c.path == other.c.path),
        and_(episode.c.id == first_of(recording.c.id) + EPISODE.c.episode, _seen(caller, episode)),
    )
    name = escape_text(caller.name)
    better = (other.c.created_by == name, other.c.rank < file.c.rank)  # apart, each by its index
    before = [same.where(of).correlate(EPISODE).exists() for of in better]
    recordings = select(RECORDING.c.id).where(RECORDING.c.uuid.in_(copied))
    of_others = and_(EPISODE.c.recording_id.in_(recordings), EPISODE.c.created_by != name)
    return and_(seen, not_(and_(of_others, or_(*before))))


def _seen(caller: Caller, rows: FromClause) -> ColumnElement[bool]:
    return readable(caller, Right.EPISODE_READ, rows.c.created_by, rows.c.published_in)


def known_audiences(
    connection: Connection, caller: Caller, among: Set[str]
) -> Callable[[str, Sequence[str]], list[str]]:
    """A function of an item's owner and groups (some `among` these): those of the groups that the caller may know of.
    Every list of groups that is sent goes through it.

    Nobody is told of groups that are gone. The owner knows the others; everybody else, their own and `global`, and with
    the right to read groups or users in `global`, the names of these.
    """
    own = {GLOBAL, *caller.rights}
    there, known = set(own), set(own)
    if others := among - own:
        kinds = {Right.GROUP_READ: GROUP.c.name, Right.USER_READ: USER.c.name}
        named = (select(name, literal(right.value)).where(name.in_(others)) for right, name in kinds.items())
        for name, right in connection.execute(union_all(*named)):
            there.add(name)
            if caller.may(Right(right)):
                known.add(name)

    def shown(owner: str, names: Sequence[str]) -> list[str]:
        seen = there if owner == caller.name else known
        return [name for name in names if name in seen or name == owner]

    return shown


def as_told(connection: Connection, caller: Caller, items: Sequence[_Item]) -> list[_Item]:
    """The same items, but published only in groups of which the caller may know."""
    known = known_audiences(connection, caller, {name for item in items for name in item.published_in})
    return [
        item.model_copy(update={"published_in": known(item.created_by, item.published_in)}) for item in items
    ]


def demand_audience(connection: Connection, caller: Caller, right: Right, group: str) -> None:
    """Raises DeniedError without the right to publish in a group, or in a user's own one. A group that is not there is
    refused, since whoever makes one of that name later would see what was published."""
    demand_known(connection, caller, group)
    caller.demand(right, group)


def demand_known(connection: Connection, caller: Caller, group: str) -> None:
    """Raises DeniedError for a group that is not there, or that the caller may not know of, in the same words."""
    if group not in (GLOBAL, *caller.rights):
        known = {Right.GROUP_READ: GROUP.c.name, Right.USER_READ: USER.c.name}
        names = [select(name).where(name == group) for right, name in known.items() if caller.may(right)]
        if not any(connection.execute(query).first() for query in names):
            raise DeniedError(
                f"Insufficient permissions in group: {group:.100}. It does not exist, or you are not in it"
                f"{did_you_mean(group, caller.rights)}; `tupli-mcap list-groups` lists the groups that you may see"
            )


def left_alone(created_by: ColumnElement[Any], published_in: ColumnElement[Any]) -> ColumnElement[bool]:
    """The condition for what only deleted users could see.

    created_by, published_in: columns of the queried table.
    """
    users = select(USER.c.name)
    there = or_(
        AUDIENCE.c.team == GLOBAL, AUDIENCE.c.team.in_(users), AUDIENCE.c.team.in_(select(GROUP.c.name))
    )
    seen = select(AUDIENCE.c.published_in).where(there)
    return and_(created_by.not_in(users), published_in.not_in(seen))
