"""The URLs that a pattern matches."""

from __future__ import annotations

import re

from tupli_mcap.errors import RecordingError
from tupli_mcap.remote.failures import unlisted
from tupli_mcap.remote.names import is_web, shown
from tupli_mcap.remote.objects import listed

_MAGIC = re.compile(r"[*?\[]")


def is_pattern(url: str) -> bool:
    """Whether a URL has wildcards."""
    return _MAGIC.search(url.partition("?")[0] if is_web(url) else url) is not None


def matching(url: str) -> list[str]:
    """The sorted URLs that match a pattern such as "s3://bucket/runs/*.mcap"; a URL without wildcards as it is.

    "*" matches within a folder, "**" also across folders.

    Raises:
        RecordingError: nothing matches, or the server cannot list files.
    """
    if not is_pattern(url):
        return [url]
    if is_web(url):
        raise unlisted(url)
    folder = "".join(_MAGIC.split(url, maxsplit=1)[0].rpartition("/")[:2])
    wanted = re.compile(_expression(url))
    found = sorted(name for name in listed(folder) if wanted.fullmatch(name))
    if not found:
        raise RecordingError(f"no file matches {shown(url)!r}; give the URL of a recording (.mcap)")
    return found


_TOKENS = re.compile(r"\*\*/|\*\*|\*|\?|\[!?\]?[^\]]*\]|.", re.DOTALL)
_MEANT = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}


def _expression(pattern: str) -> str:
    """The regular expression of a pattern."""
    return "".join(_MEANT.get(token) or _one(token) for token in _TOKENS.findall(pattern))


def _one(token: str) -> str:
    """The regular expression of a token: a wildcard, a set of characters, or a plain character."""
    if len(token) == 1:
        return re.escape(token)
    negated = token[1] == "!"
    chosen = (
        token[1 + negated : -1]
        .replace("\\", r"\\")
        .replace("^", r"\^")
        .replace("]", r"\]")
        .replace("[", r"\[")
    )
    return f"[{'^' if negated else ''}{chosen}]"
