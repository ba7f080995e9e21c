"""Writes and reads the leaves of a value of variable size: numbers, one or many, and text."""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, SpaceError, StepError
from tupli_mcap.messages import cdr
from tupli_mcap.spaces.exact import exact_array, shorten
from tupli_mcap.spaces.leaves import ROS_TYPES

Encode = Callable[[Any, bytearray, int], None]
Decode = Callable[[memoryview, int, int], tuple[Any, int]]
_DOUBLE = struct.Struct("<d")


@dataclass(frozen=True)
class Codec:
    """Writes and reads a value of the ROS type `ros`; `kind` says how a missing value is stored (see `Maybe`)."""

    ros: str
    kind: Literal["nothing", "fixed", "array", "string", "message"]
    encode: Encode
    decode: Decode
    count: int = 1  # elements, if the kind is "fixed"


@dataclass(frozen=True)
class Leaf:
    """An array or scalar of constant size."""

    dtype: np.dtype[Any]  # little-endian
    shape: tuple[int, ...]
    scalar: bool  # samples are NumPy scalars, not arrays
    seen: list[Any] | None = None  # collects the values instead of writing them

    @classmethod
    def of(cls, space: gym.Space[Any], path: str, wide: str | None = None) -> Leaf:
        """The leaf of a space, with the space's dtype or the wider one `wide`."""
        dtype, shape = np.dtype(space.dtype), tuple(space.shape or ())
        if dtype.name not in ROS_TYPES or not dtype.isnative:
            raise SpaceError(
                f"{path}: expected a dtype of {', '.join(ROS_TYPES)}, found {dtype.str} ({dtype.name})"
            )
        # Types of Gymnasium's samples: a Box of integers or bools rounds, which turns a 0-d array into a scalar.
        is_array = type(space) is spaces.MultiBinary or (type(space) is spaces.Box and dtype.kind == "f")
        if wide is not None:
            if wide not in ROS_TYPES:
                raise SpaceError(f"{path}: expected a dtype of {', '.join(ROS_TYPES)}, found {shorten(wide)}")
            dtype = np.dtype(wide)
        return cls(np.dtype(f"<{dtype.str[1:]}"), shape, shape == () and not is_array)

    @property
    def count(self) -> int:
        return math.prod(self.shape)

    def to_bytes(self) -> Callable[[Any], bytes]:
        """A function that turns a value into little-endian bytes, or raises a StepError without the path."""
        dtype, shape, array = self.dtype, self.shape, np.ndarray
        if self.seen is not None:
            return self._collect
        if dtype.kind == "b":  # those in arrays may hold other bytes than 0 and 1
            return partial(exact_bytes, dtype=dtype, shape=shape)
        scalar = dtype.type if shape == () else array
        double = float if shape == () and dtype == np.float64 else None
        integer = int if shape == () and dtype.kind in "iu" else None

        def convert(value: Any) -> bytes:
            kind = type(value)
            if (kind is array or kind is scalar) and value.dtype == dtype and value.shape == shape:
                return value.tobytes()  # type: ignore[no-any-return]
            if kind is double:
                return _DOUBLE.pack(value)
            if kind is integer:
                with contextlib.suppress(OverflowError):  # is said below
                    return value.to_bytes(dtype.itemsize, "little", signed=dtype.kind == "i")  # type: ignore[no-any-return]
            return exact_bytes(value, dtype, shape)

        return convert

    def batch_to_bytes(self, value: Array) -> bytes:
        """The same of stacked values."""
        if self.seen is not None:
            return self._collect(value)
        shape = (len(value), *self.shape)
        plain = type(value) is np.ndarray and self.dtype.kind != "b"  # a masked array has other bytes
        if plain and value.dtype == self.dtype and value.shape == shape:
            return value.tobytes()
        return exact_bytes(value, self.dtype, shape)

    def _collect(self, value: Any) -> bytes:
        assert self.seen is not None
        self.seen.append(value)
        return b""

    def from_array(self, array: Array) -> Any:
        return array[0] if self.scalar else array.reshape(self.shape)

    def split(self, array: Array, number: int) -> tuple[Any, ...]:
        """The items of a Sequence, whose elements follow each other in `array`."""
        if self.shape == () and not self.scalar:
            return tuple([array[i : i + 1].reshape(()) for i in range(number)])
        return tuple(array.reshape(number, *self.shape))


def numeric(leaf: Leaf) -> Codec:
    """One array or scalar."""
    dtype, count, itemsize = leaf.dtype, leaf.count, leaf.dtype.itemsize
    to_bytes, from_array = leaf.to_bytes(), leaf.from_array

    def encode(value: Any, out: bytearray, origin: int) -> None:
        cdr.write_array(out, origin, to_bytes(value), itemsize)

    def decode(data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        array, offset = cdr.read_array(data, offset, origin, dtype, count)
        return from_array(array), offset

    if count == 0:
        return Codec("", "nothing", encode, decode)
    ros = ROS_TYPES[dtype.name] + ("" if leaf.shape == () else f"[{count}]")
    return Codec(ros, "fixed", encode, decode, count)


def numeric_items(leaf: Leaf) -> Codec:
    """A tuple of arrays or scalars, whose elements follow each other."""
    dtype, count, itemsize = leaf.dtype, leaf.count, leaf.dtype.itemsize
    to_bytes = leaf.to_bytes()

    def encode(value: Any, out: bytearray, origin: int) -> None:
        expect_tuple(value)
        parts: list[bytes] = []
        try:
            for item in value:
                parts.append(to_bytes(item))  # noqa: PERF401 (the length says where it failed)
        except StepError as err:
            raise StepError(f"[{len(parts)}]{err}") from err.__cause__
        cdr.write_length(out, origin, len(parts) * count)
        cdr.write_array(out, origin, b"".join(parts), itemsize)

    def decode(data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        number, offset = _read_number(data, offset, origin, count)
        array, offset = cdr.read_array(data, offset, origin, dtype, number * count)
        return leaf.split(array, number), offset

    return Codec(f"{ROS_TYPES[dtype.name]}[]", "array", encode, decode)


def numeric_batch(leaf: Leaf) -> Codec:
    """Arrays or scalars stacked in one array."""
    dtype, shape, count, itemsize = leaf.dtype, leaf.shape, leaf.count, leaf.dtype.itemsize

    def encode(value: Any, out: bytearray, origin: int) -> None:
        number = _batch_length(value, dtype, shape)
        data = leaf.batch_to_bytes(value)
        cdr.write_length(out, origin, number * count)
        cdr.write_array(out, origin, data, itemsize)

    def decode(data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        number, offset = _read_number(data, offset, origin, count)
        array, offset = cdr.read_array(data, offset, origin, dtype, number * count)
        return array.reshape(number, *shape), offset

    return Codec(f"{ROS_TYPES[dtype.name]}[]", "array", encode, decode)


def empty_batch(leaf: Leaf) -> Codec:
    """Arrays without elements: only their number is left to store."""
    dtype, shape = leaf.dtype, leaf.shape

    def encode(value: Any, out: bytearray, origin: int) -> None:
        number = _batch_length(value, dtype, shape)
        leaf.batch_to_bytes(value)
        cdr.write_length(out, origin, number)

    def decode(data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        number, offset = cdr.read_length(data, offset, origin)
        try:
            return np.empty((number, *shape), dtype.newbyteorder("=")), offset
        except ValueError as err:  # no bytes limit the number
            raise FormatError(
                f"expected arrays of shape {shape} before offset {offset}, found {number}"
            ) from err

    return Codec("uint32", "array", encode, decode)


def _batch_length(value: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> int:
    if not isinstance(value, np.ndarray) or value.ndim == 0:
        lengths = ", ".join(["n", *map(str, shape)])
        raise StepError(f": expected an array of {dtype.name} and shape ({lengths}), found {shorten(value)}")
    return len(value)


def _read_number(data: memoryview, offset: int, origin: int, count: int) -> tuple[int, int]:
    elements, offset = cdr.read_length(data, offset, origin)
    if elements % count:
        raise FormatError(f"expected a multiple of {count} elements before offset {offset}, found {elements}")
    return elements // count, offset


def text() -> Codec:
    """A string."""

    def encode(value: Any, out: bytearray, origin: int) -> None:
        if not isinstance(value, str):
            raise StepError(f": expected a string, found {shorten(value)}")
        cdr.write_string(out, origin, value)

    return Codec("string", "string", encode, cdr.read_string)


def expect_tuple(value: Any) -> None:
    """Raises StepError unless `value` is a tuple: a list would be read back as one."""
    if not isinstance(value, tuple):
        raise StepError(f": expected a tuple, found {shorten(value)}")


def exact_bytes(value: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """The little-endian bytes of a value, cast to `dtype`; raises StepError if the cast is not exact."""
    return exact_array(value, dtype, shape, "").tobytes()
