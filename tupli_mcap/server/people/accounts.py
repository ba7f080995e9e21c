"""Users, groups and roles. Functions that take a connection work in the transaction of their caller."""

from __future__ import annotations

import json
import re
import time
import unicodedata
from collections.abc import Iterable, Sequence
from typing import Any, Final

from pwdlib import PasswordHash
from pwdlib.hashers.argon2 import Argon2Hasher
from sqlalchemy import Connection, delete, insert, select, update

from tupli_mcap.errors import NotFoundError, StorageError
from tupli_mcap.schema import Group, GroupWithMembers, Right, UserRole
from tupli_mcap.server.database import audit, demand_few
from tupli_mcap.server.people.access import ADMIN, DEFAULT_ROLES, GLOBAL, GUEST, Caller, DeniedError
from tupli_mcap.server.tables import (
    API_TOKEN,
    GROUP,
    MEMBERSHIP,
    PRINCIPAL,
    REFRESH_TOKEN,
    ROLE,
    UPLOAD,
    USER,
)

# The minimum that OWASP recommends: a sign-in takes 19 MiB, and one core.
_HASHES: Final = PasswordHash((Argon2Hasher(time_cost=2, memory_cost=19 << 10, parallelism=1),))
_DUMMY: Final = _HASHES.hash("nobody has this password")
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@+-]{0,63}")
_IN_ADDRESSES: Final = re.compile(r"(?!\.+$)[^/\\\x00-\x1f\x7f]{1,100}")  # which cannot have a part of dots
_OWN_ROLES: Final = ("user_admin", "contributor")  # in the group of the user's own name
_EVERYBODY_S_ROLES: Final = ("global_member", "contributor")  # in `global`
_CREATOR_S_ROLES: Final = ("group_admin", "contributor")
_MEMBERSHIPS: Final = (MEMBERSHIP.c.user, MEMBERSHIP.c.team, MEMBERSHIP.c.role)
_TAKEN: Final = ", or a user or a group has or had this name, or one that looks like it; choose another name"
_BLANK: Final = "\u115f\u1160\u2800\u3164\uffa0"  # letters and symbols that draw nothing
_MOST_PASSWORD: Final = 1024
_MOST_DESCRIPTION: Final = 1000
_MOST_GROUPS: Final = 100  # of a user, with those that are deleted: names cannot be used again
_MOST_AT_ONCE: Final = (
    1000  # roles that are given, or members removed, in one transaction, for which others wait
)


class ConflictError(StorageError):
    """The name is taken."""


def prepare(connection: Connection) -> None:
    """Adds missing reserved names and default roles."""
    for name in (GLOBAL, GUEST):
        _reserve(connection, name, "reserved")
    known = set(connection.execute(select(ROLE.c.name)).scalars())
    for name, rights in DEFAULT_ROLES.items():
        if name not in known:
            _add_role(connection, name, sorted(rights), None, builtin=True)


# --- users ---


def create_user(connection: Connection, name: str, hashed: str) -> None:
    """Creates a user with the hash of a password, see `hash_password`. StorageError if the name is not valid,
    ConflictError if a user or a group has or had it."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise StorageError(
            "expected a user name of 1 to 64 letters, digits and any of . _ @ + -, which begins with a letter or a "
            f"digit, found {name!r:.80}"
        )
    if not _reserve(connection, name, "user"):
        raise ConflictError(f"User already exists{_TAKEN}")
    row = {"name": name, "password": hashed, "epoch": 0, "created_at": int(time.time())}
    connection.execute(insert(USER).values(**row))


def verify_password(connection: Connection, name: str, password: str) -> bool:
    """Whether a user has this password. Takes as long for an unknown user, so that the time does not reveal names."""
    found = connection.execute(select(USER.c.password).where(USER.c.name == name)).scalar()
    valid = _HASHES.verify(password[:_MOST_PASSWORD], found or _DUMMY)
    return valid and found is not None


def epoch_of(connection: Connection, name: str) -> int | None:
    """How often a user's password was changed; None if there is no such user."""
    epoch: int | None = connection.execute(select(USER.c.epoch).where(USER.c.name == name)).scalar()
    return epoch


def change_password(connection: Connection, name: str, hashed: str) -> None:
    """Changes a user's password to one of this hash, and ends all sign-ins and tokens of the user. NotFoundError if
    there is no such user."""
    changed = connection.execute(
        update(USER).where(USER.c.name == name).values(password=hashed, epoch=USER.c.epoch + 1)
    )
    if not changed.rowcount:
        raise NotFoundError("User does not exist")
    _revoke(connection, name)


def delete_user(connection: Connection, name: str) -> bool:
    """Deletes a user with all tokens, memberships and unfinished uploads; returns whether there was one. The name
    cannot be used again: another user of this name would own what this user stored. DeniedError for the only admin."""
    _demand_other_admin(connection, name)
    gone = connection.execute(delete(USER).where(USER.c.name == name)).rowcount
    connection.execute(delete(MEMBERSHIP).where(MEMBERSHIP.c.user == name))
    connection.execute(delete(UPLOAD).where(UPLOAD.c.user == name))  # a clean-up deletes the files
    _revoke(connection, name)
    return bool(gone)


def demand_over(connection: Connection, caller: Caller, name: str) -> None:
    """Raises DeniedError for a user with rights in `global` that the caller lacks: by setting their password, the
    caller would get these rights; by deleting them, lock out the people who run the server."""
    other = caller_named(connection, name)
    if other is not None and name != caller.name:
        for right in sorted(other.rights[GLOBAL]):
            caller.demand(right)


def _demand_other_admin(connection: Connection, name: str) -> None:
    """Raises DeniedError if a user is the only admin: without one, nobody could make another."""
    admins = select(MEMBERSHIP.c.user).where(MEMBERSHIP.c.team == GLOBAL, MEMBERSHIP.c.role == ADMIN)
    if connection.execute(admins).scalars().all() == [name]:
        raise DeniedError(
            f"{name} is the only admin of this server; first give another user the role {ADMIN} in the group {GLOBAL}"
        )


def list_users(connection: Connection, caller: Caller) -> dict[str, dict[str, list[str]]]:
    """All users, oldest first, each with the roles by group, as from `memberships_of`, in the groups that the caller
    may see."""
    names = connection.execute(select(USER.c.name).order_by(USER.c.created_at, USER.c.name)).scalars()
    every = connection.execute(select(*_MEMBERSHIPS).order_by(*_MEMBERSHIPS))
    found = _with_memberships(list(names), every)
    seen = {GLOBAL, *(group.name for group in list_groups(connection, caller))}
    return {
        name: {group: roles for group, roles in held.items() if group in seen or group == name}
        for name, held in found.items()
    }


def caller_named(connection: Connection, name: str, *, may_write: bool = True) -> Caller | None:
    """A user as a caller; None if there is no such user."""
    both = USER.outerjoin(MEMBERSHIP, MEMBERSHIP.c.user == USER.c.name)
    query = select(USER.c.epoch, *_MEMBERSHIPS).select_from(both).where(USER.c.name == name)
    found = connection.execute(query.order_by(*_MEMBERSHIPS)).all()
    if not found:
        return None
    held = _with_memberships([name], (row[1:] for row in found if row.role is not None))
    rights: dict[str, frozenset[Right]] = {}
    for group, roles in held[name].items():
        rights[group] = frozenset[Right]().union(*(_rights_of(connection, role) for role in roles))
    return Caller(name, rights, may_write, found[0].epoch)


def guest(connection: Connection) -> Caller:
    """The caller who is not signed in."""
    return Caller(GUEST, {GLOBAL: _rights_of(connection, "guest")}, may_write=False)


def memberships_of(connection: Connection, name: str) -> dict[str, list[str]]:
    """The roles of a user by group, with the roles that every user has."""
    of_user = select(*_MEMBERSHIPS).where(MEMBERSHIP.c.user == name).order_by(*_MEMBERSHIPS)
    return _with_memberships([name], connection.execute(of_user))[name]


def _with_memberships(names: Sequence[str], rows: Iterable[Any]) -> dict[str, dict[str, list[str]]]:
    """The roles of users by group, with the roles that every user has. `rows` are of `_MEMBERSHIPS`, in their order."""
    found = {name: {GLOBAL: list(_EVERYBODY_S_ROLES), name: list(_OWN_ROLES)} for name in names}
    for user, group, role in rows:
        roles = found[user].setdefault(group, [])
        if role not in roles:
            roles.append(role)
    return found


def hash_password(password: str, shortest: int) -> str:
    """The hash of a new password. Takes a while, for which others would wait in a writing transaction. StorageError if
    the password has fewer than `shortest` characters, or too many, or one that UTF-8 cannot hold."""
    if not isinstance(password, str) or not shortest <= len(password) <= _MOST_PASSWORD:
        found = f"{len(password)} characters" if isinstance(password, str) else "no text"
        raise StorageError(
            f"expected a password of {shortest} to {_MOST_PASSWORD} characters, found {found}; choose another"
        )
    try:
        return _HASHES.hash(password)
    except UnicodeEncodeError as err:
        raise StorageError(
            "expected a password in UTF-8, found a lone surrogate in it; choose another"
        ) from err


def _revoke(connection: Connection, name: str) -> None:
    for table in (REFRESH_TOKEN, API_TOKEN):
        connection.execute(delete(table).where(table.c.user == name))


def _reserve(connection: Connection, name: str, kind: str) -> bool:
    """Takes a name; False if it is taken, or looks like one that is: somebody might publish in the wrong group."""
    alike = _alike(name)
    if any(_alike(taken) == alike for taken in connection.execute(select(PRINCIPAL.c.name)).scalars()):
        return False
    connection.execute(insert(PRINCIPAL).values(name=name, kind=kind))
    return True


def _alike(name: str) -> str:
    """What names that look alike have in common: without case, accents, widths, spaces, and what draws nothing."""
    if name.isascii():
        return name.lower().replace(" ", "")
    plain = unicodedata.normalize("NFKD", name).casefold()
    return "".join(c for c in plain if unicodedata.category(c)[0] not in "MZC" and c not in _BLANK)


# --- groups ---


def create_group(connection: Connection, caller: Caller, name: str, description: str | None) -> None:
    """Creates a group with the caller as its admin. ConflictError if a user or a group has or had the name,
    StorageError if it is not valid, or the caller has created too many groups."""
    caller.demand(Right.GROUP_CREATE)
    if not caller.may(Right.ROLE_MANAGEMENT):
        demand_few(connection, caller.name, "create_group", _MOST_GROUPS)
    _demand_short(description)
    _demand_name("group", name)
    if not _reserve(connection, name, "group"):
        raise ConflictError(f"Group already exists{_TAKEN}")
    connection.execute(insert(GROUP).values(name=name, description=description))
    for role in _CREATOR_S_ROLES:
        connection.execute(insert(MEMBERSHIP).values(user=caller.name, team=name, role=role))
    audit(connection, caller.name, "create_group", name)


def list_groups(connection: Connection, caller: Caller) -> list[Group]:
    """The groups that the caller may see: their own; all, with `group_read` in `global`."""
    query = select(GROUP.c.name, GROUP.c.description).order_by(GROUP.c.name)
    if Right.GROUP_READ not in caller.rights.get(GLOBAL, ()):
        query = query.where(GROUP.c.name.in_(list(caller.rights)))
    return [Group(name=name, description=description) for name, description in connection.execute(query)]


def members_of(connection: Connection, caller: Caller, name: str) -> GroupWithMembers:
    """A group and its members, the oldest users first. NotFoundError if there is none that the caller may see."""
    _known(connection, caller, name)
    description = connection.execute(select(GROUP.c.description).where(GROUP.c.name == name)).scalar()
    roles: dict[str, list[str]] = {}
    if not caller.may(Right.USER_READ, name):
        return GroupWithMembers(name=name, description=description)
    chosen = (
        select(MEMBERSHIP.c.user, MEMBERSHIP.c.role)
        .join(USER, USER.c.name == MEMBERSHIP.c.user)
        .where(MEMBERSHIP.c.team == name)
        .order_by(USER.c.created_at, USER.c.name, MEMBERSHIP.c.role)
    )
    for user, role in connection.execute(chosen):
        roles.setdefault(user, []).append(role)
    return GroupWithMembers(name=name, description=description, members=list(roles), roles=roles)


def delete_group(connection: Connection, caller: Caller, name: str) -> None:
    """Deletes a group; its name cannot be used again. Raises NotFoundError, DeniedError."""
    if name == GLOBAL:
        raise DeniedError("everybody is in the group global; it cannot be deleted")
    _known(connection, caller, name)
    caller.demand(Right.GROUP_DELETE, name)
    connection.execute(delete(GROUP).where(GROUP.c.name == name))
    connection.execute(delete(MEMBERSHIP).where(MEMBERSHIP.c.team == name))
    audit(connection, caller.name, "delete_group", name)


def add_members(
    connection: Connection, caller: Caller, group: str, members: Sequence[tuple[str, Sequence[str]]]
) -> None:
    """Gives users further roles in a group. Nobody can give a right that they lack, and a token for machines none on
    the whole server: a stolen one could else make an admin.

    members: names of users, each with the roles.

    Raises:
        NotFoundError: there is no such group, role or user.
        DeniedError: the caller may not change the group, lacks a right of the roles, or is a machine.
        StorageError: there are too many members or roles at a time.
    """
    _known(connection, caller, group)
    caller.demand(Right.GROUP_UPDATE, group)
    if group == GLOBAL and caller.is_machine:
        raise DeniedError(
            "a token for machines gives no roles on the whole server; sign in with the password"
        )
    _demand_few(sum(1 + len(roles) for _, roles in members))
    known = {role.role for role in list_roles(connection)}
    for user, roles in members:
        for role in roles:
            if role not in known:
                raise NotFoundError(f"Role {role} not found")
            for right in sorted(_rights_of(connection, role)):
                caller.demand(right, group)
        if not connection.execute(select(USER.c.name).where(USER.c.name == user)).first():
            raise NotFoundError(f"User {user} not found")
        held = select(MEMBERSHIP.c.role).where(MEMBERSHIP.c.user == user, MEMBERSHIP.c.team == group)
        for role in set(roles) - set(connection.execute(held).scalars()):
            connection.execute(insert(MEMBERSHIP).values(user=user, team=group, role=role))
        audit(connection, caller.name, "add_member", f"{group}: {user} {', '.join(roles)}")


def _demand_few(found: int) -> None:
    if found > _MOST_AT_ONCE:
        raise StorageError(
            f"expected at most {_MOST_AT_ONCE} members and roles at a time, found {found}; send some of them"
        )


def remove_members(connection: Connection, caller: Caller, group: str, users: Sequence[str]) -> None:
    """Takes users out of a group; nothing happens to those who are not in it. Raises as `add_members` does, and
    DeniedError for the only admin, in `global`."""
    _known(connection, caller, group)
    caller.demand(Right.GROUP_UPDATE, group)
    _demand_few(len(users))
    for user in users:
        if group == GLOBAL:
            demand_over(connection, caller, user)
            _demand_other_admin(connection, user)
        gone = delete(MEMBERSHIP).where(MEMBERSHIP.c.team == group, MEMBERSHIP.c.user == user)
        connection.execute(gone)
        audit(connection, caller.name, "remove_member", f"{group}: {user}")


def may_open(caller: Caller, group: str) -> bool:
    """Whether the caller may see more of a group than its name."""
    rights = (Right.GROUP_READ, Right.GROUP_UPDATE, Right.GROUP_DELETE)
    return any(caller.may(right, group) for right in rights)


def _known(connection: Connection, caller: Caller, group: str) -> None:
    """Raises NotFoundError for a group that does not exist, or that the caller may not see."""
    is_group = group == GLOBAL or connection.execute(select(GROUP).where(GROUP.c.name == group)).first()
    if not is_group or not may_open(caller, group):
        raise NotFoundError("Group not found")


def _demand_name(kind: str, name: str) -> None:
    """Raises StorageError for a name of a group or a role that is not valid."""
    if not (isinstance(name, str) and name.isprintable() and _IN_ADDRESSES.fullmatch(name) and _alike(name)):
        raise StorageError(
            f"expected a {kind} name of 1 to 100 printable characters, without slashes and not only dots, "
            f"found {name!r:.80}"
        )


# --- roles ---


def create_role(
    connection: Connection, caller: Caller, name: str, rights: Sequence[str], description: str | None
) -> None:
    """Creates a role. Raises ConflictError if the name is taken, StorageError if it is not valid, or for an unknown
    right."""
    caller.demand(Right.ROLE_MANAGEMENT)
    _demand_short(description)
    _demand_name("role", name)
    unknown = [right for right in rights if right not in set(Right)]
    if unknown:
        raise StorageError(f"expected the rights of a role, found {unknown!r:.200}")
    if connection.execute(select(ROLE.c.name).where(ROLE.c.name == name)).first():
        raise ConflictError("Role already exists")
    _add_role(connection, name, rights, description, builtin=False)
    audit(connection, caller.name, "create_role", name)


def list_roles(connection: Connection) -> list[UserRole]:
    """All roles."""
    rows = connection.execute(select(ROLE.c.name, ROLE.c.rights, ROLE.c.description).order_by(ROLE.c.name))
    return [UserRole(role=name, rights=json.loads(rights), description=told) for name, rights, told in rows]


def delete_role(connection: Connection, caller: Caller, name: str) -> None:
    """Deletes a role, and takes it from all who have it; nothing happens if there is no such role. DeniedError for a
    default role."""
    caller.demand(Right.ROLE_MANAGEMENT)
    if name in DEFAULT_ROLES:
        raise DeniedError(f"role {name} is one that the server needs; it cannot be deleted")
    connection.execute(delete(ROLE).where(ROLE.c.name == name))
    connection.execute(delete(MEMBERSHIP).where(MEMBERSHIP.c.role == name))
    audit(connection, caller.name, "delete_role", name)


def _demand_short(description: str | None) -> None:
    """Raises StorageError for a long description: it is in every list."""
    if description is not None and len(description) > _MOST_DESCRIPTION:
        raise StorageError(
            f"expected a description of at most {_MOST_DESCRIPTION} characters, found {len(description)}"
        )


def _add_role(
    connection: Connection, name: str, rights: Sequence[str], description: str | None, *, builtin: bool
) -> None:
    row = {"name": name, "rights": json.dumps(list(rights)), "description": description, "builtin": builtin}
    connection.execute(insert(ROLE).values(**row))


def _rights_of(connection: Connection, role: str) -> frozenset[Right]:
    if role in DEFAULT_ROLES:  # the code defines their rights, not the database
        return DEFAULT_ROLES[role]
    text = connection.execute(select(ROLE.c.rights).where(ROLE.c.name == role)).scalar()
    return frozenset(Right(right) for right in json.loads(text)) if text else frozenset()
