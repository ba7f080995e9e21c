"""The floor under reading: zstd-decompress every chunk of `/step` and copy the fields out with NumPy strides.

Written from the file alone (MCAP's specification and the ROS 2 message text), sharing no code with the
library, checking nothing: what any reader of these chunks has to do at the least.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.reader import make_reader
from numpy.typing import NDArray

MESSAGE_HEADER = 9 + 22  # opcode and length; channel, sequence, log time, publish time
CDR_HEADER = 4
PRIMITIVES = {
    "bool": "?",
    "uint8": "u1",
    "int8": "i1",
    "uint16": "<u2",
    "int16": "<i2",
    "uint32": "<u4",
    "int32": "<i4",
    "uint64": "<u8",
    "int64": "<i8",
    "float32": "<f4",
    "float64": "<f8",
}


@dataclass(frozen=True)
class Chunks:
    """Where the compressed rows are: (file offset, compressed size, uncompressed size, first row, rows)."""

    path: Path
    row: np.dtype[Any]
    places: list[tuple[int, int, int, int, int]]
    rows: int


def row_dtype(schema: str, record_size: int) -> np.dtype[Any]:
    """The dtype of one Message record of `record_size` bytes whose body is CDR of primitive fields."""
    names, formats, offsets, at = [], [], [], 0
    for line in re.sub(r"#.*", "", schema).split("\n"):
        if match := re.match(r"\s*(\w+)(?:\[(\d+)\])?\s+(\w+)\s*$", line):
            kind, count, name = match.groups()
            scalar = np.dtype(PRIMITIVES[kind])
            at += -at % scalar.itemsize
            names.append(name)
            formats.append((scalar, (int(count),)) if count else scalar)
            offsets.append(MESSAGE_HEADER + CDR_HEADER + at)
            at += scalar.itemsize * int(count or 1)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": record_size})


def locate(path: Path, topic: str = "/step") -> Chunks:
    """Find the chunks of the topic (untimed: the floor does not count opening)."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        if summary is None:
            raise ValueError(f"{path} has no summary")
        channel = next(c for c in summary.channels.values() if c.topic == topic)
        chunks = sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)
        places, rows, record_size = [], 0, 0
        for chunk in chunks:
            if channel.id not in chunk.message_index_offsets:
                continue
            start = chunk.chunk_start_offset + 9 + 8 + 8 + 8 + 4 + 4 + len(chunk.compression) + 8
            stream.seek(start)
            data = zstandard.ZstdDecompressor().decompress(stream.read(chunk.compressed_size))
            first, record_size = _first_message(data)
            count = (len(data) - first) // record_size
            places.append((start, chunk.compressed_size, len(data), rows, count))
            rows += count
    return Chunks(
        path, row_dtype(summary.schemas[channel.schema_id].data.decode(), record_size), places, rows
    )


def _first_message(data: bytes) -> tuple[int, int]:
    """Offset and size of the first Message record, behind Schema and Channel records if there are any."""
    at = 0
    while True:
        size = 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        if data[at] == 0x05:
            return at, size
        at += size


def read(chunks: Chunks, fields: tuple[str, ...], threads: int) -> list[NDArray[Any]]:
    """The fields of all rows, in fresh arrays."""
    kinds = [chunks.row[name] for name in fields]
    columns = [np.empty((chunks.rows, *kind.shape), kind.base) for kind in kinds]
    with chunks.path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as file:
        view = memoryview(file)

        def copy(places: Iterator[tuple[int, int, int, int, int]]) -> None:
            decompressor = zstandard.ZstdDecompressor()
            for start, compressed, size, first_row, count in places:
                data = decompressor.decompress(view[start : start + compressed], max_output_size=size)
                rows = np.frombuffer(data, chunks.row, count, size - count * chunks.row.itemsize)
                for column, name in zip(columns, fields, strict=True):
                    column[first_row : first_row + count] = rows[name]

        if threads == 1:
            copy(iter(chunks.places))
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(copy, [iter(chunks.places[n::threads]) for n in range(threads)]))
        view.release()
    return columns
