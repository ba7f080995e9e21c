"""What a server answers: as models, or as the errors that a storage here would raise."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from tupli_mcap import errors
from tupli_mcap.errors import NotFoundError, StorageError, TupliError
from tupli_mcap.storage.texts import first_defect

if TYPE_CHECKING:
    import httpx

__all__ = ["LATER", "ConflictError", "Page", "SignInError", "UnreachableError", "as_told", "error_of"]

LATER: Final = (423, 429, 500, 502, 503, 504)
"""Statuses with which a server says that it cannot answer now."""
_ANEW: Final = (410, 460)  # an upload that is gone, or has come with wrong bytes: it is begun anew
_T = TypeVar("_T")


class UnreachableError(StorageError):
    """The server does not answer, or not now."""


class ConflictError(StorageError):
    """Something else is there already."""


class SignInError(StorageError):
    """Nobody is signed in."""


class Page(BaseModel):
    """A page of a list; `next` is the cursor of the one after it."""

    items: list[dict[str, Any]]
    next: str | None


def as_told(kind: type[_T], value: Any) -> _T:
    """What a server tells, as a model, or a list of them. StorageError if it is something else."""
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as err:
        raise StorageError(
            f"expected {getattr(kind, '__name__', kind)} from the server, found something else: {first_defect(err)}"
        ) from err


def error_of(response: httpx.Response, url: str, *, signed_in: bool) -> TupliError:
    """The error that a refusal of the server at `url` stands for."""
    status = response.status_code
    try:
        told = json.loads(response.content)
        detail, name = str(told["detail"]), str(told.get("error", ""))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        detail, name = f"it answers {status}", ""
    detail = "".join(c if c.isprintable() else " " for c in detail[:2000])
    message = f"{detail} (says {url})"
    if status == 401 and signed_in:
        return SignInError(f"{message}; sign in: tupli-mcap login USER --url {url}")
    if status in (*_ANEW, *LATER) or "Upload-Offset" in response.headers:
        return UnreachableError(f"{message}; try again later")
    if status == 409:
        return ConflictError(message)
    kind = getattr(errors, name, StorageError) if name in errors.__all__ else StorageError
    if not issubclass(kind, TupliError) or kind is TupliError:
        kind = NotFoundError if status in (404, 412) else StorageError
    return kind(message)
