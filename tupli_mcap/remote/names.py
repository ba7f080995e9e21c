"""URLs, and how they may be shown."""

from __future__ import annotations

import re

__all__ = ["is_url", "is_web", "shown"]

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
_SECRET = re.compile(r"(://)[^/@\s]*@|[?#][^\s\"'<>)\]]*")


def is_url(name: str) -> bool:
    """True for `scheme://…`."""
    return _SCHEME.match(name) is not None


def is_web(url: str) -> bool:
    """True for the address of a web server."""
    return url.lower().startswith(("http://", "https://"))


def shown(text: str) -> str:
    """A URL, or a text with URLs in it, without names, passwords and signatures."""
    return _SECRET.sub(lambda found: found[1] or "", text)
