"""The URLs that a pattern matches."""

from __future__ import annotations

import re
from collections.abc import Sequence
from fnmatch import fnmatchcase

from tupli_mcap.errors import RecordingError
from tupli_mcap.remote.failures import unlisted
from tupli_mcap.remote.names import is_web, parts_of, shown
from tupli_mcap.remote.objects import listed

_MAGIC = re.compile(r"[*?\[]")


def is_pattern(url: str) -> bool:
    """Whether a URL has wildcards; a web address, in its path: `[::1]` is a host, and a password may have a star.
    RecordingError if it is no address."""
    return _MAGIC.search(parts_of(url).path if is_web(url) else url) is not None


def matching(url: str) -> list[str]:
    """The sorted URLs that match a pattern such as "s3://bucket/runs/*.mcap"; a URL without wildcards as it is.

    "*" matches within a folder, "**" any number of folders.

    Raises:
        RecordingError: nothing matches, or the server cannot list files.
    """
    if not is_pattern(url):
        return [url]
    if is_web(url):
        raise unlisted(url)
    folder = "".join(_MAGIC.split(url, maxsplit=1)[0].rpartition("/")[:2])
    wanted = url.split("/")
    found = sorted(name for name in listed(folder) if _is_match(name.split("/"), wanted))
    if not found:
        raise RecordingError(f"no file matches {shown(url)!r}; give the URL of a recording (.mcap)")
    return found


def _is_match(name: Sequence[str], pattern: Sequence[str]) -> bool:
    """Whether the parts of a URL are those of a pattern, in which `**` stands for any number of them."""
    if not pattern:
        return not name
    first, *others = pattern
    if first == "**":
        return any(_is_match(name[i:], others) for i in range(len(name) + 1))
    return bool(name) and fnmatchcase(name[0], first) and _is_match(name[1:], others)
