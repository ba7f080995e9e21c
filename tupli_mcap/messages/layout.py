"""Byte layouts: derives ros2msg text, CDR offsets and the NumPy dtype of a whole Message record from leaves.

CDR aligns every primitive to its size, counted from the byte after the 4-byte encapsulation header. A message whose
fields all have constant size therefore has constant offsets, and a chunk of such messages is one structured array.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from tupli_mcap.arrays import DType
from tupli_mcap.mcap.records import BODY, CDR_HEADER, HEADER_FIELDS, RECORD_HEADER
from tupli_mcap.messages import cdr
from tupli_mcap.spaces.leaves import Leaf

SEQUENCE_OFFSET = 11  # offset of `sequence` in a Message record; log_time follows it
PREFIX = BODY + 8  # bytes of a step's record before its state; until its commit, the same for a whole episode
# Of an episode, and of its step or its sub-environment: messages begin with them.
NUMBERS = struct.Struct("<II")
STAMP = struct.Struct("<iI")  # seconds and nanoseconds
_TIME_MSG = "int32 sec\nuint32 nanosec\n"
SEPARATOR = "=" * 80 + "\n"  # before a nested message in a ros2msg text
IMAGE_NAME = "sensor_msgs/msg/Image"
IMAGE_SCHEMA = (
    "std_msgs/Header header\nuint32 height\nuint32 width\n"
    "string encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
    f"{SEPARATOR}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{SEPARATOR}MSG: builtin_interfaces/Time\n{_TIME_MSG}"
)


def renumbered(body: bytes | memoryview, episode: int, second: int) -> bytes:
    """The body of a message that begins with `NUMBERS`, with other numbers."""
    return NUMBERS.pack(episode, second) + body[NUMBERS.size :]


class Field(NamedTuple):
    """A field of constant size: its NumPy dtype, and its offset from the start of the CDR body."""

    name: str
    dtype: DType
    shape: tuple[int, ...]
    offset: int

    @property
    def nbytes(self) -> int:
        return self.dtype.itemsize * math.prod(self.shape)


@dataclass(frozen=True)
class MessageLayout:
    """A message of constant size: its fields, the size of its CDR body, and the dtype of one whole record."""

    fields: tuple[Field, ...]
    body_size: int
    dtype: DType

    @classmethod
    def of(cls, fields: Iterable[tuple[str, DType, tuple[int, ...]]]) -> MessageLayout:
        """Lays the fields out in order, each aligned to the size of its element."""
        placed, offset = [], 0
        for name, dtype, shape in fields:
            if 0 in shape:  # takes no bytes and has no ROS field
                continue
            offset = -(-offset // dtype.itemsize) * dtype.itemsize
            field = Field(name, dtype, shape, offset)
            placed.append(field)
            offset += field.nbytes
        return cls(tuple(placed), offset, record_dtype(placed, offset))

    @property
    def record_size(self) -> int:
        """Bytes of one whole Message record."""
        return BODY + self.body_size

    def offset(self, name: str) -> int:
        """The offset of a field from the start of the CDR body."""
        return next(f.offset for f in self.fields if f.name == name)

    def header(self, channel: int, sequence: int = 0) -> bytes:
        """The record's bytes before the CDR body, without times."""
        return RECORD_HEADER.pack(Opcode.MESSAGE, self.record_size - 9, channel, sequence, 0, 0) + CDR_HEADER


def record_dtype(fields: Sequence[Field], body_size: int) -> DType:
    """Structured dtype of a Message record: `#`-prefixed header fields, then the message's own."""
    names = [name for name, _, _ in HEADER_FIELDS] + [f.name for f in fields]
    formats: list[Any] = [fmt for _, fmt, _ in HEADER_FIELDS]
    formats += [(f.dtype.newbyteorder("<"), f.shape) for f in fields]
    offsets = [offset for _, _, offset in HEADER_FIELDS] + [BODY + f.offset for f in fields]
    spec: Any = {"names": names, "formats": formats, "offsets": offsets, "itemsize": BODY + body_size}
    dtype: DType = np.dtype(spec)
    return dtype


class ImageLayout(NamedTuple):
    """`sensor_msgs/msg/Image` with every length fixed: the record dtype and the bytes that never change."""

    dtype: DType
    body: bytes


def image_layout(leaf: Leaf) -> ImageLayout:
    """The layout of an image leaf's messages; field `data` has its stored shape, `sec`/`nanosec` its stamp."""
    shape = leaf.stored_shape
    frames = shape[0] if leaf.kind == "stack" else 1  # newer frames are below older ones
    height, width, channels = (*shape[1:], 1)[:3] if leaf.kind == "stack" else shape
    height *= frames
    body = bytearray(8)
    cdr.write_string(body, 0, leaf.name)
    cdr.write_length(body, 0, height)
    cdr.write_length(body, 0, width)
    cdr.write_string(body, 0, {1: "mono8", 3: "rgb8", 4: "rgba8"}[channels])
    body += b"\0"  # is_bigendian
    cdr.write_length(body, 0, width * channels)
    cdr.write_length(body, 0, leaf.size)
    u1 = np.dtype(np.uint8)
    fields = [
        Field("sec", np.dtype(np.int32), (), 0),
        Field("nanosec", np.dtype(np.uint32), (), 4),
        Field("fixed", u1, (len(body) - 8,), 8),
        Field("data", u1, shape, len(body)),
    ]
    return ImageLayout(record_dtype(fields, len(body) + leaf.size), bytes(body))
