"""Decompressed chunks, by channel and row, with a cache.

Everything a file says about a chunk is a claim: sizes are capped before anything is allocated, CRCs are checked, and
the rows' headers must agree with the chunk table.
"""

from __future__ import annotations

import itertools
import os
import struct
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from mmap import mmap
from typing import Any, NamedTuple, Protocol

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.chunks import decompress, headers_at, message_places
from tupli_mcap.mcap.container import IN_CHUNKS
from tupli_mcap.mcap.records import BODY, CHUNK_HEAD, crc32
from tupli_mcap.mcap.source import Source
from tupli_mcap.messages.images.codecs import ImageCodec
from tupli_mcap.messages.layout import PREFIX, SEQUENCE_OFFSET
from tupli_mcap.recording.index import StepClaims
from tupli_mcap.remote import RemoteSource

_BLOCK = 1 << 16  # messages whose places are numbers of Python at a time
IN_MEMORY = 1 << 63  # chunk offsets from here on are indexes of rows in memory
_U4, _U8 = np.dtype("<u4"), np.dtype("<u8")
_LEAST_STEP = PREFIX + 2  # bytes of a step's record: after its episode and step, terminal and timeout
_ROW_HEAD = struct.Struct("<BQH")  # opcode, length, channel: the same in every row of a channel
# bytes 0 to 7 and 7 to 10 of it, in two items of sizes that NumPy copies at once
_HEAD, _REST = np.dtype("V8"), np.dtype("V4")


class Span(NamedTuple):
    """Rows `begin:end` of chunk `chunk`."""

    chunk: int
    begin: int
    end: int


class KeptChunk:
    """A decompressed chunk without its definitions, and views of it that have been checked; None before that."""

    __slots__ = ("data", "records", "rows")

    def __init__(self, data: Any) -> None:
        self.data = data
        self.rows: Array | None = None  # their headers checked
        self.records: Array | None = None  # where each begins and ends


class ChunkCache:
    """The decompressed chunks of one or several stores that were used last, in `budget` bytes; one chunk is kept even
    if it is larger. Thread-safe, also after a fork."""

    def __init__(self, budget: int) -> None:
        self.budget = budget
        self._kept: OrderedDict[tuple[int, int], KeptChunk] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()
        self._process = os.getpid()

    def _own_lock(self) -> threading.Lock:
        if self._process != os.getpid():  # forked: a thread of the parent may hold the lock
            self._lock, self._process = threading.Lock(), os.getpid()
        return self._lock

    def get(self, key: tuple[int, int]) -> KeptChunk | None:
        if not self._kept:  # so that threads that read a whole recording do not wait for each other
            return None
        with self._own_lock():
            if key in self._kept:
                self._kept.move_to_end(key)
            return self._kept.get(key)

    def put(self, key: tuple[int, int], kept: KeptChunk) -> None:
        with self._own_lock():
            before = self._kept.pop(key, None)
            self._kept[key] = kept
            self._bytes += len(kept.data) - (0 if before is None else len(before.data))
            while self._bytes > self.budget and len(self._kept) > 1:
                self._bytes -= len(self._kept.popitem(last=False)[1].data)

    def clear(self) -> None:
        """Forgets all chunks."""
        with self._own_lock():
            self._kept.clear()
            self._bytes = 0

    def __getstate__(self) -> dict[str, Any]:
        return {"budget": self.budget}

    def __setstate__(self, state: dict[str, Any]) -> None:
        ChunkCache.__init__(self, state["budget"])


class Memory(Protocol):
    """Rows that are in no chunk of the file, by their number."""

    def __getitem__(self, i: int, /) -> Any: ...


_numbers = itertools.count()


def _are_rows(data: Any, rows: int, size: int, channel: int) -> bool:
    """Whether each of the rows, `size` bytes long, begins as a row of the channel does."""
    if not rows:
        return True
    head = _ROW_HEAD.pack(5, size - 9, channel)
    starts, rests = (
        np.ndarray(rows, kind, data, at, (size,)).tobytes() for kind, at in ((_HEAD, 0), (_REST, 7))
    )
    return starts == head[:8] * rows and rests == head[7:] * rows


def _check_sequence(sequences: Array, first: int, where: str) -> None:
    """Raises FormatError unless the rows are numbered from `first` on."""
    wrong = sequences != np.arange(first, first + len(sequences))
    if wrong.any():
        i = int(np.argmax(wrong))
        raise FormatError(
            f"{where}: expected row {first + i}, found row {sequences[i]}; recover it into a new file"
        )


class ChunkStore:
    """The chunks of a recording (CHUNK_ROWS), and rows in memory that are in no chunk. Thread-safe.

    `cache` is the budget (bytes) of a cache of its own, or a cache that is shared with other stores. An unpickled copy
    (if the source can be copied) has an empty one.
    """

    def __init__(self, source: Source, table: Array, memory: Memory, cache: int | ChunkCache) -> None:
        self._source = source
        self.table = table
        self._memory = memory
        self._cache = ChunkCache(cache) if isinstance(cache, int) else cache
        self._checked = np.zeros(len(table), np.bool_)
        self._compared = np.zeros(len(table), np.bool_)  # with `claims`
        self._number = next(_numbers)  # tells stores apart that share a cache
        self.codecs: Mapping[int, ImageCodec] = {}  # by channel; rows of other channels are not encoded
        # By step channel, the rows that the episode index names. Unless it is None, the rows of all channels are
        # compared with it and with the chunk table before they are returned.
        self.claims: Mapping[int, StepClaims] | None = None
        self.tell: Callable[[int], None] | None = None  # is told the bytes of each chunk that is read
        self._by_channel: dict[int, tuple[Array, Array]] = {}
        self._counts: dict[int, int] = {}
        for channel in set(table["channel"].tolist()):
            chosen = np.flatnonzero(table["channel"] == channel)
            chosen = chosen[np.argsort(table["first"][chosen], kind="stable")]
            ends = np.cumsum(table["rows"][chosen], dtype=np.uint64)
            if (table["first"][chosen] != ends - table["rows"][chosen]).any():
                raise FormatError(
                    f"{self.name}: the chunks of channel {channel} do not hold its rows without gaps"
                )
            self._by_channel[channel] = (chosen, table["first"][chosen].astype(np.int64))
            self._counts[channel] = int(table["rows"][chosen].sum())

    @property
    def name(self) -> str:
        """The name of the file."""
        return self._source.name

    def count(self, channel: int) -> int:
        """Rows of a channel."""
        return self._counts.get(channel, 0)

    def chunks(self, channel: int) -> list[int]:
        """The chunks of a channel in the order of their rows."""
        return [int(i) for i in self._by_channel[channel][0]] if channel in self._by_channel else []

    def spans(self, channel: int, first: int, count: int) -> Iterator[Span]:
        """The places of the rows `first:first + count` of a channel."""
        if count == 0:
            return
        if first < 0 or count < 0 or first + count > self.count(channel):
            raise FormatError(
                f"{self._source.name}: expected rows {first} to {first + count} in channel {channel}, "
                f"found {self.count(channel)} rows"
            )
        chosen, firsts = self._by_channel[channel]
        sizes = self.table["rows"]
        at = int(firsts.searchsorted(first, side="right")) - 1
        while count > 0:
            chunk = int(chosen[at])
            begin = first - int(firsts[at])
            end = min(int(sizes[chunk]), begin + count)
            yield Span(chunk, begin, end)
            count -= end - begin
            first += end - begin
            at += 1

    def elsewhere(self, source: Source, cache: ChunkCache) -> ChunkStore:
        """A store of the same chunks that reads from another source and uses another cache."""
        store = ChunkStore(source, self.table, self._memory, cache)
        store.codecs, store.claims = self.codecs, self.claims
        return store

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._number = next(_numbers)
        self._checked = np.zeros(len(self.table), np.bool_)
        self._compared = np.zeros(len(self.table), np.bool_)

    def locate(self, channels: Array, first: Array, counts: Array) -> tuple[Array, Array, Array]:
        """The places of the runs `first[i]:first[i] + counts[i]` of rows of `channels[i]` (int64), in their order:
        chunks, the first row within each, and numbers of rows (int64). Raises FormatError if the recording has no such
        rows."""
        runs, found = [], []
        for channel in np.unique(channels).tolist():
            chosen = np.flatnonzero((channels == channel) & (counts > 0))
            run, *places = self._locate(channel, first[chosen], counts[chosen])
            runs.append(chosen[run])
            found.append(np.stack(places))
        if len(found) != 1:
            order = np.argsort(np.concatenate([np.empty(0, np.int64), *runs]), kind="stable")
            found = [np.concatenate([np.empty((3, 0), np.int64), *found], axis=1)[:, order]]
        chunks, begins, steps = found[0]
        return chunks, begins, steps

    def _locate(self, channel: int, first: Array, counts: Array) -> tuple[Array, Array, Array, Array]:
        """The same for one channel and runs that are not empty; the first array gives the run of each entry."""
        if not len(first):
            none = np.empty(0, np.int64)
            return none, none, none, none
        last = first + counts
        if first.min() < 0 or last.max() > self.count(channel):
            raise FormatError(
                f"{self._source.name}: expected rows {first.min()} to {last.max()} in channel {channel}, "
                f"found {self.count(channel)} rows"
            )
        chosen, firsts = self._by_channel[channel]
        low = np.searchsorted(firsts, first, side="right") - 1
        pieces = np.searchsorted(firsts, last, side="left") - low
        run = np.repeat(np.arange(len(first)), pieces)
        at = low[run] + np.arange(len(run)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        start = np.maximum(first[run], firsts[at])
        end = np.minimum(last[run], firsts[at] + self.table["rows"][chosen[at]])
        return run, chosen[at], start - firsts[at], end - start

    def fetch(self, chunks: Iterable[int]) -> None:
        """Announces chunks that will be read next: a remote file requests them together."""
        if not isinstance(self._source, RemoteSource):
            return
        numbers = [
            i
            for i in dict.fromkeys(chunks)
            if self._cache.get((self._number, i)) is None and self._cache.get((self._number, ~i)) is None
        ]
        table = self.table[numbers]
        starts = table["offset"].tolist()
        ends = (table["offset"] + table["length"]).tolist()
        self._source.fetch([(a, b) for a, b in zip(starts, ends, strict=True) if a < IN_MEMORY])

    def load(self, i: int, *, keep: bool = True) -> Any:
        """The message records of chunk `i`; cached unless `keep` is False."""
        return self._chunk(i, None, keep=keep).data

    def _chunk(self, i: int, codec: ImageCodec | None, *, keep: bool) -> KeptChunk:
        """A chunk and its checked views; with a codec its decoded rows, and these are cached instead of it."""
        key = self._number, i if codec is None else ~i
        kept = self._cache.get(key)
        if kept is None:
            data = self._read(i)
            if codec is not None:
                try:
                    data = codec.decode(data, int(self.table["rows"][i]))
                except FormatError as err:
                    raise FormatError(f"{self._source.name}: chunk {i}: {err}") from err
            kept = KeptChunk(data)
            if keep:
                self._cache.put(key, kept)
        return kept

    def _read(self, i: int) -> Any:
        offset, length, size, _, _, skip, row_crc, _, compression, _ = self.table[i].item()
        if offset >= IN_MEMORY:
            return self._memory[offset - IN_MEMORY]
        where = f"{self._source.name}: chunk at offset {offset}"
        name = IN_CHUNKS[compression]
        # data that is not compressed is used in place
        record = memoryview(self._source.read(offset, length)) if name else self._source.view(offset, length)
        opcode, claimed, _, _, found_size, crc, name_length = CHUNK_HEAD.unpack_from(record)
        start = CHUNK_HEAD.size + name_length + 8
        head_ok = opcode == 6 and claimed + 9 == length and found_size == size and name_length == len(name)
        if not head_ok or record[CHUNK_HEAD.size : start - 8] != name.encode():
            raise FormatError(
                f"{where}: expected a chunk of {size} bytes ({name or 'none'}), found another record"
            )
        data = decompress(name, record[start:], size, where)
        if crc != row_crc or not (self._checked[i] or crc32(data) == crc):
            raise FormatError(
                f"{where}: its CRC differs; the chunk is damaged: tupli-mcap recover saves the others"
            )
        self._checked[i] = isinstance(record.obj, mmap)  # mapped data is checked once
        if self.tell is not None:
            self.tell(length)
        return memoryview(data)[skip:] if skip else data

    def rows(self, i: int, dtype: np.dtype[Any], *, keep: bool = True) -> Array:
        """The rows of a chunk of constant layout as one structured array; their headers are checked."""
        _, _, _, _, n, _, _, channel, _, _ = self.table[i].item()
        kept = self._chunk(i, self.codecs.get(channel), keep=keep)
        if kept.rows is not None:
            if kept.rows.dtype is not dtype:  # another view of the same bytes: `gather._items_dtype`
                kept.rows = kept.rows.view(dtype)
            return kept.rows
        data = kept.data
        if len(data) != n * dtype.itemsize:
            raise FormatError(
                f"{self._source.name}: chunk {i} expected {n} rows of {dtype.itemsize} bytes, found {len(data)} bytes"
            )
        rows = np.frombuffer(data, dtype)
        if not _are_rows(data, n, dtype.itemsize, channel):
            raise FormatError(
                f"{self._source.name}: chunk {i} holds records that are not rows of its channel"
            )
        if self.claims is not None and not self._compared[i]:
            self._compare_rows(i, data, channel, n, dtype.itemsize)
        kept.rows = rows
        return rows

    def _compare_rows(self, i: int, data: Any, channel: int, n: int, size: int) -> None:
        """Raises FormatError unless the rows of a chunk are those that the index names."""
        first, where = int(self.table["first"][i]), f"{self._source.name}: chunk {i}"
        claims = None if self.claims is None else self.claims.get(channel)
        if claims is None or not n:
            _check_sequence(np.ndarray(n, _U4, data, SEQUENCE_OFFSET, (size,)), first, where)
        else:
            claims.check(first, n, np.ndarray(n, _U8, data, BODY, (size,)).__getitem__, where)
        self._compared[i] = True  # once is enough: the CRC shows later changes

    def _compare_records(self, i: int, data: Any, records: Array) -> None:
        """The same for a chunk of variable layout."""
        first, where = int(self.table["first"][i]), f"{self._source.name}: chunk {i}"
        claims = None if self.claims is None else self.claims.get(int(self.table["channel"][i]))
        if claims is not None and len(records):
            starts = records[:, 0]
            if int((records[:, 1] - starts).min()) < _LEAST_STEP:
                raise FormatError(f"{where} holds messages that are not steps")
            numbers = np.ndarray(len(data) - 7, _U8, data, 0, (1,))
            claims.check(first, len(records), lambda places: numbers[starts[places] + BODY], where)
        self._compared[i] = True

    def records(self, i: int, *, keep: bool = True) -> tuple[Any, Array]:
        """A chunk of variable layout, and the offsets where each message record begins and ends: int64 (rows, 2)."""
        kept = self._chunk(i, None, keep=keep)
        if kept.records is None:
            records = self._find_records(i, kept.data)
            if self.claims is not None and not self._compared[i]:
                self._compare_records(i, kept.data, records)
            kept.records = records
        return kept.data, kept.records

    def _find_records(self, i: int, data: Any) -> Array:
        rows, channel = int(self.table["rows"][i]), int(self.table["channel"][i])
        where = f"{self._source.name}: chunk {i}"
        try:
            found = message_places(data, rows)
        except FormatError as err:
            raise FormatError(f"{where}: {err}") from err
        heads = headers_at(data)
        channels = heads["#channel"][found[:, 0]]
        others = channels[channels != channel]
        if len(others):
            raise FormatError(f"{where} holds a message of channel {others[0]}")
        if len(found) != rows:
            raise FormatError(f"{where} expected {rows} messages, found {len(found)}")
        if self.claims is not None:
            _check_sequence(heads["#sequence"][found[:, 0]], int(self.table["first"][i]), where)
        return found

    def all_messages(self, channel: int | None) -> Iterator[tuple[int, int, memoryview]]:
        """(row, log_time, body) of the messages of a channel; none if it is None. No chunk is cached.

        Raises:
            FormatError: a chunk is damaged; the messages before it have been yielded.
        """
        if channel is not None:
            messages = self.messages(channel, 0, self.count(channel), keep=False)
            for row, (log_time, body) in enumerate(messages):
                yield row, log_time, body

    def messages(
        self, channel: int, first: int, count: int, *, keep: bool = True
    ) -> Iterator[tuple[int, memoryview]]:
        """(log_time, CDR body) of messages of a channel of variable layout."""
        for span in self.spans(channel, first, count):
            data, records = self.records(span.chunk, keep=keep)
            view = memoryview(data)
            for begin in range(span.begin, span.end, _BLOCK):
                for start, end in records[begin : min(begin + _BLOCK, span.end)].tolist():
                    yield int.from_bytes(view[start + 15 : start + 23], "little"), view[start + BODY : end]

    def bodies(self, channel: int, first: int, count: int) -> Iterator[memoryview]:
        """The CDR bodies of messages of a channel of variable layout, whose chunks are fetched together."""
        self.fetch(span.chunk for span in self.spans(channel, first, count))
        return (body for _, body in self.messages(channel, first, count))
