"""The dependencies of all routes: the server's library, and the caller.

One that waits for nothing is `async`: FastAPI runs all others in threads, and handing over takes longer than they do.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from typing import Annotated, Any, NamedTuple

from fastapi import Depends, Query, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from tupli_mcap.server.library import Library
from tupli_mcap.server.people import accounts
from tupli_mcap.server.people.access import Caller, DeniedError
from tupli_mcap.server.people.tokens import SignInError

_BEARER = HTTPBearer(auto_error=False, description="An access token of `POST /v1/tokens`, or an API token.")


async def _library(request: Request) -> Library:
    library: Library = request.app.state.library
    return library


Served = Annotated[Library, Depends(_library)]


async def _address(request: Request) -> str:
    return request.client.host if request.client else ""


Address = Annotated[str, Depends(_address)]
_Credentials = Annotated[HTTPAuthorizationCredentials | None, Depends(_BEARER)]


def _known_caller(library: Served, credentials: _Credentials, request: Request) -> Caller:
    """The caller: a user, or a guest. SignInError if a token is given and not valid."""
    with library.database.reading() as connection:
        if credentials is None:
            return accounts.guest(connection)
        caller = library.tokens.caller(connection, credentials.credentials)
    request.state.user = caller.name  # for the log
    return caller


_Known = Annotated[Caller, Depends(_known_caller)]


async def _any_caller(request: Request, address: Address, caller: _Known) -> AsyncIterator[Caller]:
    if request.method == "PATCH":  # takes no thread while its body arrives
        yield caller
        return
    async with request.app.state.turns.turn(caller, address):
        yield caller


AnyCaller = Annotated[Caller, Depends(_any_caller, scope="function")]
"""The caller, whose turn it is until the function of the route returns."""


async def _reader(library: Served, caller: AnyCaller) -> Caller:
    return _demand_guests(library, caller)


def _demand_guests(library: Library, caller: Caller) -> Caller:
    if caller.is_guest and not library.settings.guests:
        raise SignInError("this server shows nothing to guests")
    return caller


Reader = Annotated[Caller, Depends(_reader)]


def _demand_writing(caller: Caller) -> None:
    """Raises DeniedError if the caller's token may only read."""
    if not caller.may_write:
        raise DeniedError("this token may only read; make one with `tupli-mcap create-token NAME --write`")


async def _writer(request: Request, library: Served, caller: AnyCaller) -> Caller:
    if not caller.is_guest:
        _demand_writing(caller)
    elif request.url.path.startswith("/v1/"):
        raise SignInError("guests may change nothing")
    return _demand_guests(library, caller)


Writer = Annotated[Caller, Depends(_writer)]
"""A user whose token may write. `/v1` asks guests to sign in (401); at PyTupli's routes, they lack the rights (403)."""


async def _newcomer(caller: AnyCaller) -> Caller:
    if not caller.is_guest:
        _demand_writing(caller)
    return caller


Newcomer = Annotated[Caller, Depends(_newcomer)]
"""A user whose token may write, or a guest, who may sign up where the server lets everybody."""


async def _person(caller: Writer) -> Caller:
    if caller.is_machine:
        raise DeniedError("a token for machines may not do this; sign in with the password")
    return caller


Person = Annotated[Caller, Depends(_person)]
"""A user who has signed in with the password: a stolen token cannot make more tokens, or lock out its user."""


class Holder(NamedTuple):
    """The reader of an address: a signed-in caller, or the holder of a ticket, which names what it opens."""

    caller: Caller
    ticket: Mapping[str, Any] | None

    def of(self, recording: str) -> Caller:
        """The caller with whose rights a recording is read. Raises SignInError if the ticket is for something else."""
        if self.ticket is not None and self.ticket.get("recording") != recording:
            raise SignInError("the ticket is for another recording; open it again")
        return self.caller


def _known_holder(
    library: Served,
    caller: _Known,
    request: Request,
    ticket: Annotated[str | None, Query(max_length=4096)] = None,
) -> Holder:
    if ticket is None:
        return Holder(_demand_guests(library, caller), None)
    with library.database.reading() as connection:
        found, what = library.tokens.of_ticket(connection, ticket)
    if found.is_guest and not library.settings.guests:
        raise SignInError("the ticket is not valid any more")
    request.state.user = found.name
    return Holder(found, what)


async def _holder(
    request: Request, address: Address, holder: Annotated[Holder, Depends(_known_holder)]
) -> AsyncIterator[Holder]:
    async with request.app.state.turns.turn(holder.caller, address):
        yield holder


TicketHolder = Annotated[Holder, Depends(_holder, scope="function")]
