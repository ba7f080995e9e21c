"""Writes and reads values made of other values: Dict, Tuple, Sequence, Graph and OneOf.

Each level puts its part of the path before the message of a StepError from below.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import GraphInstance

from tupli_mcap.errors import FormatError, StepError
from tupli_mcap.messages import cdr
from tupli_mcap.messages.variable.leaf_codecs import Codec, Decode, Encode, expect_tuple
from tupli_mcap.spaces.exact import shorten

Entry = tuple[Any, str, Encode]  # key, its path, its encoder


def encode_dict(entries: Sequence[Entry]) -> Encode:
    """Encodes entries in the order of the space; the value's order does not matter."""
    keys = [key for key, _, _ in entries]

    def encode(value: Any, out: bytearray, origin: int) -> None:
        if not isinstance(value, dict) or value.keys() != set(keys):
            found = list(value) if isinstance(value, dict) else value
            raise StepError(f": expected a dict with the keys {shorten(keys)}, found {shorten(found)}")
        _put(entries, value, out, origin)

    return encode


def decode_dict(keys: Sequence[Any], decoders: Sequence[Decode]) -> Decode:
    decode_values = decode_tuple(decoders)

    def decode(data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        values, offset = decode_values(data, offset, origin)
        return dict(zip(keys, values, strict=True)), offset

    return decode


def encode_tuple(entries: Sequence[Entry]) -> Encode:
    def encode(value: Any, out: bytearray, origin: int) -> None:
        if not isinstance(value, tuple) or len(value) != len(entries):
            raise StepError(f": expected a tuple of {len(entries)}, found {shorten(value)}")
        _put(entries, value, out, origin)

    return encode


def _put(entries: Sequence[Entry], value: Any, out: bytearray, origin: int) -> None:
    for key, path, put in entries:
        try:
            put(value[key], out, origin)
        except StepError as err:
            raise StepError(f"{path}{err}") from err.__cause__


def decode_tuple(decoders: Sequence[Decode]) -> Decode:
    def decode(data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        values = []
        for get in decoders:
            value, offset = get(data, offset, origin)
            values.append(value)
        return tuple(values), offset

    return decode


def items_of(codec: Codec) -> Codec:
    """A tuple of any number of values, each a message or a string."""
    put, get = codec.encode, codec.decode

    def encode(value: Any, out: bytearray, origin: int) -> None:
        expect_tuple(value)
        cdr.write_length(out, origin, len(value))
        for i, item in enumerate(value):
            try:
                put(item, out, origin)
            except StepError as err:
                raise StepError(f"[{i}]{err}") from err.__cause__

    def decode(data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        number, offset = cdr.read_length(data, offset, origin)
        if number > len(data) - offset:  # each item takes at least one byte
            raise FormatError(f"expected {number} items at offset {offset}, found {len(data) - offset} bytes")
        values = []
        for _ in range(number):
            value, offset = get(data, offset, origin)
            values.append(value)
        return tuple(values), offset

    return Codec(f"{codec.ros}[]", "array", encode, decode)


@dataclass(frozen=True)
class Maybe:
    """A value that may be missing: another field of the message says whether it is there.

    `codec` writes and reads a value, `skip` writes a missing one, `miss` reads a missing one.
    """

    codec: Codec
    skip: Callable[[bytearray, int], None]
    miss: Callable[[memoryview, int, int], int]

    @classmethod
    def of(cls, codec: Codec) -> Maybe:
        if codec.kind == "nothing":
            return cls(codec, lambda _out, _origin: None, lambda _data, offset, _origin: offset)
        if codec.kind == "string":
            return cls(codec, lambda out, origin: cdr.write_string(out, origin, ""), _miss_string)
        if codec.kind in ("fixed", "message"):
            codec = _counted(codec)
        return cls(codec, lambda out, origin: cdr.write_length(out, origin, 0), _miss_array)


def _miss_string(data: memoryview, offset: int, origin: int) -> int:
    text, end = cdr.read_string(data, offset, origin)
    if text:
        raise FormatError(
            f"expected no text at offset {offset}, where none was chosen, found {shorten(text)}"
        )
    return end


def _miss_array(data: memoryview, offset: int, origin: int) -> int:
    number, end = cdr.read_length(data, offset, origin)
    if number:
        raise FormatError(f"expected no elements at offset {offset}, where none were chosen, found {number}")
    return end


def _counted(codec: Codec) -> Codec:
    """A value of a fixed number of elements (a message is one) as a sequence, so that it can be empty."""
    put, get, count = codec.encode, codec.decode, codec.count

    def encode(value: Any, out: bytearray, origin: int) -> None:
        cdr.write_length(out, origin, count)
        put(value, out, origin)

    def decode(data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        number, offset = cdr.read_length(data, offset, origin)
        if number != count:
            raise FormatError(f"expected {count} elements before offset {offset}, found {number}")
        return get(data, offset, origin)

    return Codec(codec.ros.partition("[")[0] + "[]", "array", encode, decode)


def encode_graph(nodes: Codec, edges: Maybe | None, links: Maybe) -> Encode:
    def encode(value: Any, out: bytearray, origin: int) -> None:
        if not isinstance(value, GraphInstance):
            raise StepError(f": expected a GraphInstance, found {shorten(value)}")
        try:
            path = ".nodes"
            nodes.encode(value.nodes, out, origin)
            path = ".edges"
            if edges is not None:
                _encode_maybe(edges, value.edges, out, origin)
            elif value.edges is not None:
                raise StepError(f": expected None, as the space has no edges, found {shorten(value.edges)}")
            path = ".edge_links"
            _encode_maybe(links, value.edge_links, out, origin)
        except StepError as err:
            raise StepError(f"{path}{err}") from err.__cause__

    return encode


def decode_graph(nodes: Codec, edges: Maybe | None, links: Maybe) -> Decode:
    def decode(data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        nodes_value, offset = nodes.decode(data, offset, origin)
        edges_value = None
        if edges is not None:
            edges_value, offset = _decode_maybe(edges, data, offset, origin)
        links_value, offset = _decode_maybe(links, data, offset, origin)
        return GraphInstance(nodes_value, edges_value, links_value), offset

    return decode


def _encode_maybe(maybe: Maybe, value: Any, out: bytearray, origin: int) -> None:
    """A boolean, then the value: None and an empty array differ."""
    if value is None:
        out += b"\0"
        maybe.skip(out, origin)
    else:
        out += b"\1"
        maybe.codec.encode(value, out, origin)


def _decode_maybe(maybe: Maybe, data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
    if offset >= len(data) or data[offset] > 1:
        raise FormatError(
            f"expected a boolean at offset {offset}, found {bytes(data[offset : offset + 1])!r}"
        )
    if data[offset]:
        return maybe.codec.decode(data, offset + 1, origin)
    return None, maybe.miss(data, offset + 1, origin)


def encode_one_of(options: Sequence[Maybe]) -> Encode:
    def encode(value: Any, out: bytearray, origin: int) -> None:
        if not isinstance(value, tuple) or len(value) != 2:
            raise StepError(f": expected a pair of an index and a value, found {shorten(value)}")
        index, chosen = value
        if not isinstance(index, int | np.integer) or not 0 <= index < len(options):
            raise StepError(f"[0]: expected an index below {len(options)}, found {shorten(index)}")
        cdr.write_length(out, origin, int(index))
        for i, option in enumerate(options):
            if i != index:
                option.skip(out, origin)
                continue
            try:
                option.codec.encode(chosen, out, origin)
            except StepError as err:
                raise StepError(f"[1]{err}") from err.__cause__

    return encode


def decode_one_of(options: Sequence[Maybe]) -> Decode:
    def decode(data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        index, offset = cdr.read_length(data, offset, origin)
        if index >= len(options):
            raise FormatError(f"expected an index below {len(options)} before offset {offset}, found {index}")
        chosen = None
        for i, option in enumerate(options):
            if i == index:
                chosen, offset = option.codec.decode(data, offset, origin)
            else:
                offset = option.miss(data, offset, origin)
        return (np.int64(index), chosen), offset

    return decode


def with_dummy(encode: Encode, decode: Decode) -> tuple[Encode, Decode]:
    """Adds one byte to a message without fields, which CDR cannot have."""

    def encode_byte(value: Any, out: bytearray, origin: int) -> None:
        encode(value, out, origin)
        out += b"\0"

    def decode_byte(data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        value, offset = decode(data, offset, origin)
        if offset >= len(data):
            raise FormatError(f"expected a byte at offset {offset}, found the end")
        return value, offset + 1

    return encode_byte, decode_byte
