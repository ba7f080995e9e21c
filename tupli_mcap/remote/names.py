"""Tells paths and URLs apart, and removes secrets from them before they are shown."""

from __future__ import annotations

import base64
import os
import re
from pathlib import Path
from urllib.parse import SplitResult, unquote_to_bytes, urlsplit

from tupli_mcap.errors import RecordingError

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
# A password may have any "@", and where the port is no number, spaces, or what ends a host, too.
_USER = r"(://)(?:[^/?#\s]*@|[^/?#\s:\[]*:(?!\d*[/?#\s])(?:[^/?#\n]*@|\S*?@))"
_SECRET = re.compile(_USER + r"|[?#][^\s\"'<>)\]]*")


def is_url(name: str) -> bool:
    """Whether a name is a URL: `scheme://…`."""
    return _SCHEME.match(name) is not None


def is_web(url: str) -> bool:
    """Whether a URL is the address of a web server."""
    return url.lower().startswith(("http://", "https://"))


def is_server(name: str) -> bool:
    """True for the address of a server (`tupli-mcap serve`): of a web server, and not of a file on it.
    RecordingError if it is no address."""
    return is_web(name) and not parts_of(name).path.strip("/")


def parts_of(url: str) -> SplitResult:
    """The parts of a URL. RecordingError if it is none, such as one with a bracket without its other half."""
    try:
        return urlsplit(url)
    except ValueError as err:
        raise RecordingError(f"expected an address, found {shown(url)!r:.80}: {err}") from err


def signed_in(url: str) -> tuple[str, str]:
    """A web address without its user and password, and the `Authorization` header that stands for them ("" without).

    In them, characters that end a part of an address are percent-encoded, and any other may be.
    """
    parts = parts_of(url)
    user, at, host = parts.netloc.rpartition("@")
    if not at:
        return url, ""
    name, _, password = user.encode(errors="surrogateescape").partition(b":")
    plain = unquote_to_bytes(name) + b":" + unquote_to_bytes(password)
    return parts._replace(netloc=host).geturl(), f"Basic {base64.b64encode(plain).decode()}"


def check_local(path: str | os.PathLike[str]) -> None:
    """Raises RecordingError for the URL of a file that is to be written; `Path` would make it directories here."""
    if is_url(name := os.fspath(path)):
        raise RecordingError(
            f"{shown(name)}: expected a local path to write to, found a URL; write to a path, and copy the file"
        )


def path_of(place: str | os.PathLike[str]) -> Path:
    """A path as a user gives it. Raises RecordingError for an empty text, which `Path` takes for this directory,
    and for one with a NUL."""
    if not os.fspath(place):
        raise RecordingError("expected a path, found an empty text; name a directory as '.'")
    if "\0" in os.fspath(place):
        raise RecordingError(f"expected a path, found {os.fspath(place)!r:.80}, which holds a NUL")
    return Path(place)


def in_home(path: Path) -> Path:
    """A path whose `~` is the user's directory. A name that only begins as such a directory stays: `~x.mcap`."""
    try:
        return path.expanduser()
    except RuntimeError:  # there is no such user
        return path


def shown(text: str) -> str:
    """Removes user names, passwords and signatures from the URLs in a text."""
    return _SECRET.sub(lambda found: found[1] or "", text)


def shown_argument(argument: str) -> str:
    """An argument of a command line, whose URLs are without secrets; what comes before the first one is as it is."""
    url = _SCHEME.search(argument)
    start = url.start() if url else len(argument)
    return argument[:start] + shown(argument[start:])


def shown_name(name: str) -> str:
    """The name of a file as users see it: a URL without secrets, or a path as it is, which may have any characters."""
    return shown(name) if is_url(name) else name
