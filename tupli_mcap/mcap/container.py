"""Writes MCAP files: header, metadata, attachments, chunks, summary.

The `mcap` package writes all records but those of chunks: their rows and message indexes come as whole arrays.
"""

from __future__ import annotations

import contextlib
import functools
import os
import stat
import struct
import threading
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from typing import Any, NamedTuple, Protocol

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from tupli_mcap.errors import RecordingError, os_reason
from tupli_mcap.mcap.records import (
    CHUNK_HEAD,
    MAGIC,
    MESSAGE_INDEX,
    PROFILE,
    crc32,
    with_crc,
    written_records,
)

REPEATED = ".repeated"
"""End of the name of metadata that are repeated at the end of a file: viewers warn of two records of one name."""

CHUNK_ROWS = np.dtype(
    [
        ("offset", "<u8"), ("length", "<u8"), ("uncompressed", "<u8"), ("first", "<u8"),
        ("rows", "<u4"), ("skip", "<u4"), ("crc", "<u4"), ("channel", "<u2"), ("compression", "u1"), ("pad", "u1"),
    ]
)  # fmt: skip
LIBRARY = "tupli-mcap"
COMPRESSIONS = ["none", "zstd", "lz4"]
IN_CHUNKS = ["", "zstd", "lz4"]
"""The same, as chunks name them."""
_ROW = struct.Struct("<QQQQIIIHBB")  # of CHUNK_ROWS
_PIECES = 1024  # buffers that one call of the system takes
_LEVEL = -1  # of zstd: faster than level 1 to write and to read, for a little more room
_CONTEXT = 4 << 20  # bytes: more than a compressor needs besides its output


def _write(fd: int, parts: Sequence[memoryview], position: int | None) -> int:
    """Writes at least one byte of `parts` at a position (None: to a pipe); returns how many it wrote."""
    if position is None:
        return os.writev(fd, parts)
    if hasattr(os, "pwritev"):
        return os.pwritev(fd, parts, position)
    return os.pwrite(fd, b"".join(parts), position)


class Rows(NamedTuple):
    """Message records of one channel for a chunk: `first` is the first row, `offsets` are from the first record on,
    `times` are log_times (ns)."""

    channel: int
    first: int
    data: Any
    offsets: np.ndarray[Any, np.dtype[np.uint64]]
    times: np.ndarray[Any, np.dtype[np.uint64]]


class Encoder(Protocol):
    """Turns rows of constant size, as the journal holds them, into the messages that a channel's chunks hold."""

    def encode(self, rows: Rows) -> Rows:
        """The same messages as the chunks hold them."""
        ...


class Prepared(NamedTuple):
    """A chunk before compression: `skip` bytes of Schema and Channel records come before the rows in `data`."""

    rows: Rows
    skip: int
    data: Any
    crc: int


Packed = tuple[Sequence[Prepared], Sequence[bytes]]  # chunks, and their compressed data


@functools.cache  # the version is read from the disk
def library() -> str:
    """The name and the version of this package, as recordings name their writer."""
    return f"{LIBRARY} {version(LIBRARY)}"


class Container:
    """Writes records to the descriptor of a file or a pipe, and collects what the summary needs.

    Not thread-safe, but the function that `start_chunks` returns may be called from another thread.
    """

    def __init__(self, fd: int, name: str, compression: str) -> None:
        if compression not in COMPRESSIONS:
            raise RecordingError(f"compression: expected one of {COMPRESSIONS}, found {compression!r}")
        self._fd = fd
        self._is_pipe = fd >= 0 and stat.S_ISFIFO(os.fstat(fd).st_mode)
        self.name = name
        self.compression = compression
        self._local = threading.local()  # a compressor for each thread
        self.position = 0
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunk_indexes: list[bytes] = []
        self.attachment_indexes: list[AttachmentIndex] = []
        self.metadata_indexes: list[MetadataIndex] = []
        self.metadata: dict[str, Mapping[str, str]] = {}  # by name; written again at the end
        self.counts: dict[int, int] = {}
        self.start_time: int | None = None
        self.end_time = 0
        self.chunk_rows = bytearray()
        self.codecs: Mapping[int, Encoder] = {}  # by channel; rows of other channels are written as they are
        self._announced: set[int] = set()

    def close(self) -> None:
        """Forgets the descriptor, whose number may soon be another file's; the caller closes it."""
        self._fd = -1

    def write(self, *parts: Any) -> None:
        """Appends bytes, in one call of the system if it takes them all. RecordingError if the system refused. The file
        keeps its whole records."""
        start = position = self.position
        left = [memoryview(part) for part in parts]
        try:
            while left:
                written = _write(self._fd, left[:_PIECES], None if self._is_pipe else position)
                position += written
                while left and written >= len(left[0]):
                    written -= len(left.pop(0))
                if written:
                    left[0] = left[0][written:]
        except OSError as err:
            with contextlib.suppress(OSError):  # bytes that stay are no whole record, and readers ignore them
                os.ftruncate(self._fd, start)
            raise RecordingError(
                f"{self.name}: could not write {sum(map(len, parts))} bytes at offset {start}: {os_reason(err)}; "
                "what was recorded before stays readable"
            ) from err
        self.position = position

    def start(self) -> None:
        """Magic and header."""
        self.write(MAGIC + written_records(Header(PROFILE, library())))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        self.metadata[name] = values
        data = written_records(Metadata(name, with_crc(values)))
        self.metadata_indexes.append(MetadataIndex(self.position, len(data), name))
        self.write(data)

    def add_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        record = written_records(Attachment(time_ns, time_ns, name, media_type, data))
        offset = self.position
        self.write(record)
        self.attachment_indexes.append(
            AttachmentIndex(offset, len(record), time_ns, time_ns, len(data), name, media_type)
        )

    def add_schema(self, name: str, text: str) -> int:
        schema = Schema(max(self.schemas, default=0) + 1, text.encode(), "ros2msg", name)
        self.schemas[schema.id] = schema
        return schema.id

    def add_channel(self, topic: str, schema_id: int, metadata: Mapping[str, str]) -> int:
        described = with_crc(metadata) if metadata else {}
        channel = Channel(max(self.channels, default=0) + 1, topic, "cdr", described, schema_id)
        self.channels[channel.id] = channel
        self.counts[channel.id] = 0
        return channel.id

    def define_channels(self) -> None:
        """Writes the definitions of channels that have no chunk yet, so that a file without its journal has them.

        A channel's first chunk starts with them again, for readers that go from chunk to chunk.
        """
        for channel in self.channels:
            if channel not in self._announced:
                self.write(self.definitions(channel))

    def definitions(self, channel: int) -> bytes:
        """The Schema and Channel records of a channel, as they precede its first message."""
        record = self.channels[channel]
        return written_records(self.schemas[record.schema_id], record)

    def add_chunk(self, rows: Rows) -> None:
        """Writes a chunk of one channel's records and its message index.

        The channel's first chunk starts with its Schema and Channel records.
        """
        if len(rows.offsets):
            self.finish_chunks(self.start_chunks([rows])())

    def prepare(self, rows: Rows) -> Prepared:
        """The records of a chunk and their CRC. The channel's earlier chunks must be in the file."""
        codec = self.codecs.get(rows.channel)
        rows = rows if codec is None else codec.encode(rows)
        head = b"" if rows.channel in self._announced else self.definitions(rows.channel)
        data = rows.data if not head else head + bytes(rows.data)
        return Prepared(rows, len(head), data, crc32(data))

    def pack(self, data: Any) -> bytes:
        """Compresses the records of a chunk; RecordingError if there is no memory for it."""
        with self._memory_for(len(data)):
            if self.compression == "zstd":
                packed: bytes = self._zstd().compress(data)
                return packed
            if self.compression == "lz4":
                framed: bytes = lz4.frame.compress(data)
                return framed
            return bytes(data)

    @contextlib.contextmanager
    def _memory_for(self, size: int) -> Iterator[None]:
        try:
            yield
        except (zstandard.ZstdError, RuntimeError, MemoryError) as err:
            raise RecordingError(
                f"{self.name}: could not compress {size} bytes: {str(err) or 'out of memory'}; "
                "what was recorded before stays readable"
            ) from err

    @property
    def packs_together(self) -> bool:
        """True if `pack_all` releases the interpreter lock once for all chunks, so that a thread pays."""
        return self.compression == "zstd" and hasattr(self._zstd(), "multi_compress_to_buffer")

    def pack_all(self, data: Sequence[Any]) -> list[Any]:
        """`pack` of several chunks, as bytes or buffers."""
        if len(data) > 1 and self.packs_together:  # each call makes compressors for its threads
            size = sum(map(len, data))
            with self._memory_for(size):
                # raise MemoryError here: zstandard frees a buffer twice, and ends the process, if it finds too little
                np.empty(size + _CONTEXT, np.uint8)
                parts = self._zstd().multi_compress_to_buffer(list(data))
            return [parts[i] for i in range(len(parts))]
        return [self.pack(part) for part in data]

    def _zstd(self) -> zstandard.ZstdCompressor:
        if not hasattr(self._local, "zstd"):
            self._local.zstd = zstandard.ZstdCompressor(level=_LEVEL)
        found: zstandard.ZstdCompressor = self._local.zstd
        return found

    def start_chunks(self, chunks: Sequence[Rows]) -> Callable[[], Packed]:
        """A function that compresses chunks of different channels, in any thread; `finish_chunks` takes its result.

        This method and `finish_chunks` do everything that needs the interpreter lock, so that the compressing thread
        takes it only once. Except: chunks with a codec are encoded in that thread.
        """
        if any(rows.channel in self.codecs for rows in chunks):
            return lambda: self._packed([self.prepare(rows) for rows in chunks])
        return partial(self._packed, [self.prepare(rows) for rows in chunks])

    def _packed(self, chunks: Sequence[Prepared]) -> Packed:
        return chunks, self.pack_all([chunk.data for chunk in chunks])

    def finish_chunks(self, packed: Packed) -> None:
        """Writes compressed chunks and their message indexes."""
        method = COMPRESSIONS.index(self.compression)
        records, notes = [], []
        position = self.position
        for (rows, skip, data, crc), body in zip(*packed, strict=True):
            entries = index_entries(rows.times, rows.offsets, skip).tobytes()
            start, end, size, count = rows.times.item(0), rows.times.item(-1), len(data), len(rows.offsets)
            head = _chunk_head(IN_CHUNKS[method].encode(), len(body), (start, end, size, crc))
            index = MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), rows.channel, len(entries))
            length = len(head) + len(body)
            row = (position, length, size, rows.first, count, skip, crc, rows.channel, method, 0)
            notes.append((row, start, end))
            records += [head, body, index, entries]
            position += length + len(index) + len(entries)
        self.write(*records)
        for note in notes:
            self.note_chunk(*note)

    def note_chunk(self, row: tuple[int, ...], start: int, end: int) -> None:
        """Notes a chunk that is in the file, for the summary and the index: a row of CHUNK_ROWS, its times (ns)."""
        self.chunk_indexes.append(_chunk_index(row, start, end))
        self.chunk_rows += _ROW.pack(*row)
        channel, rows = row[7], row[4]
        self._announced.add(channel)
        self.counts[channel] += rows
        if self.start_time is None or start < self.start_time:
            self.start_time = start
        self.end_time = max(self.end_time, end)

    def finish(self) -> None:
        """Repeats the metadata; then writes DataEnd, summary, footer and magic in one write."""
        for name, values in list(self.metadata.items()):
            self.add_metadata(name + REPEATED, values)
        data_end = written_records(DataEnd(0))
        self.write(data_end, self.summary(self.position + len(data_end)), MAGIC)

    def summary(self, start: int) -> bytes:
        """The summary, which begins at offset `start`, and the footer."""
        groups: list[tuple[Opcode, list[Any]]] = [
            (Opcode.SCHEMA, list(self.schemas.values())),
            (Opcode.CHANNEL, list(self.channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self.chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, list(self.attachment_indexes)),
            (Opcode.METADATA_INDEX, list(self.metadata_indexes)),
        ]
        summary, offsets = bytearray(), []
        for opcode, records in groups:
            begin = len(summary)
            summary += b"".join(records) if opcode == Opcode.CHUNK_INDEX else written_records(*records)
            if records:
                offsets.append(SummaryOffset(opcode, start + begin, len(summary) - begin))
        offset_start = start + len(summary)
        summary += written_records(*offsets)
        crc = zlib.crc32(written_records(Footer(start, offset_start, 0))[:-4], zlib.crc32(summary))
        return bytes(summary) + written_records(Footer(start, offset_start, crc))

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self.attachment_indexes),
            channel_count=len(self.channels),
            channel_message_counts={c: n for c, n in self.counts.items() if n},
            chunk_count=len(self.chunk_indexes),
            message_count=sum(self.counts.values()),
            message_end_time=self.end_time,
            message_start_time=self.start_time or 0,
            metadata_count=len(self.metadata_indexes),
            schema_count=len(self.schemas),
        )


# The records of a chunk are packed here, and not by the `mcap` package's builder, which packs field by field.

# RECORD; first and last time, offset and length of the chunk; length of the map of message indexes, its one channel and
# offset; length of the message index; length of the compression's name
_CHUNK_INDEX = struct.Struct("<BQQQQQIHQQI")
_SIZES = struct.Struct("<QQ")  # compressed, uncompressed


def _chunk_head(name: bytes, packed: int, facts: tuple[int, int, int, int]) -> bytes:
    """A Chunk record up to its `packed` bytes; `name` is the compression."""
    length = CHUNK_HEAD.size - 9 + len(name) + 8 + packed
    return CHUNK_HEAD.pack(Opcode.CHUNK, length, *facts, len(name)) + name + packed.to_bytes(8, "little")


def index_entries(times: Any, offsets: Any, skip: int) -> np.ndarray[Any, np.dtype[np.uint64]]:
    """The entries of a MessageIndex: log_time and offset of each message, uint64 (messages, 2); `offsets` are those
    behind the first `skip` bytes of the chunk."""
    entries = np.empty((len(times), 2), "<u8")
    entries[:, 0] = times
    np.add(offsets, np.uint64(skip), out=entries[:, 1])
    return entries


def _chunk_index(row: tuple[int, ...], start: int, end: int) -> bytes:
    """The ChunkIndex record of a chunk, whose message index follows it; `row` is one of CHUNK_ROWS."""
    offset, length, size, _, rows, _, _, channel, method, _ = row
    name = IN_CHUNKS[method].encode()
    index = 10, channel, offset + length, MESSAGE_INDEX.size + 16 * rows
    whole = _CHUNK_INDEX.size - 9 + len(name) + _SIZES.size
    head = _CHUNK_INDEX.pack(Opcode.CHUNK_INDEX, whole, start, end, offset, length, *index, len(name))
    return head + name + _SIZES.pack(length - CHUNK_HEAD.size - len(name) - 8, size)
