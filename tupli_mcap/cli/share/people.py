"""Commands for the people of a server (users, groups, roles, tokens for machines), and for one's own account.

Each calls a method of `TupliAPIClient`.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tupli_mcap.cli.options import Json, Url, server_at
from tupli_mcap.cli.output import Column, print_facts, print_json, print_result, print_rows, when
from tupli_mcap.cli.terminal import ask_secret, confirmed
from tupli_mcap.errors import StorageError, bytes_of

if TYPE_CHECKING:
    from tupli_mcap.schema import GroupMembershipQuery, GroupWithMembers

Group = Annotated[str, typer.Argument(metavar="GROUP", help="The group's name.")]
Users = Annotated[list[str], typer.Argument(metavar="USER", help="Names of users.")]
Description = Annotated[str | None, typer.Option(help="A description of it.")]
Username = Annotated[str, typer.Argument(metavar="USER", help="The user's name.")]


def list_users(url: Url = None, as_json: Json = False) -> None:
    """List the users of a server, and their groups.

    Admins also see how much each user has stored, and may; without a QUOTA, there is no limit.
    """
    with server_at(url) as client:
        users = client.list_users()
    told = [
        {
            "username": user.username,
            "memberships": {held.group: held.roles for held in user.memberships},
            "used": user.used,
            "quota": user.quota,
        }
        for user in users
    ]
    rows = [
        (
            user.username,
            *("" if size is None else bytes_of(size) for size in (user.used, user.quota)),
            ", ".join(held.group for held in user.memberships if held.group != user.username),
        )
        for user in users
    ]
    columns = (
        Column("USER"),
        Column("STORED", "right"),
        Column("QUOTA", "right"),
        Column("GROUPS", shrink="end"),
    )
    print_rows(told, columns, rows, empty="no users", as_json=as_json)


def set_quota(
    username: Username,
    gigabytes: Annotated[
        float | None,
        typer.Argument(metavar="[GB]", min=0, max=1e9, help="Without it, what --quota of the server says."),
    ] = None,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Set how much a user of a server may store.

    It takes the right user_update, which admins have. `whoami` tells users how much they have
    stored, and may.
    """
    quota = None if gigabytes is None else round(gigabytes * 1e9)
    with server_at(url) as client:
        client.set_quota(username, quota)
        may = "as much as the server lets everybody" if quota is None else bytes_of(quota)
        told = {"url": client.url, "username": username, "quota": quota}
        print_result(told, f"{username} may store {may} at {client.url}", as_json=as_json)


def delete_user(
    username: Username,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Delete a user, and what only they could see.

    What they published stays. Nobody can take the name again. You may delete yourself. The
    command asks first; without a terminal, it takes --yes.
    """
    with server_at(url) as client:
        question = f"Delete the user {username} at {client.url}, and what only they could see?"
        if not (yes or confirmed(question)):
            raise StorageError(
                f"the user {username} was not deleted; to delete without being asked, give --yes"
            )
        client.delete_user(username)
        _deleted(client.url, "user", username, as_json=as_json)


def list_groups(url: Url = None, as_json: Json = False) -> None:
    """List the groups of a server that you may see."""
    with server_at(url) as client:
        groups = client.list_groups()
    rows = [(group.name, group.description or "") for group in groups]
    columns = (Column("GROUP"), Column("DESCRIPTION", shrink="end"))
    print_rows([each.model_dump() for each in groups], columns, rows, empty="no groups", as_json=as_json)


def read_group(group: Group, url: Url = None, as_json: Json = False) -> None:
    """Show a group and its members."""
    with server_at(url) as client:
        _print_group(client.read_group(group), as_json=as_json)


def create_group(
    group: Group, description: Description = None, url: Url = None, as_json: Json = False
) -> None:
    """Create a group of users, with you as its admin.

    `publish --group` lets its members see a benchmark.
    """
    from tupli_mcap.schema import Group

    with server_at(url) as client:
        made = client.create_group(Group(name=group, description=description))
        print_result(made.model_dump(), f"created the group {group} at {client.url}", as_json=as_json)


def delete_group(group: Group, url: Url = None, as_json: Json = False) -> None:
    """Delete a group of users.

    Only their owners still see what was published in it. The name cannot be used again.
    """
    with server_at(url) as client:
        client.delete_group(group)
        _deleted(client.url, "group", group, as_json=as_json)


def add_members(
    group: Group,
    users: Users,
    roles: Annotated[
        list[str] | None,
        typer.Option("--role", metavar="ROLE", help="Their role; by default, member. Repeatable."),
    ] = None,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Add users to a group, or give them roles there.

    A member reads what is published in the group, a contributor also publishes there, and a
    group_admin adds and removes members. An admin of the server sees all roles, and their
    rights, with list-roles. You cannot give a right that you do not have.
    """
    with server_at(url) as client:
        _print_group(client.add_group_members(_query(group, users, roles)), as_json=as_json)


def remove_members(group: Group, users: Users, url: Url = None, as_json: Json = False) -> None:
    """Remove users from a group."""
    with server_at(url) as client:
        _print_group(client.remove_group_members(_query(group, users, None)), as_json=as_json)


def list_roles(url: Url = None, as_json: Json = False) -> None:
    """List the roles on a server, and their rights."""
    with server_at(url) as client:
        roles = client.list_roles()
    told = [role.model_dump(mode="json") for role in roles]
    rows = [(role.role, ", ".join(role.rights), role.description or "") for role in roles]
    columns = (Column("ROLE"), Column("RIGHTS", shrink="end"), Column("DESCRIPTION", shrink="end"))
    print_rows(told, columns, rows, empty="no roles", as_json=as_json)


def create_role(
    role: Annotated[str, typer.Argument(metavar="ROLE", help="The role's name.")],
    rights: Annotated[list[str], typer.Argument(metavar="RIGHT", help="Rights, such as episode_read.")],
    description: Description = None,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Create a role from rights; for admins only."""
    from tupli_mcap.schema import Right, UserRole

    unknown = [right for right in rights if right not in set(Right)]
    if unknown:
        raise typer.BadParameter(f"expected rights among {', '.join(Right)}, found {', '.join(unknown)}")
    with server_at(url) as client:
        wanted = UserRole(role=role, rights=[Right(right) for right in rights], description=description)
        made = client.create_role(wanted)
        print_result(
            made.model_dump(mode="json"), f"created the role {role} at {client.url}", as_json=as_json
        )


def delete_role(
    role: Annotated[str, typer.Argument(metavar="ROLE", help="The role's name.")],
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Delete a role, and take it from all who have it."""
    with server_at(url) as client:
        client.delete_role(role)
        _deleted(client.url, "role", role, as_json=as_json)


def list_tokens(url: Url = None, as_json: Json = False) -> None:
    """List your tokens for machines."""
    with server_at(url) as client:
        tokens = client.list_tokens()
    told = [token.model_dump(exclude={"token"}) for token in tokens]
    columns = (Column("ID"), Column("NAME", shrink="end"), Column("MAY"), Column("MADE"), Column("EXPIRES"))
    rows = [
        (t.id, t.name, t.scope, when(t.created_at), "never" if t.expires is None else when(t.expires))
        for t in tokens
    ]
    print_rows(told, columns, rows, empty="no tokens", as_json=as_json)


def create_token(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A name for the token.")],
    write: Annotated[bool, typer.Option("--write", help="Allow writing, not only reading.")] = False,
    days: Annotated[int, typer.Option(min=1, max=3650, help="How many days it is valid.")] = 90,
    forever: Annotated[bool, typer.Option("--forever", help="Keep it valid until it is deleted.")] = False,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Create a token that gives a machine your rights.

    The token is shown only once. On the machine, put it into TUPLI_MCAP_TOKEN.
    """
    with server_at(url) as client:
        token = client.create_token(name, "write" if write else "read", None if forever else days)
    print_result(token.model_dump(), token.token, as_json=as_json)


def delete_token(
    token: Annotated[str, typer.Argument(metavar="ID", help="The token's id, as list-tokens shows it.")],
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Revoke one of your tokens for machines."""
    with server_at(url) as client:
        client.delete_token(token)
        _deleted(client.url, "token", token, as_json=as_json)


def _query(group: str, users: list[str], roles: list[str] | None) -> GroupMembershipQuery:
    from tupli_mcap.schema import GroupMembership, GroupMembershipQuery

    members = [GroupMembership(user=user, roles=roles or None) for user in users]
    return GroupMembershipQuery(group_name=group, members=members)


def _print_group(group: GroupWithMembers, *, as_json: bool) -> None:
    if as_json:
        print_json(group.model_dump())
        return
    held = [(user, ", ".join(group.roles[user])) for user in group.members]
    print_facts([("group", group.name), ("description", group.description or ""), *held])


def _deleted(url: str, kind: str, name: str, *, as_json: bool) -> None:
    print_result({"url": url, "deleted": name}, f"deleted the {kind} {name} at {url}", as_json=as_json)


# --- one's own account ---


def login(username: Username, url: Url = None, as_json: Json = False) -> None:
    """Sign in to a server, until logout.

    The password is asked for, or taken from TUPLI_MCAP_PASSWORD.
    """
    with server_at(url) as client:
        client.login(username, _password("Password"))
        _tell(client.url, username, f"signed in to {client.url} as {username}", as_json=as_json)


def logout(url: Url = None, as_json: Json = False) -> None:
    """Sign out of a server."""
    with server_at(url) as client:
        username = client.username
        client.logout()
        _tell(client.url, username, f"signed out of {client.url}", as_json=as_json)


def whoami(url: Url = None, as_json: Json = False) -> None:
    """Show who is signed in, with their roles.

    Also how much they have stored, and may store.
    """
    with server_at(url) as client:
        me = client.whoami()
        memberships = {membership.group: membership.roles for membership in me.memberships}
        name = me.username if client.username else ""  # a guest has a name that nobody has given
        found: dict[str, Any] = {"url": client.url, "username": name, "memberships": memberships}
        found |= {"used": me.used, "quota": me.quota}
    if as_json:
        print_json(found)
        return
    roles = [(group, ", ".join(held)) for group, held in memberships.items()]
    stored = bytes_of(me.used) if name and me.used is not None else ""
    if stored and me.quota is not None:
        stored += f" of {bytes_of(me.quota)}"
    user = name or "nobody is signed in"
    print_facts([("server", found["url"]), ("user", user), ("stored", stored), *roles])


def signup(username: Username, url: Url = None, as_json: Json = False) -> None:
    """Create a user on a server.

    If the server was started with --open-signup, everybody may; else it takes the right
    user_create. The password is asked for, or taken from TUPLI_MCAP_PASSWORD.
    """
    with server_at(url) as client:
        client.signup(username, _password("Password of the new user", twice=True))
        _tell(client.url, username, f"created the user {username} at {client.url}", as_json=as_json)


def password(
    username: Annotated[
        str | None, typer.Argument(metavar="[USER]", help="The user's name; by default, yours.")
    ] = None,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Change a password, and end all of the user's sign-ins.

    Passwords are asked for, or taken from TUPLI_MCAP_PASSWORD (the old one) and
    TUPLI_MCAP_NEW_PASSWORD.
    """
    with server_at(url) as client:
        me = client.whoami().username
        own = username in (None, me)
        old = _password("Old password") if own else None
        new = _password("New password", "TUPLI_MCAP_NEW_PASSWORD", twice=True)
        client.change_password(username or me, new, old=old)
        if own:
            client.login(me, new)
        changed = username or me
        _tell(client.url, changed, f"changed the password of {changed} at {client.url}", as_json=as_json)


def _tell(url: str, username: str, line: str, *, as_json: bool) -> None:
    print_result({"url": url, "username": username}, line, as_json=as_json)


def _password(question: str, variable: str = "TUPLI_MCAP_PASSWORD", *, twice: bool = False) -> str:
    found = os.environ.get(variable) or ask_secret(question, twice=twice)
    if not found:
        raise StorageError(f"no password: stdin is no terminal to ask on; set {variable}")
    return found
