"""The user's own account: password, and tokens for machines."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Form, Response
from fastapi.responses import JSONResponse

from tupli_mcap.errors import TupliError
from tupli_mcap.page.answers import PageRoute
from tupli_mcap.server.pages.session import Code, Member, Visit, tried
from tupli_mcap.server.people import accounts
from tupli_mcap.server.wire import told

router = APIRouter(route_class=PageRoute, include_in_schema=False)
_Text = Annotated[str, Form()]


@router.get("/account")
def show(visit: Member) -> Response:
    """The user's account and tokens, with forms to change them."""
    return _page(visit)


@router.post("/account/password")
def change_password(visit: Code, old: _Text = "", new: _Text = "") -> Response:
    """Changes the user's password; every other sign-in ends."""
    library, name = visit.library, visit.caller.name
    change = partial(library.change_password, visit.caller, name, new, old=old)
    response = tried(change, partial(_page, visit), "/account")
    if response.status_code == 303:
        with library.database.writing() as connection:
            pair = library.tokens.pair(connection, name)
        visit.begin(response, pair["refresh_token"])
    return response


@router.post("/account/tokens")
def create_token(
    visit: Code, name: _Text = "", scope: _Text = "read", days: Annotated[int, Form()] = 90
) -> Response:
    """Creates a token for a machine, and shows it once."""
    library = visit.library
    try:
        with library.database.writing() as connection:
            made = library.tokens.create_api_token(connection, visit.caller, name, scope, days)
    except TupliError as err:
        status, text = told(err)
        return _page(visit, text, status, sent={"name": name, "scope": scope, "days": str(days)})
    return _page(visit, made=made)


@router.post("/account/tokens/delete")
def delete_token(visit: Code, token: _Text = "") -> Response:
    change = partial(visit.change, visit.library.tokens.delete_api_token, token)
    return tried(change, partial(_page, visit), "/account")


@router.post("/account/access")
def access(visit: Code) -> Response:
    """An access token for the scripts of our own pages, which need it for uploads."""
    with visit.library.database.reading() as connection:
        token = visit.library.tokens.access_for(connection, visit.session)
    return JSONResponse({"access_token": token}, headers={"Cache-Control": "no-store"})


def _page(
    visit: Visit,
    wrong: str = "",
    status: int = 200,
    *,
    made: dict[str, Any] | None = None,
    sent: dict[str, str] | None = None,
) -> Response:
    with visit.library.database.reading() as connection:
        tokens = visit.library.tokens.list_api_tokens(connection, visit.caller)
        memberships = accounts.memberships_of(connection, visit.caller.name)
    facts = {"username": visit.caller.name, "memberships": memberships, "tokens": tokens}
    return visit.page("account.html", facts, wrong, status, sent=sent, made=made)
