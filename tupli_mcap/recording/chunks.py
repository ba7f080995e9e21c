"""Decompressed chunks, by channel and row, with a cache.

Everything a file says of a chunk is a claim: sizes are capped before anything is allocated, CRCs are checked, and the
rows' own headers must agree with the chunk table.
"""

from __future__ import annotations

import os
import struct
import threading
import zlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.errors import FormatError
from tupli_mcap.messages.layout import BODY
from tupli_mcap.recording.claims import MAX_CHUNK
from tupli_mcap.recording.compression import decompress
from tupli_mcap.recording.container import COMPRESSIONS
from tupli_mcap.recording.logs import iter_records
from tupli_mcap.recording.source import Source

__all__ = ["IN_MEMORY", "ChunkStore", "Span"]

IN_MEMORY = 1 << 63  # chunk offsets from here on index rows recovered from a journal
_CHUNK_HEAD = struct.Struct(
    "<BQQQQII"
)  # opcode, length, start, end, uncompressed size, crc, compression length


_TIME, _TIME_OFFSET = struct.Struct("<Q"), 15  # in a Message record


class Span(NamedTuple):
    """Rows `begin:end` of chunk `chunk`."""

    chunk: int
    begin: int
    end: int


class ChunkStore:
    """The chunks of a recording. `table` is a CHUNK_ROWS array; `memory` holds rows that are only in the journal.

    `rows(i, dtype)` and `offsets(i)` are safe from several threads.
    """

    def __init__(
        self, source: Source, table: np.ndarray[Any, Any], memory: Sequence[bytes], cache_bytes: int
    ) -> None:
        self._source = source
        self.table = table
        self._memory = memory
        self._budget = cache_bytes
        self._cache: OrderedDict[int, Any] = OrderedDict()
        self._cached = 0
        self._lock = threading.Lock()
        self._process = os.getpid()
        self._offsets: dict[int, list[tuple[int, int]]] = {}
        self._views: dict[int, np.ndarray[Any, Any]] = {}  # of cached chunks, their headers checked
        self._by_channel: dict[int, tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]] = {}
        self._counts: dict[int, int] = {}
        for channel in np.unique(table["channel"]):
            chosen = np.flatnonzero(table["channel"] == channel)
            chosen = chosen[np.argsort(table["first"][chosen], kind="stable")]
            self._check_chain(chosen, int(channel))
            self._by_channel[int(channel)] = (chosen, table["first"][chosen].astype(np.int64))
            self._counts[int(channel)] = int(table["rows"][chosen].sum())

    def _check_chain(self, chosen: np.ndarray[Any, Any], channel: int) -> None:
        ends = np.cumsum(self.table["rows"][chosen], dtype=np.uint64)
        if (self.table["first"][chosen] != ends - self.table["rows"][chosen]).any():
            raise FormatError(
                f"{self._source.name}: the chunks of channel {channel} do not hold its rows without gaps"
            )

    def count(self, channel: int) -> int:
        """Rows of a channel."""
        return self._counts.get(channel, 0)

    def chunks(self, channel: int) -> list[int]:
        """The chunks of a channel in the order of their rows."""
        return [int(i) for i in self._by_channel[channel][0]] if channel in self._by_channel else []

    def spans(self, channel: int, first: int, count: int) -> Iterator[Span]:
        """Where the rows `first:first + count` of a channel lie."""
        if count == 0:
            return
        if first < 0 or count < 0 or first + count > self.count(channel):
            raise FormatError(
                f"{self._source.name}: expected rows {first} to {first + count} in channel {channel}, "
                f"found {self.count(channel)} rows"
            )
        chosen, firsts = self._by_channel[channel]
        at = int(np.searchsorted(firsts, first, side="right")) - 1
        while count > 0:
            rows = int(self.table["rows"][chosen[at]])
            begin = first - int(firsts[at])
            end = min(rows, begin + count)
            yield Span(int(chosen[at]), begin, end)
            count -= end - begin
            first += end - begin
            at += 1

    def load(self, i: int, *, keep: bool = True) -> Any:
        """The message records of chunk `i`; cached unless `keep` is False."""
        if self._process != os.getpid():  # forked: the lock may be held by a thread that is not here
            self._lock, self._process = threading.Lock(), os.getpid()
        with self._lock:
            if i in self._cache:
                self._cache.move_to_end(i)
                return self._cache[i]
        data = self._read(i)
        if keep:
            with self._lock:
                self._cache[i] = data
                self._cached += len(data)
                while self._cached > self._budget and len(self._cache) > 1:
                    old, dropped = self._cache.popitem(last=False)
                    self._offsets.pop(old, None)
                    self._views.pop(old, None)
                    self._cached -= len(dropped)
        return data

    def _read(self, i: int) -> Any:
        row = self.table[i]
        offset, length, size = int(row["offset"]), int(row["length"]), int(row["uncompressed"])
        if offset >= IN_MEMORY:
            return self._memory[offset - IN_MEMORY]
        where = f"{self._source.name}: chunk at offset {offset}"
        skip = int(row["skip"])
        if (
            length < _CHUNK_HEAD.size + 8
            or size > MAX_CHUNK
            or skip > size
            or int(row["compression"]) >= len(COMPRESSIONS)
        ):
            raise FormatError(
                f"{where}: expected a chunk of at most {MAX_CHUNK} bytes, found {length} holding {size}"
            )
        record = self._source.read(offset, length)
        opcode, claimed, _, _, found_size, crc, name_length = _CHUNK_HEAD.unpack_from(record)
        name = COMPRESSIONS[row["compression"]].replace("none", "")
        start = _CHUNK_HEAD.size + name_length + 8
        head_ok = opcode == 6 and claimed + 9 == length and found_size == size and name_length == len(name)
        if not head_ok or record[_CHUNK_HEAD.size : start - 8] != name.encode():
            raise FormatError(
                f"{where}: expected a chunk of {size} bytes ({name or 'none'}), found another record"
            )
        data = decompress(name, memoryview(record)[start:], size, where)
        if zlib.crc32(data) != crc or crc != row["crc"]:
            raise FormatError(f"{where}: its CRC differs, the chunk is damaged or another one")
        return memoryview(data)[skip:] if skip else data

    def rows(self, i: int, dtype: np.dtype[Any], *, keep: bool = True) -> np.ndarray[Any, Any]:
        """The rows of a chunk of constant layout as one structured array; their headers are checked."""
        view = self._views.get(i)
        if view is not None:
            return view
        data = self.load(i, keep=keep)
        row = self.table[i]
        n = int(row["rows"])
        if len(data) != n * dtype.itemsize:
            raise FormatError(
                f"{self._source.name}: chunk {i} expected {n} rows of {dtype.itemsize} bytes, found {len(data)} bytes"
            )
        rows = np.frombuffer(data, dtype)
        good = (rows["#opcode"] == 5).all() and (rows["#length"] == dtype.itemsize - 9).all()
        if not (good and (rows["#channel"] == row["channel"]).all()):
            raise FormatError(f"{self._source.name}: chunk {i} holds records that are no rows of its channel")
        if i in self._cache:
            self._views[i] = rows
        return rows

    def messages(self, i: int) -> list[tuple[int, int]]:
        """(start, end) of each message record of a chunk of variable layout."""
        if i not in self._offsets:
            data = memoryview(self.load(i))
            spans = []
            for start, end, channel, _, _ in iter_records(data):
                if channel != self.table["channel"][i]:
                    raise FormatError(f"{self._source.name}: chunk {i} holds a message of channel {channel}")
                spans.append((start, end))
            if len(spans) != self.table["rows"][i]:
                raise FormatError(
                    f"{self._source.name}: chunk {i} expected {self.table['rows'][i]} messages, found {len(spans)}"
                )
            self._offsets[i] = spans
        return self._offsets[i]

    def bodies(self, channel: int, first: int, count: int) -> Iterator[memoryview]:
        """The CDR bodies of messages of a channel of variable layout."""
        for span in self.spans(channel, first, count):
            data = memoryview(self.load(span.chunk))
            for start, end in self.messages(span.chunk)[span.begin : span.end]:
                yield data[start + BODY : end]

    def times(self, channel: int, first: int, count: int) -> Iterator[int]:
        """The log times (ns) of messages of a channel of variable layout."""
        for span in self.spans(channel, first, count):
            data = memoryview(self.load(span.chunk))
            for start, _ in self.messages(span.chunk)[span.begin : span.end]:
                yield _TIME.unpack_from(data, start + _TIME_OFFSET)[0]
