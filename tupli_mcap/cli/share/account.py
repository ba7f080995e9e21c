"""Commands for accounts on a server: login, logout, whoami, signup, password."""

from __future__ import annotations

import os
from typing import Annotated, Any

import typer

from tupli_mcap.cli.options import Json, Url, server_at
from tupli_mcap.cli.output import print_facts, print_json, print_result
from tupli_mcap.cli.terminal import ask_secret
from tupli_mcap.errors import StorageError

Username = Annotated[str, typer.Argument(metavar="USER", help="The user's name.")]


def login(username: Username, url: Url = None, as_json: Json = False) -> None:
    """Sign in to a server, until logout.

    The password is asked for, or taken from TUPLI_MCAP_PASSWORD.
    """
    with server_at(url) as client:
        client.login(username, _password("Password: "))
        _tell(client.url, username, f"signed in to {client.url} as {username}", as_json=as_json)


def logout(url: Url = None, as_json: Json = False) -> None:
    """Sign out of a server."""
    with server_at(url) as client:
        username = client.username
        client.logout()
        _tell(client.url, username, f"signed out of {client.url}", as_json=as_json)


def whoami(url: Url = None, as_json: Json = False) -> None:
    """Show which user is signed in, and their roles."""
    with server_at(url) as client:
        me = client.whoami()
        memberships = {membership.group: membership.roles for membership in me.memberships}
        name = me.username if client.username else ""  # a guest has a name that nobody has given
        found: dict[str, Any] = {"url": client.url, "username": name, "memberships": memberships}
    if as_json:
        print_json(found)
        return
    roles = [(group, ", ".join(held)) for group, held in memberships.items()]
    print_facts([("server", found["url"]), ("user", name or "nobody is signed in"), *roles])


def signup(username: Username, url: Url = None, as_json: Json = False) -> None:
    """Create a user on a server.

    If the server was started with --open-signup, everybody may; else it takes the right
    user_create. The password is asked for, or taken from TUPLI_MCAP_PASSWORD.
    """
    with server_at(url) as client:
        client.signup(username, _password("Password of the new user: "))
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
        old = _password("Old password: ") if own else None
        new = _password("New password: ", "TUPLI_MCAP_NEW_PASSWORD")
        client.change_password(username or me, new, old=old)
        if own:
            client.login(me, new)
        changed = username or me
        _tell(client.url, changed, f"changed the password of {changed} at {client.url}", as_json=as_json)


def _tell(url: str, username: str, line: str, *, as_json: bool) -> None:
    print_result({"url": url, "username": username}, line, as_json=as_json)


def _password(question: str, variable: str = "TUPLI_MCAP_PASSWORD") -> str:
    found = os.environ.get(variable) or ask_secret(question)
    if not found:
        raise StorageError(f"no password: stdin is no terminal to ask on; set {variable}")
    return found
