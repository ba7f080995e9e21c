"""Codecs of images in chunks; in the journal and in memory, images are rows of constant size.

A codec works on whole chunks: the writer encodes a chunk before it is compressed, `ChunkStore` decodes it before it
returns rows. The channel's metadata name the codec.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from mcap.records import Channel

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import Encoder, Rows
from tupli_mcap.mcap.records import BODY, CDR_HEADER, MAX_CHUNK, RECORD_HEADER, iter_records
from tupli_mcap.messages.frames import EncodedFrame, decode_frame, encode_frame
from tupli_mcap.messages.images.pictures import decode_pixels, encode_pixels
from tupli_mcap.messages.layout import STAMP, ImageLayout
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import parse
from tupli_mcap.spaces.leaves import Leaf

CODEC = "codec"  # key of the metadata of an image channel
_LENGTH = struct.Struct("<Q")  # of a Message record, after its opcode
_HEIGHT_WIDTH = struct.Struct("<II")
_COUNT = struct.Struct("<I")


class ImageCodec(Encoder, Protocol):
    """Encodes and decodes the chunks of one image channel; rows that are encoded already (a killed writer's) stay as
    they are. Thread-safe."""

    def decode(self, data: Any, count: int) -> Any:
        """The `count` rows of constant size of a chunk; raises FormatError if `data` does not hold them."""
        ...


def image_codecs(layout: StepLayout, channels: Mapping[int, Channel]) -> dict[int, ImageCodec]:
    """The codecs of the channels that have one, by channel id; raises FormatError if a channel names a codec that this
    version does not know."""
    codecs: dict[int, ImageCodec] = {}
    leaves = {leaf.name: leaf for leaf in layout.images}
    for number, channel in channels.items():
        leaf = leaves.get(channel.metadata.get("leaf", ""))
        if leaf is None:
            continue
        topic = parse(channel.topic)
        if topic is None or topic.kind != "image":
            continue
        codec = _codec(channel, leaf, layout.image_messages[leaf.name])
        if codec is not None:
            codecs[number] = codec
    return codecs


def _codec(channel: Channel, leaf: Leaf, layout: ImageLayout) -> ImageCodec | None:
    """The codec that a channel names; None if its images are stored as they are."""
    name = channel.metadata.get(CODEC)
    if name is None:
        return StackCodec(leaf, layout) if leaf.kind == "stack" else None
    if name == "png":
        return PngCodec(leaf, layout)
    raise FormatError(
        f"{channel.topic}: expected the codec 'png' or none, found {name!r:.40}; update tupli-mcap"
    )


def png_leaves(channels: Mapping[int, Channel]) -> frozenset[str]:
    """The names of the leaves whose images are PNG in a recording with these channels."""
    return frozenset(
        channel.metadata.get("leaf", "")
        for channel in channels.values()
        if channel.metadata.get(CODEC) == "png"
    )


def uses_codecs(channels: Mapping[int, Channel]) -> bool:
    """True if a recording with these channels has format version 2."""
    return any("stacks" in channel.metadata or CODEC in channel.metadata for channel in channels.values())


# ---- stacks of frames: each frame of a sliding window is stored once, here as pixels


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

    def decode(self, data: Any, count: int) -> Any:
        size, start, frame = self._dtype.itemsize, self._start, self._frame_bytes
        if count * size > MAX_CHUNK:
            raise FormatError(f"expected at most {MAX_CHUNK} bytes of stacked frames, found {count * size}")
        if len(data) == count * size:
            return data
        if len(data) < count * (start + frame):  # before anything is allocated
            raise FormatError(f"expected {count} stacks of frames, found {len(data)} bytes")
        out = bytearray(count * size)
        source, windows, at = memoryview(data), self._windows(out, count), 0
        for i in range(count):
            if at + start > len(source):
                raise FormatError(f"expected {count} stacks of frames, found {i}")
            (length,) = _LENGTH.unpack_from(source, at + 1)
            new, rest = divmod(length + 9 - start, frame)
            end = at + start + new * frame
            least = 1 if i else self._frames  # no row comes before the first one
            if rest or not least <= new <= self._frames or end > len(source):
                raise FormatError(f"row {i} expected 1 to {self._frames} frames, found {length} bytes")
            head = memoryview(out)[i * size : i * size + start]
            head[:] = source[at : at + start]
            told = _COUNT.unpack_from(head, self._height_at)[0], _COUNT.unpack_from(head, start - 4)[0]
            if told != (new * self._height, new * frame):
                raise FormatError(
                    f"row {i} expected a picture of {new} frames, found one of height {told[0]}"
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
            raise FormatError(f"expected {count} stacks of frames in {at} bytes, found {len(source)} bytes")
        return out


# ---- PNG, in `sensor_msgs/msg/CompressedImage`, which viewers show; every pixel is exact


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
            stamp = STAMP.pack(int(row["sec"]), int(row["nanosec"]))
            png = encode_pixels(window[-new:].reshape(new * self._height, self._width, self._channels))
            body = stamp + encode_frame(self._leaf.name, EncodedFrame(0, "png", png))[STAMP.size :]
            times = int(row["#log_time"]), int(row["#publish_time"])
            head = RECORD_HEADER.pack(5, BODY - 9 + len(body), rows.channel, int(row["#sequence"]), *times)
            records.append(head + CDR_HEADER + body)
        offsets = np.zeros(count, np.uint64)
        np.cumsum([len(record) for record in records[:-1]], out=offsets[1:])
        return rows._replace(data=b"".join(records), offsets=offsets)

    def decode(self, data: Any, count: int) -> Any:
        size = count * self._dtype.itemsize
        if size > MAX_CHUNK:
            raise FormatError(f"expected at most {MAX_CHUNK} bytes of images, found {size}")
        if self._is_raw(data, count):
            return data
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
            row["sec"], row["nanosec"] = STAMP.unpack_from(view, start + BODY)
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
