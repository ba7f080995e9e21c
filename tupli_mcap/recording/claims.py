"""What a file's indexes claim, held against what is there before anything is allocated or read by them."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tupli_mcap.errors import FormatError
from tupli_mcap.messages.layout import BODY
from tupli_mcap.recording.compression import MAX_RATIO
from tupli_mcap.recording.container import COMPRESSIONS, MAGIC

__all__ = [
    "EPISODE_TOPICS",
    "MAX_CHUNK",
    "MAX_ROWS_A_BYTE",
    "StepClaims",
    "check_bools",
    "check_chunks",
    "check_episodes",
    "check_rows",
]

MAX_CHUNK = 1 << 31
EPISODE_TOPICS = ("/episode_start", "/episode_end", "/final_state")
_U32, _U64 = 2**32 - 1, 2**64 - 1
_MANY_ROWS = 1 << 16
_CHUNK_FIXED = 9 + 40  # of a Chunk record, before and after the name of its compression
MAX_ROWS_A_BYTE = 16
"""Messages that a byte of a compressed chunk may stand for at most: each has a number of its own (`sequence`), so that
no compressor gets far below a byte a message."""
_NAMED = np.array([_CHUNK_FIXED + len(name.replace("none", "")) for name in COMPRESSIONS], np.uint64)
_RATIOS = np.array([MAX_RATIO[name] for name in COMPRESSIONS], np.uint64)
Array = np.ndarray[Any, Any]


def check_chunks(table: Array, end: int, name: str) -> None:
    """Raises FormatError unless the chunks of a file's chunk table lie apart, before `end`, and can hold their rows."""
    offset, length, size = table["offset"], table["length"], table["uncompressed"]
    inside = (offset >= len(MAGIC)) & (offset <= end) & (length >= _CHUNK_FIXED) & (length <= end)
    inside &= offset + length <= end  # no overflow: both are at most `end`
    room = size - np.minimum(size, table["skip"])
    sized = (size <= MAX_CHUNK) & (table["skip"] <= size) & (room >= table["rows"].astype(np.uint64) * BODY)
    packed = length - np.minimum(length, _NAMED[np.minimum(table["compression"], len(COMPRESSIONS) - 1)])
    ratio = _RATIOS[np.minimum(table["compression"], len(COMPRESSIONS) - 1)]
    plain = table["compression"] == 0
    sized &= (size <= np.minimum(packed, MAX_CHUNK) * ratio) & (~plain | (size == packed))
    sized &= table["rows"] <= np.minimum(packed, MAX_CHUNK) * np.uint64(MAX_ROWS_A_BYTE)
    good = inside & sized & (table["compression"] < len(COMPRESSIONS))
    if not good.all():
        i = int(np.argmin(good))
        raise FormatError(
            f"{name}: the episode index places chunk {i} at offset {offset[i]}, {length[i]} bytes with "
            f"{table['rows'][i]} rows in {size[i]}; expected it before offset {end}, with room for its rows "
            f"in at most {MAX_CHUNK} bytes, which its compressed bytes can hold"
        )
    order = np.argsort(offset, kind="stable")
    if (offset[order][1:] < (offset + length)[order][:-1]).any():
        raise FormatError(f"{name}: the episode index names chunks that overlap; recover it into a new file")


def check_rows(table: Array, sizes: Mapping[int, tuple[int, bool]], name: str) -> None:
    """Raises FormatError unless the chunks of a file have the bytes that their rows take.

    Args:
        table: CHUNK_ROWS that `check_chunks` has looked at.
        sizes: by channel, the bytes of a row, and whether all have so many; otherwise none has fewer.
        name: of the file.
    """
    room = table["uncompressed"] - table["skip"]
    for channel, (size, exact) in sizes.items():
        needed = table["rows"].astype(np.uint64) * np.uint64(size)
        wrong = (table["channel"] == channel) & ((needed != room) if exact else (needed > room))
        if wrong.any():
            i = int(np.argmax(wrong))
            raise FormatError(
                f"{name}: the episode index says that chunk {i} holds {table['rows'][i]} rows in {room[i]} bytes; "
                f"expected {'' if exact else 'at least '}{size} bytes a row"
            )


def check_episodes(
    rows: Array, steps: Sequence[int], others: Mapping[str, int], name: str, *, whole: bool
) -> None:
    """Raises FormatError unless the episodes lie in the rows there are, apart from each other.

    Args:
        rows: EPISODE_ROWS.
        steps: rows of the step channel of each sub-environment.
        others: rows of each of EPISODE_TOPICS.
        name: of the file.
        whole: whether each row of the step channels has to be of an episode.
    """
    _check_places(rows, steps, others, name)
    lengths = np.bincount(rows["env"], rows["length"], minlength=len(steps))
    if whole and (lengths != steps).any():
        env = int(np.argmax(lengths != steps))
        raise FormatError(
            f"{name}: the episode index gives {int(lengths[env])} of the {steps[env]} steps of sub-environment {env} "
            "to episodes; recover it into a new file"
        )


def _check_places(rows: Array, steps: Sequence[int], others: Mapping[str, int], name: str) -> None:
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


def check_bools(column: Any, what: str, name: str) -> None:
    """Raises FormatError if a column is of bools and the file holds one that is neither 0 nor 1."""
    if not isinstance(column, np.ndarray) or column.dtype != np.bool_:
        return
    if np.bitwise_or.reduce(column.view(np.uint8), axis=None) > 1:
        raise FormatError(f"{name}: expected bools of 0 or 1 in {what!r}, found another byte")


class StepClaims:
    """What the episode index says of the rows of a step channel: which episode and step each is, and how episodes end.

    Nothing changes in it; it may be shared by threads and stores.

    Args:
        episodes: EPISODE_ROWS of one sub-environment, which share no row.
    """

    def __init__(self, episodes: Array) -> None:
        rows = episodes[np.argsort(episodes["first_row"].astype(np.int64), kind="stable")]
        self._firsts = rows["first_row"].astype(np.int64)
        self._stops = self._firsts + rows["length"].astype(np.int64)
        self._how = np.ascontiguousarray(rows["end"])
        # The two numbers of row r, as one of 64 bits, are this of its episode and r << 32.
        self._bases = (rows["episode"] - (rows["first_row"] << np.uint64(32))).astype("<u8")

    def check(self, first: int, numbers: bytes, flags: Array, where: str) -> None:
        """Holds consecutive rows against the index.

        Args:
            first: the number of the first row.
            numbers: the bytes of `episode` and `step` of each row.
            flags: the bytes of `terminal` and `timeout` of each row, as one number (`<u2`).
            where: the file, and what of it is read.

        Raises:
            FormatError: a row is of another episode or step, or the flags of an episode's last row say another end.
        """
        n = len(flags)
        stop = first + n
        low = int(self._stops.searchsorted(first, side="right"))
        high = int(self._firsts.searchsorted(stop, side="left"))
        stops = self._stops[low:high]
        lengths = stops - self._firsts[low:high]
        if low < high:  # the first and the last episode may go on beyond these rows
            lengths[0] = stops[0] - max(first, int(self._firsts[low]))
            lengths[-1] -= max(0, int(stops[-1]) - stop)
        expected = np.repeat(self._bases[low:high] + np.uint64(first << 32 & _U64), lengths)
        rows: Array | None = None
        if len(expected) != n:  # a recovered file may have rows of no episode, which are never given out
            begins = np.maximum(self._firsts[low:high], first) - first
            rows = np.repeat(begins - np.cumsum(lengths) + lengths, lengths) + np.arange(len(expected))
            numbers = np.frombuffer(numbers, "<u8")[rows].tobytes()
        expected += _steps_up()[:n] if rows is None and n <= _MANY_ROWS else _steps_at(n, rows)
        if numbers != expected.tobytes():
            found = np.frombuffer(numbers, "<u8")
            i = int(np.argmax(found != expected))
            told, is_of = (
                f"step {int(one[i]) >> 32} of episode {int(one[i]) & _U32}" for one in (expected, found)
            )
            raise FormatError(
                f"{where}: expected {told} in row {first + (i if rows is None else int(rows[i]))} as the episode index "
                f"says, found {is_of}; recover it into a new file"
            )
        if low < high and int(stops[-1]) > stop:
            stops = stops[:-1]
        ends = _end_of()[flags[stops - (first + 1)]]
        told_ends = self._how[low : low + len(ends)]
        if ends.tobytes() != told_ends.tobytes():
            i = low + int(np.argmax(ends != told_ends))
            raise FormatError(
                f"{where}: expected the end {self._how[i]} of episode {int(self._bases[i]) & _U32} as the episode "
                f"index says, found other flags in its last row, {int(self._stops[i]) - 1}; recover it into a new file"
            )


@functools.cache
def _steps_up() -> Array:
    """What the numbers of rows grow by within an episode."""
    return np.arange(_MANY_ROWS, dtype=np.uint64) << np.uint64(32)


def _steps_at(n: int, rows: Array | None) -> Array:
    """The same for more rows, or for some of them."""
    found: Array = (np.arange(n) if rows is None else rows).astype(np.uint64) << np.uint64(32)
    return found


@functools.cache
def _end_of() -> Array:
    """The end that the bytes of `terminal` and `timeout` say: 0 terminal, 1 timeout, 2 interrupted."""
    flags = np.arange(1 << 16)
    return np.where(flags & 0xFF, 0, np.where(flags, 1, 2)).astype(np.uint8)
