"""Bodies of answers: stored bytes, whole or a range of them.

1. From a directory: the file itself; through nginx, its name, and nginx sends it (`X-Accel-Redirect`).
2. From a bucket: if clients can reach it, a redirect to a temporary address (307); else piece by piece.

The content of a name never changes, so that any `ETag` pins a version: that of nginx, of the bucket, or ours, which is
the SHA-256.
"""

from __future__ import annotations

import re
from typing import Any, Final
from urllib.parse import quote

from fastapi import HTTPException, Request, Response
from fastapi.responses import RedirectResponse

from tupli_mcap.page.answers import attachment
from tupli_mcap.page.copies import ClosingResponse
from tupli_mcap.server.blobs import BucketBlobs, LostError
from tupli_mcap.server.library import Library

MEDIA: Final = "application/octet-stream"
# Clients ask there at once, and ask this server again for each further range. S3 lets clocks differ by so much.
_SIGNED_SECONDS: Final = 15 * 60
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
        NotFoundError: they were deleted after the caller had found them.
        LostError: the bytes are missing.
        UnavailableError: the bucket does not answer.
    """
    blobs, settings = library.blobs, library.settings
    tag = f'"{digest}"'
    if _is_among(tag, request.headers.get("If-None-Match", "").replace("W/", "")):
        return Response(status_code=304, headers={"ETag": tag})
    if isinstance(blobs, BucketBlobs) and settings.presigned and request.method == "GET" and not headers:
        return RedirectResponse(blobs.signed(name, _SIGNED_SECONDS), 307, {"Cache-Control": "no-store"})
    size = blobs.size(name)
    if size is None:
        raise library.missing(name)
    named = attachment(file_name) if file_name else {}
    wanted = request.headers.get("If-Match")
    # A request that has not come through nginx is answered here, and one with our SHA-256 in If-Match: nginx would
    # compare it with its own tag.
    by_nginx = settings.accel and "X-Forwarded-For" in request.headers
    if not isinstance(blobs, BucketBlobs) and by_nginx and not headers and tag not in (wanted or ""):
        told = {"X-Accel-Redirect": quote(f"{settings.accel.rstrip('/')}/{name}"), **named}
        return Response(headers=told, media_type=MEDIA)
    if wanted is not None and not _is_among(tag, wanted):
        raise HTTPException(412, "this has changed; open it again")
    part = _range(request, tag, size)
    start, stop = part or (0, size)
    told = {"Content-Length": str(stop - start), "Accept-Ranges": "bytes", "ETag": tag}
    headers = {**(headers or {}), **told, **named}
    if part:
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
    status = 206 if part else 200
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers, media_type=MEDIA)
    try:
        pieces = blobs.pieces(name, start, stop)
    except LostError as err:
        raise library.missing(name) from err
    return ClosingResponse(pieces, status_code=status, headers=headers, media_type=MEDIA)


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
