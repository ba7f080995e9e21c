"""What a chunk holds: decompresses it within bounds, and finds its Message records, as arrays of their headers."""

from __future__ import annotations

import struct
import sys
import threading
from collections import deque
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from tupli_mcap.arrays import Array, DType
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import IN_CHUNKS, index_entries
from tupli_mcap.mcap.records import (
    BODY,
    CHUNK_HEAD,
    HEADER_FIELDS,
    MAX_ROWS_A_BYTE,
    RECORD,
    iter_records,
    message_index,
    parse_record,
)

_MOST_DEFINITIONS = 2 << 16  # in a chunk: ids of schemas and of channels have 16 bits
MAX_RATIO = {"": 1, "lz4": 255, "zstd": 1 << 15}
"""Uncompressed bytes for each compressed one, at most: LZ4 counts a match in bytes of 255, and a block of zstd takes at
least 4 bytes and holds at most 128 KiB. Zeros come close to both."""

_LENGTH = struct.Struct("<Q")  # of a record, after its opcode
_BLOCK = 1 << 16  # headers that are copied at once
_NAMES, _KINDS, _OFFSETS = map(list, zip(*HEADER_FIELDS, strict=True))
_HEADER: DType = np.dtype({"names": _NAMES, "formats": _KINDS, "offsets": _OFFSETS, "itemsize": BODY})
HEADERS: DType = np.dtype([*zip(_NAMES, _KINDS, strict=True), ("#offset", "<u8")])
_local = threading.local()


def _decompressor() -> zstandard.ZstdDecompressor:
    if not hasattr(_local, "zstd"):
        _local.zstd = zstandard.ZstdDecompressor()
    found: zstandard.ZstdDecompressor = _local.zstd
    return found


def decompress(name: str, data: memoryview, size: int, where: str) -> Any:
    """Decompresses one frame to `size` bytes; whatever the frame holds, at most a byte more is produced. FormatError if
    the frame is damaged, has another size, or bytes follow it, which other readers would read."""
    if size > len(data) * MAX_RATIO.get(name, size):
        raise FormatError(
            f"{where}: {len(data)} compressed bytes cannot hold the {size} bytes that the file declares"
        )
    try:
        if name == "zstd":
            if zstandard.frame_content_size(data) not in (size, zstandard.CONTENTSIZE_UNKNOWN):
                raise FormatError(
                    f"{where}: expected {size} bytes, the zstd frame says {zstandard.frame_content_size(data)}"
                )
            found: Any = _decompressor().decompress(data, max_output_size=size, allow_extra_data=False)
        elif name == "lz4":
            frame = lz4.frame.LZ4FrameDecompressor()
            found = frame.decompress(bytes(data), max_length=size + 1)
            if frame.unused_data:
                raise FormatError(
                    f"{where}: expected one lz4 frame, found {len(frame.unused_data)} bytes behind it"
                )
            if len(found) == size and not frame.eof:
                raise FormatError(f"{where}: expected the end of the lz4 frame, found more of it")
        elif name == "":
            found = data
        else:
            raise FormatError(f"{where}: expected compression zstd, lz4 or none, found {name[:20]!r}")
    except (zstandard.ZstdError, RuntimeError) as err:
        raise FormatError(f"{where}: the compressed data is damaged: {err}") from err
    if len(found) != size:
        raise FormatError(f"{where}: expected {size} bytes after decompression, found {len(found)}")
    return found


class ChunkClaim(NamedTuple):
    """The claim of an index, or of the chunk's header: `length` bytes in the file hold `size` bytes of records."""

    length: int
    size: int
    compression: str
    crc: int  # 0: not said

    @property
    def packed(self) -> int:
        """Bytes of compressed data."""
        return self.length - CHUNK_HEAD.size - len(self.compression) - 8


class Chunk(NamedTuple):
    """A chunk whose claim is right, its times (ns), and its decompressed records, `data`, whose CRC was checked if the
    claim has one."""

    start_time: int
    end_time: int
    claim: ChunkClaim
    data: memoryview


class ChunkRecords(NamedTuple):
    """The definitions a chunk starts with (`skip` bytes), and the headers of its messages (`HEADERS`; offsets from
    the first message)."""

    skip: int
    schemas: list[Schema]
    channels: list[Channel]
    headers: Array

    @property
    def channel(self) -> int:
        """The channel of all messages."""
        return int(self.headers["#channel"][0])

    def is_indexed_by(self, body: memoryview) -> bool:
        """Whether the body of a MessageIndex record is the one that the chunk must have."""
        channel, entries = message_index(body)
        wanted = index_entries(self.headers["#log_time"], self.headers["#offset"], self.skip)
        return channel == self.channel and np.array_equal(entries, wanted)

    @property
    def first(self) -> int:
        """The row number of the first message."""
        return int(self.headers["#sequence"][0])

    @property
    def spans(self) -> Array:
        """Where the message records are in the chunk: uint32 (spans, 2), begins and ends; they fill each span."""
        begins = self.headers["#offset"] + self.skip
        ends = begins + self.headers["#length"] + 9
        gaps = begins[1:] != ends[:-1]
        first, last = np.append(True, gaps), np.append(gaps, True)
        return np.stack([begins[first], ends[last]], axis=1).astype(np.uint32)

    def row(self, offset: int, claim: ChunkClaim) -> tuple[int, ...]:
        """The row in the episode index, as CHUNK_ROWS, of the chunk at `offset`."""
        compression = IN_CHUNKS.index(claim.compression)
        counts = self.first, len(self.headers), self.skip
        return offset, claim.length, claim.size, *counts, claim.crc, self.channel, compression, 0


def chunk_records(data: memoryview, where: str, packed: int) -> ChunkRecords:
    """The records of a recording's chunk, whose compressed data has `packed` bytes; FormatError if the chunk is not
    definitions followed by messages of one channel in the order of their rows."""
    found = records_by_channel(data, where, packed)
    if len(found) > 1:
        raise FormatError(f"{where}: expected messages of one channel in it")
    return found[0]


def records_by_channel(data: memoryview, where: str, packed: int) -> list[ChunkRecords]:
    """The records of each channel in a chunk: definitions, then messages. Another program may have written it; then
    `definitions_first` has put it into this order. FormatError if it holds something else, or a channel's rows are not
    consecutive."""
    skip = 0
    schemas: list[Schema] = []
    channels: list[Channel] = []
    while skip + 9 <= len(data) and data[skip] in (Opcode.SCHEMA, Opcode.CHANNEL):
        if len(schemas) + len(channels) >= _MOST_DEFINITIONS:
            raise FormatError(f"{where}: expected at most {_MOST_DEFINITIONS} definitions in it")
        opcode, length = RECORD.unpack_from(data, skip)
        if length > len(data) - skip - 9:
            raise FormatError(f"{where}: a record in it claims {length} bytes")
        record = parse_record(opcode, data[skip + 9 : skip + 9 + length], skip, where)
        schemas.append(record) if opcode == Opcode.SCHEMA else channels.append(record)
        skip += 9 + length
    try:
        headers = message_headers(data[skip:], MAX_ROWS_A_BYTE * packed)
    except FormatError as err:
        raise FormatError(f"{where}: {err}") from err
    if not len(headers):
        raise FormatError(f"{where}: expected messages in it, found none")
    if (headers["#channel"] != headers["#channel"][0]).any():
        headers = headers[np.argsort(headers["#channel"], kind="stable")]
    numbers, rows = headers["#channel"], headers["#sequence"].astype(np.int64)
    is_other = numbers[1:] != numbers[:-1]
    if (~is_other & (rows[1:] != rows[:-1] + 1)).any():
        raise FormatError(f"{where}: expected consecutive rows in it")
    parts = np.split(headers, np.flatnonzero(is_other) + 1)
    return [ChunkRecords(skip, schemas, channels, part) for part in parts]


def definitions_first(data: memoryview, packed: int) -> memoryview:
    """The records of a chunk in the order in which recordings have them: another program defines a channel where its
    first message comes. More records than a chunk can have stay as they are."""
    definitions: list[memoryview] = []
    messages: list[memoryview] = []
    at = kept = 0
    for _ in range(MAX_ROWS_A_BYTE * packed):
        if at + RECORD.size > len(data) or len(definitions) > _MOST_DEFINITIONS:
            break
        opcode, length = RECORD.unpack_from(data, at)
        end = at + RECORD.size + length
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            messages.append(data[kept:at])
            definitions.append(data[at:end])
            kept = end
        elif opcode != Opcode.MESSAGE or end - at < BODY:
            break
        at = end
    return memoryview(b"".join([*definitions, *messages, data[kept:]]))


def message_headers(data: memoryview, most: int = sys.maxsize) -> Array:
    """The headers of consecutive Message records, as HEADERS; FormatError if `data` is something else, or holds more
    than `most` messages."""
    offsets = message_places(data, most)[:, 0]
    found = np.empty(len(offsets), HEADERS)
    for begin in range(0, len(offsets), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        heads = headers_at(data)[offsets[part]]
        for name, _, _ in HEADER_FIELDS:
            found[name][part] = heads[name]
    found["#offset"] = offsets
    return found


def headers_at(data: Any) -> Array:
    """The header that a Message record would have at each offset of `data`: a view."""
    return np.ndarray(max(0, len(data) - BODY + 1), _HEADER, data, 0, (1,))


def message_places(data: Any, most: int = sys.maxsize) -> Array:
    """Where consecutive Message records begin and end: int64 (records, 2). FormatError as `message_headers`."""
    starts: Any = []
    at, end, length_at = 0, len(data), _LENGTH.unpack_from
    size = 9 + length_at(data, 1)[0] if end >= BODY else 0
    fits = size >= BODY and end % size == 0 and end // size <= most
    if fits and (np.ndarray(end // size, "<u8", data, 1, (size,)) == size - 9).all():  # all of one size
        starts, at = np.arange(0, end, size), end
    while at + BODY <= end and len(starts) <= most:
        starts.append(at)
        at += 9 + length_at(data, at + 1)[0]
    if len(starts) > most:
        raise FormatError(f"expected at most {most} messages, found more")
    places = np.empty((len(starts), 2), np.int64)
    # the last one may claim more bytes than an integer of NumPy can say
    places[:, 0], places[:-1, 1], places[-1:, 1] = starts, starts[1:], min(at, end)
    opcodes = np.frombuffer(data, np.uint8)[places[:, 0]]
    if at != end or (opcodes != Opcode.MESSAGE).any() or (places[:, 1] - places[:, 0] < BODY).any():
        deque(iter_records(data), 0)  # raises, and names the wrong record
    return places
