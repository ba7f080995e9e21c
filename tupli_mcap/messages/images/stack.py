"""Stacks of frames: each frame of a sliding window is stored once, here as pixels, in `png` as PNG."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import BODY, MAX_CHUNK
from tupli_mcap.messages.layout import ImageLayout
from tupli_mcap.spaces.leaves import Leaf

_LENGTH = struct.Struct("<Q")  # of a Message record, after its opcode
_HEIGHT_WIDTH = struct.Struct("<II")
_COUNT = struct.Struct("<I")


def new_frames(windows: Array) -> list[int]:
    """How many frames of each row are new: its other frames are the newest ones of the row before.

    All frames of the first row are new. `windows` are the frames of each row, the oldest first: uint8 (rows, frames,
    bytes of a frame).
    """
    k = windows.shape[1]
    new = [k] * len(windows)
    moved = (windows[1:, : k - 1] == windows[:-1, 1:]).all(axis=(1, 2))
    for i in range(1, len(windows)):
        if moved[i - 1]:
            new[i] = 1
            continue
        same = (m for m in range(2, k) if np.array_equal(windows[i, : k - m], windows[i - 1, m:]))
        new[i] = next(same, k)
    return new


class StackCodec:
    """An `ImageCodec` that stores each frame of a sliding window once, as pixels.

    A message holds the new frames of a row, newer ones below older ones. The other frames are the newest ones of the
    row before in the chunk. The first row of a chunk holds all its frames, and so does a row that shares none.
    """

    def __init__(self, leaf: Leaf, layout: ImageLayout) -> None:
        self._dtype = layout.dtype
        self._frames, self._height, width = leaf.stored_shape[:3]
        self._frame_bytes = leaf.size // self._frames
        self._start = layout.dtype.itemsize - leaf.size  # of the pixels in a record
        self._height_at = BODY + layout.body.index(_HEIGHT_WIDTH.pack(self._frames * self._height, width), 8)

    def _windows(self, data: Any, count: int) -> Array:
        """The frames of each row, as bytes: (count, frames, bytes of a frame)."""
        size = self._frame_bytes
        shape, strides = (count, self._frames, size), (self._dtype.itemsize, size, 1)
        return np.ndarray(shape, np.uint8, data, self._start, strides)

    def encode(self, rows: Rows) -> Rows:
        size, count, data = self._dtype.itemsize, len(rows.offsets), memoryview(rows.data).cast("B")
        if len(data) != size * count:
            return rows
        parts: list[Any] = []
        lengths = np.empty(count, np.uint64)
        for i, new in enumerate(new_frames(self._windows(data, count))):
            end = (i + 1) * size
            pixels = new * self._frame_bytes
            head = bytearray(data[i * size : i * size + self._start])
            lengths[i] = len(head) + pixels
            _LENGTH.pack_into(head, 1, len(head) + pixels - 9)
            _COUNT.pack_into(head, self._height_at, new * self._height)
            _COUNT.pack_into(head, self._start - 4, pixels)
            parts += [head, data[end - pixels : end]]
        offsets = np.zeros(count, np.uint64)
        np.cumsum(lengths[:-1], out=offsets[1:])
        return rows._replace(data=b"".join(parts), offsets=offsets)

    def decode(self, data: Any, count: int, where: str) -> Any:
        size, start, frame = self._dtype.itemsize, self._start, self._frame_bytes
        if count * size > MAX_CHUNK:
            raise FormatError(
                f"{where}: expected at most {MAX_CHUNK} bytes of stacked frames, found {count * size}"
            )
        if len(data) == count * size:
            return data
        if len(data) < count * (start + frame):  # before anything is allocated
            raise FormatError(f"{where}: expected {count} stacks of frames, found {len(data)} bytes")
        out = bytearray(count * size)
        source, windows, at = memoryview(data), self._windows(out, count), 0
        for i in range(count):
            if at + start > len(source):
                raise FormatError(f"{where}: expected {count} stacks of frames, found {i}")
            (length,) = _LENGTH.unpack_from(source, at + 1)
            new, rest = divmod(length + 9 - start, frame)
            end = at + start + new * frame
            least = 1 if i else self._frames  # no row comes before the first one
            if rest or not least <= new <= self._frames or end > len(source):
                raise FormatError(
                    f"{where}: row {i} expected 1 to {self._frames} frames, found {length} bytes"
                )
            head = memoryview(out)[i * size : i * size + start]
            head[:] = source[at : at + start]
            told = _COUNT.unpack_from(head, self._height_at)[0], _COUNT.unpack_from(head, start - 4)[0]
            if told != (new * self._height, new * frame):
                raise FormatError(
                    f"{where}: row {i} expected a picture of {new} frames, found one of height {told[0]}"
                )
            _LENGTH.pack_into(head, 1, size - 9)
            _COUNT.pack_into(head, self._height_at, self._frames * self._height)
            _COUNT.pack_into(head, start - 4, self._frames * frame)
            if new < self._frames:
                windows[i, : self._frames - new] = windows[i - 1, new:]
            windows[i, self._frames - new :] = np.frombuffer(source[at + start : end], np.uint8).reshape(
                new, frame
            )
            at = end
        if at != len(source):
            raise FormatError(
                f"{where}: expected {count} stacks of frames in {at} bytes, found {len(source)} bytes"
            )
        return out
