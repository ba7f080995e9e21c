"""Uploads a recording to a server with the tus protocol: an interrupted upload continues, the server checks the
SHA-256, and a recording that is sent twice is stored once."""

from __future__ import annotations

import base64
import hashlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import quote, unquote, urlsplit

from tupli_mcap.errors import StorageError
from tupli_mcap.storage.api.answers import UnreachableError, as_told
from tupli_mcap.storage.api.session import TIMEOUT, Session
from tupli_mcap.storage.atomic import os_errors

Tell = Callable[[int], None]
"""Is told how many more bytes were sent or fetched; fewer than none, where some have to be sent again."""

_FRUITLESS: Final = 4  # attempts one after another that bring nothing across
_PIECE: Final = 1 << 20
_CHECKED: Final = 20e6  # bytes a second that a slow server reads again to check them
_TUS: Final = {"Tus-Resumable": "1.0.0"}


class Sent(NamedTuple):
    """A recording on the server, by its name; `was_there`: the server had these bytes, and nothing was sent."""

    name: str
    was_there: bool


def send_file(
    session: Session, path: Path, *, name: str = "", sent_before: int = 0, tell: Tell = lambda _: None
) -> Sent:
    """Sends a recording.

    name: of its file here, which becomes part of its name on the server. sent_before: episodes with lower numbers were
        sent before, in parts; those that the server lacks were deleted there, and stay so. tell: see `Tell`.

    Raises:
        UnreachableError: the server does not answer, or the connection breaks again and again.
        StorageError: the server refuses it, or the file cannot be read.
    """
    digest, size = digest_of(path)
    told = {"sha256": digest} | ({"sent_before": str(sent_before)} if sent_before else {})
    metadata = ",".join(f"{key} {base64.b64encode(text.encode()).decode()}" for key, text in told.items())
    headers = {**_TUS, "Upload-Length": str(size), "Upload-Metadata": metadata}
    fruitless, reached, shown, was_there = 0, 0, 0, True

    def pieces(offset: int) -> Iterator[bytes]:
        nonlocal shown
        tell(offset - shown)
        shown = offset
        with os_errors("cannot read", path), path.open("rb") as file:
            file.seek(offset)
            while piece := file.read(_PIECE):
                yield piece
                shown += len(piece)
                tell(len(piece))

    while True:
        begun = session.send("POST", "/v1/uploads", headers=headers, repeat=True).headers
        offset = as_told(int, begun.get("Upload-Offset", size))
        tell(offset - shown)
        shown = offset
        if "Recording" in begun:
            return Sent(_recording(begun), was_there)
        was_there = False
        fruitless, reached = (fruitless, reached) if offset <= reached else (0, offset)
        try:
            done = session.send(
                "PATCH",
                _path(begun.get("Location", "")),
                content=partial(pieces, offset),
                headers={
                    **_TUS,
                    "Upload-Offset": str(offset),
                    "Recording-Name": quote(os.fsencode(name)),
                    "Content-Type": "application/offset+octet-stream",
                    "Content-Length": str(size - offset),
                },
                timeout=TIMEOUT + size / _CHECKED,
            )
            return Sent(_recording(done.headers), was_there)
        except UnreachableError:
            fruitless += 1
            if fruitless == _FRUITLESS:
                raise
        time.sleep(0.2 * 2**fruitless)


def digest_of(path: Path) -> tuple[str, int]:
    """The SHA-256 of a file, and its size. StorageError if it cannot be read."""
    with os_errors("cannot read", path), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest(), file.tell()


def _recording(headers: Mapping[str, str]) -> str:
    """The server's name of an uploaded recording."""
    return unquote(as_told(str, headers.get("Recording")))


def _path(location: str) -> str:
    """The path of an upload on the same server, without the host name, which a proxy may change."""
    try:
        return urlsplit(location).path or "/"
    except ValueError as err:
        raise StorageError(
            f"expected the address of an upload from the server, found {location!r:.80}"
        ) from err
