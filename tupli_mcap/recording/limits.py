"""What a file's indexes claim, held against what is there before anything is allocated or read by them."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.compression import MAX_RATIO
from tupli_mcap.mcap.container import COMPRESSIONS, MAGIC
from tupli_mcap.mcap.records import BODY, MAX_CHUNK, MAX_ROWS_A_BYTE
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE

__all__ = [
    "EPISODE_TOPICS",
    "StepClaims",
    "check_chunks",
    "check_episodes",
    "check_rows",
]

EPISODE_TOPICS = (EPISODE_START, EPISODE_END, FINAL_STATE)
_U32 = 2**32 - 1
_CHUNK_FIXED = 9 + 40  # of a Chunk record, before and after the name of its compression
_NAMED = np.array([_CHUNK_FIXED + len(name.replace("none", "")) for name in COMPRESSIONS], np.uint64)
_RATIOS = np.array([MAX_RATIO[name] for name in COMPRESSIONS], np.uint64)


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
    good &= (start < others[EPISODE_START]) & (end < others[EPISODE_END])
    good &= (final >= -1) & (final < others[FINAL_STATE]) & (how <= 2)
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


class StepClaims:
    """What the episode index says of the rows of a step channel: where episodes begin and end, and how.

    The index is held against the first and the last row of each episode, and against the first row of each chunk: that
    finds every boundary that is not where the rows have it. Nothing changes in it; threads and stores may share it.

    Args:
        index: EPISODE_ROWS; no two episodes share a row.
        env: the sub-environment whose channel it is.
    """

    def __init__(self, index: Array, env: int) -> None:
        mine = np.flatnonzero(index["env"] == env)
        mine = mine[np.argsort(index["first_row"][mine], kind="stable")]
        # field by field: NumPy takes far longer for rows of many fields
        episodes, firsts, lengths = (index[name][mine] for name in ("episode", "first_row", "length"))
        self._how = index["end"][mine]
        self._rows = _by_turns(firsts, firsts + lengths - 1).astype(
            np.int64
        )  # the first and the last of each
        # `episode` and `step` of such a row, as one number of 64 bits
        self._numbers = _by_turns(episodes, episodes + (lengths - 1 << np.uint64(32)))

    def check(self, first: int, numbers: Array, flags: Array, where: str) -> None:
        """Holds consecutive rows against the index.

        Args:
            first: the number of the first row.
            numbers: `episode` and `step` of each row, as one number (`<u8`).
            flags: the bytes of `terminal` and `timeout` of each row, as one number (`<u2`).
            where: the file, and what of it is read.

        Raises:
            FormatError: a row is of another episode or step, or the flags of an episode's last row say another end.
        """
        if not len(numbers):
            return
        low, high = self._rows.searchsorted((first, first + len(numbers))).tolist()
        if low % 2:  # the first row belongs to an episode that began before
            steps = first - int(self._rows[low - 1])
            self._compare(first, [int(numbers[0])], [int(self._numbers[low - 1]) + (steps << 32)], where)
        places = self._rows[low:high] - first
        found, expected = numbers[places], self._numbers[low:high]
        if found.tobytes() != expected.tobytes():
            self._compare(self._rows[low:high], found.tolist(), expected.tolist(), where)
        ends = _end_of()[flags[places[1 - low % 2 :: 2]]]
        how = self._how[low // 2 : high // 2]
        if ends.tobytes() != how.tobytes():
            i = int(np.argmax(ends != how))
            at = int(self._rows[low:high][1 - low % 2 :: 2][i])
            raise FormatError(
                f"{where}: expected the end {how[i]} of episode {int(self._numbers[low // 2 * 2 + 2 * i]) & _U32} as "
                f"the episode index says, found other flags in its last row, {at}; recover it into a new file"
            )

    def _compare(self, rows: Any, found: Sequence[int], expected: Sequence[int], where: str) -> None:
        for row, one, other in zip(np.atleast_1d(rows).tolist(), found, expected, strict=True):
            if one != other:
                raise FormatError(
                    f"{where}: expected step {other >> 32} of episode {other & _U32} in row {row} as the episode index "
                    f"says, found step {one >> 32} of episode {one & _U32}; recover it into a new file"
                )


def _by_turns(firsts: Array, lasts: Array) -> Array:
    both = np.empty(2 * len(firsts), np.uint64)
    both[::2], both[1::2] = firsts, lasts
    return both


@functools.cache
def _end_of() -> Array:
    """The end that the bytes of `terminal` and `timeout` say: 0 terminal, 1 timeout, 2 interrupted."""
    flags = np.arange(1 << 16)
    return np.where(flags & 0xFF, 0, np.where(flags, 1, 2)).astype(np.uint8)
