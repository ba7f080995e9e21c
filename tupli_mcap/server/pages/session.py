"""Sign-in by a cookie, pages with forms, and their protection against pages of other sites.

1. Signing in puts a refresh token into a cookie that scripts cannot read. Browsers send it from other sites only when
   the user follows a link. Signing out, a new password and the deletion of the user revoke it.
2. The HTTP API (`/v1`) ignores cookies, so that a page of another site cannot call it for the user.
3. A form is accepted only with a code that is made of the server's secret and the sign-in, and only if the browser does
   not report another origin.
4. A program sends pages a token, as it does to the HTTP API. A page of another site has none that it could send. A
   request with a token is answered by it alone, and is refused where only a browser that is signed in may come.
"""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Annotated, Any, Final, NamedTuple

from fastapi import Depends, Form, Request, Response
from fastapi.responses import RedirectResponse
from fastapi.security import HTTPBearer
from starlette.concurrency import run_in_threadpool

from tupli_mcap.errors import TupliError
from tupli_mcap.page.answers import SignInNeededError, page
from tupli_mcap.server.library import Library
from tupli_mcap.server.pages.shelf import LibraryShelf
from tupli_mcap.server.people import accounts
from tupli_mcap.server.people.access import Caller, DeniedError
from tupli_mcap.server.wire import told

COOKIE: Final = "tupli_mcap_session"
_BEARER: Final = HTTPBearer(auto_error=False)


class Visit(NamedTuple):
    """A request for a page: its caller, refresh token of the sign-in (empty for a guest and for a program that sends a
    token), and code for forms."""

    request: Request
    library: Library
    caller: Caller
    session: str = ""
    code: str = ""

    @property
    def is_signed_in(self) -> bool:
        """Whether the caller is signed in in a browser."""
        return bool(self.session)

    @property
    def address(self) -> str:
        """The address of the caller's machine."""
        return self.request.client.host if self.request.client else ""

    @property
    def is_own_origin(self) -> bool:
        """Whether a form is from a page of this server, according to the browser's headers."""
        headers = self.request.headers
        site, origin = headers.get("sec-fetch-site"), headers.get("origin")
        if site is not None:
            return site in ("same-origin", "none")
        return origin is None or origin.partition("://")[2] == headers.get("host")

    def shelf(self) -> LibraryShelf:
        """The shelf of what the caller may see. SignInNeededError for a guest, if the server has no guests."""
        if self.caller.is_guest and not self.library.settings.guests:
            raise SignInNeededError("sign in to see what is here")
        url, kept = self.request.url, self.request.app.state.kept
        return LibraryShelf(self.library, self.caller, f"{url.scheme}://{url.netloc}", kept)

    def change(self, work: Callable[..., object], *args: object) -> None:
        """Calls `work(connection, caller, *args)` in a writing transaction."""
        with self.library.database.writing() as connection:
            work(connection, self.caller, *args)

    def page(
        self,
        template: str,
        facts: Mapping[str, Any],
        wrong: str = "",
        status: int = 200,
        *,
        at: str = "",
        sent: Mapping[str, str] | None = None,
        **more: Any,
    ) -> Response:
        """A page with forms for a signed-in user. wrong: why the last form was refused. sent: what was in it. at: the
        address of the page, if that to which its forms are sent is another one."""
        guests = self.library.settings.guests
        everybody = "everybody, also without a sign-in" if guests else "everybody who is signed in"
        response = page(
            self.request, template, facts, status=status, shelf=self.shelf(), code=self.code, wrong=wrong,
            sent=defaultdict(str, sent or {}), me=self.caller, everybody=everybody, at=at, **more,
        )  # fmt: skip
        response.headers["Cache-Control"] = "no-store"
        return response

    def begin(self, response: Response, refresh_token: str) -> None:
        """Sets the cookie of a sign-in."""
        response.set_cookie(
            COOKIE, refresh_token, max_age=self.library.settings.refresh_seconds, httponly=True, samesite="lax",
            secure=self.request.url.scheme == "https", path="/",
        )  # fmt: skip


def _known_visit(request: Request, token: str) -> Visit:
    """A visit by the holder of a token, else by who has signed in, else by a guest. SignInError if a token is given and
    not valid."""
    library: Library = request.app.state.library
    session = "" if token else request.cookies.get(COOKIE, "")
    with library.database.reading() as connection:
        if token:
            caller: Caller | None = library.tokens.caller(connection, token)
        else:
            caller = library.tokens.of_session(connection, session) if session else None
        if caller is None:
            return Visit(request, library, accounts.guest(connection))
    request.state.user = caller.name  # for the log
    return Visit(request, library, caller, session, library.tokens.form_code(session))


async def _visit(request: Request) -> AsyncIterator[Visit]:
    given = await _BEARER(request)
    visit = await run_in_threadpool(_known_visit, request, "" if given is None else given.credentials)
    with contextlib.suppress(SignInNeededError):
        request.state.shelf = visit.shelf()  # for error pages
    async with request.app.state.turns.turn(visit.caller, visit.address):
        yield visit


Visitor = Annotated[Visit, Depends(_visit, scope="function")]
"""A visit by anybody, whose turn it is until the function of the route returns."""


async def _member(visit: Visitor) -> Visit:
    if not visit.is_signed_in:
        raise SignInNeededError("sign in to see this page")
    return visit


Member = Annotated[Visit, Depends(_member)]
"""A visit by a signed-in user."""


async def _checked(visit: Member, code: Annotated[str, Form()] = "") -> Visit:
    if not visit.is_own_origin or not visit.library.tokens.is_form_code(visit.session, code):
        raise DeniedError("this form is out of date, or not from this sign-in; reload the page and try again")
    return visit


Code = Annotated[Visit, Depends(_checked)]
"""A visit by a signed-in user who has sent a form of our own page."""


@contextlib.asynccontextmanager
async def shown(request: Request) -> AsyncIterator[LibraryShelf]:
    """The shelf of what the caller may see, see `Visit.shelf`; it is their turn within the block."""
    async with contextlib.asynccontextmanager(_visit)(request) as visit:
        yield visit.shelf()


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
