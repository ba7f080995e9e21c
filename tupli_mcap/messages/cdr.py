"""The primitives of plain CDR, little-endian, appended to a bytearray and read from a memoryview.

A primitive is aligned to its size, counted from an origin (the byte after the encapsulation header).
A sequence is its length (uint32) and its elements; an empty one has no padding after the length. A string is
its length with the terminating NUL, UTF-8, NUL.

CDR strings hold no NUL and UTF-8 no lone surrogates, but a Python string may. These, and the escape character
itself, are written as U+001A (SUBSTITUTE) and four hexadecimal digits, so that every string comes back exactly
and every reader can show it.
"""

from __future__ import annotations

import re
from struct import Struct
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError

_LENGTH = Struct("<I")
_PADDING = tuple(bytes(n) for n in range(8))
_TO_ESCAPE = re.compile("[\x00\x1a\ud800-\udfff]")
_ESCAPED = re.compile("\x1a(.{0,4})", re.DOTALL)


def write_length(out: bytearray, origin: int, length: int) -> None:
    """Append an aligned uint32."""
    out += _PADDING[(origin - len(out)) & 3]
    out += _LENGTH.pack(length)


def read_length(data: memoryview, offset: int, origin: int) -> tuple[int, int]:
    """Return an aligned uint32 and the offset after it."""
    offset += (origin - offset) & 3
    if offset + 4 > len(data):
        raise FormatError(f"expected a length at offset {offset}, found the end at {len(data)}")
    return _LENGTH.unpack_from(data, offset)[0], offset + 4


def write_array(out: bytearray, origin: int, data: bytes, itemsize: int) -> None:
    """Append the little-endian bytes of elements of `itemsize` bytes, aligned; no padding if `data` is empty."""
    if data:
        out += _PADDING[(origin - len(out)) & (itemsize - 1)]
        out += data


def read_array(
    data: memoryview, offset: int, origin: int, dtype: np.dtype[Any], count: int
) -> tuple[Array, int]:
    """Return a new array of `count` elements of a little-endian `dtype`, and the offset after them."""
    if count == 0:
        return np.empty(0, dtype), offset
    size = dtype.itemsize
    offset += (origin - offset) & (size - 1)
    end = offset + count * size
    if end > len(data):
        raise FormatError(
            f"expected {count} of {dtype.name} at offset {offset}, found the end at {len(data)}"
        )
    if dtype.kind != "b":
        return np.frombuffer(data, dtype, count, offset).astype(dtype.newbyteorder("=")), end
    flags = np.frombuffer(data, np.uint8, count, offset)
    if flags.max() > 1:
        raise FormatError(f"expected booleans of 0 or 1 at offset {offset}, found {int(flags.max())}")
    return flags.astype(np.bool_), end


def write_string(out: bytearray, origin: int, text: str) -> None:
    """Append a string; it may hold any characters."""
    if _TO_ESCAPE.search(text) is not None:
        text = _TO_ESCAPE.sub(lambda match: f"\x1a{ord(match[0]):04x}", text)
    data = text.encode()
    write_length(out, origin, len(data) + 1)
    out += data
    out += b"\0"


def read_string(data: memoryview, offset: int, origin: int) -> tuple[str, int]:
    """Return a string and the offset after it. Some writers store an empty string without its NUL."""
    length, offset = read_length(data, offset, origin)
    end = offset + length
    if end > len(data):
        raise FormatError(
            f"expected a string of {length} bytes at offset {offset}, found the end at {len(data)}"
        )
    return decode_string(data[offset:end], offset), end


def decode_string(stored: bytes | memoryview, offset: int) -> str:
    """Return the string whose bytes, with their NUL, were stored at `offset`."""
    if not stored:
        return ""
    try:
        text = str(stored[:-1], "utf-8")
    except UnicodeDecodeError as err:
        raise FormatError(f"expected UTF-8 at offset {offset + err.start}, found {err.reason}") from err
    if stored[-1] != 0 or "\0" in text:
        raise FormatError(f"expected a string with one NUL, at its end, at offset {offset}")
    return _ESCAPED.sub(_unescape, text) if "\x1a" in text else text


def _unescape(match: re.Match[str]) -> str:
    digits = match[1]
    if re.fullmatch("[0-9a-f]{4}", digits) is None or _TO_ESCAPE.match(chr(int(digits, 16))) is None:
        raise FormatError(f"expected an escaped character after U+001A, found {digits!r}")
    return chr(int(digits, 16))
