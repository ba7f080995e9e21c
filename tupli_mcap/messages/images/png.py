"""Images as PNG in `sensor_msgs/msg/CompressedImage`, which viewers show; every pixel is exact."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import BODY, CDR_HEADER, MAX_CHUNK, RECORD_HEADER, iter_records
from tupli_mcap.messages.frames import EncodedFrame, decode_frame, encode_frame
from tupli_mcap.messages.images.pictures import decode_pixels, encode_pixels
from tupli_mcap.messages.images.stack import new_frames
from tupli_mcap.messages.layout import ImageLayout
from tupli_mcap.spaces.leaves import Leaf

_STAMP = struct.Struct("<iI")  # kept bit for bit, even if it is no valid time


class PngCodec:
    """An `ImageCodec` that stores each row of an image leaf as a PNG. It needs Pillow.

    Of a stack, it stores the newest frames of a row, as `StackCodec` does; an image is a stack of one frame.
    """

    def __init__(self, leaf: Leaf, layout: ImageLayout) -> None:
        self._leaf = leaf
        self._dtype = layout.dtype
        self._fixed = np.frombuffer(layout.body[8:], np.uint8)
        self._frames, *frame = leaf.stored_shape if leaf.kind == "stack" else (1, *leaf.shape)
        self._height, self._width, self._channels = (*frame, 1)[:3]

    def _is_raw(self, data: Any, count: int) -> bool:
        """Whether `data` is rows of constant size, as a journal holds them."""
        if len(data) != count * self._dtype.itemsize:
            return False
        return bool((np.frombuffer(data, self._dtype)["fixed"] == self._fixed).all())

    def _windows(self, rows: Array) -> Array:
        """The frames of each row, as bytes: (rows, frames, bytes of a frame)."""
        size = self._height * self._width * self._channels
        windows: Array = rows["data"].reshape(len(rows), self._frames, size)
        return windows

    def encode(self, rows: Rows) -> Rows:
        count = len(rows.offsets)
        if not self._is_raw(rows.data, count):
            return rows
        records = []
        images = np.frombuffer(rows.data, self._dtype)
        windows = self._windows(images)
        for row, window, new in zip(images, windows, new_frames(windows), strict=True):
            stamp = _STAMP.pack(int(row["sec"]), int(row["nanosec"]))
            png = encode_pixels(window[-new:].reshape(new * self._height, self._width, self._channels))
            body = stamp + encode_frame(self._leaf.name, EncodedFrame(0, "png", png))[_STAMP.size :]
            times = int(row["#log_time"]), int(row["#publish_time"])
            head = RECORD_HEADER.pack(5, BODY - 9 + len(body), rows.channel, int(row["#sequence"]), *times)
            records.append(head + CDR_HEADER + body)
        offsets = np.zeros(count, np.uint64)
        np.cumsum([len(record) for record in records[:-1]], out=offsets[1:])
        return rows._replace(data=b"".join(records), offsets=offsets)

    def decode(self, data: Any, count: int, where: str) -> Any:
        size = count * self._dtype.itemsize
        if size > MAX_CHUNK:
            raise FormatError(f"{where}: expected at most {MAX_CHUNK} bytes of images, found {size}")
        if self._is_raw(data, count):
            return data
        try:
            return self._decode(data, count)
        except FormatError as err:
            raise FormatError(f"{where}: {err}") from err

    def _decode(self, data: Any, count: int) -> Any:
        out = np.zeros(count, self._dtype)
        out["fixed"] = self._fixed
        view, windows, number = memoryview(data), self._windows(out), 0
        for start, end, channel, sequence, log_time in iter_records(view):
            if number == count:
                raise FormatError(f"expected {count} images, found more")
            row = out[number]
            frame, name = decode_frame(view[start + BODY : end])
            if (name, frame.form) != (self._leaf.name, "png"):
                raise FormatError(
                    f"expected a png of {self._leaf.name!r}, found {frame.form!r:.20} of {name!r:.40}"
                )
            row["#opcode"], row["#length"], row["#channel"] = 5, self._dtype.itemsize - 9, channel
            row["#sequence"], row["#log_time"] = sequence, log_time
            row["#publish_time"] = RECORD_HEADER.unpack_from(view, start)[5]
            row["#cdr"] = int.from_bytes(view[start + BODY - 4 : start + BODY], "little")
            row["sec"], row["nanosec"] = _STAMP.unpack_from(view, start + BODY)
            shape = self._height, self._width, self._channels
            frames = decode_pixels(frame.data, shape, self._frames).reshape(-1, windows.shape[2])
            old = self._frames - len(frames)
            if old and not number:
                raise FormatError(f"expected {self._frames} frames in the first picture, found {len(frames)}")
            if old:
                windows[number, :old] = windows[number - 1, -old:]
            windows[number, old:] = frames
            number += 1
        if number != count:
            raise FormatError(f"expected {count} images, found {number}")
        return out.view(np.uint8)
