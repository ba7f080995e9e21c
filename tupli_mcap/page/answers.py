"""Answers to a browser: pages and errors as HTML or JSON, with headers that keep content of files from being run."""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from http import HTTPStatus
from typing import Annotated, Any, Final
from urllib.parse import quote, urlencode

from fastapi import Depends, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import RedirectResponse
from fastapi.routing import APIRoute
from jinja2 import Environment, PackageLoader, StrictUndefined
from starlette.convertors import PathConvertor, register_url_convertor
from starlette.datastructures import QueryParams
from starlette.exceptions import HTTPException

import tupli_mcap
from tupli_mcap import jsonvalue
from tupli_mcap.errors import FilterError, MissingExtraError, NotFoundError, SpaceError, TupliError, bytes_of
from tupli_mcap.page import texts
from tupli_mcap.page.shelf import Shelf
from tupli_mcap.recording.edit.merge import UnmergeableError
from tupli_mcap.schema import FilterEQ, format_filter, join_key

POLICY: Final = (
    "default-src 'self'; img-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
_HEADERS: Final = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "private, no-cache",
}


FOR_VIEWERS: Final = {
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Expose-Headers": "Accept-Ranges, Content-Range, ETag, Last-Modified",
}
"""The headers of a recording that pages of other hosts may read: they need the ticket, and no cookie."""


class _FileName(PathConvertor):
    regex = "(?s:.+)"


register_url_convertor("file_name", _FileName())
FILE_NAME: Final = "{name:file_name}"
"""The part of a route's path for the name of a file, which may have slashes and line breaks."""


async def _shelf(request: Request) -> AsyncIterator[Shelf]:
    async with request.app.state.shown(request) as shelf:
        request.state.shelf = shelf
        yield shelf


Shown = Annotated[Shelf, Depends(_shelf, scope="function")]
"""The shelf, limited to what the requesting user may see."""


class SignInNeededError(TupliError):
    """The page needs a signed-in user, and nobody is signed in."""


class PageRoute(APIRoute):
    """A route whose errors are pages, and whose answers have the headers of pages."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        answered = super().get_route_handler()

        async def handler(request: Request) -> Response:
            try:
                return _with_headers(await answered(request))
            except (TupliError, RequestValidationError, HTTPException) as err:
                return error_page(request, err)

        return handler


def _with_headers(response: Response) -> Response:
    for name, value in _HEADERS.items():
        response.headers.setdefault(name, value)
    return response


def page(
    request: Request,
    template: str,
    facts: Mapping[str, Any],
    *,
    status: int = 200,
    shelf: Shelf | None = None,
    **drawn: Any,
) -> Response:
    """A page: `facts` as JSON if the query has `format=json`, else the template filled with `facts` and `drawn`."""
    if _wants_json(request):
        return Response(jsonvalue.dumps(dict(facts)), status, media_type="application/json")
    drawn |= {"request": request, "shelf": shelf, "facts": facts}
    got = request.method in ("GET", "HEAD")  # what a form has led to has no address
    at = "" if got else drawn.get("at", "")
    here = at.partition("?")[0] or request.url.path
    drawn |= {"here": here, "params": request.query_params, "got": got, "at": at}
    made = _templates().get_template(template).render(drawn)
    # A text of a file may hold characters that UTF-8 cannot encode (lone surrogates).
    return Response(made.encode("utf-8", "replace"), status, media_type="text/html")


def attachment(name: str) -> dict[str, str]:
    """The header of an answer that a browser saves as a file of this name, which may have any letters."""
    return {"Content-Disposition": f"attachment; filename*=utf-8''{quote(name)}"}


def address(*path: object, **params: Any) -> str:
    """The address of a page; parameters that are None, empty, False or 0, as they are by default, are left out."""
    given = {key: value for key, value in params.items() if value not in (None, "", [], False)}
    parts = (
        quote(str(part), safe="@:+/" if i else "", errors="surrogatepass") for i, part in enumerate(path)
    )
    query = urlencode(given, doseq=True, errors="surrogatepass")
    return "/" + "/".join(parts) + (f"?{query}" if query else "")


def _same_query(params: QueryParams, **changes: str) -> str:
    """A query with some parameters changed; others may be there several times."""
    kept = [(key, value) for key, value in params.multi_items() if key not in changes]
    return urlencode([*kept, *changes.items()], errors="surrogatepass")


def _size(given: int | None) -> str:
    """`1.2 MB`; a dash for None."""
    return "–" if given is None else bytes_of(given)


@functools.cache
def _templates() -> Environment:
    made = Environment(
        loader=PackageLoader("tupli_mcap.page"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {name: getattr(texts, name) for name in texts.__all__}
    made.filters |= {"size": _size, "spelled": jsonvalue.spelled}
    made.globals |= {
        "can_film": importlib.util.find_spec("av") is not None,
        "can_replay": importlib.util.find_spec("rerun") is not None,
        "address": address,
        "metadata_key": lambda key: join_key(["metadata", key]),
        "recording_filter": lambda name: format_filter(FilterEQ(key="recording", value=name)),
        "same_query": _same_query,
        "version": tupli_mcap.__version__,
    }
    return made


def _wants_json(request: Request) -> bool:
    return request.query_params.get("format") == "json"


def wants_page(request: Request) -> bool:
    """Whether a request, perhaps of no route, is for a page: from a browser, or for the JSON of a page."""
    return _wants_json(request) or "text/html" in request.headers.get("accept", "")


def error_page(request: Request, err: Exception) -> Response:
    """The page for an error; for `SignInNeededError`, a redirection to the sign-in page. `request.state.shelf` is the
    shelf, once it is known."""
    as_json = _wants_json(request)
    if isinstance(err, SignInNeededError) and request.method in ("GET", "HEAD") and not as_json:
        here = request.url.path + (f"?{request.url.query}" if request.url.query else "")
        return _with_headers(RedirectResponse(address("sign-in", next=here), 303))
    status, text = _told(request, err)
    title, shelf = _TITLES.get(status, "This did not work"), getattr(request.state, "shelf", None)
    before, own = request.headers.get("referer", ""), str(request.base_url)
    came_from = f"/{before.removeprefix(own)}" if before.startswith(own) else ""  # the page with the form
    drawn = {"title": title, "may_sign_in": isinstance(err, SignInNeededError), "at": came_from}
    return _with_headers(page(request, "error.html", {"error": text}, status=status, shelf=shelf, **drawn))


def _told(request: Request, err: Exception) -> tuple[int, str]:
    """The status and the message of an error. An application may set `app.state.told` to word our errors itself."""
    if isinstance(err, HTTPException):
        is_bare = err.detail == HTTPStatus.NOT_FOUND.phrase  # as Starlette says that there is no route
        return err.status_code, "there is no page at this address" if is_bare else str(err.detail)
    if isinstance(err, RequestValidationError):
        first = err.errors()[0]
        return 400, f"{'.'.join(map(str, first['loc'][1:]))}: {first['msg']}"
    if isinstance(err, SignInNeededError):
        return 401, str(err)
    told: Callable[[Exception], tuple[int, str]] | None = getattr(request.app.state, "told", None)
    return _status(err) if told is None else told(err)


def _status(err: Exception) -> tuple[int, str]:
    wrong = (FilterError, SpaceError, UnmergeableError)
    kinds = ((NotFoundError, 404), (wrong, 400), (MissingExtraError, 501))
    return next((code for kind, code in kinds if isinstance(err, kind)), 500), str(err)


_TITLES: Final = {
    400: "This cannot be shown",
    401: "Not signed in",
    403: "Not allowed",
    404: "Not here",
    501: "Something is not installed",
}
