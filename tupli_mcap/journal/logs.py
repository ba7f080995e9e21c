"""Logs: Message records of variable size in the journal, and how they go into chunks.

Each half of a log is a u64 end offset and the records up to it. The end is stored after the records, as one machine
word, and commits them. A log of events also holds the size of the file after its earlier records went there.

A sealed record has checksums in place of `publish_time`, which is derived when it goes to a chunk. If a process is
killed, the kernel still has all pages of its journal. If the kernel goes down, pages it has not written are lost, in
any order and in parts: after another boot, only records count that are known to be whole.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.journal.file import LOG_HEADER, Journal, LogArea
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import BODY, CDR_HEADER, crc32_each

FRONT = struct.Struct("<BQHIQ")  # a record up to publish_time, where a journal has a checksum
_LOG_TIME = FRONT.size - 8
_SEAL = struct.Struct("<II")
_SEAL_END = FRONT.size + _SEAL.size
STATE = BODY + 8  # offset of the state in a step's record
StartChunks = Callable[[Sequence[Rows]], Callable[[], None]]


class ToFile(NamedTuple):
    """The file that rows go to from the journal.

    Attributes:
        counts: rows of each channel in it.
        end_time: `log_time` (ns) of the latest of them.
        size: returns its size (bytes).
        add_chunk: writes a chunk, durably where that is asked for.
        start_chunks: begins to compress several chunks; what it returns writes them, durably where that is asked for.
        grow: called with the size of a step that is larger than the journal.
        durable: chunks are on the disk before their rows are used again.
        sealed: rows in the journal carry checksums.
    """

    counts: Mapping[int, int]
    end_time: int
    size: Callable[[], int]
    add_chunk: Callable[[Rows], None]
    start_chunks: StartChunks
    grow: Callable[[int], None]
    durable: bool
    sealed: bool


def checksum(record: bytes | bytearray | memoryview) -> int:
    """CRC-32 of a Message record without its `publish_time`."""
    view = memoryview(record)
    return crc32(view[_SEAL_END:], crc32(view[: FRONT.size]))


def seal(view: bytearray | memoryview, start: int, end: int, running: bytes | bytearray | memoryview) -> None:
    """Writes the checksums of a record, and of the state that follows its step, in place of `publish_time`."""
    whole = checksum(memoryview(view)[start:end])
    _SEAL.pack_into(view, start + FRONT.size, whole, crc32(running))


def seal_of(view: bytes | memoryview, start: int) -> tuple[int, int]:
    """The two checksums of the record at `start`."""
    return _SEAL.unpack_from(view, start + FRONT.size)


def sealed_records(table: Array) -> bytes:
    """Records of constant size as they are in a log: checksums replace `publish_time`, in `table`, too."""
    size = table.dtype.itemsize - 8
    bare = np.empty((len(table), size), np.uint8)
    whole = table.view(np.uint8).reshape(len(table), table.dtype.itemsize)
    bare[:, : FRONT.size], bare[:, FRONT.size :] = whole[:, : FRONT.size], whole[:, FRONT.size + 8 :]
    table["#publish_time"] = crc32_each(bare.view(f"V{size}")[:, 0].tolist())
    return table.tobytes()


def as_rows(channel: int, first: int, joined: bytearray, sizes: Any, *, sealed: bool) -> Rows:
    """Whole records of one channel that lie in `joined` one after the other; `sizes` are their numbers of bytes.

    With `sealed`, `publish_time` replaces their checksums.
    """
    offsets = np.zeros(len(sizes), dtype=np.uint64)
    np.cumsum(sizes[:-1], out=offsets[1:])
    log_times = offsets[:, None] + np.arange(_LOG_TIME, _LOG_TIME + 8, dtype=np.uint64)
    content = np.frombuffer(joined, np.uint8)
    times = content[log_times]
    if sealed:  # the journal's checksums are there
        content[log_times + np.uint64(8)] = times
    return Rows(channel, first, joined, offsets, times.reshape(-1).view("<u8"))


def joined_rows(channel: int, first: int, records: Sequence[bytes], *, sealed: bool) -> Rows:
    """The same of records that lie apart."""
    return as_rows(channel, first, bytearray().join(records), list(map(len, records)), sealed=sealed)


class EventLog:
    """A log of one half with records of several channels. When it is full, they go to the file, one chunk for each.

    Attributes:
        sequences: messages of each channel so far, with those of earlier sessions.
        latest_ns: log_time (ns) of the last message; later ones are not less.
    """

    def __init__(self, journal: Journal, name: str, channels: Iterable[int], file: ToFile) -> None:
        self._name, self._file = name, file
        self.sequences = {channel: file.counts[channel] for channel in channels}
        self.latest_ns = file.end_time
        # the records in the journal by channel, so that a flush need not parse it
        self._whole: defaultdict[int, list[bytes]] = defaultdict(list)
        self._last = 0  # where the last message began
        self._last_channel = 0
        self._can_drop = False
        self.move(journal)

    def move(self, journal: Journal) -> None:
        """Goes on in another journal. All records must be in the file."""
        area, buffer = journal.area(self._name, LogArea), journal.buffer(self._name)
        self._records = buffer[LOG_HEADER : LOG_HEADER + area.capacity]
        self._commit, self._behind = buffer[:8].cast("Q"), buffer[8:16].cast("Q")
        self._capacity = area.capacity
        self._position = 0
        self._behind[0] = self._file.size()
        self._commit[0] = 0

    def append(self, time_ns: int, *messages: tuple[int, bytes]) -> int:
        """Commits messages (channel, CDR body) together; returns their log_time (ns)."""
        if time_ns > self.latest_ns:
            self.latest_ns = time_ns
        else:
            time_ns = self.latest_ns
        size = 0
        for _, body in messages:
            size += BODY + len(body)
        if self._position + size > self._capacity:
            self.flush()
        fits = size <= self._capacity
        sequences, position, channel = self.sequences, self._position, 0
        self._last = position
        for channel, body in messages:
            sequences[channel] = 1 + (sequence := sequences[channel])
            front = FRONT.pack(5, BODY - 9 + len(body), channel, sequence, time_ns)
            tail = CDR_HEADER + body
            record = front + crc32(tail, crc32(front)).to_bytes(8, "little") + tail
            self._whole[channel].append(record)
            if fits:
                begin, position = position, position + len(record)
                self._records[begin:position] = record
        if not fits:
            self._write()
            self._can_drop = False
            return time_ns
        self._last_channel, self._can_drop = channel, True
        self._position = self._commit[0] = position
        return time_ns

    def drop_last(self, channel: int) -> None:
        """Removes the message of the last `append`, one of `channel`, unless it is in the file already."""
        if not self._can_drop:
            return
        self._whole[channel].pop()
        self._position = self._last
        self._commit[0] = self._last
        self.sequences[channel] -= 1

    def flush(self, *, keep_last: bool = False) -> None:
        """Writes the records to the file; with `keep_last` the last one stays here, so that it can still be dropped."""
        keep_last = keep_last and self._can_drop
        kept = self._whole[self._last_channel].pop() if keep_last else b""
        self._write(1 if keep_last else 0)
        if keep_last:
            self._whole[self._last_channel].append(kept)
        self._commit[0] = 0
        self._records[: len(kept)] = kept
        self._last, self._position, self._can_drop = 0, len(kept), keep_last
        self._commit[0] = len(kept)

    def _write(self, kept: int = 0) -> None:
        """Writes the records to the file; `kept` records were taken out at the end of the last channel's."""
        whole, self._whole = self._whole, defaultdict(list)
        for channel, records in whole.items():
            if records:
                first = (
                    self.sequences[channel] - len(records) - (kept if channel == self._last_channel else 0)
                )
                self._file.add_chunk(joined_rows(channel, first, records, sealed=True))
        self._behind[0] = self._file.size()
