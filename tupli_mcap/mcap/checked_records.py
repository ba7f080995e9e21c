"""Records that MCAP readers take on trust, checked: message indexes and attachments."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from mcap.records import AttachmentIndex

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.source import Source

__all__ = ["attachment_index", "checked_attachment", "message_index"]

_ATTACHMENT_HEAD = struct.Struct("<QQI")  # log_time, create_time, length of the name
_PIECE = 1 << 20
_MOST_TEXT = 1 << 17  # bytes of name and media type


def message_index(body: memoryview) -> tuple[int, np.ndarray[Any, np.dtype[np.uint64]]]:
    """The channel and the entries (log_time, offset) of a MessageIndex record.

    Raises:
        FormatError: its sizes do not add up.
    """
    channel, size = int.from_bytes(body[:2], "little"), int.from_bytes(body[2:6], "little")
    if len(body) != 6 + size or size % 16:
        raise FormatError(f"expected a message index of {len(body) - 6} bytes, it says {size}")
    return channel, np.frombuffer(body[6:], "<u8").reshape(-1, 2)


def checked_attachment(source: Source, offset: int, length: int) -> AttachmentIndex:
    """The facts of the attachment at `offset`, whose body has `length` bytes; its CRC is checked in pieces.

    Raises:
        FormatError: it is damaged.
    """
    found = attachment_index(source, offset, length)
    crc, position, end = 0, offset + 9, offset + 9 + length - 4
    expected = int.from_bytes(source.read(end, 4), "little")
    while position < end:
        piece = source.read(position, min(_PIECE, end - position))
        crc = zlib.crc32(piece, crc)
        position += len(piece)
    if crc != expected:
        raise FormatError(f"the attachment {found.name!r:.80} is damaged (its CRC differs)")
    return found


def attachment_index(source: Source, offset: int, length: int) -> AttachmentIndex:
    """What an attachment's header says; FormatError if it does not add up to its length.

    The sizes are read before the texts: where many places look like an attachment, each takes a few bytes.
    """
    start, left = offset + 9, length - _ATTACHMENT_HEAD.size - 4 - 8 - 4  # for the texts and the data
    if left < 0:
        raise FormatError("the attachment's header is damaged")
    log_time, create_time, name_size = _ATTACHMENT_HEAD.unpack(source.read(start, _ATTACHMENT_HEAD.size))
    if name_size > min(left, _MOST_TEXT):
        raise FormatError("the attachment's sizes do not add up")
    at = start + _ATTACHMENT_HEAD.size + name_size
    type_size = int.from_bytes(source.read(at, 4), "little")
    if name_size + type_size > min(left, _MOST_TEXT):
        raise FormatError("the attachment's sizes do not add up")
    data_size = int.from_bytes(source.read(at + 4 + type_size, 8), "little")
    if name_size + type_size + data_size != left:
        raise FormatError("the attachment's sizes do not add up")
    try:
        name = bytes(source.read(at - name_size, name_size)).decode()
        media_type = bytes(source.read(at + 4, type_size)).decode()
    except UnicodeDecodeError as err:
        raise FormatError("the attachment's header is damaged") from err
    return AttachmentIndex(offset, 9 + length, log_time, create_time, data_size, name, media_type)
