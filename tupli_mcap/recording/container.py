"""The MCAP container around the block of step messages: header, chunks, attachments, summary.

Records are written by the `mcap` package; the rows of a chunk and their message index are ours, because they come as
whole arrays.
"""

from __future__ import annotations

import contextlib
import os
import threading
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from tupli_mcap.errors import RecordingError
from tupli_mcap.recording.checksums import with_crc
from tupli_mcap.system import refused

__all__ = ["CHUNK_ROWS", "MAGIC", "Compression", "Container"]

MAGIC = b"\x89MCAP0\r\n"
PROFILE = "tupli_mcap"
Compression = str  # "zstd", "lz4" or "none"

CHUNK_ROWS = np.dtype(
    [
        ("offset", "<u8"), ("length", "<u8"), ("uncompressed", "<u8"), ("first", "<u8"),
        ("rows", "<u4"), ("skip", "<u4"), ("crc", "<u4"), ("channel", "<u2"), ("compression", "u1"), ("pad", "u1"),
    ]
)  # fmt: skip
COMPRESSIONS = ["none", "zstd", "lz4"]


def _built(builder: RecordBuilder) -> bytes:
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


class Rows(NamedTuple):
    """Message records of one channel, ready to be a chunk: `offsets` of each from the first, `times` their log_time."""

    channel: int
    first: int
    data: Any
    offsets: np.ndarray[Any, np.dtype[np.uint64]]
    times: np.ndarray[Any, np.dtype[np.uint64]]


class Prepared(NamedTuple):
    """A chunk before compression: `skip` bytes of Schema and Channel records come before the rows in `data`."""

    rows: Rows
    skip: int
    data: Any
    crc: int


class Container:
    """Writes records to a file descriptor and remembers what the summary needs.

    `add_chunk` may be called from two threads, for different channels, and `pack_all` from any; nothing else.
    """

    def __init__(self, fd: int, name: str, compression: Compression) -> None:
        if compression not in COMPRESSIONS:
            raise RecordingError(f"compression: expected one of {COMPRESSIONS}, found {compression!r}")
        self._fd = fd
        self._name = name
        self._compression = compression
        self._local = threading.local()  # a compressor is not to be shared
        self._lock = threading.RLock()
        self.position = 0
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunk_indexes: list[bytes] = []
        self.attachment_indexes: list[AttachmentIndex] = []
        self.metadata_indexes: list[MetadataIndex] = []
        self.counts: dict[int, int] = {}
        self.start_time: int | None = None
        self.end_time = 0
        self.chunk_rows = bytearray()
        self._announced: set[int] = set()

    def write(self, data: bytes) -> None:
        """Appends bytes; on failure the file keeps only whole records."""
        start = self.position
        view = memoryview(data)
        try:
            while view:
                view = view[os.pwrite(self._fd, view, start + len(data) - len(view)) :]
        except OSError as err:
            with contextlib.suppress(OSError):  # what stays behind is no whole record, and is not read
                os.ftruncate(self._fd, start)
            raise RecordingError(
                f"{self._name}: could not write {len(data)} bytes at offset {start}: {refused(err)}; "
                "what was recorded before stays readable"
            ) from err
        self.position += len(data)

    def start(self, library: str) -> None:
        """Magic and header."""
        builder = RecordBuilder()
        Header(PROFILE, library).write(builder)
        self.write(MAGIC + _built(builder))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        builder = RecordBuilder()
        Metadata(name, with_crc(values)).write(builder)
        data = _built(builder)
        self.metadata_indexes.append(MetadataIndex(self.position, len(data), name))
        self.write(data)

    def add_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        builder = RecordBuilder()
        Attachment(time_ns, time_ns, name, media_type, data).write(builder)
        record = _built(builder)
        offset = self.position
        self.write(record)
        self.attachment_indexes.append(
            AttachmentIndex(offset, len(record), time_ns, time_ns, len(data), name, media_type)
        )

    def add_schema(self, name: str, text: str) -> int:
        schema = Schema(len(self.schemas) + 1, text.encode(), "ros2msg", name)
        self.schemas[schema.id] = schema
        return schema.id

    def add_channel(self, topic: str, schema_id: int, metadata: Mapping[str, str]) -> int:
        described = with_crc(metadata) if metadata else {}
        channel = Channel(len(self.channels) + 1, topic, "cdr", described, schema_id)
        self.channels[channel.id] = channel
        self.counts[channel.id] = 0
        return channel.id

    def define_channels(self) -> None:
        """Writes the definitions of channels that have no chunk yet, so that a file without its journal knows them.

        Readers that take chunks one by one find them again at the start of a channel's first chunk.
        """
        for channel in self.channels:
            if channel not in self._announced:
                self.write(self.definitions(channel))

    def definitions(self, channel: int) -> bytes:
        """The Schema and Channel records of a channel, as they precede its first message."""
        builder = RecordBuilder()
        self.schemas[self.channels[channel].schema_id].write(builder)
        self.channels[channel].write(builder)
        return _built(builder)

    def add_chunk(self, rows: Rows) -> None:
        """Writes a chunk of one channel's records and its message index.

        The channel's first chunk starts with its Schema and Channel records.
        """
        if len(rows.offsets):
            chunk = self.prepare(rows)
            self.place(chunk, self.pack(chunk.data))

    def prepare(self, rows: Rows) -> Prepared:
        """The records of a chunk and their CRC. The channel's chunk before it must be in the file."""
        head = b"" if rows.channel in self._announced else self.definitions(rows.channel)
        data = rows.data if not head else head + bytes(rows.data)
        return Prepared(rows, len(head), data, zlib.crc32(data))

    def pack(self, data: Any) -> bytes:
        """Compresses the records of a chunk."""
        if self._compression == "zstd":
            packed: bytes = self._zstd().compress(data)
            return packed
        if self._compression == "lz4":
            framed: bytes = lz4.frame.compress(data)
            return framed
        return bytes(data)

    @property
    def packs_together(self) -> bool:
        """True if `pack_all` lets go of the interpreter lock once for all chunks, so that a thread is worth it."""
        return self._compression == "zstd" and hasattr(self._zstd(), "multi_compress_to_buffer")

    def pack_all(self, data: Sequence[Any]) -> list[bytes]:
        """`pack` of several chunks; may be called from any thread."""
        if data and self.packs_together:
            parts = self._zstd().multi_compress_to_buffer(list(data))
            return [parts[i].tobytes() for i in range(len(parts))]
        return [self.pack(part) for part in data]

    def _zstd(self) -> zstandard.ZstdCompressor:
        if not hasattr(self._local, "zstd"):
            self._local.zstd = zstandard.ZstdCompressor(level=1)
        found: zstandard.ZstdCompressor = self._local.zstd
        return found

    def place(self, prepared: Prepared, packed: bytes) -> None:
        """Writes a prepared chunk and its message index."""
        rows, skip, data, crc = prepared
        name = "" if self._compression == "none" else self._compression
        start, end = int(rows.times[0]), int(rows.times[-1])
        builder = RecordBuilder()
        Chunk(name, packed, end, start, crc, len(data)).write(builder)
        index = _message_index(rows, skip)
        with self._lock:
            self._place_chunk(rows, _built(builder), index, (start, end, len(data), skip, crc, len(packed)))

    def _place_chunk(
        self, rows: Rows, chunk: bytes, index: bytes, facts: tuple[int, int, int, int, int, int]
    ) -> None:
        start, end, size, skip, crc, packed = facts
        name = "" if self._compression == "none" else self._compression
        entry = ChunkIndex(
            chunk_length=len(chunk),
            chunk_start_offset=self.position,
            compression=name,
            compressed_size=packed,
            message_end_time=end,
            message_index_length=len(index),
            message_index_offsets={rows.channel: self.position + len(chunk)},
            message_start_time=start,
            uncompressed_size=size,
        )
        row = (self.position, len(chunk), size, rows.first, len(rows.offsets), skip, crc, rows.channel)
        self.write(chunk + index)
        self.note_chunk(entry, (*row, COMPRESSIONS.index(self._compression), 0))

    def note_chunk(self, index: ChunkIndex, row: tuple[int, ...]) -> None:
        """Remembers a chunk that is in the file, for the summary and the episode index."""
        builder = RecordBuilder()
        index.write(builder)
        self.chunk_indexes.append(_built(builder))
        self.chunk_rows += np.array(row, CHUNK_ROWS).tobytes()
        channel, rows = row[7], row[4]
        self._announced.add(channel)
        self.counts[channel] += rows
        if self.start_time is None or index.message_start_time < self.start_time:
            self.start_time = index.message_start_time
        self.end_time = max(self.end_time, index.message_end_time)

    def finish(self) -> None:
        """DataEnd, summary, footer, magic, in one write."""
        builder = RecordBuilder()
        DataEnd(0).write(builder)
        data_end = _built(builder)
        summary_start = self.position + len(data_end)
        groups: list[tuple[Opcode, list[Any]]] = [
            (Opcode.SCHEMA, list(self.schemas.values())),
            (Opcode.CHANNEL, list(self.channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self.chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, list(self.attachment_indexes)),
            (Opcode.METADATA_INDEX, list(self.metadata_indexes)),
        ]
        offsets = []
        for opcode, records in groups:
            start = builder.count
            for record in records:
                builder.write(record) if isinstance(record, bytes) else record.write(builder)
            if records:
                offsets.append(SummaryOffset(opcode, summary_start + start, builder.count - start))
        offset_start = summary_start + builder.count
        for offset in offsets:
            offset.write(builder)
        summary = _built(builder)
        Footer(summary_start, offset_start, 0).write(builder)
        crc = zlib.crc32(_built(builder)[:-4], zlib.crc32(summary))
        Footer(summary_start, offset_start, crc).write(builder)
        self.write(data_end + summary + _built(builder) + MAGIC)

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


def _message_index(rows: Rows, skip: int) -> bytes:
    """A MessageIndex record, built as one array (the package's own writer takes 1 µs a message)."""
    n = len(rows.offsets)
    entries = np.empty((n, 2), dtype="<u8")
    entries[:, 0] = rows.times
    entries[:, 1] = rows.offsets + np.uint64(skip)
    body = entries.tobytes()
    head = bytearray()
    head += bytes([Opcode.MESSAGE_INDEX]) + (6 + len(body)).to_bytes(8, "little")
    head += rows.channel.to_bytes(2, "little") + len(body).to_bytes(4, "little")
    return bytes(head) + body
