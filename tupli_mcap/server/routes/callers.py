"""Who asks: what every route takes to know the server and the caller."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from tupli_mcap.server.library import Library
from tupli_mcap.server.people import accounts
from tupli_mcap.server.people.access import Caller, DeniedError
from tupli_mcap.server.people.tokens import SignInError

__all__ = ["Address", "AnyCaller", "Reader", "Served", "Writer"]

_BEARER = HTTPBearer(auto_error=False, description="An access token of `POST /v1/tokens`, or an API token.")


def _library(request: Request) -> Library:
    library: Library = request.app.state.library
    return library


Served = Annotated[Library, Depends(_library)]


def _address(request: Request) -> str:
    return request.client.host if request.client else ""


Address = Annotated[str, Depends(_address)]
_Credentials = Annotated[HTTPAuthorizationCredentials | None, Depends(_BEARER)]


def _any_caller(library: Served, credentials: _Credentials) -> Caller:
    """Whoever it is: a user, or a guest. A token that is given must be valid."""
    with library.database.reading() as connection:
        if credentials is None:
            return accounts.guest(connection)
        return library.tokens.caller(connection, credentials.credentials)


AnyCaller = Annotated[Caller, Depends(_any_caller)]


def _reader(library: Served, caller: AnyCaller) -> Caller:
    if caller.is_guest and not library.settings.guests:
        raise SignInError("this server shows nothing to guests")
    return caller


Reader = Annotated[Caller, Depends(_reader)]


def _writer(caller: AnyCaller) -> Caller:
    if caller.is_guest:
        raise SignInError("guests may change nothing")
    if not caller.may_write:
        raise DeniedError("this token may only read; make one with the scope 'write'")
    return caller


Writer = Annotated[Caller, Depends(_writer)]
