"""Users, groups, roles and tokens of a server, as PyTupli names them."""

from __future__ import annotations

import enum
from typing import Final

from pydantic import BaseModel, Field


class Right(enum.StrEnum):
    """A right that a role may give."""

    BENCHMARK_CREATE = "benchmark_create"
    BENCHMARK_READ = "benchmark_read"
    BENCHMARK_DELETE = "benchmark_delete"
    ARTIFACT_CREATE = "artifact_create"
    ARTIFACT_READ = "artifact_read"
    ARTIFACT_DELETE = "artifact_delete"
    EPISODE_CREATE = "episode_create"
    EPISODE_READ = "episode_read"
    EPISODE_DELETE = "episode_delete"
    USER_CREATE = "user_create"
    USER_READ = "user_read"
    USER_UPDATE = "user_update"
    USER_DELETE = "user_delete"
    GROUP_CREATE = "group_create"
    GROUP_READ = "group_read"
    GROUP_UPDATE = "group_update"
    GROUP_DELETE = "group_delete"
    ROLE_MANAGEMENT = "role_management"


RIGHT: Final = Right
"""The name that it has in PyTupli."""


class Membership(BaseModel):
    """The roles that a user holds in a group."""

    group: str
    roles: list[str]


class UserOut(BaseModel):
    """A user and their groups."""

    username: str
    memberships: list[Membership] = Field(default_factory=list)


class Me(UserOut):
    """The user who is signed in, with the bytes that they have stored (None: an earlier server does not say it), and
    may store (`quota`; None: without a limit)."""

    used: int | None = None
    quota: int | None = None


class ListedUser(UserOut):
    """A user in a list, with the bytes that they have stored, and may store (`quota`; None: without a limit). Both are
    None if you may not set quotas."""

    used: int | None = None
    quota: int | None = None


class UserRole(BaseModel):
    """A role and the rights that it gives."""

    role: str
    rights: list[Right] = Field(fail_fast=True)
    description: str | None = None


class Group(BaseModel):
    """A group of users."""

    name: str
    description: str | None = None


class GroupMembership(BaseModel):
    """A user of a group; without roles, a `member`, or all of their roles."""

    user: str
    roles: list[str] | None = Field(default=None, fail_fast=True)


class GroupMembershipQuery(BaseModel):
    """Users to add to a group, or to remove from it."""

    group_name: str
    members: list[GroupMembership] = Field(fail_fast=True)


class GroupWithMembers(Group):
    """A group and the members that the caller may see; `roles` are those of each member."""

    members: list[str] = Field(default_factory=list)
    roles: dict[str, list[str]] = Field(default_factory=dict)


class ApiToken(BaseModel):
    """A token for a machine.

    Attributes:
        scope: `read` or `write`.
        created_at, expires: ISO 8601 in UTC; `expires` is None for a token that never does.
        token: the secret itself, only in the answer that makes it.
    """

    id: str
    name: str
    scope: str
    created_at: str
    expires: str | None
    token: str = Field("", repr=False)
