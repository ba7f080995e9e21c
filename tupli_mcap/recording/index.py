"""The episode index: the last attachment of a recording, with one fixed-size row for each episode and each chunk.

The metadata texts lie beside the rows and are parsed on access.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
import zstandard

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.compression import MAX_RATIO, decompress
from tupli_mcap.mcap.container import CHUNK_ROWS

INDEX_NAME = "episodes.index"
INDEX_MEDIA_TYPE = "application/x-tupli-mcap-index"
_HEAD = struct.Struct("<8sQQQ")
_MAGIC = b"TMIDX\0\0\1"
_SIZE = struct.Struct("<Q")
_MAX_METADATA = 1 << 26
# Rows differ in the numbers of episodes and the checksums of chunks, and compress far less than this.
_MAX_ROW_RATIO = 256

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
    """Collects rows while recording: 96 bytes for each episode, plus its metadata text."""

    def __init__(self) -> None:
        self.rows = bytearray()
        self.metadata = bytearray()
        self.count = 0

    def add(
        self,
        first_row: int,
        length: int,
        total: float,
        start_time: int,
        end_time: int,
        seed: int | None,
        start_row: int,
        end_row: int,
        final_row: int,
        number: int,
        env: int,
        end: int,
        metadata: str,
    ) -> None:
        """Adds an episode: the fields of an `EpisodeRow`, and its metadata as JSON."""
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

    def extend(self, episodes: np.ndarray[Any, Any]) -> None:
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

    episodes: np.ndarray[Any, Any]
    chunks: np.ndarray[Any, Any]
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
        if length > _MAX_METADATA or start + length > len(self.metadata):
            raise FormatError(f"episode {i}: its metadata lies outside the index ({start} + {length} bytes)")
        try:
            return self.metadata[start : start + length].decode()
        except UnicodeDecodeError as err:
            raise FormatError(f"episode {i}: expected UTF-8 metadata, found {err.reason}") from err
