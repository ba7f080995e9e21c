"""Filter keys: dotted paths into nested mappings, such as `metadata.score`.

A segment that holds a dot, a quote or nothing at all is written as a JSON string: `metadata."v1.0".score`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import lru_cache

from tupli_mcap.errors import FilterError

_QUOTED = re.compile(r'"(?:[^"\\]|\\.)*"', re.DOTALL)
_PLAIN = re.compile(r'[^."][^.]*')


@lru_cache(maxsize=4096)
def split_key(key: str) -> tuple[str, ...]:
    """The segments of a dotted path.

    Raises:
        FilterError: A segment is empty, or a quoted one is not a JSON string; the message names the character.
    """
    segments: list[str] = []
    position = 0
    while True:
        quoted = _QUOTED.match(key, position)
        match = quoted or _PLAIN.match(key, position)
        if match is None:
            raise FilterError(
                f"filter key {key!r} needs a name at character {position}, such as metadata.score"
            )
        segments.append(_unquote(key, match.group()) if quoted else match.group())
        position = match.end()
        if position == len(key):
            return tuple(segments)
        if key[position] != ".":
            raise FilterError(f"filter key {key!r} needs a dot or its end at character {position}")
        position += 1


def _unquote(key: str, quoted: str) -> str:
    try:
        return str(json.loads(quoted))
    except ValueError as err:
        raise FilterError(f"filter key {key!r} holds {quoted}, which is not a JSON string") from err


def join_key(segments: Sequence[str]) -> str:
    """The dotted path of segments, quoting those that need it; `split_key` is its inverse.

    Raises:
        FilterError: No segments.
    """
    if not segments:
        raise FilterError("a filter key needs at least one segment")
    return ".".join(_quote(segment) for segment in segments)


def _quote(segment: str) -> str:
    if segment and "." not in segment and not segment.startswith('"'):
        return segment
    return json.dumps(segment, ensure_ascii=False)
