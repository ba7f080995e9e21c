"""Finds the compressed chunks of a recording that another one can take over unchanged.

A row says which one it is (`sequence`), of which channel and of which episode; so only the first rows of a recording
are those of another one, up to the first that is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from tupli_mcap.journal.derive import even_rows
from tupli_mcap.mcap.compression import decompress
from tupli_mcap.mcap.container import COMPRESSIONS, Container, Prepared, Rows
from tupli_mcap.mcap.records import CHUNK_HEAD
from tupli_mcap.recording.columns.chunk_store import IN_MEMORY, ChunkStore
from tupli_mcap.recording.opened import OpenFile


def first_chunks(
    file: OpenFile,
    container: Container,
    channel: int,
    count: int,
    dtype: np.dtype[Any] | None,
) -> Iterator[tuple[Prepared, bytes]]:
    """The chunks that hold only rows of the first `count` of a channel, and their compressed bytes.

    Each is unpacked, and its CRC checked: no damage is handed on.

    Args:
        container: the target, in which the channel has the same id.
        dtype: of rows of constant size, where they lie so in the chunk; None where they vary.

    Raises:
        FormatError: a chunk is damaged.
    """
    store, end = file.store, 0
    for chunk in store.chunks(channel):
        row = store.table[chunk]
        end += int(row["rows"])
        offset, length, skip = int(row["offset"]), int(row["length"]), int(row["skip"])
        name = COMPRESSIONS[int(row["compression"])]
        if end > count or offset >= IN_MEMORY or name != container.compression:
            return
        data = store.load(chunk, keep=False)
        method = name.replace("none", "")
        packed = file.source.read(offset, length)[CHUNK_HEAD.size + len(method) + 8 :]
        definitions = container.definitions(channel) if int(row["first"]) == 0 else b""
        size = int(row["uncompressed"])
        whole = decompress(method, memoryview(packed), size, store.name) if skip else data
        if skip != len(definitions) or bytes(whole[:skip]) != definitions:
            return
        yield Prepared(_rows(store, chunk, channel, data, dtype), skip, whole, int(row["crc"])), packed


def _rows(store: ChunkStore, chunk: int, channel: int, data: Any, dtype: np.dtype[Any] | None) -> Rows:
    first = int(store.table[chunk]["first"])
    if dtype is not None:
        return even_rows(channel, first, data, store.rows(chunk, dtype, keep=False))
    starts = store.records(chunk)[1][:, 0].tolist()
    times = [int.from_bytes(memoryview(data)[start + 15 : start + 23], "little") for start in starts]
    return Rows(channel, first, data, np.array(starts, np.uint64), np.array(times, np.uint64))
