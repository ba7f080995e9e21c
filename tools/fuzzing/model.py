"""A golden recording taken apart into records, and put together again with every size, offset and CRC right.

A mutator changes a part and the rest follows, so that the checks behind the checksums are reached.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard

from tupli_mcap.arrays import Array
from tupli_mcap.mcap.container import CHUNK_ROWS
from tupli_mcap.mcap.records import MAGIC
from tupli_mcap.recording.index import EPISODE_ROWS, INDEX_NAME

__all__ = [
    "ATTACHMENT",
    "CHUNK",
    "FOOTER",
    "INDEX",
    "FileRecord",
    "Index",
    "Model",
    "Seed",
    "load_seeds",
    "pack",
    "strings",
]

GOLDEN = Path(__file__).parents[2] / "tests" / "golden"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX = 1, 2, 3, 4, 5, 6, 7
ATTACHMENT, METADATA, DATA_END = 9, 12, 15
_RECORD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_INDEX_HEAD = struct.Struct("<8sQQQ")


def record(opcode: int, body: bytes) -> bytes:
    return _RECORD.pack(opcode, len(body)) + body


def split(data: bytes) -> list[tuple[int, int, bytes]]:
    """(opcode, offset, body) of the records in `data`."""
    found, at = [], 0
    while at + 9 <= len(data):
        opcode, length = _RECORD.unpack_from(data, at)
        found.append((opcode, at, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return found


def pack(name: bytes, data: bytes) -> bytes:
    """`data` as the chunk compression `name` has it."""
    if name == b"zstd":
        return zstandard.ZstdCompressor(level=1).compress(data)
    return lz4.frame.compress(data) if name == b"lz4" else data


def unpack(name: bytes, data: bytes, size: int) -> bytes:
    if name == b"zstd":
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    return lz4.frame.decompress(data) if name == b"lz4" else data


@dataclass
class FileRecord:
    """A record of the data section; of a chunk, `inner` are its records and `head` the fields before them."""

    opcode: int
    body: bytes
    inner: list[bytes] = field(default_factory=list)
    compression: bytes = b""
    times: tuple[int, int] = (0, 0)
    size: int | None = None  # what the header claims instead of the right one
    packed: Callable[[bytes], bytes] | None = None  # how to compress instead

    def encode(self) -> bytes:
        if self.opcode == CHUNK:
            data = b"".join(self.inner)
            packed = pack(self.compression, data) if self.packed is None else self.packed(data)
            size = len(data) if self.size is None else self.size
            head = _CHUNK_HEAD.pack(*self.times, size & (2**64 - 1), zlib.crc32(data), len(self.compression))
            return record(CHUNK, head + self.compression + len(packed).to_bytes(8, "little") + packed)
        if self.opcode == ATTACHMENT:
            return record(ATTACHMENT, self.body[:-4] + zlib.crc32(self.body[:-4]).to_bytes(4, "little"))
        return record(self.opcode, self.body)


@dataclass
class Index:
    """The episode index; `claims` replaces the counts of its header, `sizes` those before its parts."""

    episodes: Array
    chunks: Array
    texts: bytes
    claims: dict[int, int] = field(default_factory=dict)
    change_chunks: Callable[[Array], Array] = lambda rows: rows
    compress: Callable[[bytes], bytes] = zstandard.ZstdCompressor(level=1).compress

    @classmethod
    def decode(cls, data: bytes) -> Index:
        _, episodes, chunks, texts = _INDEX_HEAD.unpack_from(data)
        at, parts = _INDEX_HEAD.size, []
        for size in (episodes * EPISODE_ROWS.itemsize, chunks * CHUNK_ROWS.itemsize, texts):
            packed = int.from_bytes(data[at : at + 8], "little")
            parts.append(unpack(b"zstd", data[at + 8 : at + 8 + packed], max(size, 1)))
            at += 8 + packed
        rows = np.frombuffer(parts[0], EPISODE_ROWS).copy()
        return cls(rows, np.frombuffer(parts[1], CHUNK_ROWS).copy(), parts[2])

    def encode(self, table: Array) -> bytes:
        chunks = self.change_chunks(table)
        head = [b"TMIDX\0\0\1", len(self.episodes), len(chunks), len(self.texts)]
        for place, value in self.claims.items():
            head[place] = value & (2**64 - 1)
        out = _INDEX_HEAD.pack(*head)
        for part in (self.episodes.tobytes(), chunks.tobytes(), self.texts):
            packed = self.compress(part)
            out += len(packed).to_bytes(8, "little") + packed
        return out


def strings(*texts: bytes) -> bytes:
    return b"".join(len(text).to_bytes(4, "little") + text for text in texts)


@dataclass
class Model:
    """The parts of a recording up to its index, the index, what follows that, and the summary's other records."""

    parts: list[FileRecord]
    index: Index | None
    summary: list[tuple[int, bytes]]
    index_times: bytes = bytes(16)
    behind: list[FileRecord] = field(default_factory=list)  # attachments and metadata

    @classmethod
    def of(cls, data: bytes) -> Model:
        parts: list[FileRecord] = []
        index, times = None, bytes(16)
        records = split(data[len(MAGIC) :])
        summary: list[tuple[int, bytes]] = []
        ended = False
        for opcode, _, body in records:
            if opcode == DATA_END:
                ended = True
            elif ended:
                if opcode in (SCHEMA, CHANNEL, 11):
                    summary.append((opcode, body))
            elif opcode == CHUNK:
                start, end, size, _, length = _CHUNK_HEAD.unpack_from(body)
                name = body[_CHUNK_HEAD.size : _CHUNK_HEAD.size + length]
                inner = unpack(name, body[_CHUNK_HEAD.size + length + 8 :], size)
                pieces = [record(kind, piece) for kind, _, piece in split(inner)]
                parts.append(FileRecord(CHUNK, b"", pieces, name, (start, end)))
            elif opcode == ATTACHMENT and INDEX_NAME.encode() in body[:64]:
                index, times = Index.decode(_attachment_data(body)), body[:16]
            else:
                parts.append(FileRecord(opcode, body))
        return cls(parts, index, summary, times)

    def chunks(self) -> list[FileRecord]:
        return [part for part in self.parts if part.opcode == CHUNK]

    def encode(self) -> bytes:
        """The file: finished where there is an index."""
        out = bytearray(MAGIC)
        table = None if self.index is None else self.index.chunks.copy()
        attachments, metadata, chunk_indexes = [], [], []
        number = 0
        for part in self.parts:
            at, data = len(out), part.encode()
            out += data
            if part.opcode == CHUNK:
                if table is not None and number < len(table):
                    _place(table[number : number + 1], part, at, data)
                chunk_indexes.append(_chunk_index(part, at, data))
                number += 1
            elif part.opcode == ATTACHMENT:
                attachments.append(_attachment_index(part.body, at, len(data)))
            elif part.opcode == METADATA:
                metadata.append(_metadata_index(part.body, at, len(data)))
        if self.index is None or table is None:
            return bytes(out)
        data = self.index.encode(table)
        name = strings(INDEX_NAME.encode(), b"application/x-tupli-mcap-index")
        body = self.index_times + name + len(data).to_bytes(8, "little") + data
        attachments.append(_attachment_index(body + bytes(4), len(out), len(body) + 13))
        out += record(ATTACHMENT, body + zlib.crc32(body).to_bytes(4, "little"))
        for part in self.behind:
            at, data = len(out), part.encode()
            out += data
            if part.opcode == ATTACHMENT:
                attachments.append(_attachment_index(part.body, at, len(data)))
            else:
                metadata.append(_metadata_index(part.body, at, len(data)))
        out += record(DATA_END, bytes(4))
        start = len(out)
        groups = [*self.summary, *((8, body) for body in chunk_indexes)]
        groups += [*((10, body) for body in attachments), *((13, body) for body in metadata)]
        summary = b"".join(record(opcode, body) for opcode, body in groups)
        return bytes(out) + summary + footer(start, 0, summary)


def footer(start: int, offsets: int, summary: bytes) -> bytes:
    head = _RECORD.pack(FOOTER, 20) + struct.pack("<QQ", start, offsets)
    return head + zlib.crc32(head, zlib.crc32(summary)).to_bytes(4, "little") + MAGIC


def _place(row: Array, part: FileRecord, at: int, data: bytes) -> None:
    inner = b"".join(part.inner)
    row["offset"], row["length"] = at, len(data)
    row["uncompressed"] = (len(inner) if part.size is None else part.size) & (2**64 - 1)
    row["crc"] = zlib.crc32(inner)
    row["rows"] = sum(1 for piece in part.inner if piece[:1] == b"\x05")
    row["skip"] = sum(len(piece) for piece in part.inner if piece[:1] != b"\x05")


def _chunk_index(part: FileRecord, at: int, data: bytes) -> bytes:
    head = struct.pack("<QQQQI", *part.times, at, len(data), 0)
    return head + bytes(8) + strings(part.compression) + struct.pack("<QQ", len(data), len(data))


def _attachment_index(body: bytes, at: int, length: int) -> bytes:
    name_end = 20 + int.from_bytes(body[16:20], "little")
    media_end = name_end + 4 + int.from_bytes(body[name_end : name_end + 4], "little")
    head = struct.pack("<QQ", at, length) + body[:16] + body[media_end : media_end + 8]
    return head + body[16:media_end]


def _metadata_index(body: bytes, at: int, length: int) -> bytes:
    size = int.from_bytes(body[:4], "little")
    return struct.pack("<QQ", at, length) + strings(body[4 : 4 + size])


def _attachment_data(body: bytes) -> bytes:
    at = 20 + int.from_bytes(body[16:20], "little")
    at += 4 + int.from_bytes(body[at : at + 4], "little")
    return body[at + 8 : -4]


@dataclass
class Seed:
    """A golden recording, its journal where it has one, and its records' places."""

    name: str
    data: bytes
    journal: bytes | None

    def model(self) -> Model:
        return Model.of(self.data)


def load_seeds(directory: Path = GOLDEN) -> list[Seed]:
    """The golden recordings, by name; of the unfinished ones a second time without the journal."""
    seeds = []
    for path in sorted(directory.glob("*.mcap")):
        packed = path.with_name(path.name + ".journal.zst")
        journal = zstandard.ZstdDecompressor().decompress(packed.read_bytes()) if packed.exists() else None
        seeds.append(Seed(path.stem, path.read_bytes(), journal))
    return seeds
