"""The first page, and signing in and out."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import JSONResponse

import tupli_mcap
from tupli_mcap.errors import TupliError
from tupli_mcap.page.answers import PageRoute, page
from tupli_mcap.page.routes import lists
from tupli_mcap.server.pages.session import COOKIE, Code, Visit, Visitor, done
from tupli_mcap.server.people.access import DeniedError
from tupli_mcap.server.wire import told

router = APIRouter(route_class=PageRoute, include_in_schema=False)
_Next = Annotated[str, Form(alias="next")]


@router.get("/", response_model=None)
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
    visit: Visitor,
    username: Annotated[str, Form()] = "",
    password: Annotated[str, Form()] = "",
    following: _Next = "/",
    new: Annotated[bool, Form()] = False,
) -> Response:
    """Signs in; if the server is open to sign-ups, it may create the user first."""
    library = visit.library
    try:
        if not visit.is_own_origin:
            raise DeniedError("this form is not of this server; open its page and sign in there")
        if new and not library.settings.open_signup:
            raise DeniedError("only an administrator makes users here")
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
    visit: Visit,
    following: str,
    wrong: str = "",
    status: int = 200,
    *,
    new: bool = False,
    username: str = "",
) -> Response:
    response = page(
        visit.request, "sign-in.html", {"error": wrong or None}, status=status, wrong=wrong, next=_local(following),
        open_signup=visit.library.settings.open_signup, new=new, username=username,
    )  # fmt: skip
    response.headers["Cache-Control"] = "no-store"
    return response


def _local(address: str) -> str:
    """An address of this server: a path, never another host."""
    is_path = address.startswith("/") and not address.startswith(("//", "/\\")) and address.isprintable()
    return address if is_path else "/"
