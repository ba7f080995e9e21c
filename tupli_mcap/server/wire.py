"""The JSON of requests, answers and errors, and the status of each error."""

from __future__ import annotations

import bisect
import contextlib
import json
import math
import re
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Final

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from starlette.exceptions import HTTPException

from tupli_mcap import jsonvalue
from tupli_mcap.errors import (
    FilterError,
    FormatError,
    MissingExtraError,
    NotFoundError,
    RecordingError,
    SpaceError,
    StorageError,
    TupliError,
)
from tupli_mcap.page.answers import error_page, wants_page
from tupli_mcap.recording.edit.merge import UnmergeableError
from tupli_mcap.schema import (
    ArtifactMetadata,
    ArtifactMetadataItem,
    BaseFilter,
    BenchmarkHeader,
    parse_filter,
)
from tupli_mcap.server.blobs import LostError
from tupli_mcap.server.database import DiskFullError, TooLongError, UnavailableError
from tupli_mcap.server.people.access import DeniedError
from tupli_mcap.server.people.accounts import ConflictError
from tupli_mcap.server.people.limits import FullError, TooManyError
from tupli_mcap.server.people.tokens import SignInError
from tupli_mcap.server.traffic.logs import LOG
from tupli_mcap.server.uploads import BusyError, ChecksumError, GoneError, TooLargeError, TooManyUploadsError
from tupli_mcap.storage.base import age
from tupli_mcap.storage.benchmark_json import restored
from tupli_mcap.storage.texts import first_defect, plain_message

_MOST_VALUES: Final = 20_000
_LONGEST_TEXT: Final = 20_000  # characters of a filter
_MOST_METADATA: Final = 64 << 10  # bytes of JSON
_CURSOR: Final = re.compile("([0-9]{1,20})-([0-9a-f]{64})")
_MOST_OFFSET: Final = 1 << 53  # larger numbers in JSON are not exact in all programs

_STATUS: Final[dict[type[TupliError], int]] = {
    SignInError: 401,
    TooManyError: 429,
    DeniedError: 403,
    NotFoundError: 404,
    ConflictError: 409,
    GoneError: 410,
    BusyError: 423,
    ChecksumError: 460,  # defined by tus
    TooLargeError: 413,
    TooManyUploadsError: 429,
    UnavailableError: 503,
    TooLongError: 400,
    UnmergeableError: 400,
    RecordingError: 503,  # a stored file cannot be opened
    FullError: 507,
    DiskFullError: 507,
    LostError: 500,
    FilterError: 400,
    SpaceError: 400,
    FormatError: 400,
    StorageError: 400,
    MissingExtraError: 501,
}


_FAILED: Final = {
    500: "the server has failed; its log says more",
    503: "the server cannot reach what it keeps things in; try again later",
}


class Error(BaseModel):
    """Why a request was refused; `error` is the class of the error that a `TupliStorage` would raise."""

    detail: str
    error: str


_Answers = dict[int | str, dict[str, Any]]
_TOLD: Final[dict[str, Any]] = {"model": Error}
_FAILURES: Final[_Answers] = {
    503: _TOLD,
    507: {**_TOLD, "description": "The caller keeps as much as they may, or the server's disk is full."},
}
# What the OpenAPI document says of every route that programs use.
REFUSALS: Final[_Answers] = {**_FAILURES, "4XX": {**_TOLD, "description": "Why this is refused."}}
REFUSALS_OF_PYTUPLI: Final[_Answers] = _FAILURES | dict.fromkeys(
    (400, 401, 403, 404, 409, 412, 413, 416, 429), _TOLD
)

_FilterText = Annotated[str, Field(max_length=_LONGEST_TEXT, examples=["return > 45"])]


def _affordable(told: Any) -> Any:
    """The JSON of a filter, before each part of it is looked at, which takes long for many; or the filter of a text."""
    if isinstance(told, str):
        if len(told) > _LONGEST_TEXT:
            raise ValueError(
                f"expected a filter's text of at most {_LONGEST_TEXT} characters, found {len(told)}; send JSON"
            )
        return parse_filter(told)
    count, parts = 0, [told]
    while parts and count <= _MOST_VALUES:
        part = parts.pop()
        inner, value = (part.get("filters"), part.get("value")) if isinstance(part, dict) else (None, None)
        if isinstance(inner, list) and inner:
            parts += inner
            continue
        count += len(value) if isinstance(value, list) else 1
        if count <= _MOST_VALUES and isinstance(value, dict | list):
            part["value"] = _restored(value)
    if count > _MOST_VALUES:
        raise ValueError(
            f"expected a filter with at most {_MOST_VALUES} values, found more; ask in several parts"
        )
    return told


def _restored(value: Any) -> Any:
    """A value that JSON lacks, such as a large integer, from its tag; see `jsonvalue`."""
    try:
        return restored(value)
    except (FormatError, RecursionError) as err:
        raise ValueError(str(err)) from err


AskedFilter = Annotated[
    BaseFilter, BeforeValidator(_affordable, json_schema_input_type=BaseFilter | _FilterText)
]
"""The filter of a request: as JSON, or as the text that commands take."""


class Asked(BaseModel):
    """The body of a request. A field that it does not have is an error: a misspelt filter would mean everything."""

    model_config = ConfigDict(extra="forbid")


class Listing(Asked):
    """What to list: a filter, and which page of the matching items. `cursor` is the `next` of the page before."""

    filter: AskedFilter | None = None
    limit: int | None = Field(default=None, ge=0)
    offset: int = Field(default=0, ge=0, le=_MOST_OFFSET)
    cursor: str | None = None


def answer(value: Any) -> Response:
    """A JSON answer; models become objects. Numbers that JSON lacks (NaN, infinities) are tagged, as in our files."""
    return Response(jsonvalue.dumps(_as_json(value)), media_type="application/json")


def demand_short(metadata: BaseModel) -> None:
    """Raises TooLargeError for long metadata of an item: they are in every list, and in a header of an artifact."""
    size = len(jsonvalue.dumps(_as_json(metadata)))
    if size > _MOST_METADATA:
        raise TooLargeError(
            f"expected metadata of at most {_MOST_METADATA} bytes, found {size}; store an artifact instead"
        )


def artifact_metadata(data: str | bytes) -> ArtifactMetadata:
    """The metadata of an artifact, from JSON."""
    try:
        found = ArtifactMetadata.model_validate(jsonvalue.loads(data))
    except ValidationError as err:
        raise StorageError(f"expected the metadata of an artifact: {first_defect(err)}") from err
    except ValueError as err:
        raise StorageError(f"expected the metadata of an artifact as JSON: {err}") from err
    demand_short(found)
    return found


def listed(items: Iterable[BaseModel], following: str | None = None) -> Response:
    return answer({"items": list(items), "next": following})


def paged(
    items: Sequence[BenchmarkHeader] | Sequence[ArtifactMetadataItem], told: Listing, most: int
) -> Response:
    """A page of a list that is complete in memory, oldest first. Its cursor names the last item, and not how many there
    were: one of them may be deleted before the next page."""
    start = told.offset
    if told.cursor is not None:
        last = _CURSOR.fullmatch(told.cursor)
        if last is None:
            raise StorageError("expected the cursor of the page before; list from the beginning")
        start += bisect.bisect_right(items, (int(last[1]), last[2]), key=age)
    stop = start + (most if told.limit is None else min(told.limit, most))
    more = start < stop < len(items)
    return listed(items[start:stop], "{}-{}".format(*age(items[stop - 1])) if more else None)


def _as_json(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump()
    if isinstance(value, dict):
        return {key: _as_json(item) for key, item in value.items()}
    return [_as_json(item) for item in value] if isinstance(value, list) else value


def told(err: TupliError) -> tuple[int, str]:
    """The status and the message of an error. Failures of the server are logged."""
    kind = next((kind for kind in type(err).__mro__ if kind in _STATUS), None)
    if kind is StorageError and isinstance(err.__cause__, OSError):  # it names a file of the server
        kind = UnavailableError
    status = 500 if kind is None else _STATUS[kind]
    if status >= 500 and kind is not FullError:
        why = {} if kind is None else {"error": str(err)}  # about the server; others may quote the request
        LOG.error("refused", extra={"status": status, **why}, exc_info=err)
    return status, str(err) if kind is LostError else _FAILED.get(status, str(err))


class _Refusal(JSONResponse):
    """An error as JSON in ASCII, because it may quote a text that UTF-8 cannot hold: one with a lone surrogate."""

    def render(self, content: object) -> bytes:
        return json.dumps(content).encode()


def _defect(request: Request, found: dict[str, Any]) -> str:
    """What is wrong with a request, in words."""
    kind, (part, *inside) = found["type"], found["loc"]
    media = request.headers.get("Content-Type", "none")
    if kind == "json_invalid":
        return f"expected JSON as the body, found a mistake at character {inside[0]}: {found['ctx']['error']}"
    if part == "body" and not inside and "json" not in media:
        return f"expected JSON as the body, and Content-Type: application/json, found {media:.80}"
    what = "there is no such field" if kind == "extra_forbidden" else plain_message(found["msg"])
    return f"expected another request: {'.'.join(map(str, inside)) or 'its body'}: {what}"


def tell_errors(app: FastAPI) -> None:
    """Makes the application answer errors of this package, and invalid requests."""

    @app.exception_handler(RequestValidationError)
    async def _tell_defect(request: Request, err: RequestValidationError) -> _Refusal:
        defects = [{name: each[name] for name in ("type", "loc", "msg")} for each in err.errors()]
        if not request.url.path.startswith("/v1/"):  # PyTupli's client expects this form
            return _Refusal({"detail": defects}, 422)
        return _Refusal({"detail": _defect(request, err.errors()[0]), "error": "StorageError"}, 400)

    @app.exception_handler(HTTPException)
    async def _tell_refusal(request: Request, err: HTTPException) -> Response:
        if not request.url.path.startswith("/v1/") and wants_page(request):
            # Notes the shelf of who is signed in, for the links of the page.
            with contextlib.suppress(TupliError):
                async with request.app.state.shown(request):
                    pass
            return error_page(request, err)
        kind = "NotFoundError" if err.status_code in (404, 412) else "StorageError"
        detail = err.detail
        if detail in ("Not Found", "Method Not Allowed"):  # of Starlette
            detail = f"there is no route {request.method} {request.url.path:.200}; /openapi.json lists what there is"
        return _Refusal({"detail": detail, "error": kind}, err.status_code, err.headers)

    @app.exception_handler(TupliError)
    def _tell(request: Request, err: TupliError) -> _Refusal:
        status, text = told(err)
        headers = {"WWW-Authenticate": "Bearer"} if status == 401 else {}
        if isinstance(err, TooManyError):
            headers["Retry-After"] = str(math.ceil(err.seconds))
        kind = next(c.__name__ for c in type(err).__mro__ if c.__module__ == "tupli_mcap.errors")
        return _Refusal({"detail": text, "error": kind}, status, headers)
