"""Names of values inside values, such as `metadata.score` and `state.arm.q[0]`: the keys of filters, and what tables,
messages, plots and pages call a part of a step.

A name begins with a word (`state`, `metadata`). `.key` is an entry of a mapping, `[i]` an entry of a tuple or an
element of an array, and `[i,j]` an element of an array of two dimensions. `.0` stands for `[0]` where a name is read.
A key that holds a dot or what cannot be printed, begins with a quote, ends as an index does, or is empty, is written as
a JSON string: `metadata."v1.0".score`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

from tupli_mcap.errors import FilterError

INDEX = r"\[-?[0-9]+(?:,[ ]?-?[0-9]+)*\]"
_INDEX = re.compile(INDEX)
_QUOTED = re.compile(r'"(?:[^"\\]|\\.)*"', re.DOTALL)


@lru_cache(maxsize=4096)
def split_key(key: str) -> tuple[str, ...]:
    """The segments of a name; those of `state.q[0,1]` are state, q, 0 and 1.

    Raises:
        FilterError: A segment is empty, or a quoted one is not a JSON string; the message names the character.
    """
    segments: list[str] = []
    position = 0
    while True:
        quoted = _QUOTED.match(key, position)
        begin = quoted.end() if quoted else position
        stop = key.find(".", begin)
        stop = len(key) if stop < 0 else stop
        name, indexes = _without_indexes(key[begin:stop])
        if quoted and name:
            raise FilterError(f"filter key {key!r} needs a dot or its end at character {begin}")
        if not quoted and name[:1] in ("", '"'):
            raise FilterError(
                f"filter key {key!r} needs a name at character {position}, such as metadata.score"
            )
        segments += [_unquote(key, quoted.group()) if quoted else name, *indexes]
        if stop == len(key):
            return tuple(segments)
        position = stop + 1


def _without_indexes(text: str) -> tuple[str, list[str]]:
    """`q[0][1,2]` as q, and 0, 1, 2."""
    end, found = len(text), list[str]()
    while (begin := text.rfind("[", 0, end)) >= 0 and _INDEX.fullmatch(text, begin, end):
        found.append(text[begin + 1 : end - 1])
        end = begin
    return text[:end], [index.strip() for several in reversed(found) for index in several.split(",")]


def _unquote(key: str, quoted: str) -> str:
    try:
        return str(json.loads(quoted))
    except ValueError as err:
        raise FilterError(f"filter key {key!r} holds {quoted}, which is not a JSON string") from err


def name_within(name: str, *segments: Any) -> str:
    """The name of a part of the value called `name`: `name_within("state.arm", "q", (0, 1))` is `state.arm.q[0,1]`.

    Of the segments, a text is a key, which is quoted if need be; a tuple is the indexes of an element of an array; and
    anything else is an index.
    """
    return name + "".join(map(_segment, segments))


def leaves_of(
    value: Mapping[str, Any], before: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The values in nested mappings that are no mappings themselves, each with the keys that lead to it."""
    for key, inside in value.items():
        if isinstance(inside, Mapping):
            yield from leaves_of(inside, (*before, key))
        else:
            yield (*before, key), inside


def join_key(segments: Sequence[Any]) -> str:
    """The name of a value by its segments; `split_key` is its inverse, but gives indexes as texts.

    Raises:
        FilterError: No segments.
    """
    if not segments:
        raise FilterError("a filter key needs at least one segment")
    return name_within("", *segments).removeprefix(".")


def _segment(segment: Any) -> str:
    if not isinstance(segment, str):
        return f"[{','.join(map(str, segment)) if isinstance(segment, tuple) else segment}]"
    printable = segment.isprintable()
    begins = printable and segment[:1] not in ("", '"')
    plain = begins and "." not in segment and not _without_indexes(segment)[1]
    return f".{segment if plain else json.dumps(segment, ensure_ascii=not printable)}"
