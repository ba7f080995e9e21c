"""Rendered frames: a row of `/camera/<name>` holds a picture, the same row of `/frame/<name>` says what it shows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tupli_mcap.errors import FormatError
from tupli_mcap.messages import cdr
from tupli_mcap.messages.layout import IMAGE_SCHEMA, NUMBERS, STAMP, MessageLayout

CAMERA_NAME = "sensor_msgs/msg/CompressedImage"
CAMERA_SCHEMA = (
    "std_msgs/Header header\nstring format\nuint8[] data\n" + IMAGE_SCHEMA[IMAGE_SCHEMA.index("=") :]
)
FRAME_NAME = "tupli_mcap/msg/Frame"
FRAME_SCHEMA = "uint32 episode\nuint32 step\n"
FRAME_LAYOUT = MessageLayout.of([("episode", np.dtype(np.uint32), ()), ("step", np.dtype(np.uint32), ())])
"""A row of `/frame/<name>`."""


class EncodedFrame(NamedTuple):
    """A picture as it is stored: `form` is "png" or "jpeg", `time_ns` the time when it was rendered."""

    time_ns: int
    form: str
    data: bytes


def encode_frame(camera: str, frame: EncodedFrame) -> bytes:
    """The CDR body of a `sensor_msgs/msg/CompressedImage`."""
    out = bytearray(STAMP.pack(*divmod(frame.time_ns, 10**9)))
    cdr.write_string(out, 0, camera)
    cdr.write_string(out, 0, frame.form)
    cdr.write_length(out, 0, len(frame.data))
    return bytes(out) + frame.data


def decode_frame(body: memoryview) -> tuple[EncodedFrame, str]:
    """The picture in a `sensor_msgs/msg/CompressedImage`, and its `frame_id`; raises FormatError if lengths do not add
    up to the message."""
    if len(body) < STAMP.size:
        raise FormatError(f"expected a compressed image, found {len(body)} bytes")
    sec, nanosec = STAMP.unpack_from(body)
    frame_id, at = cdr.read_string(body, STAMP.size, 0)
    form, at = cdr.read_string(body, at, 0)
    size, at = cdr.read_length(body, at, 0)
    if at + size != len(body):
        raise FormatError(f"expected the bytes of a picture from byte {at} to the end of a message")
    return EncodedFrame(sec * 10**9 + nanosec, form, bytes(body[at:])), frame_id


def encode_pair(episode: int, step: int) -> bytes:
    """The CDR body of a `tupli_mcap/msg/Frame`."""
    return NUMBERS.pack(episode, step)
