"""Who asks for a page: the cookie of a sign-in, and forms that no page of somebody else can send.

1. Signing in puts a refresh token into a cookie that scripts cannot read, and that other sites do not send along with
   anything but a link. It is revoked as every other: by signing out, a new password, the end of the user.
2. The programming interface (`/v1`) takes no cookie, so nothing of it can be set off by a page of somebody else.
3. A form is taken only with a code made of the server's secret and the sign-in, and never from another origin, which
   browsers say.
"""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple
from urllib.parse import urlsplit

from fastapi import Depends, Form, Request, Response

from tupli_mcap.page.answers import SignInNeededError
from tupli_mcap.server.library import Library
from tupli_mcap.server.pages.shelf import LibraryShelf
from tupli_mcap.server.people import accounts
from tupli_mcap.server.people.access import Caller, DeniedError

__all__ = ["COOKIE", "Code", "Member", "Visit", "Visitor", "begin", "end", "is_own_origin", "shelf_of"]

COOKIE: Final = "tupli_mcap_session"


class Visit(NamedTuple):
    """Who asks, by which sign-in (a refresh token; empty for a guest), and the code for forms."""

    library: Library
    caller: Caller
    session: str
    code: str

    @property
    def is_signed_in(self) -> bool:
        """Whether it is no guest."""
        return bool(self.session)


def _visit(request: Request) -> Visit:
    library: Library = request.app.state.library
    session = request.cookies.get(COOKIE, "")
    with library.database.reading() as connection:
        caller = library.tokens.of_session(connection, session) if session else None
        if caller is None:
            return Visit(library, accounts.guest(connection), "", "")
    request.state.user = caller.name  # for the log
    return Visit(library, caller, session, library.tokens.form_code(session))


Visitor = Annotated[Visit, Depends(_visit)]
"""Whoever it is."""


def _member(visit: Visitor) -> Visit:
    if not visit.is_signed_in:
        raise SignInNeededError("sign in to see this page")
    return visit


Member = Annotated[Visit, Depends(_member)]
"""Somebody who is signed in."""


def _checked(request: Request, visit: Member, code: Annotated[str, Form()] = "") -> Visit:
    if not is_own_origin(request) or not visit.library.tokens.is_form_code(visit.session, code):
        raise DeniedError(
            "this form is not of a page of yours, or is out of date; reload the page and try again"
        )
    return visit


Code = Annotated[Visit, Depends(_checked)]
"""Somebody who is signed in, and has sent a form of our own page."""


def is_own_origin(request: Request) -> bool:
    """Whether a form is of a page of this server, as far as the browser says."""
    site = request.headers.get("sec-fetch-site")
    if site is not None:
        return site in ("same-origin", "none")
    origin = request.headers.get("origin")
    return origin is None or urlsplit(origin).netloc == request.headers.get("host")


def begin(request: Request, response: Response, refresh_token: str, seconds: int) -> None:
    """Puts a sign-in into the browser."""
    secure = request.url.scheme == "https"
    response.set_cookie(
        COOKIE, refresh_token, max_age=seconds, httponly=True, samesite="lax", secure=secure, path="/"
    )


def end(response: Response) -> None:
    """Takes the sign-in out of the browser."""
    response.delete_cookie(COOKIE, path="/", httponly=True, samesite="lax")


def shelf_of(request: Request) -> LibraryShelf:
    """What who asks may see.

    Raises:
        SignInNeededError: nobody is signed in, and guests are shown nothing.
    """
    visit = _visit(request)
    if not visit.is_signed_in and not visit.library.settings.guests:
        raise SignInNeededError("sign in to see what is here")
    address = f"{request.url.scheme}://{request.url.netloc}"
    return LibraryShelf(visit.library, visit.caller, address, request.app.state.kept)
