"""What a file's indexes claim, held against what is there before anything is allocated or read by them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tupli_mcap.errors import FormatError
from tupli_mcap.messages.layout import BODY
from tupli_mcap.recording.container import COMPRESSIONS, MAGIC

__all__ = ["EPISODE_TOPICS", "MAX_CHUNK", "check_chunks", "check_episodes"]

MAX_CHUNK = 1 << 31
EPISODE_TOPICS = ("/episode_start", "/episode_end", "/final_state")
_CHUNK_FIXED = 9 + 40  # of a Chunk record, before and after the name of its compression
Array = np.ndarray[Any, Any]


def check_chunks(table: Array, end: int, name: str) -> None:
    """Raises FormatError unless the chunks of a file's chunk table lie apart, before `end`, and can hold their rows."""
    offset, length, size = table["offset"], table["length"], table["uncompressed"]
    inside = (offset >= len(MAGIC)) & (offset <= end) & (length >= _CHUNK_FIXED) & (length <= end)
    inside &= offset + length <= end  # no overflow: both are at most `end`
    room = size - np.minimum(size, table["skip"])
    sized = (size <= MAX_CHUNK) & (table["skip"] <= size) & (room >= table["rows"].astype(np.uint64) * BODY)
    good = inside & sized & (table["compression"] < len(COMPRESSIONS))
    if not good.all():
        i = int(np.argmin(good))
        raise FormatError(
            f"{name}: the episode index places chunk {i} at offset {offset[i]}, {length[i]} bytes with "
            f"{table['rows'][i]} rows in {size[i]}; expected it before offset {end}, with room for its rows "
            f"in at most {MAX_CHUNK} bytes"
        )
    order = np.argsort(offset, kind="stable")
    if (offset[order][1:] < (offset + length)[order][:-1]).any():
        raise FormatError(f"{name}: the episode index names chunks that overlap; recover it into a new file")


def check_episodes(rows: Array, steps: Sequence[int], others: Mapping[str, int], name: str) -> None:
    """Raises FormatError unless the episodes lie in the rows there are, apart from each other.

    Args:
        rows: EPISODE_ROWS.
        steps: rows of the step channel of each sub-environment.
        others: rows of each of EPISODE_TOPICS.
        name: of the file.
    """
    if not len(rows):
        return
    env, first, length, start, end, final, how, numbers = (
        np.ascontiguousarray(rows[name])  # each is looked at several times
        for name in ("env", "first_row", "length", "start_row", "end_row", "final_row", "end", "episode")
    )
    good = env < len(steps)
    env = np.minimum(env, len(steps))
    limit = np.array([*steps, 0], np.uint64)[env]
    good &= (length >= 1) & (length <= limit) & (first <= limit)
    good &= length <= limit - np.minimum(first, limit)
    good &= (start < others["/episode_start"]) & (end < others["/episode_end"])
    good &= (final >= -1) & (final < others["/final_state"]) & (how <= 2)
    if not good.all():
        row = rows[int(np.argmin(good))]
        raise FormatError(
            f"{name}: the episode index places episode {row['episode']} at rows {row['first_row']} to "
            f"{int(row['first_row']) + int(row['length'])} of sub-environment {row['env']}, with messages that are not "
            "all there; recover it into a new file"
        )
    if (numbers[1:] <= numbers[:-1]).any():
        raise FormatError(
            f"{name}: expected episodes in the order of their numbers, each once, in the episode index"
        )
    if ((env[1:] == env[:-1]) & (first[1:] >= (first + length)[:-1])).all():
        return  # one after the other, as a single environment is recorded: nothing to sort
    order = np.lexsort((first, env))
    same = env[order][1:] == env[order][:-1]
    if (same & (first[order][1:] < (first + length)[order][:-1])).any():
        raise FormatError(
            f"{name}: the episode index gives a step to two episodes; recover it into a new file"
        )
