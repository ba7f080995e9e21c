"""Pages of users, groups and their members."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Form, Response

from tupli_mcap.page.answers import PageRoute, address
from tupli_mcap.schema import Right
from tupli_mcap.server.pages.session import Code, Member, Visit, tried
from tupli_mcap.server.people import accounts, limits
from tupli_mcap.server.people.access import GLOBAL

router = APIRouter(route_class=PageRoute, include_in_schema=False)
_Text = Annotated[str, Form()]
_Sent = dict[str, str] | None


@router.get("/users")
def show_users(visit: Member) -> Response:
    return _users(visit)


@router.post("/users")
def create_user(visit: Code, username: _Text = "", password: _Text = "") -> Response:
    def change() -> None:
        visit.caller.demand(Right.USER_CREATE)
        visit.library.create_user(visit.caller, username, password, "")

    return tried(change, partial(_users, visit, sent={"username": username}), "/users")


@router.post("/users/delete")
def delete_user(visit: Code, username: _Text = "") -> Response:
    """Deletes a user, and what only they could see; the name cannot be used again."""
    change = partial(visit.library.delete_user, visit.caller, username)
    return tried(change, partial(_users, visit), "/users")


@router.post("/users/quota")
def set_quota(
    visit: Code, username: _Text = "", gigabytes: Annotated[float | None, Form(ge=0, le=1e9)] = None
) -> Response:
    """Sets how much a user may store; an empty field stands for the server's quota."""
    size = None if gigabytes is None else round(gigabytes * 1e9)
    change = partial(visit.change, limits.set_quota, username, size)
    return tried(change, partial(_users, visit), "/users")


def _users(visit: Visit, wrong: str = "", status: int = 200, *, sent: _Sent = None) -> Response:
    visit.caller.demand(Right.USER_READ)
    rights = {"create": Right.USER_CREATE, "set_quota": Right.USER_UPDATE, "delete": Right.USER_DELETE}
    may = {verb: visit.caller.may(right) for verb, right in rights.items()}
    with visit.library.database.reading() as connection:
        facts: dict[str, Any] = {"users": accounts.list_users(connection, visit.caller)}
        if may["set_quota"]:
            usages = limits.usages(connection, visit.library.settings)
            facts["stored"] = {name: usage._asdict() for name, usage in usages.items()}
    quota = visit.library.settings.quota
    return visit.page("users.html", facts, wrong, status, at="/users", sent=sent, may=may, quota=quota)


@router.get("/groups")
def show_groups(visit: Member) -> Response:
    return _groups(visit)


@router.post("/groups")
def create_group(visit: Code, name: _Text = "", description: _Text = "") -> Response:
    """Creates a group with the user as its admin."""
    change = partial(visit.change, accounts.create_group, name, description or None)
    sent = {"name": name, "description": description}
    return tried(change, partial(_groups, visit, sent=sent), address("group", name=name))


def _groups(visit: Visit, wrong: str = "", status: int = 200, *, sent: _Sent = None) -> Response:
    with visit.library.database.reading() as connection:
        groups = [group.model_dump() for group in accounts.list_groups(connection, visit.caller)]
        own = accounts.memberships_of(connection, visit.caller.name)
    may = {"create": visit.caller.may(Right.GROUP_CREATE), "open": partial(accounts.may_open, visit.caller)}
    return visit.page(
        "groups.html", {"groups": groups}, wrong, status, at="/groups", sent=sent, own=own, may=may
    )


@router.get("/group")
def show_group(visit: Member, name: str) -> Response:
    return _group(visit, name)


@router.post("/group/members")
def add_member(visit: Code, name: _Text = "", user: _Text = "", role: _Text = "member") -> Response:
    change = partial(visit.change, accounts.add_members, name, [(user, [role])])
    again = partial(_group, visit, name, sent={"user": user, "role": role})
    return tried(change, again, address("group", name=name))


@router.post("/group/members/delete")
def remove_member(visit: Code, name: _Text = "", user: _Text = "") -> Response:
    change = partial(visit.change, accounts.remove_members, name, [user])
    left = user == visit.caller.name  # who may not see the group any more
    return tried(change, partial(_group, visit, name), "/groups" if left else address("group", name=name))


@router.post("/group/delete")
def delete_group(visit: Code, name: _Text = "") -> Response:
    """Deletes a group; its name cannot be used again."""
    change = partial(visit.change, accounts.delete_group, name)
    return tried(change, partial(_group, visit, name), "/groups")


def _group(visit: Visit, name: str, wrong: str = "", status: int = 200, *, sent: _Sent = None) -> Response:
    with visit.library.database.reading() as connection:
        group = accounts.members_of(connection, visit.caller, name)
        roles = [role.role for role in accounts.list_roles(connection)]
    caller = visit.caller
    may = {
        "change": caller.may(Right.GROUP_UPDATE, name),  # `may.update` would be a method of the dict
        "delete": name != GLOBAL and caller.may(Right.GROUP_DELETE, name),
    }
    return visit.page(
        "group.html",
        group.model_dump(),
        wrong,
        status,
        at=address("group", name=name),
        sent=sent,
        may=may,
        roles=roles,
    )
