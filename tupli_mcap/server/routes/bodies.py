"""Bodies of answers: stored bytes, whole or a range of them.

1. From a directory: the file itself; behind nginx, its name, and nginx sends it (`X-Accel-Redirect`).
2. From a bucket: if clients can reach it, a redirect to a temporary address (307); else piece by piece.

The content of a name never changes, so that any `ETag` pins a version: that of nginx, of the bucket, or ours, which is
the SHA-256.
"""

from __future__ import annotations

import re
from collections.abc import AsyncIterator
from typing import Any, Final
from urllib.parse import quote

from fastapi import HTTPException, Request, Response
from fastapi.responses import FileResponse, RedirectResponse, StreamingResponse
from starlette.concurrency import run_in_threadpool
from starlette.types import Receive, Scope, Send

from tupli_mcap.page.answers import attachment
from tupli_mcap.server.blobs import PIECE, Blobs, BucketBlobs, lost
from tupli_mcap.server.library import Library

MEDIA: Final = "application/octet-stream"
_SIGNED_SECONDS: Final = 3600
MADE: Final[dict[int | str, dict[str, Any]]] = {200: {"content": {MEDIA: {}}}}
"""The part of the OpenAPI document for bytes that are made while they are sent."""
BODY: Final = {
    **MADE,
    206: {"description": "The range that was asked for.", "content": {MEDIA: {}}},
    304: {"description": "The caller has this version."},
    307: {"description": "The bytes are at another address."},
}
"""The part of the OpenAPI document for the answers of `body_of`."""
_RANGE: Final = re.compile(r"bytes=(\d{0,19})-(\d{0,19})", re.IGNORECASE)


def body_of(
    library: Library,
    request: Request,
    name: str,
    *,
    digest: str,
    file_name: str = "",
    headers: dict[str, str] | None = None,
) -> Response:
    """The answer to a GET or HEAD for the bytes that are kept under a name, and have this SHA-256.

    headers: further headers; with any, this server sends the bytes itself.

    Raises:
        HTTPException: the request is for another version (412), or for a range beyond the end (416).
        LostError: the bytes are missing.
        UnavailableError: the bucket does not answer.
    """
    blobs, settings = library.blobs, library.settings
    tag = f'"{digest}"'
    if _is_among(tag, request.headers.get("If-None-Match", "").replace("W/", "")):
        return Response(status_code=304, headers={"ETag": tag})
    is_bucket = isinstance(blobs, BucketBlobs)
    if isinstance(blobs, BucketBlobs) and settings.presigned and request.method == "GET" and not headers:
        return RedirectResponse(blobs.signed(name, _SIGNED_SECONDS), 307, {"Cache-Control": "no-store"})
    size = blobs.size(name)
    if size is None:
        raise lost(name)
    named = attachment(file_name) if file_name else {}
    # A request with our SHA-256 in If-Match is answered here: nginx would compare it with its own tag.
    if not is_bucket and settings.accel and not headers and tag not in request.headers.get("If-Match", ""):
        told = {"X-Accel-Redirect": quote(f"{settings.accel.rstrip('/')}/{name}"), **named}
        return Response(headers=told, media_type=MEDIA)
    _check_version(request, tag)
    headers = {**(headers or {}), "ETag": tag, **named}
    part = _range(request, tag, size)
    if not is_bucket:
        sent = _File if part else _WholeFile
        return sent(blobs.place(name), headers=headers, media_type=MEDIA)
    return _from_bucket(blobs, request, name, size, part, headers)


def _from_bucket(
    blobs: Blobs,
    request: Request,
    name: str,
    size: int,
    part: tuple[int, int] | None,
    headers: dict[str, str],
) -> Response:
    start, stop = part or (0, size)
    headers |= {"Content-Length": str(stop - start), "Accept-Ranges": "bytes"}
    if part:
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
    status = 206 if part else 200
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers, media_type=MEDIA)
    first = blobs.piece(name, start, min(start + PIECE, stop)) if stop > start else b""
    pieces = _pieces(blobs, name, first, start, stop)
    return StreamingResponse(pieces, status, headers, media_type=MEDIA)


class _File(FileResponse):
    chunk_size = 1 << 18  # larger ones are kept by the allocator, for each thread


class _WholeFile(_File):
    """A file, whatever range the request names: one that is not valid, or several, count as none (RFC 9110)."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = [(name, value) for name, value in scope["headers"] if name != b"range"]
        await super().__call__({**scope, "headers": headers}, receive, send)


async def _pieces(blobs: Blobs, name: str, first: bytes, start: int, stop: int) -> AsyncIterator[bytes]:
    yield first
    for begin in range(start + PIECE, stop, PIECE):
        yield await run_in_threadpool(blobs.piece, name, begin, min(begin + PIECE, stop))


def _check_version(request: Request, tag: str) -> None:
    wanted = request.headers.get("If-Match")
    if wanted is not None and not _is_among(tag, wanted):
        raise HTTPException(412, "this has changed; open it again")


def _is_among(tag: str, wanted: str) -> bool:
    return wanted.strip() == "*" or tag in map(str.strip, wanted.split(","))


def _range(request: Request, tag: str, size: int) -> tuple[int, int] | None:
    """The requested range of bytes; None for all, which also answers what is no valid range, and several ones."""
    found = _RANGE.fullmatch(request.headers.get("Range", "").strip())
    if found is None or not any(found.groups()) or request.headers.get("If-Range", tag) != tag:
        return None
    first, last = found.groups()
    if first and last and int(first) > int(last):
        return None
    start = int(first) if first else max(0, size - int(last))
    stop = min(int(last) + 1, size) if first and last else size
    if start >= size or start >= stop:
        raise HTTPException(416, f"expected a range of {size} bytes", {"Content-Range": f"bytes */{size}"})
    return start, stop
