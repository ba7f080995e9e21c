"""Who asks: what every route takes to know the server and the caller."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from tupli_mcap.server import accounts
from tupli_mcap.server.access import Caller, DeniedError
from tupli_mcap.server.library import Library
from tupli_mcap.server.tokens import SignInError

__all__ = ["AnyCaller", "Reader", "Served", "Throttle", "Writer"]

_BEARER = HTTPBearer(auto_error=False, description="An access token of `POST /v1/tokens`, or an API token.")


def _library(request: Request) -> Library:
    library: Library = request.app.state.library
    return library


Served = Annotated[Library, Depends(_library)]
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


class Throttle:
    """Keeps who tries passwords from trying many: ten failures a minute for a name, and from an address."""

    _MOST = 10
    _SECONDS = 60.0

    def __init__(self) -> None:
        self._failures: dict[str, deque[float]] = {}
        self._turn = threading.Lock()

    def wait(self, *keys: str) -> float:
        """Seconds until another try; 0 if it may be made now."""
        now = time.monotonic()
        with self._turn:
            for key in list(self._failures):
                times = self._failures[key]
                while times and times[0] < now - self._SECONDS:
                    times.popleft()
                if not times:
                    del self._failures[key]
            full = [self._failures[key] for key in keys if len(self._failures.get(key, ())) >= self._MOST]
            return max((times[0] + self._SECONDS - now for times in full), default=0.0)

    def failed(self, *keys: str) -> None:
        """Notes a failure."""
        with self._turn:
            for key in keys:
                self._failures.setdefault(key, deque()).append(time.monotonic())
