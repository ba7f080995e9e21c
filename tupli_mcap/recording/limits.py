"""Checks the episode index and the chunk table against the file before anything is allocated from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.compression import MAX_RATIO
from tupli_mcap.mcap.container import COMPRESSIONS
from tupli_mcap.mcap.records import BODY, MAGIC, MAX_CHUNK, MAX_ROWS_A_BYTE
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE

EPISODE_TOPICS = (EPISODE_START, EPISODE_END, FINAL_STATE)

_U32 = 2**32 - 1
_CHUNK_FIXED = 9 + 40  # bytes of a Chunk record without the name of its compression and the compressed data
_NAMED = np.array([_CHUNK_FIXED + len(name.replace("none", "")) for name in COMPRESSIONS], np.uint64)
_RATIOS = np.array([MAX_RATIO[name] for name in COMPRESSIONS], np.uint64)


def check_chunks(table: Array, end: int, name: str) -> None:
    """Raises FormatError unless the chunks in `table` do not overlap, lie before `end`, and can hold their rows."""
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
        table: CHUNK_ROWS that `check_chunks` has checked.
        sizes: by channel, bytes of a row, and whether this is exact or the least.
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
        whole: whether each row of the step channels must belong to an episode.
    """
    _check_places(rows, steps, others, name)
    held = int(rows["length"].sum())
    if whole and held != sum(steps):  # episodes do not overlap, so no sub-environment can have more
        raise FormatError(
            f"{name}: the episode index gives {held} of the {sum(steps)} steps to episodes; recover it into a new file"
        )


def _check_places(rows: Array, steps: Sequence[int], others: Mapping[str, int], name: str) -> None:
    if not len(rows):
        return
    env, first, length, start, end, final, how, numbers = (
        np.ascontiguousarray(rows[name])  # each is used several times
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
        return  # in order, as a single environment is recorded: nothing to sort
    order = np.lexsort((first, env))
    same = env[order][1:] == env[order][:-1]
    if (same & (first[order][1:] < (first + length)[order][:-1])).any():
        raise FormatError(
            f"{name}: the episode index gives a step to two episodes; recover it into a new file"
        )


class StepClaims:
    """Compares the rows of a step channel with the episode index. Thread-safe.

    The last rows of episodes and of chunks are compared. Such a row says how many steps of its episode came before it,
    so this finds every wrong boundary.

    Args:
        index: EPISODE_ROWS; no two episodes share a row.
        env: the sub-environment whose channel it is.
    """

    def __init__(self, index: Array, env: int) -> None:
        self._index, self._env = index, env

    @cached_property
    def _episodes(self) -> tuple[Array, Array, Array]:
        """The first and the last row of each episode, in the order of their rows; and the `episode` and `step` that the
        last one must have, as one number."""
        index = self._index
        mine = index["env"] == self._env
        if not mine.all():
            index = index[mine]
        # field by field: NumPy is slow with rows of many fields
        firsts, lengths = index["first_row"].astype(np.int64), index["length"].astype(np.int64)
        numbers = index["episode"].astype("<u8") + (lengths - 1 << 32).astype("<u8")
        if (firsts[1:] < firsts[:-1]).any():
            order = np.argsort(firsts, kind="stable")
            firsts, lengths, numbers = firsts[order], lengths[order], numbers[order]
        return firsts, firsts + lengths - 1, numbers

    def check(self, first: int, count: int, numbers_at: Callable[[Array], Array], where: str) -> None:
        """Compares the rows of a chunk with the index.

        Args:
            first: the number of its first row.
            count: how many rows it has, at least 1.
            numbers_at: returns `episode` and `step` of some of its rows as one number (`<u8`); row 0 is the first one.
            where: the file and the channel, for errors.

        Raises:
            FormatError: a row belongs to another episode or step.
        """
        firsts, lasts, numbers = self._episodes
        begin, end = int(lasts.searchsorted(first)), int(lasts.searchsorted(first + count))
        goes_on = end < len(firsts) and bool(firsts[end] < first + count)  # an episode, in the next chunk
        rows = lasts[begin : end + goes_on] - first
        expected = numbers[begin : end + goes_on]
        if goes_on:
            later = int(rows[-1]) - (count - 1)
            rows[-1] -= later
            expected = expected.copy()
            expected[-1] -= np.uint64(later << 32)
        found = numbers_at(rows)
        if found.tobytes() != expected.tobytes():
            i = int(np.argmax(found != expected))
            one, other = int(found[i]), int(expected[i])
            raise FormatError(
                f"{where}: expected step {other >> 32} of episode {other & _U32} in row {first + rows[i]} as "
                f"the episode index says, found step {one >> 32} of episode {one & _U32}; recover it into a new file"
            )
