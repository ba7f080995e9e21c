"""The records of MCAP files that rows are made of: their layout, and how large they may be."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from tupli_mcap.errors import FormatError

__all__ = [
    "BODY",
    "CDR_HEADER",
    "HEADER_FIELDS",
    "MAX_CHUNK",
    "MAX_ROWS_A_BYTE",
    "RECORD_HEADER",
    "iter_records",
]

MAX_CHUNK = 1 << 31  # bytes, uncompressed
MAX_ROWS_A_BYTE = 16
"""Messages that a byte of a compressed chunk may stand for at most: each has a number of its own (`sequence`), so that
no compressor gets far below a byte a message."""
CDR_HEADER = b"\x00\x01\x00\x00"
# opcode, record length, channel, sequence, log_time, publish_time; then the CDR header
RECORD_HEADER = struct.Struct("<BQHIQQ")
BODY = RECORD_HEADER.size + len(CDR_HEADER)  # offset of the CDR body in a Message record
_OPCODE_MESSAGE = 5
HEADER_FIELDS: list[tuple[str, str, int]] = [
    ("#opcode", "u1", 0),
    ("#length", "<u8", 1),
    ("#channel", "<u2", 9),
    ("#sequence", "<u4", 11),
    ("#log_time", "<u8", 15),
    ("#publish_time", "<u8", 23),
    ("#cdr", "<u4", 31),
]


def iter_records(data: memoryview, start: int = 0) -> Iterator[tuple[int, int, int, int, int]]:
    """(offset, end, channel, sequence, log_time) of the Message records in `data`.

    Raises:
        FormatError: bytes that are no whole Message record.
    """
    while start < len(data):
        if start + BODY > len(data):
            raise FormatError(f"expected a message record at byte {start}, found {len(data) - start} bytes")
        opcode, length, channel, sequence, log_time, _ = RECORD_HEADER.unpack_from(data, start)
        end = start + 9 + length
        if opcode != 5 or length < BODY - 9 or end > len(data):
            raise FormatError(
                f"expected a message record at byte {start}, found opcode {opcode} of {length} bytes"
            )
        yield start, end, channel, sequence, log_time
        start = end
