"""Bounded decompression: never produces or allocates more than the chunk's header declares."""

from __future__ import annotations

import threading
from typing import Any

import lz4.frame
import zstandard

from tupli_mcap.errors import FormatError

MAX_RATIO = {"": 1, "none": 1, "lz4": 255, "zstd": 1 << 15}
"""Uncompressed bytes for each compressed one, at most: LZ4 counts a match in bytes of 255, and a block of zstd takes at
least 4 bytes and holds at most 128 KiB. Zeros come close to both."""

_local = threading.local()


def _decompressor() -> zstandard.ZstdDecompressor:
    if not hasattr(_local, "zstd"):
        _local.zstd = zstandard.ZstdDecompressor()
    found: zstandard.ZstdDecompressor = _local.zstd
    return found


def decompress(name: str, data: memoryview, size: int, where: str) -> Any:
    """Decompresses one frame to `size` bytes; no more is produced or allocated.

    Raises:
        FormatError: the frame is damaged, has another size, or bytes follow it, which other readers would read.
    """
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
