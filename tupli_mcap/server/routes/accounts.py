"""Signing in, users, groups, roles, and tokens for machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

from fastapi import APIRouter
from pydantic import BaseModel, FailFast, Field

from tupli_mcap.schema import (
    ApiToken,
    Group,
    GroupWithMembers,
    ListedUser,
    Me,
    Membership,
    Right,
    UserOut,
    UserRole,
)
from tupli_mcap.server.people import accounts, limits
from tupli_mcap.server.people.tokens import SignInError
from tupli_mcap.server.routes.callers import Address, Newcomer, Person, Reader, Served, Writer
from tupli_mcap.server.wire import REFUSALS, Asked
from tupli_mcap.storage.api.answers import TokenPair

router = APIRouter(prefix="/v1", tags=["accounts"], responses=REFUSALS)


class Credentials(BaseModel):
    """A user's name and password."""

    username: str
    password: str


class Refresh(Asked):
    """The refresh token of the last answer."""

    refresh_token: str


class Quota(Asked):
    """How many bytes a user may store; None for the server's quota."""

    bytes: int | None = Field(ge=0, le=1 << 60, strict=True)


class Password(Asked):
    """A new password; `old` is needed to change one's own."""

    password: str
    old: str | None = None


class Member(Asked):
    """A user in a group."""

    user: str
    roles: list[str] = Field(default_factory=lambda: ["member"], fail_fast=True)


class NewToken(Asked):
    """A token for a machine: its name, its scope (`read` or `write`), and its days (None: for ever)."""

    name: str
    scope: str = "read"
    days: int | None = Field(default=90, ge=1, le=3650)


def memberships(held: Mapping[str, Sequence[str]]) -> list[Membership]:
    """The roles that a user holds, by group."""
    return [Membership(group=group, roles=list(roles)) for group, roles in held.items()]


@router.post("/tokens")
def sign_in(library: Served, address: Address, told: Credentials) -> TokenPair:
    """Signs in."""
    return TokenPair(**library.sign_in(told.username, told.password, address))


@router.post("/tokens/refresh")
def refresh(library: Served, told: Refresh) -> TokenPair:
    """Exchanges a refresh token for a new pair. If the answer was lost, it can be exchanged again within an hour, until
    the new one is; any other second use ends the sign-in."""
    with library.database.writing() as connection:
        pair = library.tokens.refreshed(connection, told.refresh_token)
    if pair is None:
        raise SignInError("the refresh token was used before: this sign-in is ended; sign in again")
    return TokenPair(**pair)


@router.post("/tokens/end")
def sign_out(library: Served, told: Refresh) -> None:
    """Ends the sign-in of a refresh token."""
    with library.database.writing() as connection:
        library.tokens.end(connection, told.refresh_token)


@router.get("/me")
def who_am_i(library: Served, caller: Reader) -> Me:
    """The caller."""
    if caller.is_guest:
        return Me(username=caller.name, memberships=memberships({"global": ["guest"]}))
    with library.database.reading() as connection:
        return Me(
            username=caller.name,
            memberships=memberships(accounts.memberships_of(connection, caller.name)),
            used=limits.used_by(connection, caller.name),
            quota=limits.quota_of(connection, library.settings, caller.name),
        )


@router.post("/users")
def create_user(library: Served, caller: Newcomer, address: Address, told: Credentials) -> UserOut:
    """Creates a user. Everybody may if the server is open to sign-ups; else it takes the right `user_create`."""
    library.create_user(caller, told.username, told.password, address)
    with library.database.reading() as connection:
        held = accounts.memberships_of(connection, told.username)
    return UserOut(username=told.username, memberships=memberships(held))


@router.get("/users")
def list_users(library: Served, caller: Reader) -> list[ListedUser]:
    """All users; for callers with the right `user_update`, with what they have stored, and may store."""
    caller.demand(Right.USER_READ)
    stored: dict[str, limits.Usage] = {}
    with library.database.reading() as connection:
        users = accounts.list_users(connection, caller)
        if caller.may(Right.USER_UPDATE):
            stored = limits.usages(connection, library.settings)
    told = {name: {"used": usage.used, "quota": usage.quota} for name, usage in stored.items()}
    return [
        ListedUser(username=name, memberships=memberships(held), **told.get(name, {}))
        for name, held in users.items()
    ]


@router.delete("/users/{username}")
def delete_user(library: Served, caller: Person, username: str) -> None:
    """Deletes a user, and what only they could see; the name cannot be used again."""
    library.delete_user(caller, username)


@router.put("/users/{username}/quota")
def set_quota(library: Served, caller: Writer, username: str, told: Quota) -> None:
    """Sets how much a user may store."""
    with library.database.writing() as connection:
        limits.set_quota(connection, caller, username, told.bytes)


@router.put("/users/{username}/password")
def change_password(library: Served, caller: Person, username: str, told: Password) -> None:
    """Changes a password, and ends all sign-ins and tokens of the user."""
    old = (told.old or "") if username == caller.name else None
    library.change_password(caller, username, told.password, old=old)


@router.post("/groups")
def create_group(library: Served, caller: Writer, told: Group) -> Group:
    """Creates a group with the caller as its admin."""
    with library.database.writing() as connection:
        accounts.create_group(connection, caller, told.name, told.description)
    return told


@router.get("/groups")
def list_groups(library: Served, caller: Reader) -> list[Group]:
    """The groups that the caller may see."""
    with library.database.reading() as connection:
        return accounts.list_groups(connection, caller)


@router.get("/groups/{name}")
def read_group(library: Served, caller: Reader, name: str) -> GroupWithMembers:
    """A group and its members."""
    with library.database.reading() as connection:
        return accounts.members_of(connection, caller, name)


@router.delete("/groups/{name}")
def delete_group(library: Served, caller: Writer, name: str) -> None:
    """Deletes a group; its name cannot be used again."""
    with library.database.writing() as connection:
        accounts.delete_group(connection, caller, name)


@router.put("/groups/{name}/members")
def add_members(
    library: Served, caller: Writer, name: str, told: Annotated[list[Member], FailFast()]
) -> GroupWithMembers:
    """Gives users roles in a group: to all of them, or to none."""
    with library.database.writing() as connection:
        accounts.add_members(connection, caller, name, [(member.user, member.roles) for member in told])
        return accounts.members_of(connection, caller, name)


@router.delete("/groups/{name}/members/{user}")
def remove_member(library: Served, caller: Writer, name: str, user: str) -> None:
    """Removes a user from a group."""
    with library.database.writing() as connection:
        accounts.remove_members(connection, caller, name, [user])


@router.post("/roles")
def create_role(library: Served, caller: Writer, told: UserRole) -> UserRole:
    """Creates a role."""
    with library.database.writing() as connection:
        accounts.create_role(connection, caller, told.role, told.rights, told.description)
    return told


@router.get("/roles")
def list_roles(library: Served, caller: Reader) -> list[UserRole]:
    """All roles."""
    caller.demand(Right.ROLE_MANAGEMENT)
    with library.database.reading() as connection:
        return accounts.list_roles(connection)


@router.delete("/roles/{role_name}")
def delete_role(library: Served, caller: Writer, role_name: str) -> None:
    """Deletes a role, and takes it from all who have it."""
    with library.database.writing() as connection:
        accounts.delete_role(connection, caller, role_name)


@router.post("/api-tokens")
def create_api_token(library: Served, caller: Person, told: NewToken) -> ApiToken:
    """Creates a token for a machine. Only this answer contains it."""
    with library.database.writing() as connection:
        return library.tokens.create_api_token(connection, caller, told.name, told.scope, told.days)


@router.get("/api-tokens", response_model_exclude={"__all__": {"token"}})
def list_api_tokens(library: Served, caller: Writer) -> list[ApiToken]:
    """The caller's tokens for machines."""
    with library.database.reading() as connection:
        return library.tokens.list_api_tokens(connection, caller)


@router.delete("/api-tokens/{token}")
def delete_api_token(library: Served, caller: Writer, token: str) -> None:
    """Revokes a token for a machine."""
    with library.database.writing() as connection:
        library.tokens.delete_api_token(connection, caller, token)
