"""Turns answers of a server into models, or into the errors that a local storage would raise."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final, TypeVar

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from tupli_mcap import errors
from tupli_mcap.errors import NotFoundError, StorageError, TupliError
from tupli_mcap.storage.texts import first_defect

if TYPE_CHECKING:
    import httpx

LATER: Final = (423, 429, 500, 502, 503, 504)
"""Statuses with which a server says that it cannot answer now."""
_LATER: Final = "try again later"
_ANEW: Final = (410, 460)  # an upload that expired or got wrong bytes: begin it again
_NO_ROUTE: Final = ("there is no route", "Not Found", "Method Not Allowed")  # as ours and others say it
_OF_PROXIES: Final = {
    403: ", as a proxy does that may not read the server's files",
    502: ", as a proxy does while the server behind it does not run",
    504: ", as a proxy does while the server behind it does not answer",
}
_NO_FIELD: Final = "there is no such field"  # as our server says it of what a client of another version asks
_WHICH: Final = "is it a tupli-mcap server, of a version like this one?"
_T = TypeVar("_T")


class UnreachableError(StorageError):
    """The server does not answer, or cannot answer now."""


class FailedError(UnreachableError):
    """The server failed at this request, and may not fail at others."""


class ConflictError(StorageError):
    """Something with this name or id exists already."""


class SignInError(StorageError):
    """Nobody is signed in."""


def is_of_all(err: TupliError) -> bool:
    """Whether all recordings would meet an error: nobody is signed in, or the server does not answer."""
    return isinstance(err, SignInError | UnreachableError) and not isinstance(err, FailedError)


# --- answers, of which a server makes the same models ---


class Page(BaseModel):
    """A page of items; `next` is the cursor of the next page, None on the last."""

    items: list[dict[str, Any]]
    next: str | None


class TokenPair(BaseModel):
    """An access token, valid for `expires_in` seconds, and the token that is exchanged for the next pair."""

    access_token: str
    refresh_token: str
    token_type: str
    expires_in: int


class Shared(BaseModel):
    """What a group sees now or no longer, or would: whether the benchmark, and how many episodes.

    unseen: how many artifacts of others, which the benchmark needs, the group cannot see.
    """

    benchmark: bool
    episodes: int
    unseen: int


class Ticket(BaseModel):
    """An address at which a recording can be read for a while without signing in; `whole` if the caller may read all.

    digest: of the whole file. size, episodes: too; 0 unless `whole`.
    """

    path: str = Field(pattern="^/v1/files/")
    whole: bool
    digest: str = Field(pattern="^[0-9a-f]{64}$")
    size: int
    episodes: int


# --- parsing them ---


def as_told(kind: type[_T], value: Any) -> _T:
    """Parses an answer as a model or a list of models. StorageError if it does not fit."""
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as err:
        raise StorageError(
            f"expected {getattr(kind, '__name__', kind)} from the server, found something else ({first_defect(err)}); "
            f"{_WHICH}"
        ) from err


def error_of(response: httpx.Response, url: str, *, sign_in: str) -> TupliError:
    """The error for a refusal of the server at `url`.

    sign_in: tells the user how to sign in; empty for requests that need no sign-in.
    """
    status = response.status_code
    try:
        told = json.loads(response.content)
        detail, name = str(told["detail"]), str(told.get("error", ""))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        detail = name = ""
    if status in (401, 404, 405, 501) and (not name or detail.startswith(_NO_ROUTE)):
        asked = response.request
        message = f"{url} answers {status} to {asked.method} {asked.url.path}; {_WHICH}"
    elif not detail:
        message = f"{url} answers {status}{_OF_PROXIES.get(status, '')}"
    else:
        which = f"; {_WHICH}" if status == 400 and detail.endswith(_NO_FIELD) else ""
        message = f"{''.join(c if c.isprintable() else ' ' for c in detail[:2000])}{which} (says {url})"
    if status == 401 and name:
        return SignInError(f"{message}; {sign_in}" if sign_in else message)
    if status == 500:
        return FailedError(message)
    if status in (*_ANEW, *LATER) or "Upload-Offset" in response.headers:
        return UnreachableError(message if _LATER in detail else f"{message}; {_LATER}")
    if status == 409:
        return ConflictError(message)
    kind = getattr(errors, name, StorageError) if name in errors.__all__ else StorageError
    if not issubclass(kind, TupliError) or kind is TupliError:
        kind = NotFoundError if status in (404, 412) else StorageError
    return kind(message)
