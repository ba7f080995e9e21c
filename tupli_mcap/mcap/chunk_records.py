"""The Message records of a chunk as arrays: their offsets and headers."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import COMPRESSIONS
from tupli_mcap.mcap.records import BODY, HEADER_FIELDS, MAX_ROWS_A_BYTE, RECORD, iter_records, parse_record
from tupli_mcap.mcap.walk import Chunk

_LENGTH = struct.Struct("<Q")  # of a record, after its opcode
_BLOCK = 1 << 16  # headers that are copied at once
HEADERS = np.dtype([(name, kind) for name, kind, _ in HEADER_FIELDS] + [("#offset", "<u8")])


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

    def index_entries(self) -> Array:
        """The entries that the chunk's MessageIndex must have: log_time and offset, uint64 (messages, 2)."""
        entries = np.empty((len(self.headers), 2), "<u8")
        entries[:, 0] = self.headers["#log_time"]
        entries[:, 1] = self.headers["#offset"] + np.uint64(self.skip)
        return entries

    @property
    def first(self) -> int:
        """The row number of the first message."""
        return int(self.headers["#sequence"][0])

    def row(self, offset: int, length: int, chunk: Chunk) -> tuple[int, ...]:
        """The chunk's row in the episode index, as CHUNK_ROWS: its record is `length` bytes long, at `offset`."""
        compression = COMPRESSIONS.index(chunk.compression or "none")
        counts = self.first, len(self.headers), self.skip
        return offset, length, len(chunk.data), *counts, chunk.crc, self.channel, compression, 0


def chunk_records(data: memoryview, where: str, packed: int) -> ChunkRecords:
    """The records of a recording's chunk, whose compressed data has `packed` bytes.

    Raises:
        FormatError: the chunk is not definitions followed by messages of one channel in the order of their rows.
    """
    skip, schemas, channels = 0, [], []
    while skip + 9 <= len(data) and data[skip] in (Opcode.SCHEMA, Opcode.CHANNEL):
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
        raise FormatError(f"{where}: expected messages of one channel in it")
    if (headers["#sequence"] != int(headers["#sequence"][0]) + np.arange(len(headers))).any():
        raise FormatError(f"{where}: expected consecutive rows in it")
    return ChunkRecords(skip, schemas, channels, headers)


def message_headers(data: memoryview, most: int | None = None) -> Array:
    """The headers of consecutive Message records, as HEADERS.

    Raises:
        FormatError: `data` is something else, or holds more than `most` messages.
    """
    even = _even(data, most)
    if even is not None:
        return even
    offsets = message_places(data, most)[:, 0]
    found = np.empty(len(offsets), HEADERS)
    for begin in range(0, len(offsets), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        heads = np.ndarray(max(0, len(data) - BODY + 1), _packed(BODY), data, 0, (1,))[offsets[part]]
        for name, _, _ in HEADER_FIELDS:
            found[name][part] = heads[name]
    found["#offset"] = offsets
    return found


def message_places(data: Any, most: int | None) -> Array:
    """Where consecutive Message records begin and end: int64 (records, 2). Raises as `message_headers` does."""
    starts, at, size, length_at = [], 0, len(data), _LENGTH.unpack_from
    for _ in itertools.count() if most is None else range(most):
        if at + BODY > size:
            break
        starts.append(at)
        at += 9 + length_at(data, at + 1)[0]
    else:
        if at + BODY <= size:
            raise _too_many(most)
    if at == size:
        places = np.array([starts, [*starts[1:], at][: len(starts)]], np.int64).T
        opcodes = np.frombuffer(data, np.uint8)[places[:, 0]]
        if (opcodes == Opcode.MESSAGE).all() and (places[:, 1] - places[:, 0] >= BODY).all():
            return places
    return np.array(
        [place[:2] for place in iter_records(data)], np.int64
    )  # raises, and names the wrong record


def messages(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """(log_time, CDR body) of consecutive Message records.

    Raises:
        FormatError: `data` is something else. It is raised before the first message.
    """
    headers = message_headers(data)
    for begin in range(0, len(headers), _BLOCK):
        part = headers[begin : begin + _BLOCK]
        columns = (part[name].tolist() for name in ("#log_time", "#offset", "#length"))
        for log_time, start, length in zip(*columns, strict=True):
            yield log_time, data[start + BODY : start + 9 + length]


def _too_many(most: int | None) -> FormatError:
    return FormatError(f"expected at most {most} messages, found more")


def _packed(size: int) -> np.dtype[Any]:
    """The dtype of records of `size` bytes each, whose fields are those of the header."""
    spec: Any = {
        "names": [name for name, _, _ in HEADER_FIELDS],
        "formats": [kind for _, kind, _ in HEADER_FIELDS],
        "offsets": [at for _, _, at in HEADER_FIELDS],
        "itemsize": size,
    }
    dtype: np.dtype[Any] = np.dtype(spec)
    return dtype


def _even(data: memoryview, most: int | None) -> Array | None:
    """The headers if all records have the same size, else None."""
    if len(data) < BODY:
        return None
    size = 9 + int.from_bytes(data[1:9], "little")
    if size < BODY or len(data) % size:
        return None
    if most is not None and len(data) // size > most:
        raise _too_many(most)
    rows = np.frombuffer(data, _packed(size))
    if (rows["#opcode"] != Opcode.MESSAGE).any() or (rows["#length"] != size - 9).any():
        return None
    found = np.empty(len(rows), HEADERS)
    for name, _, _ in HEADER_FIELDS:
        found[name] = rows[name]
    found["#offset"] = np.arange(len(rows)) * size
    return found
