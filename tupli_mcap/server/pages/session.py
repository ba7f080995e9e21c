"""Sign-in by a cookie, pages with forms, and their protection against pages of other sites.

1. Signing in puts a refresh token into a cookie that scripts cannot read. Browsers send it from other sites only when
   the user follows a link. Signing out, a new password and the deletion of the user revoke it.
2. The HTTP API (`/v1`) ignores cookies, so that a page of another site cannot call it for the user.
3. A form is accepted only with a code that is made of the server's secret and the sign-in, and only if the browser does
   not report another origin.
"""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Annotated, Any, Final, NamedTuple
from urllib.parse import urlsplit

from fastapi import Depends, Form, Request, Response
from fastapi.responses import RedirectResponse
from starlette.concurrency import run_in_threadpool

from tupli_mcap.errors import TupliError
from tupli_mcap.page.answers import SignInNeededError, page
from tupli_mcap.server.library import Library
from tupli_mcap.server.pages.shelf import LibraryShelf
from tupli_mcap.server.people import accounts
from tupli_mcap.server.people.access import Caller, DeniedError
from tupli_mcap.server.wire import told

COOKIE: Final = "tupli_mcap_session"


class Visit(NamedTuple):
    """The caller, the refresh token of the sign-in (empty for a guest), and the code for forms."""

    library: Library
    caller: Caller
    session: str
    code: str

    @property
    def is_signed_in(self) -> bool:
        """Whether the caller is signed in, and no guest."""
        return bool(self.session)

    def change(self, work: Callable[..., object], *args: object) -> None:
        """Calls `work(connection, caller, *args)` in a writing transaction."""
        with self.library.database.writing() as connection:
            work(connection, self.caller, *args)


def _known_visit(request: Request) -> Visit:
    library: Library = request.app.state.library
    session = request.cookies.get(COOKIE, "")
    with library.database.reading() as connection:
        caller = library.tokens.of_session(connection, session) if session else None
        if caller is None:
            return Visit(library, accounts.guest(connection), "", "")
    request.state.user = caller.name  # for the log
    return Visit(library, caller, session, library.tokens.form_code(session))


async def _visit(request: Request) -> AsyncIterator[Visit]:
    visit = await run_in_threadpool(_known_visit, request)
    with contextlib.suppress(SignInNeededError):
        request.state.shelf = shelf_of(request, visit)  # for error pages
    address = request.client.host if request.client else ""
    async with request.app.state.turns.turn(visit.caller, address):
        yield visit


Visitor = Annotated[Visit, Depends(_visit, scope="function")]
"""A visit by anybody, whose turn it is until the function of the route returns."""


async def _member(visit: Visitor) -> Visit:
    if not visit.is_signed_in:
        raise SignInNeededError("sign in to see this page")
    return visit


Member = Annotated[Visit, Depends(_member)]
"""A visit by a signed-in user."""


async def _checked(request: Request, visit: Member, code: Annotated[str, Form()] = "") -> Visit:
    if not is_own_origin(request) or not visit.library.tokens.is_form_code(visit.session, code):
        raise DeniedError("this form is out of date, or not from this sign-in; reload the page and try again")
    return visit


Code = Annotated[Visit, Depends(_checked)]
"""A visit by a signed-in user who has sent a form of our own page."""


def is_own_origin(request: Request) -> bool:
    """Whether a form is from a page of this server, according to the browser's headers."""
    site = request.headers.get("sec-fetch-site")
    if site is not None:
        return site in ("same-origin", "none")
    origin = request.headers.get("origin")
    return origin is None or urlsplit(origin).netloc == request.headers.get("host")


def begin(request: Request, response: Response, refresh_token: str, seconds: int) -> None:
    """Sets the cookie of a sign-in."""
    secure = request.url.scheme == "https"
    response.set_cookie(
        COOKIE, refresh_token, max_age=seconds, httponly=True, samesite="lax", secure=secure, path="/"
    )


def end(response: Response) -> None:
    """Removes the cookie of the sign-in."""
    response.delete_cookie(COOKIE, path="/", httponly=True, samesite="lax")


def shelf_of(request: Request, visit: Visit) -> LibraryShelf:
    """The shelf of what the caller may see. SignInNeededError if nobody is signed in, and the server has no guests."""
    if not visit.is_signed_in and not visit.library.settings.guests:
        raise SignInNeededError("sign in to see what is here")
    address = f"{request.url.scheme}://{request.url.netloc}"
    return LibraryShelf(visit.library, visit.caller, address, request.app.state.kept)


@contextlib.asynccontextmanager
async def shown(request: Request) -> AsyncIterator[LibraryShelf]:
    """The shelf of what the caller may see, see `shelf_of`; it is their turn within the block."""
    async with contextlib.asynccontextmanager(_visit)(request) as visit:
        yield shelf_of(request, visit)


# --- pages with forms ---


def form_page(
    request: Request,
    visit: Visit,
    template: str,
    facts: Mapping[str, Any],
    *,
    wrong: str = "",
    status: int = 200,
    sent: Mapping[str, str] | None = None,
    **more: Any,
) -> Response:
    """A page with forms for a signed-in user. wrong: why the last form was refused. sent: what was in it."""
    response = page(
        request, template, facts, status=status, shelf=shelf_of(request, visit), code=visit.code, wrong=wrong,
        sent=defaultdict(str, sent or {}), me=visit.caller, **more,
    )  # fmt: skip
    response.headers["Cache-Control"] = "no-store"
    return response


def tried(change: Callable[[], None], again: Callable[[str, int], Response], address: str) -> Response:
    """Makes a change, and redirects to an address; if the change is refused, shows the page `again`."""
    try:
        change()
    except TupliError as err:
        status, text = told(err)
        return again(text, status)
    return done(address)


def done(address: str) -> Response:
    """Redirects to another page, which the browser fetches with GET."""
    return RedirectResponse(address, 303)
