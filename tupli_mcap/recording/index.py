"""The episode index: the last attachment of a recording, with one fixed-size row for each episode and each chunk.

The metadata texts lie beside the rows and are parsed on access. The index is a claim: it is checked against the file
before anything is allocated from it.
"""

from __future__ import annotations

import operator
import struct
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import zstandard

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.mcap.chunks import MAX_RATIO, decompress
from tupli_mcap.mcap.container import CHUNK_ROWS, IN_CHUNKS
from tupli_mcap.mcap.records import BODY, CHUNK_HEAD, MAGIC, MAX_CHUNK, MAX_ROWS_A_BYTE
from tupli_mcap.messages.episodes import INTERRUPTED
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE

INDEX_NAME = "episodes.index"
INDEX_MEDIA_TYPE = "application/x-tupli-mcap-index"
EPISODE_TOPICS = (EPISODE_START, EPISODE_END, FINAL_STATE)
_HEAD = struct.Struct("<8sQQQ")
_MAGIC = b"TMIDX\0\0\1"
_SIZE = struct.Struct("<Q")
_MAX_METADATA = 1 << 26
# Rows differ in the numbers of episodes and the checksums of chunks, and compress far less than this.
_MAX_ROW_RATIO = 256
_CHUNK_FIXED = CHUNK_HEAD.size + 8  # bytes of a Chunk record without the name of its compression and its data
_NAMED = np.array([_CHUNK_FIXED + len(name) for name in IN_CHUNKS], np.uint64)
_RATIOS = np.array([MAX_RATIO[name] for name in IN_CHUNKS], np.uint64)

NO_SEED, HAS_SEED, LARGE_SEED = range(3)  # `has_seed`: a large seed is in `/episode_start`, and 0 here

EPISODE_ROWS = np.dtype(
    [
        ("first_row", "<u8"), ("length", "<u8"), ("return", "<f8"), ("start_time", "<i8"), ("end_time", "<i8"),
        ("seed", "<i8"), ("start_row", "<u8"), ("end_row", "<u8"), ("final_row", "<i8"),
        ("metadata_offset", "<u8"), ("metadata_length", "<u4"), ("episode", "<u4"), ("env", "<u4"),
        ("end", "u1"), ("has_seed", "u1"), ("pad", "u1", (2,)),
    ]
)  # fmt: skip


class EpisodeRow(NamedTuple):
    """One row; `start_row`, `end_row` and `final_row` (-1: none) are rows of the three episode channels."""

    first_row: int
    length: int
    episode_return: float
    start_time: int
    end_time: int
    seed: int | None
    start_row: int
    end_row: int
    final_row: int
    episode: int
    env: int
    end: int


_ROW = struct.Struct("<QQdqqqQQqQIIIBB2x")


def indexed_seed(seed: int | None) -> tuple[int, int]:
    """The fields `seed` and `has_seed` of an episode."""
    if seed is None:
        return 0, NO_SEED
    return (seed, HAS_SEED) if -(2**63) <= seed < 2**63 else (0, LARGE_SEED)


class IndexBuilder:
    """Collects rows while recording, after those of `index`: 96 bytes for each episode, plus its metadata text."""

    def __init__(self, index: EpisodeIndex | None = None) -> None:
        self.rows = bytearray() if index is None else bytearray(index.episodes.tobytes())
        self.metadata = bytearray() if index is None else bytearray(index.metadata)
        self.count = 0 if index is None else len(index.episodes)

    def add(self, row: tuple[Any, ...], metadata: str) -> None:
        """Adds an episode and its metadata as JSON; `row` is an `EpisodeRow`, or a plain tuple of its fields."""
        (
            first_row, length, total, start_time, end_time, seed, start_row, end_row, final_row, number, env, end,
        ) = row  # fmt: skip
        text = b"" if metadata == "{}" else metadata.encode()
        indexed, has_seed = indexed_seed(seed)
        try:
            self.rows += _ROW.pack(
                first_row, length, total, start_time, end_time, indexed, start_row, end_row,
                final_row, len(self.metadata), len(text), number, env, end, has_seed,
            )  # fmt: skip
        except struct.error as err:  # values from a damaged journal
            raise FormatError(
                f"episode {number}: expected times before 2^63 ns, and numbers that fit the index, found a start at "
                f"{start_time} and an end at {end_time} ns: a clock was set wrong, or the journal is damaged ({err})"
            ) from err
        self.metadata += text
        self.count += 1

    def extend(self, episodes: Array) -> None:
        """Adds episodes (EPISODE_ROWS) without metadata."""
        self.rows += episodes.tobytes()
        self.count += len(episodes)

    def encode(self, chunk_rows: bytes | bytearray) -> bytes:
        """The attachment's bytes, with episodes in the order of their numbers."""
        rows = np.frombuffer(bytes(self.rows), EPISODE_ROWS)
        rows = rows[np.argsort(rows["episode"], kind="stable")]
        head = _HEAD.pack(_MAGIC, self.count, len(chunk_rows) // CHUNK_ROWS.itemsize, len(self.metadata))
        return (
            head + _compress(rows.tobytes()) + _compress(bytes(chunk_rows)) + _compress(bytes(self.metadata))
        )


def _compress(data: bytes) -> bytes:
    packed = zstandard.ZstdCompressor(level=-1).compress(data)
    return _SIZE.pack(len(packed)) + packed


def _decompress(
    data: bytes, at: int, size: int, where: str, ratio: int = _MAX_ROW_RATIO
) -> tuple[bytes, int]:
    """A part of `size` bytes, at most `ratio` times its compressed bytes, and the offset of the next part."""
    if at + _SIZE.size > len(data):
        raise FormatError(
            f"{where}: expected a part of the episode index at byte {at}, found {len(data)} bytes"
        )
    (packed,) = _SIZE.unpack_from(data, at)
    start = at + _SIZE.size
    end = start + packed
    if end > len(data) or size > ratio * packed:
        raise FormatError(f"{where}: the episode index claims {packed} bytes that hold {size} at byte {at}")
    part = decompress("zstd", memoryview(data)[start:end], size, f"{where}: episode index")
    return bytes(part), end


class EpisodeIndex(NamedTuple):
    """A decoded index: structured arrays `episodes` (EPISODE_ROWS), `chunks` (CHUNK_ROWS), and the metadata texts."""

    episodes: Array
    chunks: Array
    metadata: bytes

    @classmethod
    def decode(cls, data: bytes, where: str) -> EpisodeIndex:
        """Raises FormatError if counts and sizes do not add up to the attachment."""
        if len(data) < _HEAD.size:
            raise FormatError(
                f"{where}: expected an episode index of at least {_HEAD.size} bytes, found {len(data)}"
            )
        magic, episodes, chunks, metadata = _HEAD.unpack_from(data)
        if magic != _MAGIC:
            raise FormatError(f"{where}: expected an episode index of version 1, found {magic!r}")
        rows, at = _decompress(data, _HEAD.size, episodes * EPISODE_ROWS.itemsize, where)
        table, at = _decompress(data, at, chunks * CHUNK_ROWS.itemsize, where)
        found = np.frombuffer(rows, EPISODE_ROWS)
        if (found["end"] > 2).any():
            raise FormatError(f"{where}: the episode index names ends that do not exist")
        told = int(found["metadata_length"].sum(dtype=np.uint64))
        if told != metadata:
            raise FormatError(
                f"{where}: the episode index claims {metadata} bytes of metadata, {told} of which are of episodes"
            )
        texts, at = _decompress(data, at, metadata, where, MAX_RATIO["zstd"])
        if at != len(data):
            raise FormatError(f"{where}: expected an episode index of {at} bytes, found {len(data)}")
        return cls(found, np.frombuffer(table, CHUNK_ROWS), texts)

    def metadata_text(self, i: int) -> str:
        """The JSON text of an episode's metadata."""
        row = self.episodes[i]
        start, length = int(row["metadata_offset"]), int(row["metadata_length"])
        if length == 0:
            return "{}"
        place = f"metadata of episode {row['episode']}"
        if length > _MAX_METADATA or start + length > len(self.metadata):
            raise FormatError(f"{place}: expected them in the index, found {length} bytes at {start}")
        try:
            return self.metadata[start : start + length].decode()
        except UnicodeDecodeError as err:
            raise FormatError(f"{place}: expected UTF-8, found {err.reason}") from err


# ---- checks, before anything is allocated from the index


def check_chunks(table: Array, end: int, name: str) -> None:
    """Raises FormatError unless the chunks in `table` do not overlap, lie before `end`, and can hold their rows."""
    offset, length, size = table["offset"], table["length"], table["uncompressed"]
    inside = (offset >= len(MAGIC)) & (offset <= end) & (length >= _CHUNK_FIXED) & (length <= end)
    inside &= offset + length <= end  # no overflow: both are at most `end`
    room = size - np.minimum(size, table["skip"])
    sized = (size <= MAX_CHUNK) & (table["skip"] <= size) & (room >= table["rows"].astype(np.uint64) * BODY)
    method = np.minimum(table["compression"], len(IN_CHUNKS) - 1)
    packed = length - np.minimum(length, _NAMED[method])
    plain, ratio = method == 0, _RATIOS[method]
    sized &= (size <= np.minimum(packed, MAX_CHUNK) * ratio) & (~plain | (size == packed))
    sized &= table["rows"] <= np.minimum(packed, MAX_CHUNK) * np.uint64(MAX_ROWS_A_BYTE)
    good = inside & sized & (table["compression"] < len(IN_CHUNKS))
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

    `table` is one that `check_chunks` has checked; `sizes` has, by channel, the bytes of a row, and whether this is
    exact or the least.
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
    """Raises FormatError unless the episodes (EPISODE_ROWS) lie in the rows there are, apart from each other.

    `steps` are the rows of the step channel of each sub-environment, `others` those of each of EPISODE_TOPICS. If
    `whole`, each row of the step channels must belong to an episode.
    """
    env, first, length, start, end, final, numbers = (
        np.ascontiguousarray(rows[name])  # each is used several times
        for name in ("env", "first_row", "length", "start_row", "end_row", "final_row", "episode")
    )
    good = env < len(steps)
    env = np.minimum(env, len(steps))
    limit = np.array([*steps, 0], np.uint64)[env]
    good &= (length >= 1) & (length <= limit) & (first <= limit)
    good &= length <= limit - np.minimum(first, limit)
    good &= (start < others[EPISODE_START]) & (end < others[EPISODE_END])
    good &= (final >= -1) & (final < others[FINAL_STATE])
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
    of_one_in_order = (env[1:] == env[:-1]) & (first[1:] >= (first + length)[:-1])
    if not of_one_in_order.all():
        order = np.lexsort((first, env))
        same = env[order][1:] == env[order][:-1]
        if (same & (first[order][1:] < (first + length)[order][:-1])).any():
            raise FormatError(
                f"{name}: the episode index gives a step to two episodes; recover it into a new file"
            )
    held = int(rows["length"].sum())
    if whole and held != sum(steps):  # episodes do not overlap, so no sub-environment can have more
        raise FormatError(
            f"{name}: the episode index gives {held} of the {sum(steps)} steps to episodes; recover it into a new file"
        )


class StepClaims:
    """Compares the rows of the step channel of sub-environment `env` with the episode index. Thread-safe.

    The last rows of episodes and of chunks are compared. Such a row says how many steps of its episode came before it,
    so this finds every wrong boundary. No two episodes may share a row.
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
        firsts, lengths = index["first_row"].astype(np.int64), index["length"].astype(np.int64)
        numbers = index["episode"].astype("<u8") + (lengths - 1 << 32).astype("<u8")
        if (firsts[1:] < firsts[:-1]).any():
            order = np.argsort(firsts, kind="stable")
            firsts, lengths, numbers = firsts[order], lengths[order], numbers[order]
        return firsts, firsts + lengths - 1, numbers

    def check(self, first: int, count: int, numbers_at: Callable[[Array], Array], where: str) -> None:
        """Raises FormatError unless the rows of a chunk, at least one, are of the episodes and steps that the index
        says.

        `first` is the number of its first row. `numbers_at` returns `episode` and `step` of some of its rows as one
        number (`<u8`); row 0 is the first one.
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
            step, episode = divmod(int(expected[i]), 1 << 32)
            found_step, found_episode = divmod(int(found[i]), 1 << 32)
            raise FormatError(
                f"{where}: expected step {step} of episode {episode} in row {first + rows[i]} as the episode index "
                f"says, found step {found_step} of episode {found_episode}; recover it into a new file"
            )


def cut_off(rows: Array, runs: Sequence[int] | Array) -> Array:
    """A mask (bool) of the interrupted episodes that are the last of their sub-environment in their run: its end cut
    them off. `runs` has the run of each of the index rows."""
    is_last = np.zeros(len(rows), np.bool_)
    streams = np.stack([np.asarray(runs, np.int64), rows["env"].astype(np.int64)], axis=1)
    _, from_end = np.unique(streams[::-1], axis=0, return_index=True)
    is_last[len(is_last) - 1 - from_end] = True
    mask: Array = is_last & (rows["end"] == INTERRUPTED)
    return mask


def whole_numbers(given: Any, expected: str = "numbers of episodes, such as [3, 7]") -> list[int]:
    """Numbers that somebody chose, of episodes by default. RecordingError if they are no integers; a mask is none."""
    try:
        numbers = list(given)
        if isinstance(given, str) or any(isinstance(number, bool | np.bool_) for number in numbers):
            raise TypeError
        return [operator.index(number) for number in numbers]
    except TypeError as err:
        raise RecordingError(f"expected {expected}, found {given!r:.80}") from err


def chosen_numbers(rows: Array, given: Any, name: str) -> list[int]:
    """The numbers of episodes that somebody chose among `rows` of an index, each once; all of them for None.
    RecordingError if they are no integers, or one is not there."""
    known = rows["episode"].tolist()
    chosen = known if given is None else list(dict.fromkeys(whole_numbers(given)))
    if missing := sorted(set(chosen).difference(known)):
        there = f"choose from {known[0]} to {known[-1]}" if known else "it has none"
        raise RecordingError(f"{name} has no episode {missing[0]}; {there}")
    return chosen
