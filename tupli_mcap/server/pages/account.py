"""The first page, signing in and out, and the user's own account: password, and tokens for machines."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, Final

from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import JSONResponse

import tupli_mcap
from tupli_mcap.errors import TupliError
from tupli_mcap.page.answers import PageRoute, address, page
from tupli_mcap.page.routes import lists
from tupli_mcap.schema import ApiToken
from tupli_mcap.server.pages.session import COOKIE, Code, Member, Visit, Visitor, done, tried
from tupli_mcap.server.people import accounts, limits
from tupli_mcap.server.people.access import DeniedError
from tupli_mcap.server.wire import told

router = APIRouter(route_class=PageRoute, include_in_schema=False)
_Text = Annotated[str, Form()]
_Next = Annotated[str, Form(alias="next")]
_Flag = Annotated[bool, Form()]
_CHANGED: Final = "tupli_mcap_password_changed"


@router.get("/account")
def show(visit: Member) -> Response:
    """The user's account and tokens, with forms to change them. After a change of the password, it says so once."""
    changed = _CHANGED in visit.request.cookies
    response = _page(visit, changed=changed)
    if changed:
        response.delete_cookie(_CHANGED, path="/account", httponly=True, samesite="lax")
    return response


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
        response.set_cookie(_CHANGED, "1", max_age=60, path="/account", httponly=True, samesite="lax")
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
    changed: bool = False,
    made: ApiToken | None = None,
    sent: dict[str, str] | None = None,
) -> Response:
    with visit.library.database.reading() as connection:
        found = visit.library.tokens.list_api_tokens(connection, visit.caller)
        memberships = accounts.memberships_of(connection, visit.caller.name)
        used = limits.used_by(connection, visit.caller.name)
        quota = limits.quota_of(connection, visit.library.settings, visit.caller.name)
    tokens = [token.model_dump(exclude={"token"}) for token in found]
    facts: dict[str, Any] = {"username": visit.caller.name, "memberships": memberships, "tokens": tokens}
    facts |= {"used": used, "quota": quota}
    return visit.page(
        "account.html", facts, wrong, status, at="/account", sent=sent, made=made, changed=changed
    )


# --- the first page, signing in and out ---


@router.api_route("/", methods=["GET", "HEAD"], response_model=None)
def root(
    request: Request, visit: Visitor, q: str = "", number: Annotated[int, Query(alias="page", ge=1)] = 1
) -> Response:
    """Browsers, and `?format=json`, get the datasets; other clients get the server's name and version."""
    browser = "text/html" in request.headers.get("accept", "") or "format" in request.query_params
    if not browser:
        return JSONResponse({"name": "tupli-mcap", "version": tupli_mcap.__version__})
    return lists.datasets(request, visit.shelf(), q, number)


@router.get("/sign-in")
def show_sign_in(visit: Visitor, next: str = "/") -> Response:
    """The form for name and password."""
    if visit.is_signed_in:
        return done(_local(next))
    return _sign_in_page(visit, next)


@router.post("/sign-in")
def sign_in(
    visit: Visitor, username: _Text = "", password: _Text = "", following: _Next = "/", new: _Flag = False
) -> Response:
    """Signs in; if the server is open to sign-ups, it may create the user first."""
    library = visit.library
    try:
        if not visit.is_own_origin:
            raise DeniedError("this form is not of this server; open its page and sign in there")
        if new:
            library.create_user(visit.caller, username, password, visit.address)
        pair = library.sign_in(username, password, visit.address)
    except TupliError as err:
        status, text = told(err)
        return _sign_in_page(visit, following, text, status, new=new, username=username)
    response = done(_local(following))
    visit.begin(response, pair["refresh_token"])
    return response


@router.post("/sign-out")
def sign_out(visit: Code) -> Response:
    with visit.library.database.writing() as connection:
        visit.library.tokens.end(connection, visit.session)
    response = done("/sign-in")
    response.delete_cookie(COOKIE, path="/", httponly=True, samesite="lax")
    return response


def _sign_in_page(
    visit: Visit, following: str, wrong: str = "", status: int = 200, *, new: bool = False, username: str = ""
) -> Response:
    following = _local(following)
    response = page(
        visit.request, "sign-in.html", {"error": wrong or None}, status=status, wrong=wrong, next=following,
        open_signup=visit.library.settings.open_signup, new=new, username=username,
        at=address("sign-in", next=following),
    )  # fmt: skip
    response.headers["Cache-Control"] = "no-store"
    return response


def _local(address: str) -> str:
    """An address of this server: a path, never another host."""
    is_path = address.startswith("/") and not address.startswith(("//", "/\\")) and address.isprintable()
    return address if is_path else "/"
